"""`WeightTuning-v0` as the `VecEnv` of Stable-Baselines3, and its network as a weight policy."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from agents.sb3 import AdapterVecEnv
from agents.weight_tuning.env import WeightTuningVectorEnv
from agents.weight_tuning.policy import WeightPolicy

Array = NDArray[Any]
Infos = list[dict[str, Any]]


class WeightLearnerVecEnv(AdapterVecEnv):
    """`VecEnv` of a `WeightTuningVectorEnv`.

    When an episode ends, the info has `score`, `end`, and SB3's `terminal_observation` and
    `TimeLimit.truncated`; all other infos are empty. For SB3 to log returns, wrap it in a
    `VecMonitor`. `get_attr` returns attributes of the vector environment, once for each.

    Parameters
    ----------
    envs
        The environments, in autoreset mode SAME_STEP.
    feature_mask
        Factor of each feature, (size,): 0 hides a feature from the learner and from its policy.

    Raises
    ------
    ValueError
        For another autoreset mode, or a mask of another shape.
    """

    def __init__(self, envs: WeightTuningVectorEnv, feature_mask: Array | None = None) -> None:
        if envs.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError("learning needs environments with autoreset_mode='SameStep'")
        self.envs = envs
        size = envs.single_observation_space.shape[0]  # type: ignore[index]
        self.feature_mask = np.ones(size, dtype=np.float32)
        if feature_mask is not None:
            self.feature_mask = np.asarray(feature_mask, dtype=np.float32)
        if self.feature_mask.shape != (size,):
            raise ValueError(
                f"feature_mask must have shape ({size},), not {self.feature_mask.shape}"
            )
        self._actions: Array = np.zeros(0)
        super().__init__(
            [envs], [envs] * envs.num_envs, envs.single_observation_space,
            envs.single_action_space, monitored=False,
        )  # fmt: skip

    @property
    def solves(self) -> int:
        """Number of solves of the NMPC so far: the budget."""
        return self.envs.solves

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every environment, with the seeds and options set before."""
        first: NDArray[np.float32] = self._reset_with_options(self.envs) * self.feature_mask
        return first

    def step_async(self, actions: Array) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, Infos]:
        """Drive a window; return features, rewards float32, dones, infos with SB3's names."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        done = terminated | truncated
        last: Infos = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            last[i] = {
                "terminal_observation": infos["final_obs"][i] * self.feature_mask,
                "TimeLimit.truncated": bool(truncated[i]),
                "score": float(infos["final_info"]["score"][i]),
                "end": infos["final_info"]["end"][i],
            }
        return observations * self.feature_mask, rewards.astype(np.float32), done, last

    def policy_of(
        self, network: Sequence[tuple[Array, Array]], algorithm: str, training: Mapping[str, Any]
    ) -> WeightPolicy:
        """Make a weight policy of layers (W, b), tanh between them; masked features are ignored."""
        first, *others = network
        layers = [(np.asarray(first[0], dtype=np.float32) * self.feature_mask, first[1]), *others]
        single = self.envs.drives.single
        return WeightPolicy(
            choice=self.envs.choice, layers=tuple(layers), layout=single.layout,
            control_period=single.control_period, algorithm=algorithm, training=training,
        )  # fmt: skip

    def env_method(
        self,
        method_name: str,
        *method_args: Any,  # noqa: ARG002
        indices: Any = None,  # noqa: ARG002
        **method_kwargs: Any,  # noqa: ARG002
    ) -> list[Any]:
        """Refuse: the environments run in compiled code and have no methods of their own."""
        raise AttributeError(
            f"cannot call {method_name!r} of each: the environments are one, in compiled code; "
            "call it on `envs`"
        )
