"""Sizes, colours, text and lines of every frame, and the view from the world to pixels."""

import importlib.util
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
import pygame  # the line above silences its greeting

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

WIDTH, HEIGHT = 900, 600
"""Pixels of a frame."""
SCENE_HEIGHT = 456
"""Pixels of the frame's upper part, the scene; the strip charts are below it."""
SUPERSAMPLING = 2
"""Factor by which everything is drawn larger and then scaled down: antialiasing of all shapes."""
MARGIN, PADDING = 12, 10
"""Pixels around and within the cards that lie on the scene."""

BACKGROUND, CORRIDOR, CORRIDOR_EDGE = (246, 247, 249), (233, 236, 240), (206, 211, 218)
ROAD, LANE_LINE = (222, 225, 229), (255, 255, 255)
INK, FAINT, GRID, ALERT = (30, 36, 48), (116, 124, 138), (224, 228, 234), (200, 38, 38)
CARD = (255, 255, 255, 236)
DASHBOARD, PLOT = (255, 255, 255), (250, 251, 252)
BODY, OUTLINE, GLASS, TYRE = (208, 222, 243), (38, 70, 128), (118, 144, 180), (30, 36, 48)
SHADOW, LAMP = (214, 217, 223), (250, 220, 130)
OTHER, OTHER_GLASS = (150, 158, 170), (104, 112, 126)
TRAIL, PLAN, FORCE = (24, 28, 38), (206, 44, 148), (240, 120, 20)
TRACE, TRACE_FILL, REFERENCE = (38, 96, 184), (214, 227, 246), (240, 120, 20)

# Samples of matplotlib's "viridis" and "YlOrRd", without the ends that are too pale on white.
SCALES = {
    "speed": ((68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81)),
    "curvature": ((254, 217, 118), (254, 178, 76), (252, 104, 48), (214, 20, 32), (110, 0, 40)),
}
"""Colours of a path, from the lowest to the highest value."""
COLOUR_STEPS = 48
"""Shades of a scale; with fewer shades, longer runs of a line are drawn at once."""
CHUNK = 8
"""Segments of a line of one colour that are filled as one polygon."""


def shades(scale: str, shares: Sequence[float] | Array) -> list[Colour]:
    """Return the colours of a scale at shares from 0 to 1."""
    samples = np.array(SCALES[scale], dtype=np.float64)
    rounded = np.round(np.clip(shares, 0.0, 1.0) * COLOUR_STEPS) / COLOUR_STEPS
    at = np.linspace(0.0, 1.0, len(samples))
    channels = np.array([np.interp(rounded, at, channel) for channel in samples.T])
    return [(int(r), int(g), int(b)) for r, g, b in channels.T]


class Letters:
    """Text renderer with a cache.

    Sizes are in pixels of the frame; the surfaces are larger by SUPERSAMPLING.
    """

    MOST = 2000
    """Largest number of texts kept."""

    def __init__(self) -> None:
        pygame.font.init()
        self._fonts: dict[tuple[int, bool], pygame.font.Font] = {}
        self._texts: dict[tuple[str, Colour, int, bool], pygame.Surface] = {}

    def render(
        self, text: str, colour: Colour, size: int = 12, *, bold: bool = False
    ) -> pygame.Surface:
        """Render a text on a transparent surface."""
        key = (text, colour, size, bold)
        if key not in self._texts:
            if len(self._texts) >= self.MOST:
                self._texts.clear()
            self._texts[key] = self._font(size, bold).render(text, True, colour)
        return self._texts[key]

    def fitted(
        self, text: str, width: float, colour: Colour, size: int = 12, *, bold: bool = False
    ) -> pygame.Surface:
        """Render a text, shortened to fit into `width` pixels of the frame."""
        surface, kept = self.render(text, colour, size, bold=bold), text
        while surface.get_width() > SUPERSAMPLING * width and len(kept) > 1:
            kept = kept[:-1]
            surface = self.render(f"{kept.rstrip()}…", colour, size, bold=bold)
        return surface

    def _font(self, size: int, bold: bool) -> pygame.font.Font:
        if (size, bold) not in self._fonts:
            self._fonts[size, bold] = pygame.font.Font(_font_file(bold), SUPERSAMPLING * size)
        return self._fonts[size, bold]


def _font_file(bold: bool) -> Path | None:
    """Find DejaVu Sans, which comes with matplotlib; None stands for pygame's own font."""
    # Importing matplotlib would take longer than drawing a hundred frames.
    found = importlib.util.find_spec("matplotlib")
    if found is None or found.origin is None:
        return None
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    file = Path(found.origin).parent / "mpl-data" / "fonts" / "ttf" / name
    return file if file.is_file() else None


def signed(value: float, digits: int) -> str:
    """Write a number with its sign; a rounded zero is never negative."""
    return f"{round(float(value), digits) + 0.0:+.{digits}f}"


