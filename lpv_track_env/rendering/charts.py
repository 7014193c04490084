"""Strip charts of an episode's last seconds, below the scene."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pygame
from numpy.typing import NDArray

from lpv_track_env.rendering import history
from lpv_track_env.rendering.style import (
    ALERT,
    DASHBOARD,
    FAINT,
    GRID,
    HEIGHT,
    INK,
    MARGIN,
    PLOT,
    REFERENCE,
    SCENE_HEIGHT,
    SUPERSAMPLING,
    TRACE,
    TRACE_FILL,
    WIDTH,
    Type,
    signed,
)
from lpv_track_env.rendering.view import Colour
from lpv_track_env.task import Task

Array = NDArray[np.float64]
Box = tuple[int, int, int, int]

HEADER, FOOTER = 40, 18
"""Pixels of the frame above a plot, for title and value, and below it."""
GAP = 14
"""Pixels of the frame between charts."""
NICE = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Ends of the axes of what has no range of its own."""


@dataclass(frozen=True)
class Signal:
    """What a chart shows.

    Parameters
    ----------
    title, unit
        Their words.
    column
        Of `History.signals`.
    digits
        Of the value in words.
    factor
        From SI units to `unit`.
    ends
        Half ranges of the axis, the smallest that holds what is shown is taken; None: the fixed
        range.
    fixed
        Range of the axis where `ends` is None.
    limits
        What must not be exceeded, drawn where the axis has it.
    reference
        Column of what the signal should be, if there is one to draw.
    signed
        Whether the value is written with its sign.
    """

    title: str
    unit: str
    column: int
    digits: int
    factor: float = 1.0
    ends: tuple[float, ...] | None = NICE
    fixed: tuple[float, float] = (0.0, 1.0)
    limits: tuple[float, ...] = ()
    reference: int | None = None
    signed: bool = True

    def axis(self, values: Array) -> tuple[float, float]:
        """Ends of the axis for some values, in `unit`."""
        if self.ends is None:
            return self.fixed
        largest = float(np.abs(values).max(initial=0.0))
        end = next((end for end in self.ends if end >= largest), self.ends[-1])
        return -end, end


def signals_of(task: Task) -> list[Signal]:
    """The charts of a task."""
    car = task.vehicle
    top = 1.15 * float(task.path.speed.max())
    low, high = car.acceleration_range
    steering = math.degrees(car.max_steering_angle)
    corridor, degrees = task.max_lateral_error, math.degrees(1.0)
    angles = tuple(end for end in (2.0, 5.0, 10.0, 20.0) if end < steering)
    room = 0.08 * (high - low)
    return [
        Signal("speed", "m/s", history.SPEED, 2, ends=None, fixed=(0.0, top),
               reference=history.REFERENCE_SPEED, signed=False),
        Signal("lateral error", "m", history.LATERAL_ERROR, 3, limits=(-corridor, corridor)),
        Signal("heading error", "deg", history.HEADING_ERROR, 1, degrees,
               ends=(1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0), limits=(-90.0, 90.0)),
        Signal("steering", "deg", history.STEERING, 1, degrees, ends=(*angles, 1.12 * steering),
               limits=(-steering, steering)),
        Signal("acceleration", "m/s²", history.ACCELERATION, 2, ends=None,
               fixed=(low - room, high + room), limits=(low, high)),
    ]  # fmt: skip


