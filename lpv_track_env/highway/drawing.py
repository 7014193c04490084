"""highway-env's roads and traffic, as the renderer draws them."""

from collections.abc import Sequence

import numpy as np
from highway_env.road.lane import AbstractLane, LineType
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.objects import RoadObject
from numpy.typing import NDArray

from lpv_track_env.rendering.track import Scenery

Array = NDArray[np.float64]

PIECE = 10.0
"""m of a lane that are one surface."""
SPACING = 1.0
"""m between the points of its edges."""


def scenery(network: RoadNetwork) -> Scenery:
    """Surfaces of all lanes, and the lines that are painted beside them."""
    surfaces: list[Array] = []
    lines: list[tuple[Array, bool]] = []
    for lane in network.lanes_list():
        at = np.linspace(0.0, lane.length, max(int(np.ceil(lane.length / SPACING)), 1) + 1)
        # highway-env's lateral coordinate grows to what is the path's left here.
        edges = [_edge(lane, at, side) for side in (-0.5, 0.5)]
        step = max(int(PIECE / SPACING), 1)
        for k in range(0, len(at) - 1, step):
            part = slice(k, k + step + 1)
            surfaces.append(np.vstack([edges[0][part], edges[1][part][::-1]]))
        for edge, kind in zip(edges, lane.line_types, strict=True):
            if kind != LineType.NONE:
                lines.append((edge, kind == LineType.STRIPED))
    return Scenery(surfaces, lines)


def _edge(lane: AbstractLane, at: Array, side: float) -> Array:
    return np.array([lane.position(s, side * lane.width_at(s)) for s in at], dtype=np.float64)


def boxes(others: Sequence[RoadObject]) -> Array:
    """Bodies as the renderer takes them, (m, 5): X m, Y m, heading rad, length m, width m."""
    rows = [(*one.position, one.heading, one.LENGTH, one.WIDTH) for one in others]
    return np.array(rows, dtype=np.float64).reshape(-1, 5)
