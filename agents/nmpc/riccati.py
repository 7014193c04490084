"""Newton steps of the NMPC's QP by Riccati recursions over its stages, compiled.

A step minimises, over dx_0 = 0, dx_{i+1} = A_i dx_i + B_i du_i and du_{-1} = 0,

    sum_i 1/2 dx_i' Hx_i dx_i + gx_i' dx_i  +  1/2 du_i' Hu_i du_i + gu_i' du_i
        + 1/2 h_i (n_i' [dx_i; du_i])^2 + k_i n_i' [dx_i; du_i]
        + 1/2 (du_i - du_{i-1})' W_i (du_i - du_{i-1}) + w_i' (du_i - du_{i-1})

with n_i the gradient of vx', Hu and W diagonal, and Hx diagonal except for the blocks of (vx, vy)
and (X, Y).
Hessians and gradients are those of the cost, at the solution so far, plus the terms of the
inequalities (barrier and slope in the lanes of `layout`; those of vx and vy hold at the end of a
stage). The value function of stage i depends on dx_i and p = du_{i-1}:

    1/2 x' P x + x' T p + 1/2 p' U p + s' x + t' p

`factor` computes the matrix part once for a Hessian, `solve` the vector part for each gradient. The
derivatives of a stage are described in `linearisation`, all arrays in `layout`.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import layout as L
from agents.nmpc.linearisation import (
    HEADING_X,
    HEADING_Y,
    RATE_A,
    RATE_DELTA,
    RATE_R,
    RATE_VX,
    RATE_VY,
    Six,
    dot,
    mixed,
    plus,
    scaled,
    taken,
)  # fmt: skip
from trajectories.compilation import compiled_internal

Array = NDArray[Any]
Float = Any

NAN = math.nan


@compiled_internal
def _product(p: Any, v: Six) -> Six:
    """Product P v for a symmetric P, given by its upper triangle, row by row."""
    p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15 = p[:11]
    p22, p23, p24, p25, p33, p34, p35, p44, p45, p55 = p[11:]
    v0, v1, v2, v3, v4, v5 = v
    return (
        p00 * v0 + p01 * v1 + p02 * v2 + p03 * v3 + p04 * v4 + p05 * v5,
        p01 * v0 + p11 * v1 + p12 * v2 + p13 * v3 + p14 * v4 + p15 * v5,
        p02 * v0 + p12 * v1 + p22 * v2 + p23 * v3 + p24 * v4 + p25 * v5,
        p03 * v0 + p13 * v1 + p23 * v2 + p33 * v3 + p34 * v4 + p35 * v5,
        p04 * v0 + p14 * v1 + p24 * v2 + p34 * v3 + p44 * v4 + p45 * v5,
        p05 * v0 + p15 * v1 + p25 * v2 + p35 * v3 + p45 * v4 + p55 * v5,
    )


@compiled_internal
def _back(a0: Six, a1: Six, a3: Six, a42: Float, a52: Float, v: Six) -> Six:
    """Product A' v: columns vx, vy, r of A are given in full, psi by its last two entries."""
    return (
        dot(a0, v), dot(a1, v), v[2] + a42 * v[4] + a52 * v[5], dot(a3, v), v[4], v[5],
    )  # fmt: skip


@compiled_internal
def _entry(
    value: Float, k: Float, ci: Float, cj: Float, gi: Float, ki: Float, hi: Float, li: Float
) -> Float:
    """Entry of Hx + A' P A + k c c' - G' M^-1 G."""
    return value + k * ci * cj - gi * ki - hi * li


@compiled_internal
def _put(e: Array, at: int, ka: Six, by: Float, c: Six) -> None:
    """Write the vector ka + by c into a stage."""
    e[at], e[at + 1], e[at + 2] = ka[0] + by * c[0], ka[1] + by * c[1], ka[2] + by * c[2]
    e[at + 3], e[at + 4], e[at + 5] = ka[3] + by * c[3], ka[4] + by * c[4], ka[5] + by * c[5]


