"""Compiled kernels of the vector environment: the single environment's, on blocks of vehicles.

A block's states are copied into scratch rows of `LANES` vehicles each, and every Runge-Kutta step
is one loop over a row, which the compiler turns into vector instructions. All else is the single
environment's own functions, vehicle by vehicle. Bits are those of the single environment.
"""

import math
from typing import Any

import numba
from numpy.typing import NDArray

from lpv_track_env import kernels as k
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.draws import choice
from lpv_track_env.episodes import TRAJECTORY_DRAW, VEHICLE_DRAW, begin
from lpv_track_env.integration import in_half_steps, integrate, rotate, runge_kutta
from trajectories.compilation import compiled, compiled_inline, compiled_internal, compiled_parallel

Array = NDArray[Any]

LANES = 32
"""Vehicles in a block."""

# Rows of the scratch, each LANES long: state, then
COS, SIN, ACCELERATION, STEERING, COS_STEERING, SIN_STEERING, PARAMETERS = (
    6 * LANES, 7 * LANES, 8 * LANES, 9 * LANES, 10 * LANES, 11 * LANES, 12 * LANES,
)  # fmt: skip
SUBSTEP, CLIPPED, PUSH, SUBSTEPS = 18 * LANES, 19 * LANES, 20 * LANES, 21 * LANES
SCRATCH_SIZE = 22 * LANES

NEXT_STEP, SAME_STEP, DISABLED = range(3)
"""When an environment that has ended is reset, as `gymnasium.vector.AutoresetMode` says."""


@compiled_internal
def integrate_lanes(b: Array, substeps: int) -> None:
    """Runge-Kutta steps of all lanes of a scratch, the same number for each."""
    for j in range(LANES):
        half = 0.5 * b[SUBSTEP + j]
        b[PUSH + j] = b[ACCELERATION + j] * half
        b[YAW_RATE * LANES + j] *= half
    for _ in range(substeps):
        for j in range(LANES):
            vx, vy, r, turn, dx, dy = runge_kutta(
                b[j], b[LANES + j], b[3 * LANES + j], b[COS + j], b[SIN + j],
                b[PUSH + j], b[STEERING + j], b[COS_STEERING + j], b[SIN_STEERING + j],
                b[PARAMETERS + j], b[PARAMETERS + LANES + j], b[PARAMETERS + 2 * LANES + j],
                b[PARAMETERS + 3 * LANES + j], b[PARAMETERS + 4 * LANES + j],
                b[PARAMETERS + 5 * LANES + j],
                b[SUBSTEP + j], True,
            )  # fmt: skip
            c, s = rotate(b[COS + j], b[SIN + j], turn)
            b[j], b[LANES + j], b[3 * LANES + j] = vx, vy, r
            b[2 * LANES + j] += turn
            b[4 * LANES + j] += dx
            b[5 * LANES + j] += dy
            b[COS + j], b[SIN + j] = c, s
    for j in range(LANES):
        b[YAW_RATE * LANES + j] /= 0.5 * b[SUBSTEP + j]


@compiled_inline
def load_lane(b: Array, j: int, record: Array, action: Array, p: Array) -> None:
    """Copy a vehicle into lane j: state, what its actuators give, parameters, substeps."""
    a, delta, bits = k.actuate(
        action[0], action[1], record[k.ACCELERATION], record[k.STEERING],
        p[k.MAX_STEERING], p[k.STEERING_STEP], p[k.LOWEST_ACCELERATION],
        p[k.HIGHEST_ACCELERATION], p[k.ACCELERATION_STEP],
    )  # fmt: skip
    for row in range(6):
        b[row * LANES + j] = record[row]
    b[COS + j], b[SIN + j] = math.cos(record[PSI]), math.sin(record[PSI])
    b[ACCELERATION + j], b[STEERING + j] = a, delta
    b[COS_STEERING + j], b[SIN_STEERING + j] = math.cos(delta), math.sin(delta)
    h = p[k.PERIOD] / p[k.SUBSTEPS]
    b[SUBSTEP + j], b[SUBSTEPS + j] = h, p[k.SUBSTEPS]
    q = in_half_steps(0.5 * h, p[0], p[1], p[2], p[3], p[4], p[5], p[6])
    for row in range(len(q)):
        b[PARAMETERS + row * LANES + j] = q[row]
    b[CLIPPED + j] = bits


@compiled_internal
def integrate_one(b: Array, j: int, record: Array, p: Array) -> None:
    """Integrate lane j alone: for blocks whose vehicles need different numbers of substeps."""
    substeps = int(p[k.SUBSTEPS])
    vx, vy, psi, r, x, y = integrate(
        record[VX], record[VY], record[PSI], record[YAW_RATE], record[X], record[Y],
        b[ACCELERATION + j], b[STEERING + j],
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[k.PERIOD] / substeps, substeps,
    )  # fmt: skip
    b[j], b[LANES + j], b[2 * LANES + j] = vx, vy, psi
    b[3 * LANES + j], b[4 * LANES + j], b[5 * LANES + j] = r, x, y


@compiled
def first_bad(commands: Array, ends: Array, mode: int) -> int:
    """Index into the flat `commands` (n, 2) of the first that is not finite, or -1.

    In NEXT_STEP commands to environments that have ended are ignored.
    """
    for i in range(commands.shape[0]):
        if mode == NEXT_STEP and ends[i] != k.RUNNING:
            continue
        for j in range(2):
            if not math.isfinite(commands[i, j]):
                return 2 * i + j
    return -1


