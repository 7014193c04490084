"""Compiled kernels of closed loops: control periods of many vehicles, each with its NMPC."""

import math
from typing import Any

import numba
from numpy.typing import NDArray

from agents.delay_kernels import look_ahead
from agents.nmpc import rti
from agents.nmpc.qp import CODE, INNER, SUCCESS
from agents.nmpc.schedule import NO_BAND, choose_weights, update_band
from agents.weight_tuning.deciding import reconsider
from agents.weight_tuning.watching import FAILURES, FRESH, passed, watch
from agents.weight_tuning.watching import ITERATIONS as ITERATED
from lpv_track_env import kernels as k
from lpv_track_env.conditions import layout as conditions_layout
from lpv_track_env.conditions.episode import drive_under_conditions
from lpv_track_env.vector_kernels import copy
from trajectories.compilation import compiled, compiled_internal, compiled_parallel

Array = NDArray[Any]

(
    STEPS, REWARD, LATERAL, HEADING, SPEED, STEERING_RATE, JERK, MAX_LATERAL, MAX_HEADING,
    STEERING_VARIATION, FAILED, CLIPPED, ITERATIONS, SOLVES,
) = range(14)  # fmt: skip
TALLY = 14

ASKED, GIVEN, HELD, PAUSED = range(4)
"""What holds for a vehicle's next action: its NMPC is asked, `actions` has what replaces a failed
solve, the vehicle is not to go on in this call."""


@compiled_internal
def count(record: Array, before_a: Any, before_delta: Any, period: Any, sums: Array) -> None:
    """Add a period that was driven to its vehicle's tally, (TALLY,)."""
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
def look(
    observation: Array, commands: Array, foot: Array, future: Array, nodes: Array, seen: Array
) -> None:
    """Fill `seen` (size,) with what the NMPC is shown: with `future` settings, when it lands."""
    total = 0.0
    for j in range(seen.shape[0]):
        seen[j] = observation[j]
        total += abs(seen[j])
    if future.shape[0] > 0:
        foot[0] = foot[1] = foot[2] = 0.0
        if math.isfinite(total):
            look_ahead(seen, commands, future, nodes, foot)


@compiled_internal
def remember(commands: Array, a: Any, delta: Any) -> None:
    """Put a command before those that were sent earlier, (rows, 2)."""
    for j in range(commands.shape[0] - 1, 0, -1):
        commands[j, 0], commands[j, 1] = commands[j - 1, 0], commands[j - 1, 1]
    commands[0, 0], commands[0, 1] = a, delta


@compiled
def attend(
    row: int, observations: Array, looked: Array, commands: Array, feet: Array, future: Array,
    nodes: Array, rules: Array, bands: Array, watched: Array, actions: Array, steps: int,
    period: Any,
) -> None:  # fmt: skip
    """Take in a vehicle's observation, once: what the NMPC is shown, the band, what is watched."""
    if watched[row, FRESH] > 0.0:
        return
    look(observations[row], commands[row], feet[row], future, nodes, looked[row])
    update_band(looked[row], steps, rules, bands, row)
    watch(watched[row], observations[row], actions[row, 0], actions[row, 1], period)


@compiled
def attend_rows(
    mask: Array, observations: Array, looked: Array, commands: Array, feet: Array, future: Array,
    nodes: Array, rules: Array, bands: Array, watched: Array, actions: Array, steps: int,
    period: Any,
) -> None:  # fmt: skip
    """`attend` for every row that `mask` (n,) marks."""
    for row in range(mask.shape[0]):
        if mask[row]:
            attend(
                row, observations, looked, commands, feet, future, nodes, rules, bands, watched,
                actions, steps, period,
            )  # fmt: skip


@compiled_internal
def choose(
    row: int, observations: Array, looked: Array, tables: Array, rules: Array, bands: Array,
    weights: Array, watched: Array, network: Array, layers: Array, sets: Array, matrix: Array,
    log_span: Any, catalogue: Array, scales: Array, window: int, scratch: Array, steps: int,
) -> None:  # fmt: skip
    """Bring a vehicle's `weights` in use up to date with what `attend` took in.

    Where there are `layers`, a policy writes the vehicle's table first, if it is time.
    """
    own = row if tables.shape[0] > 1 else 0
    if layers.shape[0] > 0:
        reconsider(
            observations[row], watched[row], weights[row], bands[row], network, layers, sets,
            matrix, log_span, catalogue, scales, window, tables[own], scratch,
        )  # fmt: skip
    choose_weights(looked[row], steps, tables[own], rules, bands, row, weights[row])


@compiled_internal
def solved(watched: Array, told: Array) -> None:
    """Note what a solve took, by what it `told`, and whether it failed."""
    watched[ITERATED] += told[INNER]
    if told[CODE] != SUCCESS:
        watched[FAILURES] += 1.0


