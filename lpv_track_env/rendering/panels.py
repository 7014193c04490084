"""Cards on the scene: what is driven, what the agent does, the map, the key."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pygame
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.rendering.forces import AxleForces
from lpv_track_env.rendering.style import (
    ALERT,
    FAINT,
    GRID,
    INK,
    MARGIN,
    PADDING,
    PLAN,
    SCENE_HEIGHT,
    SUPERSAMPLING,
    TRACE,
    TRAIL,
    WIDTH,
    Type,
    card,
    signed,
)
from lpv_track_env.rendering.vehicles import arrow
from lpv_track_env.rendering.view import Colour, View
from lpv_track_env.task import Task
from trajectories import CurvatureBands

Array = NDArray[np.float64]

CARD_WIDTH, ROW = 224, 17
"""Pixels of the frame."""
LABEL, NOTE_LABEL = 66, 54
"""Pixels of a row's label, of ours and of an agent's; its value follows."""
MOST_NOTES = 9
"""Rows of an agent's card: more would reach the charts."""
BANDS = CurvatureBands()


class Cards:
    """The words on an episode's frames.

    Parameters
    ----------
    task
        What is driven.
    letters
        To write with.
    """

    def __init__(self, task: Task, letters: Type) -> None:
        self._task, self._letters = task, letters
        self._curvature = np.abs(task.path.curvature)
        self._blank = card(CARD_WIDTH, 2 * PADDING + 5 * ROW + 1)
        self._notes: tuple[Mapping[str, str], pygame.Surface] | None = None
        self._scale: tuple[int, pygame.Surface] | None = None
        self._title = f"{task.path.name} · {task.vehicle.name}"

    def draw_task(self, surface: pygame.Surface, record: Array, forces: AxleForces) -> int:
        """Draw what is driven, how far, and in which band; returns the card's lower end."""
        scale, left = SUPERSAMPLING, SUPERSAMPLING * (MARGIN + PADDING)
        surface.blit(self._blank, (scale * MARGIN, scale * MARGIN))
        top = scale * (MARGIN + PADDING - 2)
        title = self._letters.fitted(self._title, CARD_WIDTH - 2 * PADDING, INK, 12, bold=True)
        surface.blit(title, (left, top))
        top += scale * (ROW + 4)
        self._row(
            surface, top, "time", f"{record[kernels.STEPS] * self._task.control_period:.2f} s"
        )
        top += scale * ROW
        s, length = float(record[kernels.ARC_LENGTH]), self._task.path.length
        share = (s - float(record[kernels.START]) * self._task.path.closed) / length
        self._row(surface, top, "driven", f"{s:.0f} of {length:.0f} m")
        self._bar(surface, top, min(max(share, 0.0), 1.0))
        top += scale * ROW
        curvature = float(
            np.interp(s % length if s > length else s, self._task.path.arc_length, self._curvature)
        )
        band = int(BANDS.classify(curvature))
        self._row(surface, top, "curvature", f"{BANDS.names[band]}")
        self._steps(surface, top, band)
        top += scale * ROW
        front, rear = (
            signed(math.degrees(slip), 1) for slip in (forces.front_slip, forces.rear_slip)
        )
        self._row(surface, top, "slip angles", f"{front}° front, {rear}° rear")
        return MARGIN + self._blank.get_height() // scale

    def draw_end(self, surface: pygame.Surface, end: int) -> None:
        """Draw how the episode has ended, over the middle of the scene."""
        if end == kernels.RUNNING:
            return
        colour = INK if end == kernels.FINISHED else ALERT
        text = self._letters.render(kernels.END_NAMES[end].replace("_", " "), colour, 16, bold=True)
        banner = card(text.get_width() / SUPERSAMPLING + 4 * PADDING, 36)
        place = (SUPERSAMPLING * WIDTH - banner.get_width()) // 2
        banner.blit(text, text.get_rect(center=banner.get_rect().center))
        surface.blit(banner, (place, SUPERSAMPLING * MARGIN))

    def draw_notes(self, surface: pygame.Surface, notes: Mapping[str, str], top: int) -> None:
        """Draw what an agent tells, a row an entry, below `top`."""
        if not notes:
            return
        if self._notes is None or self._notes[0] != notes:
            rows = list(notes.items())[:MOST_NOTES]
            panel = card(CARD_WIDTH, 2 * PADDING + ROW * len(rows) - 3)
            for k, (label, value) in enumerate(rows):
                at = SUPERSAMPLING * (PADDING + ROW * k - 2)
                word = self._letters.fitted(label, NOTE_LABEL - 4, FAINT, 11)
                panel.blit(word, (SUPERSAMPLING * PADDING, at))
                room = CARD_WIDTH - 2 * PADDING - NOTE_LABEL
                panel.blit(
                    self._letters.fitted(value, room, INK, 11),
                    (SUPERSAMPLING * (PADDING + NOTE_LABEL), at),
                )
            self._notes = (dict(notes), panel)
        place = (SUPERSAMPLING * MARGIN, SUPERSAMPLING * (top + MARGIN // 2))
        surface.blit(self._notes[1], place)

    def draw_scale(self, surface: pygame.Surface, view: View) -> None:
        """Draw a bar of round length, between 60 and 150 pixels."""
        scale = view.scale / SUPERSAMPLING
        length = next(m for m in (2.0, 5.0, 10.0, 20.0) if m * scale >= 60.0 or m == 20.0)
        wide, left = round(length * view.scale), SUPERSAMPLING * PADDING
        if self._scale is None or self._scale[0] != wide:
            panel = card(wide / SUPERSAMPLING + 2 * PADDING, 34)
            base = SUPERSAMPLING * 24
            pygame.draw.line(panel, INK, (left, base), (left + wide, base), 3)
            for end in (left, left + wide):
                pygame.draw.line(panel, INK, (end, base - 7), (end, base + 7), 3)
            label = self._letters.render(f"{length:g} m", INK, 10)
            panel.blit(label, (left + (wide - label.get_width()) // 2, base - 34))
            self._scale = (wide, panel)
        bottom = SUPERSAMPLING * (SCENE_HEIGHT - MARGIN)
        panel = self._scale[1]
        surface.blit(panel, (SUPERSAMPLING * MARGIN, bottom - panel.get_height()))

    def _row(self, surface: pygame.Surface, top: int, label: str, value: str) -> None:
        left = SUPERSAMPLING * (MARGIN + PADDING)
        surface.blit(self._letters.render(label, FAINT, 11), (left, top))
        room = CARD_WIDTH - 2 * PADDING - LABEL
        text = self._letters.fitted(value, room, INK, 11)
        surface.blit(text, (left + SUPERSAMPLING * LABEL, top))

    def _bar(self, surface: pygame.Surface, top: int, share: float) -> None:
        """A bar at a row's right end, filled by a share."""
        left, width, height = self._right(44), SUPERSAMPLING * 44, SUPERSAMPLING * 5
        top += SUPERSAMPLING * 5
        pygame.draw.rect(surface, GRID, (left, top, width, height), border_radius=height // 2)
        if share > 0.0:
            filled = max(round(width * share), height)
            pygame.draw.rect(surface, TRACE, (left, top, filled, height), border_radius=height // 2)

    def _steps(self, surface: pygame.Surface, top: int, band: int) -> None:
        """Four fields at a row's right end, those up to the band filled."""
        left, wide = self._right(44), SUPERSAMPLING * 44 // len(BANDS)
        top += SUPERSAMPLING * 5
        for k in range(len(BANDS)):
            box = (left + k * wide, top, wide - SUPERSAMPLING * 2, SUPERSAMPLING * 5)
            pygame.draw.rect(surface, TRACE if k <= band else GRID, box)

    @staticmethod
    def _right(width: int) -> int:
        """Left end of what ends at a card's right, pixels of the supersampled frame."""
        return SUPERSAMPLING * (MARGIN + CARD_WIDTH - PADDING - width)


def make_key(letters: Type, shown: Sequence[str]) -> pygame.Surface:
    """A card that says what lines and arrows mean: of "driven", "plan", "tyre forces"."""
    scale = SUPERSAMPLING
    words = [letters.render(word, FAINT, 10) for word in shown]
    widths = [word.get_width() + scale * 26 for word in words]
    key = card((sum(widths) + scale * (8 + 8 * (len(words) - 1))) / scale, 22)
    x, middle = 8 * scale, 11 * scale
    for name, word, width in zip(shown, words, widths, strict=True):
        _glyph(key, name, x, middle)
        key.blit(word, (x + scale * 20, middle - word.get_height() // 2))
        x += width + 8 * scale
    return key


def _glyph(surface: pygame.Surface, name: str, x: int, y: int) -> None:
    scale = SUPERSAMPLING
    if name == "tyre forces":
        arrow(surface, np.array([x, y], dtype=float), np.array([x + 16.0 * scale, y]))
        return
    colour: Colour = PLAN if name == "plan" else TRAIL
    pygame.draw.line(surface, colour, (x, y), (x + 16 * scale, y), scale + scale // 2)
    if name == "plan":
        for k in range(3):
            pygame.draw.circle(surface, colour, (x + 8 * scale * k, y), 2.2 * scale)
