"""Outcome of a comparison: each metric's difference, aggregates and odds, and the failures."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.comparison.competitors import Competitor, Drive
from experiments.comparison.measures import Measure
from experiments.run.resampling import Intervals, bootstrap_intervals, plan_of, run_weights
from experiments.run.statistics import (
    Interval,
    optimality_gap,
    paired_failures,
    performance_profile,
    probability_of_improvement,
    rate_interval,
    weighted_interquartile_mean,
)

Array = NDArray[Any]

LEVELS = 40
"""Number of levels of a performance profile."""
SPAN = 1e3
"""Largest ratio of a profile's levels; less than the least of them is next to nothing."""
HEAD = 6
"""Number of statistics that every metric has, see `_Sides.statistic`."""


@dataclass(frozen=True)
class Profile:
    """Shares of drives whose loss is at most each level; each share is an interval."""

    levels: Array
    a: list[Interval]
    b: list[Interval]


@dataclass(frozen=True)
class Metric:
    """Results of one metric: differences are B - A, in the metric's unit.

    Means, `difference` and `relative` (to the size of A's mean) are over pairs that both passed;
    all else is over all drives, a failed one being behind every other.
    """

    measure: Measure
    drives: int
    pairs: int
    """Pairs of drives that both passed; with several trainings, of each with each."""
    mean_a: float
    mean_b: float
    difference: Interval
    relative: Interval
    over_drives: Interval
    over_trainings: Interval
    """The difference with the interval over drives alone, and over trainings alone."""
    iqm_a: Interval
    iqm_b: Interval
    improvement: Interval
    """Probability that B is better than A in a random run of the same task."""
    wins: int
    ties: int
    losses: int
    """Drives in which B is better, the same, or worse."""
    target: float | None
    """Target of the optimality gaps."""
    gap_a: Interval | None
    gap_b: Interval | None
    profile: Profile


