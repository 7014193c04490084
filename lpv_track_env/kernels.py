"""Compiled kernels of path tracking: actuators, integration, projection, reward, observation.

`drive` and `start` work on the arrays of one episode; `advance` works on a single environment,
whose arrays are packed in one. The other environments call the parts of `drive`. The constants are
the indices of the arrays' entries.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import observation as entry
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.integration import integrate
from lpv_track_env.observation import PREVIEW_BOUNDS, PREVIEW_START, SCALARS
from lpv_track_env.reward import terms
from trajectories.compilation import compiled, compiled_in_place, compiled_inline, compiled_internal
from trajectories.projection import SEARCH_WINDOW, follow
from trajectories.table import cell, fill_preview, saturate, speed_in

Array = NDArray[Any]

# Record of an episode, (RECORD_SIZE,) float64: the state [vx, vy, psi, r, X, Y], then
ACCELERATION, STEERING, START, STEPS, REFERENCE_SPEED, END = 6, 7, 8, 9, 10, 11
# and, from ARC_LENGTH on, the quantities that a step reports:
ARC_LENGTH, LATERAL_ERROR, HEADING_ERROR, SPEED_ERROR, CLIPPED, REWARD, TERMS = (
    12, 13, 14, 15, 16, 17, 18,
)  # fmt: skip
RECORD_SIZE = 24

# Constants of an environment, (CONSTANTS_SIZE,) float64: 7 vehicle parameters, then
MAX_STEERING, STEERING_STEP, LOWEST_ACCELERATION, HIGHEST_ACCELERATION, ACCELERATION_STEP = (
    7, 8, 9, 10, 11,
)  # fmt: skip
PERIOD, SUBSTEPS, PREVIEW_PERIOD, CORRIDOR, MAX_STEPS, LENGTH, CLOSED, TIGHTEST = (
    12, 13, 14, 15, 16, 17, 18, 19,
)  # fmt: skip
START_RANGE, LATERAL_RANGE, HEADING_RANGE, SPEED_RANGE, HEIGHT, LOWEST_SPEED, WEIGHTS = (
    20, 21, 22, 23, 24, 25, 26,
)  # fmt: skip
CONSTANTS_SIZE = 37

# A single environment, float64: its command [a, delta], then
RECORD = 2
CONSTANTS = RECORD + RECORD_SIZE
OBSERVATION = CONSTANTS + CONSTANTS_SIZE
"""First entry of the observation: float32, two numbers in each float64."""

RUNNING, FINISHED, LEFT_CORRIDOR, WRONG_HEADING, NON_FINITE, TIME_LIMIT, COLLISION = range(7)
END_NAMES = (
    "running", "finished", "left_corridor", "wrong_heading", "non_finite", "time_limit",
    "collision",
)  # fmt: skip
"""Ends of an episode by code; a collision only in traffic."""
NOT_FINITE = -1
"""Code in place of an end: the command is not finite."""

RANGE_ACCELERATION, RATE_ACCELERATION, RANGE_STEERING, RATE_STEERING = 1, 2, 4, 8
"""Bits of `CLIPPED`, one for each limit of the actuators that clipped the command."""

MAX_HEADING_ERROR = 0.5 * math.pi
BOUNDS = tuple(bound for _, _, bound in SCALARS)
CURVATURE_BOUND, SPEED_BOUND = (bound for _, _, bound in PREVIEW_BOUNDS)


@compiled_internal
def clip(value: Any, low: Any, high: Any) -> Any:
    """Return `value` clipped to [low, high]."""
    return min(max(value, low), high)


@compiled_internal
def wrap(angle: Any) -> Any:
    """Return an angle wrapped to (-pi, pi]; an angle in that range is returned unchanged."""
    if -math.pi < angle <= math.pi:
        return angle
    wrapped = angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
    return math.pi if wrapped == -math.pi else wrapped


@compiled_internal
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
    """Return the commands after the actuators' range and rate limits, and the clipping bits."""
    ranged_a, ranged_delta = clip(a, low_a, high_a), clip(delta, -max_delta, max_delta)
    rated_a = clip(ranged_a, last_a - a_step, last_a + a_step)
    rated_delta = clip(ranged_delta, last_delta - delta_step, last_delta + delta_step)
    # The tolerance ignores the rounding of a controller that drives along a bound. Sums rather than
    # branches, since these would be hard to predict.
    bits = (
        RANGE_ACCELERATION * (abs(ranged_a - a) > 1e-6)
        + RATE_ACCELERATION * (abs(rated_a - ranged_a) > 1e-6)
        + RANGE_STEERING * (abs(ranged_delta - delta) > 1e-6)
        + RATE_STEERING * (abs(rated_delta - ranged_delta) > 1e-6)
    )
    return rated_a, rated_delta, bits


