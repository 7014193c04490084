"""`lpv-track ablation`: each disturbance alone and its cost, and what helps against all of them."""

import argparse

from rich.console import Console

from experiments.commands.options import add_out, add_seeds, add_workers, resumable, seeds_of

EXAMPLE = "lpv-track ablation --trajectories T2 T5 --seeds 10 --out results/ablation"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--agent", default="lpv-nmpc", metavar="NAME")
    parser.add_argument("--trajectories", nargs="+", default=["T2", "T5"], metavar="NAME")
    add_seeds(parser, 10)
    add_out(parser, "results/ablation")
    add_workers(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.realtime.ablation import ablate

    with resumable(options, console):
        return ablate(
            options.out, agent=options.agent, trajectories=options.trajectories,
            seeds=seeds_of(options), workers=options.workers, console=console,
        )  # fmt: skip
