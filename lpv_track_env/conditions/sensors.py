"""Sensors of a vehicle under conditions, and the estimate that is made of their readings.

The environments call the compiled kernels. `Sensors` makes them usable alone, for simulations with
clocks of their own and for recorded drives.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, STATE_SIZE, VX, VY, YAW_RATE, X, Y
from lpv_track_env.conditions import DRAWN, Conditions, layout
from lpv_track_env.draws import gaussian, random_key, uniform
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.kernels import ACCELERATION, STEERING, clip
from trajectories.compilation import compiled, compiled_in_place, compiled_internal

Array = NDArray[Any]

# Numbers of an episode's draws, beside those of `episodes`.
CONDITIONS_DRAW, DIRECTION_DRAW, FIRST_WANDER_DRAW, FIRST_GUST_DRAW, PHASE_DRAW = 16, 80, 82, 84, 86
PERIOD_DRAW = 128
"""First draw of the control periods; each period has `DRAWS` of its own."""
DRAWS = 64
READINGS_DRAW, FIX_DRAW, WANDER_DRAW, OUTAGE_DRAW, OUTLIER_DRAW, DRIFT_DRAW = 0, 4, 6, 8, 10, 12
"""Draws within a control period."""


@compiled_in_place
def draw_conditions(m: Array, spec: Array, key: Any, episode: Any) -> None:
    """Draw an episode's conditions, and the wander, gust and fix phase at its beginning."""
    for j in range(layout.COUNT):
        low, high = spec[2 * j], spec[2 * j + 1]
        m[j] = low
        if high > low:
            m[j] += (high - low) * uniform(key, episode, CONDITIONS_DRAW + j)
    direction = 2.0 * math.pi * uniform(key, episode, DIRECTION_DRAW)
    m[layout.WIND_X], m[layout.WIND_Y] = math.cos(direction), math.sin(direction)
    first, second = gaussian(key, episode, FIRST_WANDER_DRAW)
    m[layout.WANDER_X], m[layout.WANDER_Y] = (
        m[layout.GNSS_WANDER] * first,
        m[layout.GNSS_WANDER] * second,
    )
    first, second = gaussian(key, episode, FIRST_GUST_DRAW)
    m[layout.GUST] = m[layout.GUST_SPEED] * first
    # The receiver has been running before: the first fix falls anywhere within its period.
    m[layout.NEXT_FIX] = spec[layout.GNSS_PERIOD] * uniform(key, episode, PHASE_DRAW)


@compiled_internal
def read_sensors(m: Array, record: Array, key: Any, episode: Any, draw: int, period: Any) -> None:
    """Read wheel speed, yaw rate and heading of the true state."""
    first, second = gaussian(key, episode, draw + READINGS_DRAW)
    third, _ = gaussian(key, episode, draw + READINGS_DRAW + 2)
    walk, _ = gaussian(key, episode, draw + DRIFT_DRAW)
    m[layout.DRIFT] += m[layout.YAW_RATE_DRIFT] * math.sqrt(period) * walk
    m[layout.READ_SPEED] = (
        record[VX] * (1.0 + m[layout.SPEED_SCALE]) + m[layout.SPEED_NOISE] * first
    )
    m[layout.READ_YAW_RATE] = (
        record[YAW_RATE]
        + m[layout.YAW_RATE_BIAS]
        + m[layout.DRIFT]
        + m[layout.YAW_RATE_NOISE] * second
    )
    m[layout.READ_HEADING] = record[PSI] + m[layout.HEADING_BIAS] + m[layout.HEADING_NOISE] * third


@compiled_internal
def fix_without_outlier(
    m: Array, x: Any, y: Any, key: Any, episode: Any, draw: int
) -> tuple[Any, Any]:
    """Return a fix of a position with noise and wander, no outlier."""
    first, second = gaussian(key, episode, draw + FIX_DRAW)
    return (
        x + (m[layout.WANDER_X] + m[layout.GNSS_NOISE] * first),
        y + (m[layout.WANDER_Y] + m[layout.GNSS_NOISE] * second),
    )


