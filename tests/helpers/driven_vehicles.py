"""Environments, real-time NMPCs and observations that their tests share."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
from lpv_track_env import PATH_TRACKING
from lpv_track_env.vector_env import PathTrackingVectorEnv

Array = NDArray[Any]


def environment(**settings: Any) -> gymnasium.Env:
    return gymnasium.make(PATH_TRACKING, **{"trajectory": "u-turn", **settings})


def made(env: gymnasium.Env | None = None, **settings: Any) -> Any:
    return agents.make("lpv-nmpc", environment() if env is None else env, **settings)


def drives(n: int, steps: int) -> Array:
    """Observations (steps, n, size) of vehicles that are driven from all over a path."""
    envs = PathTrackingVectorEnv(
        n, "T1", random_start=True, initial_error_range=(0.5, 0.1, 1.0), autoreset_mode="Disabled"
    )
    agent = agents.make("lpv-nmpc", envs.single)
    seen = [envs.reset(seed=3)[0]]
    for _ in range(steps - 1):
        seen.append(envs.step(agent.predict(seen[-1])[0])[0])
    return np.array(seen)
