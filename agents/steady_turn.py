"""Steady turns of the bicycle on the reference: the feedforward of the classical controllers."""

import math
from typing import NamedTuple

import numpy as np

from agents.reference import LocalReference
from lpv_track_env.steady_turn import steady_turn as solved
from lpv_track_env.vehicle import VehicleParameters


class Turn(NamedTuple):
    """Motion of a vehicle whose centre of gravity follows a curve."""

    steering_angle: float
    """Steering angle, rad."""
    sideslip: float
    """Direction of travel minus heading, rad; on the path, the heading error is -sideslip."""
    yaw_rate: float
    """Yaw rate, rad/s."""
    rear_slip: float
    """Direction of travel of the rear axle minus heading, rad."""


def steady_turn(curvature: float, speed: float, vehicle: VehicleParameters) -> Turn:
    """Compute steering, sideslip and yaw rate on a circle of the centre of gravity.

    The solution is exact for the bicycle on linear tyres (`lpv_track_env.steady_turn`).

    Parameters
    ----------
    curvature
        Curvature, 1/m, signed; limited to that at full lock and standstill.
    speed
        vx, m/s.
    vehicle
        The vehicle.
    """
    lr = vehicle.rear_axle_distance
    delta, turning, lever = solved(
        curvature, speed, vehicle.mass, vehicle.front_axle_distance, lr,
        vehicle.front_cornering_stiffness, vehicle.rear_cornering_stiffness,
        vehicle.max_steering_angle,
    )  # fmt: skip
    return Turn(
        delta, math.atan(turning * lever), turning * speed, math.atan(turning * (lever - lr))
    )


def transient_turn(turn: Turn, sideslip: float, speed: float, vehicle: VehicleParameters) -> Turn:
    """Compute the motion along the path while the sideslip still lags behind a steady turn's.

    Where the curvature changes, the rear axle follows over a distance of about lr: with the rear
    slip neglected in the transient, lr beta'/vx + beta = beta_ss, which `lagged_sideslip`
    integrates. The yaw rate kappa vx - beta' and the front slip then differ from the steady turn's.

    Parameters
    ----------
    turn
        Steady turn for the present curvature.
    sideslip
        Present nominal sideslip, rad.
    speed
        vx, m/s.
    vehicle
        The vehicle.
    """
    lag, lr = turn.sideslip - sideslip, vehicle.rear_axle_distance
    return Turn(
        turn.steering_angle - vehicle.wheelbase / lr * lag,
        sideslip,
        turn.yaw_rate - speed / lr * lag,
        turn.rear_slip,
    )


def lagged_sideslip(
    turn: Turn, sideslip: float, distance: float, vehicle: VehicleParameters
) -> float:
    """Return the nominal sideslip (rad) after another `distance` (m) in a steady turn."""
    share = 1.0 - math.exp(-abs(distance) / vehicle.rear_axle_distance)
    return sideslip + share * (turn.sideslip - sideslip)


class EarlyTurn(NamedTuple):
    """Pose and curvature at the foot point of an arc that rounds an undrivable corner."""

    lateral_offset: float
    """Position to the left of the path, m."""
    heading: float
    """Heading relative to the path's, rad."""
    curvature: float
    """Curvature, 1/m."""


def early_turn(reference: LocalReference, limit: float) -> EarlyTurn:
    """Round a corner ahead that is too sharp for any vehicle; zeros if none is near.

    A corner of angle theta at the distance w is rounded by an arc of curvature `limit` that starts
    theta/(2 limit) before it. After that start, the arc's heading at the foot point is
    H = theta/2 - limit w and its offset H^2/(2 limit). The node ahead with the largest H is used. A
    path whose curvature stays below 2 `limit` has no such node and is not changed.
    """
    heading = reference.heading - reference.heading[0]
    due = 0.5 * np.abs(heading) - limit * reference.arc_length
    node = int(np.argmax(due))
    amount = float(due[node])
    if amount <= 0.0:
        return EarlyTurn(0.0, 0.0, 0.0)
    side = math.copysign(1.0, float(heading[node]))
    share = min(amount / 0.05, 1.0)
    return EarlyTurn(side * amount**2 / (2.0 * limit), side * amount, side * share * limit)
