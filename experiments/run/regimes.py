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
from experiments.run import physical_limits
from experiments.run.estimates import Estimate, two_way
from experiments.run.search import passes
from experiments.run.statistics import rate_interval
from experiments.run.tables import (
    Result,
    by_label,
    ordered,
    training_of,
    training_range,
    trainings_of,
    with_trainings,
)


class Mean(NamedTuple):
    """Column of a regime's table: the mean of a metric over the drives that finished."""

    heading: str
    key: str
    decimals: int
    factor: float = 1.0


SCORE = Mean("score", "score", 2)
POSSIBLE = Mean("of possible, %", "of_possible", 0, 100.0)
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
    Mean("ALE, m", "ale", 3),
    Mean("overshoot, m", "overshoot", 3),
    Mean("back after, s", "recovery_time", 1),
    *MEANS[3:],
)
"""The same where cases say where they start, so that the largest error is that of the start."""
SEARCHED = {
    "fixed_speed": (Mean("entry speed, m/s", "highest_fixed_speed", 2), POSSIBLE, *MEANS[3:]),
    "grip": (
        Mean("fastest lap, s", "fastest_lap", 2), POSSIBLE, Mean("grip", "highest_grip", 2),
        *MEANS[3:],
    ),
}  # fmt: skip
"""The same by the setting that is searched for."""
COUNTS = ("agent", "drives", "failed", "95 %")
NOTE = (
    "A drive fails unless it reaches the end of the path; beside the failures stands the "
    "Clopper-Pearson interval of their rate. The other columns are means over the "
    "drives that did: largest and root mean square lateral error, root mean squares of speed "
    "error, steering rate and jerk, and the score that weights are tuned for (lower is better). "
    "Agents that fail more often have them over easier drives; some finish because they are slow. "
    "Overshoot is the largest lateral error on the other side of the path than the start; a "
    "vehicle is back once its lateral error stays below 0.1 m. Entry speeds are the highest with "
    "which a lane change is passed without touching a cone, and fastest laps those over all shares "
    "of grip tried, each beside its share of what an optimal control problem says is possible. "
    "Of an agent with several trainings the drives of all are counted; beside the interval of its "
    "rate of failures stands the range of its trainings' rates, and ± is the 95 % interval of a "
    "mean over trainings, by the t-distribution."
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
    trainings: int = 0
    by_training: str = ""
    """Range of the trainings' rates of failures, if there are several."""
    spreads: tuple[float | None, ...] = ()
    """Half widths of the means' 95 % intervals over trainings, for each column."""

    @property
    def cells(self) -> list[str]:
        """Text of the columns of `headings`."""
        spreads = self.spreads or (None,) * len(self.means)
        numbers = [
            "–"
            if mean is None
            else Estimate(mean, spread).words(column.decimals, factor=column.factor)
            for mean, spread, column in zip(self.means, spreads, self.columns, strict=True)
        ]
        low, high = (100.0 * end for end in rate_interval(self.failed, self.drives))
        interval = f"{low:.0f}–{high:.0f} %"
        if self.by_training:
            interval += f", {self.by_training}"
        name = with_trainings(self.label, self.trainings)
        return [name, f"{self.drives}", f"{self.failed}", interval, *numbers]


def by_regime(cases: Iterable[Result]) -> dict[str, list[Result]]:
    """Group the cases that have a regime, in the order of `tables.ordered`."""
    groups: dict[str, list[Result]] = {}
    for case in ordered(cases):
        if name := str(case.get("regime") or ""):
            groups.setdefault(name, []).append(case)
    return groups


def columns_of(cases: Iterable[Result]) -> tuple[Mean, ...]:
    """Return the columns of means for the cases of a regime."""
    for case in cases:
        if setting := (case.get("search") or {}).get("setting"):
            return SEARCHED[setting]
        if case.get("start"):
            return FROM_STARTS
    return MEANS


def headings(columns: tuple[Mean, ...]) -> list[str]:
    """Return the headings of a table with these columns of means."""
    return [*COUNTS, *(column.heading for column in columns)]


def lines(cases: Iterable[Result]) -> list[Line]:
    """Return a line for each agent of one regime."""
    cases = list(cases)
    columns = columns_of(cases)
    return [_line(label, group, columns) for label, group in by_label(cases).items()]


def _line(label: str, cases: Sequence[Result], columns: tuple[Mean, ...]) -> Line:
    finished = [case for case in cases if passed(case)]
    found = [[(training_of(case), figure(case, column)) for case in finished] for column in columns]
    means = tuple(_mean([value for _, value in values]) for values in found)
    failed = len(cases) - len(finished)
    if (count := trainings_of(cases)) < 2:
        return Line(label, len(cases), failed, means, columns, count)
    spreads = tuple(
        two_way((None, training, value) for training, value in values if value is not None)
        .over_trainings
        if mean is not None else None
        for mean, values in zip(means, found, strict=True)
    )  # fmt: skip
    by_training = training_range(cases, lambda case: not passed(case))
    return Line(label, len(cases), failed, means, columns, count, by_training, spreads)


def passed(case: Result) -> bool:
    """Return whether the drive of a case did what its regime asks for."""
    return case.get("status") == "ok" and "end" in case and passes(case)


def figure(case: Result, column: Mean) -> float | None:
    """Return what a case has in a column of means; None if it has none."""
    found = case["metrics"]
    if column is SCORE:
        return score(found)
    return possible(case) if column is POSSIBLE else found.get(column.key)


def possible(case: Result) -> float | None:
    """Return the share of what is physically possible that a searched case reached.

    An entry speed by the highest possible one, or the least possible lap time by the fastest lap;
    None if no limit is known for the case.
    """
    conditions, found = case.get("conditions"), case["metrics"]
    friction = conditions.get("friction") if isinstance(conditions, Mapping) else None
    if case.get("vehicle_changes") or not isinstance(friction, float):
        return None
    limit = physical_limits.limit_of(str(case["trajectory"]), str(case["vehicle"]), friction)
    if limit is None:
        return None
    if "fastest_lap" in found:
        return float(limit / found["fastest_lap"])
    return float(found["highest_fixed_speed"] / limit) if "highest_fixed_speed" in found else None


def _mean(values: Sequence[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None


def score(metrics: Mapping[str, float]) -> float | None:
    """Return the score of a finished drive; None for results that lack one of its metrics."""
    if not all(key in metrics for key in SCORED):
        return None
    return float(np.sum([metrics[key] for key in SCORED] / SCALES))


def tables_of(cases: Iterable[Result]) -> list[Table]:
    """Return tables for a terminal, with a group of lines for each regime; none without any.

    Neighbouring regimes of equal columns share a table.
    """
    shown: list[Table] = []
    columns: tuple[Mean, ...] | None = None
    for name, group in by_regime(cases).items():
        found = lines(group)
        if found[0].columns != columns:
            columns = found[0].columns
            shown.append(_start(columns))
        for place, line in enumerate(found):
            first = Text("" if place else name, style="bold")
            cells = (Text(cell.replace(" ±", "\n±").replace(", ", "\n", 1)) for cell in line.cells)
            shown[-1].add_row(first, *cells, end_section=place + 1 == len(found))
    return shown


def _start(columns: tuple[Mean, ...]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    table.add_column("regime", max_width=30, overflow="fold")
    for place, heading in enumerate(headings(columns)):
        table.add_column(heading.replace(" ", "\n"), justify="right" if place else "left")
    return table
