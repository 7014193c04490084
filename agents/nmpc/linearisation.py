"""The NMPC's discrete model and its exact derivatives, compiled.

The same map as `casadi_solver.discrete_model`: classic Runge-Kutta steps of the vector field over a
period, inputs held. A period is integrated in the frame of the vehicle at its start, since the
motion does not depend on where the vehicle is nor where it heads: sines of small angles are then
enough, and derivatives with respect to heading and position need no integration at all.

A period's derivatives fill a record of `RECORD` numbers::

    0..17   columns vx, vy, r of A, six rows each     18, 19  A[X, psi], A[Y, psi]
    20..31  columns a, delta of B, six rows each
    32      vx' at the period's start                 33..36  its derivatives by vx, vy, r, delta

The other columns of A are unit columns, and dvx'/da is 1.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from lpv_track_env.integration import integrate, rotate
from trajectories.compilation import compiled, compiled_in_place

Array = NDArray[Any]
# Floats inside compiled code; numba ignores annotations, mypy sees what a caller passes.
Float = Any

RECORD = 37
HEADING_X, HEADING_Y, RATE, RATE_VX, RATE_VY, RATE_R, RATE_DELTA = 18, 19, 32, 33, 34, 35, 36
SEEDS = 5
"""Directions that are integrated: vx, vy, r at the period's start, a, delta."""
SCRATCH = 6 * SEEDS
DYNAMIC = (VX, VY, YAW_RATE)


class Linearisation(NamedTuple):
    """The model along a plan: `states` (N + 1, 6), A (N, 6, 6), B (N, 6, 2) and vx'."""

    states: Array
    A: Array
    B: Array
    rate: Array
    """vx' at each period's start, (N,) m/s^2."""
    rate_x: Array
    """Its derivatives by the state, (N, 6)."""
    rate_u: Array
    """Its derivatives by the input, (N, 2)."""


@compiled
def advance(state: Array, a: Float, delta: Float, p: Array, h: Float, n: int, out: Array) -> None:
    """`out` (6,) is the model's state after `n` Runge-Kutta steps of h s from `state` (6,)."""
    vx, vy, psi, r, x, y = integrate(
        state[VX], state[VY], 0.0, state[YAW_RATE], 0.0, 0.0, a, delta,
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], h, n,
    )  # fmt: skip
    c, s = math.cos(state[PSI]), math.sin(state[PSI])
    out[VX], out[VY], out[YAW_RATE] = vx, vy, r
    out[PSI] = state[PSI] + psi
    out[X] = state[X] + c * x - s * y
    out[Y] = state[Y] + s * x + c * y


