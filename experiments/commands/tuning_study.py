"""`lpv-track tuning-study`: compare the ways to weights."""

import argparse
from typing import TYPE_CHECKING

from rich.console import Console

from experiments.commands.options import (
    add_engine,
    add_out,
    amount,
    engine_of,
    file_name,
    resumable,
    whole,
)

if TYPE_CHECKING:
    from experiments.study.study import Study

EXAMPLE = "lpv-track tuning-study --seeds 10 --out results/tuning-study"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_out(parser, "results/tuning-study")
    parser.add_argument(
        "--seeds", type=whole(1, 1000), default=10, metavar="N",
        help="trainings a rung (default 10)",
    )  # fmt: skip
    parser.add_argument(
        "--solves", type=amount, default=300_000, metavar="N", help="of a training (default 3e5)"
    )
    parser.add_argument(
        "--rungs", nargs="+", metavar="NAME", help="default: all; an unknown one lists them"
    )
    parser.add_argument(
        "--drives", type=whole(2, 10_000), default=8, metavar="N",
        help="drives on each path in the evaluation of a training (default 8)",
    )  # fmt: skip
    parser.add_argument(
        "--tracks", type=file_name, metavar="DIR",
        help="folder of TUMFTM centre lines (x_m,y_m,...): one more set",
    )  # fmt: skip
    add_engine(parser)
    parser.add_argument(
        "--quick", action="store_true",
        help="2 trainings of 60,000 solves, 2 drives a path, small oracles: a preview",
    )  # fmt: skip


def study_of(options: argparse.Namespace) -> "Study":
    """Return the study that the options ask for.

    Raises
    ------
    ValueError
        For an unknown rung or a folder without tracks.
    """
    from experiments.study.evaluation import track_set, usual_sets
    from experiments.study.study import RUNGS, Study, checked_labels

    labels = checked_labels(options.rungs or [rung.label for rung in RUNGS])
    quick = options.quick
    sets = usual_sets(2 if quick else options.drives)
    if options.tracks is not None:
        sets.append(track_set(options.tracks, options.drives))
    return Study(
        options.out, labels, tuple(range(2 if quick else options.seeds)),
        60_000 if quick else options.solves, tuple(sets),
    )  # fmt: skip


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code: trainings, evaluations, oracles, report."""
    from collections.abc import Iterator

    from experiments.run.benchmark import progress_bar
    from experiments.study.oracle import study_oracles
    from experiments.study.report import write_report
    from experiments.study.study import run_evaluations, run_trainings

    study, engine = study_of(options), engine_of(options)
    with study.claimed(), resumable(options, console), progress_bar(console) as progress:

        def follow(words: str, steps: Iterator[tuple[int, int]]) -> None:
            bar = progress.add_task(words, total=None)
            for done, count in steps:
                progress.update(bar, completed=done, total=count or 1)
            progress.update(bar, completed=1, total=1)

        follow("trainings", run_trainings(study, engine))
        follow("evaluations", run_evaluations(study, engine))
        headroom, greedy = study_oracles(study, progress, quick=options.quick)
    report = study.folder / "report.html"
    summary = write_report(study, headroom, greedy, report)
    for line in summary["ladder"]:
        console.print("  ".join(line[:1] + line[2:10]), markup=False, highlight=False)
    console.print(f"report: {report}", markup=False, soft_wrap=True)
    return 0
