"""Steps of a primal-dual interior-point method for the NMPC's QP, compiled.

Mehrotra's predictor and corrector on Riccati recursions (`riccati`), from an infeasible start.
A slack s costs linear s + 1/2 quadratic s^2 and is eliminated analytically: with w = lam / t and b
the multiplier after a step of length zero, its step is

    ds = (sum b - linear - quadratic s - sum w dgap) / (quadratic + sum w)

over its pairs and its own bound, with both penalties multiplied by the stage's share of the nominal
period. Each stage then adds a Hessian and a gradient to the Riccati recursion. Pairs and arrays are
described in `layout`.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import layout as L
from agents.nmpc.linearisation import RATE_A, RATE_DELTA, RATE_R, RATE_VX, RATE_VY
from trajectories.compilation import compiled_internal

Array = NDArray[Any]
Float = Any

START_BARRIER = 300.0
"""Initial product t lam."""
START_DISTANCE = 1.0
"""Least initial t, as a share of the range between a pair's bounds."""


@compiled_internal
def initialise(lanes: Array, constants: Array) -> Float:
    """Initialise all pairs: products at START_BARRIER, t at least a share of its range.

    Returns the largest residual t - gap.
    """
    worst, n = 0.0, lanes.shape[1]
    shares = L.grid(constants, L.SHARE, n)
    most_a, most_delta = L.grid(constants, L.CHANGE_A, n), L.grid(constants, L.CHANGE_DELTA, n)
    for i in range(n):
        for k in range(8):
            if k < 2:
                reach = constants[L.HIGH_A] - constants[L.LOW_A]
            elif k < 4:
                reach = 2.0 * constants[L.MAX_DELTA]
            else:
                reach = 2.0 * (most_a[i] if k < 6 else most_delta[i])
            gap = lanes[L.GAP + k, i]
            t = max(gap, START_DISTANCE * reach)
            worst = max(worst, t - gap)
            lanes[L.T + k, i], lanes[L.RESIDUAL + k, i] = t, t - gap
            lanes[L.LAM + k, i] = START_BARRIER / t
        for soft in range(3):
            first = 8 + 3 * soft
            high, low = lanes[L.GAP + first, i], lanes[L.GAP + first + 1, i]
            # The slack whose product with the slope of its penalty is the barrier.
            linear = constants[L.LINEAR + soft] * shares[i]
            curved = 4.0 * START_BARRIER * constants[L.QUADRATIC + soft] * shares[i]
            least = 2.0 * START_BARRIER / (linear + math.sqrt(linear * linear + curved) + 1e-3)
            slack = max(-min(high, low), 0.0) + least
            lanes[L.T + first, i], lanes[L.T + first + 1, i] = high + slack, low + slack
            lanes[L.T + first + 2, i] = slack
            for k in range(first, first + 3):
                lanes[L.RESIDUAL + k, i] = 0.0
                lanes[L.LAM + k, i] = START_BARRIER / lanes[L.T + k, i]
    return worst


@compiled_internal
def fill_hessian(lanes: Array, constants: Array) -> None:
    """Fill the Hessian terms of the pairs, and clear the corrections.

    w1 + w2 - (w1 - w2)^2 / (quadratic + sum w) and the like are computed without differences of
    large numbers.
    """
    n = lanes.shape[1]
    shares = L.grid(constants, L.SHARE, n)
    for k in range(L.PAIRS):
        t, lam, correction = lanes[L.T + k], lanes[L.LAM + k], lanes[L.DT + k]
        inverse, weight = lanes[L.INVERSE + k], lanes[L.WEIGHT + k]
        for i in range(n):
            inverse[i] = 1.0 / t[i]
            weight[i] = lam[i] * inverse[i]
            correction[i] = 0.0
    ratio = constants[L.RATIO]
    w = lanes[L.WEIGHT : L.WEIGHT + L.PAIRS]
    for i in range(n):
        for f in range(4):
            lanes[L.BARRIER_A + f, i] = w[2 * f, i] + w[2 * f + 1, i]
        w1, w2, w3 = w[8, i], w[9, i], w[10, i]
        quadratic = constants[L.QUADRATIC] * shares[i]
        bottom = 1.0 / (quadratic + w1 + w2 + w3)
        vx = ((w1 + w2) * (quadratic + w3) + 4.0 * w1 * w2) * bottom
        lanes[L.BOTTOM, i] = bottom
        w1, w2, w3 = w[11, i], w[12, i], w[13, i]
        quadratic = constants[L.QUADRATIC_RATE] * shares[i]
        bottom = 1.0 / (quadratic + w1 + w2 + w3)
        lanes[L.BARRIER_RATE, i] = ((w1 + w2) * (quadratic + w3) + 4.0 * w1 * w2) * bottom
        lanes[L.BOTTOM_RATE, i] = bottom
        w1, w2, w3 = w[14, i], w[15, i], w[16, i]
        quadratic = constants[L.QUADRATIC_RATIO] * shares[i]
        bottom = 1.0 / (quadratic + w1 + w2 + w3)
        apart = (quadratic + w3) * bottom
        lanes[L.BARRIER_VX, i] = vx + ratio * ratio * (w1 + w2) * apart
        lanes[L.BARRIER_CROSS, i] = ratio * (w2 - w1) * apart
        lanes[L.BARRIER_VY, i] = (w1 + w2) * apart + 4.0 * w1 * w2 * bottom
        lanes[L.BOTTOM_RATIO, i] = bottom