@compiled
def differentiate(
    state: Array, a: Float, delta: Float, p: Array, h: Float, n: int, out: Array, record: Array,
    z: Array,
) -> None:  # fmt: skip
    """Do what `advance` does and fill the period's record; `z` (SCRATCH,) is working space.

    Forward sensitivities through the stages of every Runge-Kutta step: dk = J dz + J_u, exact to
    rounding for the discrete map (not for the flow that it approximates).
    """
    m, iz, lf, lr, caf, car, mu = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    vx, vy, r = state[VX], state[VY], state[YAW_RATE]
    c, s, psi, x, y = 1.0, 0.0, 0.0, 0.0, 0.0
    cd, sd = math.cos(delta), math.sin(delta)
    half, sixth = 0.5 * h, h / 6.0
    for k in range(SCRATCH):
        z[k] = 0.0
    z[0], z[SEEDS + 1], z[3 * SEEDS + 2] = 1.0, 1.0, 1.0
    for step in range(n):
        q = compiled_inverse_speed(vx)
        k1 = compiled_field(vx, vy, r, c, s, a, delta, cd, sd, q, m, iz, lf, lr, caf, car, mu)
        slope = compiled_inverse_speed_slope(vx)
        j1 = compiled_jacobian(vx, vy, r, delta, cd, sd, q, slope, m, iz, lf, lr, caf, car, mu)
        if step == 0:
            record[RATE] = k1[0]
            record[RATE_VX], record[RATE_VY], record[RATE_R] = j1[0], j1[1], j1[2]
            record[RATE_DELTA] = j1[3]
        ux, uy, w = vx + half * k1[0], vy + half * k1[1], r + half * k1[3]
        c2, s2 = rotate(c, s, half * k1[2])
        q = compiled_inverse_speed(ux)
        k2 = compiled_field(ux, uy, w, c2, s2, a, delta, cd, sd, q, m, iz, lf, lr, caf, car, mu)
        slope = compiled_inverse_speed_slope(ux)
        j2 = compiled_jacobian(ux, uy, w, delta, cd, sd, q, slope, m, iz, lf, lr, caf, car, mu)
        ux, uy, w = vx + half * k2[0], vy + half * k2[1], r + half * k2[3]
        c3, s3 = rotate(c, s, half * k2[2])
        q = compiled_inverse_speed(ux)
        k3 = compiled_field(ux, uy, w, c3, s3, a, delta, cd, sd, q, m, iz, lf, lr, caf, car, mu)
        slope = compiled_inverse_speed_slope(ux)
        j3 = compiled_jacobian(ux, uy, w, delta, cd, sd, q, slope, m, iz, lf, lr, caf, car, mu)
        ux, uy, w = vx + h * k3[0], vy + h * k3[1], r + h * k3[3]
        c4, s4 = rotate(c, s, h * k3[2])
        q = compiled_inverse_speed(ux)
        k4 = compiled_field(ux, uy, w, c4, s4, a, delta, cd, sd, q, m, iz, lf, lr, caf, car, mu)
        slope = compiled_inverse_speed_slope(ux)
        j4 = compiled_jacobian(ux, uy, w, delta, cd, sd, q, slope, m, iz, lf, lr, caf, car, mu)
        for k in range(SEEDS):
            by_a = 1.0 if k == 3 else 0.0
            by_delta = 1.0 if k == 4 else 0.0
            zx, zy, zp = z[k], z[SEEDS + k], z[2 * SEEDS + k]
            zr = z[3 * SEEDS + k]
            d1 = _directional(j1, zx, zy, zp, zr, by_a, by_delta, c, s, k1[4], k1[5])
            d2 = _directional(
                j2, zx + half * d1[0], zy + half * d1[1], zp + half * d1[2], zr + half * d1[3],
                by_a, by_delta, c2, s2, k2[4], k2[5],
            )  # fmt: skip
            d3 = _directional(
                j3, zx + half * d2[0], zy + half * d2[1], zp + half * d2[2], zr + half * d2[3],
                by_a, by_delta, c3, s3, k3[4], k3[5],
            )  # fmt: skip
            d4 = _directional(
                j4, zx + h * d3[0], zy + h * d3[1], zp + h * d3[2], zr + h * d3[3],
                by_a, by_delta, c4, s4, k4[4], k4[5],
            )  # fmt: skip
            z[k] = zx + sixth * (d1[0] + 2.0 * (d2[0] + d3[0]) + d4[0])
            z[SEEDS + k] = zy + sixth * (d1[1] + 2.0 * (d2[1] + d3[1]) + d4[1])
            z[2 * SEEDS + k] = zp + sixth * (d1[2] + 2.0 * (d2[2] + d3[2]) + d4[2])
            z[3 * SEEDS + k] = zr + sixth * (d1[3] + 2.0 * (d2[3] + d3[3]) + d4[3])
            z[4 * SEEDS + k] += sixth * (d1[4] + 2.0 * (d2[4] + d3[4]) + d4[4])
            z[5 * SEEDS + k] += sixth * (d1[5] + 2.0 * (d2[5] + d3[5]) + d4[5])
        vx += sixth * (k1[0] + 2.0 * (k2[0] + k3[0]) + k4[0])
        vy += sixth * (k1[1] + 2.0 * (k2[1] + k3[1]) + k4[1])
        turn = sixth * (k1[2] + 2.0 * (k2[2] + k3[2]) + k4[2])
        r += sixth * (k1[3] + 2.0 * (k2[3] + k3[3]) + k4[3])
        x += sixth * (k1[4] + 2.0 * (k2[4] + k3[4]) + k4[4])
        y += sixth * (k1[5] + 2.0 * (k2[5] + k3[5]) + k4[5])
        psi += turn
        c, s = rotate(c, s, turn)
    c0, s0 = math.cos(state[PSI]), math.sin(state[PSI])
    for k in range(SEEDS):
        first = 6 * k if k < 3 else 6 * k + 2
        for row in range(4):
            record[first + row] = z[row * SEEDS + k]
        zx, zy = z[4 * SEEDS + k], z[5 * SEEDS + k]
        record[first + X] = c0 * zx - s0 * zy
        record[first + Y] = s0 * zx + c0 * zy
    east, north = c0 * x - s0 * y, s0 * x + c0 * y
    record[HEADING_X], record[HEADING_Y] = -north, east
    out[VX], out[VY], out[YAW_RATE] = vx, vy, r
    out[PSI] = state[PSI] + psi
    out[X], out[Y] = state[X] + east, state[Y] + north


