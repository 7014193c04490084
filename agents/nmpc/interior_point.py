"""Primal-dual interior-point method for the NMPC's quadratic program, compiled.

Mehrotra's predictor and corrector on Riccati recursions (`riccati`), from an infeasible start. Every
inequality is a pair (t, lam) with t lam -> 0; with "gap" for the distance to a bound, per stage::

     0.. 7   high, low of a, delta, a - a_before, delta - delta_before        t = gap
     8.. 9   high, low of vx at the period's end,         10  its slack       t = gap + slack
    11..12   high, low of vx' at the period's start,      13  its slack
    14..15   ratio vx - vy, ratio vx + vy at the end,     16  their slack     t = slack

A slack s costs linear s + 1/2 quadratic s^2 and is eliminated by hand: with w = lam / t and b the
multiplier that a step of no length would give, its step is

    ds = (sum b - linear - quadratic s - sum w dgap) / (quadratic + sum w)

over its pairs and its own bound. What the Riccati recursion sees is then a Hessian and a gradient
by stage. Before all this, the plan without inequalities is tried: where it keeps them it is the
solution, to rounding.

The model is that of `linearisation`; all arrays are carved out of one workspace.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import riccati
from agents.nmpc.linearisation import RATE, RATE_DELTA, RATE_R, RATE_VX, RATE_VY
from agents.nmpc.riccati import BARRIER, GAIN, SLOPE
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from trajectories.compilation import compiled, compiled_in_place

Array = NDArray[Any]
Float = Any

PAIRS = 17
SOFT_PAIRS = ((8, 9, 10), (11, 12, 13), (14, 15, 16))
"""First and second pair and slack of each soft constraint: on vx, vx', vy."""
FUNCTIONALS = 8
"""Rows of a step: a, delta, their changes, vx, vx', ratio vx - vy, ratio vx + vy."""

# Numbers of the problem, (LIMITS_SIZE,): see `rti_solver.limits`.
(
    LOW_A, HIGH_A, MAX_DELTA, STEP_A, STEP_DELTA, FIRST_STEP_A, FIRST_STEP_DELTA, LOW_SPEED,
    HIGH_SPEED, LOW_RATE, HIGH_RATE, RATIO, LINEAR, QUADRATIC, DAMPING_A, DAMPING_DELTA,
) = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 15, 18, 19)  # fmt: skip
LIMITS_SIZE = 20
SLACK_OF = (0, 2, 1)
"""Index in the problem's penalties (vx, vy, vx') of the soft constraints in their order here."""

OPTIMAL, OUT_OF_ITERATIONS, BROKEN = 0, 1, 2
GUESSING, PREDICTING, CORRECTING = 0, 1, 2
"""Phases: the active-set method, then predictor and corrector in turns."""
FREE, BINDING, BROKEN_SOFT = 0.0, 1.0, 2.0
"""What a guess makes of a constraint: it is kept by itself, holds as an equation, is broken."""
MAX_GUESSES = 6
NEAR = 1e-4
"""Gap below which a constraint of the plan is guessed to bind."""
HELD = 1e-9
"""Largest gap of a constraint that binds."""
SLIGHT = 1e-9
STIFFNESS = 1e7
MAX_ITERATIONS = 40
START_BARRIER = 300.0
START_DISTANCE = 1.0
"""Least t at the start, as a share of the range between a pair's bounds."""
CAUTION, LEAST_CAUTION = 0.995, 0.9999
"""Share of the way to the nearest bound, at first and near the solution."""
ACCEPTABLE = 1e-6
"""Mean product at which rounding may end the iterations."""


@compiled
def workspace_size(n: int) -> int:
    """Length of the workspace of `solve_qp` for N = n."""
    return 6 * (n + 1) + (2 + GAIN + BARRIER + SLOPE + 10 * PAIRS + FUNCTIONALS + 6 + 1) * n