@compiled_inline
def observe(
    record: Array, constants: Array, table: Array, observation: Array, index: int, u: Any
) -> None:  # fmt: skip
    """Write the observation (see `observation`) at a foot point, at u in [0, 1] of a cell."""
    o, k = observation, (observation.shape[0] - PREVIEW_START) // 2
    o[entry.LONGITUDINAL_SPEED] = saturate(record[VX], BOUNDS[entry.LONGITUDINAL_SPEED])
    o[entry.LATERAL_SPEED] = saturate(record[VY], BOUNDS[entry.LATERAL_SPEED])
    o[entry.YAW_RATE] = saturate(record[YAW_RATE], BOUNDS[entry.YAW_RATE])
    o[entry.ACCELERATION] = saturate(record[ACCELERATION], BOUNDS[entry.ACCELERATION])
    o[entry.STEERING_ANGLE] = saturate(record[STEERING], BOUNDS[entry.STEERING_ANGLE])
    o[entry.LATERAL_ERROR] = saturate(record[LATERAL_ERROR], BOUNDS[entry.LATERAL_ERROR])
    o[entry.HEADING_ERROR] = saturate(record[HEADING_ERROR], BOUNDS[entry.HEADING_ERROR])
    o[entry.REFERENCE_SPEED] = saturate(record[REFERENCE_SPEED], BOUNDS[entry.REFERENCE_SPEED])
    fill_preview(
        table, constants[LENGTH], constants[CLOSED] > 0.5, record[ARC_LENGTH], index, u,
        constants[PREVIEW_PERIOD], observation, PREVIEW_START, k,
        CURVATURE_BOUND, SPEED_BOUND,
    )  # fmt: skip


@compiled_inline
def locate(
    record: Array, constants: Array, table: Array, near: Any, ahead: Any, window: Any
) -> tuple[int, Any]:
    """Project the vehicle on the path, about `ahead` m after `near`, and record its errors.

    Returns the foot point's cell and u in it.
    """
    s, lateral_error, heading, index, u, _ = follow(
        table, constants[LENGTH], constants[CLOSED] > 0.5, record[X], record[Y],
        near, ahead, window, constants[TIGHTEST],
    )  # fmt: skip
    reference_speed = speed_in(table, index, u)
    record[ARC_LENGTH] = s
    record[LATERAL_ERROR] = lateral_error
    record[HEADING_ERROR] = wrap(record[PSI] - heading)
    record[REFERENCE_SPEED] = reference_speed
    record[SPEED_ERROR] = record[VX] - reference_speed
    return index, u


@compiled
def locate_and_observe(
    record: Array, constants: Array, table: Array, observation: Array, ahead: Any, window: Any
) -> None:
    """Project the record's state on the path, about `ahead` m from its arc length, and observe."""
    index, u = locate(record, constants, table, record[ARC_LENGTH], ahead, window)
    observe(record, constants, table, observation, index, u)


@compiled_inline
def end_code(record: Array, constants: Array, finite: bool) -> int:
    """Return RUNNING or the code of the episode's end."""
    if not finite:
        return NON_FINITE
    if abs(record[LATERAL_ERROR]) > constants[CORRIDOR]:
        return LEFT_CORRIDOR
    if abs(record[HEADING_ERROR]) > MAX_HEADING_ERROR:
        return WRONG_HEADING
    goal = constants[LENGTH]
    if constants[CLOSED] > 0.5:
        goal += record[START]
    if record[ARC_LENGTH] >= goal - 1e-9:
        return FINISHED
    if record[STEPS] >= constants[MAX_STEPS]:
        return TIME_LIMIT
    return RUNNING


@compiled_inline
def finish(
    record: Array, constants: Array, table: Array, observation: Array,
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any, bits: int,
) -> int:  # fmt: skip
    """End a control period with a new state and actuators: errors, end, reward, observation.

    A non-finite new state ends the episode: the record keeps the last finite state.
    """
    p = constants
    last_a, last_delta, before = record[ACCELERATION], record[STEERING], record[ARC_LENGTH]
    finite = math.isfinite(vx + vy + psi + r + x + y)
    record[STEPS] += 1.0
    record[CLIPPED] = bits
    if finite:
        record[VX], record[VY], record[PSI] = vx, vy, psi
        record[YAW_RATE], record[X], record[Y] = r, x, y
        record[ACCELERATION], record[STEERING] = a, delta
        ahead = vx * p[PERIOD]
        reach = min(max(SEARCH_WINDOW, 1.5 * abs(ahead)), p[LENGTH])
        index, u = locate(record, constants, table, before, ahead, reach)
    else:
        n = table.shape[0]
        index, offset = cell(before, p[LENGTH], p[CLOSED] > 0.5, n)
        u = offset * (n - 1) / p[LENGTH]
    end = end_code(record, constants, finite)
    failed = end in (LEFT_CORRIDOR, WRONG_HEADING, NON_FINITE)
    # A tuple, since a slice would be an array with a reference count.
    w = WEIGHTS
    weights = (
        p[w], p[w + 1], p[w + 2], p[w + 3], p[w + 4], p[w + 5], p[w + 6], p[w + 7], p[w + 8],
        p[w + 9], p[w + 10],
    )  # fmt: skip
    parts = terms(
        weights, p[PERIOD], record[ARC_LENGTH] - before,
        record[LATERAL_ERROR], record[HEADING_ERROR], record[SPEED_ERROR],
        record[REFERENCE_SPEED], (a - last_a) / p[PERIOD], (delta - last_delta) / p[PERIOD], failed,
    )  # fmt: skip
    total = 0.0
    for k in range(len(parts)):
        record[TERMS + k] = parts[k]
        total += parts[k]
    record[REWARD] = total
    record[END] = end
    observe(record, constants, table, observation, index, u)
    return end


