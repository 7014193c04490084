"""Quasi-LPV form x' = A(x, u) x + B(u, x) u of the bicycle, exactly equal to its vector field.

The entries are those of kumar2025lpv with its misprints corrected (A[vy, vy] contains
Car + Caf cos delta; the columns of B follow u = [a, delta]). The inverse speed q of `bicycle`
replaces 1/vx, and the direction s = vx q multiplies the steering column of B; from 1 m/s upwards
q = 1/vx and s = 1. With limited friction the stiffnesses are the secants of `tyres`, scheduled over
slip and acceleration, and B[vx, a] is the share ax / a of the acceleration that is followed.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.bicycle import (
    ACTION_SIZE,
    PSI,
    STATE_SIZE,
    VX,
    VY,
    YAW_RATE,
    X,
    Y,
    casadi_inverse_speed,
    inverse_speed,
)
from lpv_track_env.tyres import scheduled
from lpv_track_env.vehicle import VehicleParameters

OUTPUTS = (VX, PSI, X, Y)
"""Entries of the state in the output y = C x = [vx, psi, X, Y]."""

C: NDArray[np.float64] = np.eye(STATE_SIZE)[list(OUTPUTS)]
"""Output matrix, shape (4, 6)."""

Entries = dict[tuple[int, int], Any]
"""(row, column) -> value."""


def entries(
    vx: Any,
    vy: Any,
    cos_psi: Any,
    sin_psi: Any,
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
    followed: Any = 1.0,
) -> tuple[Entries, Entries]:
    """Compute the non-zero entries of A and B, (row, column) -> value, for any backend.

    `followed` is the share of the acceleration that the tyres follow; the linear ones all of it.
    """
    direction = vx * q
    front, rear = caf * cos_delta, car
    moment = front * lf - rear * lr
    a_entries = {
        (VX, VX): -rolling_deceleration * q,
        (VX, VY): caf * sin_delta * q / mass,
        (VX, YAW_RATE): caf * lf * sin_delta * q / mass + vy,
        (VY, VY): -(rear + front) * q / mass,
        (VY, YAW_RATE): -moment * q / mass - vx,
        (PSI, YAW_RATE): 1.0,
        (YAW_RATE, VY): -moment * q / yaw_inertia,
        (YAW_RATE, YAW_RATE): -(front * lf * lf + rear * lr * lr) * q / yaw_inertia,
        (X, VX): cos_psi,
        (X, VY): -sin_psi,
        (Y, VX): sin_psi,
        (Y, VY): cos_psi,
    }
    b_entries = {
        (VX, 0): followed,
        (VX, 1): -caf * sin_delta * direction / mass,
        (VY, 1): front * direction / mass,
        (YAW_RATE, 1): front * lf * direction / yaw_inertia,
    }
    return a_entries, b_entries


def matrices(
    state: NDArray[np.float64] | Any,
    action: NDArray[np.float64] | Any,
    parameters: VehicleParameters,
    friction: float = math.inf,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute A(x, u), shape (6, 6), and B(u, x), shape (6, 2), at one state (6,) and action (2,).

    A x + B u equals `bicycle.derivative(x, u)` for every x and u, with the same coefficient of
    friction: no linearisation error.

    Raises
    ------
    ValueError
        If a shape is wrong.
    """
    x = np.asarray(state, dtype=np.float64)
    u = np.asarray(action, dtype=np.float64)
    if x.shape != (STATE_SIZE,) or u.shape != (ACTION_SIZE,):
        raise ValueError(f"state must be (6,) and action (2,): got {x.shape} and {u.shape}")
    vx, vy, psi, r = x[:4]
    a, delta = u
    angles, q = (np.cos(psi), np.sin(psi), np.cos(delta), np.sin(delta)), inverse_speed(vx)
    followed, numbers = scheduled(
        (vx, vy, r), (a, delta), q, parameters, friction, np.minimum, np.maximum
    )
    nonzero = entries(vx, vy, *angles, q, *numbers, followed=followed)
    zeros = np.zeros((STATE_SIZE, STATE_SIZE)), np.zeros((STATE_SIZE, ACTION_SIZE))
    a_matrix, b_matrix = _filled(zeros, nonzero)
    return a_matrix, b_matrix


def casadi_matrices(
    state: Any, action: Any, parameters: VehicleParameters, friction: float = math.inf
) -> tuple[Any, Any]:
    """Compute A (6, 6) and B (6, 2) as CasADi expressions of state (6, 1) and action (2, 1)."""
    import casadi as ca

    vx, vy, psi, r = state[VX], state[VY], state[PSI], state[YAW_RATE]
    a, delta = action[0], action[1]
    angles = (ca.cos(psi), ca.sin(psi), ca.cos(delta), ca.sin(delta))
    q = casadi_inverse_speed(vx)
    followed, numbers = scheduled(
        (vx, vy, r), (a, delta), q, parameters, friction, ca.fmin, ca.fmax
    )
    nonzero = entries(vx, vy, *angles, q, *numbers, followed=followed)
    zeros = ca.SX(STATE_SIZE, STATE_SIZE), ca.SX(STATE_SIZE, ACTION_SIZE)
    return _filled(zeros, nonzero)


def _filled(matrices: tuple[Any, Any], nonzero: tuple[Entries, Entries]) -> tuple[Any, Any]:
    """Write entries into zero matrices A and B, and return these."""
    for matrix, values in zip(matrices, nonzero, strict=True):
        for index, value in values.items():
            matrix[index] = value
    return matrices
