"""`lpv-track verify`: the real-time NMPC against independent solvers, models and derivatives."""

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console

from experiments.commands.options import add_out, add_seed, add_workers, whole

if TYPE_CHECKING:
    from rich.table import Table

Result = Mapping[str, Any]

EXAMPLE = "lpv-track verify --states 200 --out results/verify"
SOLVER = "agents.nmpc.rti_solver:RtiSolver"
QUICK = 24
"""States of a quick run: two for each trajectory and vehicle."""
QUANTILES = {"median": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}
LEAST_COMPARED = 0.9
"""Share of the situations in which an oracle must have an answer."""


class Row(NamedTuple):
    """Row of the table: a measure, and the goal that it has to meet."""

    measure: str
    """Key in a result's measures."""
    title: str
    goal: float | None = None
    """Largest acceptable magnitude, or None for information only."""
    share: float = 1.0
    """Least share of the situations within the goal."""
    signed: bool = False
    """True if the measure is a difference whose sign matters."""
    sampled: bool = False
    """True if only some situations have the measure."""


ROWS = (
    Row("states", "roll-out against CasADi", 1e-9),
    Row("A", "dF/dx against CasADi", 1e-9),
    Row("B", "dF/du against CasADi", 1e-9),
    Row("rate", "vx' against CasADi", 1e-9),
    Row("rate_x", "dvx'/dx against CasADi", 1e-9),
    Row("rate_u", "dvx'/du against CasADi", 1e-9),
    Row("qp_first_input", "QP: first input against PIQP", 1e-6),
    Row("qp_plan", "QP: all inputs against PIQP"),
    Row("excess", "plan: hard bounds broken by", 1e-6),
    Row("suboptimality", "plan: IPOPT betters it by", 1e-6, share=0.99),
    Row("cost_error", "plan: cost against IPOPT", signed=True),
    Row("first_input", "plan: first input, same cost", sampled=True),
    Row("fatrop_cost_error", "plan: cost against fatrop", signed=True, sampled=True),
    Row("oracles_cost_error", "fatrop: cost against IPOPT", signed=True, sampled=True),
    Row("one_step_first_input", "one iteration: first input"),
)
"""Magnitudes of errors: costs and entries of derivatives above 1 are relative, others absolute."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--states", type=whole(1, 1_000_000), default=1000, metavar="N", help="default 1000"
    )
    parser.add_argument(
        "--quick", action="store_true", help=f"{QUICK} states, whatever --states says"
    )
    add_seed(parser)
    parser.add_argument(
        "--solver", default=SOLVER, metavar="MODULE:CLASS",
        help="default: the real-time solver of lpv-nmpc",
    )  # fmt: skip
    add_out(parser, "results/verify")
    add_workers(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Measure situations, print the table, write `verify.json`; return 1 if a goal is missed.

    Raises
    ------
    ValueError
        For a solver that cannot be loaded.
    """
    from agents.registry import agent_class
    from experiments.run.provenance import provenance
    from trajectories.fileio import write_atomically

    states = QUICK if options.quick else options.states
    agent_class(options.solver)
    specs = [_spec(index, options.seed, options.solver) for index in range(states)]
    began = time.perf_counter()
    results = sorted(_measure(specs, options.workers, console), key=lambda one: int(one["index"]))
    summaries = summarise(results)
    missed = shortfalls(summaries, results)
    console.print(_table(summaries))
    console.print(_work(results), markup=False, highlight=False)
    content = {
        "format": "lpv-track-verify/1",
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "settings": {
            "states": states, "seed": options.seed, "solver": options.solver,
            "workers": options.workers,
        },
        **provenance(),
        "seconds": time.perf_counter() - began,
        "holds": not missed,
        "missed": missed,
        "summary": summaries,
        "situations": [_plain(result) for result in results],
    }  # fmt: skip
    file = options.out / "verify.json"
    write_atomically(file, json.dumps(content, indent=1, allow_nan=False).encode())
    console.out(f"written: {file}", highlight=False)
    for line in missed:
        console.print(f"fell short: {line}", markup=False, highlight=False, style="red")
    return 1 if missed else 0


