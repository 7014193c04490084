"""Where things of the world lie in a picture, and lines as thick as pixels ask for."""

import math
from collections.abc import Sequence

import numpy as np
import pygame
from numpy.typing import NDArray

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

CHUNK = 8
"""Segments of a line of one colour that are filled as one polygon."""


class View:
    """World (m, y upwards) to pixels (y downwards).

    Parameters
    ----------
    centre
        Place in the world (m, m) that is seen in the middle.
    scale
        Pixels a metre.
    middle
        Pixel (x, y) of the middle: that of the picture, or right of it and below.
    """

    def __init__(
        self, centre: tuple[float, float], scale: float, middle: tuple[float, float]
    ) -> None:
        self.scale = scale
        self._centre, self._middle = np.array(centre), np.array(middle)
        self._stretch = np.array([scale, -scale])

    def pixels(self, points: Array) -> Array:
        """Pixels (..., 2) of world points (..., 2) m."""
        moved: Array = (points - self._centre) * self._stretch + self._middle
        return moved

    def window(self) -> tuple[Array, Array]:
        """Lower left and upper right corner (2,) of what is seen, m in the world."""
        half = self._middle / self.scale
        return self._centre - half, self._centre + half

    def sees(self, low: Array, high: Array) -> NDArray[np.intp]:
        """Indices of boxes, corners (n, 2) m, that overlap what is seen."""
        left, right = self.window()
        return np.flatnonzero(((high >= left) & (low <= right)).all(axis=1))


def turned(points: Array, angle: float) -> Array:
    """Points (n, 2) turned counter-clockwise about the origin."""
    c, s = math.cos(angle), math.sin(angle)
    result: Array = points @ np.array([[c, s], [-s, c]])
    return result


def normals(points: Array) -> Array:
    """Unit normals (n, 2) of a line through points (n, 2), n >= 2; zero where it does not move."""
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
    """Draw a line through pixels (n, 2), its n - 1 segments in colours of their own.

    `across` (n, 2) are its unit normals, which a caller knows beforehand.
    """
    offset = across * (0.5 * width)
    left, right = (points + offset).tolist(), (points - offset).tolist()
    start = 0
    for k in range(1, len(points)):
        # Runs of one colour are one polygon.
        if k == len(points) - 1 or colours[k] != colours[start] or k - start == CHUNK:
            pygame.draw.polygon(
                surface, colours[start], left[start : k + 1] + right[start : k + 1][::-1]
            )
            start = k


def clipped(polygon: Array, low: Array, high: Array) -> Array:
    """A polygon's (n, 2) part within a box, corners (2,): (k, 2), of a concave one seamed.

    Sutherland and Hodgman's: side by side of the box, what lies beyond is cut off.
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
            # Each corner that stays is followed by the place where its edge leaves or enters.
            both = np.stack([polygon, cut], axis=1).reshape(-1, 2)
            polygon = both[np.stack([inside >= 0.0, crosses], axis=1).ravel()]
    return polygon


def boxes(lines: Sequence[Array]) -> tuple[Array, Array]:
    """Corners (n, 2), (n, 2) of the boxes around n sets of points (k, 2)."""
    if not lines:
        return np.empty((0, 2)), np.empty((0, 2))
    return (
        np.array([line.min(axis=0) for line in lines]),
        np.array([line.max(axis=0) for line in lines]),
    )
