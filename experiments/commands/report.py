"""`lpv-track report`: the tables and report.html of saved cases."""

import argparse

from rich.console import Console

from experiments.commands.options import file_name

EXAMPLE = "lpv-track report results/benchmark"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("folder", type=file_name, metavar="DIR")
    parser.add_argument(
        "--open-named-files", action="store_true",
        help="open the files of paths and vehicles that the results name; for results you trust",
    )  # fmt: skip


def run(options: argparse.Namespace, console: Console) -> int:
    """Rebuild `report.html`, print the tables, and return 0."""
    from experiments.report.build import where, write_report
    from experiments.report.drives import NamedFiles
    from experiments.run.console_tables import all_tables
    from experiments.run.result_schema import read_driven
    from experiments.run.store import ResultStore

    if not options.folder.is_dir():
        raise ValueError(f"{options.folder} is not a folder of results")
    files = NamedFiles(None if options.open_named_files else frozenset())
    skipped: list[str] = []
    report = write_report(options.folder, files)
    console.print(all_tables(ResultStore(options.folder).cases(skipped, read_driven)))
    for line in skipped:
        console.out(f"left out: {line}", style="red", highlight=False)
    console.out(where(report), highlight=False)
    return 0