@compiled_in_place
def drive(
    record: Array, a: Any, delta: Any, constants: Array, table: Array, observation: Array
) -> int:
    """Drive one control period of an episode, in place; return the code of its end."""
    p = constants
    a, delta, bits = actuate(
        a, delta, record[ACCELERATION], record[STEERING],
        p[MAX_STEERING], p[STEERING_STEP], p[LOWEST_ACCELERATION], p[HIGHEST_ACCELERATION],
        p[ACCELERATION_STEP],
    )  # fmt: skip
    substeps = int(p[SUBSTEPS])
    vx, vy, psi, r, x, y = integrate(
        record[VX], record[VY], record[PSI], record[YAW_RATE], record[X], record[Y], a, delta,
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[PERIOD] / substeps, substeps, p[LOWEST_SPEED],
    )  # fmt: skip
    return finish(record, constants, table, observation, vx, vy, psi, r, x, y, a, delta, bits)


@compiled
def advance(
    episode: Array, table: Array
) -> tuple[int, Any, Any, Any, Any, int, Any, Any, Any, Any, Any, Any, Any]:
    """Drive one control period of a single environment, whose arrays `episode` holds, in place.

    Returns the code of its end and the record from ARC_LENGTH on; for a command that is not finite
    NOT_FINITE, and nothing changes. Passing one array and returning every number at once is the
    fastest way from and to Python.
    """
    a, delta = episode[0], episode[1]
    m = episode[RECORD:CONSTANTS]
    if math.isfinite(a) and math.isfinite(delta):
        end = drive(
            m, a, delta, episode[CONSTANTS:OBSERVATION], table,
            episode[OBSERVATION:].view(np.float32),
        )  # fmt: skip
    else:
        end = NOT_FINITE
    k = TERMS
    return (
        end, m[ARC_LENGTH], m[LATERAL_ERROR], m[HEADING_ERROR], m[SPEED_ERROR], int(m[CLIPPED]),
        m[REWARD], m[k], m[k + 1], m[k + 2], m[k + 3], m[k + 4], m[k + 5],
    )  # fmt: skip


@compiled
def command(episode: Array) -> tuple[Any, Any, int]:
    """Return the actuators' values for the command in `episode`, and the clipping bits."""
    m, p = episode[RECORD:CONSTANTS], episode[CONSTANTS:OBSERVATION]
    a, delta, bits = actuate(
        episode[0], episode[1], m[ACCELERATION], m[STEERING],
        p[MAX_STEERING], p[STEERING_STEP], p[LOWEST_ACCELERATION], p[HIGHEST_ACCELERATION],
        p[ACCELERATION_STEP],
    )  # fmt: skip
    return a, delta, bits


@compiled
def conclude(
    episode: Array, table: Array,
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any, bits: int,
) -> int:  # fmt: skip
    """End a control period with the new state of another plant; return the end's code."""
    end: int = finish(
        episode[RECORD:CONSTANTS], episode[CONSTANTS:OBSERVATION], table,
        episode[OBSERVATION:].view(np.float32), vx, vy, psi, r, x, y, a, delta, bits,
    )  # fmt: skip
    return end


@compiled
def start(record: Array, constants: Array, table: Array, observation: Array) -> None:
    """Begin an episode from the state and actuators in `record`, near its ARC_LENGTH."""
    near = record[ARC_LENGTH]
    record[START:] = 0.0
    window = min(SEARCH_WINDOW, constants[LENGTH])
    index, u = locate(record, constants, table, near, 0.0, window)
    record[START] = record[ARC_LENGTH]
    observe(record, constants, table, observation, index, u)


@compiled
def first_not_finite(commands: Array, ends: Array, skips_ended: bool) -> int:
    """Return the index into the flat `commands` (n, 2) of the first that is not finite, or -1.

    `skips_ended` leaves out environments whose episode has ended, by their codes `ends` (n,).
    """
    for i in range(commands.shape[0]):
        if skips_ended and ends[i] != RUNNING:
            continue
        for j in range(2):
            if not math.isfinite(commands[i, j]):
                return 2 * i + j
    return -1
