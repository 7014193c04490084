"""Solver of the NMPC's quadratic program (QP), compiled: active-set guesses, then interior point.

The QP is the problem linearised along a plan. The solver first guesses the active set a few times
(`active_set`); most QPs are solved that way, exact to rounding. The others go on with
`interior_point`, whose result leads to further guesses of the active set: if one of them is
consistent, the solution is exact too. All arrays are described in `layout`.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import layout as L
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
from agents.nmpc.linearisation import HEADING_X, HEADING_Y
from trajectories.compilation import compiled_in_place, compiled_internal

Array = NDArray[Any]
Float = Any

SUCCESS, MAXITER, NOT_FINITE, QP_FAILURE = range(4)
"""Codes of a solve, by `problem.Status`: SUCCESS, MAXITER, NAN, QP_FAILURE."""

# Statistics of a solve, (STATS,): code, iterations in QPs, QPs, cost, first of the largest slacks.
CODE, INNER, OUTER, COST, SLACK = 0, 1, 2, 3, 4
STATS = 7

# Phases of the solver: active-set guesses, then predictor and corrector in turns.
GUESSING, PREDICTING, CORRECTING = 0, 1, 2
MAX_GUESSES = 6
"""Guesses of the active set at the start."""
MAX_CROSSINGS = 4
"""Guesses of the active set from a result of the interior-point method."""
HOPEFUL = 8
"""Changes of the active set up to which guessing goes on; beyond, only while they get fewer."""
MAX_ITERATIONS = 40
CROSSING = 1e-6
"""Mean product t lam at which the active set is guessed again."""
NEXT_CROSSING = 1e-3
"""Factor of `CROSSING` for each further time."""
CAUTION, LEAST_CAUTION = 0.995, 0.9999  # share of the way to the bound: at first, near the solution
ACCEPTABLE = 1e-6
"""Mean product t lam that counts as solved where rounding ends the iterations."""


@compiled_internal
def clamp(stages: Array, at: int, last_a: Float, last_delta: Float, constants: Array) -> None:
    """Bring the inputs of a point (from column `at` on) within bounds and rates, first to last."""
    before_a, before_delta = last_a, last_delta
    most_a, most_delta = constants[L.FIRST_CHANGE_A], constants[L.FIRST_CHANGE_DELTA]
    for i in range(stages.shape[0] - 1):
        e = stages[i]
        a = min(max(e[at], before_a - most_a), before_a + most_a)
        delta = min(max(e[at + 1], before_delta - most_delta), before_delta + most_delta)
        before_a = min(max(a, constants[L.LOW_A]), constants[L.HIGH_A])
        before_delta = min(max(delta, -constants[L.MAX_DELTA]), constants[L.MAX_DELTA])
        e[at], e[at + 1] = before_a, before_delta
        most_a, most_delta = constants[L.CHANGE_A], constants[L.CHANGE_DELTA]


@compiled_internal
def follow(stages: Array) -> None:
    """Fill the states of the solution so far by simulating the linearised model."""
    for k in range(2, L.POINT):
        stages[0, L.NOW_A + k] = stages[0, L.PLAN_A + k]
    for i in range(stages.shape[0] - 1):
        e, f = stages[i], stages[i + 1]
        da, ddelta = e[L.NOW_A] - e[L.PLAN_A], e[L.NOW_DELTA] - e[L.PLAN_DELTA]
        dvx, dvy = e[L.NOW_VX] - e[L.PLAN_VX], e[L.NOW_VY] - e[L.PLAN_VY]
        turn, dr = e[L.NOW_PSI] - e[L.PLAN_PSI], e[L.NOW_R] - e[L.PLAN_R]
        for k in range(6):
            f[L.NOW_VX + k] = f[L.PLAN_VX + k] + riccati.moved(e, k, dvx, dvy, dr, da, ddelta)
        f[L.NOW_PSI] += turn
        f[L.NOW_X] += e[HEADING_X] * turn + (e[L.NOW_X] - e[L.PLAN_X])
        f[L.NOW_Y] += e[HEADING_Y] * turn + (e[L.NOW_Y] - e[L.PLAN_Y])


@compiled_internal
def copy_point(stages: Array, to: int, at: int) -> None:
    """Copy a point of all stages, from column `at` on."""
    for i in range(stages.shape[0]):
        for k in range(L.POINT):
            stages[i, to + k] = stages[i, at + k]


@compiled_internal
def move_by_step(stages: Array, length: Float) -> None:
    """Move the solution so far by `length` times the step."""
    for i in range(stages.shape[0]):
        for k in range(L.POINT):
            stages[i, L.NOW_A + k] += length * stages[i, L.STEP_A + k]


@compiled_in_place
def solve_qp(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array,
    constants: Array, stats: Array,
) -> int:  # fmt: skip
    """Solve the QP linearised along the plan of `stages`, from the derivatives stored there.

    (last_a, last_delta) is the input in force, `weights` (10,) are Q, S, R. Writes the solution to
    the stages' NOW and its slacks to the lanes, adds to the statistics `stats` (STATS,), and
    returns a code.
    """
    n = lanes.shape[1]
    copy_point(stages, L.NOW_A, L.PLAN_A)
    measure_gaps(stages, lanes, last_a, last_delta, constants)
    guess(lanes)
    mu, worst, share, tolerance = START_BARRIER, 0.0, 1.0, constants[L.TOLERANCE]
    phase, tries, most, iterations = GUESSING, 0, MAX_GUESSES, 0
    code, changed, before, inside, crossing = QP_FAILURE, 1, 0, False, CROSSING
    # All phases share one loop, so that each function is called from one place only: this halves
    # the compile time.
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
            total += stages[i, L.STEP_A] + stages[i, L.STEP_DELTA] + stages[i + 1, L.STEP_X]
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
                # Cross over to the active set, which can be identified by now.
                copy_point(stages, L.KEPT, L.NOW_A)
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
            copy_point(stages, L.NOW_A, L.KEPT)
            recall(lanes)
        else:
            # Start the interior-point method from inputs within their limits.
            inside = True
            clamp(stages, L.NOW_A, last_a, last_delta, constants)
            follow(stages)
            measure_gaps(stages, lanes, last_a, last_delta, constants)
            worst = start(lanes, constants)
    clamp(stages, L.NOW_A, last_a, last_delta, constants)
    stats[INNER] += iterations
    stats[OUTER] += 1.0
    return code
