"""Figures of a report from saved traces, each a list of small SVG panels.

A figure is a panel per trajectory (solve times: one panel), so that a page can lay them out beside
or below each other as its width allows. Nothing here touches pyplot or lasting global state, and
the same traces give the same bytes. Long traces are decimated to their extremes.
"""

import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from numpy.typing import NDArray

import trajectories
from lpv_track_env import vehicle
from lpv_track_env.bicycle import VX, VY, X, Y
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Array = NDArray[np.float64]

POINTS = 600
"""Most points of a line; a panel is about 300 pt wide, so this is two per point of width."""
WIDTH = 4.2
"""in, of a panel: 302 pt, so 9 pt text is about 10 px on a narrow phone."""
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5195")
"""Okabe and Ito's colour-blind-safe set (jfly.uni-koeln.de/color) less black and yellow, a violet
added."""
DASHES = ("solid", "dashed", "dotted", "dashdot")
REFERENCE = "#000000"
BROAD: dict[str, Any] = {"color": REFERENCE, "alpha": 0.16, "linewidth": 6.0}
LIMIT = "#B00020"
ELONGATED = 0.08
"""Width per length of a path under which equal scales would show a line."""
AT_LIMIT = 0.99
"""Share of the limit on |vy|/vx from which on a vehicle is drawn as being at it."""
EXCESS = 1e-3
STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "text.parse_math": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.formatter.useoffset": False,
    "lines.linewidth": 1.1,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}
TRACE = (
    "time", "state", "arc_length", "lateral_error", "heading_error", "reference_speed",
    "acceleration", "steering_angle", "solve_time",
)  # fmt: skip
"""Arrays that a trace must hold to be drawn."""


@dataclass(frozen=True)
class Drive:
    """One case with its trace, under the label that it has in the tables."""

    label: str
    trajectory: str
    case: Mapping[str, Any]
    trace: Mapping[str, Array]

    @property
    def finished(self) -> bool:
        """Whether it drove the whole path."""
        return bool(self.case.get("end") == "finished")


@dataclass(frozen=True)
class LineStyle:
    """Colour, dashes and width (pt) of an agent, the same in every figure."""

    colour: str
    dashes: str
    width: float

    def as_line(self) -> dict[str, Any]:
        """Keyword arguments of `Axes.plot`."""
        return {"color": self.colour, "linestyle": self.dashes, "linewidth": self.width}


@dataclass(frozen=True)
class Panel:
    """A part of a figure: its title and its SVG."""

    title: str
    svg: str


Styles = Mapping[str, LineStyle]
Draw = Callable[[Figure], None]


def line_styles(labels: Iterable[str]) -> dict[str, LineStyle]:
    """A style for each label: colours first, then the same colours dashed.

    Earlier lines are broader, so that they show beneath a later one that covers them.
    """
    n, once = len(COLOURS), list(dict.fromkeys(labels))
    return {
        label: LineStyle(
            COLOURS[k % n], DASHES[k // n % len(DASHES)], 2.2 - 1.1 * k / max(len(once) - 1, 1)
        )
        for k, label in enumerate(once)
    }


def usable(trace: Mapping[str, Array] | None) -> bool:
    """Whether a trace holds what the figures need, finite and of one length."""
    if not trace or any(name not in trace for name in TRACE):
        return False
    n = len(trace["time"])
    return n > 1 and all(
        len(trace[name]) == n and bool(np.isfinite(trace[name]).all()) for name in TRACE
    )


def decimate(values: Array, limit: int = POINTS) -> NDArray[np.intp]:
    """Indices of at most `limit` of (n,) values: the ends, and each bucket's least and greatest."""
    n = len(values)
    if n <= limit:
        return np.arange(n)
    edges = np.linspace(1, n - 1, (limit - 2) // 2 + 1).astype(int)
    kept = [0, n - 1]
    for start, stop in pairwise(edges):
        part = values[start:stop]
        kept += [start + int(part.argmin()), start + int(part.argmax())]
    return np.unique(kept)


def render(draw: Draw, height: float, salt: str) -> str:
    """SVG of what `draw` puts on a panel of some height in inches; `salt` keeps ids apart."""
    with mpl.rc_context(cast("Any", {**STYLE, "svg.hashsalt": salt})):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure)
        buffer = io.StringIO()
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(buffer, format="svg", metadata=nothing)
    return slim(buffer.getvalue())


def slim(svg: str) -> str:
    """Matplotlib's SVG for inlining: no prologue, size, unused ids and more decimals than seen."""
    svg = svg[svg.index("<svg") :]
    head, rest = svg.split(">", 1)
    head = re.sub(r' (?:width|height)="[^"]*"', "", head)
    # Its style sheet would hold for the whole page, its font is said once for all texts.
    rest = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", rest, count=1, flags=re.DOTALL)
    rest = rest.replace("font-size: 9px; font-family: 'DejaVu Sans', sans-serif; ", "")
    rest = re.sub(r' transform="rotate\(-0 [^)]*\)"', "", rest)
    svg = (
        f'{head} font-family="DejaVu Sans, sans-serif" font-size="9" stroke-linejoin="round">{rest}'
    )
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', svg))
    svg = re.sub(r'(<\w+) id="([^"]*)"', lambda m: m[0] if m[2] in used else m[1], svg)
    svg = re.sub(r' d="([^"]*)"', lambda m: f' d="{_shorten(m[1])}"', svg)
    svg = re.sub(r'( [xy])="(-?\d+\.\d+)"', lambda m: f'{m[1]}="{float(m[2]):.2f}"', svg)
    return re.sub(r"\n\s*", "\n", svg).strip()


def _shorten(commands: str) -> str:
    rounded = re.sub(
        r"-?\d+\.\d+", lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), commands
    )
    return re.sub(r" ?\n", "", re.sub(r"([MLCQz]) ", r"\1", rounded)).strip()


