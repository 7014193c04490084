"""Compiled kernels of a vehicle under conditions: late commands, lags, friction, wind."""

import math
from typing import Any

from numpy.typing import NDArray

from lpv_track_env import kernels as k
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.conditions import WIND_LEVER, layout
from lpv_track_env.draws import gaussian
from lpv_track_env.integration import integrate_with
from lpv_track_env.tyres import compiled_constants
from trajectories.compilation import compiled, compiled_in_place, compiled_internal

Array = NDArray[Any]

AIR_DENSITY = 1.225
"""kg/m^3, standard atmosphere at sea level."""
GUST_DRAW = 32
"""Number of the gust's draw within a control period, see `conditions.sensors`."""
STOP_DECELERATION = 2.0
"""Deceleration of a controlled stop, m/s^2."""


def controlled_stop(rolling_deceleration: Any, max_jerk: Any, speed: Any) -> Any:
    """Return the acceleration command (m/s^2) that brakes from a speed >= 0 (m/s) to standstill.

    Half the jerk limit (m/s^3) brings deceleration and speed to zero at the same time.
    """
    return rolling_deceleration - min(STOP_DECELERATION, math.sqrt(max_jerk * speed))


compiled_controlled_stop = compiled_internal(controlled_stop)


@compiled_internal
def send_command(m: Array, commands: Array, now: Any, a: Any, delta: Any, offset: Any) -> None:
    """Queue a command made from readings at `now` (s), its steering angle less `offset` (rad)."""
    latency, occupied = m[layout.LATENCY], m[layout.OCCUPIED]
    if latency < 0.0:
        latency = m[layout.COMPUTING_DELAY]
    if occupied < 0.0:
        occupied = latency
    m[layout.FREE_AT] = now + occupied
    m[layout.COMMAND_A], m[layout.COMMAND_DELTA] = a, delta
    landing = now + latency
    room = commands.shape[0] // layout.COMMAND
    newest = int(m[layout.NEWEST])
    # A command that lands before earlier ones replaces them.
    while m[layout.QUEUED] > 1.0 and commands[newest * layout.COMMAND] >= landing:
        newest = (newest - 1 + room) % room
        m[layout.QUEUED] -= 1.0
    newest = (newest + 1) % room
    commands[newest * layout.COMMAND] = landing
    commands[newest * layout.COMMAND + 1] = a
    commands[newest * layout.COMMAND + 2] = delta - offset
    m[layout.NEWEST] = newest
    m[layout.QUEUED] = min(m[layout.QUEUED] + 1.0, float(room))


@compiled_internal
def mean_command(m: Array, commands: Array, entry: int, begins: Any, ends: Any) -> Any:
    """Return the mean of an entry (1: a, 2: delta) of the commands in force over a time, s."""
    room = commands.shape[0] // layout.COMMAND
    at, left = int(m[layout.NEWEST]), int(m[layout.QUEUED])
    total, end, value = 0.0, ends, 0.0
    while left > 0 and end > begins:
        value = commands[at * layout.COMMAND + entry]
        landing = commands[at * layout.COMMAND]
        if landing < end:
            start = max(landing, begins)
            total += (end - start) * value
            end = start
        at, left = (at - 1 + room) % room, left - 1
    if end > begins:
        total += (end - begins) * value
    return total / (ends - begins)


@compiled_internal
def advance_gust(m: Array, key: Any, episode: Any, draw: int, period: Any) -> None:
    """Advance the gust by a period (s): a stationary first-order Gauss-Markov process."""
    kept = math.exp(-period / m[layout.GUST_TIME])
    first, _ = gaussian(key, episode, draw + GUST_DRAW)
    m[layout.GUST] = (
        kept * m[layout.GUST] + m[layout.GUST_SPEED] * math.sqrt(1.0 - kept * kept) * first
    )


@compiled_internal
def side_wind(m: Array, vx: Any, vy: Any, psi: Any) -> tuple[Any, Any]:
    """Return the lateral (m/s^2) and yaw acceleration (rad/s^2) caused by the wind.

    F = rho/2 A |v| v_y with the air's velocity v in the body frame: the side force coefficient is
    proportional to the sine of the angle of the flow.
    """
    c, s = math.cos(psi), math.sin(psi)
    wind = m[layout.WIND_SPEED] + m[layout.GUST]
    wx, wy = wind * m[layout.WIND_X], wind * m[layout.WIND_Y]
    ahead, aside = c * wx + s * wy - vx, c * wy - s * wx - vy
    flow = math.sqrt(ahead * ahead + aside * aside)
    force = 0.5 * AIR_DENSITY * m[layout.SIDE_AREA] * flow * aside
    return force / m[layout.PLANT], force * WIND_LEVER / m[layout.PLANT + 1]