@compiled_internal
def measure_fix(
    m: Array, x: Any, y: Any, spacing: Any, now: Any, key: Any, episode: Any, draw: int
) -> tuple[bool, Any, Any]:
    """Return whether a position is fixed, `spacing` seconds after the last fix, and the fix (m)."""
    kept = math.exp(-spacing / m[layout.GNSS_WANDER_TIME])
    driven = m[layout.GNSS_WANDER] * math.sqrt(1.0 - kept * kept)
    first, second = gaussian(key, episode, draw + WANDER_DRAW)
    m[layout.WANDER_X] = kept * m[layout.WANDER_X] + driven * first
    m[layout.WANDER_Y] = kept * m[layout.WANDER_Y] + driven * second
    if now < m[layout.OUTAGE_END]:
        return False, x, y
    if uniform(key, episode, draw + OUTAGE_DRAW) < m[layout.GNSS_DROPOUT_RATE] * spacing:
        m[layout.OUTAGE_END] = now + m[layout.GNSS_DROPOUT_DURATION]
        return False, x, y
    x, y = fix_without_outlier(m, x, y, key, episode, draw)
    if uniform(key, episode, draw + OUTLIER_DRAW) < m[layout.GNSS_OUTLIER_RATE]:
        angle = 2.0 * math.pi * uniform(key, episode, draw + OUTLIER_DRAW + 1)
        x += m[layout.GNSS_OUTLIER_SIZE] * math.cos(angle)
        y += m[layout.GNSS_OUTLIER_SIZE] * math.sin(angle)
    return True, x, y


@compiled_internal
def send_fix(
    m: Array, fixes: Array, record: Array, now: Any, key: Any, episode: Any, draw: int, spec: Array
) -> None:
    """Measure the fix that is due, if one is, and queue it until its arrival."""
    if now < m[layout.NEXT_FIX] - 1e-9:
        return
    spacing = spec[layout.GNSS_PERIOD]
    m[layout.NEXT_FIX] = max(m[layout.NEXT_FIX] + spacing, now + 1e-6)
    there, x, y = measure_fix(m, record[X], record[Y], spacing, now, key, episode, draw)
    at = int(m[layout.WAITING])
    if there and (at + 1) * layout.FIX <= fixes.shape[0]:
        place = at * layout.FIX
        fixes[place], fixes[place + 1] = now + m[layout.GNSS_LATENCY], now
        fixes[place + 2], fixes[place + 3] = x, y
        m[layout.WAITING] += 1.0


@compiled_internal
def drop_first(m: Array, fixes: Array) -> None:
    """Remove the oldest fix from the queue."""
    m[layout.WAITING] -= 1.0
    for j in range(int(m[layout.WAITING]) * layout.FIX):
        fixes[j] = fixes[j + layout.FIX]


@compiled_internal
def steering_offset(ekf: Array, spec: Array) -> Any:
    """Return the steering offset that is subtracted from the commands, rad."""
    if spec[layout.CALIBRATE] < 0.5 or spec[layout.ESTIMATOR] != layout.EKF:
        return 0.0
    limit = layout.MAX_STEERING_OFFSET
    return clip(ekf[filtering.STEERING_OFFSET], -limit, limit)


@compiled_in_place
def estimate(
    m: Array, fixes: Array, ekf: Array, record: Array, now: Any, spec: Array, work: Array
) -> None:
    """Estimate the state at the end of a control period from its readings and arrived fixes."""
    e = m[layout.ESTIMATE : layout.TAIL]
    kind = int(spec[layout.ESTIMATOR])
    if kind == layout.EKF:
        settings = spec[layout.SETTINGS :]
        filtering.advance_filter(
            ekf, now, m[layout.MEAN_A], m[layout.MEAN_DELTA], m[layout.READ_SPEED],
            m[layout.READ_YAW_RATE], m[layout.READ_HEADING], settings, work,
        )  # fmt: skip
    while m[layout.WAITING] > 0.5 and fixes[0] <= now + 1e-9:
        m[layout.FIX_X], m[layout.FIX_Y] = fixes[2], fixes[3]
        if kind == layout.EKF:
            filtering.take_fix(ekf, fixes[1], fixes[2], fixes[3], spec[layout.SETTINGS :], work)
        drop_first(m, fixes)
    e[ACCELERATION] = m[layout.SERVO_A]
    e[STEERING] = m[layout.SERVO_DELTA] + steering_offset(ekf, spec)
    if kind == layout.EKF:
        for j in range(6):
            e[j] = ekf[j]
        m[layout.DEVIATION] = filtering.position_deviation(ekf)
    elif kind == layout.RAW:
        e[VX], e[VY], e[YAW_RATE] = m[layout.READ_SPEED], 0.0, m[layout.READ_YAW_RATE]
        e[PSI], e[X], e[Y] = m[layout.READ_HEADING], m[layout.FIX_X], m[layout.FIX_Y]
    else:
        for j in range(6):
            e[j] = record[j]
        e[STEERING] = m[layout.SERVO_DELTA] + m[layout.STEERING_OFFSET]


