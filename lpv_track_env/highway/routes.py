"""Reference paths from routes over highway-env's lanes.

Lanes that follow each other do not join: on `racetrack` they overlap by up to 2.6 m or leave as
much open, and the heading jumps by up to 5 degrees there. So their centre lines are sampled, cut
back at every junction, and refitted as one smooth curve, periodic where the route is a lap.

highway-env's y axis is drawn downwards, but its angles go from x to y like ours: its coordinates
are taken as they are, and what is left of the path here is drawn right of it there.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.road.road import RoadNetwork
from numpy.typing import NDArray

from trajectories import ReferencePath
from trajectories.shapes import from_geometry, smooth
from trajectories.speed import SpeedLimits

Array = NDArray[np.float64]
LaneIndex = tuple[str, str, int]

SPACING = 1.0
"""m between samples of a centre line."""
CUT = 2.0
"""m of each lane that are left out at a junction, beyond what overlaps."""
SMOOTHING = 0.05
"""m, rms by which the path may pass the sampled centre lines."""


def lane_route(network: RoadNetwork, nodes: Sequence[str], lane: int) -> list[LaneIndex]:
    """Lanes along a route of nodes: `lane` of the first road, then whichever begins nearest.

    Raises
    ------
    ValueError
        If two nodes that follow each other are not joined by a road, or the first road has no such
        lane.
    """
    if len(nodes) < 2:
        raise ValueError("a route needs two nodes or more")
    route: list[LaneIndex] = []
    for begin, end in pairwise(nodes):
        lanes = network.graph.get(begin, {}).get(end)
        if not lanes:
            known = ", ".join(network.graph.get(begin, {})) or "nothing"
            raise ValueError(f"no road from {begin!r} to {end!r}; from {begin!r} leads: {known}")
        if not route:
            if not 0 <= lane < len(lanes):
                raise ValueError(f"lane must be 0 to {len(lanes) - 1} there, not {lane}")
            route.append((begin, end, lane))
            continue
        last = network.get_lane(route[-1])
        place = last.position(last.length, 0.0)
        apart = [float(np.hypot(*(one.position(0.0, 0.0) - place))) for one in lanes]
        route.append((begin, end, int(np.argmin(apart))))
    return route


def road_ahead(network: RoadNetwork, begin: str, end: str) -> tuple[str, ...]:
    """Nodes of the road that goes on from a first one, until it ends or closes to a lap.

    Raises
    ------
    ValueError
        Where it branches: then a route must be given.
    """
    nodes = [begin, end]
    while nodes[-1] != begin:
        following = list(network.graph.get(nodes[-1], {}))
        if not following:
            break
        if len(following) > 1:
            raise ValueError(
                f"the road branches at {nodes[-1]!r} to {', '.join(following)}: "
                f"give a route of nodes that begins with {begin!r}, {end!r}"
            )
        if following[0] in nodes[1:]:
            raise ValueError(
                f"the road leads back to {following[0]!r}, not to where it begins: give a route"
            )
        nodes.append(following[0])
    return tuple(nodes)


def centre_points(network: RoadNetwork, route: Sequence[LaneIndex], *, closed: bool) -> Array:
    """Points (n, 2), m, along the centre lines of a route's lanes, thinned at junctions."""
    lanes = [network.get_lane(index) for index in route]
    count = len(lanes)
    parts = []
    for k, lane in enumerate(lanes):
        inner_start, inner_end = closed or k > 0, closed or k < count - 1
        start = _cut(lanes[k - 1], lane) if inner_start else 0.0
        end = _cut(lane, lanes[(k + 1) % count]) if inner_end else 0.0
        # Of a short lane something stays.
        share = min(1.0, 0.8 * lane.length / max(start + end, 1e-9))
        start, end = share * start, lane.length - share * end
        steps = max(int(np.ceil((end - start) / SPACING)), 1)
        at = np.linspace(start, end, steps + 1)
        parts.append(np.array([lane.position(s, 0.0) for s in at], dtype=np.float64))
    return np.vstack(parts)


def _cut(before: AbstractLane, after: AbstractLane) -> float:
    """How much of either lane is left out at their junction, m: half the overlap, and `CUT`."""
    end = np.asarray(before.position(before.length, 0.0))
    heading = before.heading_at(before.length)
    gap = np.asarray(after.position(0.0, 0.0)) - end
    along = float(gap @ np.array([np.cos(heading), np.sin(heading)]))
    return CUT + max(-0.5 * along, 0.0)


def reference_path(
    network: RoadNetwork,
    route: Sequence[LaneIndex],
    limits: SpeedLimits,
    *,
    closed: bool,
    name: str,
) -> ReferencePath:
    """Fit a path to a route and plan its speed.

    Parameters
    ----------
    network
        The lanes.
    route
        Lanes that follow each other; of a lap, the last leads to the first.
    limits
        Of the speed; its `max_speed` is lowered to the least speed limit of the route's lanes.
    closed
        Whether the route is a lap.
    name
        Of the path.

    Returns
    -------
    ReferencePath
        With `route`, and how far it passes the lanes' centres, in its metadata.
    """
    points = centre_points(network, route, closed=closed)
    lanes = [network.get_lane(index) for index in route]
    allowed = [float(lane.speed_limit) for lane in lanes if lane.speed_limit is not None]
    limits = replace(limits, max_speed=min([limits.max_speed, *allowed]))
    return _fitted(points.tobytes(), limits, closed, name, tuple(route))


@lru_cache(maxsize=64)
def _fitted(
    points: bytes, limits: SpeedLimits, closed: bool, name: str, route: tuple[LaneIndex, ...]
) -> ReferencePath:
    """Fit points, once in a process: roads are made anew for every episode, mostly the same."""
    smoothed = smooth(np.frombuffer(points).reshape(-1, 2), SMOOTHING, closed=closed)
    return from_geometry(
        smoothed.geometry, limits, name, closed=closed,
        source="highway-env: centre lines of a route, refitted",
        route=[list(index) for index in route],
        max_deviation=smoothed.max_deviation,
        rms_deviation=smoothed.rms_deviation,
    )  # fmt: skip
