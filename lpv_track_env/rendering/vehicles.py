"""Vehicles from above: the one that drives, and others around it."""

import numpy as np
import pygame
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.rendering.style import OTHER, OTHER_GLASS
from lpv_track_env.rendering.view import View, turned

Array = NDArray[np.float64]

OTHER_SHAPE = np.array(
    [(-0.5, -0.5), (0.42, -0.5), (0.5, -0.32), (0.5, 0.32), (0.42, 0.5), (-0.5, 0.5)]
)
"""Body (6, 2) as shares of length and width, from the middle, x forwards."""
OTHER_WINDSCREEN = np.array([(0.32, -0.36), (0.32, 0.36), (0.18, 0.44), (0.18, -0.44)])


def draw_others(surface: pygame.Surface, view: View, others: ArrayLike) -> None:
    """Draw other vehicles, (m, 5) [X m, Y m, heading rad, length m, width m].

    Those out of sight, or not finite, are left out.

    Raises
    ------
    ValueError
        For another shape.
    """
    rows = np.asarray(others, dtype=np.float64)
    if rows.size == 0:
        return
    if rows.ndim != 2 or rows.shape[1] != 5:
        raise ValueError(f"others must be (m, 5): X, Y, heading, length, width; got {rows.shape}")
    rows = rows[np.isfinite(rows).all(axis=1)]
    reach = np.hypot(rows[:, 3:4], rows[:, 4:5])
    for k in view.sees(rows[:, :2] - reach, rows[:, :2] + reach):
        x, y, heading, length, width = rows[k].tolist()
        for shape, colour in ((OTHER_SHAPE, OTHER), (OTHER_WINDSCREEN, OTHER_GLASS)):
            corners = turned(shape * (length, width), heading) + np.array([x, y])
            pygame.draw.polygon(surface, colour, view.pixels(corners).tolist())
