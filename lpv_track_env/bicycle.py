"""The dynamic bicycle: the project's only copy of the vehicle's physics.

`field` is plain arithmetic on its arguments, which include sines, cosines and the inverse speed. So
the same function runs on floats inside numba, on NumPy arrays, on CasADi symbols and on torch
tensors; only the few lines that prepare its arguments differ between backends.

Model (kumar2025lpv, section II; state x = [vx, vy, psi, r, X, Y], input u = [a, delta])::

    vx'  = a - mu g - Fyf sin(delta)/m + r vy
    vy'  = Fyr/m + Fyf cos(delta)/m - r vx
    psi' = r
    r'   = (Fyf cos(delta) lf - Fyr lr)/Iz
    X'   = vx cos(psi) - vy sin(psi)
    Y'   = vx sin(psi) + vy cos(psi)
    Fyf  = Caf (delta - (vy + lf r)/vx)
    Fyr  = Car (-(vy - lr r)/vx)

From 1 m/s upwards (the paper's domain) the field is exactly this. Below 1 m/s a polynomial replaces
1/vx, which keeps the field twice continuously differentiable, finite at standstill, and correct in
reverse, where tyres damp lateral motion as they do forwards. With q(vx) = `inverse_speed` and the
signed direction s = vx q (exactly 1 from 1 m/s upwards), the slip angles are
delta s - (vy + lf r) q and -(vy - lr r) q, and rolling resistance decelerates by mu g s.

`tyres` limits the forces Fyf, Fyr and the acceleration a by friction.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.tyres import scheduled
from lpv_track_env.vehicle import VehicleParameters
from trajectories.compilation import compiled, compiled_internal

# Entries of the state: m/s, m/s, rad, rad/s, m, m.
VX, VY, PSI, YAW_RATE, X, Y = range(6)
STATE_SIZE = 6
ACTION_SIZE = 2
LOW_SPEED = 1.0
"""m/s below which a polynomial replaces 1/|vx|: the lower end of the paper's speed range."""
LONGEST_SUBSTEP = 0.005
"""s; a vehicle's fastest pole at standstill can require a shorter substep."""
POLE_STEP = 1.5
"""Largest product of substep and fastest pole; the Runge-Kutta method is stable up to 2.78."""


def inverse_speed_polynomial(ratio: Any, bounded_speed: Any) -> Any:
    """Compute q, which continues 1/|vx| to standstill, for any backend.

    `ratio` is w = min(|vx| / LOW_SPEED, 1) and `bounded_speed` is max(|vx|, LOW_SPEED). From
    LOW_SPEED upwards q is exactly 1/|vx|. Below, q = (15 - 10 w^2 + 3 w^4) / (8 LOW_SPEED), which
    agrees with 1/|vx| and its first two derivatives at LOW_SPEED.
    """
    squared = ratio * ratio
    return (15.0 - 10.0 * squared + 3.0 * squared * squared) / (8.0 * bounded_speed)