@compiled_internal
def command_age(m: Array, commands: Array, now: Any) -> Any:
    """Return the time since the command in force landed, s."""
    room = commands.shape[0] // layout.COMMAND
    at, left = int(m[layout.NEWEST]), int(m[layout.QUEUED])
    while left > 1 and commands[at * layout.COMMAND] > now:
        at, left = (at - 1 + room) % room, left - 1
    return now - commands[at * layout.COMMAND]


@compiled_internal
def stop_acceleration(m: Array, constants: Array) -> Any:
    """Return the acceleration (m/s^2) that brakes to a stop, within the jerk limit.

    The vehicle knows its speed from the estimate only.
    """
    speed = max(m[layout.ESTIMATE + VX], 0.0)
    jerk = constants[k.ACCELERATION_STEP] / constants[k.PERIOD]
    wanted = compiled_controlled_stop(constants[6], jerk, speed)
    return max(wanted, m[layout.SERVO_A] - constants[k.ACCELERATION_STEP])


@compiled_internal
def advance_servos(m: Array, commands: Array, braking: Any, begins: Any, h: Any) -> tuple[Any, Any]:
    """Advance the servos by h seconds; return the means of their outputs a and delta.

    The first-order lags are solved exactly; the integrator, which holds its inputs, takes the
    means. `braking` is the acceleration of a vehicle that brakes to a stop.
    """
    lag, ends, dead = m[layout.DRIVE_LAG], begins + h, m[layout.DRIVE_DEAD_TIME]
    kept = math.exp(-h / lag) if lag > 0.0 else 0.0
    wanted = (
        braking
        if m[layout.STOPPING] > 0.5
        else mean_command(m, commands, 1, begins - dead, ends - dead)
    )
    behind = m[layout.SERVO_A] - wanted
    a = wanted + behind * ((1.0 - kept) * lag / h)
    m[layout.SERVO_A] = wanted + behind * kept
    lag, dead = m[layout.STEERING_LAG], m[layout.STEERING_DEAD_TIME]
    kept = math.exp(-h / lag) if lag > 0.0 else 0.0
    wanted = mean_command(m, commands, 2, begins - dead, ends - dead)
    behind = m[layout.SERVO_DELTA] - wanted
    delta = wanted + behind * ((1.0 - kept) * lag / h)
    m[layout.SERVO_DELTA] = wanted + behind * kept
    return a, delta


@compiled
def slipperiness(record: Array, spec: Array, constants: Array) -> Any:
    """Return the factor of the friction where the vehicle is: 1 but on a slippery stretch."""
    s, length = record[k.ARC_LENGTH], constants[k.LENGTH]
    if constants[k.CLOSED] > 0.5:
        s -= length * math.floor(s / length)
    slippery = spec[layout.STRETCH_START] <= s < spec[layout.STRETCH_END]
    return spec[layout.STRETCH_FACTOR] if slippery else 1.0


@compiled_in_place
def drive_vehicle(
    m: Array, commands: Array, record: Array, constants: Array, now: Any, friction: Any
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Return the true state after a control period on a road of some friction.

    Writes servos and mean inputs into `m`.
    """
    p, q = constants, layout.PLANT
    substeps = int(p[k.SUBSTEPS])
    h = p[k.PERIOD] / substeps
    vx, vy, psi, r = record[VX], record[VY], record[PSI], record[YAW_RATE]
    x, y = record[X], record[Y]
    tyre = compiled_constants(friction, p[k.HEIGHT], m[q], m[q + 2], m[q + 3], m[q + 4], m[q + 5])
    total_a = total_delta = 0.0
    windy = m[layout.WIND_SPEED] > 0.0 or m[layout.GUST_SPEED] > 0.0
    braking = stop_acceleration(m, p)
    for i in range(substeps):
        a, delta = advance_servos(m, commands, braking, now + i * h, h)
        total_a += a
        total_delta += delta
        a /= m[layout.MASS_FACTOR]
        delta += m[layout.STEERING_OFFSET]
        push = spin = 0.0
        if windy:
            push, spin = side_wind(m, vx, vy, psi)
        # Half of the wind's impulse before the step and half after it: Strang splitting, order 2.
        vy += 0.5 * h * push
        r += 0.5 * h * spin
        vx, vy, psi, r, x, y = integrate_with(
            vx, vy, psi, r, x, y, a, delta,
            m[q], m[q + 1], m[q + 2], m[q + 3], m[q + 4], m[q + 5], m[q + 6], tyre, h, 1,
            p[k.LOWEST_SPEED],
        )  # fmt: skip
        vy += 0.5 * h * push
        r += 0.5 * h * spin
    m[layout.MEAN_A], m[layout.MEAN_DELTA] = total_a / substeps, total_delta / substeps
    return vx, vy, psi, r, x, y
