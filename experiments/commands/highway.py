"""`lpv-track highway`: agents in highway-env's traffic, beside its own controllers."""

import argparse

from rich.console import Console

from experiments.commands.options import resumable
from experiments.highway.options import add_highway_options as add_options

__all__ = ["EXAMPLE", "add_options", "run"]

EXAMPLE = "lpv-track highway --scene racetrack --agents lpv-nmpc ppo idm --seeds 20"


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.highway.command import run_highway

    with resumable(options, console):
        return run_highway(options, console)
