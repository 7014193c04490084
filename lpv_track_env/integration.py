"""Integration of the bicycle by classic Runge-Kutta steps: one step, shared by every environment.

The single environment takes the steps of one vehicle one after another; the vector environment
takes one step of many vehicles side by side. Both call `runge_kutta`, and IEEE arithmetic gives
both the same bits.
"""

import math
from typing import Any

from lpv_track_env.bicycle import (
    compiled_field,
    compiled_inverse_speed,
    compiled_inverse_speed_of_lanes,
)
from trajectories.compilation import compiled, compiled_inline


@compiled_inline
def rotate(c: Any, s: Any, angle: Any) -> tuple[Any, Any]:
    """(cos, sin) turned by a small angle: Taylor series to order 7, no call of libm."""
    q = angle * angle
    dc = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0)))
    ds = angle * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5040.0))))
    return c * dc - s * ds, s * dc + c * ds


@compiled
def inverse_speed(vx: Any, lanes: bool) -> Any:
    """q(vx), see `bicycle`: by a branch, or without one; `lanes` is a constant where it is used."""
    return compiled_inverse_speed_of_lanes(vx) if lanes else compiled_inverse_speed(vx)


@compiled_inline
def runge_kutta(
    vx: Any, vy: Any, r: Any, c: Any, s: Any, a: Any, delta: Any, cd: Any, sd: Any,
    p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, h: Any, lanes: bool,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """One Runge-Kutta step (classic, order 4) of h seconds, inputs held.

    (c, s) and (cd, sd) are cosine and sine of heading and steering angle; p1 to p6 the vehicle's
    parameters from the yaw inertia on, per unit of mass (see `per_mass`). Returns the new vx, vy
    and r, and the changes of psi, X and Y.
    """
    half = 0.5 * h
    q = inverse_speed(vx, lanes)
    k1 = compiled_field(vx, vy, r, c, s, a, delta, cd, sd, q, 1.0, p1, p2, p3, p4, p5, p6)
    ux, uy, w = vx + half * k1[0], vy + half * k1[1], r + half * k1[3]
    c2, s2 = rotate(c, s, half * k1[2])
    q = inverse_speed(ux, lanes)
    k2 = compiled_field(ux, uy, w, c2, s2, a, delta, cd, sd, q, 1.0, p1, p2, p3, p4, p5, p6)
    ux, uy, w = vx + half * k2[0], vy + half * k2[1], r + half * k2[3]
    c2, s2 = rotate(c, s, half * k2[2])
    q = inverse_speed(ux, lanes)
    k3 = compiled_field(ux, uy, w, c2, s2, a, delta, cd, sd, q, 1.0, p1, p2, p3, p4, p5, p6)
    ux, uy, w = vx + h * k3[0], vy + h * k3[1], r + h * k3[3]
    c2, s2 = rotate(c, s, h * k3[2])
    q = inverse_speed(ux, lanes)
    k4 = compiled_field(ux, uy, w, c2, s2, a, delta, cd, sd, q, 1.0, p1, p2, p3, p4, p5, p6)
    sixth = h * (1.0 / 6.0)
    return (
        vx + sixth * (k1[0] + 2.0 * (k2[0] + k3[0]) + k4[0]),
        vy + sixth * (k1[1] + 2.0 * (k2[1] + k3[1]) + k4[1]),
        r + sixth * (k1[3] + 2.0 * (k2[3] + k3[3]) + k4[3]),
        sixth * (k1[2] + 2.0 * (k2[2] + k3[2]) + k4[2]),
        sixth * (k1[4] + 2.0 * (k2[4] + k3[4]) + k4[4]),
        sixth * (k1[5] + 2.0 * (k2[5] + k3[5]) + k4[5]),
    )


@compiled
def per_mass(p0: Any, p1: Any, p4: Any, p5: Any) -> tuple[Any, Any, Any]:
    """Yaw inertia and cornering stiffnesses over the mass: a division less in every stage."""
    return p1 / p0, p4 / p0, p5 / p0


@compiled
def integrate(
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any,
    p0: Any, p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, h: Any, substeps: int,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """State after `substeps` Runge-Kutta steps of h seconds, inputs held.

    Sines and cosines are taken once: the heading's pair is then turned by each step's small angle.
    """
    cd, sd = math.cos(delta), math.sin(delta)
    c, s = math.cos(psi), math.sin(psi)
    p1, p4, p5 = per_mass(p0, p1, p4, p5)
    for _ in range(substeps):
        vx, vy, r, turn, dx, dy = runge_kutta(
            vx, vy, r, c, s, a, delta, cd, sd, p1, p2, p3, p4, p5, p6, h, False
        )
        x += dx
        y += dy
        psi += turn
        c, s = rotate(c, s, turn)
    return vx, vy, psi, r, x, y
