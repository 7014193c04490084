"""Scores of a row: interquartile means, with intervals over drives and over trainings apart."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.run.resampling import Plan, bootstrap_intervals, run_weights
from experiments.run.statistics import weighted_interquartile_mean

Array = NDArray[np.float64]


class Score(NamedTuple):
    """Interquartile mean over all drives, with 95 % intervals.

    Value and ends are infinite where more drives failed than the mean leaves out.
    """

    value: float
    drives: tuple[float, float] | None
    """Interval over drives, the trainings being given; None if there is nothing to draw."""
    trainings: tuple[float, float] | None
    """Interval over trainings, the drives being given; None with fewer than two."""


def score(losses: Array, plan: Plan) -> Score:
    """Return the interquartile mean of losses (trainings, drives), which may be infinite."""

    def statistic(drives: Array, trainings: Array) -> Array:
        weights = run_weights(drives, trainings)
        return weighted_interquartile_mean(losses.ravel(), weights)[None]

    count = (len(losses),)
    over_drives = bootstrap_intervals(statistic, plan, count, draw_trainings=False)
    over_trainings = bootstrap_intervals(statistic, plan, count, draw_drives=False)
    ends = [
        (float(one.low[0]), float(one.high[0])) if one.resamples else None
        for one in (over_drives, over_trainings)
    ]
    return Score(float(over_drives.value[0]), *ends)
