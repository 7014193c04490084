"""`lpv-track bag`: exchange drives with ROS."""

import argparse

from rich.console import Console

from experiments.ros.arguments import add_bag_parsers as add_options

__all__ = ["EXAMPLE", "add_options", "run"]

EXAMPLE = "lpv-track bag export --trajectory T2 --out run.bag"


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.ros.command import run_bag

    return run_bag(options, console)
