"""Import foreign paths: racing circuits, plain x,y lists, GPS logs.

Every import takes the same steps: checks, a smoothing spline whose deviation is reported,
resampling at 0.25 m of arc length, heading and curvature from the spline's derivatives, and a
jerk-limited speed profile.
"""

import math
import warnings
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from trajectories.arguments import Number, flag, instance_of, numbers, shown
from trajectories.geodesy import east_north_up
from trajectories.path import MINIMUM_POINTS, SPACING, ReferencePath
from trajectories.shapes import Geometry, from_geometry, smooth
from trajectories.speed import SpeedLimits
from trajectories.text_table import COLUMNS, TextTable, is_number, read_table

Array = NDArray[np.float64]

IMPORT_LIMITS = SpeedLimits(max_speed=10.0, max_lateral_acceleration=2.0, max_acceleration=1.5)
"""Default speed limits of an imported path: as for analytic shapes, but starting at 1.5 m/s."""
SMOOTHING = 0.05
"""m rms: removes the jitter of points 5 m apart (on one track the largest curvature falls from
0.162 to 0.104 1/m)."""
GPS_SMOOTHING = 0.2
"""m rms."""
SHARP = 0.115
"""Curvature from which a bend is warned of, 1/m: a wheelbase of 5 m steers it with 30 degrees."""

