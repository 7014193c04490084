"""`lpv-track merge`: folders of results, such as shards of one benchmark, joined into one."""

import argparse

from rich.console import Console

from experiments.commands.options import file_name, resumable

EXAMPLE = "lpv-track merge results/all results/shard-1 results/shard-2"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("out", type=file_name, metavar="OUT", help="folder of the joined results")
    parser.add_argument(
        "folders", type=file_name, nargs="+", metavar="FOLDER", help="folders to join"
    )


def run(options: argparse.Namespace, console: Console) -> int:
    """Join the folders, print the number of cases, and return 0."""
    from experiments.run.benchmark import progress_bar
    from experiments.run.merging import merge

    with resumable(options, console), progress_bar(console) as progress:
        bar = progress.add_task("cases")
        found = merge(
            options.out, options.folders,
            lambda done, total: progress.update(bar, completed=done, total=total),
        )  # fmt: skip
    for line in found.skipped:
        console.out(f"left out: {line}", style="red", highlight=False)
    console.out(
        f"{found.cases} cases in {options.out}, {found.added} of them added from "
        f"{len(options.folders)} folder{'s' * (len(options.folders) > 1)}; tables and report: "
        f"lpv-track report {options.out}",
        highlight=False,
    )
    return 0