@compiled
def decide(
    row: int, asked: int, period: Any, observations: Array, looked: Array, commands: Array,
    feet: Array, future: Array, tables: Array, rules: Array, bands: Array, weights: Array,
    watched: Array, until_band: bool, since: Array, network: Array, layers: Array, sets: Array,
    matrix: Array, log_span: Any, catalogue: Array, scales: Array, window: int, constants: Array,
    plans: Array, flags: Array, told: Array, states: Array, actions: Array, sums: Array,
    nodes: Array, scratch: Array, stages: Array, lanes: Array,
) -> int:  # fmt: skip
    """Fill a vehicle's row of `actions`; HELD if its solve has failed, PAUSED at a band's end.

    With `until_band`, `since` (n,) is the band in which the call found the vehicle.
    """
    if asked == ASKED:
        attend(
            row, observations, looked, commands, feet, future, nodes, rules, bands, watched,
            actions, lanes.shape[1], period,
        )  # fmt: skip
        if until_band:
            if since[row] == NO_BAND:
                since[row] = bands[row]
            if since[row] != bands[row]:
                return PAUSED
        choose(
            row, observations, looked, tables, rules, bands, weights, watched, network, layers,
            sets, matrix, log_span, catalogue, scales, window, scratch, lanes.shape[1],
        )  # fmt: skip
        failed = rti.control(
            row, looked[row : row + 1], weights[row : row + 1], constants, plans, flags, told,
            states, actions, stages, lanes,
        )  # fmt: skip
        sums[ITERATIONS] += told[row, INNER]
        sums[SOLVES] += 1.0
        solved(watched[row], told[row])
        if failed > 0:
            sums[FAILED] += 1.0
            return HELD
    if future.shape[0] > 0:
        remember(commands[row], actions[row, 0], actions[row, 1])
    return ASKED


@compiled
def drive_rows(
    first: int, last: int, periods: int, records: Array, observations: Array, ends: Array,
    cases: Array, env_constants: Array, tables: Array, rows: Array, looked: Array, commands: Array,
    feet: Array, future: Array, weight_tables: Array, rules: Array, bands: Array, weights: Array,
    watched: Array, until_band: bool, since: Array, network: Array, layers: Array, sets: Array,
    matrix: Array, log_span: Any, catalogue: Array, scales: Array, window: int, constants: Array,
    plans: Array, flags: Array, told: Array, states: Array, actions: Array, progress: Array,
    asked: Array, tally: Array, trace: Array, nodes: Array, scratch: Array, stages: Array,
    lanes: Array,
) -> None:  # fmt: skip
    """Drive vehicles first to last - 1 until `progress` (n,) reaches `periods` or they end.

    One whose solve fails stays where it is, `asked` (n,) HELD; set to GIVEN it goes on with its row
    of `actions` in place of that solve. With `until_band` one waits, PAUSED, where the preview's
    band changes, and in the end `bands` and `watched` are those of the next period. `trace`
    (n, periods or 0, RECORD_SIZE) gets every record. `nodes`, `scratch`, `stages` and `lanes` are
    working space.
    """
    for row in range(first, last):
        if asked[row] == HELD or asked[row] == PAUSED:
            continue
        record, case = records[row], cases[row]
        table = tables[rows[case, 0] : rows[case, 1]]
        period = env_constants[case, k.PERIOD]
        while progress[row] < periods and ends[row] == k.RUNNING:
            asked[row] = decide(
                row, asked[row], period, observations, looked, commands, feet, future,
                weight_tables, rules, bands, weights, watched, until_band, since, network, layers,
                sets, matrix, log_span, catalogue, scales, window, constants, plans, flags, told,
                states, actions, tally[row], nodes, scratch, stages, lanes,
            )  # fmt: skip
            if asked[row] != ASKED:
                break
            before_a, before_delta = record[k.ACCELERATION], record[k.STEERING]
            ends[row] = k.drive(
                record, actions[row, 0], actions[row, 1], env_constants[case], table,
                observations[row],
            )  # fmt: skip
            if trace.shape[1] > 0:
                copy(record, trace[row, progress[row]])
            progress[row] += 1
            count(record, before_a, before_delta, period, tally[row])
            passed(watched[row])
        if until_band and asked[row] == ASKED and ends[row] == k.RUNNING:
            attend(
                row, observations, looked, commands, feet, future, nodes, rules, bands, watched,
                actions, lanes.shape[1], period,
            )  # fmt: skip


