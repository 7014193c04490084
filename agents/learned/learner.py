"""What Stable-Baselines3 learns on: scaled features and actions over the vector environments."""

import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agents.base import DrivingTask
from agents.delay import DelayMemory, NearFuture
from agents.learned.policy import Policy
from agents.learned.sb3 import from_sb3
from agents.learned.scaling import Scaling, usual_scaling
from agents.sb3 import TrackingVecEnv

Array = NDArray[Any]
Infos = list[dict[str, Any]]


class _Part:
    """Environments of one kind of conditions: what an agent there is shown, and what it sends."""

    def __init__(self, venv: TrackingVecEnv, scaling: Scaling, task: DrivingTask) -> None:
        self.venv, self.scaling = venv, scaling
        self.solves = 0
        delayed = any(seconds > 0.0 for seconds in task.actuation)
        self._future = NearFuture(task, task.actuation) if delayed else None
        self._delays: DelayMemory | None = None
        self._base = None
        if scaling.origin == "lpv-nmpc":
            from agents.nmpc.rti_agent import RtiNmpc

            self._base = RtiNmpc(task)
        self._base_memory: Any = None
        self.origin = np.zeros((venv.num_envs, 2))
        self.seen = np.zeros((venv.num_envs, task.layout.size))
        space = venv.action_space
        assert isinstance(space, spaces.Box)
        self._low, self._high = space.low, space.high

    def begin(self, observations: Array) -> None:
        """Take the first observations."""
        n = len(observations)
        self._base_memory = None
        if self._future is not None:
            self._delays = self._future.memory(n)
        self.look(observations, np.ones(n, dtype=np.bool_))

    def look(self, observations: Array, starts: NDArray[np.bool_]) -> None:
        """Note what agents are shown, and what their actions are an addition to."""
        self.seen = np.array(observations, dtype=np.float64)
        if self._future is not None and self._delays is not None:
            self._future.look(self.seen, starts, self._delays)
        self.origin, self._base_memory = self._origin_of(self.seen, self._base_memory, starts)

    def _origin_of(self, seen: Array, memory: Any, starts: Array | None) -> tuple[Array, Any]:
        if self._base is not None:
            self.solves += len(seen)
            return self._base.predict(seen, memory, starts)
        if self.scaling.origin == "actuators":
            return seen[:, 3:5], None
        return np.zeros((len(seen), 2)), None

    def features(self) -> NDArray[np.float32]:
        """What the learner is shown, (n, features)."""
        return self._features(self.seen, self.origin)

    def _features(self, seen: Array, origin: Array) -> NDArray[np.float32]:
        inputs = np.hstack([seen, origin]) if self._base is not None else seen
        return self.scaling.of(inputs)

    def last_features(self, observation: Array, row: int) -> NDArray[np.float32]:
        """Features (features,) of a last observation, before the row's next episode is noted."""
        seen = np.array(observation, dtype=np.float64).reshape(1, -1)
        if self._future is not None and self._delays is not None:
            alone = self._future.memory(1)
            alone.commands[:] = self._delays.commands[row]
            self._future.look(seen, np.zeros(1, dtype=np.bool_), alone)
        # The row's own memory is the next episode's by now.
        fresh = None if self._base is None else self._base.new_memory().memory
        origin, _ = self._origin_of(seen, fresh, None)
        features: NDArray[np.float32] = self._features(seen, origin)[0]
        return features

    def act(self, outputs: Array) -> NDArray[np.float32]:
        """Actions (n, 2) in SI units for outputs (n, 2) in [-1, 1]; remembered as sent."""
        scaling = self.scaling
        actions = self.origin + scaling.centre + scaling.half * np.clip(outputs, -1.0, 1.0)
        sent: NDArray[np.float32] = np.clip(actions.astype(np.float32), self._low, self._high)
        if self._future is not None and self._delays is not None:
            self._future.note(self._delays, sent)
        return sent


