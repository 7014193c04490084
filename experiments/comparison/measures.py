"""Metrics that are compared: heading, unit, which direction is better, and the loss of a drive."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from experiments.run import regimes
from experiments.run.ranking import LARGER_IS_BETTER
from experiments.run.tables import EFFORT, FURTHER, TRACKING

Result = Mapping[str, Any]

SCORE = regimes.SCORE.key
DEFAULTS = (
    "ale", "mle", "aoe", "rms_speed_error", "steering_rate_rms", "jerk_rms", SCORE, "reward",
)  # fmt: skip
FOUND = {columns[0].key: setting for setting, columns in regimes.SEARCHED.items()}
"""First figures of searched regimes, and the setting that is searched for."""
LARGER = (*LARGER_IS_BETTER, "highest_grip", "reward", "cone_clearance")
"""Metrics of which more is better; of all others less is."""
HEADINGS = {
    **{
        one.key: (one.heading, one.unit)
        for one in (*TRACKING, *EFFORT, *FURTHER)
        if one.source == "metrics"
    },
    "rms_speed_error": ("speed error", "m/s"),
    "steering_rate_rms": ("steering rate", "rad/s"),
    "jerk_rms": ("jerk", "m/s³"),
    SCORE: ("score", ""),
    "reward": ("reward", ""),
    "highest_fixed_speed": ("entry speed", "m/s"),
    "highest_grip": ("highest grip", ""),
    "fastest_lap": ("fastest lap", "s"),
}
"""Headings and units of metrics; others have their name."""


class Measure(NamedTuple):
    """Metric, its heading and unit, and the sign that makes a loss of it."""

    key: str
    heading: str
    unit: str
    sign: float
    """1 where less is better, -1 where more is."""

    @property
    def title(self) -> str:
        """Heading with its unit."""
        return f"{self.heading}, {self.unit}" if self.unit else self.heading

    @property
    def better(self) -> str:
        """Arrow towards what is better."""
        return "↓" if self.sign > 0.0 else "↑"

    def loss(self, case: Result, *, passed: bool) -> float:
        """Return the loss of a drive: inf if it failed, NaN if the metric is none of its own.

        Figures that a search finds are those of the drives that search for them.
        """
        search = case.get("search") or {}
        if self.key in FOUND and search.get("setting") != FOUND[self.key]:
            return math.nan
        if not passed:
            return math.inf
        found = case["metrics"]
        value = regimes.score(found) if self.key == SCORE else found.get(self.key)
        return math.nan if value is None else self.sign * float(value)


def measure_of(key: str) -> Measure:
    """Return the measure of a metric's name."""
    heading, unit = HEADINGS.get(key, (key.replace("_", " "), ""))
    return Measure(key, heading, unit, -1.0 if key in LARGER else 1.0)
