"""Compiled kernels of a real vehicle's sensors, and of the estimate that is made of them."""

import math
from typing import Any

from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.conditions import layout
from lpv_track_env.draws import gaussian, uniform
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.kernels import ACCELERATION, STEERING, clip
from trajectories.compilation import compiled_in_place, compiled_internal

Array = NDArray[Any]

# Places of an episode's draws beside those of `episodes`;
CONDITIONS_DRAW, DIRECTION_DRAW, FIRST_WANDER_DRAW, FIRST_GUST_DRAW, PHASE_DRAW = 16, 80, 82, 84, 86
PERIOD_DRAW, DRAWS = 128, 64
"""from PERIOD_DRAW on, DRAWS of them to a control period, and among these:"""
READINGS_DRAW, FIX_DRAW, WANDER_DRAW, OUTAGE_DRAW, OUTLIER_DRAW, DRIFT_DRAW = 0, 4, 6, 8, 10, 12


@compiled_in_place
def draw_conditions(m: Array, spec: Array, key: Any, episode: Any) -> None:
    """Draw an episode's conditions, and what has been going on when it begins."""
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
    # Receivers do not start with the drive.
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
def sound_fix(m: Array, x: Any, y: Any, key: Any, episode: Any, draw: int) -> tuple[Any, Any]:
    """Fix of a position with the errors that every fix has."""
    first, second = gaussian(key, episode, draw + FIX_DRAW)
    return (
        x + (m[layout.WANDER_X] + m[layout.GNSS_NOISE] * first),
        y + (m[layout.WANDER_Y] + m[layout.GNSS_NOISE] * second),
    )


@compiled_internal
def measure_fix(
    m: Array, x: Any, y: Any, spacing: Any, now: Any, key: Any, episode: Any, draw: int
) -> tuple[bool, Any, Any]:
    """Whether there is a fix of a position, `spacing` seconds after the last was due, and which."""
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
    x, y = sound_fix(m, x, y, key, episode, draw)
    if uniform(key, episode, draw + OUTLIER_DRAW) < m[layout.GNSS_OUTLIER_RATE]:
        angle = 2.0 * math.pi * uniform(key, episode, draw + OUTLIER_DRAW + 1)
        x += m[layout.GNSS_OUTLIER_SIZE] * math.cos(angle)
        y += m[layout.GNSS_OUTLIER_SIZE] * math.sin(angle)
    return True, x, y


@compiled_internal
def receive_satellites(
    m: Array, ways: Array, record: Array, now: Any, key: Any, episode: Any, draw: int, spec: Array
) -> None:
    """Make the fix that is due, if there is one, and put it on its way."""
    if now < m[layout.NEXT_FIX] - 1e-9:
        return
    spacing = spec[layout.GNSS_PERIOD]
    m[layout.NEXT_FIX] = max(m[layout.NEXT_FIX] + spacing, now + 1e-6)
    there, x, y = measure_fix(m, record[X], record[Y], spacing, now, key, episode, draw)
    at = int(m[layout.WAITING])
    if there and (at + 1) * layout.WAY <= ways.shape[0]:
        place = at * layout.WAY
        ways[place], ways[place + 1] = now + m[layout.GNSS_LATENCY], now
        ways[place + 2], ways[place + 3] = x, y
        m[layout.WAITING] += 1.0


@compiled_internal
def arrived(m: Array, ways: Array, now: Any) -> Any:
    """Whether the oldest fix on its way has arrived."""
    return m[layout.WAITING] > 0.5 and ways[0] <= now + 1e-9


@compiled_internal
def drop_first(m: Array, ways: Array) -> None:
    """Take the oldest fix off the list."""
    m[layout.WAITING] -= 1.0
    for j in range(int(m[layout.WAITING]) * layout.WAY):
        ways[j] = ways[j + layout.WAY]


@compiled_internal
def offset_of(ekf: Array, spec: Array) -> Any:
    """Steering offset that is taken off the commands, rad."""
    if spec[layout.CALIBRATE] < 0.5 or spec[layout.ESTIMATOR] != layout.EKF:
        return 0.0
    offset = ekf[filtering.STEERING_OFFSET]
    return clip(offset, -layout.WORST_OFFSET, layout.WORST_OFFSET)


@compiled_in_place
def estimate(
    m: Array, ways: Array, ekf: Array, record: Array, now: Any, spec: Array, work: Array
) -> None:
    """Make the estimate of this control period's end from what was read and what has arrived."""
    e = m[layout.ESTIMATE : layout.TAIL]
    kind = int(spec[layout.ESTIMATOR])
    if kind == layout.EKF:
        settings = spec[layout.SETTINGS :]
        filtering.advance_filter(
            ekf, now, m[layout.MEAN_A], m[layout.MEAN_DELTA], m[layout.READ_SPEED],
            m[layout.READ_YAW_RATE], m[layout.READ_HEADING], settings, work,
        )  # fmt: skip
    while arrived(m, ways, now):
        m[layout.FIX_X], m[layout.FIX_Y] = ways[2], ways[3]
        if kind == layout.EKF:
            filtering.take_fix(ekf, ways[1], ways[2], ways[3], spec[layout.SETTINGS :], work)
        drop_first(m, ways)
    e[ACCELERATION] = m[layout.SERVO_A]
    e[STEERING] = m[layout.SERVO_DELTA] + offset_of(ekf, spec)
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
    """Begin from a first fix, heading and speed, read on the spot (at 0 s); no outlier."""
    kind = int(spec[layout.ESTIMATOR])
    e = m[layout.ESTIMATE : layout.TAIL]
    m[layout.FIX_X], m[layout.FIX_Y] = sound_fix(m, record[X], record[Y], key, episode, draw)
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
        f[filtering.COVARIANCE + 10 * j] = spec[layout.INITIAL + j]
    # Heading and yaw rate were read: their errors are those of the biases, with the other sign.
    filtering.correlate(f, PSI, filtering.HEADING_BIAS)
    filtering.correlate(f, YAW_RATE, filtering.GYRO_BIAS)
    filtering.begin_filter(f, 0.0)
    m[layout.DEVIATION] = filtering.position_deviation(f)
