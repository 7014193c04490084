"""Compiled kernels of the vector environment: control periods of many vehicles, and new episodes.

Under conditions each vehicle's period is the single environment's own function. Without them
vehicles are integrated in blocks: the states of `LANES` vehicles are copied into rows of scratch,
and every Runge-Kutta step is one loop over a row, which the compiler turns into vector
instructions. Results are bit for bit those of the single environment.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels as k
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.conditions.episode import begin_under_conditions, drive_under_conditions
from lpv_track_env.draws import choice
from lpv_track_env.episodes import TRAJECTORY_DRAW, VEHICLE_DRAW, begin
from lpv_track_env.integration import in_half_steps, integrate, rotate, runge_kutta
from trajectories.compilation import compiled, compiled_inline, compiled_internal, compiled_parallel

Array = NDArray[Any]


class EnvArrays(NamedTuple):
    """Arrays of n environments that compiled code steps in place.

    A case is a path driven by a vehicle; `kernels` lays out records and constants.
    """

    records: Array
    """(n, RECORD_SIZE)."""
    observations: Array
    """(n, size) float32."""
    ends: Array
    """(n,) codes of `kernels.END_NAMES`."""
    cases: Array
    """(n,) row of each environment's case in `constants` and `rows`."""
    constants: Array
    """(cases, CONSTANTS_SIZE)."""
    tables: Array
    """(nodes, 8), the tables of all paths, one after another."""
    rows: Array
    """(cases, 2), first row of each case's table and the row after its last."""
    draws: Array
    """(n, 2) uint64, key of each environment's episodes and number of the current one."""


class ConditionArrays(NamedTuple):
    """Further arrays of n environments under conditions; `conditions.layout` lays them out."""

    vehicles: Array
    """(n, size)."""
    specs: Array
    """(cases, SPEC)."""


class StepArrays(NamedTuple):
    """Inputs and results of a step of n environments."""

    commands: Array
    """(n, 2), acceleration in m/s^2 and steering angle in rad."""
    rewards: Array
    """(n,)."""
    final_records: Array
    """(n, RECORD_SIZE), last records of the episodes that ended, in SAME_STEP."""
    final_observations: Array
    """(n, size) float32, likewise."""
    final_vehicles: Array
    """Last vehicles under conditions, (n, size), likewise; else (0, 0)."""


LANES = 32
"""Number of vehicles in a block."""

# Rows of the scratch, each LANES long: state, then
COS, SIN, ACCELERATION, STEERING, COS_STEERING, SIN_STEERING, PARAMETERS = (
    6 * LANES, 7 * LANES, 8 * LANES, 9 * LANES, 10 * LANES, 11 * LANES, 12 * LANES,
)  # fmt: skip
SUBSTEP, CLIPPED, PUSH, SUBSTEPS, LOWEST = (
    18 * LANES, 19 * LANES, 20 * LANES, 21 * LANES, 22 * LANES,
)  # fmt: skip
SCRATCH_SIZE = 23 * LANES

NEXT_STEP, SAME_STEP, DISABLED = range(3)
"""Modes of `gymnasium.vector.AutoresetMode`: when an environment that has ended is reset."""


@compiled_internal
def integrate_lanes(b: Array, substeps: int) -> None:
    """Integrate all lanes of the scratch `b` by the same number of Runge-Kutta steps."""
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
                0.0, 0.0, b[SUBSTEP + j], b[LOWEST + j], True, False,
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
    """Copy a vehicle into lane j: state, actuators after the command, parameters, substeps."""
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
    b[CLIPPED + j], b[LOWEST + j] = bits, p[k.LOWEST_SPEED]


@compiled_internal
def integrate_one(b: Array, j: int, record: Array, p: Array) -> None:
    """Integrate lane j alone, for blocks whose vehicles need different numbers of substeps."""
    substeps = int(p[k.SUBSTEPS])
    vx, vy, psi, r, x, y = integrate(
        record[VX], record[VY], record[PSI], record[YAW_RATE], record[X], record[Y],
        b[ACCELERATION + j], b[STEERING + j],
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[k.PERIOD] / substeps, substeps,
        p[k.LOWEST_SPEED],
    )  # fmt: skip
    b[j], b[LANES + j], b[2 * LANES + j] = vx, vy, psi
    b[3 * LANES + j], b[4 * LANES + j], b[5 * LANES + j] = r, x, y


@compiled_internal
def draw_case(drawn: Any, key: Any, episode: Any) -> Any:
    """Draw the case of an episode, that is, its path and its vehicle.

    `drawn` holds the first case to draw from and the numbers of paths and of vehicles; the cases of
    one path stand side by side.
    """
    case, paths, vehicles = drawn
    if paths > 1:
        case += vehicles * choice(key, episode, TRAJECTORY_DRAW, paths)
    if vehicles > 1:
        case += choice(key, episode, VEHICLE_DRAW, vehicles)
    return case


@compiled_internal
def begin_next(
    i: int, envs: EnvArrays, conditions: ConditionArrays | None, drawn: Any, given: Array
) -> None:
    """Begin the next episode of environment i, with a path and a vehicle that are drawn."""
    draws = envs.draws[i]
    draws[1] += np.uint64(1)
    case = draw_case(drawn, draws[0], draws[1])
    envs.cases[i] = case
    record, observation, constants = envs.records[i], envs.observations[i], envs.constants[case]
    table = envs.tables[envs.rows[case, 0] : envs.rows[case, 1]]
    if conditions is None:
        begin(record, constants, table, observation, draws[0], draws[1], given, math.inf)
    else:
        begin_under_conditions(
            conditions.vehicles[i], record, conditions.specs[case], constants, table, observation,
            draws, given, math.inf,
        )  # fmt: skip


