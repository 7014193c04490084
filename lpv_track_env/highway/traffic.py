"""Who is in the way on a path: other vehicles in the terms of adaptive cruise control."""

import math
from collections.abc import Sequence

import numpy as np
from highway_env.vehicle.objects import RoadObject
from numpy.typing import NDArray

from lpv_track_env.highway.cruise import CruiseControl, Leader
from trajectories import ReferencePath

Array = NDArray[np.float64]


def leaders(
    path: ReferencePath,
    arc_length: float,
    front: float,
    half_width: float,
    others: Sequence[RoadObject],
    cruise: CruiseControl,
) -> list[Leader]:
    """Vehicles ahead that are in the way, or will be within the time of a cut-in.

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
    h, last = path.spacing, len(path.x) - 1
    first, count = math.floor(arc_length / h), math.ceil(cruise.range / h)
    nodes = np.arange(first, first + min(count, last) + 1)
    nodes = nodes % last if path.closed else nodes[nodes <= last]
    x, y = path.x[nodes], path.y[nodes]
    found = []
    for other in others:
        ox, oy = other.position
        squared = (x - ox) ** 2 + (y - oy) ** 2
        nearest = int(squared.argmin())
        # Nearest to an end of what is watched: behind the vehicle, or further off.
        if nearest == 0 or squared[nearest] > cruise.range**2 or nearest == len(nodes) - 1:
            continue
        heading = path.heading[nodes[nearest]]
        c, s = math.cos(heading), math.sin(heading)
        offset = c * (oy - y[nearest]) - s * (ox - x[nearest])
        vx, vy = other.velocity
        along, across = c * vx + s * vy, c * vy - s * vx
        turned = other.heading - heading
        width = 0.5 * (abs(math.cos(turned)) * other.WIDTH + abs(math.sin(turned)) * other.LENGTH)
        reach = half_width + width + cruise.side_clearance
        coming = offset + across * cruise.cut_in_time
        if min(abs(offset), abs(coming)) > reach and offset * coming > 0.0:
            continue
        length = 0.5 * (abs(math.cos(turned)) * other.LENGTH + abs(math.sin(turned)) * other.WIDTH)
        at = (first + nearest) * h
        found.append(Leader(at - length - arc_length - front, float(along)))
    return found
