"""Tyres whose friction is limited, as cornering stiffnesses scheduled over slip and acceleration.

`bicycle.field` is linear in the cornering stiffnesses Caf, Car and in the acceleration a. Where the
coefficient of friction mu is finite, it is given their values at the present slip and acceleration.
So field, LPV form and integrators stay as they are, and A x + B u stays equal to the field. Of an
axle, C is the cornering stiffness, alpha the slip angle and Fz the load; h is the height of the
centre of gravity::

    F = C alpha (1 - z + z^2/3),  z = C |alpha| / (3 F_max)    up to z = 1
    F = F_max sign(alpha)                                      beyond: all of the patch slides
    F_max = mu Fz sqrt(1 - (ax / (mu g))^2)
    Fzf = m (g lr - h ax) / L,    Fzr = m (g lf + h ax) / L
    ax = a                                       up to |a| = KNEE a_max
    |ax| = |a| - (|a| - KNEE a_max)^2 / (4 (1 - KNEE) a_max)    up to |ax| = a_max, where it stays
    a_max = min(LONGITUDINAL_SHARE mu g, (1 - LEAST_LOAD) g min(lf, lr) / h)

Lateral force
    The brush model with parabolic pressure (H. B. Pacejka, Tire and Vehicle Dynamics, section 3.2).
    C depends on neither load nor friction, so the linear tyre is the limit for mu to infinity.
Load
    Transferred by the longitudinal acceleration, without delay (R. Rajamani, Vehicle Dynamics and
    Control, section 4.3: h and ax alone). The bicycle has no track width: no lateral transfer.
Combined slip
    The friction circle at each axle. The longitudinal force m ax is distributed as the loads are,
    the ideal of brakes and drives, so both axles have the same share left for their side forces.
Longitudinal force
    An anti-lock brake and a traction control: no wheel locks, spins or leaves the ground, and
    steering keeps sqrt(1 - LONGITUDINAL_SHARE^2), 31 %, of its force. Rolling resistance and the
    drag of steered wheels, small beside it, are not counted.

Forces are continuously differentiable in state and input. Slip angles are those of `bicycle`:
forces are finite at standstill and damp in reverse.
"""

import math
from collections.abc import Callable
from typing import Any

from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import VehicleParameters
from trajectories.arguments import Number
from trajectories.compilation import compiled, compiled_inline, compiled_internal

FRICTION = Number(0.001, math.inf)
"""Rule of a coefficient of friction; inf is the linear tyre."""
Parameters = tuple[Any, Any, Any, Any, Any, Any, Any]
"""Arguments of `bicycle.field` from the mass on."""

LONGITUDINAL_SHARE = 0.95
"""Share of mu g that accelerates or brakes at most."""
KNEE = 0.8
"""Share of the largest acceleration up to which a command is followed exactly."""
LEAST_LOAD = 0.1
"""Share of its static load that an axle keeps at the largest acceleration."""
FULL = 2.0 - KNEE
"""Command by the largest acceleration, from which on it is reached."""


