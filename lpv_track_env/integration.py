"""Integration of the bicycle by classic Runge-Kutta steps.

The single environment takes all steps of one vehicle; the vector environment takes one step of
many vehicles at a time. Both call `runge_kutta`, so that IEEE arithmetic gives the same bits.

A vehicle that does not reverse has the lowest speed 0: brakes and resistances bring it to
standstill and hold it there. A step that would end below this speed ends at rest, at the point
which the vehicle reaches if its velocities fall to zero linearly in time.
"""

import math
from typing import Any

from lpv_track_env.bicycle import (
    compiled_field,
    compiled_inverse_speed,
    compiled_inverse_speed_of_lanes,
)
from lpv_track_env.tyres import compiled_sharpness, compiled_slips, followed, secant
from trajectories.compilation import compiled_inline, compiled_internal


@compiled_inline
def turned(angle: Any) -> tuple[Any, Any]:
    """Return (cos, sin) of a small angle by Taylor series of order 7, without calling libm."""
    q = angle * angle
    return (
        1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0))),
        angle * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5040.0)))),
    )


@compiled_inline
def rotate(c: Any, s: Any, angle: Any) -> tuple[Any, Any]:
    """Return (cos, sin) of a heading turned by a small angle."""
    dc, ds = turned(angle)
    return c * dc - s * ds, s * dc + c * ds


@compiled_internal
def inverse_speed(vx: Any, lanes: bool) -> Any:
    """Return q(vx), see `bicycle`; without a branch if `lanes`, a constant at compile time."""
    return compiled_inverse_speed_of_lanes(vx) if lanes else compiled_inverse_speed(vx)


@compiled_inline
def field_at(
    vx: Any, vy: Any, r: Any, c: Any, s: Any, a: Any, delta: Any, cd: Any, sd: Any,
    p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, nf: Any, nr: Any, lanes: bool,
    slides: bool,
) -> Any:  # fmt: skip
    """Return the vector field per unit of mass; `lanes` and `slides` as in `runge_kutta`."""
    q = inverse_speed(vx, lanes)
    if slides:
        front, rear = compiled_slips(vx, vy, r, delta, q, p2, p3)
        p4, p5 = secant(p4, nf, front), secant(p5, nr, rear)
    return compiled_field(vx, vy, r, c, s, a, delta, cd, sd, q, 1.0, p1, p2, p3, p4, p5, p6)


