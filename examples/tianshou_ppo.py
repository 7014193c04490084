"""PPO of Tianshou on environments one after another.

Prints the mean return of 10 s of T2 before and after. Needs Tianshou 2 (see docs/libraries.md).
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import RescaleAction, TransformObservation
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch.distributions import Independent, Normal

import lpv_track_env

# Scalars, curvatures and speeds of an observation in units that make them about 1.
SCALE = np.array([0.1, 1, 1, 0.2, 2, 1, 2, 0.1] + 20 * [10] + 20 * [0.1], dtype=np.float32)


def make() -> gymnasium.Env[Any, Any]:
    """Make an environment with actions in [-1, 1] and scaled observations."""
    env = gymnasium.make(
        lpv_track_env.PATH_TRACKING, trajectory="T2", random_start=True, time_limit=10.0
    )
    env = RescaleAction(env, np.float32(-1), np.float32(1))
    space = gymnasium.spaces.Box(-np.inf, np.inf, env.observation_space.shape, np.float32)
    return TransformObservation(env, lambda seen: SCALE * seen, space)


def mean_return(policy: Any) -> float:
    """Drive 16 episodes with the mean action."""
    envs = DummyVectorEnv([make] * 16)
    envs.seed(1)
    policy.eval()
    collected = Collector(policy, envs).collect(n_episode=16, reset_before_collect=True)
    return float(collected.returns.mean())


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument("--envs", type=int, default=32)
    options = parser.parse_args()
    torch.manual_seed(0)
    env = make()
    bodies = [Net(state_shape=48, hidden_sizes=[64, 64], activation=torch.nn.Tanh) for _ in "ac"]
    actor = ContinuousActorProbabilistic(
        preprocess_net=bodies[0], action_shape=(2,), unbounded=True
    )
    torch.nn.init.constant_(actor.sigma_param, -1.0)
    policy = ProbabilisticActorPolicy(
        actor=actor, dist_fn=lambda both: Independent(Normal(*both), 1), deterministic_eval=True,
        action_space=env.action_space, action_bound_method="clip",
    )  # fmt: skip
    algorithm: Any = PPO(
        policy=policy, critic=ContinuousCritic(preprocess_net=bodies[1]),
        optim=AdamOptimizerFactory(lr=1e-3), gamma=0.97, ent_coef=0.0, max_grad_norm=0.5,
    )  # fmt: skip
    envs = DummyVectorEnv([make] * options.envs)
    envs.seed(0)
    buffer = VectorReplayBuffer(64 * options.envs, options.envs)
    print(f"mean return before: {mean_return(policy):.1f}")
    algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=Collector(algorithm, envs, buffer), max_epochs=1,
            epoch_num_steps=options.steps, collection_step_num_env_steps=64 * options.envs,
            batch_size=16 * options.envs, update_step_num_repetitions=6,
            verbose=False, show_progress=False,
        )
    )  # fmt: skip
    print(f"mean return after {options.steps} steps: {mean_return(policy):.1f}")


if __name__ == "__main__":
    main()
