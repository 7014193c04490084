"""`lpv-track latency`: estimation and control in sequence or in parallel, and the effect of it.

kumar2025lpv runs both in parallel processes to cut latency and gives no figure (errata, 9). Here
computing times of this project's filter and solvers are recorded. Each control period draws its
times from these records, and they delay the commands of a vehicle in real-time conditions.

Parallel processes change how often a command can be computed: in sequence, a computation that takes
longer than a period misses every second one, or needs a slower clock. They do not make the readings
behind a command any fresher; with a clock for each process the readings get older.
"""

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.commands.options import (
    add_engine,
    add_out,
    add_seeds,
    add_trajectories,
    engine_of,
    file_name,
    resumable,
    seeds_of,
)

EXAMPLE = "lpv-track latency --trajectories T2 T4 --seeds 10 --out results/latency"

Spec = dict[str, Any]

PERIOD = 0.02
"""Control period of the paper (50 Hz), s."""
AGENT = "lpv-nmpc"
SOLVERS = ("lpv-nmpc", "lpv-nmpc-ipopt")
MAILBOX = 1e-4
"""Time from process to process, s, as `lpv-track run-parallel --bench-mailbox` measures it."""
SHARES = (0.5, 1.0, 1.5, 1.9)
"""Mean computing times of slower computers over the period; half is the estimator's."""
RECORDED_STEPS = 400
SLOWER_CLOCK = "sequential, slower clock"
"""One process whose period is long enough for most computations."""
KEPT = 0.95
"""Share of computations that end within the period of the slower clock."""
COLUMNS = ("sequential", SLOWER_CLOCK, "triggered", "free-running")
"""Arrangements of `ComputingTimes` and the slower clock, in the order of the figure."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_trajectories(parser, ["T2", "T4"])
    add_seeds(parser, 10)
    parser.add_argument(
        "--times", type=file_name, metavar="FILE",
        help="times.json of an earlier run, in place of recording",
    )  # fmt: skip
    add_out(parser, "results/latency")
    add_engine(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Record or read times, drive all rows, print the table, write JSON and figure; exit code."""
    from experiments.run.benchmark import print_failed, run_benchmark, selected
    from experiments.run.provenance import revision, versions
    from trajectories.fileio import write_atomically

    folder: Path = options.out
    settings = {
        "experiment": "latency", "trajectories": options.trajectories,
        "seeds": list(seeds_of(options)), "period": PERIOD,
    }  # fmt: skip
    kept = folder / "times.json"
    with resumable(options, console):
        if options.times is not None or kept.exists():
            recorded = read_times(options.times or kept)
        else:
            console.print("recording the times of the filter and of both solvers ...")
            recorded = record(options.trajectories[0])
        write_atomically(kept, json.dumps(recorded).encode())
        cells = specs_of(recorded, options.trajectories, seeds_of(options))
        specs = [spec for cell in cells.values() for spec in cell]
        store = run_benchmark(
            specs, folder, engine=engine_of(options), settings=settings, console=console
        )
    if print_failed(selected(store, specs), console):
        # Means without the failed cases would not be comparable.
        return 1
    rows = [
        {"row": label, "arrangement": arrangement, **summary(selected(store, cell))}
        for (label, arrangement), cell in cells.items()
    ]
    result = {
        **settings, "times": recorded, "rows": rows, "revision": revision(), "versions": versions(),
    }  # fmt: skip
    write_atomically(folder / "latency.json", json.dumps(result, indent=1).encode())
    draw(result, folder / "latency.png")
    console.print(table(result))
    console.out(
        f"written: {folder / 'latency.json'}, latency.png; the same again with --times {kept}",
        highlight=False,
    )
    return 0


