"""Driving history of a vehicle, compiled: running statistics from which weight policies decide.

The history holds only what the agent itself observes and commands, never the true state. Mean
squares are kept with a short and a long time constant, which separates noise, lag and weaving.
"""

import math
from typing import Any

from numpy.typing import NDArray

from lpv_track_env import observation as entry
from trajectories.compilation import compiled_internal

Array = NDArray[Any]

STATISTICS = (
    "lateral_error", "heading_error", "speed_error", "lateral_surprise", "heading_surprise",
    "steering_lag", "acceleration_lag", "steering_rate", "jerk", "command_rate",
)  # fmt: skip
"""Quantities whose mean squares are kept, in SI units: tracking errors; changes of the errors that
kinematics do not explain; reported actuators against the last command; rates of the actuators and
of the steering command."""
COUNT = len(STATISTICS)
SHORT, LONG = 0.4, 4.0  # time constants of the mean squares, s

# Entries of a vehicle's history, (HISTORY,).
(
    TAKEN_IN,  # 1 once the present observation has been taken in
    SEEN,  # finite observations so far
    CLOCK,  # control periods since the last decision on weights
    DECIDED,  # band of that decision, -1 before the first
    FAILURES,  # failed solves since then
    ITERATIONS,  # solver iterations since then
    REJECTED,  # decisions of the episode that were not finite
    AGE,  # control periods since the last finite observation
) = range(8)
LAST = 8
"""First of nine entries of the last finite observation: lateral and heading error, vx, vy, rate of
the heading error by kinematics, reported a and delta, commanded a and delta."""
QUICK = LAST + 9
"""First of the mean squares with the short time constant."""
SLOW = QUICK + COUNT
"""First of the mean squares with the long time constant."""
HISTORY = SLOW + COUNT


@compiled_internal
def update_mean_squares(h: Array, j: int, value: Any, quick: Any, slow: Any) -> None:
    """Move both mean squares of statistic j towards the square of a value, by shares of the way."""
    square = value * value
    h[QUICK + j] += quick * (square - h[QUICK + j])
    h[SLOW + j] += slow * (square - h[SLOW + j])


@compiled_internal
def end_period(h: Array) -> None:
    """Advance the history's clocks by a control period."""
    h[TAKEN_IN] = 0.0
    h[CLOCK] += 1.0
    h[AGE] += 1.0


@compiled_internal
def update_history(h: Array, o: Array, a: Any, delta: Any, period: Any) -> None:
    """Update a history with an observation (size,) made after the command (a, delta).

    A history of zeros begins an episode. Observations that are not finite are skipped. A computer
    that misses its deadline makes no observation in a period: rates are taken over the time since
    the last one.
    """
    h[TAKEN_IN] = 1.0
    total = 0.0
    for j in range(o.shape[0]):
        total += abs(o[j])
    if not math.isfinite(total):
        return
    vx, vy, r = o[entry.LONGITUDINAL_SPEED], o[entry.LATERAL_SPEED], o[entry.YAW_RATE]
    now_a, now_delta = o[entry.ACCELERATION], o[entry.STEERING_ANGLE]
    lateral, heading = o[entry.LATERAL_ERROR], o[entry.HEADING_ERROR]
    if h[SEEN] > 0.0:
        last, before = h[LAST], h[LAST + 1]
        moved = h[LAST + 2] * math.sin(before) + h[LAST + 3] * math.cos(before)
        time = period * max(h[AGE], 1.0)
        share = 1.0 / h[SEEN]
        quick = max(1.0 - math.exp(-time / SHORT), share)
        slow = max(1.0 - math.exp(-time / LONG), share)
        update_mean_squares(h, 0, lateral, quick, slow)
        update_mean_squares(h, 1, heading, quick, slow)
        update_mean_squares(h, 2, vx - o[entry.REFERENCE_SPEED], quick, slow)
        update_mean_squares(h, 3, lateral - last - time * moved, quick, slow)
        update_mean_squares(h, 4, heading - before - time * h[LAST + 4], quick, slow)
        update_mean_squares(h, 5, delta - now_delta, quick, slow)
        update_mean_squares(h, 6, a - now_a, quick, slow)
        update_mean_squares(h, 7, (now_delta - h[LAST + 6]) / time, quick, slow)
        update_mean_squares(h, 8, (now_a - h[LAST + 5]) / time, quick, slow)
        update_mean_squares(h, 9, (delta - h[LAST + 8]) / time, quick, slow)
        h[LAST + 7], h[LAST + 8] = a, delta
    else:
        h[DECIDED] = -1.0
        h[LAST + 7], h[LAST + 8] = now_a, now_delta
    h[SEEN] += 1.0
    h[AGE] = 0.0
    h[LAST], h[LAST + 1], h[LAST + 2], h[LAST + 3] = lateral, heading, vx, vy
    # The first curvature of the preview is that of the coming period.
    h[LAST + 4] = r - o[entry.PREVIEW_START] * vx
    h[LAST + 5], h[LAST + 6] = now_a, now_delta
