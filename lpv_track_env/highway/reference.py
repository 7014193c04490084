"""A path's table whose speeds make way for the traffic, as the kernels read it."""

import math
from collections.abc import Sequence

import numpy as np
from highway_env.vehicle.objects import RoadObject
from numpy.typing import NDArray

from lpv_track_env.highway.cruise import CruiseControl, Leader, lower_speed
from lpv_track_env.highway.traffic import leaders
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Array = NDArray[np.float64]

NOBODY = Leader(math.inf, math.nan)
STEP = 0.05
"""s between the points of a cruise control's profile."""
BEYOND = 1.0
"""s that a profile reaches further than an agent's preview."""


class TrafficReference:
    """Reference of one vehicle among others.

    Parameters
    ----------
    path
        What is followed where nobody is in the way.
    vehicle
        Whose body counts for gaps.
    layout
        Of the observation, whose preview a profile must reach beyond.
    cruise
        Settings of the gap, or None: the path's own speed, whoever is ahead.

    Attributes
    ----------
    table
        (n, 8), the path's with its speeds and times as they are now; changed in place.
    leader
        Who is ahead: gap (inf if nobody is) and speed (nan).
    """

    def __init__(
        self,
        path: ReferencePath,
        vehicle: VehicleParameters,
        layout: ObservationLayout,
        cruise: CruiseControl | None,
    ) -> None:
        self.path, self.cruise = path, cruise
        self.table: Array = path.table.copy()
        self.leader = NOBODY
        middle = 0.5 * (vehicle.front_axle_distance - vehicle.rear_axle_distance)
        self._front, self._half_width = middle + 0.5 * vehicle.length, 0.5 * vehicle.width
        self._steps = math.ceil((layout.preview_steps * layout.preview_period + BEYOND) / STEP)
        self._watch = cruise or CruiseControl()
        self._lowered = False

    def look(self, arc_length: float, speed: float, others: Sequence[RoadObject]) -> None:
        """Find who is ahead of a vehicle, and lower the speeds to keep the gap.

        Parameters
        ----------
        arc_length, speed
            The vehicle's, m and m/s.
        others
            What else is on the road.
        """
        ahead = leaders(self.path, arc_length, self._front, self._half_width, others, self._watch)
        self.leader = min(ahead, default=NOBODY)
        if self.cruise is None:
            return
        if ahead:
            profile = self.cruise.profile(arc_length, speed, ahead, STEP, self._steps)
            lower_speed(self.path, self.table, *profile)
        elif self._lowered:
            self.table[:] = self.path.table
        self._lowered = bool(ahead)
