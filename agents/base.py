"""Interface of all agents: `predict`, as in the policies of Stable-Baselines3.

Anything with `predict(observation, state, episode_start, deterministic) -> (action, state)` can
drive: in SB3's `evaluate_policy`, in this project's rollouts and in its reports. Subclass
`TrackingAgent` to write an agent as one method, `control`, for a single vehicle.
"""

import math
import os
import reprlib
import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from agents.inputs import foreign, observation_rows, started_rows
from agents.wrappers import beneath
from lpv_track_env.conditions import Actuation
from lpv_track_env.conditions.vehicle import controlled_stop
from lpv_track_env.observation import ObservationLayout, TrackingObservation
from lpv_track_env.task import checked_period
from lpv_track_env.tyres import FRICTION
from lpv_track_env.validation import two_numbers
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath
from trajectories.arguments import instance_of, shortened

Action = NDArray[np.float32]
Memory = TypeVar("Memory")

CHECKPOINTS = Path(__file__).parent / "checkpoints"
"""Folder of the policies that come with this project: NAME.json for the agent NAME."""

NO_DELAYS = Actuation()


class Agent(Protocol):
    """Protocol of everything that drives."""

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """Return actions [a m/s^2, delta rad], and the agent's memory after them.

        Parameters
        ----------
        observation
            One observation (size,), or a batch (n, size).
        state
            Memory that the last call returned; None uses the one kept in the agent.
        episode_start
            (n,) bool, True for rows in which a new episode begins.
        deterministic
            Part of SB3's protocol: no exploration noise.
        """
        ...


@dataclass(frozen=True)
class DrivingTask:
    """Knowledge that an agent has at design time: vehicle, periods, action bounds.

    `path` is for rules that derive settings from the whole path (the paper's choice of weights).
    While driving, an agent uses observations only.

    Raises
    ------
    ValueError
        For a field of another type, or an invalid period.
    """

    layout: ObservationLayout
    vehicle: VehicleParameters
    control_period: float
    path: ReferencePath
    actuation: Actuation = NO_DELAYS
    """Nominal delays and lags between a command and its effect, s."""
    friction_range: tuple[float, float] = (math.inf, math.inf)
    """Least and largest friction of tyres and road, inf without a limit."""

    def __post_init__(self) -> None:
        kinds = {
            "layout": ObservationLayout, "vehicle": VehicleParameters, "path": ReferencePath,
            "actuation": Actuation,
        }  # fmt: skip
        for name, kind in kinds.items():
            instance_of(name, getattr(self, name), kind, f"of type {kind.__name__}")
        object.__setattr__(self, "control_period", checked_period(self.control_period))
        ends = tuple(FRICTION.of("friction", end) for end in self.friction_range)
        object.__setattr__(self, "friction_range", ends)

    @property
    def friction(self) -> float:
        """Nominal friction of tyres and road: the middle of its range, inf without a limit."""
        return 0.5 * sum(self.friction_range)

    @property
    def delayed(self) -> bool:
        """True if the actuation has any delay or lag."""
        return any(time > 0.0 for time in self.actuation)

    @property
    def action_bounds(self) -> tuple[Action, Action]:
        """Lower and upper bound of the action space, (2,) float32 [m/s^2, rad]."""
        low, high = self.vehicle.acceleration_range
        limit = self.vehicle.max_steering_angle
        return np.array([low, -limit], np.float32), np.array([high, limit], np.float32)

    @classmethod
    def of(cls, env: gymnasium.Env[Any, Any]) -> "DrivingTask":
        """Collect the task from an environment, wrapped or not.

        Raises
        ------
        TypeError
            If it is not a path tracking environment.
        ValueError
            Behind a wrapper that changes observations or actions (`agents.wrappers`).
        """
        env, rescaling = beneath(env)
        if rescaling:
            raise ValueError(
                "RescaleAction changes actions: agents.make(name, env) undoes it for the agent, "
                "DrivingTask.of(env) cannot"
            )
        names = ("layout", "vehicle", "control_period", "path", "actuation", "friction_range")
        try:
            return cls(*(env.get_wrapper_attr(name) for name in names))
        except AttributeError as error:
            raise TypeError(
                f"{type(getattr(env, 'unwrapped', env)).__name__} is not a path tracking "
                f"environment: {shortened(error)}"
            ) from None


