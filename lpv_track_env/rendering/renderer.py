"""What a frame is made of, and where it goes: an array, or a window.

"rgb_array" draws on a surface in memory and needs no display. "human" opens a window and keeps real
time; closing it (or Escape) ends the drawing, not the run, and Space pauses. On a machine without a
display SDL draws unseen: that is warned of once, and nothing waits for real time. Only where SDL
has no video driver at all is it a RuntimeError, of one line.

A frame depends on nothing but the task, the records seen since `begin` and what the agent showed:
equal episodes give equal frames. Camera, trail and charts go by the episode's own time, so a run of
which every tenth step is drawn shows the same as one that is drawn step by step.
"""

from collections.abc import Mapping

import numpy as np
import pygame
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import VX, VY, YAW_RATE, X, Y
from lpv_track_env.rendering.camera import Camera
from lpv_track_env.rendering.charts import Charts, signals_of
from lpv_track_env.rendering.forces import axle_forces
from lpv_track_env.rendering.history import History
from lpv_track_env.rendering.panels import Cards, make_key
from lpv_track_env.rendering.scenery import Scenery, SceneryDrawing
from lpv_track_env.rendering.style import (
    BACKGROUND,
    HEIGHT,
    MARGIN,
    OUTLINE,
    PLAN,
    SCENE_HEIGHT,
    SUPERSAMPLING,
    TRAIL,
    WIDTH,
    Type,
)
from lpv_track_env.rendering.track import COLOURINGS, MAP_SIZE, Track
from lpv_track_env.rendering.vehicles import VehicleDrawing, draw_others
from lpv_track_env.rendering.view import View, polyline
from lpv_track_env.rendering.window import Window
from lpv_track_env.task import Task
from trajectories.naming import choose

Array = NDArray[np.float64]

PLAN_SPACING = 8.0
"""Pixels of the frame between a plan's drawn nodes at least."""
ROADS_WIDER = 1.4
"""How much more is seen where there is a scenery."""
KEPT_TRACKS = 8
"""Paths that are kept ready: a vector environment draws one after the other."""


