"""Make paths of foreign points: racing circuits and lines, waypoints, GPS logs, arrays.

Every import takes the same steps: checks, a smoothing spline whose deviation is reported,
resampling at 0.25 m of arc length (less on tracks with tight bends), heading and curvature from the
spline's derivatives, and a speed: that of the file as far as the limits allow, or a planned
jerk-limited profile.
"""

import logging
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories.arguments import array
from trajectories.cleaning import Findings, cleaned, geographic, points_of
from trajectories.columns import read_points
from trajectories.import_options import IMPORT_LIMITS, NO_LIMITS, USUAL, ImportOptions
from trajectories.naming import choose
from trajectories.oddities import oddities
from trajectories.path import MINIMUM_SPEED, ReferencePath
from trajectories.raw_path import RawPath
from trajectories.shapes import Smoothed, smooth
from trajectories.speed import keep_speed, plan_speed
from trajectories.speed_limits import SpeedLimits

Array = NDArray[np.float64]

LOG = logging.getLogger(__name__)
SMOOTHING = 0.05
GPS_SMOOTHING = 0.2
"""Usual smoothing of metres and of latitudes and longitudes, m rms, and 3 times as much at any
point. The first removes the jitter of points 5 m apart (on one track the largest curvature falls
from 0.162 to 0.114 1/m)."""
SAID = ("part", "missing", "skipped", "others")
"""Keys of readers' metadata whose texts are part of `metadata["imported"]`."""
UNUSUAL = 20.0
"""m/s^2: lateral acceleration, twice that of a good tyre, that suggests another unit of speed."""
FASTEST = 200.0
"""Highest speed in a file, m/s; higher ones suggest another unit."""
BINDING = {
    "top speed": ("max_speed",),
    "lateral acceleration": ("max_lateral_acceleration",),
    "steering rate": ("max_steering_rate", "wheelbase"),
    "acceleration or braking": ("max_acceleration", "max_deceleration"),
}
"""Limits that may lower the speeds of a file, in words, with the fields of `SpeedLimits`."""