@compiled
def measure_gaps(
    records: Array, base: Array, plan: Array, states: Array, inputs: Array, last: Array,
    limits: Array, gaps: Array,
) -> Float:  # fmt: skip
    """Fill the gaps (PAIRS, N) of linearised constraints; the rows of slacks are left alone.

    `base` (N + 1, 6) and `plan` (N, 2) are what the records were made along. Returns the least gap.
    """
    n = inputs.shape[0]
    low_a, high_a, max_delta = limits[LOW_A], limits[HIGH_A], limits[MAX_DELTA]
    ratio, least = limits[RATIO], math.inf
    before_a, before_delta = last[0], last[1]
    step_a, step_delta = limits[FIRST_STEP_A], limits[FIRST_STEP_DELTA]
    for i in range(n):
        a, delta, e = inputs[i, 0], inputs[i, 1], records[i]
        gaps[0, i], gaps[1, i] = high_a - a, a - low_a
        gaps[2, i], gaps[3, i] = max_delta - delta, delta + max_delta
        change_a, change_delta = a - before_a, delta - before_delta
        gaps[4, i], gaps[5, i] = step_a - change_a, change_a + step_a
        gaps[6, i], gaps[7, i] = step_delta - change_delta, change_delta + step_delta
        vx, vy = states[i + 1, VX], states[i + 1, VY]
        gaps[8, i], gaps[9, i] = limits[HIGH_SPEED] - vx, vx - limits[LOW_SPEED]
        rate = e[RATE] + e[RATE_VX] * (states[i, VX] - base[i, VX])
        rate += e[RATE_VY] * (states[i, VY] - base[i, VY])
        rate += e[RATE_R] * (states[i, YAW_RATE] - base[i, YAW_RATE])
        rate += a - plan[i, 0] + e[RATE_DELTA] * (delta - plan[i, 1])
        gaps[11, i], gaps[12, i] = limits[HIGH_RATE] - rate, rate - limits[LOW_RATE]
        gaps[14, i], gaps[15, i] = ratio * vx - vy, ratio * vx + vy
        before_a, before_delta = a, delta
        step_a, step_delta = limits[STEP_A], limits[STEP_DELTA]
        for k in range(8):
            least = min(least, gaps[k, i])
        for k in (8, 9, 11, 12, 14, 15):
            least = min(least, gaps[k, i])
    return least


@compiled
def guess(gaps: Array, mode: Array, lam: Array) -> None:
    """Guess which constraints hold as equations, or are broken, from a plan's gaps."""
    for k in range(PAIRS):
        row, into, multiplier = gaps[k], mode[k], lam[k]
        soft = k >= 8
        for i in range(gaps.shape[1]):
            multiplier[i] = 0.0
            into[i] = FREE
            if row[i] < NEAR:
                into[i] = BROKEN_SOFT if soft and row[i] < -NEAR else BINDING
    for k in (10, 13, 16):
        mode[k] = FREE


