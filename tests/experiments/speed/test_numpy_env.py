"""The environment in NumPy drives the same episodes as the compiled one."""

from typing import Any

import numpy as np
import pytest

from experiments.speed.numpy_env import NumpyTracking
from lpv_track_env.vector_env import PathTrackingVectorEnv


@pytest.mark.parametrize(
    "settings",
    [
        {"trajectory": "T1"},
        {"trajectory": "figure-eight", "vehicle": "course-car"},
        {"trajectory": "u-turn", "preview_period": 0.3, "control_period": 0.1},
        {"trajectory": "circle", "speed_mode": "fixed", "fixed_speed": 3.0, "time_limit": 2.0},
        {"trajectory": "straight", "max_lateral_error": 0.4},
    ],
)
def test_same_episodes(settings: dict[str, Any]) -> None:
    n = 50
    env = PathTrackingVectorEnv(
        n, random_start=True, initial_error_range=(0.4, 0.1, 0.5), autoreset_mode="Disabled",
        **settings,
    )  # fmt: skip
    env.reset(seed=0)
    yardstick = NumpyTracking(env.tasks[0], env.records)
    rng = np.random.default_rng(0)
    running = np.ones(n, dtype=bool)
    ends = 0
    for _ in range(60):
        actions = rng.uniform([-0.6, -0.05], [1.0, 0.05], (n, 2))
        observations, rewards, terminated, truncated, infos = env.step(actions)
        wanted = yardstick.step(actions)
        np.testing.assert_allclose(
            yardstick.state[:, running].T, infos["state"][running], atol=1e-9
        )
        for name in ("arc_length", "lateral_error", "heading_error", "speed_error"):
            ours, theirs = getattr(yardstick, name), infos[name]
            np.testing.assert_allclose(ours[running], theirs[running], rtol=0, atol=1e-9)
        np.testing.assert_allclose(wanted[1][running], rewards[running], rtol=0, atol=1e-9)
        # float32 rounds two values that are 1e-9 apart to at most neighbouring numbers.
        np.testing.assert_allclose(
            wanted[0][running], observations[running], rtol=2.0**-23, atol=2e-9
        )
        np.testing.assert_array_equal(wanted[2][running], terminated[running])
        np.testing.assert_array_equal(wanted[3][running], truncated[running])
        ended = terminated | truncated
        running &= ~ended
        ends += int(ended.sum())
        if ended.any():
            env.reset(options={"reset_mask": ended})
    assert running.any() or ends >= n
