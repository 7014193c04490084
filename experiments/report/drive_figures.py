"""Figures of drives, a panel for each trajectory: paths from above, quantities over time."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from experiments.report.drives import (
    Drive,
    by_trajectory,
    foot_points,
    longest_trace,
    reference_line,
)
from experiments.report.page import LineStyle, Panel
from experiments.report.svg_charts import (
    BOTTOM,
    LEFT,
    RIGHT,
    TOP,
    WIDTH,
    Chart,
    Scale,
    around,
    exactly,
    spread,
)
from lpv_track_env.bicycle import PSI, VX, X, Y

Array = NDArray[np.float64]

HEIGHT = 260.0
"""Height of a view from above; of a chart over time, `FLAT`."""
FLAT = 170.0
ELONGATED = 0.08
"""Ratio of a path's extents below which it would look like a line on equal scales."""
MAGNIFIED = 0.06
"""Share of a path's extent to which the largest deviation is magnified."""
POINTS = 600

StyleOf = Callable[[Drive], LineStyle]


def paths(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the reference and the driven paths, to scale."""
    return [
        Panel(name, _plan(group, style_of, {id(drive): _driven(drive) for drive in group}))
        for name, group in by_trajectory(drives).items()
    ]


def magnified(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the driven paths with lateral errors multiplied by the factor in the panel's title."""
    panels = []
    for name, group in by_trajectory(drives).items():
        x, y = reference_line(group)
        largest = max(float(np.abs(drive.trace["lateral_error"]).max()) for drive in group)
        factor = _round_down(MAGNIFIED * max(np.ptp(x), np.ptp(y)) / max(largest, 1e-6))
        lines = {id(drive): _driven(drive, factor) for drive in group}
        panels.append(Panel(f"{name}, deviations ×{factor:g}", _plan(group, style_of, lines)))
    return panels


def _round_down(value: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten, at least 1."""
    if value < 2.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(factor for factor in (1.0, 2.0, 5.0) if factor * power <= value))


def _driven(drive: Drive, factor: float = 1.0) -> tuple[Array, Array]:
    state = drive.trace["state"]
    if factor == 1.0:
        return state[:, X], state[:, Y]
    x, y, heading = foot_points(drive.trace)
    away = factor * drive.trace["lateral_error"]
    return x - away * np.sin(heading), y + away * np.cos(heading)


def _plan(
    group: Sequence[Drive], style_of: StyleOf, lines: Mapping[int, tuple[Array, Array]]
) -> str:
    chart = reference_chart(group, [line for drive in group for line in lines[id(drive)]])
    for drive in group:
        x, y = lines[id(drive)]
        style, kept = style_of(drive), spread(len(x), POINTS)
        chart.line(x[kept], y[kept], style.kind, style.width)
        if not drive.finished:
            chart.cross(float(x[-1]), float(y[-1]), style.kind)
    return chart.svg()


def reference_chart(group: Sequence[Drive], driven: Sequence[Array]) -> Chart:
    """Return a chart from above with the reference as a broad line and its start as a disc.

    Its scales fit the lines to be drawn on it: `driven` holds their X, Y, X, Y, ... (m).
    """
    x, y = reference_line(group)
    every = (
        np.concatenate([np.ravel(one) for one in (x, *driven[0::2])]),
        np.concatenate([np.ravel(one) for one in (y, *driven[1::2])]),
    )
    scales, equal = _plan_scales(*every)
    chart = Chart(
        *scales, x_label="X (m)", y_label="Y (m)" if equal else "Y (m), not to scale",
        height=HEIGHT,
    )  # fmt: skip
    kept = spread(len(x), POINTS)
    chart.line(x[kept], y[kept], "broad")
    chart.dot(float(x[0]), float(y[0]), "start", 3.5)
    return chart


def _plan_scales(x: Array, y: Array) -> tuple[tuple[Scale, Scale], bool]:
    """Return scales over all points, equal ones unless the path is too slender for that."""
    width, height = (WIDTH - LEFT - RIGHT), (HEIGHT - TOP - BOTTOM)
    spans = [float(np.ptp(x)), float(np.ptp(y))]
    equal = min(spans) > ELONGATED * max(spans)
    middles = [0.5 * float(one.min() + one.max()) for one in (x, y)]
    reach = [1.1 * max(span, 1e-3) for span in spans]
    if equal:
        unit = max(reach[0] / width, reach[1] / height)
        reach = [unit * width, unit * height]
    pairs = zip(middles, reach, strict=True)
    first, second = (Scale(middle - span / 2, middle + span / 2) for middle, span in pairs)
    return (first, second), equal


def lateral_error(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the lateral error over time."""
    return _over_time(drives, style_of, FLAT, ("lateral_error", "lateral error (m)"))


def heading_error(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the heading error over time."""
    return _over_time(drives, style_of, FLAT, ("heading_error", "heading error (rad)"))


def inputs(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw steering angle and, below it, acceleration in force, over time."""
    quantities = ("steering_angle", "steering (rad)"), ("acceleration", "accel. (m/s²)")
    return _over_time(drives, style_of, 135.0, *quantities)


def _over_time(
    drives: Sequence[Drive], style_of: StyleOf, height: float, *quantities: tuple[str, str]
) -> list[Panel]:
    """Draw arrays of the traces, (name, axis label) each, one chart below the other."""
    return [
        Panel(name, "".join(_time_chart(group, style_of, height, *one) for one in quantities))
        for name, group in by_trajectory(drives).items()
    ]


def _time_chart(
    drives: Sequence[Drive], style_of: StyleOf, height: float, name: str, words: str
) -> str:
    """Return the SVG of one quantity, with × where a drive ended before the path did."""
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
    """Draw the yaw over time, and the path's heading at the foot points of the first drive."""
    panels = []
    for name, group in by_trajectory(drives).items():
        yaws = [np.unwrap(drive.trace["state"][:, PSI]) for drive in group]
        _, _, reference = foot_points(group[0].trace)
        # Whole turns between yaw and reference are no error.
        turn = 2.0 * np.pi
        yaws = [one - turn * np.round((one[0] - reference[0]) / turn) for one in yaws]
        chart = Chart(
            exactly([0.0, *(drive.trace["time"] for drive in group)]),
            around([reference, *yaws]),
            x_label="time (s)", y_label="yaw (rad)", height=FLAT,
        )  # fmt: skip
        chart.course(group[0].trace["time"], reference, "broad")
        for drive, values in zip(group, yaws, strict=True):
            style = style_of(drive)
            chart.course(drive.trace["time"], values, style.kind, style.width)
        panels.append(Panel(name, chart.svg()))
    return panels


def speed(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the speed over arc length, and the path's reference speed."""
    panels = []
    for name, group in by_trajectory(drives).items():
        longest = longest_trace(group)
        speeds = [drive.trace["state"][:, VX] for drive in group]
        chart = Chart(
            exactly([0.0, *(drive.trace["arc_length"] for drive in group)]),
            around([longest["reference_speed"], *speeds], zero=True),
            x_label="arc length (m)", y_label="speed (m/s)", height=FLAT,
        )  # fmt: skip
        chart.course(longest["arc_length"], longest["reference_speed"], "broad")
        for drive, values in zip(group, speeds, strict=True):
            style = style_of(drive)
            chart.course(drive.trace["arc_length"], values, style.kind, style.width)
        panels.append(Panel(name, chart.svg()))
    return panels
