"""`lpv-track report`: the tables and report.html of saved cases."""

import argparse
from pathlib import Path

from rich.console import Console

EXAMPLE = "lpv-track report results/benchmark"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("folder", type=Path, metavar="DIR")


def run(options: argparse.Namespace, console: Console) -> int:
    """Rebuild `report.html`, print the tables, and return 0."""
    from experiments.report.build import where, write_report
    from experiments.run.console_tables import all_tables
    from experiments.run.store import ResultStore

    if not options.folder.is_dir():
        raise ValueError(f"{options.folder} is not a folder of results")
    report = write_report(options.folder)
    console.print(all_tables(ResultStore(options.folder).cases()))
    console.out(where(report), highlight=False)
    return 0
