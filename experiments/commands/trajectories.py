"""`lpv-track trajectories`: published against achieved rows of paths, drawn and written."""

import argparse
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from experiments.commands import options as shared
from experiments.commands.options import file_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize

    from trajectories import ReferencePath, SpeedLimits

EXAMPLE = "lpv-track trajectories random-3 --plan grip=0.7 max_speed=30 --write paths"

ROWS = (
    ("max_speed", "max speed", "m/s", ".2f"),
    ("max_acceleration", "max acceleration", "m/s²", ".2f"),
    ("max_lateral_acceleration", "max lateral acceleration", "m/s²", ".2f"),
    ("length", "length", "m", ".1f"),
    ("max_curvature", "max curvature", "1/m", ".3f"),
    ("total_curvature", "total curvature", "1/m", ".2f"),
)
"""Rows of the paper's table: field of `PathStatistics`, heading, unit, format."""
WHY_CURVATURE_DIFFERS = (
    "Max curvature differs on purpose: the published 1.8 to 4.0 1/m is 15 to 35 times what the "
    "vehicle steers (0.115 1/m at a 5 m wheelbase). It is what the paper's curvature formula gives "
    "at a kink between dense waypoints, sin(D/2) / (d cos²(D/2)); the Tn-raw paths have such kinks "
    "and match both curvature rows, at the price of a lateral acceleration no vehicle has there."
)
COLOURS = "viridis"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="default: the six and their raw forms"
    )
    parser.add_argument(
        "--section", nargs=2, type=shared.number(0.0, unit="m"), metavar=("START", "END"),
        help="only the part between these arc lengths, m, as an open path",
    )  # fmt: skip
    files = parser.add_argument_group("files", "options of trajectories.load(...), for files")
    files.add_argument(
        "--vehicle", metavar="NAME", help="preset or .json whose limits the speed keeps"
    )
    for option, meaning in (
        ("--max-speed", "m/s"),
        ("--max-lateral-acceleration", "m/s^2"),
        ("--max-acceleration", "m/s^2"),
        ("--smoothing", "m rms between path and points (default 0.05, 0.2 for GPS)"),
        ("--minimum-distance", "m between points; leaves out jitter and standstill"),
        ("--scale", "factor on all coordinates"),
    ):
        files.add_argument(option, type=shared.number(0.0), metavar="X", help=meaning)
    ends = files.add_mutually_exclusive_group()
    ends.add_argument("--closed", action="store_true", default=None, help="the end meets the start")
    ends.add_argument("--open", action="store_false", dest="closed", help="it does not")
    files.add_argument(
        "--columns", nargs="+", metavar="NAME",
        help="names of a table's columns, e.g. x y v_kmh; - leaves one out",
    )  # fmt: skip
    files.add_argument("--speeds", choices=("file", "planned"), help="default: the file's, if any")
    files.add_argument("--speed-unit", metavar="UNIT", help="m/s, km/h, mph or kn")
    files.add_argument("--part", metavar="NAME", help="track, road or lanelet (default: longest)")
    shared.add_settings(
        parser, "--plan",
        "plan the speed anew: limits of trajectories.SpeedLimits, in SI units, the path's own "
        "where none is given; grip=0.7 bounds lateral and total acceleration by 0.7 g; "
        "vehicle=bmw-320i grip=0.7 friction=0.9 plans as the speed mode grip does",
    )  # fmt: skip
    parser.add_argument("--draw", type=file_name, metavar="FILE", help="picture, .png or .svg")
    parser.add_argument("--write", type=file_name, metavar="DIR", help="write native CSV files")


