"""The NMPC's discrete model and its exact derivatives, compiled.

The model is that of `casadi_solvers.discrete_model`: classic Runge-Kutta steps of the vector field
over a stage, with constant inputs. A stage is integrated in the frame of the vehicle at its
start, since the motion does not depend on position and heading: only small angles are rotated, and
the derivatives by heading and position need no integration.

The derivatives of a stage are stored in its row (`layout`), in this order::

    0..17   columns vx, vy, r of A, six rows each     18, 19  A[X, psi], A[Y, psi]
    20..31  columns a, delta of B, six rows each
    32      vx' at the stage's start                  33..37  its derivatives by vx, vy, r, delta, a

The other columns of A are unit vectors.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.nmpc import layout as L
from lpv_track_env.bicycle import (
    PSI,
    VX,
    VY,
    YAW_RATE,
    X,
    Y,
    compiled_field,
    compiled_inverse_speed,
    compiled_inverse_speed_slope,
    compiled_jacobian,
)
from lpv_track_env.integration import integrate, integrate_sliding, rotate
from lpv_track_env.tyres import (
    axle_shares,
    command_derivatives,
    compiled_slips,
    secant,
)
from trajectories.compilation import compiled, compiled_inline, compiled_internal

Array = NDArray[Any]
# Floats, and vectors of six as tuples, in compiled code: numba ignores annotations.
Float = Any
Six = Any

HEADING_X, HEADING_Y, RATE, RATE_VX, RATE_VY, RATE_R, RATE_DELTA, RATE_A = (
    18, 19, 32, 33, 34, 35, 36, 37,
)  # fmt: skip
RESOLVED = 1.5
"""Largest product of a Runge-Kutta step that is chosen by speed and the fastest lateral pole."""
SEEDS = 5
"""Number of integrated directions: vx, vy, r at the stage's start, a, delta."""
DYNAMIC = (VX, VY, YAW_RATE)


class Linearisation(NamedTuple):
    """The model along a plan: `states` (N + 1, 6), A (N, 6, 6), B (N, 6, 2) and vx'."""

    states: Array
    A: Array
    B: Array
    rate: Array
    """vx' at each stage's start, (N,) m/s^2."""
    rate_x: Array
    """Derivatives of vx' by the state, (N, 6)."""
    rate_u: Array
    """Derivatives of vx' by the input, (N, 2)."""


@compiled_internal
def taken(values: Array, at: int) -> Six:
    """Six entries of an array, from `at` on."""
    return (
        values[at], values[at + 1], values[at + 2], values[at + 3], values[at + 4], values[at + 5],
    )  # fmt: skip


@compiled_internal
def dot(x: Six, y: Six) -> Float:
    """Inner product x' y."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3] + x[4] * y[4] + x[5] * y[5]


@compiled_internal
def plus(x: Six, y: Six) -> Six:
    """Sum x + y."""
    return x[0] + y[0], x[1] + y[1], x[2] + y[2], x[3] + y[3], x[4] + y[4], x[5] + y[5]


@compiled_internal
def scaled(x: Six, by: Float) -> Six:
    """Vector x times a number."""
    return x[0] * by, x[1] * by, x[2] * by, x[3] * by, x[4] * by, x[5] * by


@compiled_internal
def mixed(a: Float, x: Six, b: Float, y: Six) -> Six:
    """Linear combination a x + b y."""
    return (
        a * x[0] + b * y[0],
        a * x[1] + b * y[1],
        a * x[2] + b * y[2],
        a * x[3] + b * y[3],
        a * x[4] + b * y[4],
        a * x[5] + b * y[5],
    )


@compiled_internal
def substeps(vx: Float, a: Float, length: Float, grids: Float, p: Array) -> int:
    """Return the Runge-Kutta steps of a stage that starts at vx (m/s), by default the grid's.

    Where `p` names a pole, the steps resolve it at the lowest speed of the stage, even standstill.
    """
    if p[L.POLE] <= 0.0:
        return int(grids)
    slowest = max(abs(vx) - abs(a) * length, 0.0)
    wanted = math.ceil(length * p[L.POLE] * compiled_inverse_speed(slowest) * (1.0 / RESOLVED))
    return int(max(wanted, 1.0))


@compiled_internal
def tyre_of(p: Array) -> Any:
    """Return the constants of the model's tyres, as `tyres.constants` does."""
    t = L.TYRE
    return p[t], p[t + 1], p[t + 2], p[t + 3], p[t + 4], p[t + 5]


