"""Compiled kernels of the estimator: an extended Kalman filter on the bicycle's vector field.

State of the filter, (9,): the vehicle's [vx, vy, psi, r, X, Y], the bias of the yaw-rate sensor
(rad/s), the bias of the heading sensor (rad), and the steering offset (rad: the wheels' angle is
the reported angle plus the offset). Biases are random walks. Model of the readings::

    speed = vx        yaw rate = r + gyro bias        heading = psi + heading bias
    fix = (X, Y)

Scalar updates follow one another, which for independent noise equals one joint update. A reading
whose normalised innovation squared (NIS) exceeds its gate is rejected. The filter keeps its last
nodes: a late fix updates the node of its stamp, and the nodes after that are computed anew
(Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001:
sections 5.4 and 10.3).
"""

import math
from typing import Any

from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y, compiled_inverse_speed
from lpv_track_env.integration import integrate_with
from lpv_track_env.kernels import wrap
from trajectories.compilation import compiled, compiled_internal

Array = NDArray[Any]

GYRO_BIAS, HEADING_BIAS, STEERING_OFFSET = 6, 7, 8
STATES = 9
ENTRIES = STATES * STATES
"""Entries of the covariance."""
DIAGONAL = STATES + 1
"""Distance between two of its diagonal entries."""
# Array of a filter (`m`), float64: state, covariance (81, row by row), counters, a ring of past
# nodes.
COVARIANCE = STATES
(
    TIME, LAST_STAMP, NEWEST, NODES, FIX_NIS, READING_NIS, READINGS, FIXES_IN_A_ROW, FIX_AGE,
    FIXES_USED, FIXES_GATED, FIXES_LATE, FIXES_DUPLICATE, FIXES_NOT_FINITE, SPEED_GATED,
    YAW_RATE_GATED, HEADING_GATED, SPEED_IN_A_ROW, YAW_RATE_IN_A_ROW, HEADING_IN_A_ROW,
) = range(COVARIANCE + ENTRIES, COVARIANCE + ENTRIES + 20)  # fmt: skip
FILTER = COVARIANCE + ENTRIES + 20
"""First entry of the ring of nodes."""

# A node: its time, the step that led to it and the inputs in that step, readings (NaN: none),
# state and covariance.
NODE_TIME, NODE_STEP, NODE_A, NODE_DELTA = 0, 1, 2, 3
NODE_SPEED, NODE_YAW_RATE, NODE_HEADING, NODE_FIX_X, NODE_FIX_Y, NODE_STATE = 4, 5, 6, 7, 8, 9
NODE = NODE_STATE + STATES + ENTRIES
"""Length of a node."""

# Settings of a filter, (SETTINGS,) float64: variances of the readings,
POSITION_VARIANCE, HEADING_VARIANCE, YAW_RATE_VARIANCE, SPEED_VARIANCE = range(4)
# densities of the process noise, per second,
VX_DENSITY, VY_DENSITY, PSI_DENSITY, R_DENSITY, POSITION_DENSITY = 4, 5, 6, 7, 8
GYRO_DENSITY, HEADING_BIAS_DENSITY, OFFSET_DENSITY = 9, 10, 11
# gates on the NIS of a fix (2 degrees of freedom) and of a reading (1), rejections in a row after
# which a reading is used nevertheless, the prediction's step (s), the vehicle's 7 parameters, its
# lowest speed (m/s), and the constants of its tyres (`tyres.constants`).
FIX_GATE, READING_GATE, MOST_IN_A_ROW, SUBSTEP, PARAMETERS = 12, 13, 14, 15, 16
LOWEST_SPEED = PARAMETERS + 7
TYRE = LOWEST_SPEED + 1
SETTINGS = TYRE + 6

USED, GATED, LATE, DUPLICATE, NOT_FINITE = range(5)
FIX_RESULTS = ("used", "gated", "late", "duplicate", "not finite")
"""Outcomes of a fix, by code."""

WORK = 2 * ENTRIES
"""Size of the scratch array."""

SLIDING_NOISE = 24.0
"""Growth of the process noise of vy and r up to where tyres slide, since the friction that limits
their forces is known badly: 1 + this times the square of the slip."""
JACOBIAN_STEP = 0.35
"""Largest product of step and poles for the Jacobian: it gives four digits of its entries."""
DIFFERENCES = (1e-4, 1e-4, 1e-5, 1e-6)
"""Steps of the finite differences in vx, vy, r (m/s, m/s, rad/s) and delta (rad)."""


