"""Features on which weights are chosen, and the driving history that they use, compiled.

The history holds running statistics of what the agent itself observes and commands, never the true
state. Mean squares are kept with a short and a long time constant, which separates noise, lag and
weaving. Features have a magnitude of one, and are the same for left and right.

====================  =====  ===================================================================
features              count  meaning (scale that they are divided by)
====================  =====  ===================================================================
situation             8      vx - 10 m/s (10), |vy| (0.5 m/s), |r| (0.3 rad/s), reported a
                             (2 m/s^2), |reported delta| (0.2 rad), |lateral error| (0.1 m),
                             |heading error| (0.1 rad), speed error (1 m/s)
preview               6      largest |curvature| in each quarter of the preview (0.05 1/m); speed in
                             its middle and at its end, minus the reference speed (5 m/s)
quick, slow           20     `STATISTICS` over 0.4 s and over 4 s: ln(rms / scale) / 2, rms
                             of at least 3 % of the scale
solver                2      mean iterations since the last decision (10), share of failed solves
weights               8      ln(Q, S in use / base) / ln(span)
band                  B      1 for the band of the preview, 0 for the others
====================  =====  ===================================================================

Every entry is clipped to [-LIMIT, LIMIT].
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.observation import (
    ACCELERATION,
    HEADING_ERROR,
    LATERAL_ERROR,
    LATERAL_SPEED,
    LONGITUDINAL_SPEED,
    PREVIEW_START,
    REFERENCE_SPEED,
    STEERING_ANGLE,
    YAW_RATE,
)
from trajectories.compilation import compiled, compiled_internal

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

LIMIT = 5.0
"""Bound of every feature."""
TUNED = 8
"""Number of weights that are chosen: Q and S. R and R_rate are fixed."""
QUARTERS = 4
"""Number of parts of the preview with a feature each for their largest curvature."""
SCALES = np.array([0.05, 0.05, 0.5, 0.02, 0.01, 0.02, 0.5, 0.2, 2.0, 0.2])
"""Scales of the statistics, in their order and units."""
LEAST = 1e-3
"""Offset added to mean squares, relative to the square of the scale: (3 % of the scale)^2."""

SITUATION = (
    "longitudinal_speed", "lateral_speed", "yaw_rate", "acceleration", "steering_angle",
    "lateral_error", "heading_error", "speed_error",
)  # fmt: skip
SHARED = (
    *SITUATION,
    *(f"curvature_{quarter}" for quarter in range(1, QUARTERS + 1)), "speed_middle", "speed_end",
    *(f"quick_{name}" for name in STATISTICS), *(f"slow_{name}" for name in STATISTICS),
    "iterations", "failures",
    *(f"weight_{matrix}_{state}" for matrix in "QS" for state in ("vx", "psi", "x", "y")),
)  # fmt: skip
"""Names of all features but those of the bands."""

PATH = (*(f"curvature_{k}" for k in range(1, QUARTERS + 1)), "speed_middle", "speed_end",
        "longitudinal_speed")  # fmt: skip
"""Features of the path and the speed, without those of the bands."""
DRIVE = (
    *(f"{time}_{name}" for time in ("quick", "slow") for name in STATISTICS), "iterations",
    "failures",
)  # fmt: skip
"""Features of the drive so far: noise, lag, weave, solver."""
SUBSETS = ("all", "path", "drive")
"""Names of the feature subsets that a learner may be restricted to."""


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
    vx, vy, r = o[LONGITUDINAL_SPEED], o[LATERAL_SPEED], o[YAW_RATE]
    now_a, now_delta = o[ACCELERATION], o[STEERING_ANGLE]
    lateral, heading = o[LATERAL_ERROR], o[HEADING_ERROR]
    if h[SEEN] > 0.0:
        last, before = h[LAST], h[LAST + 1]
        moved = h[LAST + 2] * math.sin(before) + h[LAST + 3] * math.cos(before)
        time = period * max(h[AGE], 1.0)
        share = 1.0 / h[SEEN]
        quick = max(1.0 - math.exp(-time / SHORT), share)
        slow = max(1.0 - math.exp(-time / LONG), share)
        update_mean_squares(h, 0, lateral, quick, slow)
        update_mean_squares(h, 1, heading, quick, slow)
        update_mean_squares(h, 2, vx - o[REFERENCE_SPEED], quick, slow)
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
    # The first curvature of the preview is the mean over its first interval, from here on.
    h[LAST + 4] = r - o[PREVIEW_START] * vx
    h[LAST + 5], h[LAST + 6] = now_a, now_delta


def names(bands: tuple[str, ...]) -> tuple[str, ...]:
    """List the names of all features, given those of the bands."""
    return (*SHARED, *(f"band_{name}" for name in bands))


def size(bands: int) -> int:
    """Return the number of features for a number of bands."""
    return len(SHARED) + bands


def subset_mask(subset: str, bands: tuple[str, ...]) -> NDArray[np.float32]:
    """Return a factor per feature, (size,): 1 for those in one of `SUBSETS`, 0 for the others."""
    if subset == "path":
        kept = {*PATH, *(f"band_{name}" for name in bands)}
    else:
        kept = set(DRIVE if subset == "drive" else names(bands))
    return np.array([float(name in kept) for name in names(bands)], dtype=np.float32)


@compiled_internal
def bounded(value: Any) -> Any:
    """Clip a value to the limits; NaN becomes 0."""
    if math.isnan(value):
        return 0.0
    return min(max(value, -LIMIT), LIMIT)


@compiled
def fill_features(
    o: Array, h: Array, used: Array, base: Array, band: int, scales: Array, log_span: Any, x: Array
) -> None:
    """Fill the features `x` (size,) for an observation `o` and the row `h` of its drive's history.

    `used` (12,) are the weights in use, zeros before the first choice; `base` (bands, 12) those
    that an action multiplies; `band` may be -1.
    """
    steps = (o.shape[0] - PREVIEW_START) // 2
    # In the order of SITUATION.
    x[0] = bounded(o[LONGITUDINAL_SPEED] / 10.0 - 1.0)
    x[1] = bounded(abs(o[LATERAL_SPEED]) / 0.5)
    x[2] = bounded(abs(o[YAW_RATE]) / 0.3)
    x[3] = bounded(o[ACCELERATION] / 2.0)
    x[4] = bounded(abs(o[STEERING_ANGLE]) / 0.2)
    x[5] = bounded(abs(o[LATERAL_ERROR]) / 0.1)
    x[6] = bounded(abs(o[HEADING_ERROR]) / 0.1)
    x[7] = bounded(o[LONGITUDINAL_SPEED] - o[REFERENCE_SPEED])
    at = 8
    for quarter in range(QUARTERS):
        largest = 0.0
        for k in range(quarter * steps // QUARTERS, (quarter + 1) * steps // QUARTERS):
            largest = max(largest, abs(o[PREVIEW_START + k]))
        x[at] = bounded(largest / 0.05)
        at += 1
    speeds = PREVIEW_START + steps
    x[at] = bounded((o[speeds + (steps - 1) // 2] - o[REFERENCE_SPEED]) / 5.0)
    x[at + 1] = bounded((o[speeds + steps - 1] - o[REFERENCE_SPEED]) / 5.0)
    at += 2
    for means in (QUICK, SLOW):
        for j in range(COUNT):
            square = h[means + j] / (scales[j] * scales[j])
            x[at] = bounded(0.25 * math.log(square + LEAST))
            at += 1
    since = max(h[CLOCK], 1.0)
    x[at] = bounded(h[ITERATIONS] / since / 10.0)
    x[at + 1] = bounded(h[FAILURES] / since)
    at += 2
    own = max(band, 0)
    for j in range(TUNED):
        ratio = used[j] / base[own, j] if used[j] > 0.0 else 1.0
        x[at + j] = bounded(math.log(ratio) / log_span)
    at += TUNED
    for k in range(base.shape[0]):
        x[at + k] = 1.0 if k == band else 0.0


@compiled
def fill_all(
    observations: Array, history: Array, used: Array, base: Array, bands: Array, scales: Array,
    log_span: Any, features: Array,
) -> None:  # fmt: skip
    """Apply `fill_features` to every row of `features` (n, size) float32."""
    for row in range(observations.shape[0]):
        fill_features(
            observations[row], history[row], used[row], base, bands[row], scales, log_span,
            features[row],
        )  # fmt: skip
