"""`lpv-track ablation`: cost of each disturbance alone, and what helps against all of them."""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from experiments.commands.options import (
    add_engine,
    add_out,
    add_seeds,
    add_trajectories,
    engine_of,
    resumable,
    seeds_of,
)

EXAMPLE = "lpv-track ablation --trajectories T2 T5 --seeds 10 --out results/ablation"

Spec = dict[str, Any]

GROUPS: dict[str, tuple[str, ...]] = {
    "fixes: noise, wander, latency": ("gnss_noise", "gnss_wander", "gnss_latency"),
    "fixes: outages": ("gnss_dropout_rate", "gnss_dropout_duration"),
    "fixes: outliers": ("gnss_outlier_rate",),
    "heading: noise, bias": ("heading_noise", "heading_bias"),
    "yaw rate: noise, bias, drift": ("yaw_rate_noise", "yaw_rate_bias", "yaw_rate_drift"),
    "speed: noise, scale": ("speed_noise", "speed_scale"),
    "steering: lag": ("steering_lag",),
    "steering: dead time": ("steering_dead_time",),
    "steering: offset": ("steering_offset",),
    "drive: lag, dead time": ("drive_lag", "drive_dead_time"),
    "mass, inertia": ("mass_factor", "inertia_factor"),
    "tyre stiffness": ("front_stiffness_factor", "rear_stiffness_factor"),
    "rolling resistance": ("rolling_factor",),
    "friction": ("friction",),
    "wind, gusts": ("wind_speed", "gust_speed"),
    "computing delay": ("computing_delay",),
}
"""Fields of `Conditions` that a row switches on together, at their values in `REALTIME`."""
IDEAL = "none"
ALL = "all: realtime"
ALL_BUT: dict[str, dict[str, Any]] = {
    "all, readings without the filter": {"estimator": "raw"},
    "all, perfect sensors": {"estimator": "truth"},
    "all, steering offset not taken off": {"calibrate_steering": False},
    "all, fixes ten times as bad": {"gnss_noise": 0.3, "gnss_wander": 0.3},
}
"""Rows of all disturbances with one thing changed."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--agent", default="lpv-nmpc", metavar="NAME")
    add_trajectories(parser, ["T2", "T5"])
    add_seeds(parser, 10)
    add_out(parser, "results/ablation")
    add_engine(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Drive all rows, print the table, write `ablation.json` and `ablation.png`; the exit code.

    Cases that the folder already holds are kept, so that an interrupted run can be continued.
    """
    from experiments.run.benchmark import print_failed, run_benchmark, selected
    from experiments.run.provenance import revision, versions
    from trajectories.fileio import write_atomically

    cells = specs_of(options.trajectories, seeds_of(options), options.agent)
    specs = [spec for cell in cells.values() for spec in cell]
    settings = {
        "experiment": "ablation", "agent": options.agent, "trajectories": options.trajectories,
        "seeds": list(seeds_of(options)),
    }  # fmt: skip
    with resumable(options, console):
        store = run_benchmark(
            specs, options.out, engine=engine_of(options), settings=settings, console=console
        )
    if print_failed(selected(store, specs), console):
        # Means without the failed cases would not be comparable.
        return 1
    rows = [
        {"row": label, "compensated": compensated, **summary(selected(store, cell))}
        for (label, compensated), cell in cells.items()
    ]
    result = {**settings, "rows": rows, "revision": revision(), "versions": versions()}
    file = options.out / "ablation.json"
    write_atomically(file, json.dumps(result, indent=1).encode())
    draw(result, options.out / "ablation.png")
    console.print(table(result))
    console.out(f"written: {file}, ablation.png", highlight=False)
    return 0


def variants() -> dict[str, dict[str, Any]]:
    """Return the conditions of each row, in the form that cases take."""
    from lpv_track_env.conditions import REALTIME

    rows: dict[str, dict[str, Any]] = {IDEAL: {"name": "ideal", "estimator": "ekf"}}
    for label, names in GROUPS.items():
        changes = {name: getattr(REALTIME, name) for name in names}
        rows[label] = {**rows[IDEAL], **changes}
    rows[ALL] = {"name": "realtime"}
    for label, changes in ALL_BUT.items():
        rows[label] = {"name": "realtime", **changes}
    return rows


