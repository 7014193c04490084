"""Environments that a policy learns on: scaled features and actions, as SB3's `VecEnv`."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.linalg import block_diag

from agents.base import DrivingTask
from agents.delay import DelayMemory, NearFuture
from agents.learned.context import Followed, increments, with_context
from agents.learned.policy import ORIGINS, Origin, Policy
from agents.learned.sb3_policies import network_of
from agents.sb3 import AdapterVecEnv, TrackingVecEnv
from lpv_track_env.observation import ACCELERATION, PREVIEW_BOUNDS, SCALARS, STEERING_ANGLE
from trajectories.naming import choose

Array = NDArray[Any]
Infos = list[dict[str, Any]]

LIMIT = 10.0
"""Bound of the features; large errors saturate the finer of their two scales."""
FINE = 10.0
"""Ratio of the finer scale of an error to the coarser."""
RESIDUAL_SHARE = 0.25
"""Half width of a correction of the NMPC's action, as a share of the whole action range."""


@dataclass(frozen=True)
class Scaling:
    """Scaling of observations to features x, and of outputs u in [-1, 1] to actions.

    x = clip(W o + b, -limit, limit) with o the observation in SI units, followed by the NMPC's
    action if that is the origin, and by the context; action = origin + centre + half u.
    """

    feature_weight: NDArray[np.float32]
    """W, (features, inputs)."""
    feature_bias: NDArray[np.float32]
    """b, (features,)."""
    feature_limit: float
    origin: Origin
    """Origin of actions: zero, the actuators' values, or the NMPC's action."""
    centre: NDArray[np.float64]
    """(2,) [m/s^2, rad]."""
    half: NDArray[np.float64]
    """(2,) [m/s^2, rad]."""
    context: tuple[str, ...] = ()
    """Names of the task's constants that follow, see `Policy`."""

    @property
    def features(self) -> int:
        """Number of features."""
        return len(self.feature_bias)

    def features_of(self, inputs: NDArray[np.floating]) -> NDArray[np.float32]:
        """Scale inputs (n, inputs) to features (n, features)."""
        x = inputs.astype(np.float32) @ self.feature_weight.T + self.feature_bias
        return np.clip(x, -self.feature_limit, self.feature_limit, out=x)


CONTEXT_SCALES = {
    "wheelbase": (0.5, 3.0), "front_axle_share": (5.0, 0.45), "front_compliance": (50.0, 0.02),
    "rear_compliance": (50.0, 0.02), "yaw_ratio": (1.0, 0.8), "max_steering_angle": (1.0, 0.8),
    "max_steering_rate": (2.0, 0.5), "max_jerk": (0.2, 5.0), "inverse_least_friction": (1.0, 1.0),
    "inverse_largest_friction": (1.0, 1.0),
}  # fmt: skip
"""Scale of each value of the context and the value that becomes 0."""


def usual_scaling(
    task: DrivingTask, origin: Origin = "actuators", *, context: tuple[str, ...] = ()
) -> Scaling:
    """Return the scaling used in training, derived from the vehicle's ranges and the layout.

    Preview speeds are relative to the reference speed; the vehicle's speed appears both relative
    and absolute, lateral and heading error both coarse and fine. An action is an increment of the
    actuators' values, at most what their rates allow in a control period; or, on top of the NMPC, a
    correction within a part of the whole action range. Each value of the `context` is a feature.
    """
    choose("origin", origin, ORIGINS)
    car, layout = task.vehicle, task.layout
    sharpest = math.tan(car.max_steering_angle) / car.wheelbase
    accelerations = max(map(abs, car.acceleration_range))
    rows: list[dict[str, float]] = [
        {"longitudinal_speed": 0.1},
        {"lateral_speed": 1.0},
        {"yaw_rate": 1.0},
        {"acceleration": 1.0 / accelerations},
        {"steering_angle": 1.5 / car.max_steering_angle},
        {"lateral_error": 2.0},
        {"lateral_error": 2.0 * FINE},
        {"heading_error": 4.0},
        {"heading_error": 4.0 * FINE},
        {"longitudinal_speed": 1.0, "reference_speed": -1.0},
    ]
    places = {name: k for k, (name, _, _) in enumerate(SCALARS)}
    inputs = layout.size + (2 if origin == "lpv-nmpc" else 0)
    weight = np.zeros((len(rows) + layout.preview_steps * len(PREVIEW_BOUNDS), inputs))
    for row, entries in zip(weight, rows, strict=False):
        for name, scale in entries.items():
            row[places[name]] = scale
    slices, first, k = layout.slices, len(rows), layout.preview_steps
    weight[first : first + k, slices["preview_curvature"]] = np.eye(k) * (1.5 / sharpest)
    weight[first + k :, slices["preview_speed"]] = np.eye(k)
    weight[first + k :, places["reference_speed"]] = -1.0
    if origin == "lpv-nmpc":
        base = np.zeros((2, inputs))
        base[0, -2], base[1, -1] = 1.0 / accelerations, 1.5 / car.max_steering_angle
        weight = np.vstack([weight, base])
    scales, middles = np.array([CONTEXT_SCALES[name] for name in context]).reshape(-1, 2).T
    weight = block_diag(weight, np.diag(scales)) if context else weight
    bias = np.zeros(len(weight), dtype=np.float32)
    bias[len(bias) - len(context) :] = -scales * middles
    return Scaling(
        weight.astype(np.float32), bias, LIMIT, origin,
        *_outputs(task, origin), context,
    )  # fmt: skip


