"""Compiled kernels of path tracking under conditions: control periods and beginnings of episodes.

Observations are computed from the estimate; rewards, ends and infos from the true state.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels as k
from lpv_track_env.conditions import layout, sensors, vehicle
from lpv_track_env.episodes import begin
from lpv_track_env.estimation import filter as filtering
from trajectories.compilation import compiled, compiled_in_place, compiled_internal
from trajectories.projection import SEARCH_WINDOW

Array = NDArray[Any]


@compiled_in_place
def take_command(m: Array, record: Array, a: Any, delta: Any, spec: Array, constants: Array) -> int:
    """Begin a control period: queue its command unless the controller is busy.

    Returns the clipping bits.
    """
    p, commands = constants, m[layout.TAIL : layout.fixes_start(spec)]
    ekf = m[layout.filter_start(spec) :]
    now = record[k.STEPS] * p[k.PERIOD]
    bits = 0
    if m[layout.FREE_AT] > now + layout.TIME_TOLERANCE:
        # The controller is still computing an earlier command: a deadline miss.
        m[layout.MISSES] += 1.0
        m[layout.MISSED_IN_A_ROW] += 1.0
    else:
        # The rate limits hold over the time since the last command.
        periods = 1.0 + m[layout.MISSED_IN_A_ROW]
        a, delta, bits = k.actuate(
            a, delta, m[layout.COMMAND_A], m[layout.COMMAND_DELTA], p[k.MAX_STEERING],
            periods * p[k.STEERING_STEP], p[k.LOWEST_ACCELERATION], p[k.HIGHEST_ACCELERATION],
            periods * p[k.ACCELERATION_STEP],
        )  # fmt: skip
        m[layout.MISSED_IN_A_ROW] = 0.0
        vehicle.send_command(m, commands, now, a, delta, sensors.steering_offset(ekf, spec))
    m[layout.LATENCY] = m[layout.OCCUPIED] = -1.0
    blind = (
        spec[layout.ESTIMATOR] == layout.EKF and ekf[filtering.FIX_AGE] > spec[layout.MAX_FIX_AGE]
    )
    stale = (
        vehicle.command_age(m, commands, now) > spec[layout.MAX_COMMAND_AGE] + layout.TIME_TOLERANCE
    )
    m[layout.STOPPING] = 0.0
    if blind or stale:
        m[layout.STOPPING] = 1.0
        # So that the jerk limit also holds when the vehicle follows commands again.
        m[layout.COMMAND_A] = m[layout.SERVO_A]
    return bits


@compiled_in_place
def end_period(
    m: Array, record: Array, state: Any, bits: int, spec: Array, constants: Array, table: Array,
    observation: Array, key: Any, episode: Any, work: Array,
) -> int:  # fmt: skip
    """End a control period with a new true state: errors, end, reward, sensors, estimate.

    `state` is the tuple (vx, vy, psi, r, X, Y).
    """
    p, filtered = constants, layout.filter_start(spec)
    fixes, ekf = m[layout.fixes_start(spec) : filtered], m[filtered:]
    vx, vy, psi, r, x, y = state
    end = k.finish(
        record, p, table, observation, vx, vy, psi, r, x, y, m[layout.SERVO_A],
        m[layout.SERVO_DELTA], bits,
    )  # fmt: skip
    if end == k.NON_FINITE:
        # The last observation stays, since there is no state that sensors could measure.
        return end
    now = record[k.STEPS] * p[k.PERIOD]
    draw = sensors.PERIOD_DRAW + sensors.DRAWS * int(record[k.STEPS])
    sensors.read_sensors(m, record, key, episode, draw, p[k.PERIOD])
    sensors.send_fix(m, fixes, record, now, key, episode, draw, spec)
    sensors.estimate(m, fixes, ekf, record, now, spec, work)
    observe_estimate(m, p, table, observation, vx * p[k.PERIOD])
    return end


@compiled_in_place
def drive_under_conditions(
    m: Array, record: Array, a: Any, delta: Any, spec: Array, constants: Array, table: Array,
    observation: Array, key: Any, episode: Any, work: Array,
) -> int:  # fmt: skip
    """Drive one control period of an episode under conditions, in place; return its end's code."""
    bits = take_command(m, record, a, delta, spec, constants)
    period = constants[k.PERIOD]
    vehicle.advance_gust(
        m, key, episode, sensors.PERIOD_DRAW + sensors.DRAWS * (int(record[k.STEPS]) + 1), period
    )
    commands = m[layout.TAIL : layout.fixes_start(spec)]
    friction = m[layout.FRICTION] * vehicle.slipperiness(record, spec, constants)
    state = vehicle.drive_vehicle(
        m, commands, record, constants, record[k.STEPS] * period, friction
    )
    return end_period(
        m, record, state, bits, spec, constants, table, observation, key, episode, work
    )


@compiled_internal
def observe_estimate(
    m: Array, constants: Array, table: Array, observation: Array, ahead: Any
) -> None:
    """Project the estimate on the path, about `ahead` m further on, and observe from there."""
    # A fix may shift the estimate by more than the vehicle drives in a period.
    window = min(max(SEARCH_WINDOW, 1.5 * abs(ahead)), constants[k.LENGTH])
    k.locate_and_observe(
        m[layout.ESTIMATE : layout.TAIL], constants, table, observation, ahead, window
    )


