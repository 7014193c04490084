"""Cards on the scene: the task, the agent's notes, the end, the scale and the key."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pygame
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.rendering import canvas
from lpv_track_env.rendering.canvas import SUPERSAMPLING, Colour, Letters, View
from lpv_track_env.rendering.vehicles import AxleForces, arrow
from lpv_track_env.task import Task
from trajectories import CurvatureBands

Array = NDArray[np.float64]

CARD_WIDTH, ROW = 224, 17
"""Pixels of the frame."""
LABEL, NOTE_LABEL = 66, 54
"""Pixels of a row's label on the task's card, and on the card of the agent's notes."""
MOST_NOTES = 9
"""Largest number of rows on the card of notes: more would reach the charts."""
BANDS = CurvatureBands()


class Cards:
    """The cards of an episode's frames; the task's card shows its path and vehicle."""

    def __init__(self, task: Task, letters: Letters) -> None:
        self._task, self._letters = task, letters
        self._curvature = np.abs(task.path.curvature)
        self._blank = canvas.card(CARD_WIDTH, 2 * canvas.PADDING + 5 * ROW + 1)
        self._notes: tuple[Mapping[str, str], pygame.Surface] | None = None
        self._scale: tuple[int, pygame.Surface] | None = None
        self._title = f"{task.path.name} · {task.vehicle.name}"

    def draw_task(self, surface: pygame.Surface, record: Array, forces: AxleForces) -> int:
        """Draw path, vehicle, progress and curvature band; return the lower end of the card."""
        scale, left = SUPERSAMPLING, SUPERSAMPLING * (canvas.MARGIN + canvas.PADDING)
        surface.blit(self._blank, (scale * canvas.MARGIN, scale * canvas.MARGIN))
        top = scale * (canvas.MARGIN + canvas.PADDING - 2)
        room = CARD_WIDTH - 2 * canvas.PADDING
        title = self._letters.fitted(self._title, room, canvas.INK, 12, bold=True)
        surface.blit(title, (left, top))
        top += scale * (ROW + 4)
        time = record[kernels.STEPS] * self._task.control_period
        self._row(surface, top, "time", f"{time:.2f} s")
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
        slips = (forces.front_slip, forces.rear_slip)
        front, rear = (canvas.signed(math.degrees(slip), 1) for slip in slips)
        self._row(surface, top, "slip angles", f"{front}° front, {rear}° rear")
        return canvas.MARGIN + self._blank.get_height() // scale

    def draw_end(self, surface: pygame.Surface, end: int) -> None:
        """Draw how the episode ended, at the top of the scene."""
        if end == kernels.RUNNING:
            return
        colour = canvas.INK if end == kernels.FINISHED else canvas.ALERT
        text = self._letters.render(kernels.END_NAMES[end].replace("_", " "), colour, 16, bold=True)
        banner = canvas.card(text.get_width() / SUPERSAMPLING + 4 * canvas.PADDING, 36)
        place = (SUPERSAMPLING * canvas.WIDTH - banner.get_width()) // 2
        banner.blit(text, text.get_rect(center=banner.get_rect().center))
        surface.blit(banner, (place, SUPERSAMPLING * canvas.MARGIN))

    def draw_notes(self, surface: pygame.Surface, notes: Mapping[str, str], top: int) -> None:
        """Draw the agent's notes below `top`, one row for each."""
        if not notes:
            return
        if self._notes is None or self._notes[0] != notes:
            rows = list(notes.items())[:MOST_NOTES]
            panel = canvas.card(CARD_WIDTH, 2 * canvas.PADDING + ROW * len(rows) - 3)
            for k, (label, value) in enumerate(rows):
                at = SUPERSAMPLING * (canvas.PADDING + ROW * k - 2)
                word = self._letters.fitted(label, NOTE_LABEL - 4, canvas.FAINT, 11)
                panel.blit(word, (SUPERSAMPLING * canvas.PADDING, at))
                room = CARD_WIDTH - 2 * canvas.PADDING - NOTE_LABEL
                panel.blit(
                    self._letters.fitted(value, room, canvas.INK, 11),
                    (SUPERSAMPLING * (canvas.PADDING + NOTE_LABEL), at),
                )
            self._notes = (dict(notes), panel)
        place = (SUPERSAMPLING * canvas.MARGIN, SUPERSAMPLING * (top + canvas.MARGIN // 2))
        surface.blit(self._notes[1], place)

    def draw_scale(self, surface: pygame.Surface, view: View) -> None:
        """Draw a scale: a bar of a round length, 60 to 150 pixels long."""
        scale = view.scale / SUPERSAMPLING
        length = next(m for m in (2.0, 5.0, 10.0, 20.0) if m * scale >= 60.0 or m == 20.0)
        wide, left = round(length * view.scale), SUPERSAMPLING * canvas.PADDING
        if self._scale is None or self._scale[0] != wide:
            panel = canvas.card(wide / SUPERSAMPLING + 2 * canvas.PADDING, 34)
            base = SUPERSAMPLING * 24
            pygame.draw.line(panel, canvas.INK, (left, base), (left + wide, base), 3)
            for end in (left, left + wide):
                pygame.draw.line(panel, canvas.INK, (end, base - 7), (end, base + 7), 3)
            label = self._letters.render(f"{length:g} m", canvas.INK, 10)
            panel.blit(label, (left + (wide - label.get_width()) // 2, base - 34))
            self._scale = (wide, panel)
        bottom = SUPERSAMPLING * (canvas.SCENE_HEIGHT - canvas.MARGIN)
        panel = self._scale[1]
        surface.blit(panel, (SUPERSAMPLING * canvas.MARGIN, bottom - panel.get_height()))

    def _row(self, surface: pygame.Surface, top: int, label: str, value: str) -> None:
        left = SUPERSAMPLING * (canvas.MARGIN + canvas.PADDING)
        surface.blit(self._letters.render(label, canvas.FAINT, 11), (left, top))
        room = CARD_WIDTH - 2 * canvas.PADDING - LABEL
        text = self._letters.fitted(value, room, canvas.INK, 11)
        surface.blit(text, (left + SUPERSAMPLING * LABEL, top))

    def _bar(self, surface: pygame.Surface, top: int, share: float) -> None:
        """Draw a bar at the right end of a row, filled to a share."""
        left, width, height = self._right(44), SUPERSAMPLING * 44, SUPERSAMPLING * 5
        top, radius = top + SUPERSAMPLING * 5, height // 2
        pygame.draw.rect(surface, canvas.GRID, (left, top, width, height), border_radius=radius)
        if share > 0.0:
            filled = max(round(width * share), height)
            box = (left, top, filled, height)
            pygame.draw.rect(surface, canvas.TRACE, box, border_radius=radius)

    def _steps(self, surface: pygame.Surface, top: int, band: int) -> None:
        """Draw one field for each band at the right end of a row, filled up to `band`."""
        left, wide = self._right(44), SUPERSAMPLING * 44 // len(BANDS)
        top += SUPERSAMPLING * 5
        for k in range(len(BANDS)):
            box = (left + k * wide, top, wide - SUPERSAMPLING * 2, SUPERSAMPLING * 5)
            pygame.draw.rect(surface, canvas.TRACE if k <= band else canvas.GRID, box)

    @staticmethod
    def _right(width: int) -> int:
        """Left end of a drawing at a card's right end, pixels of the supersampled frame."""
        return SUPERSAMPLING * (canvas.MARGIN + CARD_WIDTH - canvas.PADDING - width)


def make_legend(letters: Letters, shown: Sequence[str]) -> pygame.Surface:
    """Make a card that explains lines and arrows: "driven", "plan", "tyre forces"."""
    scale = SUPERSAMPLING
    words = [letters.render(word, canvas.FAINT, 10) for word in shown]
    widths = [word.get_width() + scale * 26 for word in words]
    legend = canvas.card((sum(widths) + scale * (8 + 8 * (len(words) - 1))) / scale, 22)
    x, middle = 8 * scale, 11 * scale
    for name, word, width in zip(shown, words, widths, strict=True):
        _glyph(legend, name, x, middle)
        legend.blit(word, (x + scale * 20, middle - word.get_height() // 2))
        x += width + 8 * scale
    return legend


def _glyph(surface: pygame.Surface, name: str, x: int, y: int) -> None:
    scale = SUPERSAMPLING
    if name == "tyre forces":
        arrow(surface, np.array([x, y], dtype=float), np.array([x + 16.0 * scale, y]))
        return
    colour: Colour = canvas.PLAN if name == "plan" else canvas.TRAIL
    pygame.draw.line(surface, colour, (x, y), (x + 16 * scale, y), scale + scale // 2)
    if name == "plan":
        for k in range(3):
            pygame.draw.circle(surface, colour, (x + 8 * scale * k, y), 2.2 * scale)