@compiled
def hold(
    gaps: Array, mode: Array, lam: Array, limits: Array, weight: Array, base: Array,
    barrier: Array, slope: Array,
) -> None:  # fmt: skip
    """Fill `barrier` and `slope` for an equality-constrained step.

    Binding constraints by an augmented Lagrangian, broken soft ones by their price.
    """
    n = gaps.shape[1]
    for k in range(PAIRS):
        row, into, multiplier, wk, bk = gaps[k], mode[k], lam[k], weight[k], base[k]
        linear = quadratic = 0.0
        if k >= 8:
            linear, quadratic = limits[LINEAR + (k - 8) // 3], limits[QUADRATIC + (k - 8) // 3]
        for i in range(n):
            wk[i] = STIFFNESS if into[i] == BINDING else 0.0
            bk[i] = multiplier[i] - STIFFNESS * row[i] if into[i] == BINDING else 0.0
            wk[i] = quadratic if into[i] == BROKEN_SOFT else wk[i]
            bk[i] = linear - quadratic * row[i] if into[i] == BROKEN_SOFT else bk[i]
    ratio = limits[RATIO]
    for i in range(n):
        for f in range(4):
            slope[f, i] = base[2 * f, i] - base[2 * f + 1, i]
            barrier[f, i] = weight[2 * f, i] + weight[2 * f + 1, i]
        slope[4, i], barrier[4, i] = base[11, i] - base[12, i], weight[11, i] + weight[12, i]
        right, left, both = base[14, i], base[15, i], weight[14, i] + weight[15, i]
        slope[5, i] = base[8, i] - base[9, i] - ratio * (right + left)
        slope[6, i] = right - left
        barrier[5, i] = weight[8, i] + weight[9, i] + ratio * ratio * both
        barrier[6, i] = ratio * (weight[15, i] - weight[14, i])
        barrier[7, i] = both


@compiled
def revise(gaps: Array, mode: Array, lam: Array, limits: Array) -> tuple[bool, Float]:
    """Mend the guess after a step; whether it changed, and by how much what binds is missed."""
    changed, off = False, 0.0
    for k in range(PAIRS):
        row, into, multiplier = gaps[k], mode[k], lam[k]
        linear = limits[LINEAR + (k - 8) // 3] if k >= 8 else math.inf
        if k in {10, 13, 16}:
            continue
        for i in range(gaps.shape[1]):
            gap, was = row[i], into[i]
            if was == FREE:
                if gap < -HELD:
                    into[i], multiplier[i], changed = BINDING, 0.0, True
            elif was == BINDING:
                force = multiplier[i] - STIFFNESS * gap
                if force < -SLIGHT:
                    into[i], multiplier[i], changed = FREE, 0.0, True
                elif force > linear:
                    into[i], changed = BROKEN_SOFT, True
                else:
                    multiplier[i] = force
                    off = max(off, abs(gap))
            elif gap > HELD:
                into[i], multiplier[i], changed = BINDING, linear, True
    return changed, off


@compiled
def clamp(inputs: Array, last: Array, limits: Array) -> None:
    """Bring inputs (N, 2) within their bounds and rates, from the first on."""
    before_a, before_delta = last[0], last[1]
    step_a, step_delta = limits[FIRST_STEP_A], limits[FIRST_STEP_DELTA]
    for i in range(inputs.shape[0]):
        a = min(max(inputs[i, 0], before_a - step_a), before_a + step_a)
        delta = min(max(inputs[i, 1], before_delta - step_delta), before_delta + step_delta)
        before_a = min(max(a, limits[LOW_A]), limits[HIGH_A])
        before_delta = min(max(delta, -limits[MAX_DELTA]), limits[MAX_DELTA])
        inputs[i, 0], inputs[i, 1] = before_a, before_delta
        step_a, step_delta = limits[STEP_A], limits[STEP_DELTA]


@compiled
def follow(records: Array, base: Array, plan: Array, inputs: Array, states: Array) -> None:
    """Fill states (N + 1, 6) by the linearised model under inputs (N, 2)."""
    for k in range(6):
        states[0, k] = base[0, k]
    for i in range(inputs.shape[0]):
        e = records[i]
        d0 = states[i, VX] - base[i, VX]
        d1 = states[i, VY] - base[i, VY]
        d2 = states[i, PSI] - base[i, PSI]
        d3 = states[i, YAW_RATE] - base[i, YAW_RATE]
        ua, ud = inputs[i, 0] - plan[i, 0], inputs[i, 1] - plan[i, 1]
        following, there = states[i + 1], base[i + 1]
        for k in range(6):
            following[k] = there[k] + (
                e[k] * d0 + e[6 + k] * d1 + e[12 + k] * d3 + e[20 + k] * ua + e[26 + k] * ud
            )
        following[PSI] += d2
        following[X] += e[18] * d2 + (states[i, X] - base[i, X])
        following[Y] += e[19] * d2 + (states[i, Y] - base[i, Y])


@compiled
def start(gaps: Array, limits: Array, t: Array, lam: Array, residual: Array) -> Float:
    """Start of all pairs: products at START_BARRIER, t at least some share of its range.

    Returns the largest residual t - gap.
    """
    n, worst = gaps.shape[1], 0.0
    for k in range(8):
        kind = k // 2
        if kind == 0:
            reach = limits[HIGH_A] - limits[LOW_A]
        elif kind == 1:
            reach = 2.0 * limits[MAX_DELTA]
        elif kind == 2:
            reach = 2.0 * limits[STEP_A]
        else:
            reach = 2.0 * limits[STEP_DELTA]
        for i in range(n):
            t[k, i] = max(gaps[k, i], START_DISTANCE * reach)
            residual[k, i] = t[k, i] - gaps[k, i]
            worst = max(worst, residual[k, i])
            lam[k, i] = START_BARRIER / t[k, i]
    for soft in range(3):
        first, second, own = 8 + 3 * soft, 9 + 3 * soft, 10 + 3 * soft
        price = limits[LINEAR + soft] + 1e-3
        for i in range(n):
            least = START_BARRIER / price
            slack = max(-min(gaps[first, i], gaps[second, i]), 0.0) + least
            t[own, i] = slack
            t[first, i] = gaps[first, i] + slack
            t[second, i] = gaps[second, i] + slack
            residual[first, i] = residual[second, i] = residual[own, i] = 0.0
            lam[first, i] = START_BARRIER / t[first, i]
            lam[second, i] = START_BARRIER / t[second, i]
            lam[own, i] = START_BARRIER / slack
    return worst


@compiled
def condense(
    t: Array, lam: Array, residual: Array, share: Float, centre: Float, corrections: Array,
    predicting: bool, limits: Array, inverse: Array, weight: Array, base: Array,
    eliminated: Array, barrier: Array, slope: Array,
) -> None:  # fmt: skip
    """Fill what the pairs add to the gradient (`slope`) and, if predicting, the Hessian.

    `base` (PAIRS, N) gets each pair's multiplier for a step of no length, `inverse` 1 / t,
    `weight` lam / t, `eliminated` (6, N) the slacks' numerators and 1 / denominators.
    """
    n = t.shape[1]
    for k in range(PAIRS):
        tk, lk, rk, ck = t[k], lam[k], residual[k], corrections[k]
        ik, wk, bk = inverse[k], weight[k], base[k]
        if predicting:
            for i in range(n):
                ik[i] = 1.0 / tk[i]
                wk[i] = lk[i] * ik[i]
                bk[i] = wk[i] * share * rk[i]
        else:
            for i in range(n):
                bk[i] = (centre - ck[i]) * ik[i] + wk[i] * share * rk[i]
    for f in range(4):
        high, low, into = base[2 * f], base[2 * f + 1], slope[f]
        for i in range(n):
            into[i] = high[i] - low[i]
        if predicting:
            high, low, into = weight[2 * f], weight[2 * f + 1], barrier[f]
            for i in range(n):
                into[i] = high[i] + low[i]
    for soft in range(3):
        first, second, own = 8 + 3 * soft, 9 + 3 * soft, 10 + 3 * soft
        linear, quadratic = limits[LINEAR + soft], limits[QUADRATIC + soft]
        top, bottom = eliminated[2 * soft], eliminated[2 * soft + 1]
        b1, b2, b3, slack = base[first], base[second], base[own], t[own]
        w1, w2, w3 = weight[first], weight[second], weight[own]
        for i in range(n):
            top[i] = b1[i] + b2[i] + b3[i] - linear - quadratic * slack[i]
        if predicting:
            for i in range(n):
                bottom[i] = 1.0 / (quadratic + w1[i] + w2[i] + w3[i])
        # w1 + w2 - (w1 - w2)^2 / (quadratic + sum w) and its like, without differences of large
        # numbers.
        if soft < 2:
            into, row = slope[5 - soft], barrier[5 - soft]
            for i in range(n):
                into[i] = b1[i] - b2[i] - (w1[i] - w2[i]) * top[i] * bottom[i]
            if predicting:
                for i in range(n):
                    apart = quadratic + w3[i]
                    row[i] = ((w1[i] + w2[i]) * apart + 4.0 * w1[i] * w2[i]) * bottom[i]
        else:
            ratio, by_vx, by_vy = limits[RATIO], slope[5], slope[6]
            for i in range(n):
                taken = top[i] * bottom[i]
                right, left = b1[i] - w1[i] * taken, b2[i] - w2[i] * taken
                by_vx[i] -= ratio * (right + left)
                by_vy[i] = right - left
            if predicting:
                for i in range(n):
                    apart = (quadratic + w3[i]) * bottom[i]
                    barrier[5, i] += ratio * ratio * (w1[i] + w2[i]) * apart
                    barrier[6, i] = ratio * (w2[i] - w1[i]) * apart
                    barrier[7, i] = (w1[i] + w2[i]) * apart + 4.0 * w1[i] * w2[i] * bottom[i]


@compiled
def expand(
    records: Array, dx: Array, du: Array, t: Array, lam: Array, residual: Array, share: Float,
    limits: Array, inverse: Array, weight: Array, base: Array, eliminated: Array,
    functionals: Array, dt: Array, dlam: Array, longest: Array,
) -> Float:  # fmt: skip
    """Steps of all pairs from the Riccati step; returns the step length that keeps them positive.

    The length is at most 1 and goes all the way to the nearest bound. `longest` (N,) is scratch.
    """
    n = t.shape[1]
    ratio = limits[RATIO]
    before_a = before_delta = 0.0
    for i in range(n):
        a, delta, e = du[i, 0], du[i, 1], records[i]
        functionals[0, i], functionals[1, i] = a, delta
        functionals[2, i], functionals[3, i] = a - before_a, delta - before_delta
        before_a, before_delta = a, delta
        vx, vy = dx[i + 1, VX], dx[i + 1, VY]
        functionals[4, i] = vx
        rate = e[RATE_VX] * dx[i, VX] + e[RATE_VY] * dx[i, VY] + e[RATE_R] * dx[i, YAW_RATE]
        functionals[5, i] = rate + a + e[RATE_DELTA] * delta
        functionals[6, i], functionals[7, i] = ratio * vx - vy, ratio * vx + vy
        longest[i] = 1e-9
    for f in range(4):
        high, low, z = 2 * f, 2 * f + 1, functionals[f]
        for i in range(n):
            dt[high, i] = -z[i] - share * residual[high, i]
            dt[low, i] = z[i] - share * residual[low, i]
    for soft in range(3):
        first, second, own = 8 + 3 * soft, 9 + 3 * soft, 10 + 3 * soft
        top, bottom = eliminated[2 * soft], eliminated[2 * soft + 1]
        if soft < 2:
            z = functionals[4 + soft]
            for i in range(n):
                w1 = weight[first, i]
                w2 = weight[second, i]
                ds = (top[i] + (w1 - w2) * z[i]) * bottom[i]
                dt[own, i], dt[first, i], dt[second, i] = ds, ds - z[i], ds + z[i]
        else:
            right, left = functionals[6], functionals[7]
            for i in range(n):
                w1 = weight[first, i]
                w2 = weight[second, i]
                ds = (top[i] - w1 * right[i] - w2 * left[i]) * bottom[i]
                dt[own, i], dt[first, i], dt[second, i] = ds, ds + right[i], ds + left[i]
    for k in range(PAIRS):
        lk, dtk, dlk, ik = lam[k], dt[k], dlam[k], inverse[k]
        wk, bk, rk = weight[k], base[k], residual[k]
        for i in range(n):
            # base holds w share residual, which dt has taken off again.
            dlk[i] = bk[i] - wk[i] * (dtk[i] + share * rk[i]) - lk[i]
            worst = max(-dtk[i] * ik[i], -dlk[i] / lk[i])
            longest[i] = max(longest[i], worst)
    worst = 1e-9
    for i in range(n):
        worst = max(worst, longest[i])
    return 1.0 / worst


@compiled_in_place
def solve_qp(
    records: Array, base_states: Array, plan: Array, last: Array, reference: Array, weights: Array,
    limits: Array, tolerance: Float, states: Array, inputs: Array, slack: Array, work: Array,
) -> tuple[int, int]:  # fmt: skip
    """Solve the program linearised along (base_states, plan); returns a code and iterations.

    Fills states (N + 1, 6), inputs (N, 2) and slack (3, N) [vx, vx', vy] with the solution. `last`
    is the input in force, `weights` (10,) are Q, S, R, `limits` (LIMITS_SIZE,) the problem's
    numbers, `work` (workspace_size(N),).
    """
    n = plan.shape[0]
    damping_a, damping_delta = limits[DAMPING_A], limits[DAMPING_DELTA]
    at = 0
    dx = work[at : at + 6 * (n + 1)].reshape(n + 1, 6)
    at += 6 * (n + 1)
    du = work[at : at + 2 * n].reshape(n, 2)
    at += 2 * n
    gains = work[at : at + GAIN * n].reshape(n, GAIN)
    at += GAIN * n
    barrier = work[at : at + BARRIER * n].reshape(BARRIER, n)
    at += BARRIER * n
    slope = work[at : at + SLOPE * n].reshape(SLOPE, n)
    at += SLOPE * n
    pairs = work[at : at + 10 * PAIRS * n].reshape(10, PAIRS, n)
    gaps, t, lam, residual = pairs[0], pairs[1], pairs[2], pairs[3]
    inverse, weight, base, dt, dlam = pairs[4], pairs[5], pairs[6], pairs[7], pairs[8]
    mode = pairs[9]
    at += 10 * PAIRS * n
    functionals = work[at : at + FUNCTIONALS * n].reshape(FUNCTIONALS, n)
    at += FUNCTIONALS * n
    eliminated = work[at : at + 6 * n].reshape(6, n)
    at += 6 * n
    longest = work[at : at + n]

    for i in range(n):
        inputs[i, 0], inputs[i, 1] = plan[i, 0], plan[i, 1]
    for i in range(n + 1):
        for k in range(6):
            states[i, k] = base_states[i, k]
    mu, centre, worst, share = START_BARRIER, 0.0, 0.0, 1.0
    phase, tries, iterations = GUESSING, 0, 0
    changed = True
    # All methods take turns through one loop: each part is called from one place only, which
    # halves the time that compiling takes.
    while True:
        if phase == GUESSING:
            if tries == 0:
                measure_gaps(records, base_states, plan, states, inputs, last, limits, gaps)
                guess(gaps, mode, lam)
            hold(gaps, mode, lam, limits, weight, base, barrier, slope)
        else:
            condense(
                t, lam, residual, share, centre, dt, phase == PREDICTING, limits, inverse, weight,
                base, eliminated, barrier, slope,
            )  # fmt: skip
        if phase == PREDICTING or (phase == GUESSING and changed):
            riccati.factor(records, weights, damping_a, damping_delta, barrier, gains)
        riccati.solve(
            records, gains, weights, damping_a, damping_delta, states, inputs, plan, reference,
            slope, dx, du,
        )  # fmt: skip
        length = 1.0
        if phase != GUESSING:
            length = expand(
                records, dx, du, t, lam, residual, share, limits, inverse, weight, base,
                eliminated, functionals, dt, dlam, longest,
            )  # fmt: skip
        if phase == PREDICTING:
            centre = _centre(t, lam, dt, dlam, min(1.0, length), mu, longest)
            phase = CORRECTING
            continue
        total = 0.0
        for i in range(n):
            total += du[i, 0] + du[i, 1] + dx[i + 1, X]
        if not math.isfinite(total):
            good = phase != GUESSING and mu <= ACCEPTABLE and share * worst <= ACCEPTABLE
            code = OPTIMAL if good else BROKEN
            return _finish(t, inputs, last, limits, slack, code), iterations
        if phase == CORRECTING:
            length = min(1.0, max(CAUTION, min(1.0 - mu, LEAST_CAUTION)) * length)
            mu = _update(t, lam, dt, dlam, length, longest)
            share *= 1.0 - length
        for i in range(n):
            inputs[i, 0] += length * du[i, 0]
            inputs[i, 1] += length * du[i, 1]
        for i in range(n + 1):
            for k in range(6):
                states[i, k] += length * dx[i, k]
        iterations += 1
        if phase == CORRECTING:
            if mu <= tolerance and share * worst <= tolerance:
                return _finish(t, inputs, last, limits, slack, OPTIMAL), iterations
            if iterations >= MAX_ITERATIONS:
                good = mu <= ACCEPTABLE and share * worst <= ACCEPTABLE
                code = OPTIMAL if good else OUT_OF_ITERATIONS
                return _finish(t, inputs, last, limits, slack, code), iterations
            phase = PREDICTING
            continue
        tries += 1
        measure_gaps(records, base_states, plan, states, inputs, last, limits, gaps)
        changed, off = revise(gaps, mode, lam, limits)
        if not changed and off <= HELD:
            for soft in range(3):
                for i in range(n):
                    least = min(gaps[8 + 3 * soft, i], gaps[9 + 3 * soft, i])
                    t[10 + 3 * soft, i] = max(-least, 0.0)
            return _finish(t, inputs, last, limits, slack, OPTIMAL), iterations
        if tries == MAX_GUESSES:
            # Start the interior-point method where all inputs keep their limits.
            clamp(inputs, last, limits)
            follow(records, base_states, plan, inputs, states)
            measure_gaps(records, base_states, plan, states, inputs, last, limits, gaps)
            worst = start(gaps, limits, t, lam, residual)
            phase = PREDICTING


@compiled
def _update(t: Array, lam: Array, dt: Array, dlam: Array, length: Float, product: Array) -> Float:
    """Take a step of all pairs; returns the mean product t lam. `product` (N,) is scratch."""
    product[:] = 0.0
    for k in range(PAIRS):
        tk, lk, dtk, dlk = t[k], lam[k], dt[k], dlam[k]
        for i in range(t.shape[1]):
            tk[i] += length * dtk[i]
            lk[i] += length * dlk[i]
            product[i] += tk[i] * lk[i]
    return _sum(product) / (PAIRS * t.shape[1])


@compiled
def _centre(
    t: Array, lam: Array, dt: Array, dlam: Array, length: Float, mu: Float, reached: Array,
) -> Float:  # fmt: skip
    """Mehrotra's target for the products; turns `dt` into the second-order corrections dt dlam."""
    reached[:] = 0.0
    for k in range(t.shape[0]):
        tk, lk, dtk, dlk = t[k], lam[k], dt[k], dlam[k]
        for i in range(t.shape[1]):
            reached[i] += (tk[i] + length * dtk[i]) * (lk[i] + length * dlk[i])
            dtk[i] *= dlk[i]
    share = _sum(reached) / (mu * t.shape[0] * t.shape[1])
    return share * share * share * mu


@compiled
def _sum(values: Array) -> Float:
    total = 0.0
    for i in range(values.shape[0]):
        total += values[i]
    return total


@compiled
def _finish(t: Array, inputs: Array, last: Array, limits: Array, slack: Array, code: int) -> int:
    for soft in range(3):
        for i in range(slack.shape[1]):
            slack[soft, i] = t[10 + 3 * soft, i]
    clamp(inputs, last, limits)
    return code
