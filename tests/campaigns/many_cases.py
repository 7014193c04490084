"""Many cases in one folder: disk, memory and time of resuming, reporting and comparing them.

Stanley drives short paths under randomised conditions; the rows of at most `DRIVEN` real drives are
repeated with the ids and seeds of all others. Commands run in processes of their own, with a tenth
of the cases and with all. What takes more than `MEMORY`, or far longer than in proportion, breaks.
"""

import io
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from experiments.run.benchmark import run_benchmark
from experiments.run.case import Case
from experiments.run.engines import Engine
from experiments.run.store import ResultStore
from experiments.run.suites import grid
from tests.campaigns import Counts, Say

PATHS = (
    "u-turn", "sine", "double-lane-change", "circle", "straight", "figure-eight",
    "iso-3888-1-1.8", "iso-3888-2-1.8", "random-0", "random-1",
)  # fmt: skip
LAUNCH = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=sys.stderr)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(done.returncode not in (0, 1))
"""
"""A small process between: the system counts the memory of a process that starts another to it."""
DRIVEN = 2000
MEMORY = 2**30
"""Most memory that a command may take, bytes."""
GROWTH = 12.0
"""Largest ratio of times with all cases and with a tenth of them."""
TENTH = 1000
"""Fewest cases of which a tenth is measured, and that are driven in several processes."""


class Cost(NamedTuple):
    """Wall time, s, and the largest resident memory, bytes, of a command."""

    seconds: float
    memory: int


def run(count: int, seed: int, say: Say) -> Counts:
    """Measure folders of `count` cases and of a tenth of them; `seed` is that of the noise."""
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = driven(folder / "driven", min(count, DRIVEN))
        say(f"{len(rows)} cases driven, repeated up to {count}")
        sizes = [count // 10, count] if count >= TENTH else [count]
        costs = {size: measured(folder / str(size), rows, size, seed, say) for size in sizes}
    for size, found in costs.items():
        faults += [
            f"{command} of {size} cases took {cost.memory / 2**20:.0f} MiB"
            for command, cost in found.items()
            if cost.memory > MEMORY
        ]
    for command, cost in costs[count].items() if len(sizes) > 1 else ():
        ratio = cost.seconds / costs[sizes[0]][command].seconds
        if ratio > GROWTH:
            faults.append(f"{command} took {ratio:.1f} times as long with ten times the cases")
    return Counts(count, faults, {"driven": len(rows)})


def specs_of(count: int) -> list[dict[str, Any]]:
    """Return the specs of `count` cases or a few more, the same number on every path."""
    seeds = range(-(-count // len(PATHS)))
    return grid(["stanley"], PATHS, conditions="randomised", seeds=seeds)


def driven(folder: Path, count: int) -> list[dict[str, Any]]:
    """Drive `count` cases and return their rows."""
    console = Console(file=io.StringIO())
    store = run_benchmark(
        specs_of(count),
        folder,
        engine=Engine(1 if count < TENTH else None),
        settings={},
        console=console,
        traces="drawn",
    )
    return list(store.stream())


def write(folder: Path, rows: Sequence[dict[str, Any]], count: int, seed: int | None) -> None:
    """Write a folder of `count` cases from rows; with a seed, errors differ a little."""
    by_path: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_path.setdefault(row["trajectory"], []).append(row)
    rng = np.random.default_rng(seed)

    def lines() -> Iterator[bytes]:
        for number, spec in enumerate(specs_of(count)):
            own = by_path[spec["trajectory"]]
            row = dict(own[number % len(own)])
            row |= {"id": Case(**spec).id, "seed": spec["seed"]}
            if seed is not None:
                row["metrics"] = {**row["metrics"], "ale": row["metrics"]["ale"] * rng.uniform()}
            yield json.dumps(row, sort_keys=True).encode() + b"\n"

    with ResultStore(folder).cases_file.open("wb") as handle:
        handle.writelines(lines())


def measured(
    folder: Path, rows: Sequence[dict[str, Any]], count: int, seed: int, say: Say
) -> dict[str, Cost]:
    """Return the costs of the commands on two folders of `count` cases."""
    first, second = folder / "first", folder / "second"
    write(first, rows, count, None)
    write(second, rows, count, seed)
    size = (first / "cases.jsonl").stat().st_size
    say(f"{count} cases: {size / 1e6:.1f} MB on disk, {size / count / 1e3:.2f} kB each")
    seeds = str(-(-count // len(PATHS)))
    commands = {
        "report": ["report", str(first)],
        "resume": [
            "benchmark", "--agents", "stanley", "--trajectories", *PATHS, "--seeds", seeds,
            "--conditions", "randomised", "--out", str(first), "--resume", "--traces", "none",
        ],
        "compare": ["compare", str(first), str(second), "--out", str(folder / "compared")],
        "merge": ["merge", str(folder / "merged"), str(first)],
    }  # fmt: skip
    if count < TENTH:
        del commands["compare"]  # some ten seconds for any number of cases
    costs = {}
    for name, words in commands.items():
        cost = costs[name] = cost_of([sys.executable, "-m", "experiments", *words])
        say(f"{count} cases: {name} {cost.seconds:.1f} s, {cost.memory / 2**20:.0f} MiB")
    return costs


def cost_of(words: Sequence[str]) -> Cost:
    """Run a command and return its cost.

    Raises
    ------
    RuntimeError
        If it fails.
    """
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", LAUNCH, *words], capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    # Linux counts in KiB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    return Cost(time.perf_counter() - began, int(done.stdout) * unit)
