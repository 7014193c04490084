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


class Mean(NamedTuple):
    """Column of a regime's table: the mean of a metric over the drives that finished."""

    heading: str
    key: str
    decimals: int


SCORE = Mean("score", "score", 2)
MEANS = (
    Mean("MLE, m", "mle", 3),
    Mean("ALE, m", "ale", 3),
    Mean("speed error, m/s", "rms_speed_error", 2),
    Mean("steering rate, rad/s", "steering_rate_rms", 3),
    Mean("jerk, m/s³", "jerk_rms", 2),
    SCORE,
)
"""Columns of a regime's table after `COUNTS`."""
FROM_STARTS = (
    MEANS[0],
    Mean("overshoot, m", "overshoot", 3),
    Mean("back after, s", "recovery_time", 1),
    *MEANS[3:],
)
"""The same where cases say where they start."""
COUNTS = ("agent", "drives", "failed")
NOTE = (
    "A drive fails unless it reaches the end of the path. The other columns are means over the "
    "drives that did: largest and root mean square lateral error, root mean squares of speed "
    "error, steering rate and jerk, and the score that weights are tuned for (lower is better). "
    "Agents that fail more often have them over easier drives; some finish because they are slow. "
    "Overshoot is the largest lateral error on the other side of the path than the start; a "
    "vehicle is back once its lateral error stays below 0.1 m."
)
SCORED = ("ale", "aoe", "rms_speed_error", "steering_rate_rms", "jerk_rms")
"""Metrics whose sum, each divided by its scale, is the score (`agents.weight_tuning.score`)."""


class Line(NamedTuple):
    """An agent's drives in one regime; means are None where none finished or none is known."""

    label: str
    drives: int
    failed: int
    means: tuple[float | None, ...]
    columns: tuple[Mean, ...] = MEANS

    @property
    def cells(self) -> list[str]:
        """Text of the columns of `headings`."""
        numbers = (
            "–" if mean is None else f"{mean:.{column.decimals}f}"
            for mean, column in zip(self.means, self.columns, strict=True)
        )
        return [self.label, f"{self.drives}", f"{self.failed}", *numbers]


def by_regime(cases: Iterable[Result]) -> dict[str, list[Result]]:
    """Group the cases that have a regime, in the order of `tables.ordered`."""
    groups: dict[str, list[Result]] = {}
    for case in ordered(cases):
        if name := str(case.get("regime") or ""):
            groups.setdefault(name, []).append(case)
    return groups


def columns_of(cases: Iterable[Result]) -> tuple[Mean, ...]:
    """Return the columns of means for some cases."""
    return FROM_STARTS if any(case.get("start") for case in cases) else MEANS


def headings(columns: tuple[Mean, ...]) -> list[str]:
    """Return the headings of a table with these columns of means."""
    return [*COUNTS, *(column.heading for column in columns)]


def lines(cases: Iterable[Result], columns: tuple[Mean, ...] | None = None) -> list[Line]:
    """Return a line for each agent of one regime, by default with the columns of its cases."""
    cases = list(cases)
    shown = columns_of(cases) if columns is None else columns
    return [_line(label, group, shown) for label, group in by_label(cases).items()]


def _line(label: str, cases: Sequence[Result], columns: tuple[Mean, ...]) -> Line:
    finished = [case["metrics"] for case in cases if case.get("end") == "finished"]
    means = tuple(
        _mean([score(one) if column is SCORE else one.get(column.key) for one in finished])
        for column in columns
    )
    return Line(label, len(cases), len(cases) - len(finished), means, columns)


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
    columns = columns_of(case for group in groups.values() for case in group)
    for place, heading in enumerate(headings(columns)):
        shown.add_column(heading.replace(" ", "\n"), justify="right" if place else "left")
    for name, group in groups.items():
        for place, line in enumerate(found := lines(group, columns)):
            first = Text("" if place else name, style="bold")
            shown.add_row(first, *map(Text, line.cells), end_section=place + 1 == len(found))
    return shown
