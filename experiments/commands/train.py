"""`lpv-track train`: train a policy that drives."""

import argparse

from rich.console import Console

from experiments.training.options import add_training_options as add_options

__all__ = ["EXAMPLE", "add_options", "run"]

EXAMPLE = "lpv-track train ppo --seed 0 --hours 0.1 --out results/ppo"


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.training.command import run_training

    return run_training(options, console)
