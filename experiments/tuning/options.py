"""Options of `lpv-track tune`."""

import argparse
from pathlib import Path

METHODS = ("fixed", "paper", "search", "bands", "gradient", "catalogue", "rl", "paired")


def add_tuning_options(tune: argparse.ArgumentParser) -> None:
    """Declare the options; modules that tune are loaded only where it runs."""
    tune.add_argument(
        "--method", choices=METHODS, required=True,
        help="fixed: the default weights; paper: a set by the path's sharpest curvature; search: "
        "the best fixed set, by CMA-ES; bands: a set a band of curvature, by CMA-ES; gradient: the "
        "same by gradients of the closed loop; catalogue: PPO chooses sets while driving; rl: PPO "
        "multiplies weights while driving; paired: a linear policy does, learned from drives "
        "alike but for their weights",
    )  # fmt: skip
    tune.add_argument("--out", type=Path, metavar="DIR", help="default: results/tune/METHOD")
    tune.add_argument(
        "--solves", type=float, default=300_000, metavar="N",
        help="budget in solves of the NMPC, e.g. 3e6 (default 3e5); never exceeded",
    )  # fmt: skip
    tune.add_argument("--seed", type=int, default=0, help="0 to 999 (default 0)")
    tune.add_argument("--resume", action="store_true", help="go on with what DIR holds")
    tune.add_argument("--vehicle", metavar="NAME", help="preset or .json (default m2-minibus)")
    tune.add_argument(
        "--trajectories", "--paths", nargs="+", metavar="PATH", dest="trajectories",
        help="own paths, names or files, in place of random ones; not those of the evaluation",
    )  # fmt: skip
    tune.add_argument(
        "--random-paths", type=int, metavar="N", dest="paths", help="random paths (default 32)"
    )
    tune.add_argument(
        "--conditions", metavar="NAME",
        help="simulation, realtime, randomised (default: randomised)",
    )  # fmt: skip
    tune.add_argument(
        "--conditions-set", nargs="+", default=[], metavar="KEY=VALUE",
        help="fields to change in them, e.g. gnss_noise=[0.01,0.3]",
    )  # fmt: skip
    tune.add_argument(
        "--drives", type=int, metavar="N",
        help="drives that judge a candidate (default 16), environments of PPO (default 64), drives "
        "of paired (default 32)",
    )  # fmt: skip
    tune.add_argument(
        "--time-limit", type=float, metavar="S", help="of a drive (default 10 s, PPO 20 s)"
    )
    tune.add_argument("--control-period", type=float, metavar="S", help="s (default 0.05)")
    tune.add_argument("--preview-steps", type=int, metavar="K", help="default 20")
    tune.add_argument(
        "--preview-period", type=float, metavar="S", help="s (default: the control period)"
    )
    tune.add_argument(
        "--directions", metavar="NAME",
        help="what is chosen apart: joint (speed, heading, position), stages (these in Q and in S, "
        "the default), all (each of Q and S)",
    )  # fmt: skip
    tune.add_argument(
        "--span", type=float, metavar="F", help="largest factor on a default weight (default 100)"
    )
    tune.add_argument("--window", type=float, metavar="S", help="between decisions (default 0.4)")
    tune.add_argument(
        "--view", metavar="NAME",
        help="what catalogue and rl see: all (default), path (curvature, speed, band), drive "
        "(errors' history, lags, noise)",
    )  # fmt: skip
    tune.add_argument(
        "--set", nargs="+", default=[], metavar="KEY=VALUE",
        help="hyperparameters: sigma of search and gradient; pairs, learning_rate of gradient; of "
        "catalogue and rl learning_rate, last_learning_rate, rollout, batch, epochs, discount, "
        "gae_lambda, clip_range, deviation, hidden, segment; of paired deviation, hold, curvature, "
        "response, least_curvature, half_life, step",
    )  # fmt: skip


def add_study_options(study: argparse.ArgumentParser) -> None:
    """Declare the options."""
    study.add_argument("--out", type=Path, default=Path("results/tuning-study"), metavar="DIR")
    study.add_argument(
        "--seeds", type=int, default=10, metavar="N", help="trainings a rung (default 10)"
    )
    study.add_argument(
        "--solves", type=float, default=300_000, metavar="N", help="of a training (default 3e5)"
    )
    study.add_argument(
        "--rungs", nargs="+", metavar="NAME", help="default: all; an unknown one lists them"
    )
    study.add_argument(
        "--drives", type=int, default=8, metavar="N",
        help="drives a path that judge a training (default 8)",
    )  # fmt: skip
    study.add_argument(
        "--tracks", type=Path, metavar="DIR",
        help="folder of TUMFTM centre lines (x_m,y_m,...): one more set",
    )  # fmt: skip
    study.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default 2)")
    study.add_argument(
        "--quick", action="store_true",
        help="2 trainings of 60,000 solves, 2 drives a path, small oracles: what it looks like",
    )  # fmt: skip
