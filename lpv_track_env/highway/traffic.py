"""The ego vehicle in traffic: its body, the vehicles ahead, and a reference that keeps the gap.

Gaps and speeds of the vehicles ahead are measured along the path, as adaptive cruise control needs
them.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.bicycle import PSI, VX, VY, X, Y
from lpv_track_env.highway.cruise import CruiseControl, Leader, lower_speed
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Array = NDArray[np.float64]

PREDICTION_TIMES = (0.75, 1.5, 2.25, 3.0)
"""Times, s, at which the positions of vehicles that follow their lanes are predicted."""
NOBODY = Leader(math.inf, math.inf)
"""Stands for a free road."""
STEP = 0.05
"""Step of a cruise control's profile, s."""
BEYOND = 1.0
"""Time that a profile extends beyond an agent's preview, s."""


def body_centre(state: Array, vehicle: VehicleParameters) -> Array:
    """Centre of the body (2,), m: midway between the axles, highway-env's position of a vehicle."""
    ahead = 0.5 * (vehicle.front_axle_distance - vehicle.rear_axle_distance)
    heading = float(state[PSI])
    return np.array([state[X] + ahead * math.cos(heading), state[Y] + ahead * math.sin(heading)])


class EgoVehicle(Vehicle):
    """The environment's vehicle as the traffic of highway-env sees it.

    The environment moves it: `place` puts it at the plant's state, `act` and `step` do nothing.
    """

    def __init__(self, road: Road, vehicle: VehicleParameters) -> None:
        self.parameters = vehicle
        self.LENGTH, self.WIDTH = vehicle.length, vehicle.width
        self.target_speed = 0.0
        self._velocity = np.zeros(2)
        super().__init__(road, (0.0, 0.0))

    def place(self, state: Array, reference_speed: float) -> None:
        """Move the vehicle to the plant's state [vx, vy, psi, r, X, Y], (6,).

        The traffic takes `reference_speed` (m/s) for this vehicle's target speed.
        """
        heading = float(state[PSI])
        c, s = math.cos(heading), math.sin(heading)
        vx, vy = float(state[VX]), float(state[VY])
        self.position = body_centre(state, self.parameters)
        # highway-env compares headings modulo whole turns.
        self.heading, self.speed = heading, vx
        self._velocity = np.array([c * vx - s * vy, s * vx + c * vy])
        self.target_speed = reference_speed
        self.on_state_update()

    @property
    def velocity(self) -> Array:
        """Velocity in the world (2,), m/s, including sideslip, unlike highway-env's own."""
        return self._velocity

    def act(self, action: object = None) -> None:
        """Do nothing: the environment's action goes to the plant."""

    def step(self, dt: float) -> None:
        """Do nothing: `place` moves the vehicle."""


def others_on(road: Road, ego: RoadObject | None) -> list[RoadObject]:
    """All vehicles and objects on a road except the ego vehicle."""
    return [body for body in (*road.vehicles, *road.objects) if body is not ego]


class Located(NamedTuple):
    """A body in the coordinates of a path.

    `arc_length` and `offset` are m, `along` and `across` the velocity, m/s; lateral values are
    positive to the left. `half_length` and `half_width`, m, are measured along and across the path.
    """

    arc_length: float
    offset: float
    along: float
    across: float
    half_length: float
    half_width: float


class Stretch:
    """The next `reach` m of a path from a vehicle's foot point at `arc_length` (m)."""

    def __init__(self, path: ReferencePath, arc_length: float, reach: float) -> None:
        last = len(path.x) - 1
        self._first, self._spacing = math.floor(arc_length / path.spacing), path.spacing
        nodes = np.arange(self._first, self._first + min(math.ceil(reach / path.spacing), last) + 1)
        nodes = nodes % last if path.closed else nodes[nodes <= last]
        self._x, self._y, self._heading = path.x[nodes], path.y[nodes], path.heading[nodes]

    def locate(
        self, body: RoadObject, position: ArrayLike, heading: float, velocity: ArrayLike
    ) -> Located | None:
        """Locate a body of some position (2,), heading and velocity (2,); None if not beside."""
        ox, oy = np.asarray(position)
        squared = (self._x - ox) ** 2 + (self._y - oy) ** 2
        nearest = int(squared.argmin())
        # Nearest to an end of the stretch: behind the vehicle, or beyond the stretch.
        if nearest in {0, len(self._x) - 1}:
            return None
        c, s = math.cos(self._heading[nearest]), math.sin(self._heading[nearest])
        vx, vy = np.asarray(velocity)
        turned = heading - self._heading[nearest]
        along, across = abs(math.cos(turned)), abs(math.sin(turned))
        return Located(
            (self._first + nearest) * self._spacing,
            float(c * (oy - self._y[nearest]) - s * (ox - self._x[nearest])),
            float(c * vx + s * vy),
            float(c * vy - s * vx),
            0.5 * (along * body.LENGTH + across * body.WIDTH),
            0.5 * (along * body.WIDTH + across * body.LENGTH),
        )