def checked_task(task: object) -> DrivingTask:
    """Return a task; raise a TypeError for anything else, such as the environment itself."""
    if not isinstance(task, DrivingTask):
        raise TypeError(
            f"task must be a DrivingTask, not {type(task).__name__}: agents.make(name, env) makes "
            "it of an environment, DrivingTask.of(env) alone"
        )
    return task


def check_compatible(
    name: str,
    task: DrivingTask,
    *,
    layout: ObservationLayout,
    control_period: float,
    vehicle: object = None,
    stacklevel: int = 3,
) -> None:
    """Check that a policy made for a layout and a control period (s) fits a task.

    It warns if the policy was trained on another vehicle, given by name; `stacklevel` as in
    `warnings.warn`.

    Raises
    ------
    ValueError
        Naming the policy and the difference.
    """
    here = task.layout
    same_layout = layout.preview_steps == here.preview_steps and math.isclose(
        layout.preview_period, here.preview_period, rel_tol=1e-9
    )
    same_period = math.isclose(control_period, task.control_period, rel_tol=1e-9)
    preview = f"preview_steps={layout.preview_steps}, preview_period={layout.preview_period:g}"
    period = f"control_period={control_period:g}"
    if not same_layout:
        wanted = preview if same_period else f"{preview}, {period}"
        raise ValueError(
            f"{name} sees {preview} s; this environment has {here.preview_steps} and "
            f"{here.preview_period:g}: make the environment with {wanted}, or train one for it"
        )
    if not same_period:
        raise ValueError(
            f"{name} acts every {control_period:g} s, this environment every "
            f"{task.control_period:g}: make the environment with {period}, or train one for it"
        )
    check_vehicle(name, task, vehicle, stacklevel=stacklevel + 1)


def check_vehicle(
    name: str, task: DrivingTask, vehicle: object, *, how: str = "trained", stacklevel: int = 3
) -> None:
    """Warn if what has been trained or tuned for a vehicle drives another one.

    `vehicle` is its name, or a list of names.
    """
    vehicles = [vehicle] if isinstance(vehicle, str) else vehicle
    if isinstance(vehicles, list) and task.vehicle.name not in vehicles:
        # Results hold warnings: a shipped policy is named without this installation's folder.
        shown = name.replace(f"{CHECKPOINTS}{os.sep}", "")
        warnings.warn(
            f"{shown} was {how} for vehicle {', '.join(map(repr, vehicles))}, not for "
            f"{task.vehicle.name!r}",
            UserWarning,
            stacklevel=stacklevel,
        )


def stopping_acceleration(vehicle: VehicleParameters, speed: float) -> float:
    """Acceleration command (m/s^2) of a controlled stop from a speed (m/s), down to standstill."""
    # With an unknown speed the vehicle coasts: braking blindly would end in reverse.
    speed = max(speed, 0.0) if math.isfinite(speed) else 0.0
    command: float = controlled_stop(vehicle.rolling_deceleration, vehicle.max_jerk, speed)
    return command


def blind_control(
    vehicle: VehicleParameters, observation: TrackingObservation
) -> tuple[float, float]:
    """Return inputs (m/s^2, rad) for an observation that is not finite: hold the steering and stop.

    Its speed and steering angle are used if they are finite.
    """
    speed, steering = float(observation.longitudinal_speed), float(observation.steering_angle)
    return (
        stopping_acceleration(vehicle, speed),
        steering if math.isfinite(steering) else 0.0,
    )


