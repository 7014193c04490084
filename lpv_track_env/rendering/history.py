"""What an episode has shown so far: the driven trail, and the last seconds of its signals."""

import math

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import VX, X, Y

Array = NDArray[np.float64]

SECONDS = 8.0
"""s that the strip charts hold."""
TRAIL_SPACING = 0.4
"""m between kept points of the driven trail."""
TIME, SPEED, REFERENCE_SPEED, LATERAL_ERROR, HEADING_ERROR, STEERING, ACCELERATION = range(7)
"""Columns of `signals`;"""
SHOWN = np.array(
    [
        VX, kernels.REFERENCE_SPEED, kernels.LATERAL_ERROR, kernels.HEADING_ERROR,
        kernels.STEERING, kernels.ACCELERATION,
    ]
)  # fmt: skip
"""the record's entries that they hold after the time."""


class History:
    """Grows with every control period of an episode, drawn or not."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._steps = -1.0
        # Twice what is shown: the last half moves to the front when the end is reached.
        self._kept = math.ceil(SECONDS / period) + 2
        self._rows, self._count = np.zeros((2 * self._kept, 7)), 0
        self._trail: list[tuple[float, float]] = []

    def add(self, record: Array) -> bool:
        """Take in an episode's record; False if that control period is known already."""
        if record[kernels.STEPS] == self._steps:
            return False
        self._steps = float(record[kernels.STEPS])
        if self._count == len(self._rows):
            self._rows[: self._kept] = self._rows[-self._kept :]
            self._count = self._kept
        row = self._rows[self._count]
        row[TIME] = self._steps * self._period
        row[SPEED:] = record[SHOWN]
        self._count += 1
        place = (float(record[X]), float(record[Y]))
        if not self._trail or math.dist(self._trail[-1], place) >= TRAIL_SPACING:
            self._trail.append(place)
        return True

    def signals(self) -> Array:
        """The last seconds, (n, 7): time s, then speeds m/s, errors m and rad, inputs."""
        return self._rows[max(self._count - self._kept, 0) : self._count]

    def trail(self, low: Array, high: Array) -> list[Array]:
        """Unbroken stays of the driven trail within a box, corners (2,) m: each (n, 2) m."""
        points = np.array(self._trail).reshape(-1, 2)
        inside = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        return [points[run] for run in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1)]
