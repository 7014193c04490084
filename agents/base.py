"""The one way to act: `predict`, Stable-Baselines3's policy protocol.

Anything with `predict(observation, state, episode_start, deterministic) -> (action, state)` drives:
it passes through SB3's `evaluate_policy`, this project's rollouts and its reports. `TrackingAgent`
makes such an agent from one method that controls a single vehicle.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from lpv_track_env.conditions import Actuation
from lpv_track_env.conditions.vehicle import controlled_stop
from lpv_track_env.observation import ObservationLayout, TrackingObservation
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Action = NDArray[np.float32]
Memory = TypeVar("Memory")

NOTHING_DELAYED = Actuation()


class Agent(Protocol):
    """What everything that drives implements."""

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """Action(s) [a m/s^2, delta rad] for one observation (size,) or a batch (n, size).

        `state` is what the last call returned (None: the agent's own memory); rows that
        `episode_start` (n,) marks begin a new episode.
        """
        ...


@dataclass(frozen=True)
class DrivingTask:
    """What an agent may know beforehand of what it will drive: the vehicle, periods, bounds.

    `path` is known at design time only, for rules that choose settings from the whole path (the
    paper's weights); what an agent does from step to step it does on the observation.
    """

    layout: ObservationLayout
    vehicle: VehicleParameters
    control_period: float
    path: ReferencePath
    actuation: Actuation = NOTHING_DELAYED
    """Delays and lags between a command and its effect, nominal (s)."""

    @property
    def delayed(self) -> bool:
        """Whether there are any."""
        return any(time > 0.0 for time in self.actuation)

    @property
    def action_bounds(self) -> tuple[Action, Action]:
        """The action space's own float32 bounds, (2,): an action clipped to them lies in it."""
        low, high = self.vehicle.acceleration_range
        limit = self.vehicle.max_steering_angle
        return np.array([low, -limit], np.float32), np.array([high, limit], np.float32)

    @classmethod
    def of(cls, env: gymnasium.Env[Any, Any]) -> "DrivingTask":
        """Read it off an environment (wrapped or not).

        Raises
        ------
        TypeError
            If the environment is not one of path tracking.
        """
        names = ("layout", "vehicle", "control_period", "path", "actuation")
        try:
            return cls(*(env.get_wrapper_attr(name) for name in names))
        except AttributeError as error:
            raise TypeError(
                f"{type(env.unwrapped).__name__} is not a path tracking environment: {error}"
            ) from None


def stopping_acceleration(vehicle: VehicleParameters, speed: float) -> float:
    """Acceleration command (m/s^2) of a controlled stop from a speed (m/s), down to standstill."""
    # Where the speed is unknown it rolls on: braking blindly would end in reverse.
    speed = max(speed, 0.0) if math.isfinite(speed) else 0.0
    command: float = controlled_stop(vehicle.rolling_deceleration, vehicle.max_jerk, speed)
    return command


def blind_control(
    vehicle: VehicleParameters, observation: TrackingObservation
) -> tuple[float, float]:
    """Inputs (m/s^2, rad) for an observation that is not finite: steering held, braking to a stop.

    Its speed and its steering angle count where they are finite.
    """
    speed, steering = float(observation.longitudinal_speed), float(observation.steering_angle)
    return (
        stopping_acceleration(vehicle, speed),
        steering if math.isfinite(steering) else 0.0,
    )


def observation_rows(observation: NDArray[Any], size: int) -> NDArray[np.float64]:
    """One observation (size,), or a batch (n, size), as rows (n, size) for compiled code: a copy.

    Raises
    ------
    ValueError
        If it has another size.
    """
    rows = np.array(observation, dtype=np.float64, order="C")
    if rows.ndim == 1:
        rows = rows.reshape(1, -1)
    if rows.ndim != 2 or rows.shape[1] != size:
        raise ValueError(
            f"observation has shape {np.shape(observation)}, this layout has {size} "
            "entries, alone or in rows: make the agent for this environment"
        )
    return rows


class TrackingAgent(ABC, Generic[Memory]):
    """An agent made from `control`, which drives one vehicle on one observation.

    It keeps one memory per row of a batch; rows that `episode_start` marks get a new one. What an
    observation with entries that are not finite gets is decided by `control_blind`.
    """

    def __init__(self, task: DrivingTask) -> None:
        self.task = task
        self._low, self._high = task.action_bounds
        self._memories: list[Memory] = []

    @abstractmethod
    def control(self, observation: TrackingObservation, memory: Memory) -> tuple[float, float]:
        """Acceleration (m/s^2) and steering angle (rad) for one observation; may write memory."""

    def control_blind(
        self,
        observation: TrackingObservation,
        memory: Memory,  # noqa: ARG002  for subclasses
    ) -> tuple[float, float]:
        """Inputs for an observation that is not finite: steering held, braking to a stop.

        The memory is left alone: one NaN in an integral would stay there for good.
        """
        return blind_control(self.task.vehicle, observation)

    @abstractmethod
    def new_memory(self) -> Memory:
        """Memory of a vehicle at the start of an episode."""

    def diagnostics(self, memory: Memory) -> dict[str, Any]:  # noqa: ARG002  for subclasses
        """What the agent can tell of its last step for one vehicle; empty if nothing.

        Known entries: status, seconds, iterations, cost, slack (3,), fallback, weights (10,),
        plan (n, 2) in the frame of the path's foot point.
        """
        return {}

    def reset(self) -> None:
        """Forget everything: the next call begins new episodes."""
        self._memories = []

    def predict(
        self,
        observation: NDArray[Any],
        state: list[Memory] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002  part of the protocol
    ) -> tuple[Action, list[Memory]]:
        """Action (2,) for one observation (size,), or (n, 2) for a batch; and the memories.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout.
        """
        values = np.asarray(observation)
        rows = np.atleast_2d(values)
        memories = self._memories if state is None else state
        if len(memories) != len(rows):
            memories = [self.new_memory() for _ in rows]
        if episode_start is not None:
            started = np.broadcast_to(np.asarray(episode_start, dtype=bool), (len(rows),))
            memories = [
                self.new_memory() if begins else memory
                for begins, memory in zip(started, memories, strict=True)
            ]
        if state is None:
            self._memories = memories
        actions = np.empty((len(rows), 2), dtype=np.float32)
        for k, (row, memory) in enumerate(zip(rows, memories, strict=True)):
            control = self.control if np.isfinite(row).all() else self.control_blind
            actions[k] = control(self.task.layout.unpack(row), memory)
        np.nan_to_num(actions, copy=False, nan=0.0)
        np.clip(actions, self._low, self._high, out=actions)
        return (actions[0] if values.ndim == 1 else actions), memories
