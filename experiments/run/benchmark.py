"""Runs of many cases: those that a folder of results lacks are run, with progress."""

import hashlib
import time
from collections.abc import Container, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
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
from experiments.run.excerpts import MOST_PATHS
from experiments.run.folder_lock import TRACES, locked
from experiments.run.provenance import version_changes
from experiments.run.store import ResultStore
from experiments.run.tables import path_name
from trajectories.fileio import LARGEST_INTEGER
from trajectories.naming import choose

Spec = Mapping[str, Any]

STEPS = 20
"""Most lines of progress where the console is no terminal."""
CASE_LIMIT = 1800.0
"""Time limit of a case, s: the slowest agent, IPOPT's, takes some minutes on a busy computer."""
TRACES_KEPT = ("all", "drawn", "none")
"""Traces that a run keeps: those of all cases, those that a report draws, none."""
MOST_FAILED = 200
"""Most failed cases that are printed."""


def distinct(specs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the specs without repetitions of a case."""
    return list({Case(**spec).id: spec for spec in specs}.values())


def shard(specs: Sequence[dict[str, Any]], number: int, of: int) -> list[dict[str, Any]]:
    """Return every `of`-th spec, from the one at place `number` on, 1 being the first.

    Raises
    ------
    ValueError
        If there is none.
    """
    if number > len(specs):
        raise ValueError(
            f"shard {number}/{of} holds none of the {len(specs)} cases: use at most {len(specs)} "
            "shards"
        )
    return list(specs[number - 1 :: of])


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
    traces: str = "all",
) -> ResultStore:
    """Run the cases that the folder does not hold yet, and store each as it ends.

    A kill loses no case that has ended, a power loss at most those of the last second.

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
    traces
        One of `TRACES_KEPT`. "drawn" keeps those of the lowest seed of every agent and setting on
        its first `MOST_PATHS` paths.

    Raises
    ------
    ValueError
        For an unknown name, a limit that is not positive, a folder that another process
        writes in, or one that holds results while `resume` is off.
    """
    if not limit > 0.0:
        raise ValueError(f"the time limit of a case must be positive, not {limit:g} s")
    kept = choose("choice of traces", traces, TRACES_KEPT)
    by_id = _checked(specs, kind)
    with locked(folder):
        store = ResultStore(folder)
        if (folder / TRACES).is_symlink():
            raise ValueError(f"{folder / TRACES} is a link: results are written into {folder} only")
        skipped: list[str] = []
        held = store.ids(skipped)
        if (held or skipped) and not resume:
            raise ValueError(f"{folder} holds results already: say --resume, or give another --out")
        missing = {key: spec for key, spec in by_id.items() if held.get(key) != "ok"}
        notes = [f"skipped: {line}" for line in skipped]
        if len(missing) < len(by_id):
            notes.append(
                f"{len(by_id) - len(missing)} of {len(by_id)} cases are in {folder} already "
                "(same sources, same settings)"
            )
        if older := _computed_before(missing, store, kind) if held else 0:
            changes = ", ".join(version_changes(store.manifest())) or "other sources"
            notes.append(
                f"{older} of {len(by_id)} cases are run anew: those in {folder} were made with "
                f"{changes}"
            )
        for note in notes:
            console.print(note, markup=False, highlight=False)
        store.write_manifest({**settings, "traces": kept, "cases": list(by_id)})
        drawn = None if kept == "all" else _drawn(by_id, kind) if kept == "drawn" else ()
        if missing:
            todo = [kind(**spec).as_dict() for spec in missing.values()]
            with store:
                _run(todo, kind, store, engine, console, limit, drawn)
    return store


def _checked(specs: Sequence[Spec], kind: type[BaseCase]) -> dict[str, Spec]:
    """Return specs by the ids of their cases.

    Of cases that differ in nothing but their seeds, the first is checked.

    Raises
    ------
    ValueError
        As `check` of a case, or for one whose result could not be stored.
    """
    by_id: dict[str, Spec] = {}
    checked: set[str] = set()
    for spec in specs:
        case = kind(**spec)
        usual = type(case.seed) is int and abs(case.seed) <= LARGEST_INTEGER
        fields = repr({**vars(case), "seed": 0 if usual else repr(case.seed)})
        if fields not in checked:
            case.check()
            # Whatever goes wrong in it, the case's result can be stored.
            failed_case(spec, "", kind)
            checked.add(fields)
        by_id[case.id] = spec
    return by_id


def _drawn(by_id: Mapping[str, Spec], kind: type[BaseCase]) -> set[str]:
    """Return the ids of the cases whose traces "drawn" keeps, see `run_benchmark`."""
    lowest: dict[str, dict[str, tuple[int, str]]] = {}
    for key, spec in by_id.items():
        case = kind(**spec)
        setting = repr({**vars(case), "seed": 0, "trajectory": ""})
        paths = lowest.setdefault(setting, {})
        if case.place in paths or len(paths) < MOST_PATHS:
            own = (case.seed, key)
            paths[case.place] = min(own, paths.get(case.place, own))
    return {key for paths in lowest.values() for _, key in paths.values()}


def _computed_before(missing: Mapping[str, Spec], store: ResultStore, kind: type[BaseCase]) -> int:
    """Return how many of the missing cases a folder holds with another id, computed otherwise."""
    wanted = {_digest(kind(**spec).as_dict()) for spec in missing.values()}
    names = list(kind(**next(iter(missing.values()))).as_dict()) if missing else []
    there = {
        _digest({name: case.get(name) for name in names})
        for case in (store.stream([]) if missing else ())
        if case["status"] == "ok"
    }
    return len(wanted & there)


def _digest(fields: Mapping[str, Any]) -> bytes:
    # Numbers of NumPy may stand in a spec.
    content = msgspec.json.encode(fields, order="sorted", enc_hook=lambda value: value.item())
    return hashlib.blake2b(content, digest_size=16).digest()


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


def line_due(console: Console, done: int, total: int) -> bool:
    """Return whether a line of progress is due: every 5 % where the console is no terminal."""
    return not console.is_terminal and STEPS * done // total > STEPS * (done - 1) // total


def _run(
    specs: Sequence[Spec], kind: type[BaseCase], store: ResultStore, engine: Engine,
    console: Console, limit: float, drawn: Container[str] | None,
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
            kept = drawn is None or result["id"] in drawn
            store.append(result if kept else {**result, "trace": {}})
            progress.advance(bar)
            if line_due(console, count, len(specs)):
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
    for case in failed[:MOST_FAILED]:
        console.print(f"failed: {label(case)}: {case['error']}", markup=False, style="red")
    if len(failed) > MOST_FAILED:
        console.print(f"failed: {len(failed) - MOST_FAILED} more cases", style="red")
    return len(failed)
