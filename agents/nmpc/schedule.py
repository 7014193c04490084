"""Weights in use from period to period, compiled: band of the preview, blending and slew limit.

Agents, batches and compiled closed loops all follow their schedules here.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weights import HIGHEST, LOWEST, WEIGHTS, TrackingWeights, WeightSchedule
from lpv_track_env.observation import PREVIEW_START
from trajectories import CurvatureBands
from trajectories.compilation import compiled, compiled_internal

Array = NDArray[Any]

# Rules, (3 + bands - 1,): the bands' hysteresis, half width of blending, largest factor by which a
# weight changes in a period, and the bands' thresholds from there on.
HYSTERESIS, BLEND, LARGEST_FACTOR, THRESHOLDS = range(4)
NO_BAND = -1
"""Band of a vehicle before its first observation."""


def rules_of(bands: CurvatureBands, blend: float, slew: float, period: float) -> Array:
    """Pack the rules of `choose_weights`; `slew` in 1/s, `period` in s."""
    with np.errstate(over="ignore"):
        factor = float(np.exp(slew * period))
    return np.array([bands.hysteresis, blend, factor, *bands.thresholds])


def one_set(weights: Array) -> tuple[Array, Array]:
    """Return tables and rules of fixed weights, (12,) or (n, 12)."""
    tables = np.array(np.atleast_2d(weights), dtype=np.float64)[:, None, :]
    return tables, np.array([0.0, 0.0, math.inf])


def of_schedule(schedule: WeightSchedule, period: float) -> tuple[Array, Array]:
    """Return tables (1, bands, 12) and rules of a schedule, for a control period (s)."""
    sets = [weights.clipped().as_array() for weights in schedule.weights]
    slew = math.inf if schedule.slew is None else schedule.slew
    return np.array(sets)[None], rules_of(schedule.bands, schedule.blend, slew, period)


@compiled_internal
def sharpest(observation: Array, steps: int) -> Any:
    """Largest |curvature| in the first `steps` of an observation's preview, 1/m."""
    largest = 0.0
    for k in range(steps):
        value = abs(observation[PREVIEW_START + k])
        if value > largest or math.isnan(value):  # NaN is kept: no value is larger
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
    """Update `bands[row]` by a preview, unless that is not finite."""
    curvature = sharpest(observation, steps)
    if math.isfinite(curvature):
        bands[row] = band_of(curvature, bands[row], rules)


@compiled_internal
def choose_weights(
    observation: Array, steps: int, tables: Array, rules: Array, bands: Array, row: int, used: Array
) -> None:
    """Move the weights in use, (12,), towards those of the preview's band, in place.

    `tables` is (bands, 12), clipped here to the bounds of weights. `used` is zero where an episode
    begins: the slew limit does not apply then. A preview that is not finite changes nothing.
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
    """`choose_weights` for rows of observations (n, size); `tables` (1 or n, bands, 12)."""
    for row in range(observations.shape[0]):
        own = row if tables.shape[0] > 1 else 0
        choose_weights(observations[row], steps, tables[own], rules, bands, row, used[row])


class Switching:
    """Fixed weights or a schedule, as n vehicles follow them.

    Parameters
    ----------
    weights
        The weights or the schedule.
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
        """Update `used` (n, 12) and `bands` (n,) by observations (n, size)."""
        choose_all(rows, steps, self.tables, self.rules, bands, used)
