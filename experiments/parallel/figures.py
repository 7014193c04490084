"""`run.png`: latencies, path and errors of a parallel run."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments.figures import COLOURS
from experiments.parallel.recording import Driven, Outcome, Recording
from experiments.parallel.report import Summary
from experiments.parallel.setup import Setup
from lpv_track_env.bicycle import VX, X, Y
from trajectories import ReferencePath


def picture(setup: Setup, outcome: Outcome, summary: Summary, path: ReferencePath) -> Figure | None:
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
    _plain(ax.yaxis)
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
    _plain(ax.xaxis)
    _plain(ax.yaxis)
    ax.set_xlabel("ms")
    ax.set_ylabel("share of periods that took longer")
    ax.legend(fontsize="small")
    ax.grid(visible=True, alpha=0.3)


def _plain(axis: Axis) -> None:
    """Plain numbers at the decades of a logarithmic axis."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


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