@compiled_internal
def fill_prices(stages: Array, lanes: Array, weights: Array, constants: Array) -> None:
    """Fill the Hessian of the cost by positions, from weights (12,) along and across the path."""
    n = lanes.shape[1]
    shares = L.grid(constants, L.SHARE, n)
    for i in range(n):
        heading = stages[i + 1, L.REFERENCE_HEADING]
        c, s = math.cos(heading), math.sin(heading)
        last = i == n - 1
        along = weights[6] if last else shares[i + 1] * weights[2]
        across = weights[7] if last else shares[i + 1] * weights[3]
        lanes[L.PRICE_X, i] = c * c * along + s * s * across
        lanes[L.PRICE_CROSS, i] = c * s * (along - across)
        lanes[L.PRICE_Y, i] = s * s * along + c * c * across


@compiled_internal
def factor(stages: Array, lanes: Array, weights: Array, constants: Array) -> None:
    """Fill the stages' gains for weights (12,), the damping of `constants` and the barrier.

    If a matrix M is not positive definite the gains are not finite.
    """
    n = lanes.shape[1]
    shares, smooth = L.grid(constants, L.SHARE, n), L.grid(constants, L.SMOOTH, n)
    damping_a, damping_delta = constants[L.DAMPING_A], constants[L.DAMPING_DELTA]
    p00 = weights[4] + lanes[L.BARRIER_VX, n - 1]
    p01, p11 = lanes[L.BARRIER_CROSS, n - 1], lanes[L.BARRIER_VY, n - 1]
    p22, p44, p55 = weights[5], lanes[L.PRICE_X, n - 1], lanes[L.PRICE_Y, n - 1]
    p45 = lanes[L.PRICE_CROSS, n - 1]
    p02 = p03 = p04 = p05 = p12 = p13 = p14 = p15 = p23 = p24 = p25 = p33 = p34 = p35 = 0.0
    # T's columns (by a and by delta of the input before) and U.
    ta = td = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    uaa = uad = udd = 0.0
    for i in range(n - 1, -1, -1):
        e = stages[i]
        a0, a1, a3, ba, bd = taken(e, 0), taken(e, 6), taken(e, 12), taken(e, 20), taken(e, 26)
        a42, a52 = e[HEADING_X], e[HEADING_Y]
        p = (
            p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34,
            p35, p44, p45, p55,
        )  # fmt: skip
        # (P B + T)', then B' P B with T and U: the Hessian of the cost-to-go by u.
        ga, gd = plus(_product(p, ba), ta), plus(_product(p, bd), td)
        h, n_a, n_delta, share = lanes[L.BARRIER_RATE, i], e[RATE_A], e[RATE_DELTA], shares[i]
        haa = weights[8] * share + damping_a + lanes[L.BARRIER_A, i]
        haa += dot(ba, ga) + dot(ba, ta) + uaa
        hdd = weights[9] * share + damping_delta + lanes[L.BARRIER_DELTA, i]
        hdd += dot(bd, gd) + dot(bd, td) + udd
        had = dot(bd, ga) + dot(ba, td) + uad
        wa = lanes[L.BARRIER_CHANGE_A, i] + weights[10] * smooth[i]
        wd = lanes[L.BARRIER_CHANGE_DELTA, i] + weights[11] * smooth[i]
        maa, mdd = haa + wa, hdd + wd
        determinant = maa * mdd - had * had
        # A determinant that is not positive gives NaN gains, which the caller checks.
        inverse = 1.0 / determinant if determinant > 0.0 else NAN
        iaa, idd, iad = mdd * inverse, maa * inverse, -had * inverse
        # G = B' P A + T' A.
        qa, qd = _back(a0, a1, a3, a42, a52, ga), _back(a0, a1, a3, a42, a52, gd)
        # The term in vx' by Sherman and Morrison: h may be huge, and differences of huge numbers
        # would cancel P. With m = (n_a, n_delta), y = M^-1 m, c = n - G' y: P gains k c c'.
        fa, fd = iaa * n_a + iad * n_delta, iad * n_a + idd * n_delta
        k = h / (1.0 + h * (n_a * fa + n_delta * fd))
        qa0, qa1, qa2, qa3, qa4, qa5 = qa
        qd0, qd1, qd2, qd3, qd4, qd5 = qd
        c0, c1 = e[RATE_VX] - qa0 * fa - qd0 * fd, e[RATE_VY] - qa1 * fa - qd1 * fd
        c2, c3 = -qa2 * fa - qd2 * fd, e[RATE_R] - qa3 * fa - qd3 * fd
        c4, c5 = -qa4 * fa - qd4 * fd, -qa5 * fa - qd5 * fd
        # K = M^-1 G, and with the term in vx'.
        ka, kd = mixed(iaa, qa, iad, qd), mixed(iad, qa, idd, qd)
        kfa, kfd = k * fa, k * fd
        c = (c0, c1, c2, c3, c4, c5)
        _put(e, L.GAIN_A, ka, kfa, c)
        _put(e, L.GAIN_DELTA, kd, kfd, c)
        jaa, jad, jdd = iaa - kfa * fa, iad - kfa * fd, idd - kfd * fd
        e[L.INVERSE_AA], e[L.INVERSE_AD], e[L.INVERSE_DD] = jaa, jad, jdd
        e[L.CARRY], e[L.CARRY + 1] = jaa * wa, jad * wd
        e[L.CARRY + 2], e[L.CARRY + 3] = jad * wa, jdd * wd
        e[L.HOLD_A], e[L.HOLD_DELTA] = wa, wd
        if i == 0:
            break
        y0, y1, y3 = _product(p, a0), _product(p, a1), _product(p, a3)
        # Rows of A' (P A); column psi of P A, its rows psi, X, Y.
        z0, z1 = _back(a0, a1, a3, a42, a52, y0), _back(a0, a1, a3, a42, a52, y1)
        z3 = _back(a0, a1, a3, a42, a52, y3)
        y22 = p22 + a42 * p24 + a52 * p25
        y24 = p24 + a42 * p44 + a52 * p45
        y25 = p25 + a42 * p45 + a52 * p55
        h0, h1 = weights[0] * share + lanes[L.BARRIER_VX, i - 1], lanes[L.BARRIER_VY, i - 1]
        h5 = lanes[L.BARRIER_CROSS, i - 1]
        ka0, ka1, ka2, ka3, ka4, ka5 = ka
        kd0, kd1, kd2, kd3, kd4, kd5 = kd
        # P = Hx + A' P A - G' M^-1 G + k c c'.
        p00 = _entry(z0[0] + h0, k, c0, c0, qa0, ka0, qd0, kd0)
        p01 = _entry(z1[0] + h5, k, c0, c1, qa0, ka1, qd0, kd1)
        p02 = _entry(z0[2], k, c0, c2, qa0, ka2, qd0, kd2)
        p03 = _entry(z3[0], k, c0, c3, qa0, ka3, qd0, kd3)
        p04 = _entry(z0[4], k, c4, c0, qa0, ka4, qd0, kd4)
        p05 = _entry(z0[5], k, c5, c0, qa0, ka5, qd0, kd5)
        p11 = _entry(z1[1] + h1, k, c1, c1, qa1, ka1, qd1, kd1)
        p12 = _entry(z1[2], k, c1, c2, qa1, ka2, qd1, kd2)
        p13 = _entry(z3[1], k, c1, c3, qa1, ka3, qd1, kd3)
        p14 = _entry(z1[4], k, c4, c1, qa1, ka4, qd1, kd4)
        p15 = _entry(z1[5], k, c5, c1, qa1, ka5, qd1, kd5)
        p22 = _entry(
            y22 + a42 * y24 + a52 * y25 + weights[1] * share, k, c2, c2, qa2, ka2, qd2, kd2
        )
        p23 = _entry(z3[2], k, c2, c3, qa3, ka2, qd3, kd2)
        p24 = _entry(y24, k, c4, c2, qa2, ka4, qd2, kd4)
        p25 = _entry(y25, k, c5, c2, qa2, ka5, qd2, kd5)
        p33 = _entry(z3[3], k, c3, c3, qa3, ka3, qd3, kd3)
        p34 = _entry(z3[4], k, c4, c3, qa3, ka4, qd3, kd4)
        p35 = _entry(z3[5], k, c5, c3, qa3, ka5, qd3, kd5)
        p44 = _entry(p44 + lanes[L.PRICE_X, i - 1], k, c4, c4, qa4, ka4, qd4, kd4)
        p45 = _entry(p45 + lanes[L.PRICE_CROSS, i - 1], k, c4, c5, qa4, ka5, qd4, kd5)
        p55 = _entry(p55 + lanes[L.PRICE_Y, i - 1], k, c5, c5, qa5, ka5, qd5, kd5)
        # T = K' W, U = W M^-1 (M - W): no cancellation where W is large.
        ta, td = scaled(taken(e, L.GAIN_A), wa), scaled(taken(e, L.GAIN_DELTA), wd)
        uaa = wa * (iaa * haa + iad * had + kfa * fa * wa)
        uad = wa * (iaa * had + iad * hdd + kfa * fd * wd)
        udd = wd * (iad * had + idd * hdd + kfd * fd * wd)


