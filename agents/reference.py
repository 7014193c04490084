"""The reference ahead, rebuilt from an observation, and the steady turn that follows it.

The preview holds mean curvatures and end speeds over intervals of the reference's own time grid
(`lpv_track_env.observation`). Integrating them gives the path ahead without any access to it: the
frame's origin is the foot point, its x axis the path's tangent there, its y axis points left. In
this frame the vehicle stands at (0, lateral_error) with heading heading_error.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.observation import TrackingObservation
from lpv_track_env.vehicle import VehicleParameters
from trajectories.compilation import compiled, compiled_internal

Array = NDArray[Any]

NODE_SPEED, NODE_HEADING, NODE_X, NODE_Y, NODE_ARC_LENGTH = range(5)
"""Columns of a node in compiled code: first the NMPC's outputs, in their order."""
NODE = 5


class LocalReference(NamedTuple):
    """K + 1 nodes of the reference, one preview period apart; node 0 is the foot point.

    Each field is shaped (..., K + 1), with the observation's batch dimensions before it.
    """

    arc_length: Array
    """m from the foot point."""
    x: Array
    """m, along the path's tangent at the foot point."""
    y: Array
    """m, to the left of it."""
    heading: Array
    """rad, relative to the heading at the foot point; not wrapped."""
    speed: Array
    """m/s along the path."""


class LocalPoint(NamedTuple):
    """A point of the reference ahead, in the frame of the foot point."""

    x: float
    y: float
    heading: float


class Turn(NamedTuple):
    """How a vehicle moves whose centre of gravity follows a curve."""

    steering_angle: float
    """rad."""
    sideslip: float
    """rad, direction of travel minus heading; so on the path the heading error is -sideslip."""
    yaw_rate: float
    """rad/s."""
    rear_slip: float
    """rad, direction in which the rear axle travels minus heading."""


def local_reference(observation: TrackingObservation, period: float) -> LocalReference:
    """Rebuild the reference's nodes from a preview.

    Parameters
    ----------
    observation
        Scalars shaped (...), previews (..., K).
    period
        Spacing of the preview in the reference's time, s (`ObservationLayout.preview_period`).

    Returns
    -------
    LocalReference
        Nodes shaped (..., K + 1). Interval k has constant acceleration, so its length is the mean
        of its end speeds times the period, and constant curvature, so it is an arc: its chord is
        length sinc(turn / 2), along its mean heading. Exact for a path of such intervals.
    """
    curvature = np.asarray(observation.preview_curvature, dtype=np.float64)
    rows = curvature.reshape(-1, curvature.shape[-1])
    first = np.asarray(observation.reference_speed, dtype=np.float64).reshape(-1)
    speed = np.asarray(observation.preview_speed, dtype=np.float64).reshape(rows.shape)
    nodes = np.empty((rows.shape[0], rows.shape[1] + 1, NODE))
    _fill_rows(rows, first, speed, period, nodes)
    shaped = nodes.reshape(*curvature.shape[:-1], rows.shape[1] + 1, NODE)
    return LocalReference(
        arc_length=shaped[..., NODE_ARC_LENGTH],
        x=shaped[..., NODE_X],
        y=shaped[..., NODE_Y],
        heading=shaped[..., NODE_HEADING],
        speed=shaped[..., NODE_SPEED],
    )


@compiled_internal
def fill_nodes(curvature: Array, first_speed: Any, speed: Array, period: Any, nodes: Array) -> None:
    """Fill nodes (n + 1, NODE) from the first n intervals of one preview."""
    s = x = y = heading = 0.0
    before = first_speed
    # Direction of the path at the node before; turned twice by half an interval's angle.
    c, d = 1.0, 0.0
    nodes[0, NODE_SPEED], nodes[0, NODE_HEADING], nodes[0, NODE_X] = first_speed, 0.0, 0.0
    nodes[0, NODE_Y], nodes[0, NODE_ARC_LENGTH] = 0.0, 0.0
    for k in range(nodes.shape[0] - 1):
        after = float(speed[k])
        length = 0.5 * (before + after) * period
        half = 0.5 * curvature[k] * length
        ch, sh = math.cos(half), math.sin(half)
        chord = length if abs(half) < 1e-9 else length * sh / half
        c, d = c * ch - d * sh, d * ch + c * sh
        s += length
        x += chord * c
        y += chord * d
        heading += 2.0 * half
        c, d = c * ch - d * sh, d * ch + c * sh
        before = after
        nodes[k + 1, NODE_SPEED], nodes[k + 1, NODE_HEADING] = after, heading
        nodes[k + 1, NODE_X], nodes[k + 1, NODE_Y], nodes[k + 1, NODE_ARC_LENGTH] = x, y, s


@compiled
def _fill_rows(
    curvature: Array, first_speed: Array, speed: Array, period: Any, nodes: Array
) -> None:
    for row in range(nodes.shape[0]):
        fill_nodes(curvature[row], first_speed[row], speed[row], period, nodes[row])