class LearnerVecEnv(VecEnv):
    """Vector environments as a learner wants them: features and actions of about one.

    Observations are features of the observation that an agent of `agents.make` is shown (under
    conditions with delays, that of the time at which its action lands), actions lie in [-1, 1];
    both as `Scaling` says. Several vector environments, of different conditions say, are put one
    after another.

    What learns sees the observation as it is; the policy that `policy_of` makes of it is symmetric,
    so left and right are the same to it.

    Parameters
    ----------
    venvs
        Adapters over vector environments of one layout and control period, as
        `agents.sb3_vec_env` makes them.
    scaling
        By default `usual_scaling` of the first environment's task.
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
        self.task = tasks[0]
        self.scaling = usual_scaling(self.task) if scaling is None else scaling
        self._parts = [
            _Part(part, self.scaling, task) for part, task in zip(parts, tasks, strict=True)
        ]
        counts = [part.num_envs for part in parts]
        ends = np.cumsum([0, *counts]).tolist()
        self._rows = [slice(a, b) for a, b in pairwise(ends)]
        self._where = [(k, i) for k, count in enumerate(counts) for i in range(count)]
        limit = self.scaling.feature_limit
        super().__init__(
            sum(counts),
            spaces.Box(-limit, limit, (self.scaling.features,), dtype=np.float32),
            spaces.Box(-1.0, 1.0, (2,), dtype=np.float32),
        )
        self.seconds = 0.0
        """Time spent in here so far, s."""

    @property
    def solves(self) -> int:
        """Solves of the NMPC so far, where actions are additions to its."""
        return sum(part.solves for part in self._parts)

    @property
    def shown(self) -> NDArray[np.float64]:
        """What agents are shown now, in SI units, (n, size)."""
        return np.concatenate([part.seen for part in self._parts])

    @property
    def origins(self) -> NDArray[np.float64]:
        """What actions are additions to now, (n, 2)."""
        return np.concatenate([part.origin for part in self._parts])

    def policy_of(
        self, model: Any, algorithm: str, training: Mapping[str, Any] | None = None
    ) -> Policy:
        """Take the policy out of a model of SB3 that has learned on this, ready to be written.

        Parameters
        ----------
        model
            PPO, SAC or TD3 with "MlpPolicy".
        algorithm
            What it is called.
        training
            Where it comes from, in plain JSON.

        Raises
        ------
        ValueError
            For another kind of policy.
        """
        return from_sb3(
            model, layout=self.task.layout, control_period=self.task.control_period,
            algorithm=algorithm, training=training or {}, symmetric=True, **vars(self.scaling),
        )  # fmt: skip

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed environment i with seed + i at the next reset."""
        seeds: list[int | None] = []
        for rows, part in zip(self._rows, self._parts, strict=True):
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
        for rows, part in zip(self._rows, self._parts, strict=True):
            part.venv.step_async(part.act(actions[rows]))
        self.seconds += time.perf_counter() - began

    def step_wait(self) -> tuple[Array, Array, Array, Infos]:
        """Drive a control period: features, rewards, dones, infos as `TrackingVecEnv` has them."""
        began = time.perf_counter()
        features, rewards, dones = [], [], []
        infos: Infos = []
        for part in self._parts:
            observations, reward, done, info = part.venv.step_wait()
            for row in np.flatnonzero(done).tolist():
                last = info[row]["terminal_observation"]
                info[row]["terminal_observation"] = part.last_features(last, row)
            part.look(observations, done)
            features.append(part.features())
            rewards.append(reward)
            dones.append(done)
            infos += info
        self.seconds += time.perf_counter() - began
        return np.concatenate(features), np.concatenate(rewards), np.concatenate(dones), infos

    def close(self) -> None:
        """Close the vector environments."""
        for part in self._parts:
            part.venv.close()

    def _each(self, indices: Any) -> list[tuple[TrackingVecEnv, int]]:
        places = (self._where[i] for i in self._get_indices(indices))
        return [(self._parts[k].venv, i) for k, i in places]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Attribute of each environment, see `agents.sb3.EnvironmentView`."""
        return [venv.get_attr(attr_name, i)[0] for venv, i in self._each(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse, as the vector environments do."""
        for venv, i in self._each(indices):
            venv.set_attr(attr_name, value, i)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each environment."""
        return [
            venv.env_method(method_name, *method_args, indices=i, **method_kwargs)[0]
            for venv, i in self._each(indices)
        ]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """Whether each does what a wrapper does."""
        return [venv.env_is_wrapped(wrapper_class, i)[0] for venv, i in self._each(indices)]

    def get_images(self) -> Sequence[Array | None]:
        """Frames of all environments, where they have a render mode."""
        return [frame for part in self._parts for frame in part.venv.get_images()]
