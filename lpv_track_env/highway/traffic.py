"""Who is in the way on a path: other vehicles in the terms of adaptive cruise control."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.objects import RoadObject
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.highway.cruise import CruiseControl, Leader
from trajectories import ReferencePath

Array = NDArray[np.float64]

FORESEEN = (0.75, 1.5, 2.25, 3.0)
"""s ahead, at which vehicles that follow their lanes at constant speed are looked for again."""


def others_on(road: Road, ego: RoadObject | None) -> list[RoadObject]:
    """Every body on a road but one: highway-env's vehicles and objects."""
    return [one for one in (*road.vehicles, *road.objects) if one is not ego]


class Sighting(NamedTuple):
    """A body seen from a path: at an arc length, m, with how much of it reaches to each side.

    `offset`, m, and `across`, m/s, are positive to the left; `along` is m/s, `half_length` and
    `half_width`, m, are measured along the path and across it.
    """

    arc_length: float
    offset: float
    along: float
    across: float
    half_length: float
    half_width: float


class Watch:
    """The part of a path that lies ahead of a vehicle.

    Parameters
    ----------
    path
        The vehicle's reference.
    arc_length
        Of its foot point, m.
    reach
        m ahead.
    """

    def __init__(self, path: ReferencePath, arc_length: float, reach: float) -> None:
        last = len(path.x) - 1
        self._first, self._spacing = math.floor(arc_length / path.spacing), path.spacing
        nodes = np.arange(self._first, self._first + min(math.ceil(reach / path.spacing), last) + 1)
        nodes = nodes % last if path.closed else nodes[nodes <= last]
        self._x, self._y, self._heading = path.x[nodes], path.y[nodes], path.heading[nodes]

    def see(
        self, body: RoadObject, position: ArrayLike, heading: float, velocity: ArrayLike
    ) -> Sighting | None:
        """A body with some position (2,), heading and velocity (2,); None unless it is beside."""
        ox, oy = np.asarray(position)
        squared = (self._x - ox) ** 2 + (self._y - oy) ** 2
        nearest = int(squared.argmin())
        # Nearest to an end of what is watched: behind the vehicle, or further off.
        if nearest in {0, len(self._x) - 1}:
            return None
        c, s = math.cos(self._heading[nearest]), math.sin(self._heading[nearest])
        vx, vy = np.asarray(velocity)
        turned = heading - self._heading[nearest]
        along, across = abs(math.cos(turned)), abs(math.sin(turned))
        return Sighting(
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
    """Vehicles ahead that are in the way, or will be.

    Who will be in the way is what it has moved over, keeping its lateral speed, within the time of
    a cut-in; and who comes into it on its own lane, as at a merge or a roundabout. The latter
    count from where they would have been on the path by now: then one of two that approach a merge
    from the same distance gives way.

    Parameters
    ----------
    path
        The vehicle's reference.
    arc_length
        Of its foot point, m.
    front
        m from its foot point to its front bumper.
    half_width
        m, of its body.
    others
        What else is on the road.
    cruise
        Settings.
    """
    watch = Watch(path, arc_length, cruise.range)
    bumper = arc_length + front
    found = []
    for other in others:
        seen = watch.see(other, other.position, other.heading, other.velocity)
        if seen is not None and _blocks(seen, half_width, cruise):
            found.append(Leader(seen.arc_length - seen.half_length - bumper, seen.along))
            continue
        for time, later in _foreseen(other, watch):
            if _blocks(later, half_width, cruise):
                by_now = later.arc_length - later.along * time
                # Who would be behind the front bumper comes after.
                if by_now + later.half_length > bumper:
                    found.append(Leader(by_now - later.half_length - bumper, later.along))
                break
    return found


def _blocks(seen: Sighting, half_width: float, cruise: CruiseControl) -> bool:
    """Whether a body is in the way, or comes into it sideways."""
    reach = half_width + seen.half_width + cruise.side_clearance
    coming = seen.offset + seen.across * cruise.cut_in_time
    return min(abs(seen.offset), abs(coming)) <= reach or seen.offset * coming < 0.0


def _foreseen(other: RoadObject, watch: Watch) -> Iterator[tuple[float, Sighting]]:
    """Times, s, and what will be seen of a vehicle that goes on along its lane."""
    if not isinstance(other, ControlledVehicle) or other.crashed:
        return
    for time in FORESEEN:
        position, heading = _along_lanes(other, other.speed * time)
        velocity = other.speed * np.array([math.cos(heading), math.sin(heading)])
        seen = watch.see(other, position, heading, velocity)
        if seen is not None:
            yield time, seen


def _along_lanes(other: ControlledVehicle, distance: float) -> tuple[Array, float]:
    """Position (2,), m, and heading, rad, of a vehicle some distance on along its route's lanes.

    Where its route does not say which road follows and there are several, it goes straight on.
    (highway-env's own prediction fails where a road has fewer lanes than the one before.)
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
