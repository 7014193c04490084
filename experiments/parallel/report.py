"""Report of a run on the console, and its figure `run.png`."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich import box
from rich.table import Table
from rich.text import Text

from experiments.figures import COLOURS, plain_ticks
from experiments.parallel.recording import Driven, Outcome, Recording, Summary
from experiments.parallel.setup import STALE_PERIODS, Setup
from lpv_track_env.bicycle import VX, X, Y
from trajectories import ReferencePath


def table(setup: Setup, summary: Summary) -> Table:
    """Return the table of latencies for a console."""
    rows = Table(box=box.SIMPLE_HEAD)
    for heading in ("", "median", "99 %", "max"):
        rows.add_column(heading, justify="left" if not heading else "right")
    stages = summary["stages"]
    for name, times in (
        ("wake-to-action: sample due to command applied, ms", summary["wake_to_action"]),
        ("    sample due to estimate written", stages["sample_to_estimate"]),
        ("    to command written", stages["estimate_to_command"]),
        ("    to command applied", stages["command_to_action"]),
        ("solve (predict), ms", summary["solve_time"]),
        ("age of the estimate driven on, ms", summary["estimate_age"]),
        ("lateness of the vehicle's own ticks, ms", summary["vehicle_lateness"]),
    ):
        if times is not None:
            cells = [f"{1e3 * times[key]:.3f}" for key in ("median", "p99", "max")]
            rows.add_row(Text(name), *cells)
    rows.title = (
        f"{setup.agent} on {setup.trajectory}, {setup.estimator}, {setup.conditions_name}: "
        f"{summary['rate']:.2f} of {setup.rate} Hz"
    )
    return rows


def sentences(summary: Summary) -> list[str]:
    """Return what the table does not hold, a line each."""
    share, misses = 100.0 * summary["answered_share"], summary["deadline_misses"]
    lines = [
        f"{summary['periods']} periods, {share:.2f} % answered in time, {misses} deadline misses"
    ]
    if "tracking" in summary:
        errors = summary["tracking"]
        lines.append(f"tracking (truth): MLE {errors['mle']:.3f} m, ALE {errors['ale']:.3f} m")
    if summary.get("estimation"):
        values = summary["estimation"]
        lines.append(
            f"estimate: position error rms {values['position_rms']:.3f} m, "
            f"max {values['position_max']:.3f} m; {values['fixes_used']} fixes used, "
            f"{values['fixes_refused']} refused; {values['readings_refused']} readings refused; "
            f"{values['samples_lost']} samples lost"
        )
    found = summary["faults"]
    if found["stale_brakings"]:
        first = found["stale_brakings"][0]
        lines.append(
            f"the vehicle braked {len(found['stale_brakings'])} times for lack of a fresh command, "
            f"first at {first['began']:.3f} s, {first['age_periods']:.2f} periods "
            f"(of {STALE_PERIODS}) after the last good sample"
        )
    brakings = {name: count for name, count in found["commands_to_brake"].items() if count}
    if brakings:
        words = ", ".join(f"{count} for {name}" for name, count in brakings.items())
        lines.append(f"commands to brake: {words}")
    lines += [
        f"the {name} had to compile while driving, which stalls it: {place}"
        for name, place in found["compiled_while_driving"].items()
    ]
    stop = summary["stop"]
    lines.append(
        f"end: {summary['end']}; then stopped in {stop['distance']:.1f} m and "
        f"{stop['seconds']:.1f} s (simulated), at {stop['final_speed']:.2f} m/s"
    )
    return lines


def draw(setup: Setup, outcome: Outcome, summary: Summary, path: ReferencePath) -> Figure | None:
    """Draw four panels; None for a run that never began."""
    recording = outcome.recording
    if len(recording.rows) < 2:
        return None
    driven = recording.driven()
    figure = Figure(figsize=(13.0, 8.5), layout="constrained")
    panels = figure.subplots(2, 2)
    _latencies(panels[0, 0], setup, recording)
    _distribution(panels[0, 1], setup, recording)
    _errors(panels[1, 0], outcome, driven)
    _map(panels[1, 1], recording, driven, path)
    figure.suptitle(
        f"lpv-track run-parallel: {setup.agent} on {setup.trajectory}, {setup.estimator}, "
        f"{setup.conditions_name}; {summary['rate']:.2f} of {setup.rate} Hz, "
        f"{summary['deadline_misses']} deadline misses; end: {outcome.end}"
    )
    return figure


def _latencies(ax: Axes, setup: Setup, recording: Recording) -> None:
    applied = recording.applied()
    time = applied["period"] * setup.period
    for name, label, colour in (
        ("latency", "applied", COLOURS[0]),
        ("commanded", "command written", COLOURS[1]),
        ("estimated", "estimate written", COLOURS[2]),
    ):
        ax.plot(time, 1e3 * applied[name], ".", markersize=2, label=label, color=colour)
    ax.axhline(1e3 * setup.period, color="black", linewidth=0.8, label="control period")
    ax.set_yscale("log")
    plain_ticks(ax.yaxis, (1.0,))
    ax.set_xlabel("time, s")
    ax.set_ylabel("ms after the sample was due")
    ax.legend(fontsize="small", markerscale=4)
    ax.grid(visible=True, alpha=0.3)


def _distribution(ax: Axes, setup: Setup, recording: Recording) -> None:
    applied = recording.applied()
    for name, label, colour in (
        ("latency", "wake-to-action", COLOURS[0]),
        ("solve_time", "solve", COLOURS[1]),
    ):
        values = np.sort(1e3 * applied[name][applied[name] > 0.0])
        if values.size:
            beyond = 1.0 - np.arange(values.size) / values.size
            ax.step(values, beyond, where="post", label=label, color=colour)
    ax.axvline(1e3 * setup.period, color="black", linewidth=0.8, label="control period")
    ax.set_xscale("log")
    ax.set_yscale("log")
    plain_ticks(ax.xaxis, (1.0,))
    plain_ticks(ax.yaxis, (1.0,))
    ax.set_xlabel("ms")
    ax.set_ylabel("share of periods that took longer")
    ax.legend(fontsize="small")
    ax.grid(visible=True, alpha=0.3)


def _errors(ax: Axes, outcome: Outcome, driven: Driven) -> None:
    ax.plot(driven.time, driven.lateral_error, color=COLOURS[0], linewidth=1.0)
    ax.set_xlabel("time, s")
    ax.set_ylabel("lateral error (truth), m")
    for one in outcome.stale_brakings:
        ended = driven.time[-1] if one.ended is None else one.ended
        ax.axvspan(one.began, ended, color=COLOURS[3], alpha=0.3)
    speed = ax.twinx()
    speed.plot(driven.time, driven.state[:, VX], color=COLOURS[1], linewidth=0.8)
    speed.set_ylabel("speed, m/s", color=COLOURS[1])
    ax.grid(visible=True, alpha=0.3)


def _map(ax: Axes, recording: Recording, driven: Driven, path: ReferencePath) -> None:
    ax.plot(path.x, path.y, color="lightgrey", linewidth=3.0, label="path")
    ax.plot(driven.state[:, X], driven.state[:, Y], color=COLOURS[0], linewidth=1.0, label="driven")
    estimates = np.array([one["state"] for one in recording.estimates.values()])
    if estimates.size:
        ax.plot(
            estimates[:, X], estimates[:, Y], ".", color=COLOURS[1], markersize=1, label="estimated"
        )
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("X, m")
    ax.set_ylabel("Y, m")
    ax.legend(fontsize="small", markerscale=6)
