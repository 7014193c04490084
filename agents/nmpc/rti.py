"""Real-time iteration of the NMPC, compiled: one linearisation and one QP per control period.

`solve` solves the problem of one vehicle; `control` computes actions for rows of observations.
Diehl, Bock and Schloeder, "A real-time iteration scheme for nonlinear optimization in optimal
feedback control", SIAM J. Control Optim. 43, 2005. The plan is rolled out from the measured state,
so it satisfies the dynamics before every QP. Where the tyres' friction is limited the QP's step may
lead beyond the grip that its linear model promises, so a line search on the exact cost shortens it.
"""

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from agents.nmpc import layout as L
from agents.nmpc.friction import BEGUN, estimate_friction
from agents.nmpc.linearisation import acceleration, advance, differentiate, taken
from agents.nmpc.problem import steering_rate_factor
from agents.nmpc.qp import (
    CODE,
    COST,
    INNER,
    NOT_FINITE,
    OUTER,
    SLACK,
    STATS,
    SUCCESS,
    clamp,
    copy_point,
    solve_qp,
)
from agents.reference import NODE, fill_leading_nodes
from agents.weights import WEIGHTS
from lpv_track_env import observation as entry
from trajectories.compilation import (
    compiled,
    compiled_in_place,
    compiled_internal,
    compiled_parallel,
)

Array = NDArray[Any]
Float = Any

compiled_steering_rate_factor = compiled_internal(steering_rate_factor)

SHORTENINGS = 3
"""Halvings of a step that the line search tries at most."""
DECREASE = 1e-4
"""Share of the decrease that the QP expects which a step must reach (Armijo's rule)."""

# Flags of a vehicle, (FLAGS,).
(
    WARM,  # 1 if the last plan warm-starts the next solve
    PLANNED,  # 1 if there is a plan
    AGE,  # control periods since it was made
    FAILURES,  # failed solves in a row
) = range(4)
FLAGS = 4


class NmpcArrays(NamedTuple):
    """Constants of an NMPC and its memory of n vehicles, for compiled code."""

    constants: Array
    """(CONSTANTS_SIZE + GRID N,), see `layout`."""
    plans: Array
    """Inputs of the last plans, (n, N, 2)."""
    flags: Array
    """(n, FLAGS) int64."""
    stats: Array
    """Statistics of the last solves, (n, STATS), see `qp`."""
    states: Array
    """States of the last plans, (n, N + 1, 6)."""
    actions: Array
    """Last actions, (n, 2)."""
    frictions: Array
    """Records of the estimated frictions, (n, `friction.RECORD`)."""


@compiled_internal
def cost_of(
    stages: Array, lanes: Array, at: int, last_a: Float, last_delta: Float, weights: Array,
    constants: Array,
) -> Float:  # fmt: skip
    """Cost of the problem for a point of the stages (from column `at` on) and the slacks.

    (last_a, last_delta) is the input in force.
    """
    n = lanes.shape[1]
    shares, smooth = L.grid(constants, L.SHARE, n), L.grid(constants, L.SMOOTH, n)
    vx, psi, x, y = (
        at + L.NOW_VX - L.NOW_A,
        at + L.NOW_PSI - L.NOW_A,
        at + L.NOW_X - L.NOW_A,
        at + L.NOW_Y - L.NOW_A,
    )
    total = 0.0
    for i in range(n + 1):
        offset, e = 4 if i == n else 0, stages[i]
        e0, e1 = e[vx] - e[L.REFERENCE], e[psi] - e[L.REFERENCE_HEADING]
        e2, e3 = e[x] - e[L.REFERENCE_X], e[y] - e[L.REFERENCE_Y]
        c, s = math.cos(e[L.REFERENCE_HEADING]), math.sin(e[L.REFERENCE_HEADING])
        along, across = c * e2 + s * e3, c * e3 - s * e2
        error = weights[offset] * e0 * e0 + weights[offset + 1] * e1 * e1
        error += weights[offset + 2] * along * along + weights[offset + 3] * across * across
        total += error if i == n else shares[i] * error
    before_a, before_delta = last_a, last_delta
    for i in range(n):
        a, delta = stages[i, at], stages[i, at + 1]
        effort = weights[8] * a * a + weights[9] * delta * delta
        for soft in range(3):
            s = lanes[L.SLACKS[soft], i]
            effort += s * (2.0 * constants[L.LINEAR + soft] + constants[L.QUADRATIC + soft] * s)
        total += shares[i] * effort
        change_a, change_delta = a - before_a, delta - before_delta
        rates = weights[10] * change_a * change_a + weights[11] * change_delta * change_delta
        total += smooth[i] * rates
        before_a, before_delta = a, delta
    return 0.5 * total


