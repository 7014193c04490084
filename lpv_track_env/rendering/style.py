"""Sizes, colours and type of the pictures, in one place so that they stay of one kind."""

import importlib.util
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
"""Everything is drawn this much larger and smoothed down: antialiasing for every shape alike."""
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

# Samples of matplotlib's "viridis", its yellow end left out as too pale on white; and of its
# "YlOrRd", the pale end left out.
SCALES = {
    "speed": ((68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81)),
    "curvature": ((254, 217, 118), (254, 178, 76), (252, 104, 48), (214, 20, 32), (110, 0, 40)),
}
"""Colours from the least to the greatest of what a path is coloured by."""
COLOUR_STEPS = 48
"""Shades of a scale: the fewer there are, the longer are the runs that are drawn at once."""


def shades(scale: str, shares: Sequence[float] | Array) -> list[Colour]:
    """Colours of a scale at shares from 0 to 1."""
    samples = np.array(SCALES[scale], dtype=np.float64)
    rounded = np.round(np.clip(shares, 0.0, 1.0) * COLOUR_STEPS) / COLOUR_STEPS
    at = np.linspace(0.0, 1.0, len(samples))
    channels = np.array([np.interp(rounded, at, channel) for channel in samples.T])
    return [(int(r), int(g), int(b)) for r, g, b in channels.T]


class Type:
    """Text as surfaces, each drawn once and kept.

    Sizes are in pixels of the frame; the surfaces are larger by SUPERSAMPLING.
    """

    MOST = 2000
    """Texts that are kept at most."""

    def __init__(self) -> None:
        pygame.font.init()
        self._fonts: dict[tuple[int, bool], pygame.font.Font] = {}
        self._texts: dict[tuple[str, Colour, int, bool], pygame.Surface] = {}

    def render(
        self, text: str, colour: Colour, size: int = 12, *, bold: bool = False
    ) -> pygame.Surface:
        """A text on a transparent surface."""
        key = (text, colour, size, bold)
        if key not in self._texts:
            if len(self._texts) >= self.MOST:
                self._texts.clear()
            self._texts[key] = self._font(size, bold).render(text, True, colour)
        return self._texts[key]

    def fitted(
        self, text: str, width: float, colour: Colour, size: int = 12, *, bold: bool = False
    ) -> pygame.Surface:
        """A text, cut to fit into `width` pixels of the frame."""
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
    """DejaVu Sans, which comes with matplotlib; None, pygame's own font, if it is not there."""
    # Found, not imported: that would take longer than a hundred frames.
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
    """An empty card, pixels of the frame, to write on and to lay on the scene."""
    size = (round(SUPERSAMPLING * width), round(SUPERSAMPLING * height))
    surface = pygame.Surface(size, pygame.SRCALPHA, 32)
    pygame.draw.rect(surface, CARD, ((0, 0), size), border_radius=6 * SUPERSAMPLING)
    return surface
