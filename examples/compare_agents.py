"""Compare agents over seeds in a pool of processes; print means and 95 % confidence intervals."""

import argparse
from collections import defaultdict

import numpy as np
from scipy.stats import t as student

from experiments.run.engines import local_pool


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agents", nargs="+", default=["lpv-nmpc", "stanley", "ppo"])
    parser.add_argument("--trajectory", default="T2")
    parser.add_argument("--conditions", default="realtime")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()

    specs = [
        {
            "agent": agent,
            "trajectory": options.trajectory,
            "conditions": options.conditions,
            "seed": seed,
        }
        for agent in options.agents
        for seed in range(options.seeds)
    ]
    values: dict[str, list[float]] = defaultdict(list)
    for result in local_pool(specs, options.workers):
        if result["status"] != "ok":
            raise SystemExit(f"{result['agent']}, seed {result['seed']}: {result['error']}")
        values[result["agent"]].append(result["metrics"]["ale"])
    for agent in options.agents:
        ale = np.array(values[agent])
        half = student.ppf(0.975, ale.size - 1) * ale.std(ddof=1) / np.sqrt(ale.size)
        print(f"{agent:14} ALE {ale.mean():.4f} m ± {half:.4f} over {ale.size} seeds")


if __name__ == "__main__":
    main()
