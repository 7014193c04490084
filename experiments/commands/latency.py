"""`lpv-track latency`: estimation and control in sequence or in parallel, and the effect of it."""

import argparse
from pathlib import Path

from rich.console import Console

from experiments.commands.options import add_out, add_seeds, add_workers, resumable, seeds_of

EXAMPLE = "lpv-track latency --trajectories T2 T4 --seeds 10 --out results/latency"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--trajectories", nargs="+", default=["T2", "T4"], metavar="NAME")
    add_seeds(parser, 10)
    parser.add_argument(
        "--times",
        type=Path,
        metavar="FILE",
        help="times.json of an earlier run, in place of recording",
    )
    add_out(parser, "results/latency")
    add_workers(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.parallel.latency import compare

    with resumable(options, console):
        return compare(
            options.out, times=options.times, trajectories=options.trajectories,
            seeds=seeds_of(options), workers=options.workers, console=console,
        )  # fmt: skip
