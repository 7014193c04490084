"""Kernels of closed loops, compiled: control periods of many vehicles, each with its NMPC."""

import math
from typing import Any, NamedTuple

import numba
from numpy.typing import NDArray

from agents.delay import predict_observation
from agents.nmpc import layout as nmpc_layout
from agents.nmpc import rti
from agents.nmpc.qp import CODE, INNER, SUCCESS
from agents.nmpc.rti import NmpcArrays
from agents.nmpc.schedule import NO_BAND, choose_weights, update_band
from agents.weight_tuning import features
from agents.weight_tuning.decision import PolicyArrays, decide_if_due
from agents.weight_tuning.features import end_period, update_history
from agents.weight_tuning.loop_memory import MemoryArrays, WeightArrays
from lpv_track_env import kernels as k
from lpv_track_env.conditions import layout as conditions_layout
from lpv_track_env.conditions.episode import drive_under_conditions
from lpv_track_env.vector_kernels import ConditionArrays, EnvArrays, copy
from trajectories.compilation import compiled, compiled_internal, compiled_parallel

Array = NDArray[Any]

# Entries of a vehicle's tally, (TALLY,): see `closed_loop.Tally`.
(
    STEPS, REWARD, LATERAL, HEADING, SPEED, STEERING_RATE, JERK, MAX_LATERAL, MAX_HEADING,
    STEERING_VARIATION, FAILED, CLIPPED, ITERATIONS, SOLVES,
) = range(14)  # fmt: skip
TALLY = 14

# Phases of a vehicle within a call.
(
    SOLVE,  # its NMPC computes the next action
    ACTION_GIVEN,  # the next action is in `actions` already, in place of a failed solve
    SOLVE_FAILED,  # its solve has failed: it waits for a replacement
    PAUSED,  # it waits for the next call
) = range(4)


class Run(NamedTuple):
    """Progress of one call, a row a vehicle."""

    progress: Array
    """Control periods driven, (n,)."""
    phases: Array
    """SOLVE, ACTION_GIVEN, SOLVE_FAILED or PAUSED, (n,)."""
    first_bands: Array
    """Band of the first solve, (n,), NO_BAND before it."""
    tally: Array
    """(n, TALLY)."""
    trace: Array
    """Record after each period, (n, periods, RECORD_SIZE), or (n, 0, RECORD_SIZE) for none."""


class Workspace(NamedTuple):
    """Working space of one thread, or of all threads with a leading dimension."""

    nodes: Array
    """Nodes of the preview, (preview steps + 1, NODE)."""
    layers: Array
    """Two layers of a policy's network, (2, widest) float32."""
    stages: Array
    """(N + 1, STAGE), see `agents.nmpc.layout`."""
    lanes: Array
    """(LANES, N)."""
    filter: Array
    """Working space of the state estimator."""


@compiled_internal
def add_to_tally(record: Array, before_a: Any, before_delta: Any, period: Any, sums: Array) -> None:
    """Add a control period that has been driven to its vehicle's tally, (TALLY,)."""
    change_a = record[k.ACCELERATION] - before_a
    change_delta = record[k.STEERING] - before_delta
    sums[STEPS] += 1.0
    sums[REWARD] += record[k.REWARD]
    sums[LATERAL] += record[k.LATERAL_ERROR] * record[k.LATERAL_ERROR]
    sums[HEADING] += record[k.HEADING_ERROR] * record[k.HEADING_ERROR]
    sums[SPEED] += record[k.SPEED_ERROR] * record[k.SPEED_ERROR]
    sums[STEERING_RATE] += change_delta * change_delta / (period * period)
    sums[JERK] += change_a * change_a / (period * period)
    sums[MAX_LATERAL] = max(sums[MAX_LATERAL], abs(record[k.LATERAL_ERROR]))
    sums[MAX_HEADING] = max(sums[MAX_HEADING], abs(record[k.HEADING_ERROR]))
    sums[STEERING_VARIATION] += abs(change_delta)
    if record[k.CLIPPED] > 0.0:
        sums[CLIPPED] += 1.0


@compiled_internal
def prepare_observation(
    observation: Array, commands: Array, foot_point: Array, delays: Array, nodes: Array,
    shown: Array,
) -> None:  # fmt: skip
    """Fill `shown` (size,) with the observation for the NMPC.

    With delay compensation it is predicted to the time at which the next action takes effect.
    """
    total = 0.0
    for j in range(shown.shape[0]):
        shown[j] = observation[j]
        total += abs(shown[j])
    if delays.shape[0] > 0:
        foot_point[0] = foot_point[1] = foot_point[2] = 0.0
        if math.isfinite(total):
            predict_observation(shown, commands, delays, nodes, foot_point)


