"""Drive a lap in highway-env's traffic; print how it ended, lateral error and smallest gap."""

import argparse

import gymnasium
import numpy as np

import agents
import lpv_track_env  # noqa: F401  registers the ids


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent", default="lpv-nmpc")
    parser.add_argument("--scene", default="racetrack")
    parser.add_argument("--others", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    options = parser.parse_args()

    env = gymnasium.make(
        "lpv_track_env/HighwayTrack-v0", scene=options.scene, other_vehicles=options.others
    )
    agent = agents.make(options.agent, env)
    observation, info = env.reset(seed=options.seed)
    errors, gaps, memory, start = [], [info["gap"]], None, np.array([True])
    for _ in range(options.steps):
        action, memory = agent.predict(observation, memory, episode_start=start)
        start = np.array([False])
        observation, _, terminated, truncated, info = env.step(action)
        errors.append(info["lateral_error"])
        gaps.append(info["gap"])
        if terminated or truncated:
            break
    rms = float(np.sqrt(np.mean(np.square(errors))))
    print(f"{options.agent} on {options.scene}: {info.get('end', 'still driving')}")
    print(f"lateral error {rms:.3f} m rms, least gap {min(gaps):.1f} m")


if __name__ == "__main__":
    main()