DUPLICATE = 1e-3
"""m: points closer than this to the one before are merged."""
GAP_FACTOR = 10.0
"""Multiple of the median distance from which a gap is warned of."""
APPROACH, APPROACH_ALONG = 2.5, 20.0
"""m: a path approaches itself if it comes this close to a place this far away along the path."""
CHUNK = 4096
"""Points whose neighbours are looked up at once."""
MINIMUM_LENGTH, MAXIMUM_LENGTH = 1.0, 30_000.0
"""m: other lengths suggest that the coordinates are not metres."""
SCALES = Number(0.0, 1e9, above=True)
DISTANCES = Number(0.0, 1e9, "m")
ORIGIN = Number(-1e6, 1e6)
"""Rules of arguments."""
LARGEST_COORDINATE = 1e7
"""m: larger coordinates are not on any map of the Earth."""


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

    Parameters
    ----------
    file
        CSV file; the track widths are not used.
    closed
        Whether the track is a circuit; None decides by whether the ends meet.
    scale
        Factor on all coordinates, to fit a track to a vehicle.
    limits
        Speed limits; the default is 10 m/s, 2 m/s^2 laterally, 1.5 m/s^2 longitudinally.
    smoothing
        Largest rms deviation of the path from the (scaled) points, m; 0 interpolates.
    name
        Name of the path; by default the file's stem.

    Raises
    ------
    ValueError
        If the file cannot be read or is no drivable path; the message names line and column.
    """
    table = read_table(file)
    if len(table.rows[0]) != 4 or (table.header and table.find("width") is None):
        table.fail("is no racetrack-database file: x_m,y_m,w_tr_right_m,w_tr_left_m expected")
    points = np.column_stack([table.column(0), table.column(1)])
    importer = _Importer(table, "racetrack-database centre line", limits, smoothing)
    return importer.path(importer.scaled(points, scale), name, closed)


def read_xy(
    file: str | Path,
    *,
    closed: bool | None = None,
    scale: float = 1.0,
    limits: SpeedLimits = IMPORT_LIMITS,
    smoothing: float = SMOOTHING,
    name: str | None = None,
) -> ReferencePath:
    """Import waypoints x,y in metres; files with more columns need a header that names x and y.

    Parameters are those of `read_racetrack`. With `closed` None the path counts as closed if its
    ends are within 1.5 times the spacing (median, first or last) and the direction continues from
    the end to the start.

    Raises
    ------
    ValueError
        If the file cannot be read, is no drivable path, or seems to be in degrees.
    """
    table = read_table(file)
    x, y = table.find("x"), table.find("y")
    if table.header and (x is None or y is None):
        if table.find("latitude") is not None:
            table.fail("has latitudes and longitudes, not metres: read it with read_gps")
        table.fail(
            f"no columns x and y in its header {','.join(table.header)[:80]!r}; "
            f"known: {', '.join(COLUMNS['x'])}"
        )
    if not table.header and len(table.rows[0]) != 2:
        table.fail(f"{len(table.rows[0])} columns without a header: name them, e.g. x_m,y_m")
    points = np.column_stack([table.column(x or 0), table.column(1 if y is None else y)])
    small = np.ptp(points, axis=0).max() < 0.5 and np.abs(points).max() <= 180.0
    if small and scale == 1.0 and len(points) >= MINIMUM_POINTS:
        table.fail(
            "all points lie within 0.5 m and look like degrees: name the columns lat,lon to have "
            "them read as a GPS log, or give a scale if they are lengths"
        )
    importer = _Importer(table, "x,y waypoints", limits, smoothing)
    return importer.path(importer.scaled(points, scale), name, closed)


def read_gps(
    file: str | Path,
    *,
    closed: bool | None = None,
    origin: tuple[float, float, float] | None = None,
    minimum_distance: float = SPACING,
    limits: SpeedLimits = IMPORT_LIMITS,
    smoothing: float = GPS_SMOOTHING,
    name: str | None = None,
) -> ReferencePath:
    """Import a GPS log: columns lat, lon, optionally height and time (seconds or ISO 8601).

    Parameters
    ----------
    file
        CSV file with a header.
    closed
        As in `read_xy`.
    origin
        Latitude and longitude (deg) and height (m) of x = y = 0; the first point unless given.
        There x points east and y north. It is stored in `metadata["origin"]`.
    minimum_distance
        m: points closer than this to the last kept one are dropped (standstill); their number is
        in `metadata["dropped"]`.
    limits, smoothing, name
        As in `read_racetrack`; logs of consumer receivers may need more `smoothing`.

    Raises
    ------
    ValueError
        If the file cannot be read, angles are out of range, time goes back, or the points are no
        drivable path.
    """
    table = read_table(file)
    columns = {key: table.find(key) for key in ("latitude", "longitude", "height", "time")}
    if columns["latitude"] is None or columns["longitude"] is None:
        table.fail("is no GPS log: a header with lat and lon is needed")
    angles = {}
    for key, bound in (("latitude", 90.0), ("longitude", 180.0)):
        angles[key] = table.column(columns[key] or 0)
        beyond = np.flatnonzero(np.abs(angles[key]) > bound)
        if beyond.size:
            value = angles[key][beyond[0]]
            table.fail(
                f"line {table.lines[beyond[0]]}: {key} {value:g} is beyond {bound:g} degrees; "
                "coordinates in metres need columns x_m,y_m"
            )
    zero = np.zeros(len(table.rows))
    height = zero if columns["height"] is None else table.column(columns["height"])
    if columns["time"] is not None:
        back = np.flatnonzero(np.diff(_times(table, columns["time"])) < 0)
        if back.size:
            table.fail(f"line {table.lines[back[0] + 1]}: time goes back")
    if origin is None:
        origin = (float(angles["latitude"][0]), float(angles["longitude"][0]), float(height[0]))
    latitude, longitude, above = numbers("origin", origin, ORIGIN, 3)
    origin = latitude, longitude, above
    points = east_north_up(angles["latitude"], angles["longitude"], height, origin)[:, :2]
    importer = _Importer(table, "GPS log", limits, smoothing)
    kept = importer.thinned(points, DISTANCES.of("minimum_distance", minimum_distance))
    importer.metadata["origin"] = dict(
        zip(("latitude_deg", "longitude_deg", "height_m"), origin, strict=True)
    )
    importer.metadata["frame"] = "east-north-up at origin (WGS-84): x east, y north, m"
    importer.metadata["dropped"] = len(points) - len(kept)
    return importer.path(kept, name, closed)


def _times(table: TextTable, index: int) -> Array:
    """Read times (n,), s, from a column of numbers or of ISO 8601 stamps."""
    if is_number(table.rows[0][index]):
        return table.column(index)
    stamps = np.empty(len(table.rows))
    for k, row in enumerate(table.rows):
        try:
            stamps[k] = datetime.fromisoformat(row[index].strip('"')).timestamp()
        except (ValueError, OverflowError, OSError):
            table.fail(f"line {table.lines[k]}: {shown(row[index])} is not a time")
    return stamps


def imported(path: ReferencePath) -> bool:
    """Return whether a path was made of points that somebody measured or drew."""
    return "rms_deviation" in path.metadata


@dataclass
class _Importer:
    """Make a path from the points of one file: checks, spline, speed profile, warnings."""

    table: TextTable
    kind: str
    limits: SpeedLimits
    smoothing: float
    metadata: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        instance_of("limits", self.limits, SpeedLimits, "SpeedLimits")
        self.smoothing = DISTANCES.of("smoothing", self.smoothing)

    def warn(self, message: str) -> None:
        """Warn of a flaw that is accepted, and keep the message for the path's metadata."""
        self.warnings.append(message)
        warnings.warn(f"{self.table.file}: {message}", stacklevel=5)

    def scaled(self, points: Array, scale: float) -> Array:
        """Scale points (n, 2), and keep the factor for the metadata."""
        scale = SCALES.of("scale", scale)
        if scale != 1.0:
            self.metadata["scale"] = scale
        return points * scale

    def thinned(self, points: Array, distance: float) -> Array:
        """Keep points (m, 2) at least `distance` (m) from the last kept one, and their lines."""
        kept = [0]
        for k in range(1, len(points)):
            if math.dist(points[k], points[kept[-1]]) >= distance:
                kept.append(k)
        self.table.lines[:] = [self.table.lines[k] for k in kept]
        return points[kept]

    def path(self, points: Array, name: str | None, closed: bool | None) -> ReferencePath:
        """Check points (n, 2), smooth and resample them, and plan a speed profile."""
        closed = None if closed is None else flag("closed", closed)
        label = self.table.file.stem if name is None else instance_of("name", name, str, "text")
        points = self._checked(points)
        points, closed = self._ends(points, closed)
        self._check_steps(points, closed)
        smoothed = smooth(points, self.smoothing, closed=closed)
        geometry = smoothed.geometry
        for oddity in oddities(geometry, closed):
            self.warn(oddity)
        try:
            return from_geometry(
                geometry, self.limits, label, closed=closed,
                source=f"{self.kind}: {self.table.file.name}",
                smoothing=self.smoothing,
                max_deviation=smoothed.max_deviation,
                rms_deviation=smoothed.rms_deviation,
                warnings=self.warnings,
                **self.metadata,
            )  # fmt: skip
        except RuntimeError as error:  # no speed profile found
            raise ValueError(f"{self.table.file}: {error}") from error

    def _checked(self, points: Array) -> Array:
        """Merge duplicates to points (m, 2); reject too few, or coordinates too large."""
        far = np.flatnonzero(np.abs(points).max(axis=1) > LARGEST_COORDINATE)
        if far.size:
            self.table.fail(f"line {self.table.lines[far[0]]}: coordinate beyond 1e7 m")
        before, lines = len(points), list(self.table.lines)
        points = self.thinned(points, DUPLICATE)
        if len(points) < before:
            first = min(set(lines).difference(self.table.lines))
            self.warn(f"{before - len(points)} duplicates under 1 mm merged (first: line {first})")
        if len(points) < MINIMUM_POINTS:
            self.table.fail(f"{len(points)} distinct points, at least {MINIMUM_POINTS} are needed")
        return points

    def _ends(self, points: Array, closed: bool | None) -> tuple[Array, bool]:
        """Return the points without a repeated start, and whether the path is closed."""
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
            points = points[:-1]
            if len(points) < MINIMUM_POINTS:
                self.table.fail(f"{len(points)} distinct points, {MINIMUM_POINTS} are needed")
        return points, closed

    def _check_steps(self, points: Array, closed: bool) -> None:
        """Reject reversals and impossible lengths; warn of gaps."""
        steps = np.diff(np.vstack([points, points[:1]]) if closed else points, axis=0)
        distances = np.hypot(*steps.T)
        length = float(distances.sum())
        if not MINIMUM_LENGTH <= length <= MAXIMUM_LENGTH:
            self.table.fail(
                f"{length:.4g} m long, not between {MINIMUM_LENGTH:g} and {MAXIMUM_LENGTH:g} m: "
                "are these metres?"
            )
        following = np.roll(steps, -1, axis=0) if closed else steps[1:]
        inner = steps[: len(following)]
        along = (inner * following).sum(axis=1)
        across = inner[:, 0] * following[:, 1] - inner[:, 1] * following[:, 0]
        turns = np.degrees(np.abs(np.arctan2(across, along)))
        back = np.flatnonzero(turns > 90.0)
        if back.size:
            index = int(back[0] + 1) % len(points)
            self.table.fail(
                f"the path turns back by {turns[back[0]]:.0f} degrees at point {index} "
                f"(line {self.table.lines[index]})"
            )
        widest = int(np.argmax(distances))
        median = float(np.median(distances))
        if distances[widest] > GAP_FACTOR * median:
            self.warn(
                f"gap of {distances[widest]:.1f} m after line {self.table.lines[widest]}, "
                f"the median is {median:.2f} m"
            )


