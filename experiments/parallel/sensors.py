"""The simulated vehicle's sensors, each at its own rate, with the noise of some conditions."""

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.parallel.setup import INERTIAL_MS, MS_PER_SECOND, WHEEL_MS
from lpv_track_env import sensors
from lpv_track_env.bicycle import PSI, VX, YAW_RATE, X, Y
from lpv_track_env.conditions import IDEAL, Conditions

Array = NDArray[np.float64]


class Sensors:
    """Readings of a vehicle's true state, with errors as `lpv_track_env.sensors` has them.

    Parameters
    ----------
    conditions
        None: perfect sensors.
    fix_ms
        Time between fixes, ms.
    seed
        Of all draws.
    """

    def __init__(self, conditions: Conditions | None, fix_ms: int, seed: int) -> None:
        self.conditions = conditions or IDEAL
        self._sensors = sensors.Sensors(self.conditions, seed)
        self._latency = self._sensors.drawn["gnss_latency"]
        self._fix_ms = fix_ms
        self._coming: deque[tuple[int, float, float, float]] = deque()
        """Fixes on their way: when they arrive (ms), their stamp (s), x and y (m)."""

    def read(self, ms: int, state: Array, record: Any) -> None:
        """Write into a SAMPLE record what is read at `ms` of the vehicle's clock; NaN: nothing."""
        time = ms / MS_PER_SECOND
        for name in ("heading", "yaw_rate", "speed", "fix_time", "fix_x", "fix_y"):
            record[name] = math.nan
        if ms % INERTIAL_MS == 0:
            record["heading"], record["yaw_rate"] = self._sensors.inertial(
                time, state[PSI], state[YAW_RATE]
            )
        if ms % WHEEL_MS == 0:
            record["speed"] = self._sensors.wheel_speed(state[VX])
        if ms % self._fix_ms == 0:
            self._measure_fix(ms, time, state)
        if self._coming and self._coming[0][0] <= ms:
            _, record["fix_time"], record["fix_x"], record["fix_y"] = self._coming.popleft()

    def _measure_fix(self, ms: int, time: float, state: Array) -> None:
        """A fix of this moment, if there is one, on its way; the first one is there at once."""
        if ms == 0:
            self._coming.append((ms, time, *self._sensors.first_fix(state[X], state[Y])))
            return
        fix = self._sensors.fix(time, state[X], state[Y])
        if fix is not None:
            arrives = ms + math.ceil(MS_PER_SECOND * self._latency - 1e-6)
            self._coming.append((arrives, time, *fix))