@compiled_internal
def propagate_covariance(m: Array, f: Array, fp: Array) -> None:
    """Replace the filter's covariance P by F P F' with F = `f` (81,); `fp` (81,) is scratch."""
    # The biases stay: their three rows of F are those of the identity.
    for i in range(6):
        for j in range(STATES):
            total = 0.0
            for k in range(STATES):
                total += f[i * STATES + k] * m[COVARIANCE + k * STATES + j]
            fp[i * STATES + j] = total
    for i in range(6, STATES):
        for j in range(STATES):
            fp[i * STATES + j] = m[COVARIANCE + i * STATES + j]
    for i in range(STATES):
        for j in range(i + 1):
            total = fp[i * STATES + j]
            if j < 6:
                total = 0.0
                for k in range(STATES):
                    total += fp[i * STATES + k] * f[j * STATES + k]
            m[COVARIANCE + i * STATES + j] = total
            m[COVARIANCE + j * STATES + i] = total


@compiled_internal
def predict(m: Array, a: Any, delta: Any, dt: Any, settings: Array, work: Array) -> None:
    """Predict state and covariance dt seconds ahead, inputs held.

    The transition matrix is computed by finite differences of the integrated field itself: it
    always fits the model, and stiff tyres at low speed do no harm.
    """
    s = settings
    p0, p1, p2, p3, p4, p5, p6 = (
        s[PARAMETERS], s[PARAMETERS + 1], s[PARAMETERS + 2], s[PARAMETERS + 3],
        s[PARAMETERS + 4], s[PARAMETERS + 5], s[PARAMETERS + 6],
    )  # fmt: skip
    t = TYRE
    tyre = s[t], s[t + 1], s[t + 2], s[t + 3], s[t + 4], s[t + 5]
    substeps = max(math.ceil(dt / s[SUBSTEP] - 1e-9), 1)
    h = dt / substeps
    vx, vy, psi, r = m[VX], m[VY], m[PSI], m[YAW_RATE]
    wheels = delta + m[STEERING_OFFSET]
    # In the frame of the vehicle at the start: its heading only turns the result.
    nx, ny, turn, nr, ahead, aside = integrate_with(
        vx, vy, 0.0, r, 0.0, 0.0, a, wheels, p0, p1, p2, p3, p4, p5, p6, tyre, h, substeps,
        s[LOWEST_SPEED],
    )  # fmt: skip
    # The Jacobian needs fewer steps, enough to resolve the lateral poles; their sum bounds each.
    # The poles of limited tyres are slower.
    q = compiled_inverse_speed(vx)
    poles = q * ((p4 + p5) / p0 + (p4 * p2 * p2 + p5 * p3 * p3) / p1)
    few = min(max(math.ceil(poles * dt / JACOBIAN_STEP), 1), substeps)
    h = dt / few
    bx, by, bent, br, along, across = integrate_with(
        vx, vy, 0.0, r, 0.0, 0.0, a, wheels, p0, p1, p2, p3, p4, p5, p6, tyre, h, few
    )
    c, sn = math.cos(psi), math.sin(psi)
    f = work[:ENTRIES]
    for k in range(ENTRIES):
        f[k] = 0.0
    for k in range(STATES):
        f[k * STATES + k] = 1.0
    for k in range(4):
        step = DIFFERENCES[k]
        dvx, dvy, dturn, dr, dahead, daside = integrate_with(
            vx + (step if k == 0 else 0.0), vy + (step if k == 1 else 0.0), 0.0,
            r + (step if k == 2 else 0.0), 0.0, 0.0, a, wheels + (step if k == 3 else 0.0),
            p0, p1, p2, p3, p4, p5, p6, tyre, h, few,
        )  # fmt: skip
        column = VX if k == 0 else VY if k == 1 else YAW_RATE if k == 2 else STEERING_OFFSET
        per = 1.0 / step
        f[VX * STATES + column] = (dvx - bx) * per
        f[VY * STATES + column] = (dvy - by) * per
        f[YAW_RATE * STATES + column] = (dr - br) * per
        f[PSI * STATES + column] = (dturn - bent) * per
        dahead, daside = (dahead - along) * per, (daside - across) * per
        f[X * STATES + column] = c * dahead - sn * daside
        f[Y * STATES + column] = sn * dahead + c * daside
    dx, dy = c * ahead - sn * aside, sn * ahead + c * aside
    f[X * STATES + PSI], f[Y * STATES + PSI] = -dy, dx
    m[VX], m[VY], m[YAW_RATE] = nx, ny, nr
    m[PSI] = psi + turn
    m[X] += dx
    m[Y] += dy
    propagate_covariance(m, f, work[ENTRIES:])
    # Slip angles by those at which all of a patch slides.
    front = abs(wheels - (vy + p2 * r) * q) * tyre[2]
    sliding = min(max(front, abs(p3 * r - vy) * q * tyre[3]), 1.0)
    doubt = dt * (1.0 + SLIDING_NOISE * sliding * sliding)
    d = COVARIANCE
    m[d] += s[VX_DENSITY] * dt
    m[d + DIAGONAL * VY] += s[VY_DENSITY] * doubt
    m[d + DIAGONAL * PSI] += s[PSI_DENSITY] * dt
    m[d + DIAGONAL * YAW_RATE] += s[R_DENSITY] * doubt
    m[d + DIAGONAL * X] += s[POSITION_DENSITY] * dt
    m[d + DIAGONAL * Y] += s[POSITION_DENSITY] * dt
    m[d + DIAGONAL * GYRO_BIAS] += s[GYRO_DENSITY] * dt
    m[d + DIAGONAL * HEADING_BIAS] += s[HEADING_BIAS_DENSITY] * dt
    m[d + DIAGONAL * STEERING_OFFSET] += s[OFFSET_DENSITY] * dt


