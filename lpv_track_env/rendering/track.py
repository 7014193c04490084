"""The reference path and its corridor, coloured by speed or curvature."""

import numpy as np
import pygame
from numpy.typing import NDArray

from lpv_track_env.rendering.style import (
    BACKGROUND,
    CORRIDOR,
    CORRIDOR_EDGE,
    FAINT,
    INK,
    PADDING,
    SUPERSAMPLING,
    Type,
    card,
    shades,
)
from lpv_track_env.rendering.view import View, coloured_line, polyline
from trajectories import ReferencePath

Array = NDArray[np.float64]

COLOURINGS = {"speed": ("reference speed", "m/s", 1), "curvature": ("|curvature|", "1/m", 3)}
"""What a path may be coloured by: title, unit and digits of its legend."""
WIDEST_CORRIDOR = 50.0
"""m to each side; a wider one fills every picture."""
PATH_WIDTH = 4.5
"""Pixels of the frame."""
EVERY = 2
"""Of the path's nodes, 0.25 m apart, every second is drawn: half a metre is 10 pixels."""
TURN, LONGEST = 0.05, 15.0
"""rad and m: the corridor is drawn in pieces that turn no more and are no longer."""
MAP_SIZE, LEGEND_HEIGHT = (184, 132), 42
"""Pixels of the card with map and legend."""


class Track:
    """A path made ready to be drawn often.

    Parameters
    ----------
    path
        The reference.
    half_width
        Of the corridor, m.
    colour
        What the path is coloured by, one of `COLOURINGS`.
    letters
        To write the legend with.
    """

    def __init__(self, path: ReferencePath, half_width: float, colour: str, letters: Type) -> None:
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
        self._colours = shades(colour, share[nodes])
        self._closed = path.closed
        self.overview, self._map_view = self._draw_overview()
        self._write_legend(letters, colour, low, high)

    def draw(self, surface: pygame.Surface, view: View, *, corridor: bool) -> None:
        """Draw what a view sees of the path, and of its corridor."""
        if corridor:
            self._draw_corridor(surface, view)
        across = self._normals * (1.0, -1.0)
        for run in _stays(self._line, view, 2.0):
            if len(run) > 1:
                colours = [self._colours[k] for k in run]
                points = view.pixels(self._line[run])
                width = PATH_WIDTH * SUPERSAMPLING
                coloured_line(surface, colours, points, across[run], width)
        if not self._closed:
            self._draw_finish(surface, view)

    def _draw_corridor(self, surface: pygame.Surface, view: View) -> None:
        runs = _stays(self._middle, view, self._reach + LONGEST)
        sides = [(view.pixels(self._left[run]), view.pixels(self._right[run])) for run in runs]
        # All edges lie under all surfaces, so that those within the corridor do not show.
        for left, right in sides:
            for side in (left, right):
                polyline(surface, CORRIDOR_EDGE, side, 3.0 * SUPERSAMPLING)
        for left, right in sides:
            ours, theirs = left.tolist(), right.tolist()
            for k in range(len(ours) - 1):
                corners = (ours[k], ours[k + 1], theirs[k + 1], theirs[k])
                pygame.draw.polygon(surface, CORRIDOR, corners)

    def _draw_finish(self, surface: pygame.Surface, view: View) -> None:
        """A chequered line across the end."""
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
                colour = INK if (row + k) % 2 else BACKGROUND
                pygame.draw.polygon(surface, colour, view.pixels(quad).tolist())

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where a place of the world lies on the map's card, kept on it; pixels of the card."""
        spot = self._map_view.pixels(np.array([x, y]))
        margin = 5.0 * SUPERSAMPLING
        room = np.array(MAP_SIZE) * SUPERSAMPLING - margin
        kept = np.clip(np.nan_to_num(spot), margin, room)
        return float(kept[0]), float(kept[1])

    def _draw_overview(self) -> tuple[pygame.Surface, View]:
        """Map of the whole path, north up, and its view."""
        low, high = self._line.min(axis=0), self._line.max(axis=0)
        room = (np.array(MAP_SIZE) - 2.0 * PADDING - 6.0) * SUPERSAMPLING
        scale = float((room / np.maximum(high - low, 1.0)).min())
        centre = 0.5 * (low + high)
        middle = (0.5 * SUPERSAMPLING * MAP_SIZE[0], 0.5 * SUPERSAMPLING * MAP_SIZE[1])
        view = View((float(centre[0]), float(centre[1])), scale, middle)
        surface = card(MAP_SIZE[0], MAP_SIZE[1] + LEGEND_HEIGHT)
        points = view.pixels(self._line)
        across = self._normals * (1.0, -1.0)
        coloured_line(surface, self._colours, points, across, 2.6 * SUPERSAMPLING)
        if not self._closed:
            for point in (points[0], points[-1]):
                pygame.draw.circle(surface, INK, point.tolist(), 2.6 * SUPERSAMPLING)
        return surface, view

    def _write_legend(self, letters: Type, colour: str, low: float, high: float) -> None:
        """Write the bar of the path's colours below the map, with its least and greatest value."""
        title, unit, digits = COLOURINGS[colour]
        left, right = PADDING * SUPERSAMPLING, (MAP_SIZE[0] - PADDING) * SUPERSAMPLING
        top = (MAP_SIZE[1] + 4) * SUPERSAMPLING
        share = np.linspace(0.0, 1.0, right - left)
        if high - low <= 1e-6:
            share = np.full(right - left, 0.5)
        for k, shade in enumerate(shades(colour, share)):
            start = (left + k, top + 20 * SUPERSAMPLING)
            pygame.draw.line(self.overview, shade, start, (start[0], start[1] + 9))
        text = letters.render(f"{title}, {unit}", FAINT, 10)
        self.overview.blit(text, ((left + right - text.get_width()) // 2, top))
        self.overview.blit(letters.render(f"{low:.{digits}f}", INK, 10), (left, top))
        number = letters.render(f"{high:.{digits}f}", INK, 10)
        self.overview.blit(number, (right - number.get_width(), top))


def _turning(heading: Array, arc_length: Array) -> NDArray[np.intp]:
    """Indices of the nodes that a path's turns need, the first and the last among them."""
    kept = [0]
    for k in range(1, len(heading) - 1):
        turned = abs(heading[k + 1] - heading[kept[-1]])
        if turned > TURN or arc_length[k + 1] - arc_length[kept[-1]] > LONGEST:
            kept.append(k)
    return np.array([*kept, len(heading) - 1])


def _stays(points: Array, view: View, margin: float) -> list[NDArray[np.intp]]:
    """Unbroken runs of the points (n, 2) m that a view sees, or has within a margin (m)."""
    low, high = view.window()
    indices = np.flatnonzero(((points > low - margin) & (points < high + margin)).all(axis=1))
    return np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