def _spec(index: int, seed: int, solver: str) -> dict[str, Any]:
    """Return the spec of a situation for a worker process."""
    from experiments.run.suites import PAPER_VEHICLES
    from experiments.verify.bench import FATROP_EVERY, kind

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
    """Measure the situations in this process or in a pool, and return results as they end."""
    from experiments.run.benchmark import progress_bar
    from experiments.run.engines import Engine
    from experiments.verify.bench import run_situation, situation_death

    engine = Engine(min(workers, len(specs)))
    running = engine.run(specs, run_situation, failed=situation_death)
    results = []
    with progress_bar(console) as progress:
        bar = progress.add_task("situations", total=len(specs))
        for result in running:
            results.append(result)
            progress.advance(bar)
            if not console.is_terminal and len(results) % max(len(specs) // 10, 1) == 0:
                console.print(f"[{len(results)}/{len(specs)}]", markup=False, highlight=False)
    return results


def summarise(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return the distribution and verdict of every row.

    Returns
    -------
    list
        A dictionary per row: measure, title, goal, share_required, compared, of, median, p90, p99,
        max, lower, higher, share_within and holds (None for information). A value that is not
        finite is None. `lower` and `higher` count signed measures beyond `bench.SAME`.
    """
    return [_summary(row, results) for row in ROWS]


def _summary(row: Row, results: Sequence[Result]) -> dict[str, Any]:
    """Return the distribution and verdict of one row."""
    from experiments.verify.bench import SAME

    have = [
        result["measures"][row.measure] for result in results if row.measure in result["measures"]
    ]
    values = np.array([value for value in have if value is not None], dtype=np.float64)
    sizes = np.abs(values)
    summary: dict[str, Any] = {
        "measure": row.measure,
        "title": row.title,
        "goal": row.goal,
        "share_required": None if row.goal is None else row.share,
        "compared": len(values),
        "of": len(have) if row.sampled else len(results),
        "lower": int((values < -SAME).sum()) if row.signed else None,
        "higher": int((values > SAME).sum()) if row.signed else None,
    }
    for name, level in QUANTILES.items():
        value = float(np.quantile(sizes, level, method="inverted_cdf")) if len(sizes) else math.inf
        summary[name] = value if math.isfinite(value) else None
    within = None if row.goal is None or not len(sizes) else float((sizes <= row.goal).mean())
    summary["share_within"] = within
    summary["holds"] = None
    if row.goal is not None:
        enough = len(values) >= LEAST_COMPARED * len(results)
        summary["holds"] = bool(enough and within is not None and within >= row.share)
    return summary


def shortfalls(summaries: Sequence[Result], results: Sequence[Result]) -> list[str]:
    """Return a line for each goal that is missed and each situation that failed."""
    lines = []
    for row in summaries:
        if row["holds"] is not False:
            continue
        if row["compared"] < LEAST_COMPARED * row["of"]:
            lines.append(f"{row['title']}: only {row['compared']} of {row['of']} could be compared")
        else:
            lines.append(
                f"{row['title']}: {row['share_within']:.2%} within {row['goal']:g}, "
                f"{row['share_required']:.0%} asked for; largest {_number(row['max'])}"
            )
    failed = [result for result in results if result["error"]]
    return lines + [f"situation {result['index']}: {result['error']}" for result in failed]


def _number(value: float | None) -> str:
    """Format a measure for the table."""
    return "inf" if value is None else f"{value:.1e}"


def _table(summaries: Sequence[Result]) -> "Table":
    """Return the table of distributions and verdicts.

    The column -/+ counts the plans that cost less and more by more than `bench.SAME`.
    """
    from rich import box
    from rich.table import Table

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
            *(_number(row[name]) if n else "" for name in QUANTILES),
            "" if row["goal"] is None else f"{row['goal']:.0e}",
            "" if within is None else f"{verdict}{100.0 * within:.4g}%",
            "" if row["lower"] is None else f"{row['lower']}/{row['higher']}",
        )
    return result


def _work(results: Sequence[Result]) -> str:
    """Return the medians of iterations and times of all solvers in one line."""
    names = {"": "converged", "one_step": "one iteration", "ipopt": "IPOPT", "fatrop": "fatrop"}
    parts = []
    for prefix, name in names.items():
        key = f"{prefix}_" if prefix else ""
        words = []
        for measure, unit, scale in (("iterations", "iterations", 1.0), ("seconds", "ms", 1e3)):
            found = [
                result["measures"][key + measure]
                for result in results
                if key + measure in result["measures"]
            ]
            if found:
                words.append(f"{scale * float(np.median(found)):.3g} {unit}")
        if words:
            parts.append(f"{name} {', '.join(words)}")
    return "medians: " + "; ".join(parts)


def _plain(result: Result) -> dict[str, Any]:
    """Return a result for JSON: null if the oracle has no answer, "inf" if the solver has none."""
    measures = {
        name: value if value is None or math.isfinite(value) else "inf"
        for name, value in result["measures"].items()
    }
    kept = {key: result[key] for key in ("index", "trajectory", "vehicle", "error")}
    return {**kept, "measures": measures}