def oddities(geometry: Geometry, closed: bool) -> list[str]:
    """Describe what is accepted but unusual: a sharp bend, branches close to each other."""
    found = []
    curvature = np.abs(geometry.curvature)
    sharpest = int(np.argmax(curvature))
    if curvature[sharpest] > SHARP:
        found.append(
            f"bend of {1.0 / curvature[sharpest]:.1f} m radius at "
            f"{geometry.arc_length[sharpest]:.1f} m: more smoothing may widen it"
        )
    near = self_approach(geometry, closed)
    if near is not None:
        found.append(
            f"the path comes within {near[2]:.2f} m of itself, at {near[0]:.1f} m and "
            f"{near[1]:.1f} m: project with the last arc length at hand"
        )
    return found


def self_approach(geometry: Geometry, closed: bool) -> tuple[float, float, float] | None:
    """Find where a path comes closest to itself: two arc lengths and their distance, m.

    None if no points that lie more than 20 m apart along the path (across the seam too if it is
    closed) are closer than 2.5 m.
    """
    stride = 2  # 0.5 m: the nearest nodes are at most 0.35 m further apart than the branches
    s = geometry.arc_length[::stride]
    points = np.column_stack([geometry.x[::stride], geometry.y[::stride]])
    # A point's nearest neighbours, itself and those on its own branch included: one more than these
    # must contain the nearest point of another branch. All pairs may be 10^9 where a path lies over
    # itself many times.
    count = 2 * math.ceil(APPROACH_ALONG / s[1]) + 2
    tree = cKDTree(points, balanced_tree=False)
    best: tuple[float, float, float] | None = None
    for first in range(0, len(points), CHUNK):
        rows = slice(first, first + CHUNK)
        distances, others = tree.query(points[rows], count, distance_upper_bound=APPROACH)
        along = np.abs(np.append(s, math.inf)[others] - s[rows, None])
        if closed:
            along = np.minimum(along, np.abs(geometry.arc_length[-1] - along))
        distances[along <= APPROACH_ALONG] = math.inf
        row, column = np.unravel_index(int(np.argmin(distances)), distances.shape)
        distance = float(distances[row, column])
        if distance < (APPROACH if best is None else best[2]):
            ends = sorted((float(s[first + row]), float(s[others[row, column]])))
            best = ends[0], ends[1], distance
    return best
