"""Reference paths from routes over highway-env's lanes.

Consecutive lanes do not join exactly: on `racetrack` they overlap or leave a gap of up to 2.6 m,
and the heading jumps by up to 5 degrees. So their centre lines are sampled, shortened at every
junction, and fitted by one smooth curve, which is periodic if the route is a lap.

highway-env draws its y axis downwards, but its angles turn from x to y as they do here. So its
coordinates are used unchanged; the left of a path is drawn on its right in highway-env's own
pictures.
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
"""Distance between samples of a centre line, m."""
CUT = 2.0
"""Length of each lane left out at a junction, in addition to half the overlap, m."""
SMOOTHING = 0.05
"""Largest rms deviation of the path from the sampled centre lines, m."""


def lane_route(network: RoadNetwork, nodes: Sequence[str], lane: int) -> list[LaneIndex]:
    """Find the lanes along a route: `lane` of the first road, then the lanes that begin nearest.

    Raises
    ------
    ValueError
        If two consecutive nodes are not joined by a road, or the first road has no such lane.
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
    """Follow the road from `begin` by `end` until it ends or closes a lap, and return its nodes.

    Raises
    ------
    ValueError
        If the road branches, so that a route must be given.
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
    """Sample the centre lines of a route's lanes, (n, 2), m, with gaps at junctions."""
    lanes = [network.get_lane(index) for index in route]
    count = len(lanes)
    parts = []
    for k, lane in enumerate(lanes):
        inner_start, inner_end = closed or k > 0, closed or k < count - 1
        start = _cut(lanes[k - 1], lane) if inner_start else 0.0
        end = _cut(lane, lanes[(k + 1) % count]) if inner_end else 0.0
        # Keep at least a fifth of a short lane.
        share = min(1.0, 0.8 * lane.length / max(start + end, 1e-9))
        start, end = share * start, lane.length - share * end
        steps = max(int(np.ceil((end - start) / SPACING)), 1)
        at = np.linspace(start, end, steps + 1)
        parts.append(np.array([lane.position(s, 0.0) for s in at], dtype=np.float64))
    return np.vstack(parts)


def _cut(before: AbstractLane, after: AbstractLane) -> float:
    """Length left out of either lane at their junction, m: half the overlap, and `CUT`."""
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
        Road network with the lanes.
    route
        Consecutive lanes; the last lane of a lap leads to the first.
    limits
        Speed limits; `max_speed` is lowered to the lowest speed limit of the route's lanes.
    closed
        Whether the route is a lap.
    name
        Name of the path.

    Returns
    -------
    ReferencePath
        A path with `route` and its deviation from the lanes' centres in its metadata.
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
    """Fit a path once per process: each episode makes its road anew, but mostly the same one."""
    smoothed = smooth(np.frombuffer(points).reshape(-1, 2), SMOOTHING, closed=closed)
    return from_geometry(
        smoothed.geometry, limits, name, closed=closed,
        source="highway-env: centre lines of a route, refitted",
        route=[list(index) for index in route],
        max_deviation=smoothed.max_deviation,
        rms_deviation=smoothed.rms_deviation,
    )  # fmt: skip