@compiled_internal
def update(
    m: Array, first: int, second: int, innovation: Any, variance: Any, gate: Any, work: Array
) -> Any:
    """Update the filter with a measurement of state `first` plus state `second` (-1: none).

    Returns the NIS; a measurement beyond `gate` changes nothing.
    """
    gain = work[:STATES]
    for i in range(STATES):
        gain[i] = m[COVARIANCE + i * STATES + first]
        if second >= 0:
            gain[i] += m[COVARIANCE + i * STATES + second]
    total = gain[first] + variance
    if second >= 0:
        total += gain[second]
    nis = innovation * innovation / total
    if not nis <= gate:
        return nis
    for i in range(STATES):
        share = gain[i] / total
        m[i] += share * innovation
        for j in range(i + 1):
            # Both halves get the same number: the covariance stays exactly symmetric.
            change = m[COVARIANCE + i * STATES + j] - share * gain[j]
            m[COVARIANCE + i * STATES + j] = change
            m[COVARIANCE + j * STATES + i] = change
    return nis


@compiled_internal
def take_reading(
    m: Array, first: int, second: int, value: Any, variance: Any, row: int, gated: int,
    settings: Array, work: Array,
) -> None:  # fmt: skip
    """Update the filter with one reading, NaN for none, and count the outcome.

    After enough rejections in a row a reading is used nevertheless: the filter is wrong, not the
    sensor.
    """
    if not math.isfinite(value):
        return
    innovation = value - m[first] - (m[second] if second >= 0 else 0.0)
    if first == PSI:
        innovation = wrap(innovation)
    nis = update(m, first, second, innovation, variance, settings[READING_GATE], work)
    if nis <= settings[READING_GATE]:
        m[READING_NIS] += nis
        m[READINGS] += 1.0
        m[row] = 0.0
        return
    m[gated] += 1.0
    m[row] += 1.0
    if m[row] >= settings[MOST_IN_A_ROW]:
        m[row] = 0.0
        inflate(m, first if second < 0 else second, innovation)
        update(m, first, second, innovation, variance, math.inf, work)


@compiled_internal
def inflate(m: Array, state: int, innovation: Any) -> None:
    """Inflate the variance of a state to match a large innovation."""
    m[COVARIANCE + DIAGONAL * state] += innovation * innovation


