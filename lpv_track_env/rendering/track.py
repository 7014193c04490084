"""The ground of the scene: the reference path and its corridor, or roads in its place."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pygame
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.rendering import canvas
from lpv_track_env.rendering.canvas import SUPERSAMPLING, Letters, View
from trajectories import ReferencePath

Array = NDArray[np.float64]

COLOURINGS = {"speed": ("reference speed", "m/s", 1), "curvature": ("|curvature|", "1/m", 3)}
"""Quantities that can colour a path: title, unit and decimals of the legend."""
WIDEST_CORRIDOR = 50.0
"""m to each side; a wider corridor would fill every frame."""
PATH_WIDTH = 4.5
"""Pixels of the frame."""
EVERY = 2
"""Stride between the drawn nodes, which are 0.25 m apart: half a metre is 10 pixels."""
TURN, LONGEST = 0.05, 15.0
"""Largest turn (rad) and length (m) of the pieces in which the corridor is drawn."""
MAP_SIZE, LEGEND_HEIGHT = (184, 132), 42
"""Pixels of the card that holds map and legend."""
LINE_WIDTH = 0.15
"""Width of a painted line, m."""
DASH, GAP = 3.0, 4.5
"""Lengths of a dashed line's dashes and gaps, m."""
BEYOND = 5.0
"""m beyond the visible part of the world at which surfaces are clipped."""
PIECE = 16
"""Segments of a solid line that are drawn or left out together."""


