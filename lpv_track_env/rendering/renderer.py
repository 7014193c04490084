"""Compose frames of an episode, as arrays or in a window, with a camera that follows the vehicle.

"rgb_array" draws on a surface in memory and needs no display. "human" opens a `window.Window` and
keeps real time; closing it ends the drawing but not the run.

A frame depends only on the task, the records since `begin`, and the agent's plan and notes: equal
episodes give equal frames. Camera, trail and charts use the episode's own time, so a frame does not
depend on how many steps were drawn before it.
"""

import math
from collections.abc import Mapping

import numpy as np
import pygame
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import VX, VY, YAW_RATE, X, Y
from lpv_track_env.rendering import canvas
from lpv_track_env.rendering.canvas import SUPERSAMPLING, Letters, View
from lpv_track_env.rendering.charts import Charts, History, signals_of
from lpv_track_env.rendering.panels import Cards, make_legend
from lpv_track_env.rendering.track import MAP_SIZE, Scenery, SceneryDrawing, Track
from lpv_track_env.rendering.vehicles import VehicleDrawing, axle_forces, draw_others
from lpv_track_env.rendering.window import Window
from lpv_track_env.task import Task
from trajectories import ReferencePath

Array = NDArray[np.float64]

PLAN_SPACING = 8.0
"""Least distance between the drawn nodes of a plan, pixels of the frame."""
ROADS_WIDER = 1.4
"""Factor on the width of the view where a scenery is drawn."""
KEPT_TRACKS = 8
"""Number of prepared paths kept: a vector environment draws one after the other."""
NEAREST, FURTHEST = 42.0, 110.0
"""Width of the view at standstill, and its largest, m."""
WIDER = 3.2
"""Growth of that width with speed, m per m/s."""
LOOK_AHEAD, SHORTEST_LOOK, LONGEST_LOOK = 1.5, 4.0, 30.0
"""Distance ahead along the path that the camera turns to, in s, and its bounds, m."""
MIDDLE = (470.0, 0.5 * canvas.SCENE_HEIGHT)
"""Middle of the view, between the cards, pixels of the frame."""
ROOM = (130.0, 70.0)
"""Semi-axes of the ellipse about the middle in which the vehicle stays, pixels of the frame."""
TURNING, ZOOMING = 0.45, 0.8
"""Time constants of the two equal lags that smooth direction and width, s."""


class Camera:
    """View that follows the vehicle and looks ahead, smoothed and wider at higher speed."""

    def __init__(self) -> None:
        self._stages: Array | None = None
        self._time = 0.0
        self._wider = 1.0

    def begin(self, wider: float = 1.0) -> None:
        """Begin an episode without smoothing from the last one; `wider` scales the view's width."""
        self._stages, self._wider = None, wider

    def follow(
        self, time: float, vx: float, x: float, y: float, s: float, path: ReferencePath
    ) -> None:
        """Follow the vehicle to its speed (m/s), position and arc length (m) at a time (s)."""
        width = self._wider * float(np.clip(NEAREST + WIDER * abs(vx), NEAREST, FURTHEST))
        look = float(np.clip(LOOK_AHEAD * vx, SHORTEST_LOOK, LONGEST_LOOK))
        ahead = s + look
        ahead = ahead % path.length if path.closed else min(ahead, path.length)
        towards = np.array(
            [np.interp(ahead, path.arc_length, path.x) - x,
             np.interp(ahead, path.arc_length, path.y) - y]
        )  # fmt: skip
        target = np.array([*(towards / max(math.hypot(*towards), look)), width])
        if self._stages is None:
            self._stages = np.tile(target, (2, 1))
        else:
            passed = max(time - self._time, 0.0)
            share = 1.0 - np.exp(-passed / np.array([TURNING, TURNING, ZOOMING]))
            self._stages[0] += share * (target - self._stages[0])
            self._stages[1] += share * (self._stages[0] - self._stages[1])
        self._time = time

    def view(self, x: float, y: float) -> View:
        """Return the view of a vehicle at (x, y), m, for the supersampled scene."""
        assert self._stages is not None
        right, up, width = self._stages[1].tolist()
        scale = SUPERSAMPLING * canvas.WIDTH / width
        shift = SUPERSAMPLING / scale
        centre = (x + shift * ROOM[0] * right, y + shift * ROOM[1] * up)
        middle = (SUPERSAMPLING * MIDDLE[0], SUPERSAMPLING * MIDDLE[1])
        return View(centre, scale, middle)


