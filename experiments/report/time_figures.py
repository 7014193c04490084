"""Figures of one quantity over time or arc length, a panel a trajectory."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from experiments.report.charts import Chart
from experiments.report.drives import Drive, by_trajectory, foot_points
from experiments.report.path_figures import Panel, StyleOf
from experiments.report.scales import around, exactly
from lpv_track_env.bicycle import PSI, VX

Array = NDArray[np.float64]


def lateral_error(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Lateral error over time."""
    return [
        Panel(name, _over_time(group, style_of, "lateral_error", "lateral error (m)"))
        for name, group in by_trajectory(drives).items()
    ]


def heading_error(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Heading error over time."""
    return [
        Panel(name, _over_time(group, style_of, "heading_error", "heading error (rad)"))
        for name, group in by_trajectory(drives).items()
    ]


def inputs(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Steering angle and, below it, acceleration in force, over time."""
    return [
        Panel(
            name,
            _over_time(group, style_of, "steering_angle", "steering (rad)", height=135.0)
            + _over_time(group, style_of, "acceleration", "accel. (m/s²)", height=135.0),
        )
        for name, group in by_trajectory(drives).items()
    ]


def _over_time(
    drives: Sequence[Drive], style_of: StyleOf, name: str, words: str, height: float = 170.0
) -> str:
    """SVG of one quantity of each drive's trace; × where one ended before the path did."""
    chart = Chart(
        exactly([0.0, *(drive.trace["time"] for drive in drives)]),
        around([drive.trace[name] for drive in drives]),
        x_label="time (s)", y_label=words, height=height,
    )  # fmt: skip
    for drive in drives:
        time, values, style = drive.trace["time"], drive.trace[name], style_of(drive)
        chart.course(time, values, style.kind, style.width)
        if not drive.finished:
            chart.cross(float(time[-1]), float(values[-1]), style.kind)
    return chart.svg()


def yaw(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Yaw over time, and the path's heading at the foot points of the first drive."""
    panels = []
    for name, group in by_trajectory(drives).items():
        yaws = [np.unwrap(drive.trace["state"][:, PSI]) for drive in group]
        _, _, reference = foot_points(group[0].trace)
        # Whole turns between the two are nobody's error.
        turn = 2.0 * np.pi
        yaws = [one - turn * np.round((one[0] - reference[0]) / turn) for one in yaws]
        chart = Chart(
            exactly([0.0, *(drive.trace["time"] for drive in group)]),
            around([reference, *yaws]),
            x_label="time (s)", y_label="yaw (rad)", height=170.0,
        )  # fmt: skip
        chart.course(group[0].trace["time"], reference, "broad")
        for drive, values in zip(group, yaws, strict=True):
            style = style_of(drive)
            chart.course(drive.trace["time"], values, style.kind, style.width)
        panels.append(Panel(name, chart.svg()))
    return panels


def speed(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Speed over arc length, with the speed that the path asks for there."""
    panels = []
    for name, group in by_trajectory(drives).items():
        longest = max((drive.trace for drive in group), key=lambda trace: trace["arc_length"][-1])
        chart = Chart(
            exactly([0.0, *(drive.trace["arc_length"] for drive in group)]),
            around(
                [longest["reference_speed"], *(drive.trace["state"][:, VX] for drive in group)],
                zero=True,
            ),
            x_label="arc length (m)", y_label="speed (m/s)", height=170.0,
        )  # fmt: skip
        chart.course(longest["arc_length"], longest["reference_speed"], "broad")
        for drive in group:
            style = style_of(drive)
            chart.course(
                drive.trace["arc_length"], drive.trace["state"][:, VX], style.kind, style.width
            )
        panels.append(Panel(name, chart.svg()))
    return panels
