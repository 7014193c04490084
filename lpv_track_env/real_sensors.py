"""Compiled kernels of a real vehicle's sensors, and of the estimate that is made of them."""

import math
from typing import Any

from numpy.typing import NDArray

from lpv_track_env import filtering, real
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.draws import gaussian, uniform
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
    for j in range(real.COUNT):
        low, high = spec[2 * j], spec[2 * j + 1]
        m[j] = low
        if high > low:
            m[j] += (high - low) * uniform(key, episode, CONDITIONS_DRAW + j)
    direction = 2.0 * math.pi * uniform(key, episode, DIRECTION_DRAW)
    m[real.WIND_X], m[real.WIND_Y] = math.cos(direction), math.sin(direction)
    first, second = gaussian(key, episode, FIRST_WANDER_DRAW)
    m[real.WANDER_X], m[real.WANDER_Y] = m[real.GNSS_WANDER] * first, m[real.GNSS_WANDER] * second
    first, second = gaussian(key, episode, FIRST_GUST_DRAW)
    m[real.GUST] = m[real.GUST_SPEED] * first
    # Receivers do not start with the drive.
    m[real.NEXT_FIX] = spec[real.GNSS_PERIOD] * uniform(key, episode, PHASE_DRAW)


@compiled_internal
def read_sensors(m: Array, memory: Array, key: Any, episode: Any, draw: int, period: Any) -> None:
    """Read wheel speed, yaw rate and heading of the true state."""
    first, second = gaussian(key, episode, draw + READINGS_DRAW)
    third, _ = gaussian(key, episode, draw + READINGS_DRAW + 2)
    walk, _ = gaussian(key, episode, draw + DRIFT_DRAW)
    m[real.DRIFT] += m[real.YAW_RATE_DRIFT] * math.sqrt(period) * walk
    m[real.READ_SPEED] = memory[VX] * (1.0 + m[real.SPEED_SCALE]) + m[real.SPEED_NOISE] * first
    m[real.READ_YAW_RATE] = (
        memory[YAW_RATE] + m[real.YAW_RATE_BIAS] + m[real.DRIFT] + m[real.YAW_RATE_NOISE] * second
    )
    m[real.READ_HEADING] = memory[PSI] + m[real.HEADING_BIAS] + m[real.HEADING_NOISE] * third


@compiled_internal
def sound_fix(m: Array, x: Any, y: Any, key: Any, episode: Any, draw: int) -> tuple[Any, Any]:
    """Fix of a position with the errors that every fix has."""
    first, second = gaussian(key, episode, draw + FIX_DRAW)
    return (
        x + (m[real.WANDER_X] + m[real.GNSS_NOISE] * first),
        y + (m[real.WANDER_Y] + m[real.GNSS_NOISE] * second),
    )


@compiled_internal
def measure_fix(
    m: Array, x: Any, y: Any, spacing: Any, now: Any, key: Any, episode: Any, draw: int
) -> tuple[bool, Any, Any]:
    """Whether there is a fix of a position, `spacing` seconds after the last was due, and which."""
    kept = math.exp(-spacing / m[real.GNSS_WANDER_TIME])
    driven = m[real.GNSS_WANDER] * math.sqrt(1.0 - kept * kept)
    first, second = gaussian(key, episode, draw + WANDER_DRAW)
    m[real.WANDER_X] = kept * m[real.WANDER_X] + driven * first
    m[real.WANDER_Y] = kept * m[real.WANDER_Y] + driven * second
    if now < m[real.OUTAGE_END]:
        return False, x, y
    if uniform(key, episode, draw + OUTAGE_DRAW) < m[real.GNSS_DROPOUT_RATE] * spacing:
        m[real.OUTAGE_END] = now + m[real.GNSS_DROPOUT_DURATION]
        return False, x, y
    x, y = sound_fix(m, x, y, key, episode, draw)
    if uniform(key, episode, draw + OUTLIER_DRAW) < m[real.GNSS_OUTLIER_RATE]:
        angle = 2.0 * math.pi * uniform(key, episode, draw + OUTLIER_DRAW + 1)
        x += m[real.GNSS_OUTLIER_SIZE] * math.cos(angle)
        y += m[real.GNSS_OUTLIER_SIZE] * math.sin(angle)
    return True, x, y


@compiled_internal
def receive_satellites(
    m: Array, ways: Array, memory: Array, now: Any, key: Any, episode: Any, draw: int, spec: Array
) -> None:
    """Make the fix that is due, if there is one, and put it on its way."""
    if now < m[real.NEXT_FIX] - 1e-9:
        return
    spacing = spec[real.GNSS_PERIOD]
    m[real.NEXT_FIX] = max(m[real.NEXT_FIX] + spacing, now + 1e-6)
    there, x, y = measure_fix(m, memory[X], memory[Y], spacing, now, key, episode, draw)
    at = int(m[real.WAITING])
    if there and (at + 1) * real.WAY <= ways.shape[0]:
        place = at * real.WAY
        ways[place], ways[place + 1] = now + m[real.GNSS_LATENCY], now
        ways[place + 2], ways[place + 3] = x, y
        m[real.WAITING] += 1.0


