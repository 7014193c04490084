"""Results by regime: what a case of a suite such as `limits` tries, and how each agent fares in it.

A regime may hold several settings and paths, such as lane changes at four speeds.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from agents.weight_tuning.score import SCALES
from experiments.run.tables import Result, by_label, ordered

HEADINGS = (
    "agent", "drives", "failed", "MLE, m", "ALE, m", "speed error, m/s", "steering rate, rad/s",
    "jerk, m/s³", "score",
)  # fmt: skip
"""Headings of a regime's table: the errors and rates are means over the drives that finished."""
NOTE = (
    "A drive fails unless it reaches the end of the path. The other columns are means over the "
    "drives that did: largest and root mean square lateral error, root mean squares of speed "
    "error, steering rate and jerk, and the score that weights are tuned for (lower is better). "
    "Agents that fail more often have them over easier drives; some finish because they are slow."
)
DECIMALS = (3, 3, 2, 3, 2, 2)
SCORED = ("ale", "aoe", "rms_speed_error", "steering_rate_rms", "jerk_rms")
"""Metrics whose sum, each divided by its scale, is the score (`agents.weight_tuning.score`)."""


class Line(NamedTuple):
    """An agent's drives in one regime; means are None where none finished or none is known."""

    label: str
    drives: int
    failed: int
    means: tuple[float | None, ...]
    """MLE and ALE (m), rms speed error (m/s), steering rate (rad/s) and jerk (m/s^3), score."""

    @property
    def cells(self) -> list[str]:
        """Text of the columns of `HEADINGS`."""
        numbers = (
            "–" if mean is None else f"{mean:.{decimals}f}"
            for mean, decimals in zip(self.means, DECIMALS, strict=True)
        )
        return [self.label, f"{self.drives}", f"{self.failed}", *numbers]


def by_regime(cases: Iterable[Result]) -> dict[str, list[Result]]:
    """Group the cases that have a regime, in the order of `tables.ordered`."""
    groups: dict[str, list[Result]] = {}
    for case in ordered(cases):
        if name := str(case.get("regime") or ""):
            groups.setdefault(name, []).append(case)
    return groups


def lines(cases: Iterable[Result]) -> list[Line]:
    """Return a line for each agent of one regime."""
    return [_line(label, group) for label, group in by_label(cases).items()]


def _line(label: str, cases: Sequence[Result]) -> Line:
    finished = [case["metrics"] for case in cases if case.get("end") == "finished"]
    columns = [
        [metrics.get(key) for metrics in finished]
        for key in ("mle", "ale", "rms_speed_error", "steering_rate_rms", "jerk_rms")
    ]
    columns.append([score(metrics) for metrics in finished])
    return Line(label, len(cases), len(cases) - len(finished), tuple(map(_mean, columns)))


def _mean(values: Sequence[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None


def score(metrics: Mapping[str, float]) -> float | None:
    """Return the score of a finished drive; None for results that lack one of its metrics."""
    if not all(key in metrics for key in SCORED):
        return None
    return float(np.sum([metrics[key] for key in SCORED] / SCALES))


def table(cases: Iterable[Result]) -> Table | None:
    """Return a table for a terminal, with a group of lines for each regime; None without any."""
    groups = by_regime(cases)
    if not groups:
        return None
    shown = Table(
        title="By regime", title_justify="left", title_style="bold", box=box.SIMPLE_HEAD,
        padding=(0, 1), pad_edge=False, caption=NOTE, caption_justify="left",
    )  # fmt: skip
    shown.add_column("regime", max_width=38, overflow="fold")
    for place, heading in enumerate(HEADINGS):
        shown.add_column(heading.replace(" ", "\n"), justify="right" if place else "left")
    for name, group in groups.items():
        for place, line in enumerate(found := lines(group)):
            first = Text("" if place else name, style="bold")
            shown.add_row(first, *map(Text, line.cells), end_section=place + 1 == len(found))
    return shown
