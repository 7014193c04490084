"""`lpv-track run-parallel`: estimator and controller as separate processes, in real time."""

import argparse
import json
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from experiments.commands.options import (
    add_agent_settings,
    add_conditions,
    add_out,
    add_seed,
    add_vehicle,
    agent_settings,
    conditions_of,
)
from experiments.run.provenance import load_average, measured_on

if TYPE_CHECKING:
    from experiments.parallel.recording import Outcome, Summary

EXAMPLE = "lpv-track run-parallel --trajectory T2 --seconds 60 --rate 50"
SETTINGS = ("trajectory", "agent", "vehicle", "estimator", "rate", "seconds", "seed", "watchdog")
"""Options that are fields of `Setup` of the same name."""
RUN_FILE, MAILBOX_FILE = "run.json", "mailbox.json"
FORMAT = "lpv-track-parallel/1"
EXIT_FAILED = 1
EXIT_SIGNAL = 128
"""Plus the signal's number: 130 after Ctrl-C, 143 after SIGTERM."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--trajectory", default="T2", metavar="NAME")
    parser.add_argument("--agent", default="lpv-nmpc", metavar="NAME", help="or file.py:Class")
    add_agent_settings(parser)
    add_vehicle(parser)
    add_conditions(parser, "realtime", "realtime, ideal or simulation")
    parser.add_argument(
        "--estimator", default="ekf", metavar="NAME", help="ekf, or truth: the true state"
    )
    parser.add_argument(
        "--seconds", type=float, default=60.0, metavar="S", help="or until the path ends"
    )
    parser.add_argument("--rate", type=int, default=50, metavar="HZ", help="default 50")
    add_seed(parser)
    parser.add_argument(
        "--watchdog", type=int, default=25, metavar="N",
        help="control periods of silence after which a process counts as hung (default 25)",
    )  # fmt: skip
    add_out(parser, "results/parallel")
    parser.add_argument(
        "--bench-mailbox", action="store_true",
        help="drive nothing: measure how long a value takes from process to process",
    )  # fmt: skip


def run(options: argparse.Namespace, console: Console) -> int:
    """Drive, or measure the mailbox with `--bench-mailbox`; return the exit code.

    Raises
    ------
    OSError
        If the folder cannot be written; before anything is driven.
    """
    if options.bench_mailbox:
        return _bench(options.out, console)
    from experiments.parallel.setup import Setup

    setup = Setup(
        **{name: getattr(options, name) for name in SETTINGS},
        conditions=conditions_of(options),
        agent_settings=agent_settings(options.agent_set, [options.agent])[options.agent],
    )
    import trajectories
    from experiments.figures import save_figure
    from experiments.parallel import report, supervisor
    from experiments.parallel.recording import summarise

    file = options.out / RUN_FILE
    result = {"format": FORMAT, **measured_on(), "settings": asdict(setup)}
    _write(result, file)

    def say(line: str) -> None:
        console.out(line, highlight=False)
        console.file.flush()

    outcome = supervisor.run(setup, say)
    summary = summarise(setup, outcome)
    result["machine"]["load_average_after"] = load_average()
    result["run"] = summary
    _write(result, file)
    figure = report.draw(setup, outcome, summary, trajectories.load(setup.trajectory))
    if figure is not None:
        save_figure(figure, options.out / "run.png")
        console.print(report.table(setup, summary))
    for line in report.sentences(summary):
        say(line)
    say(f"report: {file}")
    return verdict(outcome, summary)


def verdict(outcome: "Outcome", summary: "Summary") -> int:
    """Return the exit code, and print one line on stderr for what failed.

    The code is 0 only if the run was complete and the rate was held.
    """
    if outcome.signal:
        return EXIT_SIGNAL + outcome.signal
    if outcome.fault:
        reason = outcome.fault
    elif not summary["complete"]:
        reason = f"the drive ended before its time: {outcome.end}"
    elif not summary["held"]:
        reason = (
            f"the rate was not held: {summary['deadline_misses']} of {summary['periods']} "
            "periods were not answered in time"
        )
    else:
        return 0
    print(f"lpv-track: {reason}", file=sys.stderr)
    return EXIT_FAILED


def _bench(folder: Path, console: Console) -> int:
    """Measure the mailbox, print a table, write `mailbox.json`; return the exit code."""
    from experiments.parallel.mailbox_bench import bench_mailbox

    result = {"format": FORMAT, **measured_on()}
    _write(result, folder / MAILBOX_FILE)
    result["mailbox"] = bench_mailbox(console)
    result["machine"]["load_average_after"] = load_average()
    _write(result, folder / MAILBOX_FILE)
    return 0


def _write(result: dict[str, Any], file: Path) -> None:
    from trajectories.fileio import write_atomically

    result["written"] = datetime.now(UTC).isoformat(timespec="seconds")
    content = json.dumps(result, indent=1, allow_nan=False)
    write_atomically(file, content.encode() + b"\n")