@compiled_in_place
def begin_estimate(
    m: Array, ekf: Array, record: Array, key: Any, episode: Any, draw: int, spec: Array
) -> None:
    """Begin the estimate from readings at 0 s: a fix without outlier, heading and speed."""
    kind = int(spec[layout.ESTIMATOR])
    e = m[layout.ESTIMATE : layout.TAIL]
    m[layout.FIX_X], m[layout.FIX_Y] = fix_without_outlier(
        m, record[X], record[Y], key, episode, draw
    )
    read_sensors(m, record, key, episode, draw, 0.0)
    for j in range(6):
        e[j] = record[j]
    m[layout.DEVIATION] = 0.0
    if kind == layout.TRUTH:
        return
    e[VX], e[VY], e[YAW_RATE] = m[layout.READ_SPEED], 0.0, m[layout.READ_YAW_RATE]
    e[PSI], e[X], e[Y] = m[layout.READ_HEADING], m[layout.FIX_X], m[layout.FIX_Y]
    if kind == layout.RAW:
        return
    f = ekf
    for j in range(filtering.TIME):
        f[j] = 0.0
    for j in range(6):
        f[j] = e[j]
    for j in range(filtering.STATES):
        f[filtering.COVARIANCE + filtering.DIAGONAL * j] = spec[layout.INITIAL + j]
    # Heading and yaw rate were measured: their errors are minus those of the biases.
    filtering.correlate(f, PSI, filtering.HEADING_BIAS)
    filtering.correlate(f, YAW_RATE, filtering.GYRO_BIAS)
    filtering.begin_filter(f, 0.0)
    m[layout.DEVIATION] = filtering.position_deviation(f)


@compiled
def _draw(m: Array, spec: Array, key: Any) -> None:
    draw_conditions(m, spec, key, 0)


@compiled
def _read(m: Array, state: Array, key: Any, draw: int, period: Any) -> None:
    read_sensors(m, state, key, 0, draw, period)


@compiled
def _fix(
    m: Array, x: Any, y: Any, spacing: Any, now: Any, key: Any, draw: int
) -> tuple[bool, Any, Any]:
    if now < 0.0:
        first, second = fix_without_outlier(m, x, y, key, 0, draw)
        return True, first, second
    return measure_fix(m, x, y, spacing, now, key, 0, draw)


class Sensors:
    """GNSS, IMU and wheel speed of one vehicle, with the errors of some conditions.

    Every call draws the errors of one reading; equal calls with equal seeds give equal readings.
    Readings come at once: the caller has to delay fixes by `drawn["gnss_latency"]` (s).

    Parameters
    ----------
    conditions
        Ranges are drawn once.
    seed
        Seed of all draws.
    """

    def __init__(self, conditions: Conditions, seed: int = 0) -> None:
        # The kernels of sensors read only the ranges and the period of the fixes.
        spec = np.zeros(layout.SPEC)
        spec[: 2 * layout.COUNT] = conditions.ranges().ravel()
        spec[layout.GNSS_PERIOD] = conditions.gnss_period
        self._key = random_key(np.random.default_rng(seed))
        self._vehicle, self._state = np.zeros(layout.TAIL), np.zeros(STATE_SIZE)
        self._calls = 0
        self._inertial_time = self._fix_time = 0.0
        _draw(self._vehicle, spec, self._key)

    @property
    def drawn(self) -> dict[str, float]:
        """Values drawn from the conditions' ranges, by field."""
        return dict(zip(DRAWN, self._vehicle[: len(DRAWN)].tolist(), strict=True))

    def inertial(self, time: float, heading: float, yaw_rate: float) -> tuple[float, float]:
        """Return heading (rad) and yaw rate (rad/s) as the IMU measures them at `time` (s)."""
        self._state[PSI], self._state[YAW_RATE] = heading, yaw_rate
        self._read(max(time - self._inertial_time, 0.0))
        self._inertial_time = time
        m = self._vehicle
        return float(m[layout.READ_HEADING]), float(m[layout.READ_YAW_RATE])

    def wheel_speed(self, speed: float) -> float:
        """Return the speed (m/s) as the wheels measure it."""
        self._state[VX] = speed
        self._read(0.0)
        return float(self._vehicle[layout.READ_SPEED])

    def first_fix(self, x: float, y: float) -> tuple[float, float]:
        """Return a fix (m) from before the drive, without outage or outlier."""
        _, measured_x, measured_y = _fix(
            self._vehicle, float(x), float(y), 0.0, -1.0, self._key, self._next()
        )
        return measured_x, measured_y

    def fix(self, time: float, x: float, y: float) -> tuple[float, float] | None:
        """Return the fix (m) of a position at `time` (s, from 0 on), or None in an outage."""
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
        return PERIOD_DRAW + DRAWS * self._calls
