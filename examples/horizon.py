"""Print the NMPC's diagnostics and its plan for the next two seconds, at the start of a bend."""

import argparse
from typing import Any

import gymnasium
import numpy as np

import agents
import lpv_track_env  # noqa: F401  registers the ids


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectory", default="T2")
    parser.add_argument("--start", type=float, default=55.0, help="arc length, m")
    parser.add_argument("--offset", type=float, default=0.3, help="m left of the path")
    options = parser.parse_args()

    env = gymnasium.make("lpv_track_env/PathTracking-v0", trajectory=options.trajectory)
    agent: Any = agents.make("lpv-nmpc", env)
    start = {"arc_length": options.start, "lateral_error": options.offset}
    observation, _ = env.reset(seed=0, options=start)
    action, memory = agent.predict(observation, episode_start=np.array([True]))
    solve = agent.diagnostics(memory[0])
    print(f"{solve['status']} in {1e6 * solve['seconds']:.0f} us, cost {solve['cost']:.3f}")
    print(f"action: {action[0]:.2f} m/s^2, {action[1]:.3f} rad; slack used: {solve['slack']}")
    # The origin of the plan is the nearest point of the path: x along its tangent, y to the left.
    for node in range(0, len(solve["plan"]), 3):
        x, y = solve["plan"][node]
        time = agent.problem.times[node]
        print(f"in {time:.2f} s: {x:6.2f} m ahead, {y:6.2f} m to the left")


if __name__ == "__main__":
    main()