@compiled_internal
def push_command(commands: Array, a: Any, delta: Any) -> None:
    """Put a command before those that were sent earlier, (rows, 2); the oldest is dropped."""
    for j in range(commands.shape[0] - 1, 0, -1):
        commands[j, 0], commands[j, 1] = commands[j - 1, 0], commands[j - 1, 1]
    commands[0, 0], commands[0, 1] = a, delta


@compiled_internal
def take_in(
    row: int, observations: Array, memory: MemoryArrays, weights: WeightArrays, actions: Array,
    nodes: Array, steps: int, period: Any,
) -> None:  # fmt: skip
    """Take a vehicle's observation in, once a period: NMPC's observation, band and history."""
    own = memory.history[row]
    if own[features.TAKEN_IN] > 0.0:
        return
    shown = memory.nmpc_observations[row]
    prepare_observation(
        observations[row], memory.commands[row], memory.foot_points[row], memory.delays, nodes,
        shown,
    )  # fmt: skip
    update_band(shown, steps, weights.rules, weights.bands, row)
    update_history(own, observations[row], actions[row, 0], actions[row, 1], period)


@compiled
def take_in_rows(
    mask: Array, observations: Array, memory: MemoryArrays, weights: WeightArrays, actions: Array,
    nodes: Array, steps: int, period: Any,
) -> None:  # fmt: skip
    """`take_in` for every row that `mask` (n,) marks."""
    for row in range(mask.shape[0]):
        if mask[row]:
            take_in(row, observations, memory, weights, actions, nodes, steps, period)


@compiled_internal
def update_weights(
    row: int, observations: Array, memory: MemoryArrays, weights: WeightArrays,
    policy: PolicyArrays, layers: Array, steps: int,
) -> None:  # fmt: skip
    """Update a vehicle's weights in use after `take_in`; a policy first decides, if due."""
    table = weights.tables[row if weights.tables.shape[0] > 1 else 0]
    if policy.layers.shape[0] > 0:
        decide_if_due(
            observations[row], memory.history[row], weights.in_use[row], weights.bands[row], policy,
            table, layers,
        )  # fmt: skip
    choose_weights(
        memory.nmpc_observations[row], steps, table, weights.rules, weights.bands, row,
        weights.in_use[row],
    )  # fmt: skip


@compiled_internal
def count_solve(own: Array, stats: Array) -> None:
    """Count a solve's iterations and its failure in a vehicle's history."""
    own[features.ITERATIONS] += stats[INNER]
    if stats[CODE] != SUCCESS:
        own[features.FAILURES] += 1.0


@compiled_internal
def act(
    row: int, period: Any, until_band: bool, observations: Array, memory: MemoryArrays,
    weights: WeightArrays, policy: PolicyArrays, nmpc: NmpcArrays, run: Run, work: Workspace,
) -> int:  # fmt: skip
    """Fill a vehicle's row of `actions`; returns its next phase.

    SOLVE_FAILED if its solve fails, PAUSED if with `until_band` its band is another than the first.
    """
    if run.phases[row] == SOLVE:
        steps = int(nmpc.constants[nmpc_layout.PREVIEW_STEPS])
        take_in(row, observations, memory, weights, nmpc.actions, work.nodes, steps, period)
        if until_band:
            if run.first_bands[row] == NO_BAND:
                run.first_bands[row] = weights.bands[row]
            if run.first_bands[row] != weights.bands[row]:
                return PAUSED
        update_weights(row, observations, memory, weights, policy, work.layers, steps)
        failed = rti.control(
            row, memory.nmpc_observations[row : row + 1], weights.in_use[row : row + 1],
            nmpc.constants, nmpc.plans, nmpc.flags, nmpc.stats, nmpc.states, nmpc.actions,
            nmpc.frictions, work.stages, work.lanes,
        )  # fmt: skip
        run.tally[row, ITERATIONS] += nmpc.stats[row, INNER]
        run.tally[row, SOLVES] += 1.0
        count_solve(memory.history[row], nmpc.stats[row])
        if failed > 0:
            run.tally[row, FAILED] += 1.0
            return SOLVE_FAILED
    if memory.delays.shape[0] > 0:
        push_command(memory.commands[row], nmpc.actions[row, 0], nmpc.actions[row, 1])
    return SOLVE


