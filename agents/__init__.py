"""Agents that drive the environments, all with the interface `predict`.

`make(name, env, **settings)` makes an agent; `names()` lists the known names.
"""

from typing import TYPE_CHECKING

from agents.base import Agent, DrivingTask, TrackingAgent
from agents.registry import make, names

if TYPE_CHECKING:
    from agents.sb3 import TrackingVecEnv
    from lpv_track_env.vector_env import PathTrackingVectorEnv

__all__ = ["Agent", "DrivingTask", "TrackingAgent", "make", "names", "sb3_vec_env"]


def sb3_vec_env(env: "PathTrackingVectorEnv") -> "TrackingVecEnv":
    """Wrap a vector environment as a `VecEnv` of Stable-Baselines3; see `agents.sb3`.

    Raises
    ------
    ImportError
        If Stable-Baselines3 is not installed.
    ValueError
        If the autoreset mode is not SAME_STEP.
    """
    try:
        from agents.sb3 import TrackingVecEnv
    except ModuleNotFoundError as error:
        if error.name != "stable_baselines3":
            raise
        raise ImportError(
            "Stable-Baselines3 is not installed: pip install 'lpv-track-env[rl]'"
        ) from error
    return TrackingVecEnv(env)
