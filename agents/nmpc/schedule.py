"""Weights in use from period to period, compiled: the band of a preview, and how far a switch goes.

The one place in which a schedule is followed: by agents one vehicle at a time, by batches, and by
closed loops in compiled code.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule
from lpv_track_env.observation import PREVIEW_START
from trajectories import CurvatureBands
from trajectories.compilation import compiled, compiled_internal

Array = NDArray[Any]

WEIGHTS = 10
"""Q, S, R in one row."""
HYSTERESIS, BLEND, LARGEST_FACTOR, THRESHOLDS = range(4)
"""Rules, (3 + bands - 1,): the bands' hysteresis, half width of blending, the factor by which a
weight may change in a period, and the bands' thresholds from there on."""
NO_BAND = -1


def rules_of(bands: CurvatureBands, blend: float, slew: float, period: float) -> Array:
    """Pack what `choose_weights` goes by; `slew` in nepers a second, `period` in s."""
    with np.errstate(over="ignore"):
        factor = float(np.exp(slew * period))
    return np.array([bands.hysteresis, blend, factor, *bands.thresholds])


def one_set(weights: Array) -> tuple[Array, Array]:
    """Tables and rules of weights that no band chooses: (10,) or (n, 10)."""
    tables = np.array(np.atleast_2d(weights), dtype=np.float64)[:, None, :]
    return tables, np.array([0.0, 0.0, math.inf])


def of_schedule(schedule: WeightSchedule, period: float) -> tuple[Array, Array]:
    """Tables (1, bands, 10) and rules of a schedule, at a control period (s)."""
    sets = [weights.clipped().as_array() for weights in schedule.weights]
    slew = math.inf if schedule.slew is None else schedule.slew
    return np.array(sets)[None], rules_of(schedule.bands, schedule.blend, slew, period)


@compiled_internal
def sharpest(observation: Array, steps: int) -> Any:
    """Largest |curvature| in the first `steps` of an observation's preview, 1/m."""
    largest = 0.0
    for k in range(steps):
        value = abs(observation[PREVIEW_START + k])
        if value > largest or math.isnan(value):  # and nothing is larger than NaN
            largest = value
    return largest


@compiled_internal
def class_of(curvature: Any, rules: Array) -> int:
    """Band of |curvature| without hysteresis, as `CurvatureBands.classify`."""
    band = 0
    for k in range(THRESHOLDS, rules.shape[0]):
        if curvature >= rules[k]:
            band += 1
    return band


@compiled_internal
def band_of(curvature: Any, current: int, rules: Array) -> int:
    """Band of the sharpest |curvature| of a preview, as `CurvatureBands.select`."""
    band = class_of(curvature, rules)
    if current == NO_BAND or band >= current:
        return band
    held = class_of(curvature / (1.0 - rules[HYSTERESIS]), rules)
    return max(band, min(held, current))


@compiled_internal
def update_band(observation: Array, steps: int, rules: Array, bands: Array, row: int) -> None:
    """Bring `bands[row]` up to date with a preview; one that is not finite changes nothing."""
    curvature = sharpest(observation, steps)
    if math.isfinite(curvature):
        bands[row] = band_of(curvature, bands[row], rules)


@compiled_internal
def choose_weights(
    observation: Array, steps: int, tables: Array, rules: Array, bands: Array, row: int, used: Array
) -> None:
    """Bring the weights in use, (10,), towards those of the preview's band, in place.

    `tables` is (bands, 10); `used` of zeros is that of an episode that begins. Within the bounds of
    weights, whatever the table has. A preview that is not finite changes nothing.
    """
    curvature = sharpest(observation, steps)
    first = used[0] == 0.0
    share, low = 0.0, 0
    if math.isfinite(curvature):
        band = band_of(curvature, bands[row], rules)
        bands[row] = band
        low = band
        half = rules[BLEND]
        if half > 0.0:
            low = class_of(curvature, rules)
            for k in range(rules.shape[0] - THRESHOLDS):
                below = rules[THRESHOLDS + k] * (1.0 - half)
                above = rules[THRESHOLDS + k] * (1.0 + half)
                if below < curvature < above:
                    low, share = k, (curvature - below) / (above - below)
    elif not first:
        return
    factor = rules[LARGEST_FACTOR]
    for j in range(WEIGHTS):
        value = min(max(tables[low, j], LOWEST), HIGHEST)
        if share > 0.0:
            other = min(max(tables[low + 1, j], LOWEST), HIGHEST)
            value = math.exp((1.0 - share) * math.log(value) + share * math.log(other))
        if not first:
            value = min(max(value, used[j] / factor), used[j] * factor)
        used[j] = value


@compiled
def choose_all(
    observations: Array, steps: int, tables: Array, rules: Array, bands: Array, used: Array
) -> None:
    """`choose_weights` for rows of observations (n, size); `tables` (1 or n, bands, 10)."""
    for row in range(observations.shape[0]):
        own = row if tables.shape[0] > 1 else 0
        choose_weights(observations[row], steps, tables[own], rules, bands, row, used[row])


class Switching:
    """Weights in use of n vehicles that follow fixed weights or a schedule.

    Parameters
    ----------
    weights
        What is followed.
    period
        Control period, s.
    """

    def __init__(self, weights: TrackingWeights | WeightSchedule, period: float) -> None:
        self.tables, self.rules = (
            of_schedule(weights, period)
            if isinstance(weights, WeightSchedule)
            else one_set(weights.clipped().as_array())
        )

    def choose(self, rows: Array, steps: int, bands: Array, used: Array) -> None:
        """Bring `used` (n, 10) and `bands` (n,) up to date with observations (n, size)."""
        choose_all(rows, steps, self.tables, self.rules, bands, used)
