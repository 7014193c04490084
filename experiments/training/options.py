"""Options of `lpv-track train`."""

import argparse
from pathlib import Path

ALGORITHMS = ("ppo", "sac", "td3", "bc", "residual")


def add_training_options(train: argparse.ArgumentParser) -> None:
    """Declare the options; modules that train are loaded only where it runs."""
    train.add_argument(
        "algorithm", choices=ALGORITHMS,
        help="ppo, sac, td3; bc: cloning of lpv-nmpc with DAgger; residual: ppo on top of lpv-nmpc",
    )  # fmt: skip
    train.add_argument("--out", type=Path, metavar="DIR", help="default: results/train/ALGORITHM")
    train.add_argument("--seed", type=int, default=0, help="0 to 999 (default 0)")
    train.add_argument(
        "--steps", type=float, metavar="N", help="budget in environment steps, e.g. 2e7"
    )
    train.add_argument(
        "--hours", type=float, metavar="H",
        help="budget in hours: as many steps as a trial says will fit, or --steps cut short",
    )  # fmt: skip
    train.add_argument("--resume", action="store_true", help="go on from DIR's last checkpoint")
    train.add_argument(
        "--fast",
        action="store_true",
        help="ppo: simulation only, half the updates, less than a minute",
    )
    train.add_argument("--vehicle", metavar="NAME", help="preset or .json (default m2-minibus)")
    train.add_argument(
        "--conditions", nargs="+", metavar="NAME",
        help="kinds that share the environments (default: simulation realtime)",
    )  # fmt: skip
    train.add_argument(
        "--conditions-set", nargs="+", default=[], metavar="KEY=VALUE",
        help="fields to change in each of them, e.g. friction=[0.4,1.0]",
    )  # fmt: skip
    train.add_argument(
        "--trajectories",
        nargs="+",
        metavar="NAME",
        help="own paths in place of random ones; not those of the suites paper and learned",
    )
    train.add_argument("--paths", type=int, metavar="N", help="random paths (default 48)")
    train.add_argument(
        "--envs", type=int, metavar="N",
        help="environments side by side (default: ppo 512, residual and bc 256, others 64)",
    )  # fmt: skip
    train.add_argument(
        "--segment", type=int, metavar="N",
        help="steps between checkpoints, each with a validation (default: ppo 1,000,000, residual "
        "250,000, others 100,000)",
    )  # fmt: skip
    train.add_argument(
        "--from",
        dest="start",
        metavar="POLICY",
        help="policy file to start from, e.g. of bc; ppo fits its value function alone in the "
        "first segment",
    )
    train.add_argument("--control-period", type=float, metavar="S", help="s (default 0.05)")
    train.add_argument("--preview-steps", type=int, metavar="K", help="default 20")
    train.add_argument(
        "--preview-period", type=float, metavar="S", help="s (default: the control period)"
    )
    train.add_argument(
        "--set", nargs="+", default=[], metavar="KEY=VALUE",
        help="hyperparameters, e.g. learning_rate=3e-4 hidden=[128,128]. All: learning_rate, "
        "last_learning_rate, hidden, activation, origin; ppo and residual: rollout, batch, epochs, "
        "discount, gae_lambda, clip_range, deviation; sac and td3: buffer, batch, gradient_steps, "
        "learning_starts, discount, target_rate, td3 noise; bc: round, updates, batch, "
        "expert_share, noise",
    )  # fmt: skip
    train.add_argument(
        "--reward",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="reward weights, e.g. input_rate=1.0 lateral_scale=0.1",
    )
    train.add_argument(
        "--device", metavar="NAME", help="cpu, cuda or auto (default: CUDA where there is one)"
    )