def specs_of(
    trajectories: Sequence[str], seeds: Sequence[int], agent: str
) -> dict[tuple[str, bool], list[Spec]]:
    """Return the cases of each row, with and without compensation of delays."""
    from experiments.run.suites import grid

    return {
        (label, compensated): grid(
            (agent,), trajectories, seeds=seeds, conditions=conditions,
            agent_settings={"delay_compensation": compensated},
        )
        for label, conditions in variants().items()
        for compensated in (True, False)
    }  # fmt: skip


def summary(cases: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return means over the episodes of a cell with 95 % intervals, and how many finished."""
    from experiments.run.estimates import estimate

    values: dict[str, Any] = {}
    for key in ("mle", "ale", "rms_estimate_error", "steering_variation"):
        found = estimate([case["metrics"][key] for case in cases])
        values[key], values[f"{key}_half_width"] = found.mean, found.half_width
    finished = sum(case["end"] == "finished" for case in cases)
    return {**values, "episodes": len(cases), "finished": finished}


def table(result: Mapping[str, Any]) -> Table:
    """Return the console's table, rows with and without compensation side by side."""
    paths = ", ".join(result["trajectories"])
    shown = Table(
        title=f"{result['agent']} on {paths}, {len(result['seeds'])} seeds: mean, 95 % interval",
        title_justify="left",
    )
    shown.add_column("disturbance", no_wrap=True)
    for heading in (
        "ALE\nm", "MLE\nm", "estimate\nrms m", "not comp.\nALE m", "not comp.\nMLE m",
    ):  # fmt: skip
        shown.add_column(heading, justify="right", no_wrap=True)
    pairs: dict[str, dict[bool, Mapping[str, Any]]] = {}
    for row in result["rows"]:
        pairs.setdefault(row["row"], {})[row["compensated"]] = row
    for label, pair in pairs.items():
        with_it, without = pair[True], pair[False]
        shown.add_row(
            label, _cell(with_it, "ale"), _cell(with_it, "mle"),
            f"{with_it['rms_estimate_error']:.3f}", _cell(without, "ale"), _cell(without, "mle"),
            end_section=label in {IDEAL, list(GROUPS)[-1]},
        )  # fmt: skip
    return shown


def _cell(row: Mapping[str, Any], key: str) -> str:
    if row["finished"] < row["episodes"]:
        return f"left {row['episodes'] - row['finished']} of {row['episodes']}"
    half = row[f"{key}_half_width"]
    return f"{row[key]:.3f}" + (f" ±{half:.3f}" if half is not None else "")


def draw(result: Mapping[str, Any], file: Path) -> None:
    """Draw the ALE of every row with and without compensation, hatched where the road was left."""
    from matplotlib.figure import Figure

    from experiments.figures import COLOURS, plain_ticks, save_figure

    labels = list(dict.fromkeys(row["row"] for row in result["rows"]))
    figure = Figure(figsize=(9.0, 0.42 * len(labels) + 1.6), layout="constrained")
    ax = figure.subplots()
    for offset, compensated, colour in ((-0.2, True, COLOURS[0]), (0.2, False, COLOURS[1])):
        rows = {row["row"]: row for row in result["rows"] if row["compensated"] is compensated}
        for place, label in enumerate(labels):
            row = rows[label]
            left = row["finished"] < row["episodes"]
            ax.barh(
                place + offset, row["ale"], 0.38, color=colour, alpha=0.35 if left else 1.0,
                hatch="//" if left else None, edgecolor="white" if not left else colour,
                xerr=None if left else (row["ale_half_width"] or 0.0), ecolor="0.3",
                label=("delays compensated" if compensated else "not compensated")
                if place == 0 else None,
            )  # fmt: skip
    ax.set_yticks(range(len(labels)), labels)
    ax.invert_yaxis()
    ax.set_xscale("log")
    plain_ticks(ax.xaxis)
    ax.set_xlabel("ALE, m (hatched: some episodes left the road)")
    ax.grid(visible=True, axis="x", alpha=0.3)
    ax.legend(loc="upper right")
    ax.set_title(f"{result['agent']}: each disturbance alone, and all of them")
    save_figure(figure, file)
