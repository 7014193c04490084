"""Agents of lpv-track-env: everything that drives, behind one `predict`.

`make(name, env, **settings)` makes one; `names()` lists them.
"""

from typing import TYPE_CHECKING

from agents.base import Agent, DrivingTask, TrackingAgent
from agents.registry import make, names

if TYPE_CHECKING:
    from agents.sb3 import TrackingVecEnv
    from lpv_track_env.vector_env import PathTrackingVectorEnv

__all__ = ["Agent", "DrivingTask", "TrackingAgent", "make", "names", "sb3_vec_env"]


def sb3_vec_env(env: "PathTrackingVectorEnv") -> "TrackingVecEnv":
    """Return Stable-Baselines3's `VecEnv` of a vector environment; see `agents.sb3`.

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