@compiled_internal
def draw_case(drawn: Any, key: Any, episode: Any) -> Any:
    """Draw the case of an episode, its path and its vehicle.

    `drawn` holds the first case to draw from, the number of paths and that of vehicles; cases list
    the combinations, vehicles side by side.
    """
    case, paths, vehicles = drawn
    if paths > 1:
        case += vehicles * choice(key, episode, TRAJECTORY_DRAW, paths)
    if vehicles > 1:
        case += choice(key, episode, VEHICLE_DRAW, vehicles)
    return case


@compiled_internal
def begin_next(
    i: int, record: Array, cases: Array, drawn: Any, constants: Array, tables: Array,
    rows: Array, observation: Array, keys: Array, episodes: Array, given: Array,
) -> None:  # fmt: skip
    """Begin the next episode of environment i, on a path and with a vehicle that are drawn."""
    episodes[i] += 1
    case = draw_case(drawn, keys[i], episodes[i])
    cases[i] = case
    table = tables[rows[case, 0] : rows[case, 1]]
    begin(record, constants[case], table, observation, keys[i], episodes[i], given)


@compiled_internal
def copy(source: Array, target: Array) -> None:
    """Copy a vector; an assignment would want record for the case that the two overlap."""
    for j in range(source.shape[0]):
        target[j] = source[j]


@compiled
def advance(
    first: int, last: int, mode: int,
    records: Array, actions: Array, cases: Array, drawn: Any, constants: Array, tables: Array,
    rows: Array, keys: Array, episodes: Array, given: Array,
    observations: Array, ends: Array, rewards: Array, final_records: Array,
    final_observations: Array, b: Array,
) -> None:  # fmt: skip
    """One control period of the environments `first` to `last` - 1, with autoreset.

    `ends` (n,) holds each environment's end code of the last step and is given the new one. In
    NEXT_STEP an environment that had ended begins anew instead, with reward 0; in SAME_STEP one
    that ends begins anew at once, its last record and observation kept in the `final_` arrays. `b`
    is scratch, (SCRATCH_SIZE,).
    """
    for low in range(first, last, LANES):
        lanes = min(LANES, last - low)
        uniform = True
        for j in range(LANES):
            # Lanes beyond the last environment repeat the first: no lane holds rubbish.
            i = low + j if j < lanes else low
            load_lane(b, j, records[i], actions[i], constants[cases[i]])
            uniform = uniform and b[SUBSTEPS + j] == b[SUBSTEPS]
        if uniform:
            integrate_lanes(b, int(b[SUBSTEPS]))
        else:
            for j in range(lanes):
                integrate_one(b, j, records[low + j], constants[cases[low + j]])
        for j in range(lanes):
            i = low + j
            record, observation = records[i], observations[i]
            begins = mode == NEXT_STEP and ends[i] != k.RUNNING
            if begins:
                ends[i], rewards[i] = k.RUNNING, 0.0
            else:
                case = cases[i]
                ends[i] = k.finish(
                    record, constants[case], tables[rows[case, 0] : rows[case, 1]], observation,
                    b[VX * LANES + j], b[VY * LANES + j], b[PSI * LANES + j],
                    b[YAW_RATE * LANES + j], b[X * LANES + j], b[Y * LANES + j],
                    b[ACCELERATION + j], b[STEERING + j], int(b[CLIPPED + j]),
                )  # fmt: skip
                rewards[i] = record[k.REWARD]
                if mode == SAME_STEP and ends[i] != k.RUNNING:
                    begins = True
                    copy(record, final_records[i])
                    copy(observation, final_observations[i])
            # One call for both modes: every call is compiled in.
            if begins:
                begin_next(
                    i, record, cases, drawn, constants, tables, rows, observation,
                    keys, episodes, given,
                )  # fmt: skip


@compiled_parallel
def advance_in_threads(
    chunks: int, n: int, mode: int,
    records: Array, actions: Array, cases: Array, drawn: Any, constants: Array, tables: Array,
    rows: Array, keys: Array, episodes: Array, given: Array,
    observations: Array, ends: Array, rewards: Array, final_records: Array,
    final_observations: Array, scratch: Array,
) -> None:  # fmt: skip
    """`advance` on all n environments, in chunks of whole blocks that threads share.

    Each chunk has its own row of `scratch`.
    """
    blocks = (n + LANES - 1) // LANES
    for chunk in numba.prange(chunks):
        first = chunk * blocks // chunks * LANES
        last = min((chunk + 1) * blocks // chunks * LANES, n)
        advance(
            first, last, mode, records, actions, cases, drawn, constants, tables, rows,
            keys, episodes, given, observations, ends, rewards, final_records,
            final_observations, scratch[chunk],
        )  # fmt: skip


@compiled
def begin_all(
    mask: Array,
    records: Array, cases: Array, drawn: Any, constants: Array, tables: Array, rows: Array,
    keys: Array, episodes: Array, given: Array, observations: Array, ends: Array,
) -> None:  # fmt: skip
    """Begin the next episode of every environment that `mask` (n,) marks."""
    for i in range(mask.shape[0]):
        if mask[i]:
            ends[i] = k.RUNNING
            begin_next(
                i, records[i], cases, drawn, constants, tables, rows, observations[i],
                keys, episodes, given,
            )  # fmt: skip
