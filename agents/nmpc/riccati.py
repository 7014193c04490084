"""Newton steps of the NMPC's quadratic program by Riccati recursions over its stages.

One step minimises, over dx_0 = 0, dx_{i+1} = A_i dx_i + B_i du_i and du_{-1} = 0,

    sum_i 1/2 dx_i' Hx_i dx_i + gx_i' dx_i  +  1/2 du_i' Hu_i du_i + gu_i' du_i
        + 1/2 h_i (n_i' [dx_i; du_i])^2 + k_i n_i' [dx_i; du_i]
        + 1/2 (du_i - du_{i-1})' W_i (du_i - du_{i-1}) + w_i' (du_i - du_{i-1})

with n_i the gradient of vx', Hu and W diagonal, and Hx diagonal but for (vx, vy). Hessians and
gradients are the cost's own, which is taken at a current `states` and `inputs`, plus what the
inequalities add: rows of `barrier` and `slope` by stage,

    0, 1  a, delta    2, 3  their changes    4  vx'    5..   vx, vy at the period's end

(`barrier` has (vx, vx), (vx, vy), (vy, vy) in 5 to 7). The value function of stage i has as its
arguments dx_i and p = du_{i-1}:

    1/2 x' P x + x' T p + 1/2 p' U p + s' x + t' p

`factor` runs the matrix part once for a Hessian, `solve` the vector part for each gradient.
Records of a period's derivatives are those of `linearisation`.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc.linearisation import (
    HEADING_X,
    HEADING_Y,
    RATE_DELTA,
    RATE_R,
    RATE_VX,
    RATE_VY,
)
from lpv_track_env.bicycle import PSI, VX, X, Y
from trajectories.compilation import compiled

Array = NDArray[Any]
Float = Any

BARRIER, SLOPE = 8, 7
"""Rows of what the inequalities add to Hessian and gradient."""
GAIN = 21
"""Of a stage: K (2, 6); M^-1 W (2, 2); M^-1 (3); W (2)."""
NAN = math.nan


@compiled
def _product(
    p00: Float, p01: Float, p02: Float, p03: Float, p04: Float, p05: Float, p11: Float,
    p12: Float, p13: Float, p14: Float, p15: Float, p22: Float, p23: Float, p24: Float,
    p25: Float, p33: Float, p34: Float, p35: Float, p44: Float, p45: Float, p55: Float,
    v0: Float, v1: Float, v2: Float, v3: Float, v4: Float, v5: Float,
) -> Any:  # fmt: skip
    """P v for a symmetric P."""
    return (
        p00 * v0 + p01 * v1 + p02 * v2 + p03 * v3 + p04 * v4 + p05 * v5,
        p01 * v0 + p11 * v1 + p12 * v2 + p13 * v3 + p14 * v4 + p15 * v5,
        p02 * v0 + p12 * v1 + p22 * v2 + p23 * v3 + p24 * v4 + p25 * v5,
        p03 * v0 + p13 * v1 + p23 * v2 + p33 * v3 + p34 * v4 + p35 * v5,
        p04 * v0 + p14 * v1 + p24 * v2 + p34 * v3 + p44 * v4 + p45 * v5,
        p05 * v0 + p15 * v1 + p25 * v2 + p35 * v3 + p45 * v4 + p55 * v5,
    )


@compiled
def _dot(
    a0: Float, a1: Float, a2: Float, a3: Float, a4: Float, a5: Float, y: Any
) -> Any:  # fmt: skip
    return a0 * y[0] + a1 * y[1] + a2 * y[2] + a3 * y[3] + a4 * y[4] + a5 * y[5]


@compiled
def factor(
    records: Array, weights: Array, damping_a: Float, damping_delta: Float, barrier: Array,
    gains: Array,
) -> None:  # fmt: skip
    """Fill `gains` (N, GAIN) for weights (10,), damping on the inputs and `barrier` (BARRIER, N).

    A matrix M that is not positive definite shows as gains that are not finite.
    """
    n = records.shape[0]
    q0, q2, q4, q5 = weights[0], weights[1], weights[2], weights[3]
    ra, rd = weights[8] + damping_a, weights[9] + damping_delta
    p00, p01, p11 = weights[4] + barrier[5, n - 1], barrier[6, n - 1], barrier[7, n - 1]
    p22, p44, p55 = weights[5], weights[6], weights[7]
    p02 = p03 = p04 = p05 = p12 = p13 = p14 = p15 = p23 = p24 = p25 = p33 = p34 = p35 = p45 = 0.0
    # T's columns (by a and by delta of the input before) and U.
    ta0 = ta1 = ta2 = ta3 = ta4 = ta5 = td0 = td1 = td2 = td3 = td4 = td5 = 0.0
    uaa = uad = udd = 0.0
    for i in range(n - 1, -1, -1):
        e, g = records[i], gains[i]
        a00, a10, a20, a30, a40, a50 = e[0], e[1], e[2], e[3], e[4], e[5]
        a01, a11, a21, a31, a41, a51 = e[6], e[7], e[8], e[9], e[10], e[11]
        a03, a13, a23, a33, a43, a53 = e[12], e[13], e[14], e[15], e[16], e[17]
        a42, a52 = e[HEADING_X], e[HEADING_Y]
        ba0, ba1, ba2, ba3, ba4, ba5 = e[20], e[21], e[22], e[23], e[24], e[25]
        bd0, bd1, bd2, bd3, bd4, bd5 = e[26], e[27], e[28], e[29], e[30], e[31]
        # P B and B' P B, with T and U: the Hessian by u of what follows.
        ya = _product(
            p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34,
            p35, p44, p45, p55, ba0, ba1, ba2, ba3, ba4, ba5,
        )  # fmt: skip
        yd = _product(
            p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34,
            p35, p44, p45, p55, bd0, bd1, bd2, bd3, bd4, bd5,
        )  # fmt: skip
        # (P B + T)': what the input meets of the state that follows.
        ga0, ga1, ga2 = ya[0] + ta0, ya[1] + ta1, ya[2] + ta2
        ga3, ga4, ga5 = ya[3] + ta3, ya[4] + ta4, ya[5] + ta5
        gd0, gd1, gd2 = yd[0] + td0, yd[1] + td1, yd[2] + td2
        gd3, gd4, gd5 = yd[3] + td3, yd[4] + td4, yd[5] + td5
        xa, xd = (ga0, ga1, ga2, ga3, ga4, ga5), (gd0, gd1, gd2, gd3, gd4, gd5)
        h, n_delta = barrier[4, i], e[RATE_DELTA]
        bta_a = ba0 * ta0 + ba1 * ta1 + ba2 * ta2 + ba3 * ta3 + ba4 * ta4 + ba5 * ta5
        btd_d = bd0 * td0 + bd1 * td1 + bd2 * td2 + bd3 * td3 + bd4 * td4 + bd5 * td5
        bta_d = ba0 * td0 + ba1 * td1 + ba2 * td2 + ba3 * td3 + ba4 * td4 + ba5 * td5
        haa = ra + barrier[0, i] + _dot(ba0, ba1, ba2, ba3, ba4, ba5, xa) + bta_a + uaa
        hdd = rd + barrier[1, i] + _dot(bd0, bd1, bd2, bd3, bd4, bd5, xd) + btd_d + udd
        had = _dot(bd0, bd1, bd2, bd3, bd4, bd5, xa) + bta_d + uad
        wa, wd = barrier[2, i], barrier[3, i]
        maa, mdd = haa + wa, hdd + wd
        determinant = maa * mdd - had * had
        # A determinant that is not positive gives NaN gains: the caller sees it.
        inverse = 1.0 / determinant if determinant > 0.0 else NAN
        iaa, idd, iad = mdd * inverse, maa * inverse, -had * inverse
        # G = B' P A + T' A.
        qa0 = _dot(a00, a10, a20, a30, a40, a50, xa)
        qa1 = _dot(a01, a11, a21, a31, a41, a51, xa)
        qa2 = ga2 + a42 * ga4 + a52 * ga5
        qa3 = _dot(a03, a13, a23, a33, a43, a53, xa)
        qd0 = _dot(a00, a10, a20, a30, a40, a50, xd)
        qd1 = _dot(a01, a11, a21, a31, a41, a51, xd)
        qd2 = gd2 + a42 * gd4 + a52 * gd5
        qd3 = _dot(a03, a13, a23, a33, a43, a53, xd)
        # The term in vx' by Sherman and Morrison: h may be huge, and differences of what is huge
        # would lose P. With m = (1, n_delta), y = M^-1 m, c = n - G' y: P gains k c c'.
        fa, fd = iaa + iad * n_delta, iad + idd * n_delta
        k = h / (1.0 + h * (fa + n_delta * fd))
        c0, c1 = e[RATE_VX] - qa0 * fa - qd0 * fd, e[RATE_VY] - qa1 * fa - qd1 * fd
        c2, c3 = -qa2 * fa - qd2 * fd, e[RATE_R] - qa3 * fa - qd3 * fd
        c4, c5 = -ga4 * fa - gd4 * fd, -ga5 * fa - gd5 * fd
        # K = M^-1 G.
        ka0, kd0 = iaa * qa0 + iad * qd0, iad * qa0 + idd * qd0
        ka1, kd1 = iaa * qa1 + iad * qd1, iad * qa1 + idd * qd1
        ka2, kd2 = iaa * qa2 + iad * qd2, iad * qa2 + idd * qd2
        ka3, kd3 = iaa * qa3 + iad * qd3, iad * qa3 + idd * qd3
        ka4, kd4 = iaa * ga4 + iad * gd4, iad * ga4 + idd * gd4
        ka5, kd5 = iaa * ga5 + iad * gd5, iad * ga5 + idd * gd5
        kfa, kfd = k * fa, k * fd
        g[0], g[1], g[2] = ka0 + kfa * c0, ka1 + kfa * c1, ka2 + kfa * c2
        g[3], g[4], g[5] = ka3 + kfa * c3, ka4 + kfa * c4, ka5 + kfa * c5
        g[6], g[7], g[8] = kd0 + kfd * c0, kd1 + kfd * c1, kd2 + kfd * c2
        g[9], g[10], g[11] = kd3 + kfd * c3, kd4 + kfd * c4, kd5 + kfd * c5
        g[16], g[17], g[18] = iaa - kfa * fa, iad - kfa * fd, idd - kfd * fd
        g[12], g[13], g[14], g[15] = g[16] * wa, g[17] * wd, g[17] * wa, g[18] * wd
        g[19], g[20] = wa, wd
        if i == 0:
            break
        h0, h1, h5 = q0 + barrier[5, i - 1], barrier[7, i - 1], barrier[6, i - 1]
        y0 = _product(
            p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34,
            p35, p44, p45, p55, a00, a10, a20, a30, a40, a50,
        )  # fmt: skip
        y1 = _product(
            p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34,
            p35, p44, p45, p55, a01, a11, a21, a31, a41, a51,
        )  # fmt: skip
        y3 = _product(
            p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34,
            p35, p44, p45, p55, a03, a13, a23, a33, a43, a53,
        )  # fmt: skip
        # Column psi of P A, its rows psi, X, Y.
        y22 = p22 + a42 * p24 + a52 * p25
        y24 = p24 + a42 * p44 + a52 * p45
        y25 = p25 + a42 * p45 + a52 * p55
        # P = Hx + A' P A - G' M^-1 G + k c c'.
        f00 = _dot(a00, a10, a20, a30, a40, a50, y0) + h0 + k * c0 * c0 - qa0 * ka0 - qd0 * kd0
        f01 = _dot(a00, a10, a20, a30, a40, a50, y1) + h5 + k * c0 * c1 - qa0 * ka1 - qd0 * kd1
        f03 = _dot(a00, a10, a20, a30, a40, a50, y3) + k * c0 * c3 - qa0 * ka3 - qd0 * kd3
        f11 = _dot(a01, a11, a21, a31, a41, a51, y1) + h1 + k * c1 * c1 - qa1 * ka1 - qd1 * kd1
        f13 = _dot(a01, a11, a21, a31, a41, a51, y3) + k * c1 * c3 - qa1 * ka3 - qd1 * kd3
        f33 = _dot(a03, a13, a23, a33, a43, a53, y3) + k * c3 * c3 - qa3 * ka3 - qd3 * kd3
        f02 = y0[2] + a42 * y0[4] + a52 * y0[5] + k * c0 * c2 - qa0 * ka2 - qd0 * kd2
        f12 = y1[2] + a42 * y1[4] + a52 * y1[5] + k * c1 * c2 - qa1 * ka2 - qd1 * kd2
        f23 = y3[2] + a42 * y3[4] + a52 * y3[5] + k * c2 * c3 - qa3 * ka2 - qd3 * kd2
        f22 = y22 + a42 * y24 + a52 * y25 + q2 + k * c2 * c2 - qa2 * ka2 - qd2 * kd2
        kc4, kc5 = k * c4, k * c5
        f04 = y0[4] + kc4 * c0 - qa0 * ka4 - qd0 * kd4
        f05 = y0[5] + kc5 * c0 - qa0 * ka5 - qd0 * kd5
        f14 = y1[4] + kc4 * c1 - qa1 * ka4 - qd1 * kd4
        f15 = y1[5] + kc5 * c1 - qa1 * ka5 - qd1 * kd5
        f24 = y24 + kc4 * c2 - qa2 * ka4 - qd2 * kd4
        f25 = y25 + kc5 * c2 - qa2 * ka5 - qd2 * kd5
        f34 = y3[4] + kc4 * c3 - qa3 * ka4 - qd3 * kd4
        f35 = y3[5] + kc5 * c3 - qa3 * ka5 - qd3 * kd5
        p44 = p44 + q4 + kc4 * c4 - ga4 * ka4 - gd4 * kd4
        p45 = p45 + kc4 * c5 - ga4 * ka5 - gd4 * kd5
        p55 = p55 + q5 + kc5 * c5 - ga5 * ka5 - gd5 * kd5
        p00, p01, p02, p03, p04, p05 = f00, f01, f02, f03, f04, f05
        p11, p12, p13, p14, p15, p22, p23 = f11, f12, f13, f14, f15, f22, f23
        p24, p25, p33, p34, p35 = f24, f25, f33, f34, f35
        # T = K' W, U = W M^-1 (M - W), which loses no digits where W is large.
        ta0, ta1, ta2 = g[0] * wa, g[1] * wa, g[2] * wa
        ta3, ta4, ta5 = g[3] * wa, g[4] * wa, g[5] * wa
        td0, td1, td2 = g[6] * wd, g[7] * wd, g[8] * wd
        td3, td4, td5 = g[9] * wd, g[10] * wd, g[11] * wd
        uaa = wa * (iaa * haa + iad * had + kfa * fa * wa)
        uad = wa * (iaa * had + iad * hdd + kfa * fd * wd)
        udd = wd * (iad * had + idd * hdd + kfd * fd * wd)


@compiled
def solve(
    records: Array, gains: Array, weights: Array, damping_a: Float, damping_delta: Float,
    states: Array, inputs: Array, plan: Array, reference: Array, slope: Array, dx: Array, du: Array,
) -> None:  # fmt: skip
    """Fill the step dx (N + 1, 6), du (N, 2) from states (N + 1, 6) and inputs (N, 2).

    `plan` (N, 2) is what the damping pulls to, `reference` (N + 1, >= 4), `slope` (SLOPE, N).
    """
    n = records.shape[0]
    x, y = states[n], reference[n]
    s0, s1 = weights[4] * (x[VX] - y[0]) + slope[5, n - 1], slope[6, n - 1]
    s2, s3 = weights[5] * (x[PSI] - y[1]), 0.0
    s4, s5 = weights[6] * (x[X] - y[2]), weights[7] * (x[Y] - y[3])
    ta = td = 0.0
    for i in range(n - 1, -1, -1):
        e, g = records[i], gains[i]
        a, delta, along = inputs[i, 0], inputs[i, 1], slope[4, i]
        ma = weights[8] * a + damping_a * (a - plan[i, 0]) + along + slope[0, i] + slope[2, i] + ta
        ma += e[20] * s0 + e[21] * s1 + e[22] * s2 + e[23] * s3 + e[24] * s4 + e[25] * s5
        md = weights[9] * delta + damping_delta * (delta - plan[i, 1])
        md += along * e[RATE_DELTA] + slope[1, i] + slope[3, i] + td
        md += e[26] * s0 + e[27] * s1 + e[28] * s2 + e[29] * s3 + e[30] * s4 + e[31] * s5
        ka, kd = g[16] * ma + g[17] * md, g[17] * ma + g[18] * md
        du[i, 0], du[i, 1] = ka, kd
        ta, td = g[19] * ka - slope[2, i], g[20] * kd - slope[3, i]
        if i == 0:
            break
        f0 = e[0] * s0 + e[1] * s1 + e[2] * s2 + e[3] * s3 + e[4] * s4 + e[5] * s5
        f1 = e[6] * s0 + e[7] * s1 + e[8] * s2 + e[9] * s3 + e[10] * s4 + e[11] * s5
        f2 = s2 + e[HEADING_X] * s4 + e[HEADING_Y] * s5
        f3 = e[12] * s0 + e[13] * s1 + e[14] * s2 + e[15] * s3 + e[16] * s4 + e[17] * s5
        x, y = states[i], reference[i]
        s0 = f0 + weights[0] * (x[VX] - y[0]) + slope[5, i - 1] + along * e[RATE_VX]
        s0 -= g[0] * ma + g[6] * md
        s1 = f1 + slope[6, i - 1] + along * e[RATE_VY] - g[1] * ma - g[7] * md
        s2 = f2 + weights[1] * (x[PSI] - y[1]) - g[2] * ma - g[8] * md
        s3 = f3 + along * e[RATE_R] - g[3] * ma - g[9] * md
        s4 += weights[2] * (x[X] - y[2]) - g[4] * ma - g[10] * md
        s5 += weights[3] * (x[Y] - y[3]) - g[5] * ma - g[11] * md
    x0 = x1 = x2 = x3 = x4 = x5 = 0.0
    pa = pd = 0.0
    for k in range(6):
        dx[0, k] = 0.0
    for i in range(n):
        e, g = records[i], gains[i]
        ua = g[12] * pa + g[13] * pd - du[i, 0]
        ua -= g[0] * x0 + g[1] * x1 + g[2] * x2 + g[3] * x3 + g[4] * x4 + g[5] * x5
        ud = g[14] * pa + g[15] * pd - du[i, 1]
        ud -= g[6] * x0 + g[7] * x1 + g[8] * x2 + g[9] * x3 + g[10] * x4 + g[11] * x5
        y0 = e[0] * x0 + e[6] * x1 + e[12] * x3 + e[20] * ua + e[26] * ud
        y1 = e[1] * x0 + e[7] * x1 + e[13] * x3 + e[21] * ua + e[27] * ud
        y3 = e[3] * x0 + e[9] * x1 + e[15] * x3 + e[23] * ua + e[29] * ud
        x4 += e[4] * x0 + e[10] * x1 + e[16] * x3 + e[HEADING_X] * x2 + e[24] * ua + e[30] * ud
        x5 += e[5] * x0 + e[11] * x1 + e[17] * x3 + e[HEADING_Y] * x2 + e[25] * ua + e[31] * ud
        x2 += e[2] * x0 + e[8] * x1 + e[14] * x3 + e[22] * ua + e[28] * ud
        x0, x1, x3 = y0, y1, y3
        pa, pd = ua, ud
        du[i, 0], du[i, 1] = ua, ud
        f = dx[i + 1]
        f[0], f[1], f[2], f[3], f[4], f[5] = x0, x1, x2, x3, x4, x5
