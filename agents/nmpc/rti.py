"""The NMPC's real-time iteration, compiled: one linearisation and one program a control period.

`solve` is the solver for one vehicle; `control` is the agent's step for rows of observations.
Diehl, Bock and Schloeder, "A real-time iteration scheme for nonlinear optimization in optimal
feedback control", SIAM J. Control Optim. 43, 2005; the plan is rolled out from the state as
measured, so it is feasible for the dynamics before every program.
"""

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from agents.nmpc.layout import (
    HIGH_A,
    LINEAR,
    LOW_A,
    MAX_DELTA,
    NOW_A,
    NOW_DELTA,
    NOW_PSI,
    NOW_VX,
    NOW_X,
    NOW_Y,
    PERIOD,
    PLAN_A,
    PLAN_DELTA,
    PLAN_PSI,
    PLAN_R,
    PLAN_VX,
    PLAN_VY,
    PLAN_X,
    PLAN_Y,
    QUADRATIC,
    REFERENCE,
    REFERENCE_HEADING,
    REFERENCE_X,
    REFERENCE_Y,
    SHIFT,
    SLACKS,
    SPACE_HIGH_A,
    SPACE_HIGH_DELTA,
    SPACE_LOW_A,
    SPACE_LOW_DELTA,
)
from agents.nmpc.linearisation import differentiate
from agents.nmpc.qp import (
    CODE,
    COST,
    INNER,
    NOT_FINITE,
    OUTER,
    SLACK,
    SUCCESS,
    TOLD,
    clamp,
    solve_program,
)
from agents.reference import NODE, fill_nodes
from lpv_track_env.observation import PREVIEW_START
from trajectories.compilation import (
    compiled,
    compiled_in_place,
    compiled_internal,
    compiled_parallel,
)

Array = NDArray[Any]
Float = Any

WARM, PLANNED, AGE, FAILURES = range(4)
"""Flags of a row, (FLAGS,): whether its plan warm-starts, is there at all, its age, failures."""
FLAGS = 4


@compiled_internal
def cost_of(stages: Array, lanes: Array, at: int, weights: Array, constants: Array) -> Float:
    """Cost of the problem at a point of the stages (from column `at` on) and the slacks."""
    n = lanes.shape[1]
    vx, psi, x, y = (
        at + NOW_VX - NOW_A,
        at + NOW_PSI - NOW_A,
        at + NOW_X - NOW_A,
        at + NOW_Y - NOW_A,
    )
    total = 0.0
    for i in range(n + 1):
        offset, e = 4 if i == n else 0, stages[i]
        e0, e1 = e[vx] - e[REFERENCE], e[psi] - e[REFERENCE_HEADING]
        e2, e3 = e[x] - e[REFERENCE_X], e[y] - e[REFERENCE_Y]
        total += weights[offset] * e0 * e0 + weights[offset + 1] * e1 * e1
        total += weights[offset + 2] * e2 * e2 + weights[offset + 3] * e3 * e3
    for i in range(n):
        a, delta = stages[i, at], stages[i, at + 1]
        total += weights[8] * a * a + weights[9] * delta * delta
        for soft in range(3):
            s = lanes[SLACKS[soft], i]
            total += s * (2.0 * constants[LINEAR + soft] + constants[QUADRATIC + soft] * s)
    return 0.5 * total


@compiled_in_place
def solve(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array,
    constants: Array, told: Array,
) -> int:  # fmt: skip
    """One real-time iteration on the plan, its first state and the reference in `stages`.

    (last_a, last_delta) is the input in force, weights (10,). The improved plan is the stages' NOW;
    fills `told` (TOLD,). Returns the code; on any but SUCCESS there is nothing to be used.
    """
    told[INNER] = told[OUTER] = 0.0
    clamp(stages, PLAN_A, last_a, last_delta, constants)
    for i in range(lanes.shape[1]):
        differentiate(stages[i], constants, stages[i + 1])
    code = solve_program(stages, lanes, last_a, last_delta, weights, constants, told)
    told[COST] = cost_of(stages, lanes, NOW_A, weights, constants) if code == SUCCESS else math.nan
    for soft in range(3):
        largest = 0.0
        if code == SUCCESS:
            for i in range(lanes.shape[1]):
                largest = max(largest, lanes[SLACKS[soft], i])
        told[SLACK + soft] = largest
    return code