def leaders(
    path: ReferencePath,
    arc_length: float,
    front: float,
    half_width: float,
    others: Sequence[RoadObject],
    cruise: CruiseControl,
) -> list[Leader]:
    """Find the bodies ahead that block the path of a vehicle, or will block it.

    The vehicle's foot point is at `arc_length` (m), its front bumper `front` (m) ahead of that, and
    `half_width` (m) is half the width of its body.

    A body will block the path if it moves into it sideways at its present lateral speed within the
    time of a cut-in, or if its own lane leads into it, as at a merge or a roundabout. In the second
    case its place is projected back: the arc length that it will reach on the path, minus the
    distance that it covers until then. So of two vehicles that approach a merge, the one that would
    arrive later yields.
    """
    stretch = Stretch(path, arc_length, cruise.range)
    bumper = arc_length + front
    found = []
    for other in others:
        now = stretch.locate(other, other.position, other.heading, other.velocity)
        if now is not None and _blocks(now, half_width, cruise):
            found.append(Leader(now.arc_length - now.half_length - bumper, now.along))
            continue
        for time, later in _predicted(other, stretch):
            if _blocks(later, half_width, cruise):
                arc_length_now = later.arc_length - later.along * time
                # A body behind the front bumper will follow this vehicle.
                if arc_length_now + later.half_length > bumper:
                    found.append(Leader(arc_length_now - later.half_length - bumper, later.along))
                break
    return found


def _blocks(body: Located, half_width: float, cruise: CruiseControl) -> bool:
    """Return whether a body blocks the path, or will soon move into it sideways."""
    reach = half_width + body.half_width + cruise.side_clearance
    soon = body.offset + body.across * cruise.cut_in_time
    return min(abs(body.offset), abs(soon)) <= reach or body.offset * soon < 0.0


def _predicted(other: RoadObject, stretch: Stretch) -> Iterator[tuple[float, Located]]:
    """Predict a vehicle that goes on along its lane: times, s, and where it is beside the path."""
    if not isinstance(other, ControlledVehicle) or other.crashed:
        return
    for time in PREDICTION_TIMES:
        position, heading = _along_lanes(other, other.speed * time)
        velocity = other.speed * np.array([math.cos(heading), math.sin(heading)])
        located = stretch.locate(other, position, heading, velocity)
        if located is not None:
            yield time, located


def _along_lanes(other: ControlledVehicle, distance: float) -> tuple[Array, float]:
    """Position (2,), m, and heading, rad, of a vehicle after a distance (m) along its lanes.

    Where several roads follow and its route names none of them, it goes straight on. (highway-env's
    own prediction fails where a road has fewer lanes than the one before.)
    """
    network = other.road.network
    index, planned = other.lane_index, {step[0]: step[1] for step in other.route or ()}
    s = other.lane.local_coordinates(other.position)[0] + distance
    lane = other.lane
    while s > lane.length:
        node = index[1]
        roads = network.graph.get(node, {})
        after = planned.get(node, next(iter(roads)) if len(roads) == 1 else None)
        if after not in roads:
            break
        s -= lane.length
        end = lane.position(lane.length, 0.0)
        apart = [float(np.hypot(*(one.position(0.0, 0.0) - end))) for one in roads[after]]
        index = (node, after, int(np.argmin(apart)))
        lane = network.get_lane(index)
    return lane.position(s, 0.0), float(lane.heading_at(s))


class TrafficReference:
    """Reference of a vehicle in traffic: a path's table whose speeds keep the gap.

    The speeds are lowered at least as far as the preview of `layout` reaches. `vehicle` is the
    driven one, whose body counts for gaps; `cruise` None keeps the path's own speed regardless of
    traffic.

    Attributes
    ----------
    table
        (n, 8), the path's table with the present speeds and times; changed in place.
    leader
        The vehicle ahead: gap (inf if there is none) and speed (NaN).
    """

    def __init__(
        self,
        path: ReferencePath,
        vehicle: VehicleParameters,
        layout: ObservationLayout,
        cruise: CruiseControl | None,
    ) -> None:
        self.path, self.cruise = path, cruise
        self.table: Array = path.table.copy()
        self.leader = NOBODY
        middle = 0.5 * (vehicle.front_axle_distance - vehicle.rear_axle_distance)
        self._front, self._half_width = middle + 0.5 * vehicle.length, 0.5 * vehicle.width
        self._steps = math.ceil((layout.preview_steps * layout.preview_period + BEYOND) / STEP)
        self._settings = cruise or CruiseControl()
        self._lowered = False

    def update(self, arc_length: float, speed: float, others: Sequence[RoadObject]) -> None:
        """Find the vehicle ahead, and lower the reference's speeds to keep the gap.

        This vehicle is at `arc_length` (m) and drives at `speed` (m/s).
        """
        ahead = leaders(
            self.path, arc_length, self._front, self._half_width, others, self._settings
        )
        self.leader = min(ahead, default=NOBODY)
        if self.cruise is None:
            return
        if ahead:
            profile = self.cruise.profile(arc_length, speed, ahead, STEP, self._steps)
            lower_speed(self.path, self.table, *profile)
        elif self._lowered:
            self.table[:] = self.path.table
        self._lowered = bool(ahead)
