"""Compiled: what is noted of a drive from period to period, for whoever chooses weights.

All of it is what the agent itself sees and does; nothing is of the truth. Mean squares are kept
over a short and a long time, so that noise, lag and weave can be told from what is seen.
"""

import math
from typing import Any

from numpy.typing import NDArray

from lpv_track_env.observation import PREVIEW_START
from trajectories.compilation import compiled_internal

Array = NDArray[Any]

STATISTICS = (
    "lateral_error", "heading_error", "speed_error", "lateral_surprise", "heading_surprise",
    "steering_lag", "acceleration_lag", "steering_rate", "jerk", "command_rate",
)  # fmt: skip
"""What mean squares are kept of, in SI units: errors; how far errors have moved otherwise than by
kinematics; reported actuators against the last command; rates of the actuators and of the steering
command."""
COUNT = len(STATISTICS)
SHORT, LONG = 0.4, 4.0
"""Time constants, s."""

# Of a vehicle's row, (WATCH,):
FRESH, SEEN, CLOCK, DECIDED, FAILURES, ITERATIONS, REJECTED, AGE = range(8)
"""Whether the observation at hand is in; observations seen; periods since the last decision; the
band it was made in, or -1; failed solves and iterations since then; decisions that were no numbers;
periods since the last observation that was seen."""
LAST = 8
"""Last lateral and heading error, vx, vy, rate of the heading error, reported a and delta, and
commanded a and delta;"""
QUICK, SLOW = LAST + 9, LAST + 9 + COUNT
"""mean squares over the short and the long time."""
WATCH = SLOW + COUNT


@compiled_internal
def mean_in(w: Array, j: int, value: Any, quick: Any, slow: Any) -> None:
    """Take the square of a value into its two means."""
    square = value * value
    w[QUICK + j] += quick * (square - w[QUICK + j])
    w[SLOW + j] += slow * (square - w[SLOW + j])


@compiled_internal
def passed(w: Array) -> None:
    """Note that a control period has passed."""
    w[FRESH] = 0.0
    w[CLOCK] += 1.0
    w[AGE] += 1.0


@compiled_internal
def watch(w: Array, o: Array, a: Any, delta: Any, period: Any) -> None:
    """Note an observation (size,), of after the command (a, delta).

    The first after zeros begins an episode. One that is not finite is passed over. A computer that
    misses its deadline sees none in a period: changes are over the time since the last one.
    """
    w[FRESH] = 1.0
    total = 0.0
    for j in range(o.shape[0]):
        total += abs(o[j])
    if not math.isfinite(total):
        return
    vx, vy, r, now_a, now_delta = o[0], o[1], o[2], o[3], o[4]
    lateral, heading = o[5], o[6]
    if w[SEEN] > 0.0:
        last, before = w[LAST], w[LAST + 1]
        moved = w[LAST + 2] * math.sin(before) + w[LAST + 3] * math.cos(before)
        time = period * max(w[AGE], 1.0)
        share = 1.0 / w[SEEN]
        quick = max(1.0 - math.exp(-time / SHORT), share)
        slow = max(1.0 - math.exp(-time / LONG), share)
        mean_in(w, 0, lateral, quick, slow)
        mean_in(w, 1, heading, quick, slow)
        mean_in(w, 2, vx - o[7], quick, slow)
        mean_in(w, 3, lateral - last - time * moved, quick, slow)
        mean_in(w, 4, heading - before - time * w[LAST + 4], quick, slow)
        mean_in(w, 5, delta - now_delta, quick, slow)
        mean_in(w, 6, a - now_a, quick, slow)
        mean_in(w, 7, (now_delta - w[LAST + 6]) / time, quick, slow)
        mean_in(w, 8, (now_a - w[LAST + 5]) / time, quick, slow)
        mean_in(w, 9, (delta - w[LAST + 8]) / time, quick, slow)
        w[LAST + 7], w[LAST + 8] = a, delta
    else:
        w[DECIDED] = -1.0
        w[LAST + 7], w[LAST + 8] = now_a, now_delta
    w[SEEN] += 1.0
    w[AGE] = 0.0
    w[LAST], w[LAST + 1], w[LAST + 2], w[LAST + 3] = lateral, heading, vx, vy
    # The preview's first curvature is that of the period to come.
    w[LAST + 4] = r - o[PREVIEW_START] * vx
    w[LAST + 5], w[LAST + 6] = now_a, now_delta
