"""Drawing of path tracking with pygame: frames as arrays, or a window.

"rgb_array" draws on a surface in memory and needs no display. "human" opens a window and keeps real
time; closing it (or Escape) ends the drawing, not the run. On a machine without a display SDL draws
unseen: that is warned of once, and nothing waits for real time. Only where SDL has no video driver
at all is it a RuntimeError, of one line.

A frame depends on nothing but the task, the memories drawn since `begin`
and the plan: equal episodes give equal frames.
"""

import math
import os
import warnings
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import PSI, VX, X, Y
from lpv_track_env.rendering.scenery import Scenery, SceneryDrawing
from lpv_track_env.rendering.vehicles import draw_others
from lpv_track_env.rendering.view import View
from lpv_track_env.task import Task
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
import pygame  # the line above silences its greeting

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

WIDTH, HEIGHT = 900, 600
UNSEEN_DRIVERS = ("offscreen", "dummy")
"""SDL's video drivers without a window."""
VIEW_WIDTH = 60.0
"""m across the frame."""
SUPERSAMPLING = 2
"""The scene is drawn this much larger and smoothed down: antialiasing for every shape alike."""
TRAIL_SPACING = 0.25
"""m between kept points of the driven trail."""

BACKGROUND, CORRIDOR, INK, FAINT = (248, 248, 246), (234, 235, 236), (38, 42, 48), (130, 136, 144)
PANEL, BODY, GLASS, TYRE = (255, 255, 255, 225), (222, 226, 232), (150, 164, 180), (38, 42, 48)
TRAIL, PLAN, ALERT = (208, 72, 60), (170, 60, 200), (190, 40, 30)
# Slow to fast: samples of matplotlib's "viridis", its yellow end left out as too pale on white.
SPEED_COLOURS = np.array(
    [(68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81)], dtype=np.float64
)

MARGIN, PADDING, LINE_HEIGHT = 12, 10, 19
TEXT_WIDTH = 236
MAP_SIZE = (190, 150)
WHEEL_LENGTH, WHEEL_WIDTH = 0.7, 0.26  # m