def field(
    vx: Any,
    vy: Any,
    r: Any,
    cos_psi: Any,
    sin_psi: Any,
    a: Any,
    delta: Any,
    cos_delta: Any,
    sin_delta: Any,
    q: Any,
    mass: Any,
    yaw_inertia: Any,
    lf: Any,
    lr: Any,
    caf: Any,
    car: Any,
    rolling_deceleration: Any,
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Compute the time derivative of [vx, vy, psi, r, X, Y]; `q` is the inverse speed."""
    # Slips are axle velocities, slip angle times |vx|, which q turns into angles at the very end;
    # forces are linear forms of vx, vy, r. So each stage of an integrator waits for one division
    # and few other operations, and the factors that are constant within a control period
    # (stiffnesses with mass, inertia and steering angle) stand in front of vx, vy and r.
    inverse_mass, inverse_inertia = 1.0 / mass, 1.0 / yaw_inertia
    front, rear = caf * cos_delta, car
    drag = caf * sin_delta * inverse_mass
    across, rear_across = front * inverse_mass, rear * inverse_mass
    turning, rear_turning = front * lf * inverse_inertia, rear * lr * inverse_inertia
    backward = (rolling_deceleration + drag * delta) * vx - (drag * vy + (drag * lf) * r)
    sideward = (across * delta) * vx - (
        (across + rear_across) * vy + (across * lf - rear_across * lr) * r
    )
    turnward = (turning * delta) * vx - (
        (turning - rear_turning) * vy + (turning * lf + rear_turning * lr) * r
    )
    return (
        (a + r * vy) - backward * q,
        sideward * q - r * vx,
        r,
        turnward * q,
        vx * cos_psi - vy * sin_psi,
        vx * sin_psi + vy * cos_psi,
    )


def inverse_speed_slope_polynomial(ratio: Any, bounded_speed: Any, vx: Any) -> Any:
    """Compute dq/dvx of `inverse_speed_polynomial`, with its arguments and vx, for any backend."""
    return (
        vx * (12.0 * ratio * ratio - 20.0) / (8.0 * bounded_speed * bounded_speed * bounded_speed)
    )


def jacobian(
    vx: Any,
    vy: Any,
    r: Any,
    delta: Any,
    cos_delta: Any,
    sin_delta: Any,
    q: Any,
    slope: Any,
    mass: Any,
    yaw_inertia: Any,
    lf: Any,
    lr: Any,
    caf: Any,
    car: Any,
    rolling_deceleration: Any,
    front_secant: Any,
) -> tuple[Any, Any, Any, Any, Any, Any, Any, Any, Any, Any, Any, Any]:
    """Partial derivatives of `field`'s (vx', vy', r') with respect to (vx, vy, r, delta).

    The 12 values come row by row: those of vx', of vy', of r'. `slope` is dq/dvx. `caf` and `car`
    are the slopes of the axles' forces over slip, `front_secant` is the front axle's force by slip;
    with linear tyres that is `caf` as well. The remaining derivatives need no function: with linear
    tyres dvx'/da = 1, and those of (X', Y') rotate with psi.
    """
    direction, direction_slope = vx * q, q + vx * slope
    front = front_secant * (delta * direction - (vy + lf * r) * q)
    front_vx = caf * (delta * direction_slope - (vy + lf * r) * slope)
    front_vy, front_r, front_delta = -caf * q, -caf * lf * q, caf * direction
    rear_vx, rear_vy, rear_r = car * (lr * r - vy) * slope, -car * q, car * lr * q
    per_mass, per_inertia = 1.0 / mass, 1.0 / yaw_inertia
    across, along = cos_delta * per_mass, sin_delta * per_mass
    turning, rear_turning = cos_delta * lf * per_inertia, lr * per_inertia
    return (
        -rolling_deceleration * direction_slope - front_vx * along,
        r - front_vy * along,
        vy - front_r * along,
        -front_delta * along - front * across,
        rear_vx * per_mass + front_vx * across - r,
        rear_vy * per_mass + front_vy * across,
        rear_r * per_mass + front_r * across - vx,
        front_delta * across - front * along,
        front_vx * turning - rear_vx * rear_turning,
        front_vy * turning - rear_vy * rear_turning,
        front_r * turning - rear_r * rear_turning,
        (front_delta * cos_delta - front * sin_delta) * lf * per_inertia,
    )


def inverse_speed(vx: Any) -> Any:
    """Compute q(vx), s/m, on floats or arrays: 1/|vx| from LOW_SPEED upwards, finite below."""
    speed = np.abs(vx)
    return inverse_speed_polynomial(
        np.minimum(speed / LOW_SPEED, 1.0), np.maximum(speed, LOW_SPEED)
    )


def derivative(
    state: NDArray[np.float64] | Any,
    action: NDArray[np.float64] | Any,
    parameters: VehicleParameters,
    friction: float = math.inf,
) -> NDArray[np.float64]:
    """Compute the vector field x' = f(x, u) on NumPy arrays.

    Parameters
    ----------
    state
        [vx, vy, psi, r, X, Y], shape (6,) or (6, n); m/s, m/s, rad, rad/s, m, m.
    action
        [a, delta], shape (2,) or (2, n); m/s^2, rad (counter-clockwise positive).
    parameters
        Parameters of the vehicle.
    friction
        Coefficient of friction of its tyres (`tyres`).

    Returns
    -------
    NDArray
        Time derivative, shape (6,) or (6, n).

    Raises
    ------
    ValueError
        If a shape is wrong.
    """
    x = np.asarray(state, dtype=np.float64)
    u = np.asarray(action, dtype=np.float64)
    if x.shape[:1] != (STATE_SIZE,) or u.shape[:1] != (ACTION_SIZE,):
        raise ValueError(
            f"state must be (6,) or (6, n) and action (2,) or (2, n): got {x.shape}, {u.shape}"
        )
    vx, vy, psi, r, _, _ = x
    a, delta = u
    q = inverse_speed(vx)
    share, numbers = scheduled(
        (vx, vy, r), (a, delta), q, parameters, friction, np.minimum, np.maximum
    )
    rates = field(
        vx, vy, r, np.cos(psi), np.sin(psi), a * share, delta, np.cos(delta), np.sin(delta), q,
        *numbers,
    )  # fmt: skip
    return np.array(np.broadcast_arrays(*rates))


def casadi_derivative(
    state: Any, action: Any, parameters: VehicleParameters, friction: float = math.inf
) -> Any:
    """Compute the vector field (6, 1) on CasADi symbols: state (6, 1), action (2, 1)."""
    import casadi as ca

    vx, vy, psi, r, _, _ = ca.vertsplit(state)
    a, delta = ca.vertsplit(action)
    q = casadi_inverse_speed(vx)
    share, numbers = scheduled((vx, vy, r), (a, delta), q, parameters, friction, ca.fmin, ca.fmax)
    rates = field(
        vx, vy, r, ca.cos(psi), ca.sin(psi), a * share, delta, ca.cos(delta), ca.sin(delta), q,
        *numbers,
    )  # fmt: skip
    return ca.vertcat(*rates)


def casadi_inverse_speed(vx: Any) -> Any:
    """Compute q(vx) on CasADi symbols."""
    import casadi as ca

    speed = ca.fabs(vx)
    return inverse_speed_polynomial(ca.fmin(speed / LOW_SPEED, 1.0), ca.fmax(speed, LOW_SPEED))


def fastest_pole(vx: float, parameters: VehicleParameters) -> float:
    """Largest magnitude of the lateral dynamics' poles at speed vx (m/s) and delta = 0, 1/s.

    These are the poles of the (vy, r) block of A. An explicit integrator's step must resolve them:
    for real poles, RK4 is stable up to a step of 2.78 / pole.
    """
    p = parameters
    q = float(inverse_speed(vx))
    caf, car = p.front_cornering_stiffness, p.rear_cornering_stiffness
    lf, lr = p.front_axle_distance, p.rear_axle_distance
    coupling = caf * lf - car * lr
    block = np.array(
        [
            [-(caf + car) * q / p.mass, -coupling * q / p.mass - vx],
            [-coupling * q / p.yaw_inertia, -(caf * lf**2 + car * lr**2) * q / p.yaw_inertia],
        ]
    )
    return float(np.abs(np.linalg.eigvals(block)).max())


def longest_substep(parameters: VehicleParameters) -> float:
    """Longest integration step that resolves a vehicle's dynamics at any speed, s."""
    return min(LONGEST_SUBSTEP, POLE_STEP / fastest_pole(0.0, parameters))


