"""Delay compensation: an agent that is shown the near future, when its action will land."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import delay_kernels
from agents.base import Action, Agent, DrivingTask
from agents.reference import NODE
from lpv_track_env.bicycle import longest_substep
from lpv_track_env.conditions import Actuation
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]


@dataclass
class DelayMemory:
    """What compensation remembers of n vehicles, and what its agent does."""

    inner: Any
    commands: Array
    """Those sent, the last one first, (n, rows, 2)."""
    feet: Array
    """Pose of the foot point to which the last observation was moved, from the one it had."""

    def __len__(self) -> int:
        return len(self.commands)

    def __getitem__(self, row: int) -> "DelayRow":
        # Policies without memory hand back none.
        inner = None if self.inner is None else self.inner[row]
        return DelayRow(inner, self.feet[row])


@dataclass
class DelayRow:
    """One vehicle's part."""

    inner: Any
    foot: Array


class NearFuture:
    """Observations of n vehicles moved to the time at which their next action lands.

    The vehicle's state is driven on by the model over computing delay, dead time and lag of the
    steering, under the commands that are on their way (`agents.delay_kernels`). What it needs to
    know is nominal: the delays' and lags' middles, not the episode's.

    Parameters
    ----------
    task
        What is driven.
    actuation
        Delays and lags, s.
    model
        The vehicle as the prediction knows it; by default the task's.
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
            ]
        )
        self.kept = math.ceil(max(drive, steering) / task.control_period) + 1
        """Commands that must be remembered."""
        self._nodes = np.zeros((task.layout.preview_steps + 1, NODE))

    def memory(self, n: int) -> "DelayMemory":
        """Memory of n vehicles before their first observations."""
        return DelayMemory(None, np.zeros((n, self.kept, 2)), np.zeros((n, delay_kernels.FOOT)))

    def look(self, rows: Array, starts: NDArray[np.bool_], memory: "DelayMemory") -> None:
        """Move observations, rows (n, size) float64, in place; `starts` (n,) begin episodes."""
        # Before the first command the actuators have stood where they are.
        memory.commands[starts] = np.nan_to_num(rows[starts, None, 3:5], posinf=0.0, neginf=0.0)
        delay_kernels.look_ahead_all(rows, memory.commands, self.settings, self._nodes, memory.feet)

    @staticmethod
    def note(memory: "DelayMemory", actions: NDArray[Any] | None) -> None:
        """Remember the actions (n, 2) that were sent; None: nothing was, the last ones stay."""
        memory.commands[:, 1:] = memory.commands[:, :-1].copy()
        if actions is not None:
            memory.commands[:, 0] = actions


class DelayCompensated:
    """An agent whose actions land later: it decides on the observation of that time.

    Every agent can have it, see `NearFuture`.

    Parameters
    ----------
    agent
        Any agent.
    task
        What it was made for.
    actuation
        Delays and lags, s.
    model
        The vehicle as the prediction knows it; by default the task's.
    """

    def __init__(
        self,
        agent: Agent,
        task: DrivingTask,
        actuation: Actuation,
        model: VehicleParameters | None = None,
    ) -> None:
        self.agent, self.task, self.actuation = agent, task, actuation
        self.future = NearFuture(task, actuation, model)
        self._memory: DelayMemory | None = None

    def __getattr__(self, name: str) -> Any:
        if name == "agent":
            raise AttributeError(name)
        return getattr(self.agent, name)

    def reset(self) -> None:
        """Forget everything: the next call begins new episodes."""
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
        """Action (2,) for one observation (size,), or (n, 2) for a batch; and the memory."""
        given = np.asarray(observation)
        rows = np.array(np.atleast_2d(given), dtype=np.float64, order="C")
        self.task.layout.unpack(rows)
        n = len(rows)
        memory = self._memory if state is None else state
        starts = np.zeros(n, dtype=np.bool_)
        if episode_start is not None:
            starts |= np.broadcast_to(np.asarray(episode_start, dtype=bool), (n,))
        if memory is None or len(memory) != n:
            memory = self.future.memory(n)
            starts[:] = True
        if state is None:
            self._memory = memory
        self.future.look(rows, starts, memory)
        seen = rows[0] if given.ndim == 1 else rows
        action, memory.inner = self.agent.predict(seen, memory.inner, starts, deterministic)
        self.future.note(memory, np.atleast_2d(action))
        return action, memory

    def hold(self, memory: DelayMemory | None = None) -> None:
        """Let a control period pass in which nothing was computed: the last command stays."""
        held = self._memory if memory is None else memory
        if held is not None:
            self.future.note(held, None)

    def diagnostics(self, memory: DelayRow) -> dict[str, Any]:
        """What the agent tells of its last step, its plan moved to where it belongs."""
        explain = getattr(self.agent, "diagnostics", None)
        told: dict[str, Any] = {} if explain is None else explain(memory.inner)
        if told.get("plan") is not None:
            told = {**told, "plan": moved_plan(told["plan"], memory.foot)}
        return told


def moved_plan(plan: Array, foot: Array) -> Array:
    """Positions (n, 2) in the frame of a foot point, in that from which its pose (3,) is seen."""
    x, y, heading = foot
    c, s = math.cos(heading), math.sin(heading)
    moved: Array = plan @ np.array([[c, s], [-s, c]]) + np.array([x, y])
    return moved