def constants(
    friction: Any, height: Any, mass: Any, lf: Any, lr: Any, caf: Any, car: Any
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Return the constants of a vehicle's tyres: (a_max, mu g, nf, nr, tf, tr).

    nf, nr are C / (3 F_max) at static load, the inverse of the slip angle (1/rad) from which on all
    of an axle's patch slides; tf, tr are the shares of static load that an axle gains per m/s^2.
    """
    grip = friction * GRAVITY
    limit = (1.0 - LEAST_LOAD) * GRAVITY * min(lf, lr) / height
    third = (lf + lr) / (3.0 * mass * grip)
    return (
        min(LONGITUDINAL_SHARE * grip, limit), grip, third * caf / lr, third * car / lf,
        -height / (GRAVITY * lr), height / (GRAVITY * lf),
    )  # fmt: skip


def of(vehicle: VehicleParameters, friction: float) -> tuple[float, ...]:
    """Return the `constants` of a vehicle's tyres under a coefficient of friction."""
    mass, _, lf, lr, caf, car, _ = vehicle.as_array().tolist()
    return constants(friction, vehicle.centre_of_gravity_height, mass, lf, lr, caf, car)


def followed_share(excess: Any, beyond: Any) -> Any:
    """Compute ax / a, for any backend, with w = |a| / a_max.

    `excess` is min(max(w - KNEE, 0), 2 - 2 KNEE) and `beyond` is max(w, FULL).
    """
    rest = 1.0 - excess * excess / (4.0 * (1.0 - KNEE) * (KNEE + excess))
    return rest * (FULL / beyond)


def followed_slope(excess: Any) -> Any:
    """Compute dax/da, with the argument of `followed_share`, for any backend."""
    return 1.0 - excess / (2.0 * (1.0 - KNEE))


def sharpness(
    ax: Any, grip: Any, nf: Any, nr: Any, front_transfer: Any, rear_transfer: Any
) -> tuple[Any, Any]:
    """Compute n = C / (3 F_max) of both axles under the acceleration ax, 1/rad, for any backend."""
    used = ax / grip
    left = (1.0 - used * used) ** 0.5
    return nf / (left * (1.0 + front_transfer * ax)), nr / (left * (1.0 + rear_transfer * ax))


def slips(vx: Any, vy: Any, r: Any, delta: Any, q: Any, lf: Any, lr: Any) -> tuple[Any, Any]:
    """Compute the slip angles of both axles, rad, for any backend; `q` is the inverse speed."""
    return (delta * vx - (vy + lf * r)) * q, (lr * r - vy) * q


def secant_share(within: Any, beyond: Any) -> Any:
    """Compute F / (C alpha) with min(z, 1) and max(z, 1), for any backend."""
    return (1.0 - within + within * within * (1.0 / 3.0)) / beyond


def scheduled(
    state: tuple[Any, Any, Any],
    action: tuple[Any, Any],
    q: Any,
    vehicle: VehicleParameters,
    friction: float,
    lower: Callable[[Any, Any], Any],
    upper: Callable[[Any, Any], Any],
) -> tuple[Any, Parameters]:
    """Compute ax / a and the 7 arguments of `bicycle.field` from the mass on, arrays or symbols.

    Parameters
    ----------
    state, action
        (vx, vy, r) and (a, delta), see `bicycle`.
    q
        The inverse speed.
    vehicle
        The vehicle.
    friction
        Coefficient mu; inf is the linear tyre.
    lower, upper
        The backend's minimum and maximum of two arguments.
    """
    vx, vy, r = state
    a, delta = action
    mass, inertia, lf, lr, caf, car, rolling = vehicle.as_array()
    if friction == math.inf:
        return 1.0, (mass, inertia, lf, lr, caf, car, rolling)
    height = vehicle.centre_of_gravity_height
    a_max, *others = constants(friction, height, mass, lf, lr, caf, car)
    command = abs(a) / a_max
    excess = lower(upper(command - KNEE, 0.0), FULL - KNEE)
    share = followed_share(excess, upper(command, FULL))
    front, rear = (
        n * abs(slip)
        for n, slip in zip(
            sharpness(a * share, *others), slips(vx, vy, r, delta, q, lf, lr), strict=True
        )
    )
    caf = caf * secant_share(lower(front, 1.0), upper(front, 1.0))
    car = car * secant_share(lower(rear, 1.0), upper(rear, 1.0))
    return share, (mass, inertia, lf, lr, caf, car, rolling)


compiled_constants = compiled(constants)
compiled_sharpness = compiled_internal(sharpness)
compiled_slips = compiled_internal(slips)
compiled_followed_share = compiled_internal(followed_share)
compiled_followed_slope = compiled_internal(followed_slope)


@compiled_internal
def command_excess(a: float, a_max: float) -> float:
    """Compute the first argument of `followed_share` in compiled code."""
    return min(max(abs(a) / a_max - KNEE, 0.0), FULL - KNEE)


@compiled_internal
def followed(a: float, a_max: float) -> float:
    """Compute ax in compiled code."""
    share: float = compiled_followed_share(command_excess(a, a_max), max(abs(a) / a_max, FULL))
    return a * share


@compiled_internal
def command_derivatives(a: float, tyre: Any) -> tuple[float, float, float, float, float, float]:
    """Compute ax, nf, nr under a command, and their derivatives by it, from `constants`."""
    a_max, grip, nf, nr, front_transfer, rear_transfer = tyre
    ax = followed(a, a_max)
    nf, nr = compiled_sharpness(ax, grip, nf, nr, front_transfer, rear_transfer)
    slope = compiled_followed_slope(command_excess(a, a_max))
    # By logarithms: n is 1 / (left load), with left^2 = 1 - (ax / grip)^2.
    left = slope * ax / (grip * grip - ax * ax)
    return (
        ax, nf, nr, slope,
        nf * (left - slope * front_transfer / (1.0 + front_transfer * ax)),
        nr * (left - slope * rear_transfer / (1.0 + rear_transfer * ax)),
    )  # fmt: skip


@compiled_internal
def secant(stiffness: float, n: float, slip: float) -> float:
    """Compute an axle's secant stiffness at a slip angle (rad) in compiled code."""
    z = n * abs(slip)
    if z < 1.0:
        return stiffness * (1.0 - z + z * z * (1.0 / 3.0))
    return stiffness * ((1.0 / 3.0) / z)


@compiled_inline
def axle_shares(z: float) -> tuple[float, float, float]:
    """Compute F / (C alpha), dF/dalpha / C and dF/dn / (C alpha |alpha|) in compiled code."""
    if z < 1.0:
        sticking = 1.0 - z
        return sticking + z * z * (1.0 / 3.0), sticking * sticking, z * (2.0 / 3.0) - 1.0
    inverse = 1.0 / z
    return inverse * (1.0 / 3.0), 0.0, inverse * inverse * (-1.0 / 3.0)