@compiled
def drive_rows_under_conditions(
    first: int, last: int, periods: int, records: Array, observations: Array, ends: Array,
    cases: Array, env_constants: Array, tables: Array, rows: Array, looked: Array, commands: Array,
    feet: Array, future: Array, weight_tables: Array, rules: Array, bands: Array, weights: Array,
    watched: Array, until_band: bool, since: Array, network: Array, layers: Array, sets: Array,
    matrix: Array, log_span: Any, catalogue: Array, scales: Array, window: int, constants: Array,
    plans: Array, flags: Array, told: Array, states: Array, actions: Array, progress: Array,
    asked: Array, tally: Array, trace: Array, nodes: Array, scratch: Array, stages: Array,
    lanes: Array, vehicles: Array, specs: Array, draws: Array, work: Array,
) -> None:  # fmt: skip
    """`drive_rows` under conditions, see `conditions_vector.advance` for the last four arrays."""
    for row in range(first, last):
        if asked[row] == HELD or asked[row] == PAUSED:
            continue
        record, case = records[row], cases[row]
        table = tables[rows[case, 0] : rows[case, 1]]
        period = env_constants[case, k.PERIOD]
        while progress[row] < periods and ends[row] == k.RUNNING:
            free_at = vehicles[row, conditions_layout.FREE_AT]
            if free_at > record[k.STEPS] * period + conditions_layout.INSTANT:
                # Busy with an earlier command: nothing is computed, the last one stays.
                remember(commands[row], commands[row, 0, 0], commands[row, 0, 1])
            else:
                asked[row] = decide(
                    row, asked[row], period, observations, looked, commands, feet, future,
                    weight_tables, rules, bands, weights, watched, until_band, since, network,
                    layers, sets, matrix, log_span, catalogue, scales, window, constants, plans,
                    flags, told, states, actions, tally[row], nodes, scratch, stages, lanes,
                )  # fmt: skip
                if asked[row] != ASKED:
                    break
            before_a, before_delta = record[k.ACCELERATION], record[k.STEERING]
            ends[row] = drive_under_conditions(
                vehicles[row], record, actions[row, 0], actions[row, 1], specs[case],
                env_constants[case], table, observations[row], draws[row, 0], draws[row, 1], work,
            )  # fmt: skip
            if trace.shape[1] > 0:
                copy(record, trace[row, progress[row]])
            progress[row] += 1
            count(record, before_a, before_delta, period, tally[row])
            passed(watched[row])
        if until_band and asked[row] == ASKED and ends[row] == k.RUNNING:
            attend(
                row, observations, looked, commands, feet, future, nodes, rules, bands, watched,
                actions, lanes.shape[1], period,
            )  # fmt: skip


@compiled_parallel
def drive_in_threads(
    chunks: int, n: int, periods: int, records: Array, observations: Array, ends: Array,
    cases: Array, env_constants: Array, tables: Array, rows: Array, looked: Array, commands: Array,
    feet: Array, future: Array, weight_tables: Array, rules: Array, bands: Array, weights: Array,
    watched: Array, until_band: bool, since: Array, network: Array, layers: Array, sets: Array,
    matrix: Array, log_span: Any, catalogue: Array, scales: Array, window: int, constants: Array,
    plans: Array, flags: Array, told: Array, states: Array, actions: Array, progress: Array,
    asked: Array, tally: Array, trace: Array, nodes: Array, scratch: Array, stages: Array,
    lanes: Array,
) -> None:  # fmt: skip
    """`drive_rows` on all n, in chunks that threads share; each has its own working space."""
    for chunk in numba.prange(chunks):
        drive_rows(
            chunk * n // chunks, (chunk + 1) * n // chunks, periods, records, observations, ends,
            cases, env_constants, tables, rows, looked, commands, feet, future, weight_tables,
            rules, bands, weights, watched, until_band, since, network, layers, sets, matrix,
            log_span, catalogue, scales, window, constants, plans, flags, told, states, actions,
            progress, asked, tally, trace, nodes[chunk], scratch[chunk], stages[chunk],
            lanes[chunk],
        )  # fmt: skip


@compiled_parallel
def drive_in_threads_under_conditions(
    chunks: int, n: int, periods: int, records: Array, observations: Array, ends: Array,
    cases: Array, env_constants: Array, tables: Array, rows: Array, looked: Array, commands: Array,
    feet: Array, future: Array, weight_tables: Array, rules: Array, bands: Array, weights: Array,
    watched: Array, until_band: bool, since: Array, network: Array, layers: Array, sets: Array,
    matrix: Array, log_span: Any, catalogue: Array, scales: Array, window: int, constants: Array,
    plans: Array, flags: Array, told: Array, states: Array, actions: Array, progress: Array,
    asked: Array, tally: Array, trace: Array, nodes: Array, scratch: Array, stages: Array,
    lanes: Array, vehicles: Array, specs: Array, draws: Array, work: Array,
) -> None:  # fmt: skip
    """`drive_in_threads` under conditions."""
    for chunk in numba.prange(chunks):
        drive_rows_under_conditions(
            chunk * n // chunks, (chunk + 1) * n // chunks, periods, records, observations, ends,
            cases, env_constants, tables, rows, looked, commands, feet, future, weight_tables,
            rules, bands, weights, watched, until_band, since, network, layers, sets, matrix,
            log_span, catalogue, scales, window, constants, plans, flags, told, states, actions,
            progress, asked, tally, trace, nodes[chunk], scratch[chunk], stages[chunk],
            lanes[chunk], vehicles, specs,
            draws, work[chunk],
        )  # fmt: skip
