"""Strip charts of an episode's last seconds, below the scene, and the signals that they show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pygame
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import VX, X, Y
from lpv_track_env.rendering import canvas
from lpv_track_env.rendering.canvas import SUPERSAMPLING, Colour, Letters
from lpv_track_env.task import Task

Array = NDArray[np.float64]
Box = tuple[int, int, int, int]

SECONDS = 8.0
"""s shown in the strip charts."""
TRAIL_SPACING = 0.4
"""m between stored points of the driven trail."""
# Columns of `History.signals`.
TIME, SPEED, REFERENCE_SPEED, LATERAL_ERROR, HEADING_ERROR, STEERING, ACCELERATION = range(7)
RECORDED = np.array(
    [
        VX, kernels.REFERENCE_SPEED, kernels.LATERAL_ERROR, kernels.HEADING_ERROR,
        kernels.STEERING, kernels.ACCELERATION,
    ]
)  # fmt: skip
"""Entries of an episode's record in these columns, after the time."""
HEADER, FOOTER = 40, 18
"""Pixels of the frame above a plot, for its title and value, and below it."""
GAP = 14
"""Pixels of the frame between charts."""
NICE = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Half ranges of an axis whose signal has no natural range."""


class History:
    """Driven trail and recent signals of an episode; grows every control period, drawn or not."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._steps = -1.0
        # Twice the rows that are shown: when they are full, the last half moves to the front.
        self._kept = math.ceil(SECONDS / period) + 2
        self._rows, self._count = np.zeros((2 * self._kept, 7)), 0
        self._trail: list[tuple[float, float]] = []

    def add(self, record: Array) -> bool:
        """Add an episode's record; return False if that control period was added before."""
        if record[kernels.STEPS] == self._steps:
            return False
        self._steps = float(record[kernels.STEPS])
        if self._count == len(self._rows):
            self._rows[: self._kept] = self._rows[-self._kept :]
            self._count = self._kept
        row = self._rows[self._count]
        row[TIME] = self._steps * self._period
        row[SPEED:] = record[RECORDED]
        self._count += 1
        place = (float(record[X]), float(record[Y]))
        if not self._trail or math.dist(self._trail[-1], place) >= TRAIL_SPACING:
            self._trail.append(place)
        return True

    def signals(self) -> Array:
        """Signals of the last seconds, (n, 7): time s, speeds m/s, errors m and rad, inputs."""
        return self._rows[max(self._count - self._kept, 0) : self._count]

    def trail(self, low: Array, high: Array) -> list[Array]:
        """Unbroken pieces (n, 2), m, of the driven trail within a box with corners (2,), m."""
        points = np.array(self._trail).reshape(-1, 2)
        inside = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        return [points[run] for run in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1)]