@cache
def reference_path(trajectory: str) -> ReferencePath | None:
    """Geometry of a case's trajectory by its name or file, or None where that is not to be had."""
    try:
        return trajectories.load(trajectory)
    except (ValueError, OSError):
        return None


def _by_trajectory(drives: Iterable[Drive]) -> dict[str, list[Drive]]:
    groups: dict[str, list[Drive]] = {}
    for drive in drives:
        groups.setdefault(drive.trajectory, []).append(drive)
    return groups


def _panels(
    drives: Sequence[Drive],
    salt: str,
    height: float,
    draw: Callable[[Figure, Sequence[Drive]], None],
) -> list[Panel]:
    return [
        Panel(name, render(lambda figure: draw(figure, group), height, f"{salt}/{name}"))  # noqa: B023
        for name, group in _by_trajectory(drives).items()
    ]


def _line(axes: Axes, x: Array, y: Array, style: LineStyle) -> None:
    kept = decimate(y)
    axes.plot(x[kept], y[kept], **style.as_line())


def _over_time(axes: Axes, drives: Sequence[Drive], styles: Styles, name: str) -> None:
    """One quantity of a trace over time for each drive; × where one ended before the path did."""
    for drive in drives:
        time, values = drive.trace["time"], drive.trace[name]
        _line(axes, time, values, styles[drive.label])
        if not drive.finished:
            axes.plot(time[-1], values[-1], "x", color=styles[drive.label].colour, markersize=7)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("time (s)")


def paths(drives: Sequence[Drive], styles: Styles, salt: str) -> list[Panel]:
    """Reference and driven paths from above."""

    def draw(figure: Figure, group: Sequence[Drive]) -> None:
        axes = figure.add_subplot()
        _draw_reference(axes, group)
        for drive in group:
            state, style = drive.trace["state"], styles[drive.label]
            kept = _spread(len(state))
            axes.plot(state[kept, X], state[kept, Y], **style.as_line())
            if not drive.finished:
                axes.plot(state[-1, X], state[-1, Y], "x", color=style.colour, markersize=7)

    return _panels(drives, f"{salt}/paths", 3.4, draw)


def _spread(n: int) -> NDArray[np.intp]:
    """At most POINTS indices evenly over n, ends included."""
    return np.unique(np.linspace(0, n - 1, min(n, POINTS)).astype(int))


def _draw_reference(axes: Axes, group: Sequence[Drive]) -> None:
    """The path as a broad grey line with its start; where it is not to be had, its driven part."""
    path = reference_path(group[0].trajectory)
    if path is not None:
        x, y = path.x, path.y
    else:
        # The foot point lies a lateral error to the right of the vehicle, seen along the path.
        trace = max((drive.trace for drive in group), key=lambda trace: trace["arc_length"][-1])
        heading = trace["state"][:, 2] - trace["heading_error"]
        x = trace["state"][:, X] + trace["lateral_error"] * np.sin(heading)
        y = trace["state"][:, Y] - trace["lateral_error"] * np.cos(heading)
    kept = _spread(len(x))
    axes.plot(x[kept], y[kept], **BROAD, solid_capstyle="round")
    axes.plot(x[0], y[0], "o", color=REFERENCE, markersize=4.5)
    axes.set_xlabel("X (m)")
    axes.set_ylabel("Y (m)")
    if min(np.ptp(x), np.ptp(y)) > ELONGATED * max(np.ptp(x), np.ptp(y)):
        axes.set_aspect("equal", adjustable="datalim")
    else:
        axes.set_ylabel("Y (m), not to scale")


