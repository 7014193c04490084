"""PPO of Ray's RLlib, whose workers make the environments by themselves.

Prints the mean return of 10 s of T2 before and after. Needs `lpv-track-env[rllib]`.
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
import ray
from gymnasium.wrappers import RescaleAction, TransformObservation
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.tune.registry import register_env

import lpv_track_env

# Scalars, curvatures and speeds of an observation in units that make them about 1.
SCALE = np.array([0.1, 1, 1, 0.2, 2, 1, 2, 0.1] + 20 * [10] + 20 * [0.1], dtype=np.float32)


def make(config: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    """Make an environment with actions in [-1, 1] and scaled observations."""
    env = gymnasium.make(lpv_track_env.PATH_TRACKING, **config)
    env = RescaleAction(env, np.float32(-1), np.float32(1))
    space = gymnasium.spaces.Box(-np.inf, np.inf, env.observation_space.shape, np.float32)
    return TransformObservation(env, lambda seen: SCALE * seen, space)


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--envs", type=int, default=16, help="of each worker")
    options = parser.parse_args()
    ray.init(num_cpus=options.workers + 2, include_dashboard=False)
    register_env("path-tracking", make)
    given = {"trajectory": "T2", "random_start": True, "time_limit": 10.0}
    config = (
        PPOConfig()
        .environment("path-tracking", env_config=given)
        .env_runners(num_env_runners=options.workers, num_envs_per_env_runner=options.envs)
        .rl_module(
            model_config=DefaultModelConfig(fcnet_hiddens=[64, 64], free_log_std=True)
        )
        .training(
            gamma=0.97, lambda_=0.95, lr=1e-3, grad_clip=0.5, clip_param=0.2, entropy_coeff=0.0,
            train_batch_size_per_learner=4000, minibatch_size=1000, num_epochs=6, use_kl_loss=False,
            vf_clip_param=100.0,
        )
        .evaluation(
            evaluation_duration=16, evaluation_config={"explore": False},
            evaluation_num_env_runners=1,
        )
        .debugging(seed=0)
    )  # fmt: skip
    algorithm = config.build_algo()

    def mean_return() -> float:
        return float(algorithm.evaluate()["env_runners"]["episode_return_mean"])

    print(f"mean return before: {mean_return():.1f}")
    for _ in range(options.steps // 4000):
        algorithm.train()
    print(f"mean return after {options.steps} steps: {mean_return():.1f}")
    algorithm.stop()


if __name__ == "__main__":
    main()
