"""Friction estimated while driving: a Bayes filter on a few candidates, compiled.

Each candidate's brush tyres (`lpv_track_env.tyres`, the prediction model's own) predict vy and r a
control period ahead from the last observation. What a candidate misses counts against it::

    L_i <- L_i + s (-n/2 e_i - L_i),  e_i = (vy miss / sigma_vy)^2 + (r miss / sigma_r)^2

The prior is uniform on the candidates and the posterior proportional to exp(L_i). L_i is a
forgetting mean over the time T / s, T = `MEMORY`. Errors of the model (mass, stiffness, wind,
delays, a filter that knows another friction) last longer than a period, so all of its observations
count as n = `INDEPENDENT` ones, and sigma is the model's error, not the sensors' noise. The share
s, from 0 to 1, is how far the candidates' predictions are apart: only slip tells friction, and
without it the estimate stays.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import layout as L
from agents.nmpc.linearisation import advance
from agents.speed_cap import GRIP_SHARE
from lpv_track_env import observation as entry
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.tyres import compiled_constants
from trajectories.compilation import compiled_internal

Array = NDArray[Any]

MEMORY, INDEPENDENT = 2.0, 1.5
"""Memory where friction shows, s; and the number of independent observations that it holds."""
LATERAL, YAW = 0.4, 0.2
"""Standard deviations of the model's error: lateral, m/s^2; about the vertical axis, rad/s^2."""
OUTLIER = 25.0
"""Least e_i of all candidates, beyond which an observation is not of this vehicle's motion."""
CAUTION = 2.0
"""Standard deviations below the mean at which the reference takes the friction."""
SLOWEST = 3.0
"""Speed below which nothing is learned, m/s."""
CANDIDATES = 12
# Entries of a vehicle's record: 1 after an observation, that observation's (vx, vy, r), the
# friction's mean and a cautious value below it, then L of every candidate and their misses.
BEGUN, SEEN, MEAN, CAUTIOUS, LOGARITHM = 0, 1, 4, 5, 6
MISS = LOGARITHM + CANDIDATES
RECORD = MISS + CANDIDATES


@compiled_internal
def candidate(i: int, constants: Array) -> Any:
    """Return a candidate friction; they are spaced evenly by their logarithms."""
    low, high = constants[L.LEAST_FRICTION], constants[L.MOST_FRICTION]
    return low * (high / low) ** (i / (CANDIDATES - 1.0))


@compiled_internal
def set_tyres(friction: Any, constants: Array) -> None:
    """Write the tyres' constants under a coefficient of friction."""
    p, t = constants, L.TYRE
    height = -p[t + 4] * GRAVITY * p[3]
    p[t], p[t + 1], p[t + 2], p[t + 3], p[t + 4], p[t + 5] = compiled_constants(
        friction, height, p[0], p[2], p[3], p[4], p[5]
    )


@compiled_internal
def learn(record: Array, o: Array, constants: Array) -> None:
    """Update a record's L by an observation, after the one before."""
    period = constants[L.CONTROL_PERIOD]
    before = (record[SEEN], record[SEEN + 1], 0.0, record[SEEN + 2], 0.0, 0.0)
    least, first_vy, first_r, apart = math.inf, 0.0, 0.0, 0.0
    for i in range(CANDIDATES):
        set_tyres(candidate(i, constants), constants)
        # The input in force now is that of the period that has passed.
        _, vy, _, r, _, _ = advance(
            before, o[entry.ACCELERATION], o[entry.STEERING_ANGLE], period, 1.0, constants
        )
        vy, r = vy / (LATERAL * period), r / (YAW * period)
        if i == 0:
            first_vy, first_r = vy, r
        apart = max(apart, (vy - first_vy) ** 2 + (r - first_r) ** 2)
        vy -= o[entry.LATERAL_SPEED] / (LATERAL * period)
        r -= o[entry.YAW_RATE] / (YAW * period)
        record[MISS + i] = vy * vy + r * r
        least = min(least, record[MISS + i])
    if least > OUTLIER or not math.isfinite(least):
        return
    share = min(apart, 1.0) * min(period / MEMORY, 1.0)
    for i in range(CANDIDATES):
        record[LOGARITHM + i] += share * (
            -0.5 * INDEPENDENT * record[MISS + i] - record[LOGARITHM + i]
        )


@compiled_internal
def estimate_friction(record: Array, o: Array, constants: Array) -> None:
    """Update a vehicle's record by a finite observation; write its tyres and grip to `constants`.

    `record` (RECORD,) is zero before the first observation of an episode.
    """
    if record[BEGUN] > 0.0 and record[SEEN] > SLOWEST:
        learn(record, o, constants)
    record[BEGUN] = 1.0
    record[SEEN], record[SEEN + 1] = o[entry.LONGITUDINAL_SPEED], o[entry.LATERAL_SPEED]
    record[SEEN + 2] = o[entry.YAW_RATE]
    largest = -math.inf
    for i in range(CANDIDATES):
        largest = max(largest, record[LOGARITHM + i])
    total = mean = square = 0.0
    for i in range(CANDIDATES):
        weight, friction = math.exp(record[LOGARITHM + i] - largest), candidate(i, constants)
        total += weight
        mean += weight * friction
        square += weight * friction * friction
    mean /= total
    deviation = math.sqrt(max(square / total - mean * mean, 0.0))
    record[MEAN] = mean
    record[CAUTIOUS] = max(mean - CAUTION * deviation, constants[L.LEAST_FRICTION])
    set_tyres(mean, constants)
    constants[L.GRIP] = GRIP_SHARE * record[CAUTIOUS] * GRAVITY