class TrackingAgent(ABC, Generic[Memory]):
    """Base class of agents that are written as `control`, for one vehicle and one observation.

    Each row of a batch has its own memory, which is renewed where `episode_start` is True.
    `control_blind` acts in place of `control` on observations with NaN or infinite entries; finite
    entries saturate at the bounds of the layout. Inputs that are not finite are replaced by a
    controlled stop; the first one is told by a warning, `replaced_actions` counts all.

    Raises
    ------
    TypeError
        If `task` is not a `DrivingTask`.
    """

    def __init__(self, task: DrivingTask) -> None:
        self.task = checked_task(task)
        self.replaced_actions = 0
        self._low, self._high = task.action_bounds
        self._memories: list[Memory] = []
        self._memory_types: set[type] = set()

    @abstractmethod
    def control(self, observation: TrackingObservation, memory: Memory) -> tuple[float, float]:
        """Return acceleration (m/s^2) and steering angle (rad); may change the memory."""

    def control_blind(
        self,
        observation: TrackingObservation,
        memory: Memory,  # noqa: ARG002  for subclasses
    ) -> tuple[float, float]:
        """Return inputs for an observation that is not finite: hold the steering and stop.

        The memory is not changed: one NaN in an integrator would never leave it.
        """
        return blind_control(self.task.vehicle, observation)

    @abstractmethod
    def new_memory(self) -> Memory:
        """Return the memory of a vehicle at the start of an episode."""

    def diagnostics(self, memory: Memory) -> dict[str, Any]:  # noqa: ARG002  for subclasses
        """Return details of the last step for one vehicle; empty if there are none.

        Known entries: status, seconds, iterations, cost, slack (3,), fallback, weights (12,) Q, S,
        R, R_rate in use, plan (N + 1, 2) of predicted positions in the frame of the path's foot
        point.
        """
        return {}

    def reset(self) -> None:
        """Discard all memories: the next call begins new episodes."""
        self._memories = []

    def predict(
        self,
        observation: NDArray[Any],
        state: list[Memory] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002  part of the protocol
    ) -> tuple[Action, list[Memory]]:
        """Return the action (2,) for one observation (size,), or (n, 2) for a batch; and memories.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout, or an input has a wrong type.
        TypeError
            If `state` is not this agent's memory.
        """
        rows = observation_rows(observation, self.task.layout.size)
        memories = self._memories if state is None else self._own(state)
        started = started_rows(episode_start, len(rows))
        if len(memories) != len(rows):
            memories = [self._made_memory() for _ in rows]
        elif started:
            memories = memories.copy()
            for k in started:
                memories[k] = self._made_memory()
        if state is None:
            self._memories = memories
        actions = np.empty((len(rows), 2), dtype=np.float32)
        for k, (row, memory) in enumerate(zip(rows, memories, strict=True)):
            actions[k] = self._bounded(row, memory)
        return (actions[0] if np.ndim(observation) == 1 else actions), memories

    def _own(self, state: list[Memory]) -> list[Memory]:
        """Check that memories given by the caller are such as `new_memory` makes."""
        if not isinstance(state, list):
            raise foreign(state)
        if not self._memory_types:
            self._made_memory()
        for memory in state:
            if type(memory) not in self._memory_types:
                raise foreign(memory)
        return state

    def _made_memory(self) -> Memory:
        """Make a memory, and keep its type in mind: those of one agent may differ."""
        memory = self.new_memory()
        self._memory_types.add(type(memory))
        return memory

    def _bounded(self, row: NDArray[np.float64], memory: Memory) -> tuple[float, float]:
        """Return inputs for one observation, finite and within the bounds of the actions."""
        observation = self.task.layout.unpack(row)
        control = self.control if np.isfinite(row).all() else self.control_blind
        given: Any = control(observation, memory)
        if getattr(given, "shape", None) == (1, 2):  # a network's batch of one
            given = given[0]
        a, delta = two_numbers(given)
        if not (math.isfinite(a) and math.isfinite(delta)):
            if self.replaced_actions == 0:
                warnings.warn(
                    f"{type(self).__name__} returns inputs that are not finite: "
                    f"{reprlib.repr(given)}; the vehicle is brought to a stop instead",
                    UserWarning,
                    stacklevel=3,
                )
            self.replaced_actions += 1
            a, delta = blind_control(self.task.vehicle, observation)
        # In this order a bound in the precision of the actions is exact.
        (low_a, low_delta), (high_a, high_delta) = self._low, self._high
        return min(max(a, low_a), high_a), min(max(delta, low_delta), high_delta)