@compiled_internal
def fill_gradient(lanes: Array, constants: Array, share: Float) -> None:
    """Fill the gradient terms of the pairs and of their corrections in the rows of dt."""
    n = lanes.shape[1]
    shares = L.grid(constants, L.SHARE, n)
    for k in range(L.PAIRS):
        force, correction = lanes[L.FORCE + k], lanes[L.DT + k]
        weight, residual = lanes[L.WEIGHT + k], lanes[L.RESIDUAL + k]
        for i in range(n):
            force[i] = correction[i] + weight[i] * share * residual[i]
    ratio = constants[L.RATIO]
    w, b = lanes[L.WEIGHT : L.WEIGHT + L.PAIRS], lanes[L.FORCE : L.FORCE + L.PAIRS]
    for i in range(n):
        for f in range(4):
            lanes[L.SLOPE_A + f, i] = b[2 * f, i] - b[2 * f + 1, i]
        b1, b2, slack = b[8, i], b[9, i], lanes[L.T + 10, i]
        top = b1 + b2 + b[10, i]
        top -= shares[i] * (constants[L.LINEAR] + constants[L.QUADRATIC] * slack)
        vx = b1 - b2 - (w[8, i] - w[9, i]) * top * lanes[L.BOTTOM, i]
        lanes[L.TOP, i] = top
        b1, b2, slack = b[11, i], b[12, i], lanes[L.T + 13, i]
        top = b1 + b2 + b[13, i]
        top -= shares[i] * (constants[L.LINEAR_RATE] + constants[L.QUADRATIC_RATE] * slack)
        lanes[L.SLOPE_RATE, i] = b1 - b2 - (w[11, i] - w[12, i]) * top * lanes[L.BOTTOM_RATE, i]
        lanes[L.TOP_RATE, i] = top
        b1, b2, slack = b[14, i], b[15, i], lanes[L.T + 16, i]
        top = b1 + b2 + b[16, i]
        top -= shares[i] * (constants[L.LINEAR_RATIO] + constants[L.QUADRATIC_RATIO] * slack)
        taken = top * lanes[L.BOTTOM_RATIO, i]
        right, left = b1 - w[14, i] * taken, b2 - w[15, i] * taken
        lanes[L.SLOPE_VX, i], lanes[L.SLOPE_VY, i] = vx - ratio * (right + left), right - left
        lanes[L.TOP_RATIO, i] = top


