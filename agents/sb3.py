"""Vector environments as the `VecEnv` of Stable-Baselines3.

SB3 resets an environment in the step that ends its episode and puts the last observation into the
info; Gymnasium calls this autoreset mode SAME_STEP. `agents.sb3_vec_env` imports this module when
it is called, so that `import agents` does not load torch.
"""

import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from lpv_track_env.task import Task
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Array = NDArray[Any]
Infos = list[dict[str, Any]]


class AdapterVecEnv(VecEnv):
    """Base class of `VecEnv`s over vector environments: everything but resets and steps.

    Parameters
    ----------
    envs
        Vector environments, one after another.
    views
        An object per single environment; `get_attr` and `env_method` access its attributes.
    observation_space, action_space
        Spaces of a single environment.
    monitored
        True if infos have the entry `episode`, as with SB3's `Monitor`.
    """

    def __init__(
        self,
        envs: Sequence[VectorEnv[Any, Any, Any]],
        views: Sequence[Any],
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        *,
        monitored: bool,
    ) -> None:
        self._vector_envs, self._views, self._monitored = envs, views, monitored
        super().__init__(len(views), observation_space, action_space)  # reads views' attributes

    def _reset_with_options(self, env: VectorEnv[Any, Any, Any]) -> Array:
        """Reset the only vector environment with the seeds and options set before."""
        # Environments with the same options are reset together.
        options = list(self._options)
        for wanted in [given for k, given in enumerate(options) if given not in options[:k]]:
            mask = np.array([given == wanted for given in options])
            seeds: Any = self._seeds
            observations, _ = env.reset(seed=seeds, options={**wanted, "reset_mask": mask})
        self._reset_seeds()
        self._reset_options()
        return np.asarray(observations)

    def close(self) -> None:
        """Close the vector environments."""
        for env in self._vector_envs:
            env.close()

    def get_images(self) -> Sequence[Array | None]:
        """Draw all environments; None for those without a render mode."""
        images: list[Array | None] = []
        for env in self._vector_envs:
            frames: Any = env.render()
            images += [None] * env.num_envs if frames is None else frames
        return images

    def _views_at(self, indices: Any) -> list[Any]:
        return [self._views[i] for i in self._get_indices(indices)]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of each environment."""
        return [getattr(view, attr_name) for view in self._views_at(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:  # noqa: ARG002
        """Refuse: settings belong to the constructor, and to `set_options` for one episode."""
        raise AttributeError(
            f"cannot set {attr_name!r}: the environments of a {type(self).__name__} have no "
            "attributes of their own; use set_options() for the next reset"
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each environment."""
        views = self._views_at(indices)
        return [getattr(view, method_name)(*method_args, **method_kwargs) for view in views]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """Return, for each, whether it does the work of a wrapper: at most of SB3's `Monitor`."""
        wrapped = self._monitored and issubclass(Monitor, wrapper_class)
        return [wrapped for _ in self._get_indices(indices)]


class EnvironmentView:
    """One environment of a vector environment, for `get_attr` and `env_method`."""

    def __init__(self, env: PathTrackingVectorEnv, index: int) -> None:
        self._env = env
        self._index = index
        self.render_mode = env.render_mode
        self.metadata = env.metadata
        self.spec = env.spec
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        self.layout = env.tasks[0].layout
        self.control_period = env.tasks[0].control_period

    @property
    def task(self) -> Task:
        """Task of the current episode."""
        return self._env.task_of(self._index)

    @property
    def path(self) -> ReferencePath:
        """Reference path of the current episode."""
        return self.task.path

    @property
    def vehicle(self) -> VehicleParameters:
        """Vehicle of the current episode."""
        return self.task.vehicle

    @property
    def state(self) -> Array:
        """True state [vx, vy, psi, r, X, Y], (6,); a copy."""
        state: Array = self._env.state[self._index]
        return state

    def render(self) -> Array | None:
        """Draw the environment: a frame (600, 900, 3) uint8, or None without a render mode."""
        frames = self._env.render()
        return None if frames is None else frames[self._index]


class TrackingVecEnv(AdapterVecEnv):
    """`VecEnv` of a `PathTrackingVectorEnv`.

    Transitions are those of a `DummyVecEnv` over single environments in a `Monitor`. When an
    episode ends, the info has the entries of the single environment's last info and
    `terminal_observation`, `TimeLimit.truncated` (True if truncated and not terminated: SB3 then
    bootstraps) and `episode` (return r, length l, seconds t since this object was made), from which
    SB3 logs `ep_rew_mean`. All other infos are empty: nothing reads them, and building them would
    take longer than the step.

    Actions are in SI units; SB3's algorithms clip them to the action space.

    Parameters
    ----------
    env
        The vector environment, in autoreset mode SAME_STEP.

    Raises
    ------
    ValueError
        In another mode: the action that NEXT_STEP ignores would become a transition that never
        happened, and DISABLED never resets.
    """

    def __init__(self, env: PathTrackingVectorEnv) -> None:
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                "Stable-Baselines3 needs autoreset_mode='SameStep', this vector environment has "
                f"{env.autoreset_mode.value!r}: make it with autoreset_mode='SameStep'"
            )
        self.env = env
        self.views = [EnvironmentView(env, index) for index in range(env.num_envs)]
        self._actions = np.zeros((env.num_envs, 2))
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._made = time.time()
        super().__init__(
            [env], self.views, env.single_observation_space, env.single_action_space,
            monitored=True,
        )  # fmt: skip

    def reset(self) -> Array:
        """Begin an episode in every environment, with the seeds and options set before."""
        observations = self._reset_with_options(self.env)
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self.reset_infos = [self.env.info_of(i) for i in range(self.num_envs)]
        return observations

    def step_async(self, actions: Array) -> None:
        """Store the actions, (n, 2) m/s^2 and rad, for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, Infos]:
        """Drive a control period; return observations, rewards float32, dones, infos."""
        observations, rewards, terminated, truncated = self.env.advance(self._actions)
        self._returns += rewards
        self._lengths += 1
        done = terminated | truncated
        infos: Infos = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            info, observation = self.env.final_of(i)
            infos[i] = {
                **info,
                "terminal_observation": observation,
                "TimeLimit.truncated": bool(truncated[i]),
                "episode": {
                    "r": round(float(self._returns[i]), 6),
                    "l": int(self._lengths[i]),
                    "t": round(time.time() - self._made, 6),
                },
            }
            self.reset_infos[i] = self.env.info_of(i)
            self._returns[i], self._lengths[i] = 0.0, 0
        return observations, rewards.astype(np.float32), done, infos
