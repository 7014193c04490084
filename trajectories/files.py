"""Path files: the native CSV format, and one `read` for every format that can be read.

The native format "refpath/1" has leading `# key: JSON` lines (format, name, closed, points, frame,
the path's metadata, and its statistics as `achieved`), one header line, then a row for each node;
paths of known widths have two columns more.
Numbers are written so that reading them gives the same bits.
"""

import json
import re
import warnings
from collections.abc import Set
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from trajectories.arguments import shortened, shown
from trajectories.columns import read_points
from trajectories.curvature import circle_curvature, signed_waypoint_curvature, statistics
from trajectories.fileio import checked, parse_json, read_bytes, write_atomically
from trajectories.formats import HEAD, reader_of, refuse_folder
from trajectories.import_options import USUAL, ImportOptions
from trajectories.importers import path_of, read_gps, read_racetrack, read_xy
from trajectories.path import ReferencePath
from trajectories.speed import replanned
from trajectories.speed_limits import SpeedLimits
from trajectories.text_table import MOST_BYTES, TextTable, read_lines

__all__ = ["read", "read_gps", "read_native", "read_racetrack", "read_xy", "write"]

Array = NDArray[np.float64]

FORMAT = "refpath/1"
HEADER = ("s_m", "x_m", "y_m", "psi_rad", "kappa_1pm", "v_mps", "ax_mps2", "t_s")
WIDTHS = ("w_right_m", "w_left_m")
"""Columns that a path of known widths has besides."""
FRAME = "local: x, y in m, heading counter-clockwise from x"
RESERVED = ("format", "name", "closed", "points")
"""Keys of the header that metadata cannot replace."""
LONGEST_NAME = 200
"""Most characters of a path's name in a file."""
OPTIONS = frozenset(item.name for item in fields(ImportOptions))
NATIVE_OPTIONS = frozenset(
    ("vehicle", "name", "speeds", "limits", "max_speed", "max_lateral_acceleration",
     "max_acceleration")
)  # fmt: skip
"""Options that mean something for a native file; those of speed plan it anew."""
_COMMENT = re.compile(r"#\s*(?P<key>[A-Za-z_][\w-]*)\s*:\s*(?P<value>.*)")


class Origin(msgspec.Struct):
    """Place of x = y = 0 on the Earth."""

    latitude_deg: float
    longitude_deg: float
    height_m: float


class Header(msgspec.Struct):
    """Keys of the header that are used; others may hold any JSON."""

    name: str = ""
    closed: bool = False
    points: int = -1
    source: str = ""
    warnings: list[str] = []
    limits: SpeedLimits | None = None
    origin: Origin | None = None


def write(path: ReferencePath, file: str | Path) -> None:
    """Write a path as native CSV, replacing `file` as a whole or not at all.

    Raises
    ------
    ValueError
        If a value of the metadata cannot be written as JSON; its key is named.
    OSError
        If the file cannot be written.
    """
    header = {
        "format": FORMAT, "name": path.name, "closed": path.closed,
        "points": len(path.arc_length), "frame": FRAME,
        **{key: value for key, value in path.metadata.items() if key not in RESERVED},
        "achieved": asdict(statistics(path)),
    }  # fmt: skip
    lines = [_comment(key, value) for key, value in header.items()]
    lines.append(",".join(HEADER if path.widths is None else HEADER + WIDTHS))
    columns = (
        path.arc_length, path.x, path.y, path.heading, path.curvature, path.speed,
        path.acceleration, path.time, *(() if path.widths is None else path.widths.T),
    )  # fmt: skip
    lines.extend(",".join(map(repr, row)) for row in np.column_stack(columns).tolist())
    try:
        write_atomically(Path(file), ("\n".join(lines) + "\n").encode())
    except OSError as error:
        raise OSError(error.errno, f"cannot write the path: {error.strerror}", str(file)) from error