def run(options: argparse.Namespace, console: Console) -> int:
    """Print the table of the paths, draw and write them as asked, and return 0."""
    import trajectories
    from experiments.run.suites import RAW, SIX
    from lpv_track_env.reference import too_sharp_bend
    from trajectories.speed import replanned

    names = options.names or [*SIX, *RAW]
    given = import_options(options, names)
    paths = [trajectories.load(name, **given) for name in names]
    for path in paths if "vehicle" in given else []:
        if bend := too_sharp_bend(path, given["vehicle"]):
            warnings.warn(bend, UserWarning, stacklevel=2)
    if options.section is not None:
        paths = [path.section(*options.section) for path in paths]
    if options.plan:
        given = shared.parse_settings(options.plan)
        paths = [replanned(path, limits_of(path, given)) for path in paths]
    console.print(rows_table(paths))
    if options.draw is not None:
        draw(paths if options.names else paths[: len(SIX)], options.draw)
        console.print(f"drawn: {options.draw}", markup=False, soft_wrap=True)
    if options.write is not None:
        from trajectories.files import write

        options.write.mkdir(parents=True, exist_ok=True)
        for name, path in _file_names(paths).items():
            write(path, options.write / name)
        console.print(
            f"{len(paths)} paths written to {options.write}", markup=False, soft_wrap=True
        )
    return 0


