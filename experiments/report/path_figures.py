"""Figures of paths from above: the reference, and what was driven on it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiments.report.charts import BOTTOM, LEFT, RIGHT, TOP, WIDTH, Chart, spread
from experiments.report.drives import Drive, by_trajectory, foot_points, reference_line
from experiments.report.scales import Scale
from experiments.report.styles import LineStyle
from lpv_track_env.bicycle import X, Y

Array = NDArray[np.float64]

HEIGHT = 260.0
ELONGATED = 0.08
"""Width per length of a path under which equal scales would show a line."""
MAGNIFIED = 0.06
"""Share of a path's extent that the largest deviation is magnified to."""
POINTS = 600

StyleOf = Callable[[Drive], LineStyle]


@dataclass(frozen=True)
class Panel:
    """A part of a figure: its title and its SVG."""

    title: str
    svg: str


def paths(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Reference and driven paths, to scale; a panel a trajectory."""
    return [
        Panel(name, _plan(group, style_of, {id(drive): _driven(drive) for drive in group}))
        for name, group in by_trajectory(drives).items()
    ]


def magnified(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """The same with deviations from the path drawn larger, each panel's factor in its title.

    Each point stands where the vehicle would be with that many times its lateral error.
    """
    panels = []
    for name, group in by_trajectory(drives).items():
        x, y = reference_line(group)
        largest = max(float(np.abs(drive.trace["lateral_error"]).max()) for drive in group)
        factor = _round_down(MAGNIFIED * max(np.ptp(x), np.ptp(y)) / max(largest, 1e-6))
        lines = {id(drive): _driven(drive, factor) for drive in group}
        panels.append(Panel(f"{name}, deviations ×{factor:g}", _plan(group, style_of, lines)))
    return panels


def _round_down(value: float) -> float:
    """The next of 1, 2, 5, 10, ... below, at least 1."""
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
    """A chart from above with the path of a group of drives as a broad line, its start a disc.

    Parameters
    ----------
    group
        Drives on one trajectory.
    driven
        X, Y, X, Y, ... of what will be drawn on it, m.
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
    """Scales that hold all points, equal ones unless the path is too slender for that."""
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
