"""`lpv-track speed`: how fast the environments and the solvers are, against their peers."""

import argparse

from rich.console import Console

from experiments.commands.options import EXIT_INTERRUPTED, add_out

EXAMPLE = "lpv-track speed --only single vector --out results/speed"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_out(parser, "results/speed")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="SECTION",
        help="default: all of single, vector, conditions, learning, training, solvers, policies, "
        "horizons, batches, wild, loops, tuning, rendering, memory, startup",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="tiny: shows that it works, no more")


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.speed.command import run_speed

    _, complete = run_speed(options.out, only=options.only, quick=options.quick, console=console)
    console.print(
        f"{'every round' if complete else 'interrupted; what was measured'}: "
        f"{options.out / 'speed.json'}",
        markup=False, highlight=False, soft_wrap=True,
    )  # fmt: skip
    return 0 if complete else EXIT_INTERRUPTED