@compiled_internal
def situate(observation: Array, constants: Array, stages: Array) -> bool:
    """Take an observation apart: first state and reference, in the foot point's frame.

    Returns whether the observation is finite; only then it does.
    """
    total = 0.0
    for k in range(observation.shape[0]):
        total += abs(observation[k])
    if not math.isfinite(total):
        return False
    e = stages[0]
    e[PLAN_VX], e[PLAN_VY], e[PLAN_PSI] = observation[0], observation[1], observation[6]
    e[PLAN_R], e[PLAN_X], e[PLAN_Y] = observation[2], 0.0, observation[5]
    steps = (observation.shape[0] - PREVIEW_START) // 2
    fill_nodes(
        observation[PREVIEW_START : PREVIEW_START + steps], observation[7],
        observation[PREVIEW_START + steps :], constants[PERIOD],
        stages[:, REFERENCE : REFERENCE + NODE],
    )  # fmt: skip
    return True


@compiled
def bound_action(a: Float, delta: Float, constants: Array, action: Array) -> None:
    """Write an action as it is handed out: of float32's precision, within the action space."""
    low_a, low_delta = constants[SPACE_LOW_A], constants[SPACE_LOW_DELTA]
    high_a, high_delta = constants[SPACE_HIGH_A], constants[SPACE_HIGH_DELTA]
    action[0] = min(max(float(np.float32(a)), low_a), high_a)
    action[1] = min(max(float(np.float32(delta)), low_delta), high_delta)


@compiled
def control(
    first: int, observations: Array, weights: Array, constants: Array, plans: Array, flags: Array,
    told: Array, states: Array, actions: Array, stages: Array, lanes: Array,
) -> int:  # fmt: skip
    """Control some vehicles: fill their rows of `actions` (n, 2); returns how many solves failed.

    Observations (m, size) are of rows first to first + m - 1 of all n. `weights` is (n, 10), or
    (1, 10) for all; `plans` (n, N, 2), `flags` (n, FLAGS), `told` (n, TOLD) and `states`
    (n, N + 1, 6) are what is remembered. After a failure the last plan stands, a period older, and
    no longer warm-starts. `stages` and `lanes` are working space.
    """
    n, failed = lanes.shape[1], 0
    for j in range(observations.shape[0]):
        row = first + j
        code = NOT_FINITE
        for k in range(TOLD):
            told[row, k] = 0.0
        told[row, COST] = math.nan
        if situate(observations[j], constants, stages):
            last_a = min(max(observations[j, 3], constants[LOW_A]), constants[HIGH_A])
            last_delta = observations[j, 4]
            last_delta = min(max(last_delta, -constants[MAX_DELTA]), constants[MAX_DELTA])
            for i in range(n):
                a, delta = last_a, last_delta
                if flags[row, WARM] > 0:
                    # A share of a period on in time; the last input is held.
                    ahead = min(i + 1, n - 1)
                    a, delta = plans[row, i, 0], plans[row, i, 1]
                    a += constants[SHIFT] * (plans[row, ahead, 0] - a)
                    delta += constants[SHIFT] * (plans[row, ahead, 1] - delta)
                stages[i, PLAN_A], stages[i, PLAN_DELTA] = a, delta
            own = row if weights.shape[0] > 1 else 0
            code = solve(stages, lanes, last_a, last_delta, weights[own], constants, told[row])
        told[row, CODE] = code
        if code != SUCCESS:
            flags[row, WARM] = 0
            flags[row, AGE] += 1
            flags[row, FAILURES] += 1
            failed += 1
            continue
        for i in range(n):
            plans[row, i, 0], plans[row, i, 1] = stages[i, NOW_A], stages[i, NOW_DELTA]
        for i in range(n + 1):
            for k in range(6):
                states[row, i, k] = stages[i, NOW_VX + k]
        flags[row, WARM], flags[row, PLANNED] = 1, 1
        flags[row, AGE], flags[row, FAILURES] = 0, 0
        bound_action(stages[0, NOW_A], stages[0, NOW_DELTA], constants, actions[row])
    return failed


@compiled_parallel
def control_in_threads(
    chunks: int, observations: Array, weights: Array, constants: Array, plans: Array,
    flags: Array, told: Array, states: Array, actions: Array, stages: Array, lanes: Array,
    failed: Array,
) -> None:  # fmt: skip
    """`control` of all rows, in chunks that threads share; `failed` (chunks,) gets its results."""
    n = observations.shape[0]
    for chunk in numba.prange(chunks):
        first, last = chunk * n // chunks, (chunk + 1) * n // chunks
        failed[chunk] = control(
            first, observations[first:last], weights, constants, plans, flags, told, states,
            actions, stages[chunk], lanes[chunk],
        )  # fmt: skip