@dataclass(frozen=True)
class Outcome:
    """Comparison of B with its baseline A."""

    a: Competitor
    b: Competitor
    drives: list[Drive]
    resampled: str
    """Says over what the intervals are."""
    resamples: int
    seed: int
    metrics: list[Metric]
    failed_a: int
    failed_b: int
    runs_a: int
    runs_b: int
    a_alone: int
    b_alone: int
    """Pairs of which A alone, and B alone, failed."""
    failures_p: float | None
    """p-value of McNemar's exact test; None with several trainings, whose drives are not paired."""
    seconds_a: float | None
    seconds_b: float | None
    """Median over drives of the median time of `predict`, s."""
    only_a: list[Drive]
    only_b: list[Drive]
    """Drives that the other lacks, or of which trainings are missing."""

    @property
    def trainings(self) -> tuple[int, int]:
        """Numbers of trainings of both sides."""
        return len(self.a.trainings), len(self.b.trainings)

    def failure_rates(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the Clopper-Pearson intervals of both sides' failure rates."""
        return rate_interval(self.failed_a, self.runs_a), rate_interval(self.failed_b, self.runs_b)


@dataclass(frozen=True)
class _Sides:
    """Losses of a metric, (trainings, drives), and the task of each of its drives.

    `known` marks them among all drives.
    """

    measure: Measure
    a: Array
    b: Array
    tasks: NDArray[np.intp]
    known: NDArray[np.bool_]
    levels: Array
    target: float | None

    @property
    def rows(self) -> int:
        """Number of statistics."""
        return HEAD + 2 * (self.target is not None) + 2 * len(self.levels)

    def statistic(self, drives: Array, for_a: Array, for_b: Array) -> Array:
        """Return the statistics of draws: `HEAD` rows, gaps, both profiles."""
        if not self.known.all():
            drives = drives[:, self.known]
        runs_a, runs_b = run_weights(drives, for_a), run_weights(drives, for_b)
        flat_a, flat_b = self.a.ravel(), self.b.ravel()
        difference, mean = self._difference(drives, for_a, for_b)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = difference / np.abs(mean)
        rows = [
            difference, mean, relative,
            weighted_interquartile_mean(flat_a, runs_a),
            weighted_interquartile_mean(flat_b, runs_b),
            probability_of_improvement(
                flat_b, flat_a, np.tile(self.tasks, len(self.b)),
                np.tile(self.tasks, len(self.a)), runs_b, runs_a,
            ),
        ]  # fmt: skip
        if self.target is not None:
            rows += [
                optimality_gap(flat_a, self.target, runs_a),
                optimality_gap(flat_b, self.target, runs_b),
            ]
        return np.concatenate(
            [
                np.stack(rows),
                performance_profile(flat_a, self.levels, runs_a),
                performance_profile(flat_b, self.levels, runs_b),
            ]
        )

    def _difference(self, drives: Array, for_a: Array, for_b: Array) -> tuple[Array, Array]:
        """Return means of b - a and of a over pairs of runs of a drive that both passed."""
        passed_a, passed_b = (np.isfinite(one).astype(float) for one in (self.a, self.b))
        sum_a, sum_b = (np.where(np.isfinite(one), one, 0.0) for one in (self.a, self.b))
        count_a, count_b = for_a @ passed_a, for_b @ passed_b
        pairs = (drives * count_a * count_b).sum(axis=1)
        total_a = (drives * (for_a @ sum_a) * count_b).sum(axis=1)
        total_b = (drives * (for_b @ sum_b) * count_a).sum(axis=1)
        with np.errstate(invalid="ignore"):
            return (total_b - total_a) / pairs, total_a / pairs


def compare(
    a: Competitor,
    b: Competitor,
    drives_of: dict[str, Drive],
    measures: Sequence[Measure],
    targets: dict[str, float],
    *,
    seed: int = 0,
) -> Outcome:
    """Compare a competitor with its baseline on the drives that both have with all trainings.

    Parameters
    ----------
    a, b
        Baseline and competitor.
    drives_of
        Setting, path and seed of every drive.
    measures
        Metrics, in the order of the losses of a run.
    targets
        Target of the optimality gap, by metric.
    seed
        Seed of the resampling.

    Raises
    ------
    ValueError
        If no drive is in common, or a target is of a metric that can be negative.
    """
    trainings = a.trainings, b.trainings
    sizes = len(trainings[0]), len(trainings[1])
    keys = [
        key for key, runs in a.runs.items()
        if len(runs) == sizes[0] and len(b.runs.get(key, ())) == sizes[1]
    ]  # fmt: skip
    if not keys:
        raise ValueError(
            f"{a.label} in {a.folder} and {b.label} in {b.folder} have no drive in common"
        )
    shared = set(keys)
    drives = [drives_of[key] for key in keys]
    plan = plan_of([(one.setting, one.path, one.seed) for one in drives])
    sides = _sides(a, b, keys, drives, measures, targets)

    def statistic(drawn: Array, for_a: Array, for_b: Array) -> Array:
        return np.concatenate([one.statistic(drawn, for_a, for_b) for one in sides])

    several = max(sizes) > 1
    found = bootstrap_intervals(statistic, plan, sizes, seed=seed)
    apart = [found, found]
    if several:
        apart = [
            bootstrap_intervals(statistic, plan, sizes, draw_trainings=False, seed=seed),
            bootstrap_intervals(statistic, plan, sizes, draw_drives=False, seed=seed),
        ]
    metrics, start = [], 0
    for side in sides:
        metrics.append(_metric(side, found, apart, start))
        start += side.rows
    passed_a, passed_b = (
        np.array([[one.runs[key][training].passed for key in keys] for training in found])
        for one, found in zip((a, b), trainings, strict=True)
    )
    # Counted over every pair of trainings, drive by drive.
    a_alone = int(((~passed_a).sum(axis=0) * passed_b.sum(axis=0)).sum())
    b_alone = int((passed_a.sum(axis=0) * (~passed_b).sum(axis=0)).sum())
    return Outcome(
        a=a, b=b, drives=drives, resampled=_resampled(plan.words, sizes),
        resamples=found.resamples, seed=seed, metrics=metrics,
        failed_a=int((~passed_a).sum()), failed_b=int((~passed_b).sum()),
        runs_a=passed_a.size, runs_b=passed_b.size, a_alone=a_alone, b_alone=b_alone,
        failures_p=None if several else paired_failures(a_alone, b_alone),
        seconds_a=_median(a, keys), seconds_b=_median(b, keys),
        only_a=[drives_of[key] for key in a.runs if key not in shared],
        only_b=[drives_of[key] for key in b.runs if key not in shared and key not in a.runs],
    )  # fmt: skip


def _sides(
    a: Competitor,
    b: Competitor,
    keys: Sequence[str],
    drives: Sequence[Drive],
    measures: Sequence[Measure],
    targets: dict[str, float],
) -> list[_Sides]:
    """Return the losses of each metric that any drive has."""
    numbers: dict[tuple[str, str], int] = {}
    tasks = np.array(
        [numbers.setdefault((one.setting, one.path), len(numbers)) for one in drives], dtype=np.intp
    )
    tables = [
        np.array([[one.runs[key][training].losses for key in keys] for training in one.trainings])
        for one in (a, b)
    ]
    sides = []
    for place, measure in enumerate(measures):
        one, other = (table[:, :, place] for table in tables)
        known = ~(np.isnan(one).any(axis=0) | np.isnan(other).any(axis=0))
        if not known.any():
            continue
        one, other = one[:, known], other[:, known]
        target = targets.get(measure.key)
        if target is not None and min(one.min(), other.min()) < 0.0:
            raise ValueError(
                f"--target {measure.key}: an optimality gap needs a metric of which less is better "
                "and 0 the best"
            )
        sides.append(_Sides(measure, one, other, tasks[known], known, _levels(one, other), target))
    return sides


def _levels(*losses: Array) -> Array:
    """Return levels up to the largest finite loss, evenly spaced on a log axis.

    They span at most `SPAN`. Where a loss is negative they are evenly spaced from the least one;
    without a finite loss there are none.
    """
    finite = np.concatenate([one[np.isfinite(one)] for one in losses])
    if not len(finite):
        return np.empty(0)
    low, high = float(finite.min()), float(finite.max())
    if low == high:
        return np.array([low])
    if low >= 0.0:
        low = max(float(finite[finite > 0.0].min()), high / SPAN)
        spaced = np.geomspace(low, high, LEVELS)
    else:
        spaced = np.linspace(low, high, LEVELS)
    # Rounding would leave the largest loss above the last level.
    spaced[[0, -1]] = low, high
    return spaced


def _metric(side: _Sides, found: Intervals, apart: Sequence[Intervals], start: int) -> Metric:
    """Return a metric's results, whose statistics begin at `start`."""
    measure, count = side.measure, len(side.levels)

    def interval(row: int, given: Intervals = found, *, turned: bool = False) -> Interval:
        """Return a statistic with its interval, `turned` if it is that of a negated metric."""
        ends = given.low[start + row], given.high[start + row]
        value = float(given.value[start + row])
        if turned and measure.sign < 0.0:
            return Interval(-value, float(-ends[1]), float(-ends[0]))
        return Interval(value, float(ends[0]), float(ends[1]))

    difference = interval(0, turned=True)
    mean_a = measure.sign * float(found.value[start + 1])
    both = np.isfinite(side.a).sum(axis=0) * np.isfinite(side.b).sum(axis=0)
    wins = ties = 0
    for own in side.b:
        wins += int((own < side.a).sum())
        ties += int((own == side.a).sum())
    targeted = side.target is not None
    first = HEAD + 2 * targeted
    return Metric(
        measure=measure,
        drives=side.a.shape[1],
        pairs=int(both.sum()),
        mean_a=mean_a,
        mean_b=mean_a + difference.value,
        difference=difference,
        relative=interval(2, turned=True),
        over_drives=interval(0, apart[0], turned=True),
        over_trainings=interval(0, apart[1], turned=True),
        iqm_a=interval(3, turned=True),
        iqm_b=interval(4, turned=True),
        improvement=interval(5),
        wins=wins,
        ties=ties,
        losses=len(side.b) * side.a.size - wins - ties,
        target=side.target,
        gap_a=interval(HEAD) if targeted else None,
        gap_b=interval(HEAD + 1) if targeted else None,
        profile=Profile(
            side.levels,
            [interval(first + k) for k in range(count)],
            [interval(first + count + k) for k in range(count)],
        ),
    )


def _median(competitor: Competitor, keys: Sequence[str]) -> float | None:
    """Return the median over runs of the median time of `predict`, s; None if none is known."""
    times = [
        run.seconds
        for key in keys
        for run in competitor.runs[key].values()
        if run.seconds is not None
    ]
    return float(np.median(times)) if times else None


def _resampled(drives: str, sizes: tuple[int, int]) -> str:
    """Say over what the intervals are."""
    trained = [
        f"{number} trainings of {side}"
        for side, number in zip("AB", sizes, strict=True)
        if number > 1
    ]
    return "; ".join([*trained, *([drives] if drives else [])])
