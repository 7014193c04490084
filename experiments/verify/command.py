"""`lpv-track verify`: measure many situations, print the table, write verify.json, give a verdict.

What is measured, and against what: `experiments.verify.bench`; what is asked: `verdict.ROWS`.
"""

import json
import math
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from agents.registry import agent_class
from experiments.run import engines
from experiments.run.benchmark import progress_bar
from experiments.run.provenance import hardware, revision, versions
from experiments.run.suites import PAPER_VEHICLES
from experiments.verify.bench import FATROP_EVERY, run_situation, situation_death
from experiments.verify.situations import kind
from experiments.verify.verdict import QUANTILES, number, shortfalls, summarise
from trajectories.fileio import write_atomically

SOLVER = "agents.nmpc.rti_solver:RtiSolver"
QUICK = 24
"""States of a quick run: two for each trajectory and vehicle."""


def verify(
    folder: Path, *, states: int, seed: int, workers: int, solver: str, console: Console
) -> int:
    """Verify a solver and write `folder`/verify.json.

    Returns
    -------
    int
        0 if every goal holds, 1 if not.

    Raises
    ------
    ValueError
        For no states or workers, or a solver that cannot be loaded.
    """
    for name, value in (("states", states), ("workers", workers)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, not {value}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, not {seed}")
    agent_class(solver)
    specs = [spec(index, seed, solver) for index in range(states)]
    began = time.perf_counter()
    results = sorted(_measure(specs, workers, console), key=lambda result: int(result["index"]))
    summaries = summarise(results)
    missed = shortfalls(summaries, results)
    console.print(table(summaries))
    console.print(_work(results), markup=False, highlight=False)
    content = {
        "format": "lpv-track-verify/1",
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "settings": {"states": states, "seed": seed, "solver": solver, "workers": workers},
        "revision": revision(),
        "versions": versions(),
        "hardware": hardware(),
        "seconds": time.perf_counter() - began,
        "holds": not missed,
        "missed": missed,
        "summary": summaries,
        "situations": [_plain(result) for result in results],
    }
    file = folder / "verify.json"
    write_atomically(file, json.dumps(content, indent=1, allow_nan=False).encode())
    console.print(f"written: {file}", markup=False, highlight=False, soft_wrap=True)
    for line in missed:
        console.print(f"fell short: {line}", markup=False, highlight=False, style="red")
    return 1 if missed else 0


def spec(index: int, seed: int, solver: str) -> dict[str, Any]:
    """What a worker needs to know of one situation."""
    trajectory, vehicle = kind(index)
    return {
        "index": index,
        "seed": seed,
        "trajectory": trajectory,
        "vehicle": vehicle,
        "solver": solver,
        "fatrop": index // len(PAPER_VEHICLES) % FATROP_EVERY == 0,
    }


def _measure(
    specs: Sequence[dict[str, Any]], workers: int, console: Console
) -> list[dict[str, Any]]:
    workers = min(workers, len(specs))
    run = (
        engines.in_process(specs, run_situation)
        if workers == 1
        else engines.local_pool(specs, workers, run_situation, died=situation_death)
    )
    results = []
    with progress_bar(console) as progress:
        bar = progress.add_task("situations", total=len(specs))
        for result in run:
            results.append(result)
            progress.advance(bar)
            if not console.is_terminal and len(results) % max(len(specs) // 10, 1) == 0:
                console.print(f"[{len(results)}/{len(specs)}]", markup=False, highlight=False)
    return results


def table(summaries: Sequence[dict[str, Any]]) -> Table:
    """Distributions and verdicts; `verdict.ROWS` says what is relative and what absolute.

    -/+ counts plans that cost less and more by more than `verdict.SAME`.
    """
    result = Table(title="magnitude of errors", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    result.add_column("")
    for heading in ("n", "median", "90 %", "99 %", "largest", "goal", "within", "-/+"):
        result.add_column(heading, justify="right", no_wrap=True)
    for row in summaries:
        n, within = row["compared"], row["share_within"]
        verdict = {None: "", True: "[green]", False: "[red]"}[row["holds"]]
        result.add_row(
            row["title"],
            f"{n}" if n == row["of"] else f"{n}/{row['of']}",
            *(number(row[name]) if n else "" for name in QUANTILES),
            "" if row["goal"] is None else f"{row['goal']:.0e}",
            "" if within is None else f"{verdict}{100.0 * within:.4g}%",
            "" if row["lower"] is None else f"{row['lower']}/{row['higher']}",
        )
    return result


def _work(results: Sequence[dict[str, Any]]) -> str:
    """Medians of iterations and times, in one line."""
    names = {"": "converged", "one_step": "one iteration", "ipopt": "IPOPT", "fatrop": "fatrop"}
    parts = []
    for prefix, name in names.items():
        key = f"{prefix}_" if prefix else ""
        said = []
        for measure, unit, scale in (("iterations", "iterations", 1.0), ("seconds", "ms", 1e3)):
            found = [
                result["measures"][key + measure]
                for result in results
                if key + measure in result["measures"]
            ]
            if found:
                said.append(f"{scale * float(np.median(found)):.3g} {unit}")
        if said:
            parts.append(f"{name} {', '.join(said)}")
    return "medians: " + "; ".join(parts)


def _plain(result: dict[str, Any]) -> dict[str, Any]:
    """A result for JSON: null where an oracle had no answer, "inf" where the solver had none."""
    measures = {
        name: value if value is None or math.isfinite(value) else "inf"
        for name, value in result["measures"].items()
    }
    kept = {key: result[key] for key in ("index", "trajectory", "vehicle", "error")}
    return {**kept, "measures": measures}
