"""`lpv-track tuning-study`: compare the ways to weights."""

import argparse

from rich.console import Console

from experiments.tuning.options import add_study_options as add_options

__all__ = ["EXAMPLE", "add_options", "run"]

EXAMPLE = "lpv-track tuning-study --seeds 10 --out results/tuning-study"


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.study.command import run_study

    return run_study(options, console)