@compiled
def drive_rows(
    first: int, last: int, periods: int, until_band: bool, envs: EnvArrays,
    conditions: ConditionArrays | None,
    memory: MemoryArrays, weights: WeightArrays, policy: PolicyArrays, nmpc: NmpcArrays, run: Run,
    work: Workspace,
) -> None:  # fmt: skip
    """Drive vehicles first to last - 1 until their progress reaches `periods` or they end.

    A vehicle whose solve fails waits, SOLVE_FAILED; set to ACTION_GIVEN it goes on with its row of
    `actions` in place of that solve. With `until_band` a vehicle waits, PAUSED, where the preview
    enters another band, and on return bands and histories are those of the next period.
    `conditions` is None under the conditions "simulation".
    """
    for row in range(first, last):
        if run.phases[row] == SOLVE_FAILED or run.phases[row] == PAUSED:
            continue
        record, case, observation = envs.records[row], envs.cases[row], envs.observations[row]
        table = envs.tables[envs.rows[case, 0] : envs.rows[case, 1]]
        constants = envs.constants[case]
        period, actions, commands = constants[k.PERIOD], nmpc.actions[row], memory.commands[row]
        while run.progress[row] < periods and envs.ends[row] == k.RUNNING:
            busy = False
            if conditions is not None:
                now = record[k.STEPS] * period
                free_at = conditions.vehicles[row, conditions_layout.FREE_AT]
                busy = free_at > now + conditions_layout.TIME_TOLERANCE
            if busy:
                # The computer still works on an earlier command: the last one stays in force.
                push_command(commands, commands[0, 0], commands[0, 1])
            else:
                run.phases[row] = act(
                    row, period, until_band, envs.observations, memory, weights, policy, nmpc, run,
                    work,
                )  # fmt: skip
                if run.phases[row] != SOLVE:
                    break
            before_a, before_delta = record[k.ACCELERATION], record[k.STEERING]
            if conditions is None:
                envs.ends[row] = k.drive(
                    record, actions[0], actions[1], constants, table, observation
                )
            else:
                envs.ends[row] = drive_under_conditions(
                    conditions.vehicles[row], record, actions[0], actions[1],
                    conditions.specs[case], constants, table, observation, envs.draws[row, 0],
                    envs.draws[row, 1], work.filter,
                )  # fmt: skip
            if run.trace.shape[1] > 0:
                copy(record, run.trace[row, run.progress[row]])
            run.progress[row] += 1
            add_to_tally(record, before_a, before_delta, period, run.tally[row])
            end_period(memory.history[row])
        if until_band and run.phases[row] == SOLVE and envs.ends[row] == k.RUNNING:
            take_in(
                row, envs.observations, memory, weights, nmpc.actions, work.nodes,
                int(nmpc.constants[nmpc_layout.PREVIEW_STEPS]), period,
            )  # fmt: skip


@compiled_parallel
def drive_in_threads(
    chunks: int, n: int, periods: int, until_band: bool, envs: EnvArrays,
    conditions: ConditionArrays | None,
    memory: MemoryArrays, weights: WeightArrays, policy: PolicyArrays, nmpc: NmpcArrays, run: Run,
    work: Workspace,
) -> None:  # fmt: skip
    """`drive_rows` on all n, in chunks that threads share, each with its own working space."""
    for chunk in numba.prange(chunks):
        drive_rows(
            chunk * n // chunks, (chunk + 1) * n // chunks, periods, until_band, envs, conditions,
            memory, weights, policy,
            NmpcArrays(
                nmpc.constants.copy(), nmpc.plans, nmpc.flags, nmpc.stats, nmpc.states,
                nmpc.actions, nmpc.frictions,
            ),
            run,
            Workspace(
                work.nodes[chunk], work.layers[chunk], work.stages[chunk], work.lanes[chunk],
                work.filter[chunk],
            ),
        )  # fmt: skip


# An agent's control period in two parts. The solve between them is a call of its own: called from
# here, it would be compiled once more.


@compiled
def prepare_rows(
    observations: Array, memory: MemoryArrays, weights: WeightArrays, policy: PolicyArrays,
    actions: Array, nodes: Array, layers: Array, steps: int, period: Any,
) -> None:  # fmt: skip
    """Take observations (n, size) float32 in, and update the weights in use."""
    for row in range(observations.shape[0]):
        take_in(row, observations, memory, weights, actions, nodes, steps, period)
        update_weights(row, observations, memory, weights, policy, layers, steps)


@compiled
def finish_rows(memory: MemoryArrays, actions: Array, stats: Array) -> None:
    """Record solves by their statistics (n, STATS), and the actions (n, 2) that are sent."""
    for row in range(actions.shape[0]):
        count_solve(memory.history[row], stats[row])
        if memory.delays.shape[0] > 0:
            push_command(memory.commands[row], actions[row, 0], actions[row, 1])
        end_period(memory.history[row])