def import_options(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Return the options of `trajectories.load` that were given.

    Raises
    ------
    ValueError
        If a vehicle is unknown, or is given for a path that ships.
    """
    from dataclasses import fields

    from lpv_track_env.vehicle import load
    from trajectories.arguments import shown
    from trajectories.catalog import is_file
    from trajectories.import_options import ImportOptions

    known = [item.name for item in fields(ImportOptions)]
    given = {key: value for key in known if (value := getattr(options, key, None)) is not None}
    if "vehicle" in given:
        given["vehicle"] = load(given["vehicle"])
        if others := [name for name in names if not is_file(name)]:
            raise ValueError(f"vehicle is an option of files, and {shown(others[0])} is none")
    return given


def limits_of(path: "ReferencePath", given: Mapping[str, Any]) -> "SpeedLimits":
    """Return the limits of a plan: those given by name, and the path's own for the others.

    `grip` is a share of g that bounds the lateral acceleration and the total one, so that braking
    in a turn stays within the friction circle. With a `vehicle`, and a `friction` if that is not 1,
    the other limits are not the path's but the vehicle's (`lpv_track_env.reference.grip_limits`).

    Raises
    ------
    ValueError
        For an unknown limit, a value that `SpeedLimits` refuses, or one that is missing because the
        path has no limits.
    """
    from dataclasses import MISSING, asdict, fields

    from lpv_track_env.reference import GRIP, ORDINARY_FRICTION, grip_limits
    from lpv_track_env.tyres import FRICTION
    from lpv_track_env.vehicle import load
    from trajectories import SpeedLimits
    from trajectories.arguments import Number, shown
    from trajectories.naming import choose
    from trajectories.speed import GRAVITY

    known = fields(SpeedLimits)
    by_grip = ("max_lateral_acceleration", "max_total_acceleration")
    for key in given:
        choose("limit in --plan", key, ("grip", "vehicle", "friction", *(f.name for f in known)))
    own, given = path.metadata.get("limits", {}), dict(given)
    friction = FRICTION.of("friction", given.pop("friction", ORDINARY_FRICTION))
    if "vehicle" in given:
        grip = GRIP.of("grip", given.pop("grip", None))
        own = asdict(grip_limits(path, load(given.pop("vehicle")), friction, grip))
    values = {**own, **given}
    if "grip" in values:
        if both := [name for name in by_grip if name in given]:
            raise ValueError(f"--plan: give grip or {both[0]}, not both")
        limit = friction * GRAVITY * Number(1e-3, 100.0).of("grip", values.pop("grip"))
        values |= dict.fromkeys(by_grip, limit)
    needed = [field.name for field in known if field.default is MISSING]
    if missing := [name for name in needed if name not in values]:
        raise ValueError(
            f"path {shown(path.name)} has no limits of its own: --plan needs {', '.join(missing)}"
        )
    return SpeedLimits(**values)


def _file_names(paths: Sequence["ReferencePath"]) -> dict[str, "ReferencePath"]:
    """Return the name of each path's file and its path; a path's name may be from a file.

    Raises
    ------
    ValueError
        If two paths would have one file.
    """
    from trajectories.arguments import shown
    from trajectories.fileio import file_name

    named: dict[str, ReferencePath] = {}
    for path in paths:
        name = f"{file_name(path.name)}.csv"
        if name.lower() in {other.lower() for other in named}:
            raise ValueError(f"two paths would be written to {name}, one is {shown(path.name)}")
        named[name] = path
    return named


def rows_table(paths: Sequence["ReferencePath"]) -> Table:
    """Return a table of each path's rows, with the published ones above where there are any."""
    from trajectories import PUBLISHED, statistics

    known = any(path.name.removesuffix("-raw") in PUBLISHED for path in paths)
    why = WHY_CURVATURE_DIFFERS if known else None
    table = Table(title="Trajectories", caption=why, caption_justify="left")
    table.add_column("path", no_wrap=True)
    table.add_column("", no_wrap=True)
    for _, words, unit, _ in ROWS:
        table.add_column(f"{words} {unit}", justify="right")
    table.add_column("duration s", justify="right")
    for path in paths:
        achieved = statistics(path)
        cells = [f"{getattr(achieved, field):{form}}" for field, _, _, form in ROWS]
        own = PUBLISHED.get(path.name.removesuffix("-raw"))
        if own is not None:
            rows = [f"{getattr(own.rows, field):{form}}" for field, _, _, form in ROWS]
            table.add_row(path.name, "published", *rows, "")
        first = "" if own is not None else path.name
        table.add_row(first, "achieved", *cells, f"{path.duration:.1f}", end_section=True)
    return table


def draw(paths: Sequence["ReferencePath"], file: str | Path) -> None:
    """Draw paths coloured by speed, and curvature and speed over arc length.

    The file's suffix chooses the format (.png, .svg, .pdf).
    """
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from experiments.figures import save_figure

    colours = Normalize(0.0, max(float(path.speed.max()) for path in paths))
    figure = Figure(figsize=(12.0, 2.6 * len(paths)), layout="constrained")
    grid = figure.add_gridspec(2 * len(paths), 2, width_ratios=(1.0, 1.5))
    plans = []
    for k, path in enumerate(paths):
        plan = figure.add_subplot(grid[2 * k : 2 * k + 2, 0])
        _draw_plan(plan, path, colours)
        plans.append(plan)
        curvature = figure.add_subplot(grid[2 * k, 1])
        speed = figure.add_subplot(grid[2 * k + 1, 1], sharex=curvature)
        curvature.plot(path.arc_length, path.curvature, color="tab:red", linewidth=1.0)
        curvature.set_ylabel("κ (1/m)")
        curvature.tick_params(labelbottom=False)
        speed.plot(path.arc_length, path.speed, color="tab:blue", linewidth=1.0)
        speed.set_ylabel("v (m/s)")
        speed.set_ylim(bottom=0.0)
        for axes in (curvature, speed):
            axes.set_xlim(0.0, path.length)
            axes.grid(alpha=0.3)
    speed.set_xlabel("arc length s (m)")
    figure.colorbar(
        plans[0].collections[0], ax=plans, location="left", shrink=0.5, label="speed (m/s)"
    )
    save_figure(figure, Path(file))


def _draw_plan(axes: "Axes", path: "ReferencePath", colours: "Normalize") -> None:
    """Draw one path from above and mark its start."""
    import numpy as np
    from matplotlib.collections import LineCollection

    stride = 4  # 1 m; shorter pieces blur into each other where their ends are antialiased
    points, speed = np.column_stack([path.x, path.y])[::stride], path.speed[::stride]
    lines = LineCollection(
        [*np.stack([points[:-1], points[1:]], axis=1)],
        cmap=COLOURS, norm=colours, linewidth=2.5, capstyle="projecting",
    )  # fmt: skip
    lines.set_array(0.5 * (speed[:-1] + speed[1:]))
    axes.add_collection(lines)
    axes.plot(path.x[0], path.y[0], "o", color="black", markersize=6)
    axes.annotate(
        "start", (path.x[0], path.y[0]), xytext=(5, 5), textcoords="offset points", fontsize=8
    )
    axes.set_title(f"{path.name}: {path.length:.0f} m, {path.duration:.0f} s", fontsize=10)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.grid(alpha=0.3)