@compiled_internal
def advance(state: Any, a: Float, delta: Float, length: Float, grids: Float, p: Array) -> Any:
    """State (vx, vy, psi, r, X, Y) after a stage of `length` s with constant inputs.

    `grids` are the grid's Runge-Kutta steps of the stage, and `p` the constants.
    """
    n = substeps(state[VX], a, length, grids, p)
    if p[L.TYRE + 1] < math.inf:
        vx, vy, psi, r, x, y = integrate_sliding(
            state[VX], state[VY], 0.0, state[YAW_RATE], 0.0, 0.0, a, delta,
            p[0], p[1], p[2], p[3], p[4], p[5], p[6], tyre_of(p), length / n, n,
        )  # fmt: skip
    else:
        vx, vy, psi, r, x, y = integrate(
            state[VX], state[VY], 0.0, state[YAW_RATE], 0.0, 0.0, a, delta,
            p[0], p[1], p[2], p[3], p[4], p[5], p[6], length / n, n,
        )  # fmt: skip
    c, s = math.cos(state[PSI]), math.sin(state[PSI])
    return vx, vy, state[PSI] + psi, r, state[X] + c * x - s * y, state[Y] + s * x + c * y


@compiled_inline
def _rates(
    vx: Float, vy: Float, r: Float, c: Float, s: Float, a: Float, delta: Float, cd: Float,
    sd: Float, p: Any, command: Any, slides: bool,
) -> Any:  # fmt: skip
    """Vector field, its Jacobian, and its derivatives (vx', vy', r') by the input a.

    `p` are the model's 7 parameters, `command` the `tyres.command_derivatives` of a if the tyres'
    friction is limited, which `slides` tells at compile time.
    """
    m, iz, lf, lr, caf, car, mu = p
    q, slope = compiled_inverse_speed(vx), compiled_inverse_speed_slope(vx)
    if not slides:
        return (
            compiled_field(vx, vy, r, c, s, a, delta, cd, sd, q, m, iz, lf, lr, caf, car, mu),
            compiled_jacobian(vx, vy, r, delta, cd, sd, q, slope, m, iz, lf, lr, caf, car, mu, caf),
            (1.0, 0.0, 0.0),
        )
    ax, nf, nr, slope_a, nf_a, nr_a = command
    front, rear = compiled_slips(vx, vy, r, delta, q, lf, lr)
    distance, rear_distance = abs(front), abs(rear)
    share, tangent, sharpening = axle_shares(nf * distance)
    rear_share, rear_tangent, rear_sharpening = axle_shares(nr * rear_distance)
    # Derivatives of the axles' forces by a, with that of n.
    front_a = (caf * nf_a) * (front * distance * sharpening)
    rear_a = (car * nr_a) * (rear * rear_distance * rear_sharpening)
    across, per_mass, per_inertia = front_a * cd, 1.0 / m, 1.0 / iz
    secant_f, secant_r = caf * share, car * rear_share
    return (
        compiled_field(
            vx, vy, r, c, s, ax, delta, cd, sd, q, m, iz, lf, lr, secant_f, secant_r, mu
        ),
        compiled_jacobian(
            vx, vy, r, delta, cd, sd, q, slope, m, iz, lf, lr, caf * tangent, car * rear_tangent,
            mu, secant_f,
        ),
        (
            slope_a - front_a * sd * per_mass,
            (rear_a + across) * per_mass,
            (across * lf - rear_a * lr) * per_inertia,
        ),
    )  # fmt: skip


@compiled_internal
def acceleration(state: Any, a: Float, delta: Float, p: Array) -> Float:
    """Return vx' of the model at a state (vx, vy, psi, r, X, Y) and an input."""
    vx, cd, sd = state[VX], math.cos(delta), math.sin(delta)
    q, caf, car, ax = compiled_inverse_speed(vx), p[4], p[5], a
    if p[L.TYRE + 1] < math.inf:
        ax, nf, nr, _, _, _ = command_derivatives(a, tyre_of(p))
        front, rear = compiled_slips(vx, state[VY], state[YAW_RATE], delta, q, p[2], p[3])
        caf, car = secant(caf, nf, front), secant(car, nr, rear)
    return compiled_field(
        vx, state[VY], state[YAW_RATE], 1.0, 0.0, ax, delta, cd, sd, q, p[0], p[1], p[2], p[3],
        caf, car, p[6],
    )[0]  # fmt: skip


