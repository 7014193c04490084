"""Compiled kernels of path tracking: actuators, integration, projection, reward, observation.

The scalar functions `actuate`, `integrate`, `observe` and `judge` are what every environment
shares; `step` and `start` are the single environment's packed entry points. Numba's call overhead
is per argument, so they take few arrays: the indices below name their entries.
"""

import math
from typing import Any

from numpy.typing import NDArray

from lpv_track_env.bicycle import (
    PSI,
    VX,
    VY,
    YAW_RATE,
    X,
    Y,
    compiled_field,
    compiled_inverse_speed,
)
from lpv_track_env.observation import SCALARS
from lpv_track_env.reward import terms
from trajectories.compilation import compiled
from trajectories.projection import SEARCH_WINDOW, preview, project, speed_at

Array = NDArray[Any]

# Memory of an episode, (MEMORY_SIZE,) float64: the state, then
ACCELERATION, STEERING, ARC_LENGTH, START, STEPS = 6, 7, 8, 9, 10
# and what the last step was judged by:
LATERAL_ERROR, HEADING_ERROR, SPEED_ERROR, REFERENCE_SPEED, CLIPPED, END, REWARD, TERMS = (
    11, 12, 13, 14, 15, 16, 17, 18,
)  # fmt: skip
MEMORY_SIZE = 24

# Constants of an environment, (CONSTANTS_SIZE,) float64: 7 vehicle parameters, then
MAX_STEERING, STEERING_STEP, LOWEST_ACCELERATION, HIGHEST_ACCELERATION, ACCELERATION_STEP = (
    7, 8, 9, 10, 11,
)  # fmt: skip
PERIOD, SUBSTEPS, PREVIEW_PERIOD, CORRIDOR, MAX_STEPS, LENGTH, CLOSED, WEIGHTS = (
    12, 13, 14, 15, 16, 17, 18, 19,
)  # fmt: skip
CONSTANTS_SIZE = 30

RUNNING, FINISHED, LEFT_CORRIDOR, WRONG_HEADING, NON_FINITE, TIME_LIMIT = range(6)
END_NAMES = ("running", "finished", "left_corridor", "wrong_heading", "non_finite", "time_limit")
"""How an episode ends, by code."""

RANGE_ACCELERATION, RATE_ACCELERATION, RANGE_STEERING, RATE_STEERING = 1, 2, 4, 8
"""Bits of what the actuators clipped."""

MAX_HEADING_ERROR = 0.5 * math.pi
PREVIEW_START = len(SCALARS)


@compiled
def clip(value: Any, low: Any, high: Any) -> Any:
    """`value` within [low, high]."""
    return min(max(value, low), high)


@compiled
def wrap(angle: Any) -> Any:
    """Angle in (-pi, pi]; exact (untouched) where it already lies there."""
    if -math.pi < angle <= math.pi:
        return angle
    wrapped = angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
    return math.pi if wrapped == -math.pi else wrapped


@compiled
def actuate(
    a: Any,
    delta: Any,
    last_a: Any,
    last_delta: Any,
    max_delta: Any,
    delta_step: Any,
    low_a: Any,
    high_a: Any,
    a_step: Any,
) -> tuple[Any, Any, Any]:
    """Commands after the actuators' range and rate limits, and the bits of what was clipped."""
    ranged_a, ranged_delta = clip(a, low_a, high_a), clip(delta, -max_delta, max_delta)
    rated_a = clip(ranged_a, last_a - a_step, last_a + a_step)
    rated_delta = clip(ranged_delta, last_delta - delta_step, last_delta + delta_step)
    bits = 0
    # A controller that drives along a bound must not be reported for its rounding.
    if abs(ranged_a - a) > 1e-6:
        bits += RANGE_ACCELERATION
    if abs(rated_a - ranged_a) > 1e-6:
        bits += RATE_ACCELERATION
    if abs(ranged_delta - delta) > 1e-6:
        bits += RANGE_STEERING
    if abs(rated_delta - ranged_delta) > 1e-6:
        bits += RATE_STEERING
    return rated_a, rated_delta, bits


