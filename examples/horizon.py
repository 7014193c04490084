"""Read the NMPC's plan and diagnostics at one bend; print where it means to be in a second."""

import argparse

import gymnasium
import numpy as np

import agents
import lpv_track_env  # noqa: F401  registers the ids
from agents.nmpc.rti_agent import RtiNmpc


def main() -> None:
    """Run it; `--help` lists the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectory", default="T2")
    parser.add_argument("--start", type=float, default=55.0, help="arc length, m")
    parser.add_argument("--offset", type=float, default=0.3, help="m left of the path")
    options = parser.parse_args()

    env = gymnasium.make("lpv_track_env/PathTracking-v0", trajectory=options.trajectory)
    agent = agents.make("lpv-nmpc", env)
    assert isinstance(agent, RtiNmpc)
    start = {"arc_length": options.start, "lateral_error": options.offset}
    observation, _ = env.reset(seed=0, options=start)
    action, memory = agent.predict(observation, episode_start=np.array([True]))
    told = agent.diagnostics(memory[0])
    print(f"{told['status']} in {1e6 * told['seconds']:.0f} us, cost {told['cost']:.3f}")
    print(f"action: {action[0]:.2f} m/s^2, {action[1]:.3f} rad; slack used: {told['slack']}")
    # The plan is in the frame of the path's foot point: x along the tangent, y to the left.
    for node in range(0, len(told["plan"]), 5):
        x, y = told["plan"][node]
        print(f"in {0.05 * node:.2f} s: {x:6.2f} m ahead, {y:6.2f} m to the left")


if __name__ == "__main__":
    main()
