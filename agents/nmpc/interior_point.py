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
from agents.nmpc.linearisation import RATE, RATE_DELTA, RATE_R, RATE_VX, RATE_VY, RECORD
from agents.nmpc.riccati import GAIN, NODE_HESSIAN, STAGE_GRADIENT, STAGE_HESSIAN
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from trajectories.compilation import compiled

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
MAX_ITERATIONS = 40
START_BARRIER = 1.0
START_DISTANCE = 0.5
"""Least t at the start, as a share of the range between a pair's bounds."""
CAUTION, LEAST_CAUTION = 0.995, 0.9999
"""Share of the way to the nearest bound, at first and near the solution."""
ACCEPTABLE = 1e-6
"""Mean product at which rounding may end the iterations."""


@compiled
def workspace_size(n: int) -> int:
    """Length of the workspace of `solve_qp` for N = n."""
    nodes = (NODE_HESSIAN + 12) * (n + 1)
    stages = (STAGE_HESSIAN + STAGE_GRADIENT + GAIN + 2) * n
    return nodes + stages + (9 * PAIRS + FUNCTIONALS + 6 + 1) * n


@compiled
def cost_gradient(
    states: Array, inputs: Array, plan: Array, reference: Array, weights: Array, limits: Array,
    node_gradient: Array, stage_gradient: Array,
) -> None:  # fmt: skip
    """Gradient of the cost (its damping towards `plan` included) at states and inputs."""
    n = inputs.shape[0]
    for i in range(n + 1):
        offset = 4 if i == n else 0
        x, y, g = states[i], reference[i], node_gradient[i]
        g[VX] = weights[offset] * (x[VX] - y[0])
        g[PSI] = weights[offset + 1] * (x[PSI] - y[1])
        g[X] = weights[offset + 2] * (x[X] - y[2])
        g[Y] = weights[offset + 3] * (x[Y] - y[3])
        g[VY] = g[YAW_RATE] = 0.0
    for i in range(n):
        g = stage_gradient[i]
        g[0] = weights[8] * inputs[i, 0] + limits[DAMPING_A] * (inputs[i, 0] - plan[i, 0])
        g[1] = weights[9] * inputs[i, 1] + limits[DAMPING_DELTA] * (inputs[i, 1] - plan[i, 1])
        g[2] = g[3] = 0.0


@compiled
def cost_hessian(
    weights: Array, limits: Array, node_hessian: Array, stage_hessian: Array
) -> None:
    """Hessian of the cost alone."""
    n = stage_hessian.shape[0]
    for i in range(n + 1):
        offset = 4 if i == n else 0
        h = node_hessian[i]
        h[0], h[1], h[2] = weights[offset], 0.0, weights[offset + 1]
        h[3], h[4], h[5] = weights[offset + 2], weights[offset + 3], 0.0
    for i in range(n):
        h = stage_hessian[i]
        h[0], h[1] = weights[8] + limits[DAMPING_A], weights[9] + limits[DAMPING_DELTA]
        h[2] = h[3] = h[4] = 0.0


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
def start(gaps: Array, limits: Array, t: Array, lam: Array, residual: Array) -> None:
    """Start of all pairs: products at START_BARRIER, t at least some share of its range."""
    n = gaps.shape[1]
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