@compiled
def rotate(c: Any, s: Any, angle: Any) -> tuple[Any, Any]:
    """(cos, sin) turned by a small angle: Taylor series to order 7, no call of libm."""
    q = angle * angle
    dc = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q / 720.0))
    ds = angle * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q / 5040.0)))
    return c * dc - s * ds, s * dc + c * ds


@compiled
def integrate(
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any,
    p0: Any, p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, h: Any, substeps: int,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """State after `substeps` Runge-Kutta steps (classic, order 4) of h seconds, inputs held.

    Sines and cosines are taken once: the heading's pair is then turned by each step's small angle.
    """
    cd, sd = math.cos(delta), math.sin(delta)
    c, s = math.cos(psi), math.sin(psi)
    half = 0.5 * h
    for _ in range(substeps):
        q = compiled_inverse_speed(vx)
        k1 = compiled_field(vx, vy, r, c, s, a, delta, cd, sd, q, p0, p1, p2, p3, p4, p5, p6)
        ux, uy, w = vx + half * k1[0], vy + half * k1[1], r + half * k1[3]
        c2, s2 = rotate(c, s, half * k1[2])
        q = compiled_inverse_speed(ux)
        k2 = compiled_field(ux, uy, w, c2, s2, a, delta, cd, sd, q, p0, p1, p2, p3, p4, p5, p6)
        ux, uy, w = vx + half * k2[0], vy + half * k2[1], r + half * k2[3]
        c2, s2 = rotate(c, s, half * k2[2])
        q = compiled_inverse_speed(ux)
        k3 = compiled_field(ux, uy, w, c2, s2, a, delta, cd, sd, q, p0, p1, p2, p3, p4, p5, p6)
        ux, uy, w = vx + h * k3[0], vy + h * k3[1], r + h * k3[3]
        c2, s2 = rotate(c, s, h * k3[2])
        q = compiled_inverse_speed(ux)
        k4 = compiled_field(ux, uy, w, c2, s2, a, delta, cd, sd, q, p0, p1, p2, p3, p4, p5, p6)
        sixth = h / 6.0
        vx += sixth * (k1[0] + 2.0 * (k2[0] + k3[0]) + k4[0])
        vy += sixth * (k1[1] + 2.0 * (k2[1] + k3[1]) + k4[1])
        turn = sixth * (k1[2] + 2.0 * (k2[2] + k3[2]) + k4[2])
        r += sixth * (k1[3] + 2.0 * (k2[3] + k3[3]) + k4[3])
        x += sixth * (k1[4] + 2.0 * (k2[4] + k3[4]) + k4[4])
        y += sixth * (k1[5] + 2.0 * (k2[5] + k3[5]) + k4[5])
        psi += turn
        c, s = rotate(c, s, turn)
    return vx, vy, psi, r, x, y


@compiled
def saturate(value: Any, bound: Any) -> Any:
    """`value` within +-bound; NaN becomes 0, so an observation is always finite."""
    if value != value:  # noqa: PLR0124  NaN
        return 0.0
    return min(max(value, -bound), bound)


@compiled
def observe(
    memory: Array, constants: Array, table: Array, bound: Array, observation: Array
) -> None:
    """Write the observation (see `observation`) of an episode's memory."""
    k = (observation.shape[0] - PREVIEW_START) // 2
    observation[0] = saturate(memory[VX], bound[0])
    observation[1] = saturate(memory[VY], bound[1])
    observation[2] = saturate(memory[YAW_RATE], bound[2])
    observation[3] = saturate(memory[ACCELERATION], bound[3])
    observation[4] = saturate(memory[STEERING], bound[4])
    observation[5] = saturate(memory[LATERAL_ERROR], bound[5])
    observation[6] = saturate(memory[HEADING_ERROR], bound[6])
    observation[7] = saturate(memory[REFERENCE_SPEED], bound[7])
    preview(
        table,
        constants[LENGTH],
        constants[CLOSED] > 0.5,
        memory[ARC_LENGTH],
        constants[PREVIEW_PERIOD],
        observation[PREVIEW_START : PREVIEW_START + k],
        observation[PREVIEW_START + k :],
    )
    for j in range(PREVIEW_START, observation.shape[0]):
        observation[j] = saturate(observation[j], bound[j])


@compiled
def locate(memory: Array, constants: Array, table: Array, near: Any, window: Any) -> None:
    """Project the vehicle on the path near an arc length and note its errors."""
    length, closed = constants[LENGTH], constants[CLOSED] > 0.5
    s, lateral_error, heading, _ = project(
        table, length, closed, memory[X], memory[Y], near, window
    )
    reference_speed = speed_at(table, length, closed, s)
    memory[ARC_LENGTH] = s
    memory[LATERAL_ERROR] = lateral_error
    memory[HEADING_ERROR] = wrap(memory[PSI] - heading)
    memory[REFERENCE_SPEED] = reference_speed
    memory[SPEED_ERROR] = memory[VX] - reference_speed


@compiled
def judge(memory: Array, constants: Array, finite: bool) -> int:
    """How the episode stands: RUNNING or the code of its end."""
    if not finite:
        return NON_FINITE
    if abs(memory[LATERAL_ERROR]) > constants[CORRIDOR]:
        return LEFT_CORRIDOR
    if abs(memory[HEADING_ERROR]) > MAX_HEADING_ERROR:
        return WRONG_HEADING
    goal = constants[LENGTH]
    if constants[CLOSED] > 0.5:
        goal += memory[START]
    if memory[ARC_LENGTH] >= goal - 1e-9:
        return FINISHED
    if memory[STEPS] >= constants[MAX_STEPS]:
        return TIME_LIMIT
    return RUNNING


@compiled
def step(
    memory: Array, action: Array, constants: Array, table: Array, bound: Array, observation: Array
) -> int:
    """One control period of the single environment, in place; returns the code of its end.

    A non-finite new state ends the episode: the memory keeps the last finite state.
    """
    p = constants
    last_a, last_delta = memory[ACCELERATION], memory[STEERING]
    a, delta, bits = actuate(
        action[0], action[1], last_a, last_delta,
        p[MAX_STEERING], p[STEERING_STEP], p[LOWEST_ACCELERATION], p[HIGHEST_ACCELERATION],
        p[ACCELERATION_STEP],
    )  # fmt: skip
    substeps = int(p[SUBSTEPS])
    vx, vy, psi, r, x, y = integrate(
        memory[VX], memory[VY], memory[PSI], memory[YAW_RATE], memory[X], memory[Y], a, delta,
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[PERIOD] / substeps, substeps,
    )  # fmt: skip
    finite = math.isfinite(vx + vy + psi + r + x + y)
    before = memory[ARC_LENGTH]
    memory[STEPS] += 1.0
    memory[CLIPPED] = bits
    if finite:
        memory[VX], memory[VY], memory[PSI] = vx, vy, psi
        memory[YAW_RATE], memory[X], memory[Y] = r, x, y
        memory[ACCELERATION], memory[STEERING] = a, delta
        reach = min(max(SEARCH_WINDOW, 1.5 * abs(vx) * p[PERIOD]), p[LENGTH])
        locate(memory, constants, table, before, reach)
    end = judge(memory, constants, finite)
    failed = end in (LEFT_CORRIDOR, WRONG_HEADING, NON_FINITE)
    parts = terms(
        p[WEIGHTS:], p[PERIOD], memory[ARC_LENGTH] - before,
        memory[LATERAL_ERROR], memory[HEADING_ERROR], memory[SPEED_ERROR],
        memory[REFERENCE_SPEED], (a - last_a) / p[PERIOD], (delta - last_delta) / p[PERIOD], failed,
    )  # fmt: skip
    total = 0.0
    for k in range(len(parts)):
        memory[TERMS + k] = parts[k]
        total += parts[k]
    memory[REWARD] = total
    memory[END] = end
    observe(memory, constants, table, bound, observation)
    return end


@compiled
def start(memory: Array, constants: Array, table: Array, bound: Array, observation: Array) -> None:
    """Begin an episode from the state and actuators that `memory` holds, near its ARC_LENGTH."""
    memory[START] = memory[ARC_LENGTH]
    memory[STEPS:] = 0.0
    locate(memory, constants, table, memory[ARC_LENGTH], SEARCH_WINDOW)
    memory[START] = memory[ARC_LENGTH]
    observe(memory, constants, table, bound, observation)
