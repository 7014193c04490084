"""Comparison of a replay with the recording: statistics, a table and a figure."""

from pathlib import Path
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray
from rich.table import Table

from experiments.figures import COLOURS, STYLE, save_figure
from experiments.ros.replay import Replay
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y

Array = NDArray[np.float64]

LIMIT_95 = 5.991
"""95 % quantile of chi-square with 2 degrees of freedom, for the NIS of fixes."""
RECORDED, REPLAYED, THIRD = COLOURS[0], COLOURS[1], COLOURS[2]
PATH: dict[str, Any] = {"color": "#000000", "alpha": 0.25, "linewidth": 4.0, "label": "path"}
ERRORS = (
    ("position", "m"),
    ("heading", "rad"),
    ("longitudinal speed", "m/s"),
    ("lateral speed", "m/s"),
    ("yaw rate", "rad/s"),
)


def differences(replay: Replay) -> dict[str, Array]:
    """Return estimate - odometry and proposed - recorded commands by name, (n,); may be NaN."""
    found: dict[str, Array] = {}
    if replay.odometry is not None:
        apart = replay.estimate - replay.odometry
        found["position"] = np.hypot(apart[:, X], apart[:, Y])
        found["heading"] = np.angle(np.exp(1j * apart[:, PSI]))
        found["longitudinal speed"] = apart[:, VX]
        found["lateral speed"] = apart[:, VY]
        found["yaw rate"] = apart[:, YAW_RATE]
    commands = replay.proposed - replay.recorded
    found["acceleration"], found["steering angle"] = commands.T
    return found


def summary(replay: Replay) -> dict[str, Any]:
    """Return plain values for JSON: rms and largest errors, NIS, counts, remarks.

    `errors` compares the estimate with odometry and is empty without it. A statistic without data
    is None.
    """
    found = {name: _magnitudes(values) for name, values in differences(replay).items()}
    used = replay.fix_nis[replay.fix_used]
    recording = replay.recording
    return {
        "seconds": float(replay.time[-1]),
        "periods": len(replay.time),
        "errors": {name: found[name] for name, _ in ERRORS if name in found},
        "commands": {name: found[name] for name in ("acceleration", "steering angle")},
        "lateral_error": _magnitudes(replay.lateral_error),
        "fix_nis": {
            "mean": float(used.mean()) if len(used) else None,
            "expected": 2.0,
            "share_within_95": float((used < LIMIT_95).mean()) if len(used) else None,
        },
        "reading_nis": {
            "mean": replay.reading_nis / replay.readings if replay.readings else None,
            "expected": 1.0,
        },
        "counts": replay.counts,
        "datum": list(recording.datum),
        "odometry_is_aligned": recording.odometry_is_aligned,
        "remarks": recording.remarks,
    }


def _magnitudes(values: Array) -> dict[str, float | None]:
    """Return rms and largest magnitude of the finite values."""
    known = values[np.isfinite(values)]
    if not len(known):
        return {"rms": None, "max": None}
    return {"rms": float(np.sqrt(np.mean(known**2))), "max": float(np.abs(known).max())}


def table(found: dict[str, Any]) -> Table:
    """Return a summary as a table for the console."""
    result = Table(title="replay against recording")
    for heading in ("", "rms", "largest", "unit"):
        result.add_column(heading, justify="left" if heading in {"", "unit"} else "right")
    for name, unit in ERRORS:
        if name in found["errors"]:
            _row(result, f"estimate - odometry: {name}", found["errors"][name], unit)
    _row(result, "estimate - path: lateral error", found["lateral_error"], "m")
    for name, unit in (("acceleration", "m/s^2"), ("steering angle", "rad")):
        _row(result, f"proposed - recorded: {name}", found["commands"][name], unit)
    fix, reading = found["fix_nis"], found["reading_nis"]
    if fix["mean"] is not None:
        result.caption = (
            f"NIS of fixes: mean {fix['mean']:.2f} (2 expected), "
            f"{100.0 * fix['share_within_95']:.0f} % within 95 %'s {LIMIT_95:.2f}"
        )
    if reading["mean"] is not None:
        result.caption = (
            f"{result.caption or ''}; NIS of a reading: {reading['mean']:.2f} (1 expected)"
        )
    return result