@compiled_inline
def _directional(
    j: Any, by_input: Any, zx: Float, zy: Float, zp: Float, zr: Float, by_a: Float, by_delta: Float,
    c: Float, s: Float, k: Any, slides: bool,
) -> Any:  # fmt: skip
    """Derivative of the field k (in the order of the state) along one direction."""
    ahead = j[0] * zx + j[1] * zy + j[2] * zr + j[3] * by_delta
    aside = j[4] * zx + j[5] * zy + j[6] * zr + j[7] * by_delta
    turned = j[8] * zx + j[9] * zy + j[10] * zr + j[11] * by_delta
    if slides:
        ahead += by_input[0] * by_a
        aside += by_input[1] * by_a
        turned += by_input[2] * by_a
    else:
        ahead += by_a
    return (
        ahead, aside, zr, turned, c * zx - s * zy - k[5] * zp, s * zx + c * zy + k[4] * zp,
    )  # fmt: skip


@compiled_inline
def _further(
    j: Any, by_input: Any, zx: Float, zy: Float, zp: Float, zr: Float, step: Float, d: Any,
    by_a: Float, by_delta: Float, c: Float, s: Float, k: Any, slides: bool,
) -> Any:  # fmt: skip
    """`_directional` for a direction that has moved by `step` times its rate d."""
    return _directional(
        j, by_input, zx + step * d[0], zy + step * d[1], zp + step * d[2], zr + step * d[3],
        by_a, by_delta, c, s, k, slides,
    )  # fmt: skip


@compiled_internal
def _weighted(k1: Any, k2: Any, k3: Any, k4: Any) -> Any:
    """Weighted sum of the four rates of a classic Runge-Kutta step, times 6."""
    return plus(plus(k1, scaled(plus(k2, k3), 2.0)), k4)


@compiled_inline
def _differentiate(
    e: Array, length: Float, grids: Float, p: Array, out: Array, command: Any, slides: bool
) -> None:
    """`differentiate` with linear or limited tyres; `command` and `slides` as in `_rates`."""
    model = (p[0], p[1], p[2], p[3], p[4], p[5], p[6])
    a, delta = e[L.PLAN_A], e[L.PLAN_DELTA]
    vx, vy, r = e[L.PLAN_VX], e[L.PLAN_VY], e[L.PLAN_R]
    n = substeps(vx, a, length, grids, p)
    h = length / n
    c, s, psi, x, y = 1.0, 0.0, 0.0, 0.0, 0.0
    cd, sd = math.cos(delta), math.sin(delta)
    half, sixth = 0.5 * h, h / 6.0
    z = e[L.SENSITIVITY : L.SENSITIVITY + 6 * SEEDS]
    for k in range(6 * SEEDS):
        z[k] = 0.0
    z[0], z[SEEDS + 1], z[3 * SEEDS + 2] = 1.0, 1.0, 1.0
    for step in range(n):
        k1, j1, a1 = _rates(vx, vy, r, c, s, a, delta, cd, sd, model, command, slides)
        if step == 0:
            e[RATE] = k1[0]
            e[RATE_VX], e[RATE_VY], e[RATE_R], e[RATE_DELTA] = j1[0], j1[1], j1[2], j1[3]
            e[RATE_A] = a1[0]
        c2, s2 = rotate(c, s, half * k1[2])
        k2, j2, a2 = _rates(
            vx + half * k1[0], vy + half * k1[1], r + half * k1[3],
            c2, s2, a, delta, cd, sd, model, command, slides,
        )  # fmt: skip
        c3, s3 = rotate(c, s, half * k2[2])
        k3, j3, a3 = _rates(
            vx + half * k2[0], vy + half * k2[1], r + half * k2[3],
            c3, s3, a, delta, cd, sd, model, command, slides,
        )  # fmt: skip
        c4, s4 = rotate(c, s, h * k3[2])
        k4, j4, a4 = _rates(
            vx + h * k3[0], vy + h * k3[1], r + h * k3[3],
            c4, s4, a, delta, cd, sd, model, command, slides,
        )  # fmt: skip
        for k in range(SEEDS):
            by_a = 1.0 if k == 3 else 0.0
            by_delta = 1.0 if k == 4 else 0.0
            zx, zy, zp = z[k], z[SEEDS + k], z[2 * SEEDS + k]
            zr = z[3 * SEEDS + k]
            d1 = _directional(j1, a1, zx, zy, zp, zr, by_a, by_delta, c, s, k1, slides)
            d2 = _further(j2, a2, zx, zy, zp, zr, half, d1, by_a, by_delta, c2, s2, k2, slides)
            d3 = _further(j3, a3, zx, zy, zp, zr, half, d2, by_a, by_delta, c3, s3, k3, slides)
            d4 = _further(j4, a4, zx, zy, zp, zr, h, d3, by_a, by_delta, c4, s4, k4, slides)
            d = scaled(_weighted(d1, d2, d3, d4), sixth)
            z[k] = zx + d[0]
            z[SEEDS + k] = zy + d[1]
            z[2 * SEEDS + k] = zp + d[2]
            z[3 * SEEDS + k] = zr + d[3]
            z[4 * SEEDS + k] += d[4]
            z[5 * SEEDS + k] += d[5]
        d = scaled(_weighted(k1, k2, k3, k4), sixth)
        vx += d[0]
        vy += d[1]
        psi += d[2]
        r += d[3]
        x += d[4]
        y += d[5]
        c, s = rotate(c, s, d[2])
    c0, s0 = math.cos(e[L.PLAN_PSI]), math.sin(e[L.PLAN_PSI])
    for k in range(SEEDS):
        first = 6 * k if k < 3 else 6 * k + 2
        for row in range(4):
            e[first + row] = z[row * SEEDS + k]
        zx, zy = z[4 * SEEDS + k], z[5 * SEEDS + k]
        e[first + X] = c0 * zx - s0 * zy
        e[first + Y] = s0 * zx + c0 * zy
    east, north = c0 * x - s0 * y, s0 * x + c0 * y
    e[HEADING_X], e[HEADING_Y] = -north, east
    out[L.PLAN_VX], out[L.PLAN_VY], out[L.PLAN_R] = vx, vy, r
    out[L.PLAN_PSI] = e[L.PLAN_PSI] + psi
    out[L.PLAN_X], out[L.PLAN_Y] = e[L.PLAN_X] + east, e[L.PLAN_Y] + north


