"""Make paths of foreign points: racing circuits and lines, waypoints, GPS logs, arrays.

Every import takes the same steps: checks, a smoothing spline whose deviation is reported,
resampling at 0.25 m of arc length, heading and curvature from the spline's derivatives, and a
speed: that of the file as far as the limits allow, or a planned jerk-limited profile.
"""

import logging
import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories.arguments import array
from trajectories.columns import read_points
from trajectories.geodesy import east_north_up
from trajectories.import_options import IMPORT_LIMITS, NO_LIMITS, USUAL, ImportOptions
from trajectories.naming import choose
from trajectories.oddities import oddities
from trajectories.path import MINIMUM_POINTS, MINIMUM_SPEED, SPACING, ReferencePath
from trajectories.raw_path import RawPath
from trajectories.shapes import Smoothed, from_geometry, smooth
from trajectories.speed import keep_speed
from trajectories.speed_limits import SpeedLimits

Array = NDArray[np.float64]

LOG = logging.getLogger(__name__)
SMOOTHING = 0.05
"""m rms: removes the jitter of points 5 m apart (on one track the largest curvature falls from
0.162 to 0.104 1/m)."""
GPS_SMOOTHING = 0.2
"""m rms."""
GPS_DISTANCES = (1.0, 2.0, 4.0)
"""m between the points of a GPS log: the first takes out the wandering of a good receiver that
stands, half a metre rms, most of the time, the others that of worse ones."""
DUPLICATE = 1e-3
"""m: points closer than this to the one before are merged."""
GAP_FACTOR = 10.0
"""Multiple of the median distance from which a gap is warned of."""
MINIMUM_LENGTH, MAXIMUM_LENGTH = 1.0, 30_000.0
"""m: other lengths suggest that the coordinates are not metres."""
LARGEST_COORDINATE = 1e7
"""m: larger coordinates are not on any map of the Earth."""
SAID = ("part", "missing", "skipped")
"""Metadata of readers that belong in the line of what was imported."""
BINDING = {
    "top speed": ("max_speed",),
    "lateral acceleration": ("max_lateral_acceleration",),
    "steering rate": ("max_steering_rate", "wheelbase"),
    "acceleration or braking": ("max_acceleration", "max_deceleration"),
}
"""Limits that lower the speeds of a file."""


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
    path = _Import(raw, options).path()
    LOG.info("%s: %s", raw.origin, path.metadata["imported"])
    return path