@compiled
def begin_under_conditions(
    m: Array, record: Array, spec: Array, constants: Array, table: Array, observation: Array,
    draws: Array, given: Array, friction: Any,
) -> None:  # fmt: skip
    """Begin an episode under conditions: draw the conditions and the start.

    `draws` holds key and number of the episode, (2,) uint64; `given` is as in `episodes.begin`;
    `friction` is the plant's own, inf for the bicycle's.
    """
    key, episode = draws[0], draws[1]
    for j in range(m.shape[0]):
        m[j] = 0.0
    sensors.draw_conditions(m, spec, key, episode)
    drawn = m[layout.FRICTION]
    friction = min(drawn, friction) if max(drawn, friction) == math.inf else drawn * friction
    begin(record, constants, table, observation, key, episode, given, friction)
    for j in range(7):
        m[layout.PLANT + j] = constants[j]
    m[layout.PLANT] *= m[layout.MASS_FACTOR]
    m[layout.PLANT + 1] *= m[layout.INERTIA_FACTOR]
    m[layout.PLANT + 4] *= m[layout.FRONT_STIFFNESS_FACTOR]
    m[layout.PLANT + 5] *= m[layout.REAR_STIFFNESS_FACTOR]
    m[layout.PLANT + 6] *= m[layout.ROLLING_FACTOR]
    m[layout.LATENCY] = m[layout.OCCUPIED] = -1.0
    m[layout.SERVO_A], m[layout.SERVO_DELTA] = record[k.ACCELERATION], record[k.STEERING]
    m[layout.COMMAND_A], m[layout.COMMAND_DELTA] = record[k.ACCELERATION], record[k.STEERING]
    m[layout.TAIL] = 0.0
    m[layout.TAIL + 1], m[layout.TAIL + 2] = record[k.ACCELERATION], record[k.STEERING]
    m[layout.QUEUED] = 1.0
    sensors.begin_estimate(
        m, m[layout.filter_start(spec) :], record, key, episode, sensors.PERIOD_DRAW, spec
    )
    e = m[layout.ESTIMATE : layout.TAIL]
    e[k.ACCELERATION], e[k.STEERING] = record[k.ACCELERATION], record[k.STEERING]
    if spec[layout.ESTIMATOR] == layout.TRUTH:
        e[k.STEERING] += m[layout.STEERING_OFFSET]
    e[k.ARC_LENGTH] = record[k.ARC_LENGTH]
    observe_estimate(m, constants, table, observation, 0.0)


@compiled
def advance_under_conditions(
    data: Array, table: Array, m: Array, spec: Array, work: Array, draws: Array
) -> tuple[int, Any, Any, Any, Any, int, Any, Any, Any, Any, Any, Any, Any]:
    """Drive one period of a single environment in place, as `kernels.advance` does.

    `draws` holds key and number of the episode, (2,) uint64.
    """
    a, delta = data[0], data[1]
    c = data[k.RECORD : k.CONSTANTS]
    if math.isfinite(a) and math.isfinite(delta):
        end = drive_under_conditions(
            m, c, a, delta, spec, data[k.CONSTANTS : k.OBSERVATION], table,
            data[k.OBSERVATION :].view(np.float32), draws[0], draws[1], work,
        )  # fmt: skip
    else:
        end = k.NOT_FINITE
    j = k.TERMS
    return (
        end, c[k.ARC_LENGTH], c[k.LATERAL_ERROR], c[k.HEADING_ERROR], c[k.SPEED_ERROR],
        int(c[k.CLIPPED]), c[k.REWARD], c[j], c[j + 1], c[j + 2], c[j + 3], c[j + 4], c[j + 5],
    )  # fmt: skip


@compiled
def command_under_conditions(data: Array, m: Array, spec: Array) -> tuple[Any, Any, int]:
    """Begin a control period of a plant other than the bicycle.

    Returns the mean acceleration of the drive over the period (m/s^2), the angle of the wheels at
    its end (rad), and the clipping bits.
    """
    record, constants = data[k.RECORD : k.CONSTANTS], data[k.CONSTANTS : k.OBSERVATION]
    bits = take_command(m, record, data[0], data[1], spec, constants)
    commands = m[layout.TAIL : layout.fixes_start(spec)]
    substeps, now = int(constants[k.SUBSTEPS]), record[k.STEPS] * constants[k.PERIOD]
    h = constants[k.PERIOD] / substeps
    braking = vehicle.stop_acceleration(m, constants)
    m[layout.MEAN_A] = m[layout.MEAN_DELTA] = 0.0
    for i in range(substeps):
        a, delta = vehicle.advance_servos(m, commands, braking, now + i * h, h)
        m[layout.MEAN_A] += a / substeps
        m[layout.MEAN_DELTA] += delta / substeps
    return m[layout.MEAN_A], m[layout.SERVO_DELTA] + m[layout.STEERING_OFFSET], bits


@compiled
def conclude_under_conditions(
    data: Array, table: Array, m: Array, spec: Array, work: Array, draws: Array, state: Array,
    bits: int,
) -> int:  # fmt: skip
    """End a control period after which another plant has reached a `state` (6,)."""
    reached = (state[0], state[1], state[2], state[3], state[4], state[5])
    return end_period(
        m, data[k.RECORD : k.CONSTANTS], reached, bits, spec, data[k.CONSTANTS : k.OBSERVATION],
        table, data[k.OBSERVATION :].view(np.float32), draws[0], draws[1], work,
    )  # fmt: skip
