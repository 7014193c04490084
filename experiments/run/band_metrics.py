"""Errors of an episode by the sharpness of the path where the vehicle was."""

import numpy as np
from numpy.typing import NDArray

from experiments.run.rollout import Trace
from lpv_track_env.vehicle import VehicleParameters
from trajectories import CurvatureBands, ReferencePath

Array = NDArray[np.float64]

BANDS = CurvatureBands()
"""Straight, gentle, moderate, sharp."""


def by_band(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Errors and share of time in each band of |curvature| at the foot point.

    For a band NAME, e the lateral and th the heading error, w the trapezoidal rule's weights::

        share_NAME = sum w / T          mle_NAME = max |e|
        ale_NAME = sqrt(sum w e^2 / sum w)          aoe_NAME = sqrt(sum w th^2 / sum w)

    over the samples of the band; m, rad and a share of 1. A sample belongs to its band with all of
    its weight, half of the step before and half of the one after: where a step leads from one band
    to another, its middle is the border. So shares sum to 1, share * ale^2 to ALE^2 of the episode,
    share * aoe^2 to its AOE^2, and the largest mle is its MLE. A band that the episode never visits
    has no entries. An episode of no duration has, as in `metrics.rms`, ale and aoe 0, and share 1.
    """
    del vehicle
    band = BANDS.classify(path.sample(trace.arc_length).curvature)
    weight = trapezoidal_weights(trace.time)
    total = float(weight.sum())
    values: dict[str, float] = {}
    for index, name in enumerate(BANDS.names):
        here = band == index
        if not here.any():
            continue
        lateral = trace.lateral_error[here]
        values |= {
            f"ale_{name}": weighted_rms(weight[here], lateral),
            f"mle_{name}": float(np.abs(lateral).max()),
            f"aoe_{name}": weighted_rms(weight[here], trace.heading_error[here]),
            f"share_{name}": float(weight[here].sum()) / total if total > 0.0 else 1.0,
        }
    return values


def trapezoidal_weights(time: Array) -> Array:
    """Weights w (n,) in s with int f dt = sum w f by the trapezoidal rule, at times (n,) in s."""
    return 0.5 * (np.diff(time, append=time[-1]) + np.diff(time, prepend=time[0]))


def weighted_rms(weight: Array, values: Array) -> float:
    """sqrt(sum w values^2 / sum w), both (n,); 0 where all weights are."""
    total = float(weight.sum())
    return float(np.sqrt((weight @ values**2) / total)) if total > 0.0 else 0.0
