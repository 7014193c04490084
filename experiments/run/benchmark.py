"""Runs of many cases: those that a folder of results lacks are run, with progress."""

import json
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

from experiments.run.case import BaseCase, Case, failed_case, run_case
from experiments.run.engines import Engine, Interrupts
from experiments.run.folder_lock import TRACES, locked
from experiments.run.provenance import version_changes
from experiments.run.store import ResultStore
from experiments.run.tables import path_name

Spec = Mapping[str, Any]

STEPS = 20
"""Most lines of progress where the console is no terminal."""
CASE_LIMIT = 1800.0
"""Time limit of a case, s: the slowest agent, IPOPT's, takes some minutes on a busy computer."""


def distinct(specs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the specs without repetitions of a case."""
    return list({Case(**spec).id: spec for spec in specs}.values())


def run_benchmark(
    specs: Sequence[Spec],
    folder: Path,
    *,
    engine: Engine,
    settings: Mapping[str, Any],
    console: Console,
    resume: bool = True,
    kind: type[BaseCase] = Case,
    limit: float = CASE_LIMIT,
) -> ResultStore:
    """Run the cases that the folder does not hold yet, and store each as it ends.

    Lines of `cases.jsonl` that cannot be read are named and left alone; their cases are run again.

    Parameters
    ----------
    specs
        Fields of cases of the class `kind`.
    folder
        Folder of results, made if need be; locked meanwhile.
    engine
        Where the cases run.
    settings
        Entries of the manifest.
    console
        Receives the progress.
    resume
        Allow a folder that holds results already.
    kind
        Class of the cases.
    limit
        Time limit of a case, s: one that takes longer has failed. In this process, an agent that
        never returns from native code is not ended, see `experiments.run.time_limit.TimeLimit`.

    Raises
    ------
    ValueError
        For an unknown name, a limit that is not positive, a folder that another process
        writes in, or one that holds results while `resume` is off.
    """
    if not limit > 0.0:
        raise ValueError(f"the time limit of a case must be positive, not {limit:g} s")
    by_id = {}
    for spec in specs:
        case = kind(**spec)
        case.check()
        # Whatever goes wrong in it, the case's result can be stored.
        by_id[failed_case(spec, "", kind)["id"]] = case.as_dict()
    with locked(folder):
        store = ResultStore(folder)
        if (folder / TRACES).is_symlink():
            raise ValueError(f"{folder / TRACES} is a link: results are written into {folder} only")
        skipped: list[str] = []
        held = store.cases(skipped)
        if (held or skipped) and not resume:
            raise ValueError(f"{folder} holds results already: say --resume, or give another --out")
        known = {case["id"] for case in held if case["status"] == "ok"}
        missing = {key: spec for key, spec in by_id.items() if key not in known}
        notes = [f"skipped: {line}" for line in skipped]
        if len(missing) < len(by_id):
            notes.append(
                f"{len(by_id) - len(missing)} of {len(by_id)} cases are in {folder} already "
                "(same sources, same settings)"
            )
        if older := _computed_before(missing, held, kind):
            changes = ", ".join(version_changes(store.manifest())) or "other sources"
            notes.append(
                f"{older} of {len(by_id)} cases are run anew: those in {folder} were made with "
                f"{changes}"
            )
        for note in notes:
            console.print(note, markup=False, highlight=False)
        store.write_manifest({**settings, "cases": list(by_id)})
        if missing:
            _run(list(missing.values()), kind, store, engine, console, limit)
    return store


def _computed_before(
    missing: Mapping[str, Spec], held: Sequence[Mapping[str, Any]], kind: type[BaseCase]
) -> int:
    """Return how many of the missing cases a folder holds with another id, computed otherwise."""
    if not missing or not held:
        return 0
    wanted = {json.dumps(kind(**spec).as_dict(), sort_keys=True) for spec in missing.values()}
    names = list(kind(**next(iter(missing.values()))).as_dict())
    there = {
        json.dumps({name: case.get(name) for name in names}, sort_keys=True)
        for case in held
        if case["status"] == "ok"
    }
    return len(wanted & there)


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
    specs: Sequence[Spec], kind: type[BaseCase], store: ResultStore, engine: Engine,
    console: Console, limit: float,
) -> None:  # fmt: skip
    progress = progress_bar(console)
    began = time.perf_counter()
    with progress, Interrupts() as interrupts:
        bar = progress.add_task("cases", total=len(specs))

        def started(spec: Spec) -> None:
            progress.update(bar, description=label(spec))

        run, failed = partial(run_case, kind=kind), partial(failed_case, kind=kind)
        results = engine.run(
            specs, run, started=started, failed=failed, limit=limit,
            files=partial(named_files, kind=kind), identity=partial(case_id, kind=kind),
            machine=store.add_manifest,
        )  # fmt: skip
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


def named_files(spec: Spec, kind: type[BaseCase] = Case) -> list[Path]:
    """Return the files that a case reads, beside the project's sources."""
    return kind(**spec).present_files()


def case_id(spec: Spec, kind: type[BaseCase] = Case) -> str:
    """Return the id of a case."""
    return kind(**spec).id


def label(spec: Spec) -> str:
    """Return a short name of a case for a line of progress."""
    if "scene" in spec:
        return f"{spec['agent']} {spec['scene']} seed {spec['seed']}"
    path = path_name(spec["trajectory"])
    grip = "" if spec.get("grip") is None else f" {spec['grip']:g}"
    return f"{spec['agent']} {path} {spec['vehicle']} {spec['speed_mode']}{grip}"


def selected(
    store: ResultStore, specs: Sequence[Spec], kind: type[BaseCase] = Case
) -> list[Mapping[str, Any]]:
    """Return the results of some specs, in their order."""
    by_id = {case["id"]: case for case in store.cases([])}
    return [by_id[key] for spec in specs if (key := kind(**spec).id) in by_id]


def print_failed(cases: Sequence[Mapping[str, Any]], console: Console) -> int:
    """Print a line for each case that failed and return their number."""
    failed = [case for case in cases if case["status"] != "ok"]
    for case in failed:
        console.print(f"failed: {label(case)}: {case['error']}", markup=False, style="red")
    return len(failed)