@compiled_internal
def _along(e: Array, at: int, s: Six) -> Float:
    """Inner product of six entries of a stage, from `at` on, with s."""
    return (
        e[at] * s[0] + e[at + 1] * s[1] + e[at + 2] * s[2] + e[at + 3] * s[3] + e[at + 4] * s[4]
        + e[at + 5] * s[5]
    )  # fmt: skip


@compiled_internal
def moved(e: Array, k: int, dvx: Float, dvy: Float, dr: Float, da: Float, ddelta: Float) -> Float:
    """Change of the next stage's state k by all but heading and position: row k of A and B."""
    return e[k] * dvx + e[6 + k] * dvy + e[12 + k] * dr + e[20 + k] * da + e[26 + k] * ddelta


@compiled_internal
def _turned(
    e: Array, k: int, turn: Float, dvx: Float, dvy: Float, dr: Float, da: Float, ddelta: Float
) -> Float:
    """`moved` plus the change `turn` by the heading."""
    return e[k] * dvx + e[6 + k] * dvy + e[12 + k] * dr + turn + e[20 + k] * da + e[26 + k] * ddelta


@compiled_internal
def solve(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array, constants: Array
) -> None:
    """Fill the stages' step from gains, solution and slope; the damping pulls to the plan.

    (last_a, last_delta) is the input in force.
    """
    n = lanes.shape[1]
    shares, smooth = L.grid(constants, L.SHARE, n), L.grid(constants, L.SMOOTH, n)
    damping_a, damping_delta = constants[L.DAMPING_A], constants[L.DAMPING_DELTA]
    e = stages[n]
    s0 = weights[4] * (e[L.NOW_VX] - e[L.REFERENCE]) + lanes[L.SLOPE_VX, n - 1]
    s1, s2 = lanes[L.SLOPE_VY, n - 1], weights[5] * (e[L.NOW_PSI] - e[L.REFERENCE_HEADING])
    ex, ey = e[L.NOW_X] - e[L.REFERENCE_X], e[L.NOW_Y] - e[L.REFERENCE_Y]
    s3, s4 = 0.0, lanes[L.PRICE_X, n - 1] * ex + lanes[L.PRICE_CROSS, n - 1] * ey
    s5 = lanes[L.PRICE_CROSS, n - 1] * ex + lanes[L.PRICE_Y, n - 1] * ey
    ta = td = 0.0
    for i in range(n - 1, -1, -1):
        e = stages[i]
        a, delta, along = e[L.NOW_A], e[L.NOW_DELTA], lanes[L.SLOPE_RATE, i]
        share, before_a, before_delta = shares[i], last_a, last_delta
        if i > 0:
            before_a, before_delta = stages[i - 1, L.NOW_A], stages[i - 1, L.NOW_DELTA]
        change_a = lanes[L.SLOPE_CHANGE_A, i] + weights[10] * smooth[i] * (a - before_a)
        change_delta = lanes[L.SLOPE_CHANGE_DELTA, i]
        change_delta += weights[11] * smooth[i] * (delta - before_delta)
        s = (s0, s1, s2, s3, s4, s5)
        ma = weights[8] * share * a + damping_a * (a - e[L.PLAN_A]) + along * e[RATE_A]
        ma = ma + lanes[L.SLOPE_A, i] + change_a + ta + _along(e, 20, s)
        md = weights[9] * share * delta + damping_delta * (delta - e[L.PLAN_DELTA])
        md += along * e[RATE_DELTA] + lanes[L.SLOPE_DELTA, i] + change_delta + td
        md += _along(e, 26, s)
        ka = e[L.INVERSE_AA] * ma + e[L.INVERSE_AD] * md
        kd = e[L.INVERSE_AD] * ma + e[L.INVERSE_DD] * md
        e[L.STEP_A], e[L.STEP_DELTA] = ka, kd
        ta, td = e[L.HOLD_A] * ka - change_a, e[L.HOLD_DELTA] * kd - change_delta
        if i == 0:
            break
        f0 = _along(e, 0, s) + weights[0] * share * (e[L.NOW_VX] - e[L.REFERENCE])
        f0 += lanes[L.SLOPE_VX, i - 1]
        f1 = _along(e, 6, s) + lanes[L.SLOPE_VY, i - 1] + along * e[RATE_VY]
        f2 = s2 + e[HEADING_X] * s4 + e[HEADING_Y] * s5
        f2 += weights[1] * share * (e[L.NOW_PSI] - e[L.REFERENCE_HEADING])
        s3 = _along(e, 12, s) + along * e[RATE_R] - e[L.GAIN_A + 3] * ma - e[L.GAIN_DELTA + 3] * md
        s0 = f0 + along * e[RATE_VX] - (e[L.GAIN_A] * ma + e[L.GAIN_DELTA] * md)
        s1 = f1 - e[L.GAIN_A + 1] * ma - e[L.GAIN_DELTA + 1] * md
        s2 = f2 - e[L.GAIN_A + 2] * ma - e[L.GAIN_DELTA + 2] * md
        ex, ey = e[L.NOW_X] - e[L.REFERENCE_X], e[L.NOW_Y] - e[L.REFERENCE_Y]
        f4 = lanes[L.PRICE_X, i - 1] * ex + lanes[L.PRICE_CROSS, i - 1] * ey
        f5 = lanes[L.PRICE_CROSS, i - 1] * ex + lanes[L.PRICE_Y, i - 1] * ey
        s4 += f4 - e[L.GAIN_A + 4] * ma - e[L.GAIN_DELTA + 4] * md
        s5 += f5 - e[L.GAIN_A + 5] * ma - e[L.GAIN_DELTA + 5] * md
    x0 = x1 = x2 = x3 = x4 = x5 = 0.0
    pa = pd = 0.0
    e = stages[0]
    e[L.STEP_VX] = e[L.STEP_VY] = e[L.STEP_PSI] = e[L.STEP_R] = e[L.STEP_X] = e[L.STEP_Y] = 0.0
    for i in range(n):
        e, f = stages[i], stages[i + 1]
        x = (x0, x1, x2, x3, x4, x5)
        ua = e[L.CARRY] * pa + e[L.CARRY + 1] * pd - e[L.STEP_A] - _along(e, L.GAIN_A, x)
        ud = e[L.CARRY + 2] * pa + e[L.CARRY + 3] * pd - e[L.STEP_DELTA]
        ud -= _along(e, L.GAIN_DELTA, x)
        x4 += _turned(e, 4, e[HEADING_X] * x2, x0, x1, x3, ua, ud)
        x5 += _turned(e, 5, e[HEADING_Y] * x2, x0, x1, x3, ua, ud)
        x2 += moved(e, 2, x0, x1, x3, ua, ud)
        y0, y1 = moved(e, 0, x0, x1, x3, ua, ud), moved(e, 1, x0, x1, x3, ua, ud)
        x3 = moved(e, 3, x0, x1, x3, ua, ud)
        x0, x1, pa, pd = y0, y1, ua, ud
        e[L.STEP_A], e[L.STEP_DELTA] = ua, ud
        f[L.STEP_VX], f[L.STEP_VY], f[L.STEP_PSI] = x0, x1, x2
        f[L.STEP_R], f[L.STEP_X], f[L.STEP_Y] = x3, x4, x5