@compiled_internal
def differentiate(e: Array, length: Float, grids: Float, p: Array, out: Array) -> None:
    """Advance the plan's state from stage e to the next, `out`, and fill the derivatives of e.

    The state is that of `advance`, which describes the arguments. Forward sensitivities through the
    stages of every Runge-Kutta step, dk = J dz + J_u: exact to rounding for the discrete map, not
    for the flow that it approximates.
    """
    if p[L.TYRE + 1] < math.inf:
        command = command_derivatives(e[L.PLAN_A], tyre_of(p))
        _differentiate(e, length, grids, p, out, command, True)
    else:
        _differentiate(e, length, grids, p, out, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), False)


@compiled
def differentiate_along(stages: Array, constants: Array) -> None:
    """Roll the plan in `stages` out from its first state, and fill all stages' derivatives."""
    n = stages.shape[0] - 1
    lengths, grids = L.grid(constants, L.LENGTH, n), L.grid(constants, L.SUBSTEPS, n)
    for i in range(n):
        differentiate(stages[i], lengths[i], grids[i], constants, stages[i + 1])


def unpacked(stages: Array) -> Linearisation:
    """Return the derivatives of all stages as full matrices."""
    records, states = stages[:-1, : L.DERIVATIVES], stages[:, L.PLAN_VX : L.PLAN_Y + 1]
    n = len(records)
    a_matrices = np.tile(np.eye(6), (n, 1, 1))
    b_matrices = np.zeros((n, 6, 2))
    rate_x, rate_u = np.zeros((n, 6)), np.zeros((n, 2))
    for k, column in enumerate(DYNAMIC):
        a_matrices[:, :, column] = records[:, 6 * k : 6 * k + 6]
        rate_x[:, column] = records[:, RATE_VX + k]
    a_matrices[:, X, PSI], a_matrices[:, Y, PSI] = records[:, HEADING_X], records[:, HEADING_Y]
    for k in range(2):
        b_matrices[:, :, k] = records[:, 20 + 6 * k : 26 + 6 * k]
    rate_u[:, 0], rate_u[:, 1] = records[:, RATE_A], records[:, RATE_DELTA]
    return Linearisation(
        states.copy(), a_matrices, b_matrices, records[:, RATE].copy(), rate_x, rate_u
    )


def pack(model: Linearisation, inputs: Array, stages: Array) -> None:
    """Write a linear model along `inputs` (N, 2) into the stages: the inverse of `unpacked`.

    Entries of A and B that the stages do not store are assumed to be the constants above.
    """
    stages[:, L.PLAN_VX : L.PLAN_Y + 1] = model.states
    stages[:-1, L.PLAN_A : L.PLAN_DELTA + 1] = inputs
    for k, column in enumerate(DYNAMIC):
        stages[:-1, 6 * k : 6 * k + 6] = model.A[:, :, column]
        stages[:-1, RATE_VX + k] = model.rate_x[:, column]
    stages[:-1, HEADING_X], stages[:-1, HEADING_Y] = model.A[:, X, PSI], model.A[:, Y, PSI]
    for k in range(2):
        stages[:-1, 20 + 6 * k : 26 + 6 * k] = model.B[:, :, k]
    stages[:-1, RATE] = model.rate
    stages[:-1, RATE_A], stages[:-1, RATE_DELTA] = model.rate_u.T
