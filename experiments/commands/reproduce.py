"""`lpv-track reproduce`: run cases of a results folder again and compare every value."""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from experiments.commands import options as shared

if TYPE_CHECKING:
    from experiments.run.reproduction import Row, Verdict

EXAMPLE = "lpv-track reproduce results/benchmark --sample 10"
STDIN = Path("-")
LINES = 10
"""Most values of one case whose difference is printed."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "folder", type=shared.file_name, metavar="DIR",
        help="folder of results; - reads results as JSON from standard input",
    )  # fmt: skip
    parser.add_argument("--id", nargs="+", metavar="ID", help="run only these cases")
    parser.add_argument(
        "--sample", type=shared.whole(1, 10**9), metavar="N", help="run N cases, drawn at random"
    )
    parser.add_argument(
        "--seed", type=shared.whole(0, 2**63 - 1), default=0, help="seed of the sample (default 0)"
    )
    parser.add_argument(
        "--exact", action="store_true",
        help="compare bits even where versions, sources or processor differ",
    )  # fmt: skip
    parser.add_argument(
        "--open-named-files", action="store_true",
        help="run the agents and open the files that results name; for results you trust",
    )  # fmt: skip
    parser.add_argument(
        "--case-limit", type=shared.number(0.0, 1e9, "s", above=True), metavar="S",
        help="a case that takes longer has failed, s (default 1800)",
    )  # fmt: skip
    shared.add_engine(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the cases and print what differs; return 1 for a difference or a damaged row, else 0."""
    from experiments.run.reproduction import prepared, sampled

    results, manifest_of, torn, damaged = _results(options, console)
    rows = prepared(
        results, manifest_of,
        open_named_files=options.open_named_files, whole=options.folder != STDIN,
    )  # fmt: skip
    _print_counted(console, "not run again", Counter(torn) + rows.not_run)
    _print_counted(console, "damaged", Counter(damaged) + rows.damaged)
    chosen = rows.chosen
    if options.sample is not None:
        chosen = sampled(chosen, options.sample, options.seed)
    if not chosen:
        where = "standard input" if options.folder == STDIN else options.folder
        raise ValueError(f"no result of {where} can be run again")
    _print_origins(console, chosen)
    verdicts: list[Verdict] = []
    try:
        _run(options, console, chosen, verdicts)
    except KeyboardInterrupt:
        _print(
            console,
            f"interrupted: {len(verdicts)} of {len(chosen)} cases were run again; --sample N draws "
            "fewer",
        )
        _print(console, summary(verdicts))
        raise
    _print(console, summary(verdicts))
    different = any(verdict.differences for verdict in verdicts)
    return shared.EXIT_FAILED if different or damaged or rows.damaged else 0


def _results(
    options: argparse.Namespace, console: Console
) -> tuple[list[Any], Any, list[str], list[str]]:
    """Return the chosen results, the reader of their manifests, a torn line, damaged lines."""
    from experiments.run.reproduction import pasted, torn_line
    from experiments.run.store import ResultStore
    from trajectories.fileio import MOST_BYTES

    torn: list[str] = []
    damaged: list[str] = []
    if options.folder == STDIN:
        if sys.stdin.isatty():
            console.out("results as JSON, then Ctrl-D:", highlight=False)
        text = sys.stdin.read(MOST_BYTES + 1).removeprefix("\ufeff")
        if len(text) > MOST_BYTES:
            raise ValueError(f"standard input: at most {MOST_BYTES} characters are read")
        found: Sequence[Mapping[str, Any]] = pasted(text)
        manifest_of = None
    else:
        if not options.folder.is_dir():
            raise ValueError(f"{options.folder} is not a folder of results")
        store = ResultStore(options.folder)
        found, manifest_of = store.cases(damaged), store.manifest_of
        if not (found or damaged):
            raise ValueError(f"no results in {options.folder}")
        torn = torn_line(store.cases_file)
    if options.id is not None:
        ids = {result.get("id") for result in found}
        if unknown := [one for one in options.id if one not in ids]:
            raise ValueError(f"no result has the id {unknown[0]}")
        found = [result for result in found if result.get("id") in options.id]
    return list(found), manifest_of, torn, damaged


def _run(
    options: argparse.Namespace, console: Console, rows: Sequence["Row"], verdicts: list["Verdict"]
) -> None:
    from experiments.run.benchmark import CASE_LIMIT, label, line_due, progress_bar
    from experiments.run.engines import Interrupts
    from experiments.run.reproduction import reproduce

    limit = CASE_LIMIT if options.case_limit is None else options.case_limit
    progress, began = progress_bar(console), time.perf_counter()
    with progress, Interrupts() as interrupts:
        bar = progress.add_task("cases", total=len(rows))
        for verdict in reproduce(
            rows, shared.engine_of(options), limit=limit, exact=options.exact,
            started=lambda spec: progress.update(bar, description=label(spec)),
        ):  # fmt: skip
            interrupts.check()
            verdicts.append(verdict)
            _print_verdict(console, verdict)
            progress.advance(bar)
            done = len(verdicts)
            if line_due(console, done, len(rows)):
                elapsed = time.perf_counter() - began
                _print(console, f"[{done}/{len(rows)}, {elapsed:.0f} s] {verdict.row.words}")


def _print_verdict(console: Console, verdict: "Verdict") -> None:
    words = verdict.row.words
    if verdict.note:
        _print(console, f"not comparable: {words}: {verdict.note}")
    for line in verdict.differences[:LINES]:
        _print(console, f"{words}: {line}")
    if len(verdict.differences) > LINES:
        _print(console, f"{words}: and {len(verdict.differences) - LINES} more values")


def _print_origins(console: Console, rows: Sequence["Row"]) -> None:
    """Print once for each origin of rows what differs between its machine and this one."""
    from experiments.run.reproduction import origin_words

    _print_counted(console, "made with", Counter(map(origin_words, rows)))


def _print_counted(console: Console, beginning: str, reasons: Mapping[str, int]) -> None:
    for reason, count in reasons.items():
        _print(console, f"{beginning}: {f'{count} results: ' if count > 1 else ''}{reason}")


def _print(console: Console, line: str) -> None:
    console.out(line, highlight=False)


def summary(verdicts: Iterable["Verdict"]) -> str:
    """Return how many cases and values were compared, in which way, and how many differ."""
    from experiments.run.reproduction import ABSOLUTE, RELATIVE

    compared = [verdict for verdict in verdicts if not verdict.note]
    parts = []
    for exact in (True, False):
        group = [verdict for verdict in compared if verdict.exact == exact]
        values, equal = sum(one.values for one in group), sum(one.equal for one in group)
        way = "bit for bit"
        if not exact:
            largest = max((one.largest for one in group), default=0.0)
            way = (
                f"within {RELATIVE:g} of the value or {ABSOLUTE:g} ({equal} equal bit for bit, "
                f"largest relative difference {largest:.1g})"
            )
        if group:
            parts.append(f"{_count(len(group), 'case')}, {_count(values, 'value')} {way}")
    if not parts:
        return "compared: nothing"
    different = [verdict for verdict in compared if verdict.differences]
    lines = sum(len(verdict.differences) for verdict in different)
    end = f"{_count(lines, 'difference')} in {_count(len(different), 'case')}" if lines else "equal"
    return f"compared: {' and '.join(parts)}: {end}"


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
