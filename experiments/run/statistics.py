"""Statistics of drives and trainings: aggregates, bootstrap intervals, paired gains, rates.

Definitions are those of Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice", NeurIPS 34, 2021: interquartile mean, optimality gap, probability of improvement,
performance profile; intervals come from resampling (`experiments.run.resampling`). Losses may be
inf, which is that of a drive that failed. Rates have exact binomial intervals.

The four aggregates take weights (resamples, values): how often each value was drawn.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binomtest, trim_mean

Array = NDArray[Any]

RESAMPLES = 10_000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """Estimate of a quantity with its 95 % interval."""

    value: float
    low: float
    high: float


def interquartile_mean(values: Array, axis: int = 0) -> Any:
    """Return the mean of the middle half of the values along an axis."""
    return trim_mean(values, 0.25, axis=axis)


def weighted_interquartile_mean(values: Array, weights: Array) -> Array:
    """Return the interquartile mean of values (n,) drawn `weights` (resamples, n) times.

    Of N draws the smallest and the largest floor(N / 4) are left out, as `trim_mean` does. The mean
    is inf where one of those left is inf, and NaN without any draws.
    """
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    drawn = np.cumsum(weights[:, order], axis=1)
    total = drawn[:, -1:] if len(values) else np.zeros((len(weights), 1))
    cut = np.floor(0.25 * total)
    kept = np.diff(np.clip(drawn, cut, total - cut), axis=1, prepend=cut)
    finite = int(np.isfinite(ordered).sum())
    sums = kept[:, :finite] @ ordered[:finite]
    with np.errstate(invalid="ignore"):
        means = sums / (total - 2.0 * cut)[:, 0]
    return np.where(kept[:, finite:].any(axis=1), np.inf, means)


def optimality_gap(losses: Array, target: float, weights: Array) -> Array:
    """Return the mean shortfall of the normalised score target / loss from 1, in each resample.

    It is 1 - mean(min(1, target / loss)): 0 if every drive reaches the target, 1 if all fail.
    Losses and target are positive.
    """
    # A loss of 0 has reached any target.
    scores = np.minimum(1.0, target / np.maximum(losses, np.finfo(float).tiny))
    return _mean(1.0 - scores, weights)


def performance_profile(losses: Array, levels: Array, weights: Array) -> Array:
    """Return the share of drives whose loss is at most each of the levels, (levels, resamples)."""
    order = np.argsort(losses, kind="stable")
    drawn = np.cumsum(weights[:, order], axis=1)
    drawn = np.concatenate([np.zeros((len(weights), 1)), drawn], axis=1)
    counts = drawn[:, np.searchsorted(losses[order], levels, side="right")]
    with np.errstate(invalid="ignore"):
        shares: Array = (counts / drawn[:, -1:]).T
    return shares


def probability_of_improvement(
    ours: Array,
    theirs: Array,
    our_tasks: Array,
    their_tasks: Array,
    our_weights: Array,
    their_weights: Array,
) -> Array:
    """Return the mean over tasks of P(ours < theirs), of a random run of each, in each resample.

    A task's probability is Mann and Whitney's U / (n m), ties counting half, over all pairs of one
    of our n runs and one of their m. Two failures are a tie.

    Tasks are whole numbers, one for each run. A resample that draws the runs of a task more often
    than there are counts that task as much more often, one without runs of either side not at all.
    """
    values, ranks = np.unique(np.concatenate([ours, theirs]), return_inverse=True)
    own, other = ranks[: len(ours)], ranks[len(ours) :]
    tasks = np.union1d(our_tasks, their_tasks)
    own_key = our_tasks * (len(values) + 1) + own
    other_key = their_tasks * (len(values) + 1) + other
    order = np.argsort(other_key, kind="stable")
    sorted_keys = other_key[order]
    drawn = np.cumsum(their_weights[:, order], axis=1)
    drawn = np.concatenate([np.zeros((len(drawn), 1)), drawn], axis=1)
    # Draws of theirs that are equal to, and larger than, each of ours within its task.
    first = drawn[:, np.searchsorted(sorted_keys, own_key, side="left")]
    last = drawn[:, np.searchsorted(sorted_keys, own_key, side="right")]
    end_key = (our_tasks + 1) * (len(values) + 1)
    end = drawn[:, np.searchsorted(sorted_keys, end_key, side="left")]
    wins = our_weights * (end - 0.5 * (last + first))

    def by_task(values: Array, of: Array) -> Array:
        """Sum columns by task, (resamples, tasks)."""
        order = np.argsort(of, kind="stable")
        starts = np.searchsorted(of[order], tasks, side="left")
        sums: Array = np.add.reduceat(values[:, order], starts, axis=1)
        return sums

    runs = by_task(our_weights, our_tasks)
    pairs = runs * by_task(their_weights, their_tasks)
    counted = np.where(pairs > 0.0, runs / by_task(np.ones((1, len(ours))), our_tasks), 0.0)
    shares = np.divide(by_task(wins, our_tasks), pairs, out=np.zeros(pairs.shape), where=pairs > 0)
    return _mean_by(shares, counted)


def _mean(values: Array, weights: Array) -> Array:
    """Return the mean of values (n,) drawn `weights` (resamples, n) times."""
    with np.errstate(invalid="ignore"):
        means: Array = (weights @ values) / weights.sum(axis=1)
    return means


def _mean_by(values: Array, weights: Array) -> Array:
    """Return the weighted mean of each row, (resamples,)."""
    with np.errstate(invalid="ignore"):
        means: Array = (weights * values).sum(axis=1) / weights.sum(axis=1)
    return means


def paired_gain(ours: Array, theirs: Array, *, seed: int = 0) -> Interval:
    """Estimate the share by which our mean score is below theirs.

    The gain of a training is 1 - mean(ours) / mean(theirs) on the same drives; the estimate is the
    interquartile mean over trainings. The bootstrap draws trainings and paths with replacement;
    the drives of a path stay together.

    Scores are (trainings, paths, drives); training i of one is compared with training i of the
    other, drive by drive. `seed` is that of the resampling.
    """
    if ours.shape != theirs.shape or ours.ndim != 3:
        raise ValueError(f"scores must be alike in shape, not {ours.shape} and {theirs.shape}")
    a, b = ours.mean(axis=2), theirs.mean(axis=2)
    trainings, paths = a.shape

    def gain(a: Array, b: Array) -> Array:
        gains: Array = 1.0 - a.mean(axis=-1) / b.mean(axis=-1)
        return gains

    blocks = _resampled(trainings, paths, seed)
    drawn = interquartile_mean(gain(a[blocks], b[blocks]), axis=1)
    return _interval(float(interquartile_mean(gain(a, b))), drawn)


def mean_interval(scores: Array, *, seed: int = 0) -> Interval:
    """Estimate the interquartile mean over trainings of mean scores (trainings, paths, drives)."""
    means = scores.mean(axis=2)
    trainings, paths = means.shape
    drawn = interquartile_mean(means[_resampled(trainings, paths, seed)].mean(axis=2), axis=1)
    return _interval(float(interquartile_mean(means.mean(axis=1))), drawn)


def _interval(value: float, drawn: Array) -> Interval:
    """Return an estimate with the quantiles of its resamples."""
    low, high = np.quantile(drawn, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2])
    return Interval(value, float(low), float(high))


def _resampled(trainings: int, paths: int, seed: int) -> tuple[Array, Array]:
    """Draw trainings (resamples, trainings, 1) and paths (resamples, 1, paths)."""
    random = np.random.default_rng(seed)
    rows = random.integers(trainings, size=(RESAMPLES, trainings, 1))
    return rows, random.integers(paths, size=(RESAMPLES, 1, paths))


def rate_interval(
    count: int, total: int, *, tail: float = (1.0 - CONFIDENCE) / 2
) -> tuple[float, float]:
    """Compute the Clopper-Pearson interval of a rate of which `count` of `total` were seen.

    The true rate lies below the interval with probability at most `tail`, and above it likewise.

    Raises
    ------
    ValueError
        Unless 0 <= count <= total and total is at least 1.
    """
    if not 0 <= count <= total or total < 1:
        raise ValueError(f"{count} of {total} make no rate")
    low = 0.0 if count == 0 else float(beta.ppf(tail, count, total - count + 1))
    high = 1.0 if count == total else float(beta.ppf(1.0 - tail, count + 1, total - count))
    return low, high


def rate_bound(count: int, total: int) -> float:
    """Compute the one-sided Clopper-Pearson upper bound (95 %) on a rate."""
    return rate_interval(count, total, tail=1.0 - CONFIDENCE)[1]


def paired_failures(first_alone: int, second_alone: int) -> float:
    """Return the p-value of McNemar's exact test that both sides fail equally often.

    Of the drives that one side alone fails, either side's share is 1/2 by the null hypothesis: a
    two-sided binomial test. Without any such drive the p-value is 1.
    """
    differing = first_alone + second_alone
    return float(binomtest(first_alone, differing).pvalue) if differing else 1.0
