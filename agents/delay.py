"""Delay compensation: an agent observes the near future, when its action will take effect.

A command takes effect after the computing time, the dead time of its actuator and, as far as a
first-order lag acts like a dead time, the lag. The model drives the vehicle on under the commands
that are on their way, the foot point follows, and the preview is recomputed from there. The
prediction is made for the time of the steering; if the drive is slower, its pending change of speed
is added to the speed, as the speed error that it will cause.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Action, Agent, DrivingTask
from agents.inputs import memory_of, observation_rows, saturate_row, started_rows
from agents.reference import (
    NODE,
    NODE_ARC_LENGTH,
    NODE_HEADING,
    NODE_SPEED,
    NODE_X,
    NODE_Y,
    fill_nodes,
)
from agents.wrappers import AgentAround
from lpv_track_env import observation as entry
from lpv_track_env import tyres
from lpv_track_env.bicycle import longest_substep
from lpv_track_env.conditions import Actuation
from lpv_track_env.integration import integrate_with
from lpv_track_env.kernels import wrap
from lpv_track_env.vehicle import VehicleParameters
from trajectories.compilation import compiled, compiled_internal

Array = NDArray[Any]

# Settings of the prediction, (SETTINGS,) float64: times in s, then the model's 7 parameters, its
# lowest speed (m/s) and the constants of its tyres (`tyres.constants`).
(
    DRIVE_DELAY, DRIVE_LAG, STEERING_DELAY, STEERING_LAG, HORIZON, DRIVE_HORIZON, PERIOD,
    PREVIEW_PERIOD, SUBSTEP,
) = range(9)  # fmt: skip
MODEL = 9
LOWEST_SPEED = MODEL + 7
TYRE = LOWEST_SPEED + 1
SETTINGS = TYRE + 6

FOOT = 3
"""Pose of the new foot point in the frame of the old one: x, y, heading."""


@compiled_internal
def sent(commands: Array, column: int, age: Any, period: Any) -> Any:
    """Column of the latest command `age` seconds ago; the one in row 0 was sent a period ago.

    A negative age gives the last command, held.
    """
    row = math.floor(age / period - 1e-9)
    return commands[min(max(row, 0), commands.shape[0] - 1), column]


@compiled_internal
def drive_on(
    vx: Any, vy: Any, psi: Any, r: Any, x: Any, y: Any, a: Any, delta: Any, begins: Any, ends: Any,
    commands: Array, p: Array,
) -> tuple[Any, Any, Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """Drive state and actuators on from one time to another under the commands on their way."""
    if not ends > begins:
        return vx, vy, psi, r, x, y, a, delta
    steps = max(math.ceil((ends - begins) / p[SUBSTEP] - 1e-9), 1)
    h = (ends - begins) / steps
    kept_a = math.exp(-h / p[DRIVE_LAG]) if p[DRIVE_LAG] > 0.0 else 0.0
    kept_delta = math.exp(-h / p[STEERING_LAG]) if p[STEERING_LAG] > 0.0 else 0.0
    m, t = MODEL, TYRE
    tyre = p[t], p[t + 1], p[t + 2], p[t + 3], p[t + 4], p[t + 5]
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
        vx, vy, psi, r, x, y = integrate_with(
            vx, vy, psi, r, x, y, mean_a, mean_delta,
            p[m], p[m + 1], p[m + 2], p[m + 3], p[m + 4], p[m + 5], p[m + 6], tyre, h, 1,
            p[LOWEST_SPEED],
        )  # fmt: skip
    return vx, vy, psi, r, x, y, a, delta


@compiled_internal
def speed_of(nodes: Array, intervals: Any) -> Any:
    """Reference speed at a number of intervals after the first node."""
    steps = nodes.shape[0] - 1
    k = min(max(math.floor(intervals), 0), steps - 1)
    share = min(intervals - k, 1.0)
    return nodes[k, NODE_SPEED] + share * (nodes[k + 1, NODE_SPEED] - nodes[k, NODE_SPEED])


@compiled_internal
def point_on(nodes: Array, k: int, arc: Any) -> tuple[Any, Any, Any]:
    """Point of interval k, an arc, at an arc length from its node: x, y, heading."""
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
    """Recompute the preview from a share of interval k on, extrapolated beyond its end."""
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
            o[entry.REFERENCE_SPEED] = next_speed
        else:
            gone = 0.5 * (speed + next_speed) * period
            turned = next_heading - heading
            o[entry.PREVIEW_START + j - 1] = turned / gone if gone > 1e-9 else last_curvature
            o[entry.PREVIEW_START + steps + j - 1] = next_speed
        heading, speed = next_heading, next_speed


@compiled_internal
def predict_observation(
    o: Array, commands: Array, p: Array, nodes: Array, foot_point: Array
) -> None:
    """Predict a finite observation (size,) in place to the time at which the action takes effect.

    `commands` (rows, 2) are those sent, the last one first; `nodes` is working space;
    `foot_point` (FOOT,) receives the pose of the new foot point in the frame of the old one.
    """
    steps = nodes.shape[0] - 1
    fill_nodes(
        o[entry.PREVIEW_START : entry.PREVIEW_START + steps], o[entry.REFERENCE_SPEED],
        o[entry.PREVIEW_START + steps :], p[PREVIEW_PERIOD], nodes,
    )  # fmt: skip
    vx, vy, psi, r, x, y, a, delta = drive_on(
        o[entry.LONGITUDINAL_SPEED], o[entry.LATERAL_SPEED], o[entry.HEADING_ERROR],
        o[entry.YAW_RATE], 0.0, o[entry.LATERAL_ERROR], o[entry.ACCELERATION],
        o[entry.STEERING_ANGLE], 0.0, p[HORIZON], commands, p,
    )  # fmt: skip
    # Find the interval of the foot point: go on while the vehicle is past an interval's end.
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
    foot_point[0], foot_point[1], foot_point[2] = fx, fy, heading
    # Share of the interval in time; the speed is linear in time.
    before, after = nodes[k, NODE_SPEED], nodes[k + 1, NODE_SPEED]
    period, share = p[PREVIEW_PERIOD], 0.0
    if arc > 0.0:
        root = before * before + 2.0 * (after - before) * arc / period
        speed = before + math.sqrt(max(root, 0.0))
        if speed > 1e-9:
            share = min(2.0 * arc / (speed * period), 1.0)
    later = 0.0
    if p[DRIVE_HORIZON] > p[HORIZON]:
        # The drive is slower than the steering: its pending change of speed becomes a speed error.
        further = drive_on(
            vx, vy, psi, r, x, y, a, delta, p[HORIZON], p[DRIVE_HORIZON], commands, p
        )
        beyond = k + share + (p[DRIVE_HORIZON] - p[HORIZON]) / period
        later = (further[0] - vx) - (speed_of(nodes, beyond) - speed_of(nodes, k + share))
    o[entry.LONGITUDINAL_SPEED], o[entry.LATERAL_SPEED] = vx + later, vy
    o[entry.YAW_RATE] = r
    # Rate limits of the next input start from the last command.
    o[entry.ACCELERATION], o[entry.STEERING_ANGLE] = commands[0, 0], commands[0, 1]
    o[entry.LATERAL_ERROR] = (y - fy) * math.cos(heading) - (x - fx) * math.sin(heading)
    o[entry.HEADING_ERROR] = wrap(psi - heading)
    shift_preview(o, nodes, k, share, period)
    saturate_row(o)


@compiled
def predict_observations(
    observations: Array, commands: Array, settings: Array, nodes: Array, foot_points: Array
) -> None:
    """`predict_observation` for rows (n, size), in place; rows that are not finite stay.

    A last command that is not finite becomes what the actuators do.
    """
    for row in range(observations.shape[0]):
        total = 0.0
        for j in range(observations.shape[1]):
            total += abs(observations[row, j])
        foot_points[row, 0] = foot_points[row, 1] = foot_points[row, 2] = 0.0
        for j in range(2):
            if not math.isfinite(commands[row, 0, j]):  # no command that an actuator follows
                commands[row, 0, j] = observations[row, entry.ACCELERATION + j]
        if math.isfinite(total):
            predict_observation(observations[row], commands[row], settings, nodes, foot_points[row])


@dataclass
class DelayMemory:
    """Memory of n vehicles of the delay compensation and its agent."""

    inner: Any
    """The agent's memory."""
    commands: Array
    """Commands sent, the last one first, (n, rows, 2)."""
    foot_points: Array
    """Pose of the predicted foot point in the frame of the observed one, (n, FOOT)."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the arrays, without the number of vehicles."""
        return self.commands.shape[1:]

    def __len__(self) -> int:
        return len(self.commands)

    def __getitem__(self, row: int) -> "DelayRow":
        # Policies without memory return None.
        inner = None if self.inner is None else self.inner[row]
        return DelayRow(inner, self.foot_points[row])


