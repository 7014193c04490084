"""Statistics of few trainings: interquartile means, bootstrap intervals, paired gains.

Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 34,
2021: aggregate by the interquartile mean, with intervals from resampling. Rates have exact binomial
intervals.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, trim_mean

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
