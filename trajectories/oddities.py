"""Oddities of a path that are accepted with a warning: unresolved bends, close branches."""

import math

import numpy as np
from scipy.spatial import cKDTree

from trajectories.shapes import Geometry

KINK = 1.0
"""Turn over the distance between two points, rad, from which on a bend is warned of. Bends that a
vehicle cannot steer are another matter: `lpv_track_env.reference` warns of them."""
APPROACH, APPROACH_ALONG = 2.5, 20.0
"""m: a path approaches itself if it comes this close to a place this far away along the path."""
CHUNK = 4096
"""Points whose neighbours are looked up at once."""


def oddities(geometry: Geometry, closed: bool, spacing: float) -> list[str]:
    """Describe oddities of a path through points that are `spacing` (m) apart, in a sentence each.

    They are a bend that the points do not resolve, and branches that are close to each other.
    """
    found = []
    curvature = np.abs(geometry.curvature)
    sharpest = int(np.argmax(curvature))
    if curvature[sharpest] * spacing > KINK:
        found.append(
            f"bend of {1.0 / curvature[sharpest]:.1f} m radius at "
            f"{geometry.arc_length[sharpest]:.1f} m between points {spacing:.2g} m apart: more "
            "smoothing may widen it"
        )
    near = self_approach(geometry, closed)
    if near is not None:
        found.append(
            f"the path comes within {near[2]:.2f} m of itself, at {near[0]:.1f} m and "
            f"{near[1]:.1f} m: agents keep to their branch; in your own code, call "
            "project(x, y, near=...) with the last arc length"
        )
    return found


def self_approach(geometry: Geometry, closed: bool) -> tuple[float, float, float] | None:
    """Find where a path comes closest to itself: two arc lengths and their distance, m.

    None if no points that lie more than 20 m apart along the path (across the seam too if it is
    closed) are closer than 2.5 m.
    """
    # 0.5 m: the nearest nodes are at most 0.35 m further apart than the branches
    stride = max(round(0.5 / geometry.arc_length[1]), 1)
    s = geometry.arc_length[::stride]
    points = np.column_stack([geometry.x[::stride], geometry.y[::stride]])
    # A point's nearest neighbours, itself and those on its own branch included: one more than these
    # must contain the nearest point of another branch. All pairs may be 10^9 where a path lies over
    # itself many times.
    count = 2 * math.ceil(APPROACH_ALONG / s[1]) + 2
    tree = cKDTree(points, balanced_tree=False)
    best: tuple[float, float, float] | None = None
    for first in range(0, len(points), CHUNK):
        rows = slice(first, first + CHUNK)
        distances, others = tree.query(points[rows], count, distance_upper_bound=APPROACH)
        along = np.abs(np.append(s, math.inf)[others] - s[rows, None])
        if closed:
            along = np.minimum(along, np.abs(geometry.arc_length[-1] - along))
        distances[along <= APPROACH_ALONG] = math.inf
        row, column = np.unravel_index(int(np.argmin(distances)), distances.shape)
        distance = float(distances[row, column])
        if distance < (APPROACH if best is None else best[2]):
            ends = sorted((float(s[first + row]), float(s[others[row, column]])))
            best = ends[0], ends[1], distance
    return best
