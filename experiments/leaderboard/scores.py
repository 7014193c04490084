"""Scores of a row with their intervals: interquartile means, over drives and over trainings."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.run.statistics import CONFIDENCE, RESAMPLES, interquartile_mean

Array = NDArray[np.float64]
Places = NDArray[np.int64]

MOST_DRAWN = 4_000_000
"""Most values that are drawn at once."""
LEAST_RESAMPLES, MOST_VALUES = 1000, 50_000_000
"""Of many values fewer resamples are drawn, so that all of them have at most so many values."""


class Score(NamedTuple):
    """Interquartile mean over all drives, with 95 % intervals.

    Infinite ends and values mean that more drives failed than the mean leaves out.
    """

    value: float
    drives: tuple[float, float] | None
    """Interval over drives, the trainings being given; None if no stratum has two drives."""
    trainings: tuple[float, float] | None
    """Interval over trainings, the drives being given; None with fewer than two."""


def score(losses: Array, strata: Sequence[str], *, seed: int = 0) -> Score:
    """Return the interquartile mean of losses (trainings, drives), which may be infinite.

    The bootstrap over drives draws within each stratum, of which `strata` names that of each drive;
    that over trainings draws whole trainings.
    """
    count = len(losses)
    random = np.random.default_rng(seed)
    names = np.array(strata)
    members = [np.flatnonzero(names == name) for name in dict.fromkeys(strata)]

    def drawn_drives(size: int) -> Array:
        chosen = np.concatenate([_drawn(own, size, random) for own in members], axis=1)
        return np.moveaxis(losses[:, chosen], 1, 0)

    def drawn_trainings(size: int) -> Array:
        return losses[random.integers(count, size=(size, count))]

    several = max(map(len, members)) > 1
    return Score(
        float(interquartile_mean(losses.ravel())),
        _ends(drawn_drives, losses.size) if several else None,
        _ends(drawn_trainings, losses.size) if count > 1 else None,
    )


def _drawn(members: Places, size: int, random: np.random.Generator) -> Places:
    """Draw as many members of a stratum as it has, (size, members)."""
    found: Places = members[random.integers(len(members), size=(size, len(members)))]
    return found


def _ends(draw: Callable[[int], Array], values: int) -> tuple[float, float]:
    """Return the ends of the interval of resamples of so many values each.

    `draw` makes a number of them, (resamples, trainings, drives). Infinite means are not
    interpolated.
    """
    resamples = min(RESAMPLES, max(LEAST_RESAMPLES, MOST_VALUES // values))
    step = max(1, MOST_DRAWN // values)
    sizes = [min(step, resamples - done) for done in range(0, resamples, step)]
    means = [interquartile_mean(draw(size).reshape(size, -1), axis=1) for size in sizes]
    levels = [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2]
    low, high = np.quantile(np.concatenate(means), levels, method="inverted_cdf")
    return float(low), float(high)