@compiled
def _directional(
    j: Any, zx: Float, zy: Float, zp: Float, zr: Float, by_a: Float, by_delta: Float,
    c: Float, s: Float, x_rate: Float, y_rate: Float,
) -> Any:  # fmt: skip
    """Derivative of the field (in the order of the state) along one direction."""
    return (
        j[0] * zx + j[1] * zy + j[2] * zr + j[3] * by_delta + by_a,
        j[4] * zx + j[5] * zy + j[6] * zr + j[7] * by_delta,
        zr,
        j[8] * zx + j[9] * zy + j[10] * zr + j[11] * by_delta,
        c * zx - s * zy - y_rate * zp,
        s * zx + c * zy + x_rate * zp,
    )


@compiled
def roll_out(inputs: Array, p: Array, h: Float, n: int, states: Array) -> None:
    """Fill `states` (N + 1, 6) from its row 0 on, under `inputs` (N, 2)."""
    for i in range(inputs.shape[0]):
        advance(states[i], inputs[i, 0], inputs[i, 1], p, h, n, states[i + 1])


@compiled_in_place
def differentiate_along(
    inputs: Array, p: Array, h: Float, n: int, states: Array, records: Array, scratch: Array
) -> None:
    """Roll out as `roll_out` does and fill `records` (N, RECORD) along the way."""
    for i in range(inputs.shape[0]):
        a, delta = inputs[i, 0], inputs[i, 1]
        differentiate(states[i], a, delta, p, h, n, states[i + 1], records[i], scratch)


def unpacked(states: Array, records: Array) -> Linearisation:
    """Full matrices from records (N, RECORD)."""
    n = len(records)
    a_matrices = np.tile(np.eye(6), (n, 1, 1))
    b_matrices = np.zeros((n, 6, 2))
    rate_x, rate_u = np.zeros((n, 6)), np.ones((n, 2))
    for k, column in enumerate(DYNAMIC):
        a_matrices[:, :, column] = records[:, 6 * k : 6 * k + 6]
        rate_x[:, column] = records[:, RATE_VX + k]
    a_matrices[:, X, PSI], a_matrices[:, Y, PSI] = records[:, HEADING_X], records[:, HEADING_Y]
    for k in range(2):
        b_matrices[:, :, k] = records[:, 20 + 6 * k : 26 + 6 * k]
    rate_u[:, 1] = records[:, RATE_DELTA]
    return Linearisation(
        states.copy(), a_matrices, b_matrices, records[:, RATE].copy(), rate_x, rate_u
    )
