"""Compiled kernels: the observation as it will be when an action lands.

A command acts after the computing time, the dead time and, as far as a first-order lag can be
taken for one, the lag of its actuator. The vehicle is driven on by the model under the commands
that are on their way, its foot point follows, and the preview is read anew from there: an
observation like any other, that of the near future. Its time is that of the steering; what a
slower drive has on its way beyond it is added to the speed, as the error that it will leave.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.reference import NODE_ARC_LENGTH, NODE_HEADING, NODE_SPEED, NODE_X, NODE_Y, fill_nodes
from lpv_track_env.integration import integrate
from lpv_track_env.kernels import wrap
from lpv_track_env.observation import PREVIEW_START
from trajectories.compilation import compiled, compiled_internal

Array = NDArray[Any]

# What the prediction is told, (SETTINGS,) float64: times in s, then the model's 7 parameters.
(
    DRIVE_DELAY, DRIVE_LAG, STEERING_DELAY, STEERING_LAG, HORIZON, DRIVE_HORIZON, PERIOD,
    PREVIEW_PERIOD, SUBSTEP,
) = range(9)  # fmt: skip
MODEL = 9
SETTINGS = MODEL + 7

FOOT = 3
"""Pose of the new foot point in the frame of the old one: x, y, heading."""


@compiled_internal
def sent(commands: Array, entry: int, age: Any, period: Any) -> Any:
    """Entry of the command that was the last one `age` seconds ago; row 0 was sent a period ago.

    Negative ages ask for what is not sent yet: the last command, held.
    """
    row = math.floor(age / period - 1e-9)
    return commands[min(max(row, 0), commands.shape[0] - 1), entry]


@compiled_internal
def drive_on(
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any, begins: Any, ends: Any,
    commands: Array, p: Array,
) -> tuple[Any, Any, Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """State and actuators driven on from one time to another under the commands on their way."""
    if not ends > begins:
        return vx, vy, psi, r, x, y, a, delta
    steps = max(math.ceil((ends - begins) / p[SUBSTEP] - 1e-9), 1)
    h = (ends - begins) / steps
    kept_a = math.exp(-h / p[DRIVE_LAG]) if p[DRIVE_LAG] > 0.0 else 0.0
    kept_delta = math.exp(-h / p[STEERING_LAG]) if p[STEERING_LAG] > 0.0 else 0.0
    m = MODEL
    for i in range(steps):
        # At time t a command sent at t - delay, so `delay - t` ago, comes into force.
        middle = begins + (i + 0.5) * h
        wanted_a = sent(commands, 0, p[DRIVE_DELAY] - middle, p[PERIOD])
        wanted_delta = sent(commands, 1, p[STEERING_DELAY] - middle, p[PERIOD])
        mean_a = wanted_a + (a - wanted_a) * ((1.0 - kept_a) * p[DRIVE_LAG] / h)
        mean_delta = wanted_delta + (delta - wanted_delta) * (
            (1.0 - kept_delta) * p[STEERING_LAG] / h
        )
        a = wanted_a + (a - wanted_a) * kept_a
        delta = wanted_delta + (delta - wanted_delta) * kept_delta
        vx, vy, psi, r, x, y = integrate(
            vx, vy, psi, r, x, y, mean_a, mean_delta,
            p[m], p[m + 1], p[m + 2], p[m + 3], p[m + 4], p[m + 5], p[m + 6], h, 1,
        )  # fmt: skip
    return vx, vy, psi, r, x, y, a, delta


@compiled_internal
def speed_of(nodes: Array, intervals: Any) -> Any:
    """Reference speed so many intervals after the first node."""
    steps = nodes.shape[0] - 1
    k = min(math.floor(intervals), steps - 1)
    share = min(intervals - k, 1.0)
    return nodes[k, NODE_SPEED] + share * (nodes[k + 1, NODE_SPEED] - nodes[k, NODE_SPEED])


@compiled_internal
def point_on(nodes: Array, k: int, arc: Any) -> tuple[Any, Any, Any]:
    """Point of interval k (an arc) at an arc length from its node: x, y, heading."""
    length = nodes[k + 1, NODE_ARC_LENGTH] - nodes[k, NODE_ARC_LENGTH]
    turn = nodes[k + 1, NODE_HEADING] - nodes[k, NODE_HEADING]
    if length > 1e-9:
        turn *= arc / length
    half = 0.5 * turn
    chord = arc if abs(half) < 1e-9 else arc * math.sin(half) / half
    heading = nodes[k, NODE_HEADING]
    return (
        nodes[k, NODE_X] + chord * math.cos(heading + half),
        nodes[k, NODE_Y] + chord * math.sin(heading + half),
        heading + turn,
    )


@compiled_internal
def shift_preview(o: Array, nodes: Array, k: int, share: Any, period: Any) -> None:
    """Read the preview anew from a share of interval k on; beyond its end it goes on as it ends."""
    steps = nodes.shape[0] - 1
    last_curvature = 0.0
    length = nodes[steps, NODE_ARC_LENGTH] - nodes[steps - 1, NODE_ARC_LENGTH]
    if length > 1e-9:
        turn = nodes[steps, NODE_HEADING] - nodes[steps - 1, NODE_HEADING]
        last_curvature = turn / length
    heading = speed = 0.0
    for j in range(steps + 1):
        at = k + j
        if at < steps:
            before, after = nodes[at, NODE_SPEED], nodes[at + 1, NODE_SPEED]
            part = share * period * (before + 0.5 * share * (after - before))
            whole = nodes[at + 1, NODE_ARC_LENGTH] - nodes[at, NODE_ARC_LENGTH]
            turn = nodes[at + 1, NODE_HEADING] - nodes[at, NODE_HEADING]
            next_heading = nodes[at, NODE_HEADING]
            if whole > 1e-9:
                next_heading += turn * part / whole
            next_speed = before + share * (after - before)
        else:
            next_speed = nodes[steps, NODE_SPEED]
            beyond = (at - steps + share) * period * next_speed
            next_heading = nodes[steps, NODE_HEADING] + last_curvature * beyond
        if j == 0:
            o[7] = next_speed
        else:
            gone = 0.5 * (speed + next_speed) * period
            turned = next_heading - heading
            o[PREVIEW_START + j - 1] = turned / gone if gone > 1e-9 else last_curvature
            o[PREVIEW_START + steps + j - 1] = next_speed
        heading, speed = next_heading, next_speed


@compiled_internal
def look_ahead(o: Array, commands: Array, p: Array, nodes: Array, foot: Array) -> None:
    """Turn one finite observation (size,) into that of the time at which an action lands.

    `commands` (rows, 2) are those sent, the last one first; `nodes` is working space; `foot`
    (FOOT,) gets the new foot point's pose in the frame of the old one.
    """
    steps = nodes.shape[0] - 1
    fill_nodes(
        o[PREVIEW_START : PREVIEW_START + steps], o[7], o[PREVIEW_START + steps :],
        p[PREVIEW_PERIOD], nodes,
    )  # fmt: skip
    vx, vy, psi, r, x, y, a, delta = drive_on(
        o[0], o[1], o[6], o[2], 0.0, o[5], o[3], o[4], 0.0, p[HORIZON], commands, p
    )
    # Foot point: from interval to interval while the vehicle is past the end of one.
    k = 0
    while k < steps - 1:
        heading = nodes[k + 1, NODE_HEADING]
        past = (x - nodes[k + 1, NODE_X]) * math.cos(heading)
        past += (y - nodes[k + 1, NODE_Y]) * math.sin(heading)
        if past < 0.0:
            break
        k += 1
    arc = 0.0
    fx = fy = heading = 0.0
    for _ in range(4):
        fx, fy, heading = point_on(nodes, k, arc)
        ahead = (x - fx) * math.cos(heading) + (y - fy) * math.sin(heading)
        arc += ahead
    length = nodes[k + 1, NODE_ARC_LENGTH] - nodes[k, NODE_ARC_LENGTH]
    arc = min(max(arc, 0.0), length)
    fx, fy, heading = point_on(nodes, k, arc)
    foot[0], foot[1], foot[2] = fx, fy, heading
    # Share of the interval's time: the speed is linear in it.
    before, after = nodes[k, NODE_SPEED], nodes[k + 1, NODE_SPEED]
    period, share = p[PREVIEW_PERIOD], 0.0
    if arc > 0.0:
        root = before * before + 2.0 * (after - before) * arc / period
        speed = before + math.sqrt(max(root, 0.0))
        if speed > 1e-9:
            share = min(2.0 * arc / (speed * period), 1.0)
    later = 0.0
    if p[DRIVE_HORIZON] > p[HORIZON]:
        # The drive is slower than the steering: what it has on its way shows as an error of speed.
        further = drive_on(
            vx, vy, psi, r, x, y, a, delta, p[HORIZON], p[DRIVE_HORIZON], commands, p
        )
        beyond = k + share + (p[DRIVE_HORIZON] - p[HORIZON]) / period
        later = (further[0] - vx) - (speed_of(nodes, beyond) - speed_of(nodes, k + share))
    o[0], o[1], o[2] = vx + later, vy, r
    # The next input is held to the rates from the last command on.
    o[3], o[4] = commands[0, 0], commands[0, 1]
    o[5] = (y - fy) * math.cos(heading) - (x - fx) * math.sin(heading)
    o[6] = wrap(psi - heading)
    shift_preview(o, nodes, k, share, period)


@compiled
def look_ahead_all(
    observations: Array, commands: Array, settings: Array, nodes: Array, feet: Array
) -> None:
    """`look_ahead` for rows of observations (n, size), in place; others than finite stay."""
    for row in range(observations.shape[0]):
        total = 0.0
        for j in range(observations.shape[1]):
            total += abs(observations[row, j])
        feet[row, 0] = feet[row, 1] = feet[row, 2] = 0.0
        if math.isfinite(total):
            look_ahead(observations[row], commands[row], settings, nodes, feet[row])