@compiled
def condense(
    records: Array, t: Array, lam: Array, residual: Array, share: Float, barrier: Float,
    corrections: Array, corrected: bool, hessian: bool, limits: Array, inverse: Array,
    weight: Array, base: Array, eliminated: Array, node_hessian: Array, stage_hessian: Array, node_gradient: Array,
    stage_gradient: Array,
) -> None:  # fmt: skip
    """Add the pairs' part to the gradients, and to the Hessians if asked.

    `base` (PAIRS, N) gets each pair's multiplier for a step of no length, `inverse` 1 / t (with the
    Hessian), `eliminated` (6, N) the slack's numerator and 1 / denominator.
    """
    n = t.shape[1]
    for k in range(PAIRS):
        tk, lk, rk, ck = t[k], lam[k], residual[k], corrections[k]
        ik, wk, bk = inverse[k], weight[k], base[k]
        if hessian:
            for i in range(n):
                ik[i] = 1.0 / tk[i]
                wk[i] = lk[i] * ik[i]
        if corrected:
            for i in range(n):
                bk[i] = (barrier - ck[i]) * ik[i] + wk[i] * share * rk[i]
        else:
            for i in range(n):
                bk[i] = barrier * ik[i] + wk[i] * share * rk[i]
    for soft in range(3):
        first, second, own = 8 + 3 * soft, 9 + 3 * soft, 10 + 3 * soft
        linear, quadratic = limits[LINEAR + soft], limits[QUADRATIC + soft]
        top, bottom = eliminated[2 * soft], eliminated[2 * soft + 1]
        for i in range(n):
            top[i] = (
                base[first, i] + base[second, i] + base[own, i] - linear - quadratic * t[own, i]
            )
        if hessian:
            for i in range(n):
                bottom[i] = 1.0 / (
                    quadratic
                    + weight[first, i]
                    + weight[second, i]
                    + weight[own, i]
                )
    ratio = limits[RATIO]
    for i in range(n):
        gu = stage_gradient[i]
        gu[0] += base[0, i] - base[1, i]
        gu[1] += base[2, i] - base[3, i]
        gu[2] += base[4, i] - base[5, i]
        gu[3] += base[6, i] - base[7, i]
        node, here, e = node_gradient[i + 1], node_gradient[i], records[i]
        w8, w9 = weight[8, i], weight[9, i]
        node[VX] += base[8, i] - base[9, i] - (w8 - w9) * eliminated[0, i] * eliminated[1, i]
        w11, w12 = weight[11, i], weight[12, i]
        by_rate = base[11, i] - base[12, i] - (w11 - w12) * eliminated[2, i] * eliminated[3, i]
        here[VX] += by_rate * e[RATE_VX]
        here[VY] += by_rate * e[RATE_VY]
        here[YAW_RATE] += by_rate * e[RATE_R]
        gu[0] += by_rate
        gu[1] += by_rate * e[RATE_DELTA]
        w14, w15 = weight[14, i], weight[15, i]
        taken = eliminated[4, i] * eliminated[5, i]
        right, left = base[14, i] - w14 * taken, base[15, i] - w15 * taken
        node[VX] -= ratio * (right + left)
        node[VY] += right - left
        if hessian:
            hu, hx = stage_hessian[i], node_hessian[i + 1]
            hu[0] += weight[0, i] + weight[1, i]
            hu[1] += weight[2, i] + weight[3, i]
            hu[2] += weight[4, i] + weight[5, i]
            hu[3] += weight[6, i] + weight[7, i]
            # w1 + w2 - (w1 - w2)^2 / (quadratic + sum w), with no difference of large numbers.
            own = limits[QUADRATIC] + weight[10, i]
            hx[0] += ((w8 + w9) * own + 4.0 * w8 * w9) * eliminated[1, i]
            own = limits[QUADRATIC + 1] + weight[13, i]
            hu[4] += ((w11 + w12) * own + 4.0 * w11 * w12) * eliminated[3, i]
            own = limits[QUADRATIC + 2] + weight[16, i]
            hx[0] += ratio * ratio * (w14 + w15) * own * eliminated[5, i]
            hx[1] += ((w14 + w15) * own + 4.0 * w14 * w15) * eliminated[5, i]
            hx[5] += ratio * (w15 - w14) * own * eliminated[5, i]


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
        tk, lk, dtk, dlk, ik = t[k], lam[k], dt[k], dlam[k], inverse[k]
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