def _row(result: Table, words: str, values: dict[str, float | None], unit: str) -> None:
    cells = ["-" if value is None else f"{value:.4f}" for value in values.values()]
    result.add_row(words, *cells, unit)


def draw(replay: Replay, file: Path) -> None:
    """Write the figure: plan, error of the estimate, both commands, NIS of the fixes."""
    with mpl.rc_context(cast("Any", STYLE)):
        figure = Figure(figsize=(12.0, 7.5), layout="constrained")
        grid = figure.add_gridspec(4, 2)
        _draw_plan(figure.add_subplot(grid[:2, 0]), replay)
        acceleration = figure.add_subplot(grid[:2, 1])
        others = {"sharex": acceleration}
        _draw_commands(acceleration, replay, 0, "acceleration (m/s²)")
        steering = figure.add_subplot(grid[2:, 1], **others)
        _draw_commands(steering, replay, 1, "steering angle (rad)")
        error = figure.add_subplot(grid[2, 0], **others)
        _draw_error(error, replay)
        nis = figure.add_subplot(grid[3, 0], **others)
        _draw_nis(nis, replay)
        for axes in (steering, nis):
            axes.set_xlabel("time since the first fix (s)")
        for axes in figure.axes:
            # Above the axes: nothing of the lines is hidden.
            axes.legend(
                loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False,
                borderaxespad=0.1,
            )  # fmt: skip
        save_figure(figure, file)


def _draw_plan(axes: Axes, replay: Replay) -> None:
    axes.plot(replay.path.x, replay.path.y, **PATH)
    positions = replay.recording.positions
    axes.plot(positions[:, 0], positions[:, 1], ".", color=THIRD, markersize=3.0, label="fixes")
    if replay.odometry is not None:
        axes.plot(replay.odometry[:, X], replay.odometry[:, Y], color=RECORDED, label="odometry")
    axes.plot(
        replay.estimate[:, X], replay.estimate[:, Y], color=REPLAYED, linestyle="dashed",
        label="estimate",
    )  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")


def _draw_commands(axes: Axes, replay: Replay, column: int, words: str) -> None:
    axes.plot(replay.time, replay.recorded[:, column], color=RECORDED, label="recorded")
    axes.plot(
        replay.time, replay.proposed[:, column], color=REPLAYED, linestyle="dashed",
        label="proposed",
    )  # fmt: skip
    axes.set_ylabel(words)


def _draw_error(axes: Axes, replay: Replay) -> None:
    if replay.odometry is not None:
        axes.plot(
            replay.time, differences(replay)["position"], color=REPLAYED,
            label="estimate - odometry",
        )  # fmt: skip
    axes.fill_between(
        replay.time, 0.0, 2.0 * replay.deviation, color=RECORDED, alpha=0.2,
        label="two deviations, by the filter",
    )  # fmt: skip
    axes.set_ylabel("position (m)")
    axes.set_ylim(bottom=0.0)


def _draw_nis(axes: Axes, replay: Replay) -> None:
    floor = 1e-3
    nis = np.maximum(replay.fix_nis, floor)
    axes.semilogy(
        replay.fix_time[replay.fix_used], nis[replay.fix_used], ".", color=RECORDED,
        markersize=3.0, label="used",
    )  # fmt: skip
    if not replay.fix_used.all():
        axes.semilogy(
            replay.fix_time[~replay.fix_used], nis[~replay.fix_used], "x", color=REPLAYED,
            label="gated",
        )  # fmt: skip
    axes.axhline(LIMIT_95, color=THIRD, linestyle="dashed", label="95 %")
    axes.set_ylim(floor, max(10.0 * LIMIT_95, 3.0 * float(nis.max(initial=floor))))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylabel("NIS of a fix")