class _Import:
    """Make a path from the points of one file: checks, spline, speed, warnings."""

    def __init__(self, raw: RawPath, options: ImportOptions) -> None:
        self.options = options
        self.geographic = "latitude" in raw.columns
        self.warnings: list[str] = []
        self.notes = [str(raw.metadata[key]) for key in SAID if key in raw.metadata]
        self.metadata = dict(raw.metadata)
        if not raw.places:
            raw.fail("has no points")
        self.raw = self._located(raw)

    def warn(self, message: str) -> None:
        """Warn of a flaw that is accepted, and keep the message for the path's metadata."""
        self.warnings.append(message)
        warnings.warn(f"{self.raw.origin}: {message}", stacklevel=6)

    def path(self) -> ReferencePath:
        """Check the points, smooth and resample them, and set the speed."""
        options, before = self.options, self.raw
        raw, closed = self._thinned()
        self._check_steps(raw, closed)
        smoothing = options.smoothing
        if smoothing is None:
            smoothing = GPS_SMOOTHING if self.geographic else SMOOTHING
        smoothed = smooth(_points(raw), smoothing, closed=closed)
        for oddity in oddities(smoothed.geometry, closed):
            self.warn(oddity)
        said = (
            f"{raw.kind} of {len(before.places)} points: {'closed' if closed else 'open'}, "
            f"{smoothed.geometry.arc_length[-1]:.1f} m, at most {smoothed.max_deviation:.3f} m "
            "beside them"
        )
        known = (self.metadata.get(key) for key in ("part", "missing", "skipped"))
        self.notes[:0] = [said, *(str(note) for note in known if note)]
        speed = self._speed(raw, smoothed, closed)
        widths = None
        if "width_right" in raw.columns:
            sides = [raw.columns[key] * options.scale for key in ("width_right", "width_left")]
            widths = np.column_stack([_at_nodes(side, smoothed) for side in sides])
        limits = options.planning()
        self.metadata |= {
            "source": f"{raw.kind}: {Path(raw.origin).name}",
            "smoothing": smoothing,
            "max_deviation": smoothed.max_deviation,
            "rms_deviation": smoothed.rms_deviation,
            "speeds": "planned" if speed is None else "file",
            "warnings": self.warnings,
        }
        label = raw.name if options.name is None else options.name
        try:
            if speed is None:
                self.notes.append(
                    f"speed planned for at most {limits.max_speed:.4g} m/s and "
                    f"{limits.max_lateral_acceleration:.3g} m/s² laterally"
                )
                path = from_geometry(
                    smoothed.geometry, limits, label, closed=closed, **self.metadata
                )
            else:
                path = ReferencePath(
                    *smoothed.geometry[:5], speed, label, closed,
                    {"limits": asdict(limits), **self.metadata},
                )  # fmt: skip
        except RuntimeError as error:  # no speed profile found
            raw.fail(str(error))
        metadata = {**path.metadata, "imported": "; ".join(self.notes)}
        return replace(path, metadata=metadata, widths=widths)

    def _located(self, raw: RawPath) -> RawPath:
        """Return the points with scaled columns x and y, m."""
        columns, options = dict(raw.columns), self.options
        if self.geographic:
            columns["x"], columns["y"] = self._projected(raw)
        elif options.origin is not None:
            raw.fail("origin belongs to latitudes and longitudes, but it has metres")
        elif options.scale == 1.0:
            points = _points(raw)
            if 0.0 < np.ptp(points, axis=0).max() < 0.5 and np.abs(points).max() <= 180.0:
                raw.fail(
                    "all points lie within 0.5 m and look like degrees: name the columns lat,lon "
                    "to have them read as a GPS log, or give a scale if they are lengths"
                )
        for axis in ("x", "y"):
            columns[axis] = columns[axis] * options.scale
        if options.scale != 1.0:
            self.metadata["scale"] = options.scale
        located = replace(raw, columns=columns)
        far = np.flatnonzero(np.abs(_points(located)).max(axis=1, initial=0.0) > LARGEST_COORDINATE)
        if far.size:
            raw.fail(f"{raw.places[far[0]]}: coordinate beyond 1e7 m")
        return located

    def _projected(self, raw: RawPath) -> tuple[Array, Array]:
        """Return x and y, m, of latitudes and longitudes."""
        for key, bound in (("latitude", 90.0), ("longitude", 180.0)):
            beyond = np.flatnonzero(np.abs(raw.columns[key]) > bound)
            if beyond.size:
                value = raw.columns[key][beyond[0]]
                raw.fail(f"{raw.places[beyond[0]]}: {key} {value:g} is beyond {bound:g} degrees")
        back = np.flatnonzero(np.diff(raw.columns.get("time", np.zeros(1))) < 0.0)
        if back.size:
            raw.fail(f"{raw.places[back[0] + 1]}: time goes back")
        latitude, longitude = raw.columns["latitude"], raw.columns["longitude"]
        height = raw.columns.get("height", np.zeros(len(latitude)))
        if (origin := self.options.origin) is None:
            origin = [float(values[0]) for values in (latitude, longitude, height)]
        keys = ("latitude_deg", "longitude_deg", "height_m")
        self.metadata["origin"] = dict(zip(keys, origin, strict=True))
        self.metadata["frame"] = "east-north-up at origin (WGS-84): x east, y north, m"
        place = origin[0], origin[1], origin[2]
        x, y, _ = east_north_up(latitude, longitude, height, place).T
        return x, y

    def _thinned(self) -> tuple[RawPath, bool]:
        """Leave out points that are too near to the one before; return whether the rest is closed.

        Of several distances for GPS logs it is the smallest with which the path does not turn back.
        """
        raw = self.raw
        least = self.options.minimum_distance
        usual = GPS_DISTANCES if self.geographic else (DUPLICATE,)
        tried = []
        for distance in usual if least is None else (least,):
            kept = _kept(raw, distance)
            tried.append((distance, kept, *self._ends(_of(raw, kept))))
            if _reversal(_points(tried[-1][2]), tried[-1][3]) is None:
                break
        else:
            tried = tried[:1]
        distance, kept, thinned, closed = tried[-1]
        count = len(raw.places) - len(kept)
        if self.geographic or least is not None:
            self.metadata["dropped"] = count
            self.metadata["minimum_distance"] = distance
        if count and not self.geographic and least is None and "speed" not in raw.columns:
            first = raw.places[int(np.argmin(np.append(kept, -1) == np.arange(len(kept) + 1)))]
            self.warn(f"{count} duplicates under 1 mm merged (first: {first})")
        elif count:
            self.notes.append(f"{count} points nearer than {distance:g} m or standing left out")
        if len(thinned.places) < MINIMUM_POINTS:
            raw.fail(f"{len(thinned.places)} distinct points, at least {MINIMUM_POINTS} are needed")
        return thinned, closed

    def _ends(self, raw: RawPath) -> tuple[RawPath, bool]:
        """Return the points without a repeated start, and whether the path is closed."""
        points = _points(raw)
        closed = raw.closed if self.options.closed is None else self.options.closed
        if len(points) < MINIMUM_POINTS:
            return raw, bool(closed)
        gap = points[0] - points[-1]
        repeated = bool(np.hypot(*gap) < DUPLICATE)
        if closed is None:
            steps = np.diff(points, axis=0)
            distances = np.hypot(*steps.T)
            usual = max(float(np.median(distances)), distances[0], distances[-1])
            near = np.hypot(*gap) <= 1.5 * usual
            across = steps[0] if repeated else gap
            closed = bool(near and across @ steps[-1] > 0.0 and across @ steps[0] > 0.0)
        if closed and repeated:
            raw = _of(raw, np.arange(len(points) - 1))
        return raw, closed

    def _check_steps(self, raw: RawPath, closed: bool) -> None:
        """Reject reversals and impossible lengths; warn of gaps."""
        points = _points(raw)
        distances = np.hypot(*_steps(points, closed).T)
        length = float(distances.sum())
        if not MINIMUM_LENGTH <= length <= MAXIMUM_LENGTH:
            raw.fail(
                f"{length:.4g} m long, not between {MINIMUM_LENGTH:g} and {MAXIMUM_LENGTH:g} m: "
                "are these metres?"
            )
        if (back := _reversal(points, closed)) is not None:
            raw.fail(
                f"the path turns back by {back[1]:.0f} degrees at point {back[0]} "
                f"({raw.places[back[0]]}); if that is jitter, a minimum_distance takes it out"
            )
        widest = int(np.argmax(distances))
        median = float(np.median(distances))
        if distances[widest] > GAP_FACTOR * median:
            self.warn(
                f"gap of {distances[widest]:.1f} m after {raw.places[widest]}, "
                f"the median is {median:.2f} m"
            )

    def _speed(self, raw: RawPath, smoothed: Smoothed, closed: bool) -> Array | None:
        """Return the speeds of the file (n,) up to the limits, m/s; None where they are planned."""
        options = self.options
        given = raw.columns.get("speed")
        if options.speeds == "planned":
            return None
        if given is None:
            if options.speeds == "file":
                raw.fail("has no column of speeds: name one, such as v_mps, or plan the speed")
            return None
        column = self.metadata.get("speed_column", "speed")
        if options.speeds is None and options.scale != 1.0:
            self.notes.append(f"speeds in {column} not used, since the path is scaled")
            return None
        if (given < 0.0).any():
            index = int(np.argmin(given))
            raw.fail(
                f"{raw.places[index]}: speed {given[index]:g} m/s is negative; speeds='planned' "
                "plans it anew"
            )
        if given.max() < MINIMUM_SPEED:
            self.warn(f"its speeds, in {column}, are all 0: planned instead")
            return None
        self._compare_times(raw)
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
        if cut[k] < 1e-3:
            self.notes.append(f"{said}, kept")
            return speed
        alone = {
            words: kept_to(replace(NO_LIMITS, **{name: getattr(limits, name) for name in names}))[k]
            for words, names in BINDING.items()
        }
        self.notes.append(
            f"{said}, lowered on {100.0 * np.mean(cut > 1e-3):.0f} % of the length, at most by "
            f"{cut[k]:.2f} m/s at {s[k]:.0f} m ({min(alone, key=lambda one: alone[one])})"
        )
        return speed

    def _compare_times(self, raw: RawPath) -> None:
        """Warn of speeds that are in km/h by the times of the points."""
        if "time" not in raw.columns:
            return
        speed, steps = raw.columns["speed"], np.diff(raw.columns["time"])
        driven = 0.5 * (speed[1:] + speed[:-1]) * steps
        distances = np.hypot(*np.diff(_points(raw), axis=0).T) / self.options.scale
        if 3.2 < np.median(driven / distances) < 4.0:
            self.warn(
                "its speeds are 3.6 times those that follow from its times: if they are in km/h, "
                "say so by speed_unit"
            )


