"""Drive a path with the LPV-NMPC; print how the drive ended and the largest lateral error."""

import argparse

import gymnasium
import numpy as np

import agents
import lpv_track_env  # noqa: F401  registers the ids


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectory", default="T2")
    parser.add_argument("--agent", default="lpv-nmpc", choices=agents.names())
    parser.add_argument("--steps", type=int, default=100_000, help="at most (default: to the end)")
    options = parser.parse_args()

    env = gymnasium.make("lpv_track_env/PathTracking-v0", trajectory=options.trajectory)
    agent = agents.make(options.agent, env)
    observation, info = env.reset(seed=0)
    errors = [info["lateral_error"]]
    start, done = True, False
    while not done and len(errors) <= options.steps:
        action, _ = agent.predict(observation, episode_start=np.array([start]))
        observation, _, terminated, truncated, info = env.step(action)
        errors.append(info["lateral_error"])
        start, done = False, terminated or truncated
    print(f"end: {info.get('end', 'not yet')} after {info['arc_length']:.0f} m")
    print(f"largest lateral error: {np.abs(errors).max():.3f} m")


if __name__ == "__main__":
    main()