class Renderer:
    """Draw the records of one environment's episodes.

    Parameters
    ----------
    render_mode
        "rgb_array" or "human".
    fps
        Largest number of frames per second in "human" mode.
    colour
        Quantity that colours the path: "speed" (of the reference) or "curvature".

    Attributes
    ----------
    plan
        An agent's predicted positions, (n, 2) m in the world, or None.
    notes
        An agent's notes, text by label, drawn as rows of a card.
    others
        Other vehicles, (m, 5) [X m, Y m, heading rad, length m, width m], or None.

    """

    def __init__(self, render_mode: str, fps: int, colour: str = "speed") -> None:
        self.render_mode, self.colour = render_mode, colour
        self.plan: NDArray[np.float64] | None = None
        self.notes: Mapping[str, str] = {}
        self.others: NDArray[np.float64] | None = None
        self._window = Window(fps)
        self._letters = Letters()
        self._camera = Camera()
        self._tracks: dict[tuple[int, float], tuple[Task, Track]] = {}
        self._legend: tuple[tuple[str, ...], pygame.Surface] | None = None
        size = (canvas.WIDTH, canvas.HEIGHT)
        self._large = pygame.Surface((size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING), depth=32)
        self._frame = pygame.Surface(size, depth=32)
        # The same pixels as an array: SDL reorders them faster than NumPy.
        self._array = np.zeros((canvas.HEIGHT, canvas.WIDTH, 3), dtype=np.uint8)
        self._array_frame = pygame.image.frombuffer(self._array.data, size, "RGB")

    def begin(self, task: Task, scenery: Scenery | None = None) -> None:
        """Begin an episode: prepare its fixed parts and forget the last one.

        A `scenery` is drawn in place of the corridor.

        Raises
        ------
        ValueError
            If the scenery cannot be drawn.
        """
        self._scenery = None if scenery is None else SceneryDrawing(scenery)
        self._task = task
        self.plan, self.notes, self.others = None, {}, None
        self._history = History(task.control_period)
        # On roads, show more of the other vehicles.
        self._camera.begin(1.0 if scenery is None else ROADS_WIDER)
        self._track = self._track_of(task)
        self._vehicle = VehicleDrawing(task.vehicle)
        self._cards = Cards(task, self._letters)
        self._charts = Charts(signals_of(task), self._letters)

    def follow(self, record: Array) -> None:
        """Take in a control period, drawn or not; repeating the same one changes nothing."""
        if self._history.add(record):
            time = float(record[kernels.STEPS]) * self._task.control_period
            vx, x, y = float(record[VX]), float(record[X]), float(record[Y])
            self._camera.follow(time, vx, x, y, float(record[kernels.ARC_LENGTH]), self._task.path)

    def draw(self, record: Array) -> NDArray[np.uint8] | None:
        """Draw an episode's record (`kernels.RECORD_SIZE`,): a frame (600, 900, 3) uint8.

        None for "human", which shows the frame in the window.
        """
        self.follow(record)
        if self.render_mode == "human" and self._window.dismissed:
            return None
        self._compose(record)
        if self.render_mode == "human":
            self._window.show(self._frame)
            return None
        self._array_frame.blit(self._frame, (0, 0))
        return self._array.copy()

    def close(self) -> None:
        """Close the window, if any; a later `draw` opens it again."""
        self._window.close()

    def _compose(self, record: Array) -> None:
        place = np.array([record[X], record[Y]])
        view = self._camera.view(float(place[0]), float(place[1]))
        surface = self._large
        surface.set_clip((0, 0, canvas.WIDTH * SUPERSAMPLING, canvas.SCENE_HEIGHT * SUPERSAMPLING))
        surface.fill(canvas.BACKGROUND)
        if self._scenery is not None:
            self._scenery.draw(surface, view, SUPERSAMPLING)
        self._track.draw(surface, view, corridor=self._scenery is None)
        if self.others is not None:
            draw_others(surface, view, self.others)
        self._draw_trail(view, place)
        self._vehicle.draw(surface, view, record)
        forces = axle_forces(
            float(record[VX]), float(record[VY]), float(record[YAW_RATE]),
            float(record[kernels.STEERING]), self._task.vehicle,
        )  # fmt: skip
        self._vehicle.draw_forces(surface, view, record, forces)
        self._draw_plan(view)
        lower = self._cards.draw_task(surface, record, forces)
        self._cards.draw_notes(surface, self.notes, lower)
        self._cards.draw_end(surface, int(record[kernels.END]))
        self._cards.draw_scale(surface, view)
        self._draw_map(place)
        self._draw_legend()
        surface.set_clip(None)
        self._charts.draw(surface, self._history.signals())
        pygame.transform.smoothscale(surface, (canvas.WIDTH, canvas.HEIGHT), self._frame)

    def _draw_trail(self, view: View, place: Array) -> None:
        low, high = view.window()
        runs = self._history.trail(low - 2.0, high + 2.0)
        for k, run in enumerate(runs):
            # The last run ends at the vehicle, which is between two stored points.
            points = np.vstack([run, place]) if k == len(runs) - 1 else run
            canvas.polyline(self._large, canvas.TRAIL, view.pixels(points), 1.5 * SUPERSAMPLING)

    def _draw_plan(self, view: View) -> None:
        if self.plan is None:
            return
        plan = np.asarray(self.plan, dtype=np.float64).reshape(-1, 2)
        plan = plan[np.isfinite(plan).all(axis=1)]
        low, high = view.window()
        pixels = view.pixels(plan[((plan > low) & (plan < high)).all(axis=1)])
        canvas.polyline(self._large, canvas.PLAN, pixels, SUPERSAMPLING)
        if len(pixels) == 0:
            return
        # Leave out nodes that would touch each other, from the last one backwards.
        driven = np.hypot(*np.diff(pixels, axis=0).T).sum() if len(pixels) > 1 else 0.0
        apart = max(round(PLAN_SPACING * SUPERSAMPLING * len(pixels) / max(driven, 1.0)), 1)
        for point in pixels[::-1][::apart].tolist():
            pygame.draw.circle(self._large, canvas.PLAN, point, 2.2 * SUPERSAMPLING)

    def _draw_map(self, place: Array) -> None:
        left = SUPERSAMPLING * (canvas.WIDTH - canvas.MARGIN - MAP_SIZE[0])
        top = SUPERSAMPLING * canvas.MARGIN
        self._large.blit(self._track.overview, (left, top))
        x, y = self._track.place(float(place[0]), float(place[1]))
        for colour, radius in (((255, 255, 255), 5.5), (canvas.OUTLINE, 4.0)):
            pygame.draw.circle(self._large, colour, (left + x, top + y), radius * SUPERSAMPLING)

    def _draw_legend(self) -> None:
        shown = ("driven", *(("plan",) if self.plan is not None else ()), "tyre forces")
        if self._legend is None or self._legend[0] != shown:
            self._legend = (shown, make_legend(self._letters, shown))
        legend = self._legend[1]
        right = SUPERSAMPLING * (canvas.WIDTH - canvas.MARGIN)
        bottom = SUPERSAMPLING * (canvas.SCENE_HEIGHT - canvas.MARGIN)
        self._large.blit(legend, (right - legend.get_width(), bottom - legend.get_height()))

    def _track_of(self, task: Task) -> Track:
        """Return a task's prepared path; each is prepared once."""
        key = (id(task.path), task.max_lateral_error)
        if key not in self._tracks:
            if len(self._tracks) >= KEPT_TRACKS:
                self._tracks.clear()
            track = Track(task.path, task.max_lateral_error, self.colour, self._letters)
            # A reference to the task, so that no other path gets the same id.
            self._tracks[key] = (task, track)
        return self._tracks[key][1]