def _outputs(task: DrivingTask, origin: str) -> tuple[Array, Array]:
    """Return centre and half width of the action range, (2,) [m/s^2, rad] each."""
    low, high = task.vehicle.acceleration_range
    whole = np.array([0.5 * (high - low), task.vehicle.max_steering_angle])
    if origin == "zero":
        return np.array([0.5 * (low + high), 0.0]), whole
    if origin == "actuators":
        return np.zeros(2), increments(task)
    return np.zeros(2), RESIDUAL_SHARE * whole


class _Part:
    """One vector environment of a learner: its agent's observations, features and actions."""

    def __init__(self, venv: TrackingVecEnv, scaling: Scaling, task: DrivingTask) -> None:
        self.venv, self.scaling = venv, with_context(scaling, task)
        self.solves = 0
        self._followed = Followed(task) if scaling.context else None
        self._future = NearFuture(task, task.actuation) if task.delayed else None
        self._delays: DelayMemory | None = None
        self._base = None
        if scaling.origin == "lpv-nmpc":
            from agents.nmpc.rti_agent import RtiNmpc

            self._base = RtiNmpc(task)
        self._base_memory: Any = None
        self.origins = np.zeros((venv.num_envs, 2))
        self.observations = np.zeros((venv.num_envs, task.layout.size))
        space = venv.action_space
        assert isinstance(space, spaces.Box)
        self._low, self._high = space.low, space.high

    def begin(self, observations: Array) -> None:
        """Take the first observations of all episodes."""
        n = len(observations)
        self._base_memory = None
        if self._future is not None:
            self._delays = self._future.memory(n)
        self.observe(observations, np.ones(n, dtype=np.bool_))

    def observe(self, observations: Array, starts: NDArray[np.bool_]) -> None:
        """Store the observations that agents are given, and the origins of their actions."""
        self.observations = np.array(observations, dtype=np.float64)
        if self._future is not None and self._delays is not None:
            self._future.predict(self.observations, starts, self._delays)
        self.origins, self._base_memory = self._origins_of(
            self.observations, self._base_memory, starts
        )

    def _origins_of(
        self, observations: Array, memory: Any, starts: Array | None
    ) -> tuple[Array, Any]:
        if self._base is not None:
            self.solves += len(observations)
            return self._base.predict(observations, memory, starts)
        if self.scaling.origin == "actuators":
            return observations[:, ACCELERATION : STEERING_ANGLE + 1], None
        return np.zeros((len(observations), 2)), None

    def features(self) -> NDArray[np.float32]:
        """Return the learner's features, (n, features)."""
        return self._features_of(self.observations, self.origins)

    def _features_of(self, observations: Array, origins: Array) -> NDArray[np.float32]:
        if self._followed is not None:
            observations = observations.copy()
            self._followed.replace(observations)
        inputs = observations if self._base is None else np.hstack([observations, origins])
        return self.scaling.features_of(inputs)

    def last_features(self, observation: Array, row: int) -> NDArray[np.float32]:
        """Return the features (features,) of a row's last observation, before its next episode."""
        observations = np.array(observation, dtype=np.float64).reshape(1, -1)
        if self._future is not None and self._delays is not None:
            alone = self._future.memory(1)
            alone.commands[:] = self._delays.commands[row]
            self._future.predict(observations, np.zeros(1, dtype=np.bool_), alone)
        # The row's own memory belongs to the next episode already.
        fresh = None if self._base is None else self._base.new_memory().memory
        origins, _ = self._origins_of(observations, fresh, None)
        features: NDArray[np.float32] = self._features_of(observations, origins)[0]
        return features

    def act(self, outputs: Array) -> NDArray[np.float32]:
        """Turn outputs (n, 2) in [-1, 1] into actions (n, 2) in SI units, and note them as sent."""
        scaling = self.scaling
        actions = self.origins + scaling.centre + scaling.half * np.clip(outputs, -1.0, 1.0)
        sent: NDArray[np.float32] = np.clip(actions.astype(np.float32), self._low, self._high)
        if self._future is not None and self._delays is not None:
            self._future.record(self._delays, sent)
        return sent


