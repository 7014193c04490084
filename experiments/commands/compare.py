"""`lpv-track compare`: folders of results, or agents within one, drive by drive."""

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console

from experiments.commands import options as shared

if TYPE_CHECKING:
    from experiments.comparison.outcomes import Outcome

EXAMPLE = "lpv-track compare results/before results/after --out results/compare"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "folders", nargs="+", type=shared.file_name, metavar="DIR",
        help="folders of results: agents are compared with those of the same name in the first; in "
        "one folder, with its baseline",
    )  # fmt: skip
    shared.add_agents(parser, "agents to compare, as the tables call them (default: all)")
    parser.add_argument(
        "--baseline", metavar="NAME",
        help="agent of the first folder that all others are compared with (default, in one "
        "folder: the first of --agents, else lpv-nmpc)",
    )  # fmt: skip
    parser.add_argument(
        "--metrics", nargs="+", metavar="NAME",
        help="default: ale mle aoe rms_speed_error steering_rate_rms jerk_rms score reward, and "
        "what a search found",
    )  # fmt: skip
    parser.add_argument(
        "--target", nargs="+", default=[], metavar="METRIC=VALUE",
        help="print optimality gaps: the mean shortfall from a target, e.g. ale=0.05",
    )  # fmt: skip
    parser.add_argument("--latex", action="store_true", help="print the table in LaTeX")
    parser.add_argument(
        "--width", choices=("column", "page"), default="column",
        help="width of the figures: a column of a paper, 3.5 in (default), or its page, 7.2 in",
    )  # fmt: skip
    parser.add_argument(
        "--exact", action="store_true",
        help="compare two folders value by value to the last digit instead; 1 if any differs",
    )  # fmt: skip
    shared.add_seed(parser)
    shared.add_out(parser, "results/compare")


def run(options: argparse.Namespace, console: Console) -> int:
    """Print the comparison, write table, numbers and figures; return 0, with --exact 0 or 1."""
    if options.exact:
        return exactly(options, console)
    from experiments.comparison.texts import latex, terminal
    from experiments.comparison.written import comment, write

    skipped: list[str] = []
    outcomes = compared(options, skipped)
    if options.latex:
        console.out(latex(outcomes, comment(outcomes)), highlight=False, end="")
    else:
        console.print(terminal(outcomes))
    written = write(outcomes, options.out, options.width)
    # LaTeX is printed alone.
    told = Console(stderr=True) if options.latex else console
    for line in skipped:
        told.out(f"left out: {line}", style="red", highlight=False)
    if not options.latex:
        console.out(f"in {options.out}: {', '.join(written)}", highlight=False)
    return 0


def exactly(options: argparse.Namespace, console: Console) -> int:
    """Print the values of two folders that differ; return 1 if any does, else 0."""
    from experiments.run.exact import compare, report_lines

    if len(options.folders) != 2:
        raise ValueError(f"--exact compares two folders, not {len(options.folders)}")
    found = compare(*options.folders)
    for line in report_lines(found):
        console.out(line, highlight=False)
    return shared.EXIT_FAILED if found.differences else 0


def compared(options: argparse.Namespace, skipped: list[str]) -> "list[Outcome]":
    """Return the comparisons that the options ask for."""
    from experiments.comparison.competitors import pairs_between, pairs_within, read_folder
    from experiments.comparison.measures import DEFAULTS, FOUND, SCORE, measure_of
    from experiments.comparison.outcomes import compare
    from trajectories.naming import choose

    targets = targets_of(options.target)
    names: Sequence[str] = options.metrics or (*DEFAULTS, *FOUND)
    measures = [measure_of(name) for name in dict.fromkeys((*names, *targets))]
    folders = [read_folder(folder, measures, skipped) for folder in options.folders]
    known = {SCORE}.union(*(folder.metrics for folder in folders))
    for name in (*(options.metrics or ()), *targets):
        choose("metric", name, tuple(sorted(known)))
    agents = options.agents or []
    if len(folders) == 1:
        pairs = pairs_within(folders[0], agents, options.baseline)
    else:
        pairs = pairs_between(folders, agents, options.baseline)
    drives = {key: drive for folder in folders for key, drive in folder.drives.items()}
    return [compare(a, b, drives, measures, targets, seed=options.seed) for a, b in pairs]


def targets_of(pairs: Sequence[str]) -> dict[str, float]:
    """Return the targets of `--target METRIC=VALUE`, which are positive numbers."""
    from trajectories.arguments import Number

    rule = Number(0.0, above=True)
    return {
        name: rule.of(f"--target {name}", value)
        for name, value in shared.parse_settings(pairs).items()
    }
