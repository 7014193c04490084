"""The NMPC's real-time iteration, compiled: one linearisation and one program a control period.

`solve` is the solver for one vehicle; `control` is the agent's step for rows of observations.
Diehl, Bock and Schloeder, "A real-time iteration scheme for nonlinear optimization in optimal
feedback control", SIAM J. Control Optim. 43, 2005; the plan is rolled out from the state as
measured, so it is feasible for the dynamics before every program.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.nmpc.linearisation import RECORD, SCRATCH, differentiate_along
from agents.nmpc.program import (
    HIGH_A,
    LIMITS_SIZE,
    LINEAR,
    LOW_A,
    MAX_DELTA,
    QUADRATIC,
    clamp,
)
from agents.nmpc.qp import OPTIMAL, OUT_OF_ITERATIONS, solve_qp, workspace_size
from agents.reference import NODE, fill_nodes
from lpv_track_env.bicycle import (
    PSI,
    VX,
    VY,
    YAW_RATE,
    X,
    Y,
)
from lpv_track_env.kernels import PREVIEW_START
from trajectories.compilation import compiled, compiled_in_place

Array = NDArray[Any]
Float = Any

# Numbers of a solver, (CONSTANTS_SIZE,): 7 of the model, then these, then the program's limits.
STEP, SUBSTEPS, PERIOD, SHIFT, TOLERANCE, SPACE_LOW, SPACE_HIGH, LIMITS = (
    7,
    8,
    9,
    10,
    11,
    12,
    14,
    16,
)
CONSTANTS_SIZE = LIMITS + LIMITS_SIZE

SUCCESS, MAXITER, NOT_FINITE, QP_FAILURE = range(4)
"""Codes of a solve, by `problem.Status`: SUCCESS, MAXITER, NAN, QP_FAILURE."""

# What is told of a solve, (TOLD,): code, interior-point iterations, programs, cost, largest slacks.
CODE, INNER, OUTER, COST, SLACK = 0, 1, 2, 3, 4
TOLD = 7

WARM, PLANNED, AGE, FAILURES = range(4)
"""Flags of a row, (FLAGS,): whether its plan warm-starts, is there at all, its age, failures."""
FLAGS = 4


@compiled
def space(n: int) -> int:
    """Length of the working space of `solve` for N = n."""
    return workspace_size(n) + RECORD * n + SCRATCH + 6 * (n + 1) + 2 * n


@compiled
def shift(plan: Array, share: Float) -> None:
    """Move a plan (N, 2) on in time by `share` of a period; its last input is held."""
    last = plan.shape[0] - 1
    for i in range(last):
        plan[i, 0] += share * (plan[i + 1, 0] - plan[i, 0])
        plan[i, 1] += share * (plan[i + 1, 1] - plan[i, 1])


@compiled
def cost_of(
    states: Array, inputs: Array, slack: Array, reference: Array, weights: Array, limits: Array
) -> Float:
    """Cost of the problem at states (N + 1, 6), inputs (N, 2) and slack (3, N)."""
    n = inputs.shape[0]
    total = 0.0
    for i in range(n + 1):
        offset = 4 if i == n else 0
        x, y = states[i], reference[i]
        e0, e1, e2, e3 = x[VX] - y[0], x[PSI] - y[1], x[X] - y[2], x[Y] - y[3]
        total += weights[offset] * e0 * e0 + weights[offset + 1] * e1 * e1
        total += weights[offset + 2] * e2 * e2 + weights[offset + 3] * e3 * e3
    for i in range(n):
        a, delta = inputs[i, 0], inputs[i, 1]
        total += weights[8] * a * a + weights[9] * delta * delta
        for soft in range(3):
            s = slack[soft, i]
            total += s * (2.0 * limits[LINEAR + soft] + limits[QUADRATIC + soft] * s)
    return 0.5 * total


@compiled
def iterate(
    state: Array, last: Array, reference: Array, weights: Array, constants: Array, plan: Array,
    states: Array, inputs: Array, slack: Array, told: Array, work: Array,
) -> int:  # fmt: skip
    """Linearise along `plan` (N, 2), rolled out from `state` (6,), and solve the program.

    Fills the solution: states (N + 1, 6), inputs (N, 2), slack (3, N). Adds to `told`.
    """
    n = plan.shape[0]
    at = workspace_size(n)
    inner = work[:at]
    records = work[at : at + RECORD * n].reshape(n, RECORD)
    at += RECORD * n
    scratch = work[at : at + SCRATCH]
    at += SCRATCH
    base = work[at : at + 6 * (n + 1)].reshape(n + 1, 6)
    for k in range(6):
        base[0, k] = state[k]
    differentiate_along(
        plan, constants, constants[STEP], int(constants[SUBSTEPS]), base, records, scratch
    )
    code, steps = solve_qp(
        records, base, plan, last, reference, weights, constants[LIMITS:], constants[TOLERANCE],
        states, inputs, slack, inner,
    )  # fmt: skip
    told[INNER] += steps
    told[OUTER] += 1.0
    if code == OPTIMAL:
        return SUCCESS
    return MAXITER if code == OUT_OF_ITERATIONS else QP_FAILURE


@compiled
def solve(
    state: Array, last: Array, reference: Array, weights: Array, constants: Array, plan: Array,
    states: Array, slack: Array, told: Array, work: Array,
) -> int:  # fmt: skip
    """One real-time iteration: improve `plan` (N, 2) in place.

    `state` (6,), `last` (2,) the input in force, reference (N + 1, >= 4), weights (10,). Fills
    states (N + 1, 6) and slack (3, N) with the program's prediction and `told` (TOLD,). Returns the
    code; on any but SUCCESS the plan is not to be used.
    """
    n = plan.shape[0]
    inputs = work[: 2 * n].reshape(n, 2)
    told[INNER], told[OUTER], told[COST] = 0.0, 0.0, math.nan
    told[SLACK] = told[SLACK + 1] = told[SLACK + 2] = 0.0
    clamp(plan, last, constants[LIMITS:])
    code = iterate(
        state, last, reference, weights, constants, plan, states, inputs, slack, told, work[2 * n :]
    )
    told[CODE] = code
    if code != SUCCESS:
        return code
    for i in range(n):
        plan[i, 0], plan[i, 1] = inputs[i, 0], inputs[i, 1]
        for soft in range(3):
            told[SLACK + soft] = max(told[SLACK + soft], slack[soft, i])
    told[COST] = cost_of(states, plan, slack, reference, weights, constants[LIMITS:])
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
    at += 2 * n
    slack = work[at : at + 3 * n].reshape(3, n)
    code = NOT_FINITE
    if situation(observation, constants, state, last, reference):
        for i in range(n):
            if flags[WARM] > 0:
                trial[i, 0], trial[i, 1] = plan[i, 0], plan[i, 1]
            else:
                trial[i, 0], trial[i, 1] = last[0], last[1]
        if flags[WARM] > 0:
            shift(trial, constants[SHIFT])
        code = solve(state, last, reference, weights, constants, trial, states, slack, told, work)
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
    bound_action(plan[0, 0], plan[0, 1], constants, action)
    return code


@compiled
def bound_action(a: Float, delta: Float, constants: Array, action: Array) -> None:
    """Write an action as it is handed out: of float32's precision, within the action space."""
    low_a, low_delta = constants[SPACE_LOW], constants[SPACE_LOW + 1]
    high_a, high_delta = constants[SPACE_HIGH], constants[SPACE_HIGH + 1]
    action[0] = min(max(float(np.float32(a)), low_a), high_a)
    action[1] = min(max(float(np.float32(delta)), low_delta), high_delta)


@compiled
def room(n: int) -> int:
    """Length of the working space of `control_row` for N = n."""
    return space(n) + 8 + NODE * (n + 1) + 5 * n


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