def _points(raw: RawPath) -> Array:
    """Return x and y, (n, 2) m."""
    return np.column_stack([raw.columns["x"], raw.columns["y"]])


def _of(raw: RawPath, kept: NDArray[np.int_]) -> RawPath:
    """Keep some points; a speed is the lowest up to the next one that is kept."""
    columns = {key: values[kept] for key, values in raw.columns.items()}
    if "speed" in columns:
        columns["speed"] = np.minimum.reduceat(raw.columns["speed"], kept)
    return replace(raw, columns=columns, places=[raw.places[k] for k in kept])


def _kept(raw: RawPath, distance: float) -> NDArray[np.int_]:
    """Return the indices of points at least `distance` (m) from the last kept one.

    From points where the vehicle stands that is at least `SPACING`.
    """
    points = _points(raw).tolist()
    least = np.full(len(points), distance)
    if "speed" in raw.columns:
        least[raw.columns["speed"] < MINIMUM_SPEED] = max(distance, SPACING)
    kept = [0]
    for k, apart in enumerate(least.tolist()[1:], start=1):
        if math.dist(points[k], points[kept[-1]]) >= apart:
            kept.append(k)
    return np.array(kept)


def _steps(points: Array, closed: bool) -> Array:
    return np.diff(np.vstack([points, points[:1]]) if closed else points, axis=0)


def _reversal(points: Array, closed: bool) -> tuple[int, float] | None:
    """Find the first point at which the path turns by more than 90 degrees: index and turn."""
    steps = _steps(points, closed)
    following = np.roll(steps, -1, axis=0) if closed else steps[1:]
    inner = steps[: len(following)]
    along = (inner * following).sum(axis=1)
    across = inner[:, 0] * following[:, 1] - inner[:, 1] * following[:, 0]
    turns = np.degrees(np.abs(np.arctan2(across, along)))
    back = np.flatnonzero(turns > 90.0)
    return (int(back[0] + 1) % len(points), float(turns[back[0]])) if back.size else None


def _at_nodes(values: Array, smoothed: Smoothed) -> Array:
    """Interpolate a quantity of the points (m,) to the nodes (n,) of the path."""
    around = np.resize(values, len(smoothed.places))  # the first again at the end of a closed path
    nodes: Array = np.interp(smoothed.geometry.arc_length, smoothed.places, around)
    return nodes