@compiled_internal
def roll_out(stages: Array, constants: Array) -> None:
    """Roll the inputs in the stages' STEP out from the plan's first state."""
    n = stages.shape[0] - 1
    lengths, grids = L.grid(constants, L.LENGTH, n), L.grid(constants, L.SUBSTEPS, n)
    for k in range(2, L.POINT):
        stages[0, L.STEP_A + k] = stages[0, L.PLAN_A + k]
    for i in range(n):
        e, end = stages[i], stages[i + 1]
        following = advance(
            taken(e, L.STEP_VX), e[L.STEP_A], e[L.STEP_DELTA], lengths[i], grids[i], constants
        )
        for k in range(6):
            end[L.STEP_VX + k] = following[k]


@compiled_internal
def exact_cost(
    stages: Array, lanes: Array, at: int, last_a: Float, last_delta: Float, weights: Array,
    constants: Array,
) -> Float:  # fmt: skip
    """Fill the slacks of a point that satisfies the dynamics, and return its cost."""
    p, vx, vy = constants, at + L.NOW_VX - L.NOW_A, at + L.NOW_VY - L.NOW_A
    for i in range(lanes.shape[1]):
        rate = acceleration(taken(stages[i], vx), stages[i, at], stages[i, at + 1], p)
        ahead, aside = stages[i + 1, vx], stages[i + 1, vy]
        lanes[L.SLACKS[0], i] = max(p[L.LOW_SPEED] - ahead, ahead - p[L.HIGH_SPEED], 0.0)
        lanes[L.SLACKS[1], i] = max(p[L.LOW_RATE] - rate, rate - p[L.HIGH_RATE], 0.0)
        lanes[L.SLACKS[2], i] = max(abs(aside) - p[L.RATIO] * ahead, 0.0)
    return cost_of(stages, lanes, at, last_a, last_delta, weights, constants)


@compiled_internal
def search_line(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array,
    constants: Array, expected: Float,
) -> Float:  # fmt: skip
    """Shorten the QP's step until the exact cost decreases, and return that cost.

    The step leads from the stages' PLAN to their NOW, whose cost the QP expects to be `expected`.
    NOW becomes the roll-out of the shortened step, or the plan if no step decreases the cost.
    """
    start = exact_cost(stages, lanes, L.PLAN_A, last_a, last_delta, weights, constants)
    rounding, length = 1e-12 * abs(start), 1.0
    for _ in range(SHORTENINGS + 1):
        for i in range(lanes.shape[1]):
            e = stages[i]
            for k in range(2):
                change = e[L.NOW_A + k] - e[L.PLAN_A + k]
                e[L.STEP_A + k] = e[L.PLAN_A + k] + length * change
        roll_out(stages, constants)
        found = exact_cost(stages, lanes, L.STEP_A, last_a, last_delta, weights, constants)
        if found <= start - DECREASE * length * (start - expected) + rounding:
            copy_point(stages, L.NOW_A, L.STEP_A)
            return found
        length *= 0.5
    copy_point(stages, L.NOW_A, L.PLAN_A)
    return exact_cost(stages, lanes, L.NOW_A, last_a, last_delta, weights, constants)


