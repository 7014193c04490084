"""Drive with a real vehicle's sensors and actuators; print tracking and estimation errors.

A second drive has GNSS fixes that are three times as noisy: every field of the conditions can be
changed.
"""

import argparse

import gymnasium
import numpy as np

import agents
import lpv_track_env  # noqa: F401  registers the ids
from lpv_track_env.conditions import REALTIME, Conditions


def drive(trajectory: str, conditions: Conditions) -> tuple[float, float]:
    """Return the rms of the lateral error and of the position estimate's error, m."""
    env = gymnasium.make(
        "lpv_track_env/PathTracking-v0", trajectory=trajectory, conditions=conditions
    )
    agent = agents.make("lpv-nmpc", env)  # compensates the delays of the conditions
    observation, info = env.reset(seed=0)
    lateral, estimate = [], []
    done, start = False, True
    while not done:
        action, _ = agent.predict(observation, episode_start=np.array([start]))
        observation, _, terminated, truncated, info = env.step(action)
        lateral.append(info["lateral_error"])
        estimate.append(np.hypot(*(info["estimate"] - info["state"])[4:]))
        done, start = terminated or truncated, False
    print(f"{conditions.name}: {info['end']}, deadlines missed: {info['deadline_misses']}")
    return float(np.sqrt(np.mean(np.square(lateral)))), float(np.sqrt(np.mean(np.square(estimate))))


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectory", default="T2")
    trajectory: str = parser.parse_args().trajectory
    noisy = REALTIME.replace(name="noisy fixes", gnss_noise=0.09, gnss_wander=0.09)
    for conditions in (REALTIME, noisy):
        lateral, estimate = drive(trajectory, conditions)
        print(f"  lateral error {lateral:.3f} m rms, position estimate off by {estimate:.3f} m rms")


if __name__ == "__main__":
    main()