@dataclass(frozen=True)
class Signal:
    """Signal of a chart.

    Parameters
    ----------
    title, unit
        Words above the plot.
    column
        Column of `History.signals`.
    digits
        Decimals of the written value.
    factor
        Factor from SI units to `unit`.
    ends
        Half ranges of the axis: the smallest that holds the signal is used. None for `fixed`.
    fixed
        Range of the axis if `ends` is None.
    limits
        Bounds of the signal, drawn if they are within the axis.
    reference
        Column of the signal's reference, or None.
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
        """Lower and upper end of the axis for values (n,), in `unit`."""
        if self.ends is None:
            return self.fixed
        largest = float(np.abs(values).max(initial=0.0))
        end = next((end for end in self.ends if end >= largest), self.ends[-1])
        return -end, end


def signals_of(task: Task) -> list[Signal]:
    """Return the signals to show for a task."""
    car = task.vehicle
    top = 1.15 * float(task.path.speed.max())
    low, high = car.acceleration_range
    steering = math.degrees(car.max_steering_angle)
    corridor, degrees = task.max_lateral_error, math.degrees(1.0)
    angles = tuple(end for end in (2.0, 5.0, 10.0, 20.0) if end < steering)
    room = 0.08 * (high - low)
    return [
        Signal("speed", "m/s", SPEED, 2, ends=None, fixed=(0.0, top),
               reference=REFERENCE_SPEED, signed=False),
        Signal("lateral error", "m", LATERAL_ERROR, 3, limits=(-corridor, corridor)),
        Signal("heading error", "deg", HEADING_ERROR, 1, degrees,
               ends=(1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0), limits=(-90.0, 90.0)),
        Signal("steering", "deg", STEERING, 1, degrees, ends=(*angles, 1.12 * steering),
               limits=(-steering, steering)),
        Signal("acceleration", "m/s²", ACCELERATION, 2, ends=None,
               fixed=(low - room, high + room), limits=(low, high)),
    ]  # fmt: skip


class Charts:
    """The strip below the scene: one chart for each signal, side by side."""

    def __init__(self, signals: Sequence[Signal], letters: Letters) -> None:
        self._signals, self._letters = signals, letters
        width = (canvas.WIDTH - 2 * canvas.MARGIN - GAP * (len(signals) - 1)) / len(signals)
        scale = SUPERSAMPLING
        top, bottom = canvas.SCENE_HEIGHT + HEADER, canvas.HEIGHT - FOOTER
        self._boxes: list[Box] = [
            (
                round(scale * (canvas.MARGIN + k * (width + GAP))), scale * top,
                round(scale * width), scale * (bottom - top),
            )
            for k in range(len(signals))
        ]  # fmt: skip
        size = (scale * canvas.WIDTH, scale * (canvas.HEIGHT - canvas.SCENE_HEIGHT))
        self._background = pygame.Surface(size, depth=32)
        self._background.fill(canvas.DASHBOARD)
        pygame.draw.rect(self._background, canvas.GRID, (0, 0, size[0], scale))
        for signal, (left, top, wide, high) in zip(signals, self._boxes, strict=True):
            inner = top - scale * canvas.SCENE_HEIGHT
            pygame.draw.rect(self._background, canvas.PLOT, (left, inner, wide, high))
            title = letters.render(signal.title, canvas.FAINT, 11)
            self._background.blit(title, (left, scale * 7))
            if signal.reference is not None:
                text = letters.render("reference", canvas.REFERENCE, 11)
                self._background.blit(text, (left + wide - text.get_width(), scale * 7))
            ago = letters.render(f"−{SECONDS:g} s", canvas.FAINT, 9)
            self._background.blit(ago, (left, inner + high + scale * 2))
            now = letters.render("now", canvas.FAINT, 9)
            self._background.blit(now, (left + wide - now.get_width(), inner + high + scale * 2))

    def draw(self, surface: pygame.Surface, signals: Array) -> None:
        """Draw `History.signals` (n, 7) on the supersampled frame."""
        surface.blit(self._background, (0, SUPERSAMPLING * canvas.SCENE_HEIGHT))
        if len(signals) == 0:
            return
        time = signals[:, TIME]
        shown = time >= time[-1] - SECONDS - 1e-9
        ago = (time[shown] - time[-1]) / SECONDS
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
            # Values far beyond the plot are all drawn at the same place.
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
            pygame.draw.polygon(surface, canvas.TRACE_FILL, line.tolist() + ground)
        level(zero, canvas.GRID)
        for limit in signal.limits:
            if low <= limit <= end:
                level(limit, canvas.ALERT, dashed=5 * SUPERSAMPLING)
        _trace(surface, canvas.TRACE, line, 2 * SUPERSAMPLING)
        if signal.reference is not None:
            wanted = heights(signal.factor * signals[:, signal.reference])
            _trace(surface, canvas.REFERENCE, np.column_stack([across, wanted]), SUPERSAMPLING)
        surface.set_clip(None)
        self._write(surface, signal, box, float(values[-1]), (low, end))

    def _write(
        self, surface: pygame.Surface, signal: Signal, box: Box, value: float,
        axis: tuple[float, float],
    ) -> None:  # fmt: skip
        left, _, wide, _ = box
        scale, letters = SUPERSAMPLING, self._letters
        text = f"{value:.{signal.digits}f}"
        if signal.signed:
            text = canvas.signed(value, signal.digits)
        number = letters.render(text, canvas.INK, 14, bold=True)
        base = scale * (canvas.SCENE_HEIGHT + 20)
        surface.blit(number, (left, base))
        unit = letters.render(signal.unit, canvas.FAINT, 11)
        surface.blit(unit, (left + number.get_width() + 3 * scale, base + 3 * scale))
        # The limits if they are within the axis, else the ends of the axis.
        inside = [limit for limit in signal.limits if axis[0] <= limit <= axis[1]]
        low, end = (min(inside), max(inside)) if inside else axis
        words = f"± {end:.3g}" if low == -end else f"{low:.3g} to {end:.3g}"
        span = letters.render(words, canvas.ALERT if inside else canvas.FAINT, 9)
        surface.blit(span, (left + wide - span.get_width(), base + 5 * scale))


def _trace(surface: pygame.Surface, colour: Colour, points: Array, width: int) -> None:
    """Draw a line through points (n, 2) by pygame: thinner where steep, but ten times as fast."""
    if len(points) > 1:
        pygame.draw.lines(surface, colour, False, points.tolist(), width)