def lateral_error(drives: Sequence[Drive], styles: Styles, salt: str) -> list[Panel]:
    """Lateral error over time."""

    def draw(figure: Figure, group: Sequence[Drive]) -> None:
        axes = figure.add_subplot()
        _over_time(axes, group, styles, "lateral_error")
        axes.set_ylabel("lateral error (m)")

    return _panels(drives, f"{salt}/lateral", 2.3, draw)


def heading_error(drives: Sequence[Drive], styles: Styles, salt: str) -> list[Panel]:
    """Heading error over time."""

    def draw(figure: Figure, group: Sequence[Drive]) -> None:
        axes = figure.add_subplot()
        _over_time(axes, group, styles, "heading_error")
        axes.set_ylabel("heading error (rad)")

    return _panels(drives, f"{salt}/heading", 2.3, draw)


def speed(drives: Sequence[Drive], styles: Styles, salt: str) -> list[Panel]:
    """Speed over arc length, with the speed that the path asks for there."""

    def draw(figure: Figure, group: Sequence[Drive]) -> None:
        axes = figure.add_subplot()
        longest = max((drive.trace for drive in group), key=lambda trace: trace["arc_length"][-1])
        kept = decimate(longest["reference_speed"])
        axes.plot(
            longest["arc_length"][kept], longest["reference_speed"][kept],
            **BROAD,
        )  # fmt: skip
        for drive in group:
            arc_length, vx = drive.trace["arc_length"], drive.trace["state"][:, VX]
            _line(axes, arc_length, vx, styles[drive.label])
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("arc length (m)")
        axes.set_ylabel("speed (m/s)")

    return _panels(drives, f"{salt}/speed", 2.3, draw)


def inputs(drives: Sequence[Drive], styles: Styles, salt: str) -> list[Panel]:
    """Steering angle and acceleration in force, over time."""

    def draw(figure: Figure, group: Sequence[Drive]) -> None:
        steering = figure.add_subplot(2, 1, 1)
        acceleration = figure.add_subplot(2, 1, 2, sharex=steering)
        _over_time(steering, group, styles, "steering_angle")
        _over_time(acceleration, group, styles, "acceleration")
        steering.set_xlabel("")
        steering.tick_params(labelbottom=False)
        steering.set_ylabel("steering (rad)")
        acceleration.set_ylabel("accel. (m/s²)")

    return _panels(drives, f"{salt}/inputs", 3.4, draw)


def solve_times(drives: Sequence[Drive], styles: Styles, salt: str) -> list[Panel]:
    """Time of `predict` by agent over all its control periods, against the control period.

    A thin line from the least to the greatest, a bar from the 5th to the 95th percentile, a tick at
    the median and a circle at the 99th percentile.
    """
    shown = {drive.label for drive in drives}
    labels = [label for label in styles if label in shown]
    calls = [
        np.concatenate([drive.trace["solve_time"][1:] for drive in drives if drive.label == label])
        for label in labels
    ]
    periods = sorted({float(drive.case.get("control_period", 0.05)) for drive in drives})

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for place, (label, seconds) in enumerate(zip(labels, calls, strict=True)):
            least, low, median, high, rare, most = 1e3 * np.percentile(
                np.maximum(seconds, 1e-7), (0, 5, 50, 95, 99, 100)
            )
            colour = styles[label].colour
            axes.plot([least, most], [place, place], color=colour, linewidth=1.0)
            axes.plot(
                [low, high], [place, place], color=colour, linewidth=8, alpha=0.55,
                solid_capstyle="butt",
            )  # fmt: skip
            axes.plot(median, place, "|", color="black", markersize=11, markeredgewidth=1.6)
            axes.plot(rare, place, "o", color=colour, markeredgecolor="black", markersize=5)
        for period in periods:
            axes.axvline(1e3 * period, color=LIMIT, linestyle="--", linewidth=1.0)
            axes.text(
                1e3 * period, -0.75, f"control period {1e3 * period:g} ms ", color=LIMIT,
                fontsize=8, ha="right", va="center",
            )  # fmt: skip
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_yticks(range(len(labels)), [_brief(label) for label in labels])
        axes.set_ylim(len(labels) - 0.4, -1.1)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("time of predict (ms)")

    height = 0.9 + 0.3 * (len(labels) + 1)
    return [Panel("all trajectories", render(draw, height, f"{salt}/time"))]


