"""Roads to draw in place of the corridor: surfaces and the lines painted on them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pygame
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.rendering.style import LANE_LINE, ROAD
from lpv_track_env.rendering.view import View, boxes, clipped, polyline

Array = NDArray[np.float64]

LINE_WIDTH = 0.15
"""m, of a painted line."""
DASH, GAP = 3.0, 4.5
"""m, of a dashed line."""
BEYOND = 5.0
"""m beyond what is seen at which surfaces are cut."""
PIECE = 16
"""Segments of a solid line that are looked at together: what is out of sight is not drawn."""


class Scenery(NamedTuple):
    """Roads around a path, in the world.

    Parameters
    ----------
    surfaces
        Polygons, each (n, 2) m with n >= 3.
    lines
        Pairs of a polyline (n, 2) m with n >= 2, and whether it is dashed.
    """

    surfaces: Sequence[ArrayLike]
    lines: Sequence[tuple[ArrayLike, bool]]


class SceneryDrawing:
    """A scenery made ready to be drawn often: what a view does not see costs nothing.

    Raises
    ------
    ValueError
        If a polygon or a line has too few points, another shape, or is not finite.
    """

    def __init__(self, scenery: Scenery) -> None:
        self._surfaces = [_points("surface", given, 3) for given in scenery.surfaces]
        self._pieces: list[Array] = []
        for given, dashed in scenery.lines:
            line = _points("line", given, 2)
            self._pieces += _dashes(line) if dashed else _cut(line)
        self._surface_boxes = boxes(self._surfaces)
        self._piece_boxes = boxes(self._pieces)

    def draw(self, surface: pygame.Surface, view: View, thinnest: float) -> None:
        """Draw what `view` sees; lines are at least `thinnest` pixels wide."""
        low, high = view.window()
        for k in view.sees(*self._surface_boxes):
            # Filling a polygon takes time for all of its height, seen or not.
            seen = clipped(self._surfaces[k], low - BEYOND, high + BEYOND)
            if len(seen) > 2:
                pygame.draw.polygon(surface, ROAD, view.pixels(seen).tolist())
        width = max(LINE_WIDTH * view.scale, thinnest)
        for k in view.sees(*self._piece_boxes):
            polyline(surface, LANE_LINE, view.pixels(self._pieces[k]), width)


def _points(what: str, given: ArrayLike, least: int) -> Array:
    points = np.asarray(given, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < least:
        raise ValueError(f"a {what} must be (n, 2) with n >= {least}, not {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(f"a {what} must be finite")
    return points


def _cut(line: Array) -> list[Array]:
    """Pieces of a line that join end to end."""
    return [line[k : k + PIECE + 1] for k in range(0, len(line) - 1, PIECE)]


def _dashes(line: Array) -> list[Array]:
    """Dashes of a line, its corners kept."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    dashes = []
    for start in np.arange(0.0, along[-1], DASH + GAP):
        end = min(start + DASH, along[-1])
        inside = along[(along > start) & (along < end)]
        at = np.concatenate([[start], inside, [end]])
        dashes.append(np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)]))
    return dashes