@compiled_internal
def take_readings(
    m: Array, speed: Any, yaw_rate: Any, heading: Any, settings: Array, work: Array
) -> None:
    """Update the filter with wheel speed (m/s), yaw rate (rad/s) and heading (rad); NaN: none."""
    s = settings
    m[READING_NIS] = m[READINGS] = 0.0
    take_reading(m, VX, -1, speed, s[SPEED_VARIANCE], SPEED_IN_A_ROW, SPEED_GATED, s, work)
    take_reading(
        m, YAW_RATE, GYRO_BIAS, yaw_rate, s[YAW_RATE_VARIANCE], YAW_RATE_IN_A_ROW, YAW_RATE_GATED,
        s, work,
    )  # fmt: skip
    take_reading(
        m, PSI, HEADING_BIAS, heading, s[HEADING_VARIANCE], HEADING_IN_A_ROW, HEADING_GATED, s, work
    )


@compiled_internal
def take_position(m: Array, x: Any, y: Any, gate: Any, settings: Array, work: Array) -> Any:
    """Update the filter with a position; return its NIS. One beyond `gate` changes nothing."""
    variance, d = settings[POSITION_VARIANCE], COVARIANCE
    ex, ey = x - m[X], y - m[Y]
    sxx, syy = m[d + DIAGONAL * X] + variance, m[d + DIAGONAL * Y] + variance
    sxy = m[d + X * STATES + Y]
    nis = (ex * ex * syy - 2.0 * ex * ey * sxy + ey * ey * sxx) / (sxx * syy - sxy * sxy)
    if nis <= gate:
        update(m, X, -1, ex, variance, math.inf, work)
        update(m, Y, -1, y - m[Y], variance, math.inf, work)
    return nis


@compiled_internal
def store_node(m: Array, nodes: Array, k: int) -> None:
    """Store state and covariance in node k."""
    for j in range(STATES + ENTRIES):
        nodes[k * NODE + NODE_STATE + j] = m[j]


@compiled_internal
def correlate(m: Array, state: int, bias: int) -> None:
    """Correlate the errors of a measured state and of its sensor's bias: they are opposite."""
    variance = m[COVARIANCE + DIAGONAL * bias]
    m[COVARIANCE + state * STATES + bias] = m[COVARIANCE + bias * STATES + state] = -variance


@compiled
def begin_filter(m: Array, time: Any) -> None:
    """Begin at a time (s) from the state and covariance in `m`, with one node."""
    for j in range(TIME, m.shape[0]):
        m[j] = 0.0
    m[TIME], m[LAST_STAMP], m[NODES] = time, -math.inf, 1.0
    m[FIX_NIS] = math.nan
    nodes = m[FILTER:]
    nodes[NODE_TIME] = time
    for j in range(NODE_SPEED, NODE_STATE):
        nodes[j] = math.nan
    store_node(m, nodes, 0)


@compiled
def advance_filter(
    m: Array, time: Any, a: Any, delta: Any, speed: Any, yaw_rate: Any, heading: Any,
    settings: Array, work: Array,
) -> None:  # fmt: skip
    """Predict to `time` under the mean inputs since the last call, and update with readings."""
    dt = time - m[TIME]
    predict(m, a, delta, dt, settings, work)
    take_readings(m, speed, yaw_rate, heading, settings, work)
    m[TIME] = time
    m[FIX_AGE] += dt
    nodes = m[FILTER:]
    capacity = nodes.shape[0] // NODE
    newest = (int(m[NEWEST]) + 1) % capacity
    m[NEWEST] = newest
    m[NODES] = min(m[NODES] + 1.0, float(capacity))
    node = nodes[newest * NODE : (newest + 1) * NODE]
    node[NODE_TIME], node[NODE_STEP], node[NODE_A], node[NODE_DELTA] = time, dt, a, delta
    node[NODE_SPEED], node[NODE_YAW_RATE], node[NODE_HEADING] = speed, yaw_rate, heading
    node[NODE_FIX_X] = node[NODE_FIX_Y] = math.nan
    store_node(m, nodes, newest)