@compiled_in_place
def solve(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array,
    constants: Array, stats: Array,
) -> int:  # fmt: skip
    """Do one real-time iteration on the plan, its first state and the reference in `stages`.

    (last_a, last_delta) is the input in force, weights (12,). Writes the improved plan to the
    stages' NOW, fills the statistics `stats` (STATS,) and returns a code; only with SUCCESS is the
    plan valid.
    """
    stats[INNER] = stats[OUTER] = 0.0
    clamp(stages, L.PLAN_A, last_a, last_delta, constants)
    n = lanes.shape[1]
    lengths, grids = L.grid(constants, L.LENGTH, n), L.grid(constants, L.SUBSTEPS, n)
    for i in range(n):
        differentiate(stages[i], lengths[i], grids[i], constants, stages[i + 1])
    code = solve_qp(stages, lanes, last_a, last_delta, weights, constants, stats)
    stats[COST] = math.nan
    if code == SUCCESS:
        cost = cost_of(stages, lanes, L.NOW_A, last_a, last_delta, weights, constants)
        if constants[L.TYRE + 1] < math.inf:
            cost = search_line(stages, lanes, last_a, last_delta, weights, constants, cost)
        stats[COST] = cost
    for soft in range(3):
        largest = 0.0
        if code == SUCCESS:
            for i in range(lanes.shape[1]):
                largest = max(largest, lanes[L.SLACKS[soft], i])
        stats[SLACK + soft] = largest
    return code


@compiled_internal
def is_finite(observation: Array) -> bool:
    """Return whether all entries of an observation are finite."""
    total = 0.0
    for k in range(observation.shape[0]):
        total += abs(observation[k])
    return math.isfinite(total)


@compiled_internal
def load_observation(observation: Array, constants: Array, stages: Array, lanes: Array) -> None:
    """Write first state and reference to the stages, in the frame of the path's foot point.

    The observation is finite. `lanes` is working space.
    """
    e, o = stages[0], observation
    e[L.PLAN_VX], e[L.PLAN_VY] = o[entry.LONGITUDINAL_SPEED], o[entry.LATERAL_SPEED]
    e[L.PLAN_PSI], e[L.PLAN_R] = o[entry.HEADING_ERROR], o[entry.YAW_RATE]
    e[L.PLAN_X], e[L.PLAN_Y] = 0.0, o[entry.LATERAL_ERROR]
    first = entry.PREVIEW_START
    speeds = first + (o.shape[0] - first) // 2
    # Of a preview that is very long for the horizon, only as many intervals as there is room for.
    capped = lanes.reshape(lanes.size)[: min(speeds - first + 1, lanes.size)]
    grip = constants[L.GRIP]
    fill_leading_nodes(
        o[first:speeds], o[entry.REFERENCE_SPEED], o[speeds:], constants[L.PREVIEW_PERIOD],
        L.grid(constants, L.LENGTH, stages.shape[0] - 1),
        o[entry.LONGITUDINAL_SPEED], o[entry.HEADING_ERROR], o[entry.LATERAL_ERROR],
        min(constants[L.HIGH_RATE], grip), grip, -constants[L.LOW_RATE], capped,
        stages[:, L.REFERENCE : L.REFERENCE + NODE],
    )  # fmt: skip


@compiled_internal
def load_plan(
    plan: Array, warm: bool, last_a: Float, last_delta: Float, constants: Array, stages: Array
) -> None:
    """Write the start of a solve to the stages: the last plan (N, 2), or the input in force, held.

    The plan is shifted by the share of each stage that has passed; its end is held.
    """
    n = plan.shape[0]
    shift = L.grid(constants, L.SHIFT, n)
    for i in range(n):
        a, delta = last_a, last_delta
        if warm:
            ahead, a, delta = min(i + 1, n - 1), plan[i, 0], plan[i, 1]
            a += shift[i] * (plan[ahead, 0] - a)
            delta += shift[i] * (plan[ahead, 1] - delta)
        stages[i, L.PLAN_A], stages[i, L.PLAN_DELTA] = a, delta


@compiled_internal
def schedule_weights(weights: Array, vx: Float, p: Array, scheduled: Array) -> None:
    """Fill `scheduled` with weights (12,) at a speed vx, as `NmpcProblem.weights_at` returns them.

    `p` are the constants of the solver.
    """
    for k in range(WEIGHTS):
        scheduled[k] = weights[k]
    wheelbase = p[2] + p[3]
    understeer = p[0] * (p[3] * p[5] - p[2] * p[4]) / (wheelbase * p[4] * p[5])
    vx = min(abs(vx), p[L.HIGH_SPEED])
    scheduled[WEIGHTS - 1] *= compiled_steering_rate_factor(vx, wheelbase, understeer)