@dataclass
class DelayRow:
    """One vehicle's row of a `DelayMemory`."""

    inner: Any
    foot_point: Array


class NearFuture:
    """Predictor of observations to the time at which the next action takes effect.

    It only uses nominal delays, lags and friction, the centres of their ranges, not those of the
    episode.

    Parameters
    ----------
    task
        Task of the agent.
    actuation
        Delays and lags, s.
    model
        Vehicle model of the prediction; by default the task's vehicle.
    """

    def __init__(
        self, task: DrivingTask, actuation: Actuation, model: VehicleParameters | None = None
    ) -> None:
        vehicle = model or task.vehicle
        drive = actuation.computing_delay + actuation.drive_dead_time
        steering = actuation.computing_delay + actuation.steering_dead_time
        self.settings = np.array(
            [
                drive,
                actuation.drive_lag,
                steering,
                actuation.steering_lag,
                steering + actuation.steering_lag,
                drive + actuation.drive_lag,
                task.control_period,
                task.layout.preview_period,
                longest_substep(vehicle),
                *vehicle.as_array(),
                vehicle.lowest_speed,
                *tyres.of(vehicle, task.friction),
            ]
        )
        self.kept = math.ceil(max(drive, steering) / task.control_period) + 1
        """Number of commands that must be kept."""
        self._nodes = np.zeros((task.layout.preview_steps + 1, NODE))

    def memory(self, n: int) -> "DelayMemory":
        """Create the memory of n vehicles before their first observations."""
        return DelayMemory(None, np.zeros((n, self.kept, 2)), np.zeros((n, FOOT)))

    def predict(self, rows: Array, starts: NDArray[np.bool_], memory: "DelayMemory") -> None:
        """Predict observations, rows (n, size) float64, in place; `starts` (n,) begin episodes."""
        # Before the first command the actuators have held their positions.
        actuators = rows[starts][:, None, [entry.ACCELERATION, entry.STEERING_ANGLE]]
        memory.commands[starts] = np.nan_to_num(actuators, posinf=0.0, neginf=0.0)
        predict_observations(rows, memory.commands, self.settings, self._nodes, memory.foot_points)

    @staticmethod
    def record(memory: "DelayMemory", actions: NDArray[Any] | None) -> None:
        """Record the actions (n, 2) that were sent; None repeats the last ones."""
        memory.commands[:, 1:] = memory.commands[:, :-1].copy()
        if actions is not None:
            memory.commands[:, 0] = actions