class LearnerVecEnv(AdapterVecEnv):
    """Vector environments for learning: features and actions of magnitude one.

    Observations are features of what an agent of `agents.make` would be given (under conditions
    with delays, the observation predicted to the time at which its action takes effect). Actions
    lie in [-1, 1]. `Scaling` defines both. Several vector environments, for instance with different
    conditions, are concatenated.

    The learner sees the observation itself; the policy that `policy_of` makes is symmetric, so it
    treats left and right alike.

    Parameters
    ----------
    venvs
        Adapters, made by `agents.sb3_vec_env`, over vector environments of one layout and control
        period.
    scaling
        Default: `usual_scaling` of the first environment's task.

    Raises
    ------
    TypeError
        For another kind of environment.
    ValueError
        For none at all, or for different layouts or control periods.
    """

    def __init__(
        self, venvs: TrackingVecEnv | Sequence[TrackingVecEnv], scaling: Scaling | None = None
    ) -> None:
        parts: list[Any] = list(venvs) if isinstance(venvs, list | tuple) else [venvs]
        if not parts:
            raise ValueError("LearnerVecEnv needs at least one vector environment")
        for part in parts:
            if not isinstance(part, TrackingVecEnv):
                raise TypeError(
                    f"LearnerVecEnv takes what agents.sb3_vec_env(env) returns, not a "
                    f"{type(part).__name__}"
                )
        tasks = [DrivingTask.of(part.env.single) for part in parts]
        kinds = {(task.layout, task.control_period) for task in tasks}
        if len(kinds) > 1:
            raise ValueError("all environments of a learner must share layout and control period")
        self.task, self.tasks = tasks[0], tasks
        self.scaling = usual_scaling(self.task) if scaling is None else scaling
        self._parts = [
            _Part(part, self.scaling, task) for part, task in zip(parts, tasks, strict=True)
        ]
        ends = np.cumsum([0, *(part.num_envs for part in parts)]).tolist()
        self.rows = [slice(a, b) for a, b in pairwise(ends)]
        """Rows of the environments of each of `venvs`; `tasks` has a task for each."""
        limit = self.scaling.feature_limit
        super().__init__(
            [part.env for part in parts],
            [view for part in parts for view in part.views],
            spaces.Box(-limit, limit, (self.scaling.features,), dtype=np.float32),
            spaces.Box(-1.0, 1.0, (2,), dtype=np.float32),
            monitored=True,
        )
        self.seconds = 0.0
        """Time spent in this class so far, s."""

    @property
    def solves(self) -> int:
        """Number of solves so far of the NMPC whose actions are corrected."""
        return sum(part.solves for part in self._parts)

    @property
    def agent_observations(self) -> NDArray[np.float64]:
        """Observations that agents would be given now, SI units, (n, size)."""
        return np.concatenate([part.observations for part in self._parts])

    @property
    def origins(self) -> NDArray[np.float64]:
        """Origins of the next actions, (n, 2) [m/s^2, rad]."""
        return np.concatenate([part.origins for part in self._parts])

    @property
    def halves(self) -> NDArray[np.float64]:
        """Half the range of each environment's actions, (n, 2) [m/s^2, rad]."""
        return np.repeat(
            [part.scaling.half for part in self._parts],
            [part.venv.num_envs for part in self._parts],
            axis=0,
        )

    def policy_of(
        self, model: Any, algorithm: str, training: Mapping[str, Any] | None = None
    ) -> Policy:
        """Extract the policy from an SB3 model that has learned on these environments.

        Parameters
        ----------
        model
            PPO, SAC or TD3 with "MlpPolicy".
        algorithm
            Name of the algorithm, stored with the policy.
        training
            Origin of the policy, in plain JSON.

        Raises
        ------
        ValueError
            For another kind of policy.
        """
        return Policy(
            **network_of(model)._asdict(), **vars(self.scaling), algorithm=algorithm,
            layout=self.task.layout, control_period=self.task.control_period,
            training=training or {}, symmetric=True,
        )  # fmt: skip

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed environment i with seed + i at the next reset."""
        seeds: list[int | None] = []
        for rows, part in zip(self.rows, self._parts, strict=True):
            seeds += part.venv.seed(None if seed is None else seed + rows.start)
        return seeds

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every environment."""
        for part in self._parts:
            part.begin(part.venv.reset())
        self.reset_infos = [info for part in self._parts for info in part.venv.reset_infos]
        return np.concatenate([part.features() for part in self._parts])

    def step_async(self, actions: Array) -> None:
        """Send actions (n, 2) in [-1, 1]."""
        began = time.perf_counter()
        for rows, part in zip(self.rows, self._parts, strict=True):
            part.venv.step_async(part.act(actions[rows]))
        self.seconds += time.perf_counter() - began

    def step_wait(self) -> tuple[Array, Array, Array, Infos]:
        """Drive a control period; return features, rewards, dones, and `TrackingVecEnv`'s infos."""
        began = time.perf_counter()
        features, rewards, dones = [], [], []
        infos: Infos = []
        for part in self._parts:
            observations, reward, done, info = part.venv.step_wait()
            for row in np.flatnonzero(done).tolist():
                last = info[row]["terminal_observation"]
                info[row]["terminal_observation"] = part.last_features(last, row)
            part.observe(observations, done)
            features.append(part.features())
            rewards.append(reward)
            dones.append(done)
            infos += info
        self.seconds += time.perf_counter() - began
        return np.concatenate(features), np.concatenate(rewards), np.concatenate(dones), infos