def point_at(
    reference: LocalReference, arc_length: float, curvature_beyond: float = 0.0
) -> LocalPoint:
    """Point of one reference, fields (K + 1,), at an arc length (m) from its foot point.

    Within an interval the point lies on its arc. Behind the foot point the path is taken to be
    straight, beyond the preview to go on with `curvature_beyond` (1/m).
    """
    nodes = reference.arc_length
    index = int(np.searchsorted(nodes, arc_length, side="right")) - 1
    index = min(max(index, 0), len(nodes) - 1)
    offset = arc_length - float(nodes[index])
    heading = float(reference.heading[index])
    turn = 0.0
    if index == len(nodes) - 1:
        turn = offset * curvature_beyond
    elif offset > 0.0:
        share = offset / float(nodes[index + 1] - nodes[index])
        turn = share * float(reference.heading[index + 1] - reference.heading[index])
    chord = offset * float(np.sinc(turn / (2.0 * np.pi)))
    direction = heading + 0.5 * turn
    return LocalPoint(
        float(reference.x[index]) + chord * math.cos(direction),
        float(reference.y[index]) + chord * math.sin(direction),
        heading + turn,
    )


def mean_curvature(reference: LocalReference, start: float, end: float) -> float:
    """Heading gained from one arc length (m) to another, per metre, of one reference; 1/m.

    Where the stretch reaches beyond the preview, the part within the preview stands for all of it.
    """
    first, last = float(reference.arc_length[0]), float(reference.arc_length[-1])
    # At least a centimetre, ending at the preview's end if it must.
    end = min(max(end, first + 0.01), max(last, first + 0.01))
    start = min(max(start, first), end - 0.01)
    turned = np.interp([start, end], reference.arc_length, reference.heading)
    return float(turned[1] - turned[0]) / (end - start)


def steady_turn(curvature: float, speed: float, vehicle: VehicleParameters) -> Turn:
    """Steering, sideslip and yaw rate on a circle of the centre of gravity, exact for the bicycle.

    With vy' = r' = 0 (`lpv_track_env.bicycle`) the axles share the lateral force m r vx by lr/L and
    lf/L, so that vy = b r with b = lr - m vx^2 lf/(L Car), and the curvature r/sqrt(vx^2 + vy^2)
    gives the yaw rate per speed rho = kappa/sqrt(1 - (kappa b)^2). Then::

        delta = rho (b + lf) + rho m vx^2 lr/(L Caf cos(delta))

    which for small angles is L kappa + K vx^2 kappa with the understeer gradient K (Rajamani,
    Vehicle Dynamics and Control, section 3.3). Nothing is divided by the speed.

    Parameters
    ----------
    curvature
        1/m, signed; limited to what the steering range can hold at standstill.
    speed
        vx, m/s.
    vehicle
        The vehicle.
    """
    lf, lr, wheelbase = vehicle.front_axle_distance, vehicle.rear_axle_distance, vehicle.wheelbase
    caf, car = vehicle.front_cornering_stiffness, vehicle.rear_cornering_stiffness
    limit = vehicle.max_steering_angle / wheelbase
    curvature = min(max(curvature, -limit), limit)
    momentum = vehicle.mass * speed * speed / wheelbase
    lever = lr - momentum * lf / car
    # Beyond 60 degrees of sideslip no such circle is worth following.
    ratio = min((curvature * lever) ** 2, 0.75)
    turning = curvature / math.sqrt(1.0 - ratio)
    delta = turning * wheelbase
    for _ in range(3):  # a fixed point that contracts by delta^2 or better
        cosine = math.cos(min(max(delta, -0.8), 0.8))
        delta = turning * (lever + lf + momentum * lr / (caf * cosine))
    return Turn(
        delta, math.atan(turning * lever), turning * speed, math.atan(turning * (lever - lr))
    )


def transient_turn(turn: Turn, sideslip: float, speed: float, vehicle: VehicleParameters) -> Turn:
    """Motion with the centre of gravity on the path while the sideslip still lags behind `turn`.

    Where the curvature changes, the rear axle swings in behind over about lr metres: with rear slip
    neglected in the transient, lr beta'/vx + beta = beta_ss, which `lagged_sideslip` integrates.
    The yaw rate kappa vx - beta' then differs from the steady turn's, and with it the front slip.

    Parameters
    ----------
    turn
        The steady turn of the curvature here.
    sideslip
        The nominal sideslip now, rad.
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
    """Nominal sideslip (rad) after another `distance` (m) towards a steady turn."""
    share = 1.0 - math.exp(-abs(distance) / vehicle.rear_axle_distance)
    return sideslip + share * (turn.sideslip - sideslip)


class EarlyTurn(NamedTuple):
    """How far a turn that is sharper than a vehicle's should have begun at the foot point."""

    lateral_offset: float
    """m, to the left of the path."""
    heading: float
    """rad, relative to the path's."""
    curvature: float
    """1/m."""


def early_turn(reference: LocalReference, limit: float) -> EarlyTurn:
    """Round a corner ahead that no vehicle can drive, and say what that asks for now.

    A corner of angle theta at the distance w is rounded by an arc of curvature `limit` that starts
    theta/(2 limit) before it; where the foot point has passed that start, the arc's heading here is
    H = theta/2 - limit w and its offset H^2/(2 limit). The node ahead with the largest H decides.
    A path whose curvature stays below 2 `limit` has no such node, so it is left as it is.
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
