"""Tune the NMPC's weights by random search in compiled closed loops; print the best candidate.

All candidates drive the same paths under the same disturbances, in one call. `lpv-track tune` has
better methods, built from the same parts.
"""

import argparse
from typing import Any

import numpy as np

import agents
from agents.weight_tuning.closed_loop import ClosedLoop
from agents.weight_tuning.score import scores_of
from agents.weights import TrackingWeights
from lpv_track_env.vector_env import PathTrackingVectorEnv


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--candidates", type=int, default=16)
    parser.add_argument("--drives", type=int, default=8, help="per candidate")
    parser.add_argument("--seconds", type=float, default=10.0, help="per drive")
    options = parser.parse_args()

    n = options.candidates * options.drives
    envs = PathTrackingVectorEnv(
        n,
        [f"random-{10_000_000 + k}" for k in range(4)],
        conditions="randomised",
        random_start=True,
        autoreset_mode="Disabled",
    )
    agent: Any = agents.make("lpv-nmpc", envs.single)
    loop = ClosedLoop(envs, agent)
    default = TrackingWeights().as_array()
    factors = np.ones((options.candidates, default.size))  # the first: the default weights
    random = np.random.default_rng(0)
    factors[1:, :8] = np.exp(random.normal(0.0, 1.0, (options.candidates - 1, 8)))  # of Q and S
    candidates = default * factors

    # Drive d has the same seed for all candidates, so that they differ in their weights alone.
    loop.reset(seed=[d for _ in range(options.candidates) for d in range(options.drives)])
    tally = loop.drive(round(options.seconds / 0.05), np.repeat(candidates, options.drives, axis=0))
    each = scores_of(tally, envs.arrays.ends).reshape(options.candidates, options.drives)
    scores = each.mean(axis=1)
    best = int(np.argmin(scores))
    print(f"{int(tally.solves.sum())} solves; default weights score {scores[0]:.3f}")
    print(f"best of {options.candidates} scores {scores[best]:.3f}: lower is better")
    print(TrackingWeights.from_array(candidates[best].round(3)))


if __name__ == "__main__":
    main()