class Renderer:
    """Draws the records of one environment's episodes.

    Parameters
    ----------
    render_mode
        "rgb_array" or "human".
    fps
        Frames a second that "human" keeps at most.
    colour
        What the path is coloured by: "speed", the reference's, or "curvature".

    Attributes
    ----------
    plan
        An agent's predicted positions, (n, 2) m in the world, drawn while set; None for none.
    notes
        What an agent tells, words by label, drawn as rows of a card; empty for none.
    others
        Other vehicles, (m, 5) [X m, Y m, heading rad, length m, width m], drawn while set; None for
        none.

    Raises
    ------
    ValueError
        For an unknown colour.
    """

    def __init__(self, render_mode: str, fps: int, colour: str = "speed") -> None:
        self.render_mode = render_mode
        self.colour = choose("colour", colour, tuple(COLOURINGS))
        self.plan: NDArray[np.float64] | None = None
        self.notes: Mapping[str, str] = {}
        self.others: NDArray[np.float64] | None = None
        self._window = Window(fps)
        self._letters = Type()
        self._camera = Camera()
        self._tracks: dict[tuple[int, float], tuple[Task, Track]] = {}
        self._key: tuple[tuple[str, ...], pygame.Surface] | None = None
        self._large = pygame.Surface((WIDTH * SUPERSAMPLING, HEIGHT * SUPERSAMPLING), depth=32)
        self._frame = pygame.Surface((WIDTH, HEIGHT), depth=32)
        # The same pixels as an array: SDL puts them in order faster than NumPy.
        self._array = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        self._array_frame = pygame.image.frombuffer(self._array.data, (WIDTH, HEIGHT), "RGB")

    def begin(self, task: Task, scenery: Scenery | None = None) -> None:
        """Begin an episode: prepare what is fixed in it, forget all that was seen and shown.

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
        self.plan, self.notes, self.others = None, {}, None
        self._history = History(task.control_period)
        # On roads there are others to look out for.
        self._camera.begin(1.0 if scenery is None else ROADS_WIDER)
        self._track = self._track_of(task)
        self._vehicle = VehicleDrawing(task.vehicle)
        self._cards = Cards(task, self._letters)
        self._charts = Charts(signals_of(task), self._letters)

    def follow(self, record: Array) -> None:
        """Note what a control period brought, drawn or not; the same one again changes nothing."""
        if self._history.add(record):
            time = float(record[kernels.STEPS]) * self._task.control_period
            vx, x, y = float(record[VX]), float(record[X]), float(record[Y])
            self._camera.follow(time, vx, x, y, float(record[kernels.ARC_LENGTH]), self._task.path)

    def draw(self, record: Array) -> NDArray[np.uint8] | None:
        """Draw an episode's record, (`kernels.RECORD_SIZE`,).

        Returns
        -------
        NDArray | None
            The frame, (600, 900, 3) uint8, for "rgb_array"; None for "human".
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
        surface.set_clip((0, 0, WIDTH * SUPERSAMPLING, SCENE_HEIGHT * SUPERSAMPLING))
        surface.fill(BACKGROUND)
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
        self._draw_key()
        surface.set_clip(None)
        self._charts.draw(surface, self._history.signals())
        pygame.transform.smoothscale(surface, (WIDTH, HEIGHT), self._frame)

    def _draw_trail(self, view: View, place: Array) -> None:
        low, high = view.window()
        runs = self._history.trail(low - 2.0, high + 2.0)
        for k, run in enumerate(runs):
            # The last stay reaches up to the vehicle, which is between two kept points.
            points = np.vstack([run, place]) if k == len(runs) - 1 else run
            polyline(self._large, TRAIL, view.pixels(points), 1.5 * SUPERSAMPLING)

    def _draw_plan(self, view: View) -> None:
        if self.plan is None:
            return
        plan = np.asarray(self.plan, dtype=np.float64).reshape(-1, 2)
        plan = plan[np.isfinite(plan).all(axis=1)]
        low, high = view.window()
        pixels = view.pixels(plan[((plan > low) & (plan < high)).all(axis=1)])
        polyline(self._large, PLAN, pixels, SUPERSAMPLING)
        if len(pixels) == 0:
            return
        # Nodes that would touch each other are thinned out, from the last one backwards.
        driven = np.hypot(*np.diff(pixels, axis=0).T).sum() if len(pixels) > 1 else 0.0
        apart = max(round(PLAN_SPACING * SUPERSAMPLING * len(pixels) / max(driven, 1.0)), 1)
        for point in pixels[::-1][::apart].tolist():
            pygame.draw.circle(self._large, PLAN, point, 2.2 * SUPERSAMPLING)

    def _draw_map(self, place: Array) -> None:
        left, top = SUPERSAMPLING * (WIDTH - MARGIN - MAP_SIZE[0]), SUPERSAMPLING * MARGIN
        self._large.blit(self._track.overview, (left, top))
        x, y = self._track.place(float(place[0]), float(place[1]))
        for colour, radius in (((255, 255, 255), 5.5), (OUTLINE, 4.0)):
            pygame.draw.circle(self._large, colour, (left + x, top + y), radius * SUPERSAMPLING)

    def _draw_key(self) -> None:
        shown = ("driven", *(("plan",) if self.plan is not None else ()), "tyre forces")
        if self._key is None or self._key[0] != shown:
            self._key = (shown, make_key(self._letters, shown))
        key = self._key[1]
        right, bottom = SUPERSAMPLING * (WIDTH - MARGIN), SUPERSAMPLING * (SCENE_HEIGHT - MARGIN)
        self._large.blit(key, (right - key.get_width(), bottom - key.get_height()))

    def _track_of(self, task: Task) -> Track:
        """The path ready to be drawn: made once for each."""
        key = (id(task.path), task.max_lateral_error)
        if key not in self._tracks:
            if len(self._tracks) >= KEPT_TRACKS:
                self._tracks.clear()
            track = Track(task.path, task.max_lateral_error, self.colour, self._letters)
            # With its task, so that no other path comes to have the same id.
            self._tracks[key] = (task, track)
        return self._tracks[key][1]