@compiled
def bound_action(a: Float, delta: Float, constants: Array, action: Array) -> None:
    """Write an action, rounded to float32 and clipped to the action space."""
    low_a, low_delta = constants[L.SPACE_LOW_A], constants[L.SPACE_LOW_DELTA]
    high_a, high_delta = constants[L.SPACE_HIGH_A], constants[L.SPACE_HIGH_DELTA]
    action[0] = min(max(float(np.float32(a)), low_a), high_a)
    action[1] = min(max(float(np.float32(delta)), low_delta), high_delta)


@compiled
def control(
    first: int, observations: Array, weights: Array, constants: Array, plans: Array, flags: Array,
    stats: Array, states: Array, actions: Array, frictions: Array, stages: Array, lanes: Array,
) -> int:  # fmt: skip
    """Control some vehicles: fill their rows of `actions` (n, 2); returns how many solves failed.

    Observations (m, size) are those of rows first to first + m - 1 of all n. `weights` is (n, 12),
    or (1, 12) for all. `constants` to `frictions` are those of `NmpcArrays`; they are passed one by
    one because this is called from Python every control period. After a failure the last plan
    stays, a period older, and no longer warm-starts. `stages` and `lanes` are working space, and so
    are the tyres among the constants where friction is estimated.
    """
    n, failed = lanes.shape[1], 0
    estimated = constants[L.LEAST_FRICTION] < constants[L.MOST_FRICTION]
    for j in range(observations.shape[0]):
        row = first + j
        code = NOT_FINITE
        for k in range(STATS):
            stats[row, k] = 0.0
        stats[row, COST] = math.nan
        if is_finite(observations[j]):
            if estimated:
                estimate_friction(frictions[row], observations[j], constants)
            load_observation(observations[j], constants, stages, lanes)
            last_a = observations[j, entry.ACCELERATION]
            last_a = min(max(last_a, constants[L.LOW_A]), constants[L.HIGH_A])
            last_delta = observations[j, entry.STEERING_ANGLE]
            last_delta = min(max(last_delta, -constants[L.MAX_DELTA]), constants[L.MAX_DELTA])
            load_plan(plans[row], flags[row, WARM] > 0, last_a, last_delta, constants, stages)
            own = row if weights.shape[0] > 1 else 0
            # The last stage only has a state: its first entries hold the scheduled weights.
            vx = observations[j, entry.LONGITUDINAL_SPEED]
            schedule_weights(weights[own], vx, constants, stages[n])
            code = solve(stages, lanes, last_a, last_delta, stages[n], constants, stats[row])
        else:
            frictions[row, BEGUN] = 0.0
        stats[row, CODE] = code
        if code != SUCCESS:
            flags[row, WARM] = 0
            flags[row, AGE] += 1
            flags[row, FAILURES] += 1
            failed += 1
            continue
        for i in range(n):
            plans[row, i, 0], plans[row, i, 1] = stages[i, L.NOW_A], stages[i, L.NOW_DELTA]
        for i in range(n + 1):
            for k in range(6):
                states[row, i, k] = stages[i, L.NOW_VX + k]
        flags[row, WARM], flags[row, PLANNED] = 1, 1
        flags[row, AGE], flags[row, FAILURES] = 0, 0
        bound_action(stages[0, L.NOW_A], stages[0, L.NOW_DELTA], constants, actions[row])
    return failed


@compiled_parallel
def control_in_threads(
    chunks: int, observations: Array, weights: Array, constants: Array, plans: Array,
    flags: Array, stats: Array, states: Array, actions: Array, frictions: Array, stages: Array,
    lanes: Array, failed: Array,
) -> None:  # fmt: skip
    """`control` for all rows, in chunks that threads share; fills `failed` (chunks,).

    Each thread has its own constants, into which it writes its vehicles' tyres.
    """
    n = observations.shape[0]
    for chunk in numba.prange(chunks):
        first, last = chunk * n // chunks, (chunk + 1) * n // chunks
        failed[chunk] = control(
            first, observations[first:last], weights, constants.copy(), plans, flags, stats, states,
            actions, frictions, stages[chunk], lanes[chunk],
        )  # fmt: skip
