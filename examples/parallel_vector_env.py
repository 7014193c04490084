"""Step many environments in one compiled call; print the speed, and check one against a single."""

import argparse
import time

import gymnasium
import numpy as np

import lpv_track_env  # noqa: F401  registers the ids

ID = "lpv_track_env/PathTracking-v0"


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=200)
    options = parser.parse_args()

    envs = gymnasium.make_vec(
        ID,
        num_envs=options.envs,
        vectorization_mode="vector_entry_point",
        trajectory=["T1", "T4", "random-3"],  # drawn at every reset
        autoreset_mode="SameStep",
    )
    envs.action_space.seed(0)
    envs.reset(seed=0)
    actions = [envs.action_space.sample() for _ in range(8)]
    envs.step(actions[0])  # compiles on the first run
    began = time.perf_counter()
    ended = 0
    for k in range(options.steps):
        _, _, terminated, truncated, _ = envs.step(actions[k % len(actions)])
        ended += int(np.sum(terminated | truncated))
    per_step = (time.perf_counter() - began) / options.steps / options.envs
    print(f"{1e6 * per_step:.2f} us a step and environment; {ended} episodes ended")

    same = gymnasium.make_vec(
        ID, num_envs=4, vectorization_mode="vector_entry_point", trajectory="T2"
    )
    many, _ = same.reset(seed=7)
    alone, _ = gymnasium.make(ID, trajectory="T2").reset(seed=7 + 3)
    print(f"environment 3 of seed 7 is the single one of seed 10: {np.array_equal(many[3], alone)}")


if __name__ == "__main__":
    main()