@compiled_internal
def expand_step(stages: Array, lanes: Array, constants: Array, share: Float) -> Float:
    """Compute the steps of all pairs from the Riccati step.

    Returns the step length at which the first pair reaches its bound.
    """
    n = lanes.shape[1]
    ratio = constants[L.RATIO]
    before_a = before_delta = 0.0
    dt, rest, w = (
        lanes[L.DT : L.DT + L.PAIRS],
        lanes[L.RESIDUAL : L.RESIDUAL + 8],
        lanes[L.WEIGHT : L.WEIGHT + L.PAIRS],
    )
    longest = lanes[L.LONGEST]
    for i in range(n):
        e, end = stages[i], stages[i + 1]
        a, delta, vx, vy = e[L.STEP_A], e[L.STEP_DELTA], end[L.STEP_VX], end[L.STEP_VY]
        change_a, change_delta = a - before_a, delta - before_delta
        before_a, before_delta = a, delta
        dt[0, i], dt[1, i] = -a - share * rest[0, i], a - share * rest[1, i]
        dt[2, i], dt[3, i] = -delta - share * rest[2, i], delta - share * rest[3, i]
        dt[4, i], dt[5, i] = -change_a - share * rest[4, i], change_a - share * rest[5, i]
        dt[6, i] = -change_delta - share * rest[6, i]
        dt[7, i] = change_delta - share * rest[7, i]
        slack = (lanes[L.TOP, i] + (w[8, i] - w[9, i]) * vx) * lanes[L.BOTTOM, i]
        dt[8, i], dt[9, i], dt[10, i] = slack - vx, slack + vx, slack
        rate = e[RATE_VX] * e[L.STEP_VX] + e[RATE_VY] * e[L.STEP_VY] + e[RATE_R] * e[L.STEP_R]
        rate = rate + e[RATE_A] * a + e[RATE_DELTA] * delta
        slack = (lanes[L.TOP_RATE, i] + (w[11, i] - w[12, i]) * rate) * lanes[L.BOTTOM_RATE, i]
        dt[11, i], dt[12, i], dt[13, i] = slack - rate, slack + rate, slack
        right, left = ratio * vx - vy, ratio * vx + vy
        slack = lanes[L.TOP_RATIO, i] - w[14, i] * right - w[15, i] * left
        slack *= lanes[L.BOTTOM_RATIO, i]
        dt[14, i], dt[15, i], dt[16, i] = slack + right, slack + left, slack
        longest[i] = 1e-9
    for k in range(L.PAIRS):
        lam, step, dlam, inverse = lanes[L.LAM + k], dt[k], lanes[L.DLAM + k], lanes[L.INVERSE + k]
        weight, force, residual = w[k], lanes[L.FORCE + k], lanes[L.RESIDUAL + k]
        for i in range(n):
            # force contains w share residual, which dt has subtracted again.
            dlam[i] = force[i] - weight[i] * (step[i] + share * residual[i]) - lam[i]
            worst = max(-step[i] * inverse[i], -dlam[i] / lam[i])
            longest[i] = max(longest[i], worst)
    worst = 1e-9
    for i in range(n):
        worst = max(worst, longest[i])
    return 1.0 / worst


@compiled_internal
def centre(lanes: Array, length: Float, mu: Float) -> None:
    """Turn the predictor's steps into corrections, in the rows of dt.

    (target - dt dlam) / t, with Mehrotra's target for the products and the second-order correction.
    """
    reached, n = lanes[L.LONGEST], lanes.shape[1]
    for i in range(n):
        reached[i] = 0.0
    for k in range(L.PAIRS):
        t, lam, dt, dlam = lanes[L.T + k], lanes[L.LAM + k], lanes[L.DT + k], lanes[L.DLAM + k]
        for i in range(n):
            reached[i] += (t[i] + length * dt[i]) * (lam[i] + length * dlam[i])
    share = _sum(reached) / (mu * L.PAIRS * n)
    target = share * share * share * mu
    for k in range(L.PAIRS):
        dt, dlam, inverse = lanes[L.DT + k], lanes[L.DLAM + k], lanes[L.INVERSE + k]
        for i in range(n):
            dt[i] = (target - dt[i] * dlam[i]) * inverse[i]


@compiled_internal
def take_step(lanes: Array, length: Float) -> Float:
    """Take a step of all pairs; return the mean product t lam."""
    product, n = lanes[L.LONGEST], lanes.shape[1]
    for i in range(n):
        product[i] = 0.0
    for k in range(L.PAIRS):
        t, lam, dt, dlam = lanes[L.T + k], lanes[L.LAM + k], lanes[L.DT + k], lanes[L.DLAM + k]
        for i in range(n):
            t[i] += length * dt[i]
            lam[i] += length * dlam[i]
            product[i] += t[i] * lam[i]
    return _sum(product) / (L.PAIRS * n)


@compiled_internal
def _sum(values: Array) -> Float:
    total = 0.0
    for i in range(values.shape[0]):
        total += values[i]
    return total