class DelayCompensated(AgentAround):
    """Any agent with delay compensation: it acts on predicted observations, see `NearFuture`.

    Parameters
    ----------
    agent
        The agent.
    task
        Its task.
    actuation
        Delays and lags, s.
    """

    def __init__(self, agent: Agent, task: DrivingTask, actuation: Actuation) -> None:
        super().__init__(agent)
        self.task, self.actuation = task, actuation
        self.future = NearFuture(task, actuation)
        self._memory: DelayMemory | None = None
        self._blank = self.future.memory(0)

    def reset(self) -> None:
        """Clear the memory: the next call begins new episodes."""
        self._memory = None
        forget = getattr(self.agent, "reset", None)
        if forget is not None:
            forget()

    def predict(
        self,
        observation: NDArray[Any],
        state: DelayMemory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Action, DelayMemory]:
        """Return the action (2,) for one observation (size,), or (n, 2) for a batch; and memory.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout.
        TypeError
            If `state` is not the memory of such an agent.
        """
        rows = observation_rows(observation, self.task.layout.size)
        kept = self._memory
        memory = memory_of(state, kept, len(rows), self._blank, self.future.memory)
        starts = np.zeros(len(rows), dtype=np.bool_)
        starts[started_rows(episode_start, len(rows))] = True
        if memory is not state and memory is not kept:
            starts[:] = True
        if state is None:
            self._memory = memory
        self.future.predict(rows, starts, memory)
        shown = rows[0] if np.ndim(observation) == 1 else rows
        action, memory.inner = self.agent.predict(shown, memory.inner, starts, deterministic)
        self.future.record(memory, np.atleast_2d(action))
        return action, memory

    def hold(self, memory: DelayMemory | None = None) -> None:
        """Let a control period pass without a computation: the last command stays in force."""
        held = self._memory if memory is None else memory
        if held is not None:
            self.future.record(held, None)

    def diagnostics(self, memory: DelayRow) -> dict[str, Any]:
        """Return the agent's diagnostics, its plan in the frame of the observed foot point."""
        explain = getattr(self.agent, "diagnostics", None)
        found: dict[str, Any] = {} if explain is None else explain(memory.inner)
        if found.get("plan") is not None:
            found = {**found, "plan": moved_plan(found["plan"], memory.foot_point)}
        return found


def moved_plan(plan: Array, foot_point: Array) -> Array:
    """Transform positions (n, 2) from a foot point's frame to that of its pose (3,)."""
    x, y, heading = foot_point
    c, s = math.cos(heading), math.sin(heading)
    moved: Array = plan @ np.array([[c, s], [-s, c]]) + np.array([x, y])
    return moved