@compiled_internal
def copy(source: Array, target: Array) -> None:
    """Copy a vector; an assignment would need memory in case the two overlap."""
    for j in range(source.shape[0]):
        target[j] = source[j]


@compiled_internal
def integrate_block(envs: EnvArrays, commands: Array, low: int, lanes: int, b: Array) -> None:
    """Integrate the `lanes` environments from `low` on over a control period, in scratch `b`."""
    uniform = True
    for j in range(LANES):
        # Lanes beyond the last environment repeat the first, so that every lane is a vehicle.
        i = low + j if j < lanes else low
        load_lane(b, j, envs.records[i], commands[i], envs.constants[envs.cases[i]])
        uniform = uniform and b[SUBSTEPS + j] == b[SUBSTEPS]
    if uniform:
        integrate_lanes(b, int(b[SUBSTEPS]))
    else:
        for j in range(lanes):
            integrate_one(b, j, envs.records[low + j], envs.constants[envs.cases[low + j]])


@compiled
def advance(
    first: int, last: int, mode: int, envs: EnvArrays, conditions: ConditionArrays | None,
    step: StepArrays, drawn: Any, given: Array, b: Array,
) -> None:  # fmt: skip
    """Drive the environments `first` to `last` - 1 one control period, with autoreset.

    In NEXT_STEP an environment that has ended begins anew instead, with reward 0. In SAME_STEP an
    environment that ends begins anew at once, and the `final_` arrays of `step` keep its end.

    Parameters
    ----------
    conditions
        None under "simulation"; numba compiles a version for each type.
    drawn, given
        As `draw_case` and `episodes.begin` take them, for the episodes that begin.
    b
        Scratch: (SCRATCH_SIZE,), or (`filter.WORK`,) under conditions.
    """
    for low in range(first, last, LANES):
        lanes = min(LANES, last - low)
        if conditions is None:
            integrate_block(envs, step.commands, low, lanes, b)
        for j in range(lanes):
            i = low + j
            record, observation = envs.records[i], envs.observations[i]
            begins = mode == NEXT_STEP and envs.ends[i] != k.RUNNING
            if begins:
                envs.ends[i], step.rewards[i] = k.RUNNING, 0.0
            else:
                case = envs.cases[i]
                constants = envs.constants[case]
                table = envs.tables[envs.rows[case, 0] : envs.rows[case, 1]]
                if conditions is None:
                    envs.ends[i] = k.finish(
                        record, constants, table, observation,
                        b[VX * LANES + j], b[VY * LANES + j], b[PSI * LANES + j],
                        b[YAW_RATE * LANES + j], b[X * LANES + j], b[Y * LANES + j],
                        b[ACCELERATION + j], b[STEERING + j], int(b[CLIPPED + j]),
                    )  # fmt: skip
                else:
                    envs.ends[i] = drive_under_conditions(
                        conditions.vehicles[i], record, step.commands[i, 0], step.commands[i, 1],
                        conditions.specs[case], constants, table, observation,
                        envs.draws[i, 0], envs.draws[i, 1], b,
                    )  # fmt: skip
                step.rewards[i] = record[k.REWARD]
                if mode == SAME_STEP and envs.ends[i] != k.RUNNING:
                    begins = True
                    copy(record, step.final_records[i])
                    copy(observation, step.final_observations[i])
                    if conditions is not None:
                        copy(conditions.vehicles[i], step.final_vehicles[i])
            # One call for both modes, since every call is inlined.
            if begins:
                begin_next(i, envs, conditions, drawn, given)


@compiled_parallel
def advance_in_threads(
    chunks: int, n: int, mode: int, envs: EnvArrays, conditions: ConditionArrays | None,
    step: StepArrays, drawn: Any, given: Array, scratch: Array,
) -> None:  # fmt: skip
    """`advance` on all n environments, in chunks that threads share.

    Chunks consist of whole blocks, or of single vehicles under conditions; each chunk has its own
    row of `scratch`.
    """
    size = LANES
    if conditions is not None:
        size = 1
    blocks = (n + size - 1) // size
    for chunk in numba.prange(chunks):
        first = chunk * blocks // chunks * size
        last = min((chunk + 1) * blocks // chunks * size, n)
        advance(first, last, mode, envs, conditions, step, drawn, given, scratch[chunk])


@compiled
def begin_all(
    mask: Array, envs: EnvArrays, conditions: ConditionArrays | None, drawn: Any, given: Array
) -> None:
    """Begin the next episode of every environment that `mask` (n,) marks."""
    for i in range(mask.shape[0]):
        if mask[i]:
            envs.ends[i] = k.RUNNING
            begin_next(i, envs, conditions, drawn, given)


SHARES = 8
"""Shares of the work for each thread: some shares take longer, or a processor may be taken."""


def shares(threads: int) -> int:
    """Return the number of shares into which threads divide their work."""
    return SHARES * threads if threads > 1 else 1


@contextmanager
def using_threads(threads: int) -> Iterator[None]:
    """Run numba's parallel loops in this many threads, each taking the next free share."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        with numba.parallel_chunksize(1):
            yield
    finally:
        numba.set_num_threads(before)
