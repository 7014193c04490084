"""`lpv-track verify`: the real-time NMPC against independent solvers, models and derivatives."""

import argparse

from rich.console import Console

from experiments.commands.options import add_out, add_seed, add_workers

EXAMPLE = "lpv-track verify --states 200 --out results/verify"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--states", type=int, default=1000, metavar="N", help="default 1000")
    parser.add_argument("--quick", action="store_true", help="24 states, whatever --states says")
    add_seed(parser)
    parser.add_argument(
        "--solver", metavar="MODULE:CLASS", help="default: the real-time solver of lpv-nmpc"
    )
    add_out(parser, "results/verify")
    add_workers(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.verify.command import QUICK, SOLVER, verify

    return verify(
        options.out,
        states=QUICK if options.quick else options.states,
        seed=options.seed,
        workers=options.workers,
        solver=options.solver or SOLVER,
        console=console,
    )
