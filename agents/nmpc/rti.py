"""The NMPC's real-time iteration, compiled: one linearisation and one program a control period.

`solve` is the whole solver for one vehicle; `control` is the agent's step for rows of observations.
Diehl, Bock and Schloeder, "A real-time iteration scheme for nonlinear optimization in optimal
feedback control", SIAM J. Control Optim. 43, 2005; the plan is rolled out from the state as
measured, so it is feasible for the dynamics before every program.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc.interior_point import (
    HIGH_A,
    HIGH_RATE,
    HIGH_SPEED,
    LIMITS_SIZE,
    LINEAR,
    LOW_A,
    LOW_RATE,
    LOW_SPEED,
    MAX_DELTA,
    OPTIMAL,
    OUT_OF_ITERATIONS,
    QUADRATIC,
    RATIO,
    clamp,
    solve_qp,
    workspace_size,
)
from agents.nmpc.linearisation import RECORD, SCRATCH, differentiate_along, roll_out
from agents.reference import NODE, fill_nodes
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
from lpv_track_env.kernels import PREVIEW_START
from trajectories.compilation import compiled, compiled_in_place

Array = NDArray[Any]
Float = Any

# Numbers of a solver, (CONSTANTS_SIZE,): 7 of the model, then these, then the program's limits.
STEP, SUBSTEPS, PERIOD, SHIFT, TOLERANCE, ITERATIONS, LIMITS = 7, 8, 9, 10, 11, 12, 13
CONSTANTS_SIZE = LIMITS + LIMITS_SIZE

SUCCESS, MAXITER, NOT_FINITE, QP_FAILURE = range(4)
"""Codes of a solve, by `problem.Status`: SUCCESS, MAXITER, NAN, QP_FAILURE."""

# What is told of a solve, (TOLD,): code, interior-point iterations, programs, cost, largest slacks.
CODE, INNER, OUTER, COST, SLACK = 0, 1, 2, 3, 4
TOLD = 7

WARM, PLANNED, AGE, FAILURES = range(4)
"""Flags of a row, (FLAGS,): whether its plan warm-starts, is there at all, its age, failures."""
FLAGS = 4

STEP_TOLERANCE = 1e-10
"""Largest change of an input at which an iterated solve has converged."""
ARMIJO = 1e-4
SHORTEST_STEP = 1e-6


@compiled
def space(n: int) -> int:
    """Length of the working space of `solve` for N = n."""
    return workspace_size(n) + RECORD * n + SCRATCH + 6 * (n + 1) + 4 * n + 3 * n


@compiled
def shift(plan: Array, share: Float) -> None:
    """Move a plan (N, 2) on in time by `share` of a period; its last input is held."""
    last = plan.shape[0] - 1
    for i in range(last):
        plan[i, 0] += share * (plan[i + 1, 0] - plan[i, 0])
        plan[i, 1] += share * (plan[i + 1, 1] - plan[i, 1])


@compiled
def evaluate(
    states: Array, inputs: Array, reference: Array, weights: Array, constants: Array
) -> Float:
    """Cost of the problem for inputs (N, 2) and their states (N + 1, 6), penalties included."""
    n, p, limits = inputs.shape[0], constants, constants[LIMITS:]
    total = 0.0
    for i in range(n + 1):
        offset = 4 if i == n else 0
        x, y = states[i], reference[i]
        e0, e1, e2, e3 = x[VX] - y[0], x[PSI] - y[1], x[X] - y[2], x[Y] - y[3]
        total += 0.5 * (
            weights[offset] * e0 * e0
            + weights[offset + 1] * e1 * e1
            + weights[offset + 2] * e2 * e2
            + weights[offset + 3] * e3 * e3
        )
    for i in range(n):
        a, delta, x = inputs[i, 0], inputs[i, 1], states[i]
        total += 0.5 * (weights[8] * a * a + weights[9] * delta * delta)
        rate = compiled_field(
            x[VX], x[VY], x[YAW_RATE], 1.0, 0.0, a, delta, math.cos(delta), math.sin(delta),
            compiled_inverse_speed(x[VX]), p[0], p[1], p[2], p[3], p[4], p[5], p[6],
        )[0]  # fmt: skip
        vx, vy = states[i + 1, VX], states[i + 1, VY]
        total += _penalty(max(limits[LOW_SPEED] - vx, vx - limits[HIGH_SPEED]), 0, limits)
        total += _penalty(max(limits[LOW_RATE] - rate, rate - limits[HIGH_RATE]), 1, limits)
        total += _penalty(abs(vy) - limits[RATIO] * vx, 2, limits)
    return total


@compiled
def _penalty(excess: Float, soft: int, limits: Array) -> Float:
    slack = max(excess, 0.0)
    return slack * (limits[LINEAR + soft] + 0.5 * limits[QUADRATIC + soft] * slack)


@compiled_in_place
def solve(
    state: Array, last: Array, reference: Array, weights: Array, constants: Array, plan: Array,
    states: Array, told: Array, work: Array,
) -> int:  # fmt: skip
    """Improve `plan` (N, 2) for a state (6,) and the input in force `last` (2,), in place.

    One real-time iteration takes the program's solution as it is. With more than one (the
    constants' ITERATIONS), steps are shortened until the exact cost falls, and iterations end once
    the plan no longer changes. Fills states (N + 1, 6) with the prediction and `told` (TOLD,).
    Returns the code; on any but SUCCESS the plan is not to be used.
    """
    n = plan.shape[0]
    limits = constants[LIMITS:]
    h, substeps = constants[STEP], int(constants[SUBSTEPS])
    at = workspace_size(n)
    inner = work[:at]
    records = work[at : at + RECORD * n].reshape(n, RECORD)
    at += RECORD * n
    scratch = work[at : at + SCRATCH]
    at += SCRATCH
    base = work[at : at + 6 * (n + 1)].reshape(n + 1, 6)
    at += 6 * (n + 1)
    inputs = work[at : at + 2 * n].reshape(n, 2)
    at += 2 * n
    trial = work[at : at + 2 * n].reshape(n, 2)
    at += 2 * n
    slack = work[at : at + 3 * n].reshape(3, n)
    told[INNER], told[OUTER], told[COST] = 0.0, 0.0, math.nan
    told[SLACK] = told[SLACK + 1] = told[SLACK + 2] = 0.0

    clamp(plan, last, limits)
    for k in range(6):
        base[0, k] = state[k]
    iterations = int(constants[ITERATIONS])
    cost = math.inf
    for iteration in range(iterations):
        differentiate_along(plan, constants, h, substeps, base, records, scratch)
        code, steps = solve_qp(
            records, base, plan, last, reference, weights, limits, constants[TOLERANCE], states,
            inputs, slack, inner,
        )  # fmt: skip
        told[INNER] += steps
        told[OUTER] += 1.0
        if code == OUT_OF_ITERATIONS:
            return _finish(told, MAXITER)
        if code != OPTIMAL:
            return _finish(told, QP_FAILURE)
        if iterations == 1:
            for i in range(n):
                plan[i, 0], plan[i, 1] = inputs[i, 0], inputs[i, 1]
            break
        largest = 0.0
        for i in range(n):
            largest = max(largest, abs(inputs[i, 0] - plan[i, 0]), abs(inputs[i, 1] - plan[i, 1]))
        # Length 0 first, for the cost of the plan as it stands.
        length, found = 0.0 if iteration == 0 else 1.0, math.inf
        while True:
            for i in range(n):
                trial[i, 0] = plan[i, 0] + length * (inputs[i, 0] - plan[i, 0])
                trial[i, 1] = plan[i, 1] + length * (inputs[i, 1] - plan[i, 1])
            roll_out(trial, constants, h, substeps, states)
            found = evaluate(states, trial, reference, weights, constants)
            if length == 0.0:
                cost, length = found, 1.0
                continue
            if found <= cost or length < SHORTEST_STEP:
                break
            length *= 0.5
        if found <= cost:
            cost = found
            for i in range(n):
                plan[i, 0], plan[i, 1] = trial[i, 0], trial[i, 1]
        if largest <= STEP_TOLERANCE or not found <= cost:
            break
    for soft in range(3):
        for i in range(n):
            told[SLACK + soft] = max(told[SLACK + soft], slack[soft, i])
    if iterations == 1:
        cost = evaluate(states, plan, reference, weights, constants)
    told[COST] = cost
    return _finish(told, SUCCESS if math.isfinite(cost) else NOT_FINITE)


@compiled
def _finish(told: Array, code: int) -> int:
    told[CODE] = code
    return code


@compiled
def situation(
    observation: Array, constants: Array, state: Array, last: Array, reference: Array
) -> bool:
    """Take an observation apart into the problem's parameters, in the frame of the foot point.

    Returns whether the observation is finite; only then they are filled.
    """
    total = 0.0
    for k in range(observation.shape[0]):
        total += abs(observation[k])
    if not math.isfinite(total):
        return False
    state[VX], state[VY], state[PSI] = observation[0], observation[1], observation[6]
    state[YAW_RATE], state[X], state[Y] = observation[2], 0.0, observation[5]
    limits = constants[LIMITS:]
    last[0] = min(max(observation[3], limits[LOW_A]), limits[HIGH_A])
    last[1] = min(max(observation[4], -limits[MAX_DELTA]), limits[MAX_DELTA])
    steps = (observation.shape[0] - PREVIEW_START) // 2
    fill_nodes(
        observation[PREVIEW_START : PREVIEW_START + steps], observation[7],
        observation[PREVIEW_START + steps :], constants[PERIOD], reference,
    )  # fmt: skip
    return True


@compiled_in_place
def control_row(
    observation: Array, weights: Array, constants: Array, plan: Array, flags: Array, told: Array,
    states: Array, action: Array, work: Array,
) -> int:  # fmt: skip
    """Control one vehicle: fill its action (2,), or return the code of a failed solve.

    `plan` (N, 2), `flags` (FLAGS,), `told` (TOLD,) and `states` (N + 1, 6) are what is remembered
    of it. After a failure the last plan stands, a period older, and no longer warm-starts.
    """
    n = plan.shape[0]
    at = space(n)
    state, last = work[at : at + 6], work[at + 6 : at + 8]
    at += 8
    reference = work[at : at + NODE * (n + 1)].reshape(n + 1, NODE)
    at += NODE * (n + 1)
    trial = work[at : at + 2 * n].reshape(n, 2)
    code = NOT_FINITE
    if situation(observation, constants, state, last, reference):
        for i in range(n):
            if flags[WARM] > 0:
                trial[i, 0], trial[i, 1] = plan[i, 0], plan[i, 1]
            else:
                trial[i, 0], trial[i, 1] = last[0], last[1]
        if flags[WARM] > 0:
            shift(trial, constants[SHIFT])
        code = solve(state, last, reference, weights, constants, trial, states, told, work)
    else:
        told[CODE], told[INNER], told[OUTER], told[COST] = NOT_FINITE, 0.0, 0.0, math.nan
        told[SLACK] = told[SLACK + 1] = told[SLACK + 2] = 0.0
    if code != SUCCESS:
        flags[WARM] = 0
        flags[AGE] += 1
        flags[FAILURES] += 1
        return code
    for i in range(n):
        plan[i, 0], plan[i, 1] = trial[i, 0], trial[i, 1]
    flags[WARM], flags[PLANNED], flags[AGE], flags[FAILURES] = 1, 1, 0, 0
    action[0], action[1] = plan[0, 0], plan[0, 1]
    return code


@compiled
def room(n: int) -> int:
    """Length of the working space of `control_row` for N = n."""
    return space(n) + 8 + NODE * (n + 1) + 2 * n


@compiled
def control(
    observations: Array, weights: Array, constants: Array, plans: Array, flags: Array, told: Array,
    states: Array, actions: Array, work: Array,
) -> int:  # fmt: skip
    """Control a batch of rows; returns how many solves failed.

    `observations` (n, size), `weights` (n, 10) or (1, 10) for all, `actions` (n, 2).
    """
    failed = 0
    for k in range(observations.shape[0]):
        own = k if weights.shape[0] > 1 else 0
        code = control_row(
            observations[k], weights[own], constants, plans[k], flags[k], told[k], states[k],
            actions[k], work,
        )  # fmt: skip
        if code != SUCCESS:
            failed += 1
    return failed