@compiled_inline
def runge_kutta(
    vx: Any, vy: Any, r: Any, c: Any, s: Any, a: Any, delta: Any, cd: Any, sd: Any,
    p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, nf: Any, nr: Any, h: Any, lowest: Any,
    lanes: bool, slides: bool,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """Take one Runge-Kutta step (classic, order 4) of h seconds, inputs held.

    (c, s) and (cd, sd) are cosine and sine of heading and steering angle. The yaw rate r, the
    acceleration a and the parameters p1 to p6 (from the yaw inertia on) are in units of half a
    step, see `in_half_steps`. nf and nr are the tyres' `sharpness`, used only if `slides`, a
    constant at compile time as is `lanes`. `lowest` is the lowest speed (m/s), 0 or -inf. Returns
    the new vx, vy and r, and the changes of psi (rad), X and Y (m).

    The chain of operations from stage to stage is short: in these units the change over half a
    step is the derivative itself, and positions are summed in the frame of the step's start.
    """
    k1 = field_at(
        vx, vy, r, 1.0, 0.0, a, delta, cd, sd, p1, p2, p3, p4, p5, p6, nf, nr, lanes, slides
    )
    c2, s2 = turned(k1[2])
    k2 = field_at(
        vx + k1[0], vy + k1[1], r + k1[3], c2, s2, a, delta, cd, sd, p1, p2, p3, p4, p5, p6,
        nf, nr, lanes, slides,
    )  # fmt: skip
    c3, s3 = turned(k2[2])
    k3 = field_at(
        vx + k2[0], vy + k2[1], r + k2[3], c3, s3, a, delta, cd, sd, p1, p2, p3, p4, p5, p6,
        nf, nr, lanes, slides,
    )  # fmt: skip
    c4, s4 = turned(2.0 * k3[2])
    k4 = field_at(
        vx + 2.0 * k3[0], vy + 2.0 * k3[1], r + 2.0 * k3[3], c4, s4, a, delta, cd, sd,
        p1, p2, p3, p4, p5, p6, nf, nr, lanes, slides,
    )  # fmt: skip
    third, sixth = 1.0 / 3.0, h * (1.0 / 6.0)
    ahead = sixth * (k1[4] + 2.0 * (k2[4] + k3[4]) + k4[4])
    aside = sixth * (k1[5] + 2.0 * (k2[5] + k3[5]) + k4[5])
    # The last stage is added at the very end, since it is ready last.
    ux = (vx + third * (k1[0] + 2.0 * (k2[0] + k3[0]))) + third * k4[0]
    uy = (vy + third * (k1[1] + 2.0 * (k2[1] + k3[1]))) + third * k4[1]
    w = (r + third * (k1[3] + 2.0 * (k2[3] + k3[3]))) + third * k4[3]
    turn = third * (k1[2] + 2.0 * (k2[2] + k3[2]) + k4[2])
    if ux < lowest:
        share = max(vx, 0.0) / (max(vx, 0.0) - ux)
        turn, ahead, aside = share * r, share * 0.5 * h * vx, share * 0.5 * h * vy
        ux = uy = w = 0.0
    return ux, uy, w, turn, c * ahead - s * aside, s * ahead + c * aside


@compiled_internal
def in_half_steps(
    half: Any, p0: Any, p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Return parameters p1 to p6 per unit of mass p0, with `half` a step (s) as the unit of time.

    The unit of length is the distance that 1 m/s covers in that time, so that speeds keep their
    numbers. Yaw rates and accelerations are `half` times those in SI units, lengths 1 / half times,
    and the yaw inertia per mass, a length squared, 1 / half^2 times.
    """
    inverse = 1.0 / half
    stiffness = half / p0
    return (
        (p1 / p0) * (inverse * inverse), p2 * inverse, p3 * inverse,
        p4 * stiffness, p5 * stiffness, p6 * half,
    )  # fmt: skip


@compiled_inline
def _steps(
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any,
    p0: Any, p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, nf: Any, nr: Any, h: Any,
    substeps: int, lowest: Any, slides: bool,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    cd, sd = math.cos(delta), math.sin(delta)
    c, s = math.cos(psi), math.sin(psi)
    half = 0.5 * h
    p1, p2, p3, p4, p5, p6 = in_half_steps(half, p0, p1, p2, p3, p4, p5, p6)
    a *= half
    r *= half
    for _ in range(substeps):
        vx, vy, r, turn, dx, dy = runge_kutta(
            vx, vy, r, c, s, a, delta, cd, sd, p1, p2, p3, p4, p5, p6, nf, nr, h, lowest,
            False, slides,
        )  # fmt: skip
        x += dx
        y += dy
        psi += turn
        c, s = rotate(c, s, turn)
    return vx, vy, psi, r / half, x, y


@compiled_internal
def integrate(
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any,
    p0: Any, p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, h: Any, substeps: int,
    lowest: Any = -math.inf,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """Return the state after `substeps` Runge-Kutta steps of h seconds, inputs held.

    Sine and cosine of the heading are computed once, then turned by each step's small angle.
    `lowest` is as in `runge_kutta`; models that must be differentiable leave it out.
    """
    return _steps(
        vx, vy, psi, r, x, y, a, delta, p0, p1, p2, p3, p4, p5, p6, 0.0, 0.0, h, substeps, lowest,
        False,
    )  # fmt: skip


@compiled_internal
def integrate_sliding(
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any,
    p0: Any, p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, tyre: Any, h: Any, substeps: int,
    lowest: Any = -math.inf,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """Return what `integrate` does with tyres of limited friction; `tyre`: `tyres.constants`."""
    ax = followed(a, tyre[0])
    nf, nr = compiled_sharpness(ax, tyre[1], tyre[2], tyre[3], tyre[4], tyre[5])
    return _steps(
        vx, vy, psi, r, x, y, ax, delta, p0, p1, p2, p3, p4, p5, p6, nf, nr, h, substeps, lowest,
        True,
    )  # fmt: skip


@compiled_internal
def integrate_with(
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any,
    p0: Any, p1: Any, p2: Any, p3: Any, p4: Any, p5: Any, p6: Any, tyre: Any, h: Any, substeps: int,
    lowest: Any = -math.inf,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """Return what `integrate_sliding` does if the friction is limited, else what `integrate` does.

    `tyre` are the `tyres.constants`.
    """
    if tyre[1] < math.inf:
        return integrate_sliding(
            vx, vy, psi, r, x, y, a, delta, p0, p1, p2, p3, p4, p5, p6, tyre, h, substeps, lowest
        )
    return integrate(
        vx, vy, psi, r, x, y, a, delta, p0, p1, p2, p3, p4, p5, p6, h, substeps, lowest
    )
