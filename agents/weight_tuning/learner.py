"""`WeightTuning-v0` as Stable-Baselines3 takes it, and its learned network as a weight policy."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agents.weight_tuning.policy import WeightPolicy
from agents.weight_tuning.vector_env import WeightTuningVectorEnv

Array = NDArray[Any]
Infos = list[dict[str, Any]]


class WeightLearnerVecEnv(VecEnv):
    """A `WeightTuningVectorEnv` in mode SAME_STEP, as SB3's vectorised environment.

    Parameters
    ----------
    envs
        The environments.
    seen
        Factor of each feature, (size,): 0 hides one from the learner, and from its policy.

    Raises
    ------
    ValueError
        For another autoreset mode, or factors that do not fit.
    """

    def __init__(self, envs: WeightTuningVectorEnv, seen: Array | None = None) -> None:
        if envs.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError("learning needs environments with autoreset_mode='SameStep'")
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        size = envs.single_observation_space.shape[0]  # type: ignore[index]
        self.envs = envs
        self.seen = np.ones(size, dtype=np.float32)
        if seen is not None:
            self.seen = np.asarray(seen, dtype=np.float32)
        if self.seen.shape != (size,):
            raise ValueError(f"seen must have shape ({size},), not {self.seen.shape}")
        self.solves = 0
        """Of the NMPC so far: the budget."""
        self._actions: Array = np.zeros(0)
        self._seed: int | None = None

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed environment i with seed + i at the next reset."""
        self._seed = seed
        return [None if seed is None else seed + i for i in range(self.num_envs)]

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every environment."""
        observations, _ = self.envs.reset(seed=self._seed)
        self._seed = None
        first: NDArray[np.float32] = observations * self.seen
        return first

    def step_async(self, actions: Array) -> None:
        """Take actions for the next `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, Infos]:
        """Drive a window: features, rewards, dones, infos with SB3's names."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        self.solves += int(infos["solves"].sum())
        done = terminated | truncated
        told: Infos = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            told[i] = {
                "terminal_observation": infos["final_obs"][i] * self.seen,
                "TimeLimit.truncated": bool(truncated[i]),
                "score": float(infos["score"][i]),
            }
        return observations * self.seen, rewards.astype(np.float32), done, told

    def policy_of(
        self, network: Sequence[tuple[Array, Array]], algorithm: str, training: Mapping[str, Any]
    ) -> WeightPolicy:
        """A weight policy of a network's layers (W, b), tanh between them; what is hidden, stays."""
        first, *others = network
        layers = [(np.asarray(first[0], dtype=np.float32) * self.seen, first[1]), *others]
        single = self.envs.drives.single
        return WeightPolicy(
            choice=self.envs.choice, layers=tuple(layers), layout=single.layout,
            control_period=single.control_period, algorithm=algorithm, training=training,
        )  # fmt: skip

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Attribute of the vector environment, once for each."""
        value = getattr(self.envs, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: settings are the constructor's."""
        raise NotImplementedError(f"{attr_name} is set when the environments are made")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse: the environments are one."""
        raise NotImplementedError(f"{method_name}: the environments are one, in compiled code")

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """Whether each is wrapped: none is."""
        return [False for _ in self._get_indices(indices)]