def record(trajectory: str, steps: int = RECORDED_STEPS) -> dict[str, list[float]]:
    """Measure filter and solvers on this machine; return quantiles of their times, s, by name."""
    from experiments.run.case import Case
    from experiments.run.computing import quantiles
    from experiments.run.rollout import rollout

    recorded = {"ekf": quantiles(filter_times(steps))}
    for name in SOLVERS:
        case = Case(
            agent=name, trajectory=trajectory, control_period=PERIOD, conditions="realtime",
            env_settings={"time_limit": steps * PERIOD},
        )  # fmt: skip
        env = case.make_env()
        driven = rollout(env, case.make_agent(env), seed=0)
        # The first solve has no warm start.
        recorded[name] = quantiles(driven.trace.solve_time[2:])
        env.close()
    return recorded


def filter_times(steps: int) -> list[float]:
    """Return times (s) of the filter's work in a period: prediction, readings, a fix 0.1 s late."""
    from lpv_track_env.estimation.estimator import Estimator
    from lpv_track_env.vehicle import VEHICLES

    estimator = Estimator(VEHICLES["m2-minibus"], period=PERIOD)
    times: list[float] = []
    for _ in range(2):
        times.clear()  # The first run compiles.
        estimator.begin(0.0, 0.0, 0.0, 0.0, 8.0)
        for k in range(1, steps + 1):
            now = k * PERIOD
            began = time.perf_counter()
            estimator.advance(now, 0.2, 0.01, heading=0.0, yaw_rate=0.0, speed=8.0)
            if k % 5 == 0:
                estimator.take_fix(now - 0.1, 8.0 * (now - 0.1), 0.0)
            times.append(time.perf_counter() - began)
    return times


def loads(recorded: Mapping[str, Sequence[float]]) -> dict[str, dict[str, Any]]:
    """Return the times of estimator and controller of each row, arguments of `ComputingTimes`."""
    rows: dict[str, dict[str, Any]] = {
        f"measured: ekf, {name}": {"estimation": recorded["ekf"], "control": recorded[name]}
        for name in SOLVERS
    }
    ekf, ipopt = np.array(recorded["ekf"]), np.array(recorded["lpv-nmpc-ipopt"])
    for share in SHARES:
        half = 0.5 * share * PERIOD
        rows[f"slower: {share:g} of a period"] = {
            "estimation": (half / ekf.mean() * ekf).tolist(),
            "control": (half / ipopt.mean() * ipopt).tolist(),
        }
    return rows


def specs_of(
    recorded: Mapping[str, Sequence[float]], trajectories: Sequence[str], seeds: Sequence[int]
) -> dict[tuple[str, str], list[Spec]]:
    """Return the cases of each row and arrangement; the agent knows the mean latency."""
    from experiments.run.computing import ARRANGEMENTS, ComputingTimes
    from experiments.run.suites import grid

    cells = {}
    for label, times in loads(recorded).items():
        for arrangement in ARRANGEMENTS:
            computing = {"arrangement": arrangement, **times, "mailbox": MAILBOX}
            probe = ComputingTimes(**computing, period=PERIOD)
            latencies = [probe(k, 0.0)[0] for k in range(2000)]
            delay = float(np.mean(latencies))
            clocks = {arrangement: PERIOD}
            periods = math.ceil(float(np.quantile(latencies, KEPT)) / PERIOD)
            if arrangement == "sequential" and periods > 1:
                clocks[SLOWER_CLOCK] = periods * PERIOD
            for name, period in clocks.items():
                cells[label, name] = grid(
                    (AGENT,), trajectories, seeds=seeds, control_period=period,
                    conditions={"name": "realtime", "computing_delay": delay}, computing=computing,
                )  # fmt: skip
    return cells


def read_times(file: Path) -> dict[str, list[float]]:
    """Read times that an earlier run has recorded.

    Raises
    ------
    ValueError
        If the file does not hold recorded times.
    """
    from experiments.run.computing import ComputingTimes
    from trajectories.fileio import checked, read_json

    try:
        recorded = checked(read_json(file), dict[str, list[float]], file)
        for name in ("ekf", *SOLVERS):
            ComputingTimes("sequential", recorded[name], recorded[name], period=PERIOD)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{file} does not hold recorded times: {error}") from error
    return recorded


