"""The sensors of a vehicle under conditions, outside of an environment: the same kernels.

For simulations with clocks of their own and for recorded drives.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, STATE_SIZE, VX, YAW_RATE
from lpv_track_env.conditions import DRAWN, Conditions
from lpv_track_env.conditions import layout as conditions_layout
from lpv_track_env.conditions import sensors as conditions_sensors
from lpv_track_env.draws import random_key
from trajectories.compilation import compiled

Array = NDArray[Any]


@compiled
def _draw(m: Array, spec: Array, key: Any) -> None:
    conditions_sensors.draw_conditions(m, spec, key, 0)


@compiled
def _read(m: Array, state: Array, key: Any, draw: int, period: Any) -> None:
    conditions_sensors.read_sensors(m, state, key, 0, draw, period)


@compiled
def _fix(
    m: Array, x: Any, y: Any, spacing: Any, now: Any, key: Any, draw: int
) -> tuple[bool, Any, Any]:
    if now < 0.0:
        first, second = conditions_sensors.sound_fix(m, x, y, key, 0, draw)
        return True, first, second
    return conditions_sensors.measure_fix(m, x, y, spacing, now, key, 0, draw)


class Sensors:
    """GNSS, IMU and wheel speed of one vehicle, with the errors of some conditions.

    Every call is a reading and draws anew; two with the same seed that are called alike read alike.
    Nothing here is late: `drawn["gnss_latency"]` (s) is for the caller to keep.

    Parameters
    ----------
    conditions
        What is a range there is drawn once.
    seed
        Of all draws.
    """

    def __init__(self, conditions: Conditions, seed: int = 0) -> None:
        # Of the spec only the ranges and the fixes' period are read.
        spec = np.zeros(conditions_layout.SPEC)
        spec[: 2 * conditions_layout.COUNT] = conditions.ranges().ravel()
        spec[conditions_layout.GNSS_PERIOD] = conditions.gnss_period
        self._key = random_key(np.random.default_rng(seed))
        self._vehicle, self._state = np.zeros(conditions_layout.TAIL), np.zeros(STATE_SIZE)
        self._calls = 0
        self._inertial_time = self._fix_time = 0.0
        _draw(self._vehicle, spec, self._key)

    @property
    def drawn(self) -> dict[str, float]:
        """What the conditions' ranges were drawn to, by field."""
        return dict(zip(DRAWN, self._vehicle[: len(DRAWN)].tolist(), strict=True))

    def inertial(self, time: float, heading: float, yaw_rate: float) -> tuple[float, float]:
        """Heading (rad) and yaw rate (rad/s) as an IMU reads them at `time` (s)."""
        self._state[PSI], self._state[YAW_RATE] = heading, yaw_rate
        self._read(max(time - self._inertial_time, 0.0))
        self._inertial_time = time
        return float(self._vehicle[conditions_layout.READ_HEADING]), float(
            self._vehicle[conditions_layout.READ_YAW_RATE]
        )

    def wheel_speed(self, speed: float) -> float:
        """Speed (m/s) as the wheels tell it."""
        self._state[VX] = speed
        self._read(0.0)
        return float(self._vehicle[conditions_layout.READ_SPEED])

    def first_fix(self, x: float, y: float) -> tuple[float, float]:
        """A fix (m) before the drive begins: there is one, and it is no outlier."""
        _, measured_x, measured_y = _fix(
            self._vehicle, float(x), float(y), 0.0, -1.0, self._key, self._next()
        )
        return measured_x, measured_y

    def fix(self, time: float, x: float, y: float) -> tuple[float, float] | None:
        """The fix (m) of a position at `time` (s, from 0 on), or None in an outage."""
        there, measured_x, measured_y = _fix(
            self._vehicle, float(x), float(y), max(time - self._fix_time, 0.0), float(time),
            self._key, self._next(),
        )  # fmt: skip
        self._fix_time = time
        return (measured_x, measured_y) if there else None

    def _read(self, period: float) -> None:
        _read(self._vehicle, self._state, self._key, self._next(), float(period))

    def _next(self) -> int:
        self._calls += 1
        return conditions_sensors.PERIOD_DRAW + conditions_sensors.DRAWS * self._calls