def _brief(label: str, limit: int = 26) -> str:
    return label if len(label) <= limit else f"{label[: limit - 1]}…"


def plant(case: Mapping[str, Any]) -> VehicleParameters | None:
    """The vehicle of a case with its changes, or None where it no longer loads."""
    changes = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in (case.get("vehicle_changes") or {}).items()
    }
    try:
        return vehicle.load(str(case.get("vehicle"))).replace(**changes)
    except (ValueError, TypeError):
        return None


def sideslip(trace: Mapping[str, Array]) -> Array:
    """|vy| / vx along a trace, (n,)."""
    state = trace["state"]
    return np.abs(state[:, VY]) / np.maximum(state[:, VX], 1e-3)


def steady_sideslip(curvature: Array, speed: Array, car: VehicleParameters) -> Array:
    """|vy| / vx of a steady turn, any shape: |kappa (lr - m lf v^2 / (L Car))|.

    From the rear axle, whose lateral force in a steady turn is m v^2 kappa lf / L.
    """
    give = car.mass * car.front_axle_distance / (car.wheelbase * car.rear_cornering_stiffness)
    return np.abs(curvature * (car.rear_axle_distance - give * speed**2))


def required_sideslip(drive: Drive) -> tuple[Array, Array] | None:
    """Arc length and |vy| / vx of driving exactly on the path at its speed, steady; or None."""
    path, car = reference_path(drive.trajectory), plant(drive.case)
    if path is None or car is None:
        return None
    reach = drive.trace["arc_length"]
    order = np.argsort(reach, kind="stable")
    asked = np.interp(path.arc_length, reach[order], drive.trace["reference_speed"][order])
    return path.arc_length, steady_sideslip(path.curvature, asked, car)


def reaches_sideslip_limit(case: Mapping[str, Any]) -> bool:
    """Whether |vy| <= ratio vx was broken, or a plan needed slack on it."""
    slack = case.get("solver", {}).get("slack") or (0.0, 0.0, 0.0)
    excess = case.get("metrics", {}).get("excess_lateral_velocity", 0.0)
    return bool(excess > EXCESS or slack[1] > EXCESS)


def sideslip_limit(drives: Sequence[Drive], styles: Styles, salt: str) -> list[Panel]:
    """|vy| / vx over arc length against its limit, and where on the path the limit was reached."""

    def draw(figure: Figure, group: Sequence[Drive]) -> None:
        car = plant(group[0].case)
        limit = 0.17 if car is None else car.max_lateral_velocity_ratio
        share, plan = figure.subplots(2, 1, height_ratios=(1.0, 1.5))
        needed = required_sideslip(group[0])
        if needed is not None:
            kept = decimate(needed[1])
            share.plot(needed[0][kept], needed[1][kept], **BROAD)
            share.fill_between(
                needed[0], 0.0, 1.0, where=needed[1] > limit, color=LIMIT, alpha=0.10,
                linewidth=0.0, transform=share.get_xaxis_transform(),
            )  # fmt: skip
        _draw_reference(plan, group)
        for drive in group:
            slip, state = sideslip(drive.trace), drive.trace["state"]
            style = styles[drive.label]
            _line(share, drive.trace["arc_length"], slip, style)
            at_limit = slip >= AT_LIMIT * limit
            marked = np.where(at_limit[:, None], state[:, [X, Y]], np.nan)
            plan.plot(*marked[_spread(len(marked))].T, color=LIMIT, alpha=0.4, linewidth=8.0)
            kept = _spread(len(state))
            plan.plot(state[kept, X], state[kept, Y], **style.as_line())
        share.axhline(limit, color=LIMIT, linestyle="--", linewidth=1.0)
        share.set_ylim(bottom=0.0)
        share.set_xlim(left=0.0)
        share.set_xlabel("arc length (m)")
        share.set_ylabel("|vy| / vx (–)")

    return _panels(drives, f"{salt}/sideslip", 5.0, draw)