def summary(cases: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return latencies (s), share of missed periods and errors over the episodes of a cell."""
    from experiments.run.estimates import estimate

    ale, mle = (estimate([case["metrics"][key] for case in cases]) for key in ("ale", "mle"))
    periods = [case["metrics"]["duration"] / case["control_period"] for case in cases]
    return {
        "latency_median": float(np.mean([case["latency"]["median"] for case in cases])),
        "latency_p99": float(np.mean([case["latency"]["p99"] for case in cases])),
        "missed": float(
            np.sum([case["metrics"]["deadline_misses"] for case in cases]) / np.sum(periods)
        ),
        "period": cases[0]["control_period"],
        "ale": ale.mean,
        "ale_half_width": ale.half_width,
        "mle": mle.mean,
        "mle_half_width": mle.half_width,
        "episodes": len(cases),
        "finished": sum(case["end"] == "finished" for case in cases),
    }


def table(result: Mapping[str, Any]) -> Table:
    """Return the console's table, a line per row and arrangement."""
    paths = ", ".join(result["trajectories"])
    shown = Table(
        title=f"{AGENT} at {1 / PERIOD:.0f} Hz on {paths}, {len(result['seeds'])} seeds",
        title_justify="left",
    )
    shown.add_column("computing time", max_width=24)
    shown.add_column("arrangement", no_wrap=True)
    for heading in (
        "clock\nms", "latency\nms", "p99\nms", "missed", "ALE\nm", "MLE\nm", "finished",
    ):  # fmt: skip
        shown.add_column(heading, justify="right", no_wrap=True)
    seen = ""
    for row in result["rows"]:
        shown.add_row(
            "" if row["row"] == seen else row["row"], row["arrangement"],
            f"{1e3 * row['period']:.0f}",
            f"{1e3 * row['latency_median']:.2f}", f"{1e3 * row['latency_p99']:.2f}",
            f"{100 * row['missed']:.1f} %",
            *(
                f"{row[key]:.3f}"
                + (f" ±{half:.3f}" if (half := row[f"{key}_half_width"]) is not None else "")
                for key in ("ale", "mle")
            ),
            f"{row['finished']} of {row['episodes']}",
            end_section=row["arrangement"] == COLUMNS[-1],
        )  # fmt: skip
        seen = row["row"]
    return shown


def draw(result: Mapping[str, Any], file: Path) -> None:
    """Draw latency, missed periods and ALE of every row and arrangement."""
    from matplotlib.figure import Figure

    from experiments.figures import COLOURS, plain_ticks, save_figure

    labels = list(dict.fromkeys(row["row"] for row in result["rows"]))
    figure = Figure(figsize=(12.0, 4.8), layout="constrained")
    panels = (
        ("latency_median", 1e3, "latency, median, ms (line to p99)"),
        ("missed", 100.0, "periods missed, %"),
        ("ale", 1.0, "ALE, m"),
    )
    for ax, (key, factor, title) in zip(figure.subplots(1, 3, sharey=True), panels, strict=True):
        for place, arrangement in enumerate(COLUMNS):
            rows = [row for row in result["rows"] if row["arrangement"] == arrangement]
            if not rows:
                continue
            values = np.array([factor * row[key] for row in rows])
            heights = [labels.index(row["row"]) + 0.2 * (place - 1.5) for row in rows]
            spread: Any = None
            if key == "latency_median":
                top = np.array([factor * row["latency_p99"] for row in rows])
                spread = [np.zeros(len(rows)), np.maximum(top - values, 0.0)]
            elif key == "ale":
                spread = [row["ale_half_width"] or 0.0 for row in rows]
            ax.barh(
                heights, values, 0.19, xerr=spread, color=COLOURS[place], ecolor="0.3",
                label=arrangement,
            )  # fmt: skip
        ax.set_title(title)
        if key == "ale":
            ax.set_xscale("log")
            plain_ticks(ax.xaxis)
        ax.grid(visible=True, axis="x", alpha=0.3)
        ax.set_yticks(range(len(labels)), labels)
    figure.axes[0].invert_yaxis()
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names))
    figure.suptitle(
        "Estimation and control in one process (sequential) or two (triggered by the estimate, or "
        "free-running)"
    )
    save_figure(figure, file)