@compiled_internal
def arrived(m: Array, ways: Array, now: Any) -> Any:
    """Whether the oldest fix on its way has arrived."""
    return m[real.WAITING] > 0.5 and ways[0] <= now + 1e-9


@compiled_internal
def drop_first(m: Array, ways: Array) -> None:
    """Take the oldest fix off the list."""
    m[real.WAITING] -= 1.0
    for j in range(int(m[real.WAITING]) * real.WAY):
        ways[j] = ways[j + real.WAY]


@compiled_internal
def offset_of(filter_memory: Array, spec: Array) -> Any:
    """Steering offset that is taken off the commands, rad."""
    if spec[real.CALIBRATE] < 0.5 or spec[real.ESTIMATOR] != real.EKF:
        return 0.0
    offset = filter_memory[filtering.STEERING_OFFSET]
    return clip(offset, -real.WORST_OFFSET, real.WORST_OFFSET)


@compiled_in_place
def estimate(
    m: Array, ways: Array, filter_memory: Array, memory: Array, now: Any, spec: Array, work: Array
) -> None:
    """Make the estimate of this control period's end from what was read and what has arrived."""
    e = m[real.ESTIMATE : real.TAIL]
    kind = int(spec[real.ESTIMATOR])
    if kind == real.EKF:
        settings = spec[real.SETTINGS :]
        filtering.advance_filter(
            filter_memory, now, m[real.MEAN_A], m[real.MEAN_DELTA], m[real.READ_SPEED],
            m[real.READ_YAW_RATE], m[real.READ_HEADING], settings, work,
        )  # fmt: skip
    while arrived(m, ways, now):
        m[real.FIX_X], m[real.FIX_Y] = ways[2], ways[3]
        if kind == real.EKF:
            filtering.take_fix(
                filter_memory, ways[1], ways[2], ways[3], spec[real.SETTINGS :], work
            )
        drop_first(m, ways)
    e[ACCELERATION] = m[real.SERVO_A]
    e[STEERING] = m[real.SERVO_DELTA] + offset_of(filter_memory, spec)
    if kind == real.EKF:
        for j in range(6):
            e[j] = filter_memory[j]
        m[real.DEVIATION] = filtering.position_deviation(filter_memory)
    elif kind == real.RAW:
        e[VX], e[VY], e[YAW_RATE] = m[real.READ_SPEED], 0.0, m[real.READ_YAW_RATE]
        e[PSI], e[X], e[Y] = m[real.READ_HEADING], m[real.FIX_X], m[real.FIX_Y]
    else:
        for j in range(6):
            e[j] = memory[j]
        e[STEERING] = m[real.SERVO_DELTA] + m[real.STEERING_OFFSET]


@compiled_in_place
def begin_estimate(
    m: Array, filter_memory: Array, memory: Array, key: Any, episode: Any, draw: int, spec: Array
) -> None:
    """Begin from a first fix, heading and speed, read on the spot (at 0 s); no outlier."""
    kind = int(spec[real.ESTIMATOR])
    e = m[real.ESTIMATE : real.TAIL]
    m[real.FIX_X], m[real.FIX_Y] = sound_fix(m, memory[X], memory[Y], key, episode, draw)
    read_sensors(m, memory, key, episode, draw, 0.0)
    for j in range(6):
        e[j] = memory[j]
    m[real.DEVIATION] = 0.0
    if kind == real.TRUTH:
        return
    e[VX], e[VY], e[YAW_RATE] = m[real.READ_SPEED], 0.0, m[real.READ_YAW_RATE]
    e[PSI], e[X], e[Y] = m[real.READ_HEADING], m[real.FIX_X], m[real.FIX_Y]
    if kind == real.RAW:
        return
    f = filter_memory
    for j in range(filtering.TIME):
        f[j] = 0.0
    for j in range(6):
        f[j] = e[j]
    for j in range(filtering.STATES):
        f[filtering.COVARIANCE + 10 * j] = spec[real.INITIAL + j]
    # Heading and yaw rate were read: their errors are those of the biases, with the other sign.
    filtering.correlate(f, PSI, filtering.HEADING_BIAS)
    filtering.correlate(f, YAW_RATE, filtering.GYRO_BIAS)
    filtering.begin_filter(f, 0.0)
    m[real.DEVIATION] = filtering.position_deviation(f)
