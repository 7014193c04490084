"""`lpv-track import-policy`: a model of Stable-Baselines3 becomes a policy file."""

import argparse
from pathlib import Path

from rich.console import Console

EXAMPLE = "lpv-track import-policy model.zip --algorithm ppo --trust --out mine.json"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("model", type=Path, metavar="MODEL.zip", help="what model.save() wrote")
    parser.add_argument("--algorithm", required=True, choices=["ppo", "sac", "td3"])
    parser.add_argument(
        "--trust", action="store_true",
        help="load it, although loading such a file runs whatever code it holds",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="NAME.json")
    parser.add_argument(
        "--vehicle", default="m2-minibus", metavar="NAME", help="driven in training"
    )
    parser.add_argument("--control-period", type=float, default=0.05, metavar="S")
    parser.add_argument("--preview-steps", type=int, default=20, metavar="K")
    parser.add_argument(
        "--preview-period", type=float, metavar="S", help="default: the control period"
    )


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.policy_import import run_import

    return run_import(options, console)
