"""`lpv-track run-parallel`: drive, report, and tell by the exit code whether all went well."""

import json
import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

import trajectories
from experiments.figures import save_figure
from experiments.parallel.bench import bench_mailbox
from experiments.parallel.figures import picture
from experiments.parallel.recording import Outcome
from experiments.parallel.report import Summary, sentences, summarise, table
from experiments.parallel.setup import Setup
from experiments.parallel.supervisor import run
from experiments.run.provenance import hardware, revision, versions
from trajectories.fileio import write_atomically

RUN_FILE, MAILBOX_FILE = "run.json", "mailbox.json"
FORMAT = "lpv-track-parallel/1"
EXIT_FAILED = 1
EXIT_SIGNAL = 128
"""Plus the signal's number: 130 after Ctrl-C, 143 after SIGTERM."""


def run_parallel(setup: Setup, folder: Path, console: Console) -> int:
    """Drive one run, write `run.json` and `run.png`, print the report; returns the exit code.

    0 only if the run went to its end and the rate was held.

    Raises
    ------
    OSError
        If the folder cannot be written; before anything is driven.
    """
    result = {**provenance(), "settings": setup.as_dict()}
    write(result, folder / RUN_FILE)

    def say(line: str) -> None:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
        console.file.flush()

    outcome = run(setup, say)
    result["machine"]["load_average_after"] = load()
    summary = summarise(setup, outcome)
    result["run"] = summary
    write(result, folder / RUN_FILE)
    drawn = picture(setup, outcome, summary, trajectories.load(setup.trajectory))
    if drawn is not None:
        save_figure(drawn, folder / "run.png")
        console.print(table(setup, summary))
    for line in sentences(summary):
        say(line)
    say(f"report: {folder / RUN_FILE}")
    return verdict(outcome, summary)


def verdict(outcome: Outcome, summary: Summary) -> int:
    """Exit code, with one line on stderr for what failed."""
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


def bench(folder: Path, console: Console) -> int:
    """Measure the mailbox, write `mailbox.json`, print a table; returns the exit code."""
    result = provenance()
    write(result, folder / MAILBOX_FILE)
    result["mailbox"] = bench_mailbox(console)
    result["machine"]["load_average_after"] = load()
    write(result, folder / MAILBOX_FILE)
    return 0


def provenance() -> dict[str, Any]:
    """What a result must carry: revision, versions, machine, command."""
    return {
        "format": FORMAT,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "machine": {
            **hardware(), "versions": versions(), "revision": revision(),
            "load_average_before": load(), "load_average_after": None,
        },
    }  # fmt: skip


def load() -> list[float] | None:
    """Load average over 1, 5 and 15 minutes, where the system tells it."""
    return list(os.getloadavg()) if hasattr(os, "getloadavg") else None


def write(result: dict[str, Any], file: Path) -> None:
    """Write a result as it is by now."""
    result["written"] = datetime.now(UTC).isoformat(timespec="seconds")
    content = json.dumps(result, indent=1, allow_nan=False)
    write_atomically(file, content.encode() + b"\n")