def card(width: float, height: float) -> pygame.Surface:
    """Make an empty card to write on, with a size in pixels of the frame."""
    size = (round(SUPERSAMPLING * width), round(SUPERSAMPLING * height))
    surface = pygame.Surface(size, pygame.SRCALPHA, 32)
    pygame.draw.rect(surface, CARD, ((0, 0), size), border_radius=6 * SUPERSAMPLING)
    return surface


class View:
    """Map from the world (m, y upwards) to pixels (y downwards), `scale` pixels per metre.

    The place `centre` (m, m) is shown at the pixel `middle`: the middle of the picture, or right of
    it and below.
    """

    def __init__(
        self, centre: tuple[float, float], scale: float, middle: tuple[float, float]
    ) -> None:
        self.scale = scale
        self._centre, self._middle = np.array(centre), np.array(middle)
        self._stretch = np.array([scale, -scale])

    def pixels(self, points: Array) -> Array:
        """Convert world points (..., 2), m, to pixels (..., 2)."""
        moved: Array = (points - self._centre) * self._stretch + self._middle
        return moved

    def window(self) -> tuple[Array, Array]:
        """Lower left and upper right corner (2,) of the visible part of the world, m."""
        half = self._middle / self.scale
        return self._centre - half, self._centre + half

    def visible(self, low: Array, high: Array) -> NDArray[np.intp]:
        """Indices of the visible ones among n boxes with corners (n, 2), m."""
        left, right = self.window()
        return np.flatnonzero(((high >= left) & (low <= right)).all(axis=1))


def turned(points: Array, angle: float) -> Array:
    """Turn points (n, 2) counter-clockwise about the origin."""
    c, s = math.cos(angle), math.sin(angle)
    result: Array = points @ np.array([[c, s], [-s, c]])
    return result


def normals(points: Array) -> Array:
    """Unit normals (n, 2) of a line through points (n, 2), n >= 2; zero where points coincide."""
    along = np.empty_like(points)
    steps = points[1:] - points[:-1]
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    steps /= np.maximum(lengths, 1e-12)[:, None]
    along[0], along[-1] = steps[0], steps[-1]
    along[1:-1] = steps[1:] + steps[:-1]
    size = np.hypot(along[:, 0], along[:, 1])
    result: Array = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(size, 1e-12)[:, None]
    return result


def polyline(surface: pygame.Surface, colour: Colour, points: Array, width: float) -> None:
    """Draw a line through pixels (n, 2), `width` pixels thick."""
    if len(points) < 2:
        return
    across = normals(points) * (0.5 * width)
    left, right = (points + across).tolist(), (points - across).tolist()
    for k in range(0, len(points) - 1, CHUNK):
        end = k + CHUNK + 1
        pygame.draw.polygon(surface, colour, left[k:end] + right[k:end][::-1])


def coloured_line(
    surface: pygame.Surface, colours: Sequence[Colour], points: Array, across: Array, width: float
) -> None:
    """Draw a line through pixels (n, 2), with one colour for each of its n - 1 segments.

    `across` (n, 2) are its unit normals, which callers compute once for many frames.
    """
    offset = across * (0.5 * width)
    left, right = (points + offset).tolist(), (points - offset).tolist()
    start = 0
    for k in range(1, len(points)):
        # A run of segments of one colour is one polygon.
        if k == len(points) - 1 or colours[k] != colours[start] or k - start == CHUNK:
            pygame.draw.polygon(
                surface, colours[start], left[start : k + 1] + right[start : k + 1][::-1]
            )
            start = k


def clipped(polygon: Array, low: Array, high: Array) -> Array:
    """Clip a polygon (n, 2) to a box with corners (2,); return (k, 2).

    The algorithm of Sutherland and Hodgman cuts off what lies beyond each side of the box in turn.
    The parts of a concave polygon stay joined by seams along the sides.
    """
    for axis in (0, 1):
        for sign, bound in ((1.0, low[axis]), (-1.0, high[axis])):
            if len(polygon) == 0:
                return polygon
            inside = sign * (polygon[:, axis] - bound)
            if (inside >= 0.0).all():
                continue
            following, after = np.roll(polygon, -1, axis=0), np.roll(inside, -1)
            crosses = (inside >= 0.0) != (after >= 0.0)
            share = np.where(crosses, inside / np.where(crosses, inside - after, 1.0), 0.0)
            cut = polygon + share[:, None] * (following - polygon)
            # Each kept corner is followed by the point where its edge crosses the side, if any.
            both = np.stack([polygon, cut], axis=1).reshape(-1, 2)
            polygon = both[np.stack([inside >= 0.0, crosses], axis=1).ravel()]
    return polygon


def boxes(lines: Sequence[Array]) -> tuple[Array, Array]:
    """Lower left and upper right corners, each (n, 2), of the boxes around n sets of points."""
    if not lines:
        return np.empty((0, 2)), np.empty((0, 2))
    return (
        np.array([line.min(axis=0) for line in lines]),
        np.array([line.max(axis=0) for line in lines]),
    )