class Track:
    """A path and its corridor of a half width (m), prepared for many frames.

    `colour` is the quantity that colours the path, one of `COLOURINGS`.
    """

    def __init__(
        self, path: ReferencePath, half_width: float, colour: str, letters: Letters
    ) -> None:
        nodes = np.unique(np.append(np.arange(0, len(path.x), EVERY), len(path.x) - 1))
        self._line = np.column_stack([path.x, path.y])[nodes]
        self._normals = np.column_stack([-np.sin(path.heading), np.cos(path.heading)])[nodes]
        self._reach = min(half_width, WIDEST_CORRIDOR)
        kept = _turning(path.heading[nodes], path.arc_length[nodes])
        self._middle, aside = self._line[kept], self._reach * self._normals[kept]
        self._left, self._right = self._middle + aside, self._middle - aside
        values = path.speed if colour == "speed" else np.abs(path.curvature)
        low, high = float(values.min()), float(values.max())
        share = (values - low) / (high - low) if high - low > 1e-6 else np.full(len(values), 0.5)
        self._colours = canvas.shades(colour, share[nodes])
        self._closed = path.closed
        self.overview, self._map_view = self._draw_overview()
        self._write_legend(letters, colour, low, high)

    def draw(self, surface: pygame.Surface, view: View, *, corridor: bool) -> None:
        """Draw the visible part of the path, and of its corridor."""
        if corridor:
            self._draw_corridor(surface, view)
        across = self._normals * (1.0, -1.0)
        for run in _visible_runs(self._line, view, 2.0):
            if len(run) > 1:
                colours = [self._colours[k] for k in run]
                points = view.pixels(self._line[run])
                width = PATH_WIDTH * SUPERSAMPLING
                canvas.coloured_line(surface, colours, points, across[run], width)
        if not self._closed:
            self._draw_finish(surface, view)

    def _draw_corridor(self, surface: pygame.Surface, view: View) -> None:
        runs = _visible_runs(self._middle, view, self._reach + LONGEST)
        sides = [(view.pixels(self._left[run]), view.pixels(self._right[run])) for run in runs]
        # All edges are drawn before all surfaces, which hide the edges inside the corridor.
        for left, right in sides:
            for side in (left, right):
                canvas.polyline(surface, canvas.CORRIDOR_EDGE, side, 3.0 * SUPERSAMPLING)
        for left, right in sides:
            ours, theirs = left.tolist(), right.tolist()
            for k in range(len(ours) - 1):
                corners = (ours[k], ours[k + 1], theirs[k + 1], theirs[k])
                pygame.draw.polygon(surface, canvas.CORRIDOR, corners)

    def _draw_finish(self, surface: pygame.Surface, view: View) -> None:
        """Draw a chequered line across the end."""
        low, high = view.window()
        if not ((self._line[-1] > low - 4.0) & (self._line[-1] < high + 4.0)).all():
            return
        across, along = self._normals[-1], self._line[-1] - self._line[-2]
        along = along / np.hypot(*along) * 0.5
        width = min(self._reach, 3.0)
        edges = np.linspace(-width, width, 9)
        for row in (0, 1):
            for k in range(8):
                corner = self._line[-1] + edges[k] * across + row * along
                step = (edges[1] - edges[0]) * across
                quad = np.array([corner, corner + step, corner + step + along, corner + along])
                colour = canvas.INK if (row + k) % 2 else canvas.BACKGROUND
                pygame.draw.polygon(surface, colour, view.pixels(quad).tolist())

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Pixel of the map's card for a place in the world, kept within the card."""
        spot = self._map_view.pixels(np.array([x, y]))
        margin = 5.0 * SUPERSAMPLING
        room = np.array(MAP_SIZE) * SUPERSAMPLING - margin
        kept = np.clip(np.nan_to_num(spot), margin, room)
        return float(kept[0]), float(kept[1])

    def _draw_overview(self) -> tuple[pygame.Surface, View]:
        """Draw a map of the whole path, north up; return it and its view."""
        low, high = self._line.min(axis=0), self._line.max(axis=0)
        room = (np.array(MAP_SIZE) - 2.0 * canvas.PADDING - 6.0) * SUPERSAMPLING
        scale = float((room / np.maximum(high - low, 1.0)).min())
        centre = 0.5 * (low + high)
        middle = (0.5 * SUPERSAMPLING * MAP_SIZE[0], 0.5 * SUPERSAMPLING * MAP_SIZE[1])
        view = View((float(centre[0]), float(centre[1])), scale, middle)
        surface = canvas.card(MAP_SIZE[0], MAP_SIZE[1] + LEGEND_HEIGHT)
        points = view.pixels(self._line)
        across = self._normals * (1.0, -1.0)
        canvas.coloured_line(surface, self._colours, points, across, 2.6 * SUPERSAMPLING)
        if not self._closed:
            for point in (points[0], points[-1]):
                pygame.draw.circle(surface, canvas.INK, point.tolist(), 2.6 * SUPERSAMPLING)
        return surface, view

    def _write_legend(self, letters: Letters, colour: str, low: float, high: float) -> None:
        """Draw the bar of the path's colours below the map, with the lowest and highest value."""
        title, unit, digits = COLOURINGS[colour]
        left, right = canvas.PADDING * SUPERSAMPLING, (MAP_SIZE[0] - canvas.PADDING) * SUPERSAMPLING
        top = (MAP_SIZE[1] + 4) * SUPERSAMPLING
        share = np.linspace(0.0, 1.0, right - left)
        if high - low <= 1e-6:
            share = np.full(right - left, 0.5)
        for k, shade in enumerate(canvas.shades(colour, share)):
            start = (left + k, top + 20 * SUPERSAMPLING)
            pygame.draw.line(self.overview, shade, start, (start[0], start[1] + 9))
        text = letters.render(f"{title}, {unit}", canvas.FAINT, 10)
        self.overview.blit(text, ((left + right - text.get_width()) // 2, top))
        self.overview.blit(letters.render(f"{low:.{digits}f}", canvas.INK, 10), (left, top))
        number = letters.render(f"{high:.{digits}f}", canvas.INK, 10)
        self.overview.blit(number, (right - number.get_width(), top))


def _turning(heading: Array, arc_length: Array) -> NDArray[np.intp]:
    """Indices of the nodes that the corridor needs: more in turns, always both ends."""
    kept = [0]
    for k in range(1, len(heading) - 1):
        turned = abs(heading[k + 1] - heading[kept[-1]])
        if turned > TURN or arc_length[k + 1] - arc_length[kept[-1]] > LONGEST:
            kept.append(k)
    return np.array([*kept, len(heading) - 1])


def _visible_runs(points: Array, view: View, margin: float) -> list[NDArray[np.intp]]:
    """Indices of the points (n, 2), m, visible or within a margin (m), as unbroken runs."""
    low, high = view.window()
    indices = np.flatnonzero(((points > low - margin) & (points < high + margin)).all(axis=1))
    return np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)


class Scenery(NamedTuple):
    """Roads around a path."""

    surfaces: Sequence[ArrayLike]
    """Polygons, each (n, 2) m with n >= 3."""
    lines: Sequence[tuple[ArrayLike, bool]]
    """Polylines, each (n, 2) m with n >= 2, and True for a dashed one."""


class SceneryDrawing:
    """A scenery, prepared for many frames; its invisible parts take no time to draw.

    Raises
    ------
    ValueError
        If a polygon or a line is not finite, not (n, 2), or has too few points.
    """

    def __init__(self, scenery: Scenery) -> None:
        self._surfaces = [_points("surface", given, 3) for given in scenery.surfaces]
        self._pieces: list[Array] = []
        for given, dashed in scenery.lines:
            line = _points("line", given, 2)
            self._pieces += _dashes(line) if dashed else _cut(line)
        self._surface_boxes = canvas.boxes(self._surfaces)
        self._piece_boxes = canvas.boxes(self._pieces)

    def draw(self, surface: pygame.Surface, view: View, thinnest: float) -> None:
        """Draw the visible part; lines are at least `thinnest` pixels wide."""
        low, high = view.window()
        for k in view.visible(*self._surface_boxes):
            # Filling a polygon takes time for its full height, visible or not.
            seen = canvas.clipped(self._surfaces[k], low - BEYOND, high + BEYOND)
            if len(seen) > 2:
                pygame.draw.polygon(surface, canvas.ROAD, view.pixels(seen).tolist())
        width = max(LINE_WIDTH * view.scale, thinnest)
        for k in view.visible(*self._piece_boxes):
            canvas.polyline(surface, canvas.LANE_LINE, view.pixels(self._pieces[k]), width)


def _points(what: str, given: ArrayLike, least: int) -> Array:
    points = np.asarray(given, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < least:
        raise ValueError(f"a {what} must be (n, 2) with n >= {least}, not {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(f"a {what} must be finite")
    return points


def _cut(line: Array) -> list[Array]:
    """Cut a line into pieces that join end to end."""
    return [line[k : k + PIECE + 1] for k in range(0, len(line) - 1, PIECE)]


def _dashes(line: Array) -> list[Array]:
    """Cut a line into dashes that keep its corners."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    dashes = []
    for start in np.arange(0.0, along[-1], DASH + GAP):
        end = min(start + DASH, along[-1])
        inside = along[(along > start) & (along < end)]
        at = np.concatenate([[start], inside, [end]])
        dashes.append(np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)]))
    return dashes
