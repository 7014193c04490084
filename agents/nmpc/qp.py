"""Solver of the NMPC's quadratic program (QP), compiled: active-set guesses, then interior point.

The QP is the problem linearised along a plan. The solver first guesses the active set a few times;
most QPs are solved that way, exact to rounding. The others go on with `interior_point`, whose
result leads to further guesses: if one of them is consistent, the solution is exact too.

A guess declares every inequality FREE, BINDING or BROKEN_SOFT. The QP then only has equality
constraints and is solved by an augmented Lagrangian. Constraints that this solution violates, or
that bind with a multiplier of the wrong sign, change the guess. If none does, the solution is that
of the QP, to rounding. All arrays are described in `layout`.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import layout as L
from agents.nmpc import riccati
from agents.nmpc.interior_point import (
    START_BARRIER,
    centre,
    expand_step,
    fill_gradient,
    fill_hessian,
    initialise,
    take_step,
)
from agents.nmpc.linearisation import (
    HEADING_X,
    HEADING_Y,
    RATE,
    RATE_A,
    RATE_DELTA,
    RATE_R,
    RATE_VX,
    RATE_VY,
)
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

# Modes of a constraint: inactive, active, or soft and violated at the price of its slack.
FREE, BINDING, BROKEN_SOFT = 0.0, 1.0, 2.0
NEAR = 1e-4
"""Gap below which a constraint of the plan is guessed to bind."""
HELD = 1e-9
"""Largest gap of a binding constraint."""
SLIGHT = 1e-9
"""Size of a negative multiplier beyond which a constraint is freed."""
STIFFNESS = 1e6
"""Penalty of the augmented Lagrangian. If it is larger, rounding in the recursion exceeds small
multipliers and the guesses cycle; if smaller, binding constraints take more iterations to hold."""


@compiled_internal
def clamp(stages: Array, at: int, last_a: Float, last_delta: Float, constants: Array) -> None:
    """Bring the inputs of a point (from column `at` on) within bounds and rates, first to last."""
    before_a, before_delta, n = last_a, last_delta, stages.shape[0] - 1
    most_a, most_delta = L.grid(constants, L.CHANGE_A, n), L.grid(constants, L.CHANGE_DELTA, n)
    for i in range(n):
        e = stages[i]
        a = min(max(e[at], before_a - most_a[i]), before_a + most_a[i])
        delta = min(max(e[at + 1], before_delta - most_delta[i]), before_delta + most_delta[i])
        before_a = min(max(a, constants[L.LOW_A]), constants[L.HIGH_A])
        before_delta = min(max(delta, -constants[L.MAX_DELTA]), constants[L.MAX_DELTA])
        e[at], e[at + 1] = before_a, before_delta


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


@compiled_internal
def measure_gaps(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, constants: Array
) -> None:
    """Fill the gaps of the linearised constraints; the rows of slacks stay as they are."""
    low_a, high_a, max_delta = constants[L.LOW_A], constants[L.HIGH_A], constants[L.MAX_DELTA]
    ratio = constants[L.RATIO]
    before_a, before_delta = last_a, last_delta
    gap = lanes[L.GAP : L.GAP + L.PAIRS]
    n = gap.shape[1]
    most_a, most_delta = L.grid(constants, L.CHANGE_A, n), L.grid(constants, L.CHANGE_DELTA, n)
    for i in range(n):
        e, end = stages[i], stages[i + 1]
        a, delta = e[L.NOW_A], e[L.NOW_DELTA]
        gap[0, i], gap[1, i] = high_a - a, a - low_a
        gap[2, i], gap[3, i] = max_delta - delta, delta + max_delta
        change_a, change_delta = a - before_a, delta - before_delta
        gap[4, i], gap[5, i] = most_a[i] - change_a, change_a + most_a[i]
        gap[6, i], gap[7, i] = most_delta[i] - change_delta, change_delta + most_delta[i]
        vx, vy = end[L.NOW_VX], end[L.NOW_VY]
        gap[8, i], gap[9, i] = constants[L.HIGH_SPEED] - vx, vx - constants[L.LOW_SPEED]
        rate = e[RATE] + e[RATE_VX] * (e[L.NOW_VX] - e[L.PLAN_VX])
        rate += e[RATE_VY] * (e[L.NOW_VY] - e[L.PLAN_VY])
        rate += e[RATE_R] * (e[L.NOW_R] - e[L.PLAN_R])
        rate += e[RATE_A] * (a - e[L.PLAN_A]) + e[RATE_DELTA] * (delta - e[L.PLAN_DELTA])
        gap[11, i], gap[12, i] = constants[L.HIGH_RATE] - rate, rate - constants[L.LOW_RATE]
        gap[14, i], gap[15, i] = ratio * vx - vy, ratio * vx + vy
        before_a, before_delta = a, delta


@compiled_internal
def is_slack(pair: int) -> bool:
    """Return whether a pair is the bound of a slack itself."""
    return pair >= 8 and (pair - 8) % 3 == 2


@compiled_internal
def guess(lanes: Array) -> None:
    """Guess the active set from the gaps of a plan."""
    for k in range(L.PAIRS):
        gap, mode, lam = lanes[L.GAP + k], lanes[L.MODE + k], lanes[L.LAM + k]
        near = -math.inf if is_slack(k) else NEAR
        broken = -NEAR if k >= 8 else -math.inf
        for i in range(lanes.shape[1]):
            lam[i] = 0.0
            found = BINDING if gap[i] < near else FREE
            mode[i] = BROKEN_SOFT if gap[i] < min(near, broken) else found


@compiled_internal
def identify(lanes: Array) -> None:
    """Guess the active set from the pairs of the interior-point method.

    Its multipliers are kept in the rows of their steps, see `restore_multipliers`.
    """
    for k in range(L.PAIRS):
        # Hard constraints have no slack; that of a soft constraint is the third of its pairs.
        own = k + 2 - (k - 8) % 3 if k >= 8 else k
        for i in range(lanes.shape[1]):
            lam, found = lanes[L.LAM + k, i], FREE
            if lam > lanes[L.T + k, i] and not is_slack(k):
                found = BINDING
                if own > k and lanes[L.T + own, i] > lanes[L.LAM + own, i]:
                    found = BROKEN_SOFT
            lanes[L.DLAM + k, i], lanes[L.MODE + k, i] = lam, found
    for k in range(L.PAIRS):
        for i in range(lanes.shape[1]):
            if lanes[L.MODE + k, i] != BINDING:
                lanes[L.LAM + k, i] = 0.0


@compiled_internal
def restore_multipliers(lanes: Array) -> None:
    """Restore the multipliers of the interior-point method."""
    for k in range(L.PAIRS):
        for i in range(lanes.shape[1]):
            lanes[L.LAM + k, i] = lanes[L.DLAM + k, i]


@compiled_internal
def fill_equalities(lanes: Array, constants: Array) -> None:
    """Fill barrier and slope for an equality-constrained step.

    Binding constraints enter by the augmented Lagrangian, broken soft ones by their penalty.
    """
    shares = L.grid(constants, L.SHARE, lanes.shape[1])
    for k in range(L.PAIRS):
        gap, mode, lam = lanes[L.GAP + k], lanes[L.MODE + k], lanes[L.LAM + k]
        weight, force = lanes[L.WEIGHT + k], lanes[L.FORCE + k]
        linear = quadratic = 0.0
        if k >= 8:
            kind = (k - 8) // 3
            linear, quadratic = constants[L.LINEAR + kind], constants[L.QUADRATIC + kind]
        for i in range(lanes.shape[1]):
            held, pull = 0.0, 0.0
            if mode[i] == BINDING:
                held, pull = STIFFNESS, lam[i] - STIFFNESS * gap[i]
            if mode[i] == BROKEN_SOFT:
                held = quadratic * shares[i]
                pull = linear * shares[i] - held * gap[i]
            weight[i], force[i] = held, pull
    ratio = constants[L.RATIO]
    w, b = lanes[L.WEIGHT : L.WEIGHT + L.PAIRS], lanes[L.FORCE : L.FORCE + L.PAIRS]
    for i in range(lanes.shape[1]):
        for f in range(4):
            lanes[L.SLOPE_A + f, i] = b[2 * f, i] - b[2 * f + 1, i]
            lanes[L.BARRIER_A + f, i] = w[2 * f, i] + w[2 * f + 1, i]
        lanes[L.SLOPE_RATE, i], lanes[L.BARRIER_RATE, i] = b[11, i] - b[12, i], w[11, i] + w[12, i]
        right, left, both = b[14, i], b[15, i], w[14, i] + w[15, i]
        lanes[L.SLOPE_VX, i] = b[8, i] - b[9, i] - ratio * (right + left)
        lanes[L.SLOPE_VY, i] = right - left
        lanes[L.BARRIER_VX, i] = w[8, i] + w[9, i] + ratio * ratio * both
        lanes[L.BARRIER_CROSS, i] = ratio * (w[15, i] - w[14, i])
        lanes[L.BARRIER_VY, i] = both


@compiled_internal
def revise(lanes: Array, constants: Array) -> tuple[int, Float]:
    """Revise the guess after a step; return the number of changes and the largest binding gap."""
    changed, off = 0, 0.0
    shares = L.grid(constants, L.SHARE, lanes.shape[1])
    for k in range(L.PAIRS):
        if is_slack(k):
            continue
        gaps, mode, lam = lanes[L.GAP + k], lanes[L.MODE + k], lanes[L.LAM + k]
        price = constants[L.LINEAR + (k - 8) // 3] if k >= 8 else math.inf
        for i in range(lanes.shape[1]):
            gap, was, linear = gaps[i], mode[i], price * shares[i]
            if was == FREE:
                if gap < -HELD:
                    mode[i], lam[i] = BINDING, 0.0
                    changed += 1
            elif was == BINDING:
                force = lam[i] - STIFFNESS * gap
                if force < -SLIGHT:
                    mode[i], lam[i] = FREE, 0.0
                    changed += 1
                elif force > linear:
                    mode[i] = BROKEN_SOFT
                    changed += 1
                else:
                    lam[i] = force
                    off = max(off, abs(gap))
            elif gap > HELD:
                mode[i], lam[i] = BINDING, linear
                changed += 1
    return changed, off


@compiled_internal
def fill_slacks(lanes: Array) -> None:
    """Fill the slacks from the gaps of the soft constraints."""
    for i in range(lanes.shape[1]):
        for first in (8, 11, 14):
            least = min(lanes[L.GAP + first, i], lanes[L.GAP + first + 1, i])
            lanes[L.T + first + 2, i] = max(-least, 0.0)


@compiled_in_place
def solve_qp(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array,
    constants: Array, stats: Array,
) -> int:  # fmt: skip
    """Solve the QP linearised along the plan of `stages`, from the derivatives stored there.

    (last_a, last_delta) is the input in force, `weights` (12,) are Q, S, R, R_rate. Writes the
    solution to the stages' NOW and its slacks to the lanes, adds to the statistics `stats`
    (STATS,), and returns a code.
    """
    n = lanes.shape[1]
    copy_point(stages, L.NOW_A, L.PLAN_A)
    riccati.fill_prices(stages, lanes, weights, constants)
    measure_gaps(stages, lanes, last_a, last_delta, constants)
    guess(lanes)
    mu, worst, share, tolerance = START_BARRIER, 0.0, 1.0, constants[L.TOLERANCE]
    phase, tries, most, iterations = GUESSING, 0, MAX_GUESSES, 0
    code, changed, before, inside, crossing = QP_FAILURE, 1, 0, False, CROSSING
    # All phases share one loop, so that each function is called from one place only: this halves
    # the compile time.
    while True:
        if phase == GUESSING:
            fill_equalities(lanes, constants)
        else:
            if phase == PREDICTING:
                largest = max(mu, share * worst)
                if largest <= tolerance:
                    code = SUCCESS
                    break
                if iterations >= MAX_ITERATIONS:
                    code = SUCCESS if largest <= ACCEPTABLE else MAXITER
                    break
                fill_hessian(lanes, constants)
            fill_gradient(lanes, constants, share)
        if phase == PREDICTING or (phase == GUESSING and changed > 0):
            riccati.factor(stages, lanes, weights, constants)
        riccati.solve(stages, lanes, last_a, last_delta, weights, constants)
        length = 1.0
        if phase != GUESSING:
            length = expand_step(stages, lanes, constants, share)
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
            mu = take_step(lanes, length)
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
            fill_slacks(lanes)
            code = SUCCESS
            break
        if tries < most and finite and (tries < 2 or changed <= max(before, HOPEFUL)):
            continue
        phase = PREDICTING
        if inside:
            copy_point(stages, L.NOW_A, L.KEPT)
            restore_multipliers(lanes)
        else:
            # Start the interior-point method from inputs within their limits.
            inside = True
            clamp(stages, L.NOW_A, last_a, last_delta, constants)
            follow(stages)
            measure_gaps(stages, lanes, last_a, last_delta, constants)
            worst = initialise(lanes, constants)
    clamp(stages, L.NOW_A, last_a, last_delta, constants)
    stats[INNER] += iterations
    stats[OUTER] += 1.0
    return code
