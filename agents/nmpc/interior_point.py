"""Interior-point steps for the NMPC's quadratic program, compiled.

Mehrotra's predictor and corrector on Riccati recursions (`riccati`), from an infeasible start.
Every
inequality is a pair (t, lam) with t lam -> 0; rows as in `program`::

     0.. 7   high, low of a, delta, a - a_before, delta - delta_before        t = gap
     8.. 9   high, low of vx at the period's end,         10  its slack       t = gap + slack
    11..12   high, low of vx' at the period's start,      13  its slack
    14..15   ratio vx - vy, ratio vx + vy at the end,     16  their slack     t = slack

A slack s costs linear s + 1/2 quadratic s^2 and is eliminated by hand: with w = lam / t and b the
multiplier that a step of no length would give, its step is

    ds = (sum b - linear - quadratic s - sum w dgap) / (quadratic + sum w)

over its pairs and its own bound. What the Riccati recursion sees is then a Hessian and a gradient
by stage.
"""

from typing import Any

from numpy.typing import NDArray

from agents.nmpc.linearisation import RATE_DELTA, RATE_R, RATE_VX, RATE_VY
from agents.nmpc.program import (
    HIGH_A,
    LINEAR,
    LOW_A,
    MAX_DELTA,
    PAIRS,
    QUADRATIC,
    RATIO,
    STEP_A,
    STEP_DELTA,
)
from lpv_track_env.bicycle import VX, VY, YAW_RATE
from trajectories.compilation import compiled

Array = NDArray[Any]
Float = Any

FUNCTIONALS = 8
"""Rows of a step: a, delta, their changes, vx, vx', ratio vx - vy, ratio vx + vy."""
START_BARRIER = 300.0
"""Product t lam at the start."""
START_DISTANCE = 1.0
"""Least t at the start, as a share of the range between a pair's bounds."""


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


@compiled
def update(t: Array, lam: Array, dt: Array, dlam: Array, length: Float, product: Array) -> Float:
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
def centre_of(
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
