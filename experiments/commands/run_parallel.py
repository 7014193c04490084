"""`lpv-track run-parallel`: estimator and controller as processes of their own, in real time."""

import argparse

from rich.console import Console

from experiments.commands.options import agent_settings, conditions_of
from experiments.parallel.options import SETTINGS
from experiments.parallel.options import add_parallel_options as add_options

__all__ = ["EXAMPLE", "add_options", "run"]

EXAMPLE = "lpv-track run-parallel --trajectory T2 --seconds 60 --rate 50"


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.parallel import command
    from experiments.parallel.setup import Setup

    if options.bench_mailbox:
        return command.bench(options.out, console)
    setup = Setup(
        **{name: getattr(options, name) for name in SETTINGS},
        conditions=conditions_of(options),
        agent_settings=agent_settings(options.agent_set, [options.agent])[options.agent],
    )
    return command.run_parallel(setup, options.out, console)