@compiled
def take_fix(m: Array, stamp: Any, x: Any, y: Any, settings: Array, work: Array) -> int:
    """Update the filter with a fix of the position at `stamp` (s); return a code of FIX_RESULTS.

    The fix is moved to the time of the nearest node by the velocity there, and the nodes after that
    one are computed anew. The nearest node is at most half a step away.
    """
    if not math.isfinite(stamp + x + y):
        m[FIXES_NOT_FINITE] += 1.0
        return NOT_FINITE
    if stamp == m[LAST_STAMP]:
        m[FIXES_DUPLICATE] += 1.0
        return DUPLICATE
    nodes = m[FILTER:]
    capacity, count = nodes.shape[0] // NODE, int(m[NODES])
    back = 0
    while back + 1 < count:
        here = nodes[((int(m[NEWEST]) - back + capacity) % capacity) * NODE :]
        if stamp >= here[NODE_TIME] - 0.5 * here[NODE_STEP]:
            break
        back += 1
    k = (int(m[NEWEST]) - back + capacity) % capacity
    node = nodes[k * NODE : (k + 1) * NODE]
    early = node[NODE_TIME] - stamp
    # Before the oldest node the filter knows nothing of the vehicle.
    late = early > max(0.5 * node[NODE_STEP], 1e-6) or stamp < m[LAST_STAMP]
    if late or math.isfinite(node[NODE_FIX_X]):
        m[FIXES_LATE] += 1.0
        return LATE
    for j in range(STATES + ENTRIES):
        m[j] = node[NODE_STATE + j]
    c, s = math.cos(m[PSI]), math.sin(m[PSI])
    x += (m[VX] * c - m[VY] * s) * early
    y += (m[VX] * s + m[VY] * c) * early
    ex, ey = x - m[X], y - m[Y]
    nis = take_position(m, x, y, settings[FIX_GATE], settings, work)
    m[FIX_NIS] = nis
    m[LAST_STAMP] = stamp
    gated = not nis <= settings[FIX_GATE]
    if gated:
        m[FIXES_GATED] += 1.0
        m[FIXES_IN_A_ROW] += 1.0
        if m[FIXES_IN_A_ROW] < settings[MOST_IN_A_ROW]:
            newest = int(m[NEWEST]) * NODE
            for j in range(STATES + ENTRIES):
                m[j] = nodes[newest + NODE_STATE + j]
            return GATED
        inflate(m, X, ex)
        inflate(m, Y, ey)
        take_position(m, x, y, math.inf, settings, work)
    else:
        m[FIXES_USED] += 1.0
    m[FIXES_IN_A_ROW] = 0.0
    m[FIX_AGE] = m[TIME] - stamp
    node[NODE_FIX_X], node[NODE_FIX_Y] = x, y
    store_node(m, nodes, k)
    replay(m, nodes, back, settings, work)
    return GATED if gated else USED


@compiled_internal
def replay(m: Array, nodes: Array, back: int, settings: Array, work: Array) -> None:
    """Compute the last `back` nodes anew from the state in `m`; the counters do not change."""
    capacity = nodes.shape[0] // NODE
    counts = (
        m[SPEED_GATED], m[YAW_RATE_GATED], m[HEADING_GATED], m[SPEED_IN_A_ROW],
        m[YAW_RATE_IN_A_ROW], m[HEADING_IN_A_ROW],
    )  # fmt: skip
    for left in range(back - 1, -1, -1):
        k = (int(m[NEWEST]) - left + capacity) % capacity
        node = nodes[k * NODE : (k + 1) * NODE]
        predict(m, node[NODE_A], node[NODE_DELTA], node[NODE_STEP], settings, work)
        take_readings(m, node[NODE_SPEED], node[NODE_YAW_RATE], node[NODE_HEADING], settings, work)
        if math.isfinite(node[NODE_FIX_X]):
            take_position(m, node[NODE_FIX_X], node[NODE_FIX_Y], settings[FIX_GATE], settings, work)
        store_node(m, nodes, k)
    (
        m[SPEED_GATED], m[YAW_RATE_GATED], m[HEADING_GATED], m[SPEED_IN_A_ROW],
        m[YAW_RATE_IN_A_ROW], m[HEADING_IN_A_ROW],
    ) = counts  # fmt: skip


@compiled_internal
def position_deviation(m: Array) -> Any:
    """Return the standard deviation of the position in its worst direction, m."""
    d = COVARIANCE
    xx, yy, xy = m[d + DIAGONAL * X], m[d + DIAGONAL * Y], m[d + X * STATES + Y]
    return math.sqrt(0.5 * (xx + yy) + math.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy))


@compiled
def deviation_of(m: Array) -> Any:
    """`position_deviation`, for calls from Python."""
    return position_deviation(m)
