"""Train PPO in the compiled vector environment, save the policy and drive with it.

Prints the policy's result on a path that was not used in training. Needs `lpv-track-env[rl]`.
"""

import argparse
from pathlib import Path

from stable_baselines3 import PPO

import agents
from agents.learned import write
from agents.learned.learner import LearnerVecEnv
from experiments.run.case import run_case
from lpv_track_env.vector_env import PathTrackingVectorEnv


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=3_000_000)
    parser.add_argument("--envs", type=int, default=512)
    parser.add_argument("--out", type=Path, default=Path("mine.json"))
    options = parser.parse_args()

    envs = PathTrackingVectorEnv(
        options.envs,
        trajectory=[f"random-{1000 + k}" for k in range(20)],
        random_start=True,
        initial_error_range=(0.5, 0.1, 1.0),
        time_limit=20.0,
        autoreset_mode="SameStep",
    )
    learner = LearnerVecEnv(agents.sb3_vec_env(envs))
    model = PPO(
        "MlpPolicy",
        learner,
        n_steps=32,
        batch_size=8 * options.envs,
        n_epochs=4,
        gamma=0.97,
        seed=0,
        device="cpu",
    )
    model.learn(options.steps)
    write(learner.policy_of(model, "mine"), options.out)
    result = run_case({"agent": str(options.out), "trajectory": "T2"})
    print(f"{options.out}: {result['end']}, {result['metrics']['completed']:.0%} of T2")
    print(f"ALE {result['metrics']['ale']:.3f} m, reward {result['metrics']['reward']:.1f}")


if __name__ == "__main__":
    main()