def _comment(key: str, value: object) -> str:
    try:
        line = f"# {key}: {json.dumps(value, allow_nan=False, default=_plain)}"
    except (TypeError, ValueError) as error:
        raise ValueError(f"metadata[{shown(key)}] cannot be written as JSON: {error}") from error
    if _COMMENT.fullmatch(line) is None:
        raise ValueError(f"metadata key {shown(key)} must be a word")
    return line


def _plain(value: object) -> object:
    """Convert a NumPy value to one that JSON can hold."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not a JSON value")


def read(file: str | Path, options: ImportOptions = USUAL) -> ReferencePath:
    """Read a path of any format: native, one of `trajectories.formats`, or a table of points.

    The first bytes and the suffix, the first lines or the header decide which. A table has x,y or
    latitudes and longitudes, and may have speeds, widths and other columns.

    Raises
    ------
    ValueError
        If the file cannot be read; the message names the file and the line or column. Also for an
        option that means nothing for its format.
    """
    refuse_folder(Path(file))
    start = read_bytes(file, MOST_BYTES)[:HEAD]
    if any(_is_format(line) for line in start.split(b"\n")[:50]):
        _refuse(file, "a native path file", options, NATIVE_OPTIONS)
        anew = {"limits", "max_speed", "max_lateral_acceleration", "max_acceleration"}
        planned = options.speeds == "planned" or anew.intersection(options.given())
        limits = options.planning() if planned else None
        return read_native(file, limits=limits, name=options.name)
    if (reader := reader_of(Path(file), start)) is None:
        raw = read_points(file, options)
        _refuse(file, f"a table ({raw.kind})", options, OPTIONS - {"part"})
    else:
        raw = reader(Path(file), options.part)
        _refuse(file, f"a {raw.kind}", options, OPTIONS - {"columns", "speed_unit"})
    return path_of(raw, options)


def _is_format(line: bytes) -> bool:
    match = _COMMENT.match(line.decode("utf-8", "replace").strip().lstrip("\ufeff"))
    return match is not None and match["key"] == "format"


def _refuse(file: str | Path, kind: str, options: ImportOptions, known: Set[str]) -> None:
    """Refuse options that mean nothing for a kind of file."""
    if others := [name for name in options.given() if name not in known]:
        raise ValueError(f"{shortened(file)}: {others[0]} means nothing for {kind}")


def read_native(
    file: str | Path, *, limits: SpeedLimits | None = None, name: str | None = None
) -> ReferencePath:
    """Read a native CSV, with the same bits that `write` was given.

    Parameters
    ----------
    file
        CSV file in format "refpath/1".
    limits
        Limits to plan the speed anew; None keeps the stored profile.
    name
        Name in place of the stored one.

    Raises
    ------
    ValueError
        For a torn file, an unknown format version, a cell that is not a number, arc length that
        does not increase, or heading or curvature that disagree with the positions.
    """
    metadata, table = _split(Path(file))
    columns = {name: table.column(k) for k, name in enumerate(table.header)}
    widths = None
    if WIDTHS[0] in columns:
        widths = np.column_stack([columns[name] for name in WIDTHS])
    label, closed = metadata.pop("name", Path(file).stem), metadata.pop("closed", False)
    s, x, y, psi, kappa, v = (columns[key] for key in HEADER[:6])
    try:
        path = ReferencePath(s, x, y, psi, kappa, v, label if name is None else name, closed,
                             metadata, widths)  # fmt: skip
    except ValueError as error:
        table.fail(str(error))
    _check_geometry(path, table)
    _check_motion(path, columns, table)
    if limits is not None:
        try:
            path = replanned(path, limits)
        except (RuntimeError, ValueError) as error:
            table.fail(str(error))
    return path


def _split(file: Path) -> tuple[dict[str, Any], TextTable]:
    """Split a native file into metadata and table, after a check that it is complete."""
    table = TextTable(file, HEADER, [], [])
    lines = read_lines(file)
    metadata = _metadata(lines, table)
    first = len(metadata)
    version = metadata.pop("format", None)
    if version != FORMAT:
        table.fail(f"format {shown(version)} is not known, only {FORMAT!r}")
    header = checked(metadata, Header, file)
    if len(header.name) > LONGEST_NAME or not header.name.isprintable():
        table.fail(f"name {shown(header.name)} is no line of at most {LONGEST_NAME} characters")
    header_line = lines[first].strip() if first < len(lines) else ""
    if header_line not in {",".join(HEADER), ",".join(HEADER + WIDTHS)}:
        table.fail(f"line {first + 1} is not the header {','.join(HEADER)}")
    table = replace(table, header=tuple(header_line.split(",")))
    if lines[-1].strip():
        table.fail(f"torn: line {len(lines)} has no end")
    for number, line in enumerate(lines[first + 1 : -1], start=first + 2):
        cells = line.strip().split(",")
        if len(cells) != len(table.header):
            table.fail(f"line {number} has {len(cells)} columns, not {len(table.header)}")
        table.rows.append(cells)
        table.lines.append(number)
    if metadata.pop("points", len(table.rows)) != len(table.rows):
        table.fail(f"torn: {len(table.rows)} of {header.points} points are there")
    return metadata, table


def _metadata(lines: list[str], table: TextTable) -> dict[str, Any]:
    """Read the values of the leading `# key: JSON` lines; no key may occur twice."""
    metadata: dict[str, Any] = {}
    for number, line in enumerate(lines, start=1):
        if not line.startswith("#"):
            break
        match = _COMMENT.fullmatch(line.strip())
        if match is None or match["key"] in metadata:
            table.fail(f"line {number} is not '# key: JSON' with a new key")
        where = f"{table.file}: line {number}: {shortened(match['key'], 40)}"
        metadata[match["key"]] = parse_json(match["value"], where)
    return metadata


def _check_geometry(path: ReferencePath, table: TextTable) -> None:
    """Reject arc length, heading or curvature that the positions contradict.

    Heading is compared with central differences. Curvature is compared with the circle through
    three points and with the waypoint formula of raw paths, and must agree with one of them. The
    bounds allow for coordinates rounded to 1 mm, and for the error of the differences on a grid of
    0.25 m.
    """
    h = path.spacing
    steps = np.hypot(np.diff(path.x), np.diff(path.y))
    _reject(np.abs(steps - h) > 0.02 * h + 2e-3, 1, "s_m disagrees with x, y", table)
    direction = np.arctan2(np.gradient(path.y), np.gradient(path.x))
    apart = np.angle(np.exp(1j * (path.heading - direction)))
    allowed = np.full_like(apart, 0.02)
    allowed[[0, -1]] += h * np.abs(path.curvature[[0, -1]])
    _reject(np.abs(apart) > allowed, 0, "psi_rad disagrees with the direction of x, y", table)
    circle, waypoint = circle_curvature(path.x, path.y), signed_waypoint_curvature(path.x, path.y)
    apart = np.minimum(np.abs(path.curvature - circle), np.abs(path.curvature - waypoint))
    around = np.lib.stride_tricks.sliding_window_view(np.pad(np.abs(circle), 2, mode="edge"), 5)
    wrong = apart > 0.01 + 0.1 * around.max(axis=1)
    wrong[[0, 1, -2, -1]] = False  # one-sided differences
    _reject(wrong, 0, "kappa_1pm disagrees with the curvature of x, y", table)


def _reject(wrong: NDArray[np.bool_], offset: int, message: str, table: TextTable) -> None:
    if wrong.any():
        index = int(np.flatnonzero(wrong)[0]) + offset
        table.fail(f"{message} at index {index} (line {table.lines[index]})")


def _check_motion(path: ReferencePath, columns: dict[str, Array], table: TextTable) -> None:
    """Warn if the columns of acceleration or time do not follow from the speeds, which are used."""
    for key, values, tolerance in (
        ("ax_mps2", path.acceleration, 1e-3),
        ("t_s", path.time, 1e-3 + 1e-4 * path.duration),
    ):
        if np.abs(columns[key] - values).max() > tolerance:
            warnings.warn(
                f"{table.file}: {key} does not follow from v_mps, which is used", stacklevel=4
            )
