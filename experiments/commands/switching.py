"""`lpv-track switching`: whether switching the NMPC's weights loses vehicles."""

import argparse
from pathlib import Path

from rich.console import Console

from experiments.commands.options import add_out, add_seed, add_vehicle, resumable

EXAMPLE = "lpv-track switching --episodes 2000 --spans 10 100 whole --out results/switching"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--episodes", type=int, default=2000, metavar="N", help="of each arm (default 2000)"
    )
    parser.add_argument(
        "--spans", nargs="+", default=["10", "100", "1000", "whole"], metavar="FACTOR",
        help="how far weights are drawn from the base ones (default 10 100 1000 whole: the "
        "whole bounds of weights)",
    )  # fmt: skip
    parser.add_argument(
        "--weights", type=Path, metavar="FILE",
        help="schedule of one set to switch around, as of tune --method search (default: the "
        "default weights)",
    )  # fmt: skip
    parser.add_argument(
        "--candidates", type=int, default=4, metavar="K",
        help="draws in every window of which the adversary takes the worst (default 4)",
    )  # fmt: skip
    parser.add_argument("--conditions", default="realtime", metavar="NAME")
    add_vehicle(parser)
    add_seed(parser)
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="default 1; results do not depend on it"
    )
    add_out(parser, "results/switching")


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.robustness.command import run_switching

    with resumable(options, console):
        return run_switching(options, console)