compiled_field = compiled_internal(field)
compiled_jacobian = compiled_internal(jacobian)
compiled_inverse_speed_polynomial = compiled(inverse_speed_polynomial)
compiled_inverse_speed_slope_polynomial = compiled(inverse_speed_slope_polynomial)


@compiled_internal
def compiled_inverse_speed(vx: float) -> float:
    """Compute q(vx) in compiled code for a single vehicle, branching where it is 1/|vx|."""
    speed = abs(vx)
    if speed >= LOW_SPEED:
        return 1.0 / speed
    value: float = compiled_inverse_speed_polynomial(speed / LOW_SPEED, LOW_SPEED)
    return value


@compiled_internal
def compiled_inverse_speed_of_lanes(vx: float) -> float:
    """Compute the same q(vx), bit for bit, without a branch, for vectorised loops over vehicles.

    From LOW_SPEED upwards the polynomial is 8 / (8 |vx|), and powers of two do not round.
    """
    speed = abs(vx)
    value: float = compiled_inverse_speed_polynomial(
        min(speed / LOW_SPEED, 1.0), max(speed, LOW_SPEED)
    )
    return value


@compiled_internal
def compiled_inverse_speed_slope(vx: float) -> float:
    """Compute dq/dvx in compiled code."""
    speed = abs(vx)
    value: float = compiled_inverse_speed_slope_polynomial(
        min(speed / LOW_SPEED, 1.0), max(speed, LOW_SPEED), vx
    )
    return value
