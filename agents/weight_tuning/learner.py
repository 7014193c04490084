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

    One whose episode has ended has in its info `score` and `end`, and SB3's `terminal_observation`
    and `TimeLimit.truncated`; the others' infos are empty. For SB3 to log returns, put it into a
    `VecMonitor`.

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
        # SB3's constructor asks for attributes of the environments.
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        size = envs.single_observation_space.shape[0]  # type: ignore[index]
        self.seen = np.ones(size, dtype=np.float32)
        if seen is not None:
            self.seen = np.asarray(seen, dtype=np.float32)
        if self.seen.shape != (size,):
            raise ValueError(f"seen must have shape ({size},), not {self.seen.shape}")
        self._actions: Array = np.zeros(0)

    @property
    def solves(self) -> int:
        """Of the NMPC so far: the budget."""
        return self.envs.solves

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every environment, with the seeds and options set before."""
        # Environments with the same options are reset together.
        options = list(self._options)
        for wanted in [given for k, given in enumerate(options) if given not in options[:k]]:
            mask = np.array([given == wanted for given in options])
            observations, _ = self.envs.reset(
                seed=self._seeds, options={**wanted, "reset_mask": mask}
            )
        self._reset_seeds()
        self._reset_options()
        first: NDArray[np.float32] = observations * self.seen
        return first

    def step_async(self, actions: Array) -> None:
        """Take actions for the next `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, Infos]:
        """Drive a window: features, rewards, dones, infos with SB3's names."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        done = terminated | truncated
        told: Infos = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            told[i] = {
                "terminal_observation": infos["final_obs"][i] * self.seen,
                "TimeLimit.truncated": bool(truncated[i]),
                "score": float(infos["final_info"]["score"][i]),
                "end": str(infos["final_info"]["end"][i]),
            }
        return observations * self.seen, rewards.astype(np.float32), done, told

    def policy_of(
        self, network: Sequence[tuple[Array, Array]], algorithm: str, training: Mapping[str, Any]
    ) -> WeightPolicy:
        """A weight policy of layers (W, b), tanh between them, blind to what is hidden."""
        first, *others = network
        layers = [(np.asarray(first[0], dtype=np.float32) * self.seen, first[1]), *others]
        single = self.envs.drives.single
        return WeightPolicy(
            choice=self.envs.choice, layers=tuple(layers), layout=single.layout,
            control_period=single.control_period, algorithm=algorithm, training=training,
        )  # fmt: skip

    def get_images(self) -> Sequence[Array | None]:
        """Frames of all environments, where they have a render mode."""
        frames = self.envs.render()
        return [None] * self.num_envs if frames is None else frames

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Attribute of the vector environment, once for each."""
        value = getattr(self.envs, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:  # noqa: ARG002
        """Refuse: settings are the constructor's."""
        raise AttributeError(f"cannot set {attr_name!r}: it is set when the environments are made")

    def env_method(
        self,
        method_name: str,
        *method_args: Any,  # noqa: ARG002
        indices: Any = None,  # noqa: ARG002
        **method_kwargs: Any,  # noqa: ARG002
    ) -> list[Any]:
        """Refuse: the environments are one, and have no methods of their own."""
        raise AttributeError(
            f"cannot call {method_name!r} of each: the environments are one, in compiled code; "
            "call it on `envs`"
        )

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],  # noqa: ARG002
        indices: Any = None,
    ) -> list[bool]:
        """Whether each is wrapped: none is."""
        return [False for _ in self._get_indices(indices)]