class Charts:
    """The strip below the scene: one chart a signal, side by side.

    Parameters
    ----------
    signals
        What is shown.
    letters
        To write with.
    """

    def __init__(self, signals: Sequence[Signal], letters: Type) -> None:
        self._signals, self._letters = signals, letters
        width = (WIDTH - 2 * MARGIN - GAP * (len(signals) - 1)) / len(signals)
        scale = SUPERSAMPLING
        top, bottom = SCENE_HEIGHT + HEADER, HEIGHT - FOOTER
        self._boxes: list[Box] = [
            (
                round(scale * (MARGIN + k * (width + GAP))), scale * top,
                round(scale * width), scale * (bottom - top),
            )
            for k in range(len(signals))
        ]  # fmt: skip
        size = (scale * WIDTH, scale * (HEIGHT - SCENE_HEIGHT))
        self._background = pygame.Surface(size, depth=32)
        self._background.fill(DASHBOARD)
        pygame.draw.rect(self._background, GRID, (0, 0, size[0], scale))
        for signal, (left, top, wide, high) in zip(signals, self._boxes, strict=True):
            inner = top - scale * SCENE_HEIGHT
            pygame.draw.rect(self._background, PLOT, (left, inner, wide, high))
            title = letters.render(signal.title, FAINT, 11)
            self._background.blit(title, (left, scale * 7))
            if signal.reference is not None:
                text = letters.render("reference", REFERENCE, 11)
                self._background.blit(text, (left + wide - text.get_width(), scale * 7))
            ago = letters.render(f"−{history.SECONDS:g} s", FAINT, 9)
            self._background.blit(ago, (left, inner + high + scale * 2))
            now = letters.render("now", FAINT, 9)
            self._background.blit(now, (left + wide - now.get_width(), inner + high + scale * 2))

    def draw(self, surface: pygame.Surface, signals: Array) -> None:
        """Draw `History.signals` on the whole, supersampled frame."""
        surface.blit(self._background, (0, SUPERSAMPLING * SCENE_HEIGHT))
        if len(signals) == 0:
            return
        time = signals[:, history.TIME]
        shown = time >= time[-1] - history.SECONDS - 1e-9
        ago = (time[shown] - time[-1]) / history.SECONDS
        for signal, box in zip(self._signals, self._boxes, strict=True):
            self._draw_one(surface, signal, box, ago, signals[shown])

    def _draw_one(
        self, surface: pygame.Surface, signal: Signal, box: Box, ago: Array, signals: Array
    ) -> None:
        left, top, wide, high = box
        values = signal.factor * signals[:, signal.column]
        low, end = signal.axis(values)
        across = left + wide * (1.0 + ago)

        def heights(numbers: Array | float) -> Array:
            # Far beyond the plot is as good as further still.
            share = np.clip((np.asarray(numbers) - low) / (end - low), -1.0, 2.0)
            found: Array = top + high * (1.0 - share)
            return found

        def level(value: float, colour: Colour, dashed: int = 0) -> None:
            y = round(float(heights(value)))
            step = 2 * dashed or wide
            for x in range(left, left + wide, step):
                right = min(x + (dashed or wide), left + wide) - 1
                pygame.draw.line(surface, colour, (x, y), (right, y), SUPERSAMPLING)

        surface.set_clip(box)
        zero = 0.0 if low < 0.0 < end else low
        line = np.column_stack([across, heights(values)])
        foot = float(heights(zero))
        if len(line) > 1:
            ground = [(float(across[-1]), foot), (float(across[0]), foot)]
            pygame.draw.polygon(surface, TRACE_FILL, line.tolist() + ground)
        level(zero, GRID)
        for limit in signal.limits:
            if low <= limit <= end:
                level(limit, ALERT, dashed=5 * SUPERSAMPLING)
        _trace(surface, TRACE, line, 2 * SUPERSAMPLING)
        if signal.reference is not None:
            wanted = signal.factor * signals[:, signal.reference]
            _trace(surface, REFERENCE, np.column_stack([across, heights(wanted)]), SUPERSAMPLING)
        surface.set_clip(None)
        self._write(surface, signal, box, float(values[-1]), (low, end))

    def _write(
        self, surface: pygame.Surface, signal: Signal, box: Box, value: float,
        axis: tuple[float, float],
    ) -> None:  # fmt: skip
        left, _, wide, _ = box
        scale, letters = SUPERSAMPLING, self._letters
        text = signed(value, signal.digits) if signal.signed else f"{value:.{signal.digits}f}"
        number = letters.render(text, INK, 14, bold=True)
        base = scale * (SCENE_HEIGHT + 20)
        surface.blit(number, (left, base))
        unit = letters.render(signal.unit, FAINT, 11)
        surface.blit(unit, (left + number.get_width() + 3 * scale, base + 3 * scale))
        # The limits where they are seen, else the axis' ends.
        inside = [limit for limit in signal.limits if axis[0] <= limit <= axis[1]]
        low, end = (min(inside), max(inside)) if inside else axis
        words = f"± {end:.3g}" if low == -end else f"{low:.3g} to {end:.3g}"
        span = letters.render(words, ALERT if inside else FAINT, 9)
        surface.blit(span, (left + wide - span.get_width(), base + 5 * scale))


def _trace(surface: pygame.Surface, colour: Colour, points: Array, width: int) -> None:
    """Draw a line through points (n, 2): pygame's own, thinner where steep, ten times as fast."""
    if len(points) > 1:
        pygame.draw.lines(surface, colour, False, points.tolist(), width)