def read_racetrack(
    file: str | Path,
    *,
    closed: bool | None = True,
    scale: float = 1.0,
    limits: SpeedLimits = IMPORT_LIMITS,
    smoothing: float = SMOOTHING,
    name: str | None = None,
) -> ReferencePath:
    """Import a centre line in the racetrack-database format, `# x_m,y_m,w_tr_right_m,w_tr_left_m`.

    `files.read` reads it too; this needs no header, and refuses other files. The options are those
    of `ImportOptions`.

    Raises
    ------
    ValueError
        If the file cannot be read or is no drivable path; the message names line and column.
    """
    options = ImportOptions(closed=closed, scale=scale, limits=limits, smoothing=smoothing,
                            name=name, speeds="planned")  # fmt: skip
    raw = read_points(file, options, ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m"))
    if not {"x", "width_right"} <= raw.columns.keys():
        raw.fail("is no racetrack-database file: x_m,y_m,w_tr_right_m,w_tr_left_m expected")
    return path_of(raw, options)


def read_xy(
    file: str | Path,
    *,
    closed: bool | None = None,
    scale: float = 1.0,
    limits: SpeedLimits = IMPORT_LIMITS,
    smoothing: float = SMOOTHING,
    name: str | None = None,
) -> ReferencePath:
    """Import waypoints x,y in metres, with a planned speed whatever else is in the file.

    `files.read` reads them too; this refuses other files. The options are those of `ImportOptions`.

    Raises
    ------
    ValueError
        If the file cannot be read, is no drivable path, or seems to be in degrees.
    """
    options = ImportOptions(closed=closed, scale=scale, limits=limits, smoothing=smoothing,
                            name=name, speeds="planned")  # fmt: skip
    raw = read_points(file, options)
    if "x" not in raw.columns:
        raw.fail("has latitudes and longitudes, not metres: read it with read_gps")
    return path_of(raw, options)


def read_gps(
    file: str | Path,
    *,
    closed: bool | None = None,
    origin: tuple[float, float, float] | None = None,
    minimum_distance: float | None = None,
    limits: SpeedLimits = IMPORT_LIMITS,
    smoothing: float = GPS_SMOOTHING,
    name: str | None = None,
) -> ReferencePath:
    """Import a GPS log, with a planned speed: columns lat, lon, optionally height and time.

    `files.read` reads it too; this refuses other files. The options are those of `ImportOptions`.
    Times, in seconds or ISO 8601, may not go back. The origin is stored in `metadata["origin"]`,
    and the number of points that were left out in `metadata["dropped"]`.

    Raises
    ------
    ValueError
        If the file cannot be read, angles are out of range, time goes back, or the points are no
        drivable path.
    """
    options = ImportOptions(closed=closed, origin=origin, minimum_distance=minimum_distance,
                            limits=limits, smoothing=smoothing, name=name,
                            speeds="planned")  # fmt: skip
    raw = read_points(file, options)
    if "latitude" not in raw.columns:
        raw.fail("is no GPS log: a header with lat and lon is needed")
    return path_of(raw, options)


def path_of_arrays(
    points: ArrayLike,
    speed: ArrayLike | None,
    widths: ArrayLike | None,
    options: Mapping[str, Any],
) -> ReferencePath:
    """Make a path of arrays, see `ReferencePath.from_waypoints`."""
    names = tuple(field.name for field in fields(ImportOptions))
    for key in options:
        choose("option of from_waypoints", key, names)
    given = ImportOptions(**options)
    columns: dict[str, Array] = {}
    n = len(array("points", points)) if np.ndim(points) else 0
    for name, value, shape, keys in (
        ("points", points, (n, 2), ("x", "y")),
        ("speed", speed, (n,), ("speed",)),
        ("widths", widths, (n, 2), ("width_right", "width_left")),
    ):
        if value is None and name != "points":
            continue
        values = array(name, value)
        if values.shape != shape:
            raise ValueError(f"{name} must be of shape {shape}, not {values.shape}")
        if not np.isfinite(values).all():
            index = int(np.argwhere(~np.isfinite(values))[0][0])
            raise ValueError(f"{name}[{index}] is {values[index]}: it must be finite")
        columns |= zip(keys, np.atleast_2d(values.T), strict=True)
    raw = RawPath("waypoints", "array", "waypoints", columns, [f"point {k}" for k in range(n)])
    return path_of(raw, given)


def imported(path: ReferencePath) -> bool:
    """Return whether a path was made of points that somebody measured or drew."""
    return "rms_deviation" in path.metadata


def path_of(raw: RawPath, options: ImportOptions = USUAL) -> ReferencePath:
    """Make a path of the points of a file or an array.

    Its metadata tell the source, the deviation of the path from the points, warnings, and in one
    line, `imported`, what was made of the points and their speeds; this line is logged, too.

    Raises
    ------
    ValueError
        If the points are no drivable path; the message names the file and the point.
    """
    findings = Findings(raw.origin, metadata=dict(raw.metadata))
    points, closed = cleaned(raw, options, findings)
    smoothing = options.smoothing
    if smoothing is None:
        # The jitter of points that are scaled down has become smaller, too.
        smoothing = min(options.scale, 1.0) * (GPS_SMOOTHING if geographic(raw) else SMOOTHING)
    try:
        smoothed = smooth(points_of(points), smoothing, closed=closed)
    except ValueError as error:  # a spline that swings out to kilometres between few points
        raw.fail(str(error))
    for oddity in oddities(smoothed.geometry, closed, float(np.median(np.diff(smoothed.places)))):
        findings.warn(oddity)
    speed = _speed(points, smoothed, closed, options, findings)
    limits = options.planning()
    if speed is None:
        findings.notes.append(
            f"speed planned for at most {limits.max_speed:.4g} m/s and "
            f"{limits.max_lateral_acceleration:.3g} m/s² laterally"
        )
    said = [
        f"{raw.kind} of {len(raw.places)} points: {'closed' if closed else 'open'}",
        f"{smoothed.geometry.arc_length[-1]:.1f} m",
        f"at most {smoothed.max_deviation:.3f} m beside them",
    ]
    pieces = [str(raw.metadata[key]) for key in SAID if key in raw.metadata]
    metadata = {
        **findings.metadata,
        "limits": asdict(limits),
        "source": f"{raw.kind}: {Path(raw.origin).name}",
        "smoothing": smoothing,
        "max_deviation": smoothed.max_deviation,
        "rms_deviation": smoothed.rms_deviation,
        "speeds": "planned" if speed is None else "file",
        "warnings": findings.warnings,
        "imported": "; ".join([", ".join(said), *pieces, *findings.notes]),
    }
    LOG.info("%s: %s", raw.origin, metadata["imported"])
    geometry, spacing = smoothed.geometry, float(smoothed.geometry.arc_length[1])
    label = raw.name if options.name is None else options.name
    widths = _widths(points, smoothed, options.scale)
    try:
        if speed is None:
            speed = plan_speed(geometry.curvature, spacing, limits, closed=closed)
        return ReferencePath(*geometry[:5], speed, label, closed, metadata, widths)
    except (RuntimeError, ValueError) as error:  # no profile, or a curve that loops
        raw.fail(str(error))


def _widths(raw: RawPath, smoothed: Smoothed, scale: float) -> Array | None:
    """Return the widths (n, 2), m, at the nodes, if there are any."""
    sides = []
    for key in ("width_right", "width_left"):
        if (side := raw.columns.get(key)) is None:
            return None
        if (side < 0.0).any():
            index = int(np.argmax(side < 0.0))
            raw.fail(f"{raw.places[index]}: {key} {side[index]:g} m is negative")
        sides.append(scale * _at_nodes(side, smoothed))
    return np.column_stack(sides)


def _speed(
    raw: RawPath, smoothed: Smoothed, closed: bool, options: ImportOptions, findings: Findings
) -> Array | None:
    """Return the speeds of the file (n,) up to the limits, m/s; None where they are planned."""
    given = raw.columns.get("speed")
    if options.speeds == "planned":
        return None
    if given is None:
        if options.speeds == "file":
            raw.fail("has no column of speeds: name one, such as v_mps, or plan the speed")
        return None
    column = findings.metadata.get("speed_column", "speed")
    if options.speeds is None and options.scale != 1.0:
        findings.notes.append(f"speeds in {column} not used, since the path is scaled")
        return None
    if (wrong := (given < 0.0) | (given > FASTEST)).any():
        index = int(np.argmax(wrong))
        raw.fail(
            f"{raw.places[index]}: speed {given[index]:g} m/s is not from 0 to {FASTEST:g}; "
            "speeds='planned' plans it anew"
        )
    if given.max() < MINIMUM_SPEED:
        findings.warn(f"its speeds, in {column}, are all 0: planned instead")
        return None
    _compare_times(raw, options, findings)
    squared = _at_nodes(given**2, smoothed)
    s, n = smoothed.geometry.arc_length, len(smoothed.geometry.arc_length)
    stops = smoothed.places[: len(given)][given < MINIMUM_SPEED]
    squared[np.rint(stops / s[1]).astype(int).clip(0, n - 1)] = 0.0
    wanted = np.maximum(np.sqrt(squared), MINIMUM_SPEED)
    curvature, spacing = smoothed.geometry.curvature, float(s[1])

    def kept_to(limits: SpeedLimits) -> Array:
        return keep_speed(wanted, curvature, spacing, limits, closed=closed)

    limits = options.keeping()
    speed = kept_to(limits)
    cut = wanted - speed
    k = int(np.argmax(cut))
    lateral = float((speed**2 * np.abs(curvature)).max())
    said = (
        f"speeds of {column}, {given.min():.3g} to {given.max():.3g} m/s, up to "
        f"{lateral:.2g} m/s² laterally"
    )
    if lateral > UNUSUAL:
        findings.warn(
            f"its speeds need up to {lateral:.0f} m/s² laterally: if they are in km/h, give "
            "speed_unit='km/h'"
        )
    if cut[k] < 1e-3:
        findings.notes.append(f"{said}, kept")
        return speed
    alone = {
        words: kept_to(replace(NO_LIMITS, **{name: getattr(limits, name) for name in names}))[k]
        for words, names in BINDING.items()
    }
    findings.notes.append(
        f"{said}, lowered on {100.0 * np.mean(cut > 1e-3):.0f} % of the length, at most by "
        f"{cut[k]:.2f} m/s at {s[k]:.0f} m ({min(alone, key=lambda one: alone[one])})"
    )
    return speed


def _compare_times(raw: RawPath, options: ImportOptions, findings: Findings) -> None:
    """Warn of speeds that, by the times of the points, are in km/h."""
    if "time" not in raw.columns:
        return
    speed, steps = raw.columns["speed"], np.diff(raw.columns["time"])
    driven = 0.5 * (speed[1:] + speed[:-1]) * steps
    distances = np.hypot(*np.diff(points_of(raw), axis=0).T) / options.scale
    if 3.2 < np.median(driven / distances) < 4.0:
        findings.warn(
            "its speeds are 3.6 times those that follow from its times: if they are in km/h, "
            "give speed_unit='km/h'"
        )


def _at_nodes(values: Array, smoothed: Smoothed) -> Array:
    """Interpolate a quantity of the points (m,) to the nodes (n,) of the path."""
    around = np.resize(values, len(smoothed.places))  # the first again at the end of a closed path
    nodes: Array = np.interp(smoothed.geometry.arc_length, smoothed.places, around)
    return nodes
