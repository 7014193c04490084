"""The NMPC's quadratic program: its numbers, its constraints' gaps, its linear model, compiled.

A gap is the distance to a bound, negative where it is broken. Rows of an array of gaps, per stage::

     0.. 7   high, low of a, delta, a - a_before, delta - delta_before
     8.. 9   high, low of vx at the period's end          (10 is its slack's row)
    11..12   high, low of vx' at the period's start       (13)
    14..15   ratio vx - vy, ratio vx + vy at the end      (16)
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc.linearisation import RATE, RATE_DELTA, RATE_R, RATE_VX, RATE_VY
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from trajectories.compilation import compiled

Array = NDArray[Any]
Float = Any

PAIRS = 17

# Numbers of the problem, (LIMITS_SIZE,): see `rti_solver.limits`.
(
    LOW_A, HIGH_A, MAX_DELTA, STEP_A, STEP_DELTA, FIRST_STEP_A, FIRST_STEP_DELTA, LOW_SPEED,
    HIGH_SPEED, LOW_RATE, HIGH_RATE, RATIO, LINEAR, QUADRATIC, DAMPING_A, DAMPING_DELTA,
) = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 15, 18, 19)  # fmt: skip
LIMITS_SIZE = 20
SLACK_OF = (0, 2, 1)
"""Index in the problem's penalties (vx, vy, vx') of the soft constraints in their order here."""


@compiled
def measure_gaps(
    records: Array, base: Array, plan: Array, states: Array, inputs: Array, last: Array,
    limits: Array, gaps: Array,
) -> Float:  # fmt: skip
    """Fill the gaps (PAIRS, N) of linearised constraints; the rows of slacks are left alone.

    `base` (N + 1, 6) and `plan` (N, 2) are what the records were made along. Returns the least gap.
    """
    n = inputs.shape[0]
    low_a, high_a, max_delta = limits[LOW_A], limits[HIGH_A], limits[MAX_DELTA]
    ratio, least = limits[RATIO], math.inf
    before_a, before_delta = last[0], last[1]
    step_a, step_delta = limits[FIRST_STEP_A], limits[FIRST_STEP_DELTA]
    for i in range(n):
        a, delta, e = inputs[i, 0], inputs[i, 1], records[i]
        gaps[0, i], gaps[1, i] = high_a - a, a - low_a
        gaps[2, i], gaps[3, i] = max_delta - delta, delta + max_delta
        change_a, change_delta = a - before_a, delta - before_delta
        gaps[4, i], gaps[5, i] = step_a - change_a, change_a + step_a
        gaps[6, i], gaps[7, i] = step_delta - change_delta, change_delta + step_delta
        vx, vy = states[i + 1, VX], states[i + 1, VY]
        gaps[8, i], gaps[9, i] = limits[HIGH_SPEED] - vx, vx - limits[LOW_SPEED]
        rate = e[RATE] + e[RATE_VX] * (states[i, VX] - base[i, VX])
        rate += e[RATE_VY] * (states[i, VY] - base[i, VY])
        rate += e[RATE_R] * (states[i, YAW_RATE] - base[i, YAW_RATE])
        rate += a - plan[i, 0] + e[RATE_DELTA] * (delta - plan[i, 1])
        gaps[11, i], gaps[12, i] = limits[HIGH_RATE] - rate, rate - limits[LOW_RATE]
        gaps[14, i], gaps[15, i] = ratio * vx - vy, ratio * vx + vy
        before_a, before_delta = a, delta
        step_a, step_delta = limits[STEP_A], limits[STEP_DELTA]
        for k in range(8):
            least = min(least, gaps[k, i])
        for k in (8, 9, 11, 12, 14, 15):
            least = min(least, gaps[k, i])
    return least


@compiled
def clamp(inputs: Array, last: Array, limits: Array) -> None:
    """Bring inputs (N, 2) within their bounds and rates, from the first on."""
    before_a, before_delta = last[0], last[1]
    step_a, step_delta = limits[FIRST_STEP_A], limits[FIRST_STEP_DELTA]
    for i in range(inputs.shape[0]):
        a = min(max(inputs[i, 0], before_a - step_a), before_a + step_a)
        delta = min(max(inputs[i, 1], before_delta - step_delta), before_delta + step_delta)
        before_a = min(max(a, limits[LOW_A]), limits[HIGH_A])
        before_delta = min(max(delta, -limits[MAX_DELTA]), limits[MAX_DELTA])
        inputs[i, 0], inputs[i, 1] = before_a, before_delta
        step_a, step_delta = limits[STEP_A], limits[STEP_DELTA]


@compiled
def follow(records: Array, base: Array, plan: Array, inputs: Array, states: Array) -> None:
    """Fill states (N + 1, 6) by the linearised model under inputs (N, 2)."""
    for k in range(6):
        states[0, k] = base[0, k]
    for i in range(inputs.shape[0]):
        e = records[i]
        d0 = states[i, VX] - base[i, VX]
        d1 = states[i, VY] - base[i, VY]
        d2 = states[i, PSI] - base[i, PSI]
        d3 = states[i, YAW_RATE] - base[i, YAW_RATE]
        ua, ud = inputs[i, 0] - plan[i, 0], inputs[i, 1] - plan[i, 1]
        following, there = states[i + 1], base[i + 1]
        for k in range(6):
            following[k] = there[k] + (
                e[k] * d0 + e[6 + k] * d1 + e[12 + k] * d3 + e[20 + k] * ua + e[26 + k] * ud
            )
        following[PSI] += d2
        following[X] += e[18] * d2 + (states[i, X] - base[i, X])
        following[Y] += e[19] * d2 + (states[i, Y] - base[i, Y])
