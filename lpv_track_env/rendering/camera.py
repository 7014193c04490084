"""A camera that looks ahead of the vehicle, and further away the faster it drives."""

import math

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.rendering.style import SCENE_HEIGHT, SUPERSAMPLING, WIDTH
from lpv_track_env.rendering.view import View
from trajectories import ReferencePath

Array = NDArray[np.float64]

NEAREST, FURTHEST = 42.0, 110.0
"""m across the picture, at standstill and at most;"""
WIDER = 3.2
"""s: this much more of it for each m/s."""
LOOK_AHEAD, SHORTEST_LOOK, LONGEST_LOOK = 1.5, 4.0, 30.0
"""s, m, m: how far ahead along the path the camera looks."""
MIDDLE = (470.0, 0.5 * SCENE_HEIGHT)
"""Pixels of the frame: the middle between the cards, about which the camera looks."""
ROOM = (130.0, 70.0)
"""Pixels of the frame: semi-axes of the ellipse about the middle in which the vehicle stays."""
TURNING, ZOOMING = 0.45, 0.8
"""s: time constants of the two equal stages through which direction and width follow."""


class Camera:
    """Follows an episode; eased over the episode's own time, so equal episodes look equal."""

    def __init__(self) -> None:
        self._stages: Array | None = None
        self._time = 0.0
        self._wider = 1.0

    def begin(self, wider: float = 1.0) -> None:
        """Forget the last episode: the next place is looked at without easing.

        `wider` times as much is seen as usual.
        """
        self._stages, self._wider = None, wider

    def follow(
        self, time: float, vx: float, x: float, y: float, s: float, path: ReferencePath
    ) -> None:
        """Take in where the vehicle is at some time (s): speed (m/s), position, arc length (m)."""
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
        """What is seen of a vehicle at (x, y), in the supersampled scene."""
        assert self._stages is not None
        right, up, width = self._stages[1].tolist()
        scale = SUPERSAMPLING * WIDTH / width
        shift = SUPERSAMPLING / scale
        centre = (x + shift * ROOM[0] * right, y + shift * ROOM[1] * up)
        middle = (SUPERSAMPLING * MIDDLE[0], SUPERSAMPLING * MIDDLE[1])
        return View(centre, scale, middle)