class Renderer:
    """Draws the memories of one environment's episodes.

    Parameters
    ----------
    render_mode
        "rgb_array" or "human".
    fps
        Frames a second that "human" keeps at most.

    Attributes
    ----------
    plan
        An agent's predicted positions, (n, 2) m in the world, drawn while set; None for none.
    others
        Other vehicles, (m, 5) [X m, Y m, heading rad, length m, width m], drawn while set; None for
        none.
    """

    def __init__(self, render_mode: str, fps: int) -> None:
        self.render_mode = render_mode
        self.fps = fps
        self.plan: NDArray[np.float64] | None = None
        self.others: NDArray[np.float64] | None = None
        self._window: pygame.Surface | None = None
        self._clock: pygame.time.Clock | None = None
        self._dismissed = False
        pygame.font.init()
        self._font = pygame.font.Font(None, 20)
        self._small = pygame.font.Font(None, 17)
        self._texts: dict[tuple[str, Colour, bool], pygame.Surface] = {}
        size = (WIDTH * SUPERSAMPLING, HEIGHT * SUPERSAMPLING)
        self._scene = pygame.Surface(size, depth=32)
        self._frame = pygame.Surface((WIDTH, HEIGHT), depth=32)

    def begin(self, task: Task, scenery: Scenery | None = None) -> None:
        """Begin an episode: prepare what is fixed in it, forget trail, plan and other vehicles.

        Parameters
        ----------
        task
            What is driven.
        scenery
            Roads to draw in place of the corridor.

        Raises
        ------
        ValueError
            For a scenery that cannot be drawn.
        """
        self._scenery = None if scenery is None else SceneryDrawing(scenery)
        self._task = task
        self.plan = None
        self.others = None
        self._trail: list[tuple[float, float]] = []
        path = task.path
        # Every second node, the end kept: half a metre is 7 pixels.
        nodes = np.unique(np.append(np.arange(0, len(path.x), 2), len(path.x) - 1))
        self._line = np.column_stack([path.x, path.y])[nodes]
        normal = np.column_stack([-np.sin(path.heading), np.cos(path.heading)])[nodes]
        half_width = min(task.max_lateral_error, 50.0)
        self._left, self._right = (self._line + side * half_width * normal for side in (1.0, -1.0))
        self._reach = half_width
        self._colours = _speed_colours(path.speed[nodes])
        self._map, self._map_view = self._overview(path)
        self._legend = self._speed_legend(path)

    def draw(self, memory: Array) -> NDArray[np.uint8] | None:
        """Draw an episode's memory, (`kernels.MEMORY_SIZE`,).

        Returns
        -------
        NDArray | None
            The frame, (600, 900, 3) uint8, for "rgb_array"; None for "human".
        """
        if self.render_mode == "human" and self._dismissed:
            return None
        self._compose(memory)
        if self.render_mode == "human":
            self._show()
            return None
        pixels = np.frombuffer(pygame.image.tobytes(self._frame, "RGB"), dtype=np.uint8)
        return pixels.reshape(HEIGHT, WIDTH, 3).copy()

    def close(self) -> None:
        """Close the window, if any; a later `draw` opens it again."""
        if self._window is not None:
            pygame.display.quit()
        self._window = None
        self._clock = None

    def _show(self) -> None:
        if self._window is None:
            try:
                pygame.display.init()
                self._window = pygame.display.set_mode((WIDTH, HEIGHT))
            except pygame.error as error:
                raise RuntimeError(
                    f"render_mode='human' needs a display ({error}): use render_mode='rgb_array'"
                ) from None
            pygame.display.set_caption("lpv-track-env")
            if pygame.display.get_driver() not in UNSEEN_DRIVERS:
                self._clock = pygame.time.Clock()
            elif "SDL_VIDEODRIVER" not in os.environ:
                warnings.warn(
                    "no display found: render_mode='human' draws unseen, "
                    "render_mode='rgb_array' gives the frames",
                    UserWarning,
                    stacklevel=4,
                )
        for event in pygame.event.get():
            escape = event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE
            if event.type == pygame.QUIT or escape:
                self._dismissed = True
                self.close()
                return
        self._window.blit(self._frame, (0, 0))
        pygame.display.flip()
        if self._clock is not None:
            self._clock.tick(self.fps)

    def follow(self, memory: Array) -> None:
        """Note where the vehicle is for the trail, drawn or not in this step."""
        x, y = float(memory[X]), float(memory[Y])
        if not self._trail or math.dist(self._trail[-1], (x, y)) >= TRAIL_SPACING:
            self._trail.append((x, y))

    def _compose(self, memory: Array) -> None:
        x, y = float(memory[X]), float(memory[Y])
        self.follow(memory)
        scale = SUPERSAMPLING * WIDTH / VIEW_WIDTH
        view = View((x, y), scale, (0.5 * self._scene.get_width(), 0.5 * self._scene.get_height()))
        self._scene.fill(BACKGROUND)
        if self._scenery is not None:
            self._scenery.draw(self._scene, view, SUPERSAMPLING)
        self._draw_path(view)
        if self.others is not None:
            draw_others(self._scene, view, self.others)
        trail = np.array([*self._trail, (x, y)])
        near = np.abs(trail - (x, y)).max(axis=1) < VIEW_WIDTH
        # A trail may leave the view and return: each stay is its own line.
        for run in _runs(near):
            if len(run) > 1:
                _polyline(self._scene, TRAIL, view.pixels(trail[run]), 2 * SUPERSAMPLING)
        self._draw_vehicle(view, memory)
        self._draw_plan(view)
        pygame.transform.smoothscale(self._scene, (WIDTH, HEIGHT), self._frame)
        self._draw_scale_bar()
        self._frame.blit(self._legend, (WIDTH - MARGIN - self._legend.get_width(), HEIGHT - 52))
        self._draw_map(x, y)
        self._draw_text(memory)

    def _draw_path(self, view: View) -> None:
        reach = 0.5 * math.hypot(VIEW_WIDTH, VIEW_WIDTH * HEIGHT / WIDTH) + self._reach + 2.0
        near = np.hypot(*(self._line - np.array(view.centre)).T) < reach
        cells = np.flatnonzero(near[1:] & near[:-1])
        left, right = view.pixels(self._left), view.pixels(self._right)
        for k in cells if self._scenery is None else ():
            quad = (left[k], left[k + 1], right[k + 1], right[k])
            pygame.draw.polygon(self._scene, CORRIDOR, quad)
        centre, width = view.pixels(self._line), 3 * SUPERSAMPLING
        for k in cells:
            _stroke(self._scene, self._colours[k], centre[k], centre[k + 1], width)

    def _draw_vehicle(self, view: View, memory: Array) -> None:
        car = self._task.vehicle
        x, y, psi = float(memory[X]), float(memory[Y]), float(memory[PSI])
        steering = float(memory[kernels.STEERING])

        def shape(points: Array) -> Array:
            """Pixels of points in the body's frame: x forwards, y left, from the gravity centre."""
            return view.pixels(_turned(points, psi) + np.array([x, y]))

        body, windscreen = _outline(car)
        pygame.draw.polygon(self._scene, BODY, shape(body))
        pygame.draw.polygon(self._scene, GLASS, shape(windscreen))
        half_track = 0.5 * car.width - 0.6 * WHEEL_WIDTH
        for axle, angle in ((car.front_axle_distance, steering), (-car.rear_axle_distance, 0.0)):
            for side in (half_track, -half_track):
                wheel = _turned(_rectangle(WHEEL_LENGTH, WHEEL_WIDTH), angle)
                pygame.draw.polygon(self._scene, TYRE, shape(wheel + np.array([axle, side])))
        _polyline(self._scene, INK, shape(np.vstack([body, body[:1]])), 1.5 * SUPERSAMPLING)
        centre = shape(np.zeros((1, 2)))[0]
        pygame.draw.circle(self._scene, INK, centre, 2 * SUPERSAMPLING)

    def _draw_plan(self, view: View) -> None:
        if self.plan is None:
            return
        plan = np.asarray(self.plan, dtype=np.float64).reshape(-1, 2)
        plan = plan[np.isfinite(plan).all(axis=1)]
        pixels = view.pixels(plan[np.abs(plan - view.centre).max(axis=1) < 2.0 * VIEW_WIDTH])
        _polyline(self._scene, PLAN, pixels, SUPERSAMPLING)
        for point in pixels:
            pygame.draw.circle(self._scene, PLAN, point, 2.5 * SUPERSAMPLING)

    def _draw_scale_bar(self) -> None:
        length, left, base = 10.0, MARGIN + 4, HEIGHT - MARGIN - 6
        right = left + round(length * WIDTH / VIEW_WIDTH)
        pygame.draw.line(self._frame, INK, (left, base), (right, base), 2)
        for end in (left, right):
            pygame.draw.line(self._frame, INK, (end, base - 4), (end, base + 4), 2)
        label = self._text(f"{length:g} m", INK, small=True)
        self._frame.blit(label, ((left + right - label.get_width()) // 2, base - 17))

    def _draw_map(self, x: float, y: float) -> None:
        corner = (WIDTH - MARGIN - MAP_SIZE[0], MARGIN)
        self._frame.blit(self._map, corner)
        spot = self._map_view.pixels(np.array([[x, y]]))[0].clip(4, np.array(MAP_SIZE) - 4)
        place = spot + corner
        pygame.draw.aacircle(self._frame, (255, 255, 255), place, 5)
        pygame.draw.aacircle(self._frame, TRAIL, place, 3.5)

    def _draw_text(self, memory: Array) -> None:
        car, period = self._task.vehicle, self._task.control_period
        end = int(memory[kernels.END])
        rows = [
            ("speed", f"{memory[VX]:.2f}", "m/s"),
            ("reference", f"{memory[kernels.REFERENCE_SPEED]:.2f}", "m/s"),
            ("lateral error", _signed(100.0 * memory[kernels.LATERAL_ERROR], 1), "cm"),
            ("heading error", _signed(math.degrees(memory[kernels.HEADING_ERROR]), 2), "deg"),
            ("steering", _signed(math.degrees(memory[kernels.STEERING]), 2), "deg"),
            ("acceleration", _signed(memory[kernels.ACCELERATION], 2), "m/s²"),
            ("time", f"{memory[kernels.STEPS] * period:.2f}", "s"),
        ]
        height = 2 * PADDING + LINE_HEIGHT * (len(rows) + 1) + (LINE_HEIGHT if end else 0)
        panel = pygame.Surface((TEXT_WIDTH, height), pygame.SRCALPHA, 32)
        panel.fill(PANEL)
        self._frame.blit(panel, (MARGIN, MARGIN))
        left, top, right = MARGIN + PADDING, MARGIN + PADDING, MARGIN + TEXT_WIDTH - PADDING
        self._frame.blit(self._text(f"{self._task.path.name}, {car.name}", INK), (left, top))
        for label, value, unit in rows:
            top += LINE_HEIGHT
            self._frame.blit(self._text(label, FAINT), (left, top))
            number = self._text(value, INK)
            self._frame.blit(number, (right - 40 - number.get_width(), top))
            self._frame.blit(self._text(unit, FAINT), (right - 34, top))
        if end:
            colour = INK if end == kernels.FINISHED else ALERT
            message = self._text(kernels.END_NAMES[end].replace("_", " "), colour)
            self._frame.blit(message, (left, top + LINE_HEIGHT))

    def _text(self, text: str, colour: Colour, *, small: bool = False) -> pygame.Surface:
        key = (text, colour, small)
        if key not in self._texts:
            if len(self._texts) > 2000:
                self._texts.clear()
            font = self._small if small else self._font
            self._texts[key] = font.render(text, True, colour)
        return self._texts[key]

    def _overview(self, path: ReferencePath) -> tuple[pygame.Surface, View]:
        """Map of the whole path, north up, and its view."""
        low, high = self._line.min(axis=0), self._line.max(axis=0)
        room = np.array(MAP_SIZE) - 2.0 * PADDING
        scale = float((room / np.maximum(high - low, 1.0)).min())
        centre = 0.5 * (low + high)
        view = View(
            (float(centre[0]), float(centre[1])), scale, (0.5 * MAP_SIZE[0], 0.5 * MAP_SIZE[1])
        )
        big = (MAP_SIZE[0] * SUPERSAMPLING, MAP_SIZE[1] * SUPERSAMPLING)
        surface = pygame.Surface(big, pygame.SRCALPHA, 32)
        surface.fill(PANEL)
        points = view.pixels(self._line) * SUPERSAMPLING
        for k in range(len(points) - 1):
            _stroke(surface, self._colours[k], points[k], points[k + 1], 2 * SUPERSAMPLING)
        if not path.closed:
            for point in (points[0], points[-1]):
                pygame.draw.circle(surface, INK, point, 2 * SUPERSAMPLING)
        return pygame.transform.smoothscale(surface, MAP_SIZE), view

    def _speed_legend(self, path: ReferencePath) -> pygame.Surface:
        """Bar of the path's colours with its least and greatest reference speed."""
        width, low, high = MAP_SIZE[0], float(path.speed.min()), float(path.speed.max())
        surface = pygame.Surface((width, 40), pygame.SRCALPHA, 32)
        surface.fill(PANEL)
        left, right = PADDING, width - PADDING
        for k, colour in enumerate(_speed_colours(np.linspace(low, high, right - left))):
            pygame.draw.line(surface, colour, (left + k, 26), (left + k, 31))
        title = self._text("reference speed, m/s", FAINT, small=True)
        surface.blit(title, ((width - title.get_width()) // 2, 6))
        surface.blit(self._text(f"{low:.1f}", INK, small=True), (left, 6))
        number = self._text(f"{high:.1f}", INK, small=True)
        surface.blit(number, (right - number.get_width(), 6))
        return surface


def _speed_colours(speed: Array) -> list[Colour]:
    """Colour of each speed, slow to fast; one colour where the speed is constant."""
    low, high = float(speed.min()), float(speed.max())
    share = (speed - low) / (high - low) if high - low > 1e-6 else np.full(len(speed), 0.5)
    at = np.linspace(0.0, 1.0, len(SPEED_COLOURS))
    channels = np.array([np.interp(share, at, channel) for channel in SPEED_COLOURS.T])
    return [(int(r), int(g), int(b)) for r, g, b in channels.T]


def _signed(value: float, digits: int) -> str:
    """Write a number with its sign; a rounded zero is never negative."""
    return f"{round(float(value), digits) + 0.0:+.{digits}f}"


def _runs(mask: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Split the indices of a mask's true entries into unbroken runs."""
    indices = np.flatnonzero(mask)
    return np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)


def _turned(points: Array, angle: float) -> Array:
    """Points (n, 2) turned counter-clockwise about the origin."""
    c, s = math.cos(angle), math.sin(angle)
    turned: Array = points @ np.array([[c, s], [-s, c]])
    return turned


def _rectangle(length: float, width: float) -> Array:
    """Corners (4, 2) about the origin, length along x."""
    return np.array([(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)]) * (length, width)


def _outline(car: VehicleParameters) -> tuple[Array, Array]:
    """Body with its front corners cut, (6, 2), and windscreen, (4, 2), from the gravity centre."""
    middle = 0.5 * (car.front_axle_distance - car.rear_axle_distance)
    half, side = 0.5 * car.length, 0.5 * car.width
    body = [(half - 0.4, side), (half, side - 0.35), (half, 0.35 - side), (half - 0.4, -side)]
    body += [(-half, -side), (-half, side)]
    glass = [(half - 0.7, side - 0.45), (half - 0.7, 0.45 - side)]
    glass += [(half - 1.3, 0.25 - side), (half - 1.3, side - 0.25)]
    centre = np.array([middle, 0.0])
    return np.array(body) + centre, np.array(glass) + centre


def _stroke(surface: pygame.Surface, colour: Colour, a: Array, b: Array, width: float) -> None:
    """Draw a thick line with round ends: pygame's own are cut along the axes."""
    direction = b - a
    distance = math.hypot(*direction)
    if distance > 0.0:
        across = np.array([-direction[1], direction[0]]) * (0.5 * width / distance)
        pygame.draw.polygon(surface, colour, (a + across, b + across, b - across, a - across))
    pygame.draw.circle(surface, colour, b, 0.5 * width)


def _polyline(surface: pygame.Surface, colour: Colour, points: Array, width: float) -> None:
    """Draw a thick line through points (n, 2)."""
    for a, b in pairwise(points):
        _stroke(surface, colour, a, b, width)