@compiled
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
    at = 0
    node_hessian = work[at : at + NODE_HESSIAN * (n + 1)].reshape(n + 1, NODE_HESSIAN)
    at += NODE_HESSIAN * (n + 1)
    node_gradient = work[at : at + 6 * (n + 1)].reshape(n + 1, 6)
    at += 6 * (n + 1)
    dx = work[at : at + 6 * (n + 1)].reshape(n + 1, 6)
    at += 6 * (n + 1)
    stage_hessian = work[at : at + STAGE_HESSIAN * n].reshape(n, STAGE_HESSIAN)
    at += STAGE_HESSIAN * n
    stage_gradient = work[at : at + STAGE_GRADIENT * n].reshape(n, STAGE_GRADIENT)
    at += STAGE_GRADIENT * n
    gains = work[at : at + GAIN * n].reshape(n, GAIN)
    at += GAIN * n
    du = work[at : at + 2 * n].reshape(n, 2)
    at += 2 * n
    pairs = work[at : at + 9 * PAIRS * n].reshape(9, PAIRS, n)
    gaps, t, lam, residual = pairs[0], pairs[1], pairs[2], pairs[3]
    inverse, base, dt, dlam = pairs[4], pairs[5], pairs[6], pairs[7]
    weight = pairs[8]
    at += 9 * PAIRS * n
    functionals = work[at : at + FUNCTIONALS * n].reshape(FUNCTIONALS, n)
    at += FUNCTIONALS * n
    eliminated = work[at : at + 6 * n].reshape(6, n)
    at += 6 * n
    longest = work[at : at + n]

    # Without inequalities first: most of the time they are all kept.
    cost_gradient(
        base_states, plan, plan, reference, weights, limits, node_gradient, stage_gradient
    )
    cost_hessian(weights, limits, node_hessian, stage_hessian)
    riccati.factor(records, node_hessian, stage_hessian, gains)
    riccati.solve(records, gains, node_gradient, stage_gradient, dx, du)
    for i in range(n):
        inputs[i, 0], inputs[i, 1] = plan[i, 0] + du[i, 0], plan[i, 1] + du[i, 1]
    for i in range(n + 1):
        for k in range(6):
            states[i, k] = base_states[i, k] + dx[i, k]
    least = measure_gaps(records, base_states, plan, states, inputs, last, limits, gaps)
    total = 0.0
    for i in range(n):
        slack[0, i] = slack[1, i] = slack[2, i] = 0.0
        total += inputs[i, 0] + inputs[i, 1]
        for k in range(6):
            total += states[i + 1, k]
    if not math.isfinite(total):
        return BROKEN, 0
    if least >= 0.0:
        return OPTIMAL, 0

    clamp(inputs, last, limits)
    follow(records, base_states, plan, inputs, states)
    measure_gaps(records, base_states, plan, states, inputs, last, limits, gaps)
    start(gaps, limits, t, lam, residual)
    share = 1.0  # of the first residual that is left
    worst = 0.0
    for k in range(8):
        for i in range(n):
            worst = max(worst, residual[k, i])
    count = float(PAIRS * n)
    for iteration in range(1, MAX_ITERATIONS + 1):
        mu = 0.0
        for k in range(PAIRS):
            tk, lk = t[k], lam[k]
            for i in range(n):
                mu += tk[i] * lk[i]
        mu /= count
        if mu <= tolerance and share * worst <= tolerance:
            return _finish(t, inputs, last, limits, slack, OPTIMAL), iteration - 1
        cost_gradient(
            states, inputs, plan, reference, weights, limits, node_gradient, stage_gradient
        )
        cost_hessian(weights, limits, node_hessian, stage_hessian)
        condense(
            records, t, lam, residual, share, 0.0, dt, False, True, limits, inverse, weight,
            base, eliminated, node_hessian, stage_hessian, node_gradient, stage_gradient,
        )  # fmt: skip
        riccati.factor(records, node_hessian, stage_hessian, gains)
        riccati.solve(records, gains, node_gradient, stage_gradient, dx, du)
        length = expand(
            records, dx, du, t, lam, residual, share, limits, inverse, weight, base,
            eliminated, functionals, dt, dlam, longest,
        )  # fmt: skip
        length = min(1.0, length)
        reached = 0.0
        for k in range(PAIRS):
            tk, lk, dtk, dlk = t[k], lam[k], dt[k], dlam[k]
            for i in range(n):
                reached += (tk[i] + length * dtk[i]) * (lk[i] + length * dlk[i])
                dtk[i] *= dlk[i]  # the correction
        reached /= count
        centring = reached / mu
        centring = centring * centring * centring
        cost_gradient(
            states, inputs, plan, reference, weights, limits, node_gradient, stage_gradient
        )
        condense(
            records, t, lam, residual, share, centring * mu, dt, True, False, limits, inverse,
            weight, base, eliminated, node_hessian, stage_hessian, node_gradient, stage_gradient,
        )  # fmt: skip
        riccati.solve(records, gains, node_gradient, stage_gradient, dx, du)
        total = 0.0
        for i in range(n):
            total += du[i, 0] + du[i, 1]
        if not math.isfinite(total):
            good = mu <= ACCEPTABLE and share * worst <= ACCEPTABLE
            code = OPTIMAL if good else BROKEN
            return _finish(t, inputs, last, limits, slack, code), iteration
        length = expand(
            records, dx, du, t, lam, residual, share, limits, inverse, weight, base,
            eliminated, functionals, dt, dlam, longest,
        )  # fmt: skip
        length = min(1.0, max(CAUTION, min(1.0 - mu, LEAST_CAUTION)) * length)
        for k in range(PAIRS):
            tk, lk, dtk, dlk = t[k], lam[k], dt[k], dlam[k]
            for i in range(n):
                tk[i] += length * dtk[i]
                lk[i] += length * dlk[i]
        for i in range(n):
            inputs[i, 0] += length * du[i, 0]
            inputs[i, 1] += length * du[i, 1]
        for i in range(n + 1):
            for k in range(6):
                states[i, k] += length * dx[i, k]
        share *= 1.0 - length
    return _finish(t, inputs, last, limits, slack, OUT_OF_ITERATIONS), MAX_ITERATIONS


@compiled
def _finish(t: Array, inputs: Array, last: Array, limits: Array, slack: Array, code: int) -> int:
    for soft in range(3):
        for i in range(slack.shape[1]):
            slack[soft, i] = t[10 + 3 * soft, i]
    clamp(inputs, last, limits)
    return code
