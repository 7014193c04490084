"""`lpv-track tune`: tune the NMPC's weights."""

import argparse

from rich.console import Console

from experiments.tuning.options import add_tuning_options as add_options

__all__ = ["EXAMPLE", "add_options", "run"]

EXAMPLE = "lpv-track tune --method rl --seed 0 --out results/tune/rl"


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.tuning.command import run_tuning

    return run_tuning(options, console)
