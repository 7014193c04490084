"""The NMPC's quadratic program, compiled: guesses first, the interior-point method if they fail.

The program is the problem linearised along a plan. A few guesses are made about which inequalities
bind (`active_set`); most programs end there, exact to rounding. The others go on with
`interior_point`, and from what it has found, a guess is made again: where that stands, the solution
is exact too. Arrays are those of `layout`.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import riccati
from agents.nmpc.active_set import (
    HELD,
    guess,
    hold,
    identify,
    measure_gaps,
    recall,
    revise,
    take_slacks,
)
from agents.nmpc.interior_point import START_BARRIER, centre, expand, press, start, update, weigh
from agents.nmpc.layout import (
    CHANGE_A,
    CHANGE_DELTA,
    FIRST_CHANGE_A,
    FIRST_CHANGE_DELTA,
    HIGH_A,
    KEPT,
    LOW_A,
    MAX_DELTA,
    NOW_A,
    NOW_DELTA,
    NOW_PSI,
    NOW_R,
    NOW_VX,
    NOW_VY,
    NOW_X,
    NOW_Y,
    PLAN_A,
    PLAN_DELTA,
    PLAN_PSI,
    PLAN_R,
    PLAN_VX,
    PLAN_VY,
    PLAN_X,
    PLAN_Y,
    POINT,
    STEP_A,
    STEP_DELTA,
    STEP_X,
    TOLERANCE,
)
from agents.nmpc.linearisation import HEADING_X, HEADING_Y
from trajectories.compilation import compiled_in_place, compiled_internal

Array = NDArray[Any]
Float = Any

SUCCESS, MAXITER, NOT_FINITE, QP_FAILURE = range(4)
"""Codes of a solve, by `problem.Status`: SUCCESS, MAXITER, NAN, QP_FAILURE."""

# What is told of a solve, (TOLD,): code, iterations in programs, programs, cost, largest slacks.
CODE, INNER, OUTER, COST, SLACK = 0, 1, 2, 3, 4
TOLD = 7

GUESSING, PREDICTING, CORRECTING = 0, 1, 2
"""Phases: guesses, then predictor and corrector in turns."""
MAX_GUESSES, MAX_CROSSINGS = 6, 4
"""Turns of guesses, at first and from what the interior-point method has found."""
HOPEFUL = 8
"""Places in which a guess may be mended; in more than that, only while they get fewer."""
MAX_ITERATIONS = 40
CROSSING, NEXT_CROSSING = 1e-6, 1e-3
"""Mean product t lam at which guesses are tried again, and its factor for each further time."""
CAUTION, LEAST_CAUTION = 0.995, 0.9999
"""Share of the way to the nearest bound, at first and near the solution."""
ACCEPTABLE = 1e-6
"""Mean product at which rounding may end the iterations."""


@compiled_internal
def clamp(stages: Array, at: int, last_a: Float, last_delta: Float, constants: Array) -> None:
    """Bring the inputs of a point (from column `at` on) within bounds and rates, first to last."""
    before_a, before_delta = last_a, last_delta
    most_a, most_delta = constants[FIRST_CHANGE_A], constants[FIRST_CHANGE_DELTA]
    for i in range(stages.shape[0] - 1):
        e = stages[i]
        a = min(max(e[at], before_a - most_a), before_a + most_a)
        delta = min(max(e[at + 1], before_delta - most_delta), before_delta + most_delta)
        before_a = min(max(a, constants[LOW_A]), constants[HIGH_A])
        before_delta = min(max(delta, -constants[MAX_DELTA]), constants[MAX_DELTA])
        e[at], e[at + 1] = before_a, before_delta
        most_a, most_delta = constants[CHANGE_A], constants[CHANGE_DELTA]


@compiled_internal
def follow(stages: Array) -> None:
    """Fill the states of the solution so far by the linearised model under its inputs."""
    for k in range(2, POINT):
        stages[0, NOW_A + k] = stages[0, PLAN_A + k]
    for i in range(stages.shape[0] - 1):
        e, f = stages[i], stages[i + 1]
        da, ddelta = e[NOW_A] - e[PLAN_A], e[NOW_DELTA] - e[PLAN_DELTA]
        dvx, dvy = e[NOW_VX] - e[PLAN_VX], e[NOW_VY] - e[PLAN_VY]
        turn, dr = e[NOW_PSI] - e[PLAN_PSI], e[NOW_R] - e[PLAN_R]
        for k in range(6):
            f[NOW_VX + k] = f[PLAN_VX + k] + riccati.moved(e, k, dvx, dvy, dr, da, ddelta)
        f[NOW_PSI] += turn
        f[NOW_X] += e[HEADING_X] * turn + (e[NOW_X] - e[PLAN_X])
        f[NOW_Y] += e[HEADING_Y] * turn + (e[NOW_Y] - e[PLAN_Y])


@compiled_internal
def copy_point(stages: Array, to: int, at: int) -> None:
    """Copy a point of all stages, from column `at` on."""
    for i in range(stages.shape[0]):
        for k in range(POINT):
            stages[i, to + k] = stages[i, at + k]


@compiled_internal
def move_by_step(stages: Array, length: Float) -> None:
    """Move the solution so far by `length` times the step."""
    for i in range(stages.shape[0]):
        for k in range(POINT):
            stages[i, NOW_A + k] += length * stages[i, STEP_A + k]


@compiled_in_place
def solve_program(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array,
    constants: Array, told: Array,
) -> int:  # fmt: skip
    """Solve the program linearised along the plan of `stages`, by their records.

    (last_a, last_delta) is the input in force, `weights` (10,) are Q, S, R. The solution is the
    stages' NOW and, in the lanes, the slacks. Returns a code; adds to `told` (TOLD,).
    """
    n = lanes.shape[1]
    copy_point(stages, NOW_A, PLAN_A)
    measure_gaps(stages, lanes, last_a, last_delta, constants)
    guess(lanes)
    mu, worst, share, tolerance = START_BARRIER, 0.0, 1.0, constants[TOLERANCE]
    phase, tries, most, iterations = GUESSING, 0, MAX_GUESSES, 0
    code, changed, before, inside, crossing = QP_FAILURE, 1, 0, False, CROSSING
    # All methods take turns through one loop: each part is called from one place only, which
    # halves the time that compiling takes.
    while True:
        if phase == GUESSING:
            hold(lanes, constants)
        else:
            if phase == PREDICTING:
                largest = max(mu, share * worst)
                if largest <= tolerance:
                    code = SUCCESS
                    break
                if iterations >= MAX_ITERATIONS:
                    code = SUCCESS if largest <= ACCEPTABLE else MAXITER
                    break
                weigh(lanes, constants)
            press(lanes, constants, share)
        if phase == PREDICTING or (phase == GUESSING and changed > 0):
            riccati.factor(stages, lanes, weights, constants)
        riccati.solve(stages, lanes, weights, constants)
        length = 1.0
        if phase != GUESSING:
            length = expand(stages, lanes, constants, share)
        if phase == PREDICTING:
            centre(lanes, min(1.0, length), mu)
            phase = CORRECTING
            continue
        total = 0.0
        for i in range(n):
            total += stages[i, STEP_A] + stages[i, STEP_DELTA] + stages[i + 1, STEP_X]
        finite = math.isfinite(total)
        if phase == CORRECTING:
            if not finite:
                code = SUCCESS if max(mu, share * worst) <= ACCEPTABLE else QP_FAILURE
                break
            length = min(1.0, max(CAUTION, min(1.0 - mu, LEAST_CAUTION)) * length)
            mu = update(lanes, length)
            share *= 1.0 - length
        if finite:
            move_by_step(stages, length)
        iterations += 1
        near = max(mu, share * worst) <= crossing or iterations >= MAX_ITERATIONS
        if phase == GUESSING or near:
            measure_gaps(stages, lanes, last_a, last_delta, constants)
        if phase == CORRECTING:
            phase = PREDICTING
            if near:
                # From inside to the edge: which bind can be told by now.
                copy_point(stages, KEPT, NOW_A)
                identify(lanes)
                phase, tries, most, changed = GUESSING, 0, MAX_CROSSINGS, 1
                crossing *= NEXT_CROSSING
            continue
        tries += 1
        off = math.inf
        if finite:
            before = changed
            changed, off = revise(lanes, constants)
        if changed == 0 and off <= HELD:
            take_slacks(lanes)
            code = SUCCESS
            break
        if tries < most and finite and (tries < 2 or changed <= max(before, HOPEFUL)):
            continue
        phase = PREDICTING
        if inside:
            copy_point(stages, NOW_A, KEPT)
            recall(lanes)
        else:
            # Start the interior-point method where all inputs keep their limits.
            inside = True
            clamp(stages, NOW_A, last_a, last_delta, constants)
            follow(stages)
            measure_gaps(stages, lanes, last_a, last_delta, constants)
            worst = start(lanes, constants)
    clamp(stages, NOW_A, last_a, last_delta, constants)
    told[INNER] += iterations
    told[OUTER] += 1.0
    return code
