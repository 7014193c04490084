"""Runs of many cases: those that a folder of results lacks are run, with progress."""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from experiments.run import engines
from experiments.run.case import BaseCase, Case, run_case, worker_death
from experiments.run.engines import Interrupts
from experiments.run.store import ResultStore
from experiments.run.tables import path_name

Spec = Mapping[str, Any]

STEPS = 20
"""Most lines of progress where the console is no terminal."""


def distinct(specs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the specs without repetitions of a case."""
    return list({Case(**spec).id: spec for spec in specs}.values())


def run_benchmark(
    specs: Sequence[Spec],
    folder: Path,
    *,
    workers: int,
    settings: Mapping[str, Any],
    console: Console,
    resume: bool = True,
    kind: type[BaseCase] = Case,
) -> ResultStore:
    """Run the cases that the folder does not hold yet, and store each as it ends.

    `specs` are the fields of cases of the class `kind`, `settings` entries of the manifest.

    Raises
    ------
    ValueError
        For an unknown name, no workers, or a folder that holds results while `resume` is off.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, not {workers}")
    for spec in specs:
        kind(**spec).check()
    by_id = {kind(**spec).id: spec for spec in specs}
    store = ResultStore(folder)
    known = {case["id"] for case in store.cases() if case["status"] == "ok"}
    if store.cases() and not resume:
        raise ValueError(f"{folder} holds results already: say --resume, or give another --out")
    missing = [spec for key, spec in by_id.items() if key not in known]
    store.write_manifest({**settings, "cases": list(by_id)})
    if len(missing) < len(by_id):
        console.print(
            f"{len(by_id) - len(missing)} of {len(by_id)} cases are in {folder} already "
            "(same sources, same settings)"
        )
    if missing:
        _run(missing, kind, store, min(workers, len(missing)), console)
    return store


def progress_bar(console: Console) -> Progress:
    """Return a progress bar with counts and times; it shows nothing unless on a terminal."""
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )


def _run(
    specs: Sequence[Spec], kind: type[BaseCase], store: ResultStore, workers: int, console: Console
) -> None:
    progress = progress_bar(console)
    began = time.perf_counter()
    with progress, Interrupts() as interrupts:
        bar = progress.add_task("cases", total=len(specs))

        def started(spec: Spec) -> None:
            progress.update(bar, description=label(spec))

        run, died = (partial(function, kind=kind) for function in (run_case, worker_death))
        results = (
            engines.in_process(specs, run, started)
            if workers == 1
            else engines.local_pool(specs, workers, run, started, died)
        )
        for count, result in enumerate(results, start=1):
            # Before the result is stored: a case may have taken Ctrl-C for a failed solve.
            interrupts.check()
            store.append(result)
            progress.advance(bar)
            # Piped: a line every 5 % of the cases.
            shares = (STEPS * done // len(specs) for done in (count - 1, count))
            if not console.is_terminal and len(set(shares)) > 1:
                elapsed = time.perf_counter() - began
                console.print(
                    f"[{count}/{len(specs)}, {elapsed:.0f} s] {label(result)}: "
                    f"{result['end'] or result.get('error')}",
                    markup=False, highlight=False,
                )  # fmt: skip


def label(spec: Spec) -> str:
    """Return a short name of a case for a line of progress."""
    if "scene" in spec:
        return f"{spec['agent']} {spec['scene']} seed {spec['seed']}"
    path = path_name(spec["trajectory"])
    return f"{spec['agent']} {path} {spec['vehicle']} {spec['speed_mode']}"


def selected(
    store: ResultStore, specs: Sequence[Spec], kind: type[BaseCase] = Case
) -> list[dict[str, Any]]:
    """Return the results of some specs, in their order."""
    by_id = {case["id"]: case for case in store.cases()}
    return [by_id[key] for spec in specs if (key := kind(**spec).id) in by_id]


def print_failed(cases: Sequence[Mapping[str, Any]], console: Console) -> int:
    """Print a line for each case that failed and return their number."""
    failed = [case for case in cases if case["status"] != "ok"]
    for case in failed:
        console.print(f"failed: {label(case)}: {case['error']}", markup=False, style="red")
    return len(failed)
