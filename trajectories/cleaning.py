"""Points of a path made sound: projected, scaled, thinned, checked, their ends joined or not."""

import math
import warnings
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajectories.geodesy import east_north_up
from trajectories.import_options import ImportOptions
from trajectories.path import MINIMUM_POINTS, MINIMUM_SPEED, SPACING
from trajectories.raw_path import RawPath

Array = NDArray[np.float64]

GPS_DISTANCES = (1.0, 2.0, 4.0)
"""m between the points of a GPS log: the first takes out the wandering of a good receiver that
stands, half a metre rms, most of the time, the others that of worse ones."""
DUPLICATE = 1e-3
"""m: points closer than this to the one before are merged."""
GAP_FACTOR = 10.0
"""Multiple of the median distance from which a gap is warned of."""
MINIMUM_LENGTH, MAXIMUM_LENGTH = 1.0, 30_000.0
"""Bounds of a path's length, m; other lengths suggest that the coordinates are not metres."""
LARGEST_COORDINATE = 1e7
"""m: larger coordinates are not on any map of the Earth."""


@dataclass
class Findings:
    """Report of an import: warnings of flaws that are accepted, notes, and the path's metadata.

    Parameters
    ----------
    origin
        File or array, which begins every warning.
    """

    origin: str
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)

    def warn(self, message: str) -> None:
        """Warn of a flaw that is accepted, and keep the message for the path's metadata."""
        self.warnings.append(message)
        warnings.warn(f"{self.origin}: {message}", stacklevel=6)


def cleaned(raw: RawPath, options: ImportOptions, findings: Findings) -> tuple[RawPath, bool]:
    """Return points with columns x and y, m, fit for a path, and whether the path is closed.

    A closed path's first point is not repeated at its end.

    Raises
    ------
    ValueError
        If the points are no drivable path; the message names the point.
    """
    if not raw.places:
        raw.fail("has no points")
    thinned, closed = _thinned(_located(raw, options, findings), options, findings)
    _check_steps(thinned, closed, findings)
    return thinned, closed


def geographic(raw: RawPath) -> bool:
    """Return whether points are latitudes and longitudes."""
    return "latitude" in raw.columns


def _located(raw: RawPath, options: ImportOptions, findings: Findings) -> RawPath:
    """Return the points with scaled columns x and y, m."""
    columns = dict(raw.columns)
    if geographic(raw):
        columns["x"], columns["y"] = _projected(raw, options, findings)
    elif options.origin is not None:
        raw.fail("origin belongs to latitudes and longitudes, but it has metres")
    elif options.scale == 1.0:
        points = points_of(raw)
        if 0.0 < np.ptp(points, axis=0).max() < 0.5 and np.abs(points).max() <= 180.0:
            raw.fail(
                "all points lie within 0.5 m and look like degrees: name the columns lat,lon "
                "to have them read as a GPS log, or give a scale if they are lengths"
            )
    for axis in ("x", "y"):
        columns[axis] = columns[axis] * options.scale
    if options.scale != 1.0:
        findings.metadata["scale"] = options.scale
    located = replace(raw, columns=columns)
    far = np.flatnonzero(np.abs(points_of(located)).max(axis=1, initial=0.0) > LARGEST_COORDINATE)
    if far.size:
        raw.fail(f"{raw.places[far[0]]}: coordinate beyond 1e7 m")
    return located


def _projected(raw: RawPath, options: ImportOptions, findings: Findings) -> tuple[Array, Array]:
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
    if (origin := options.origin) is None:
        origin = [float(values[0]) for values in (latitude, longitude, height)]
    keys = ("latitude_deg", "longitude_deg", "height_m")
    findings.metadata["origin"] = dict(zip(keys, origin, strict=True))
    findings.metadata["frame"] = "east-north-up at origin (WGS-84): x east, y north, m"
    place = origin[0], origin[1], origin[2]
    x, y, _ = east_north_up(latitude, longitude, height, place).T
    return x, y


def _thinned(raw: RawPath, options: ImportOptions, findings: Findings) -> tuple[RawPath, bool]:
    """Leave out points that are too near to the one before; return whether the rest is closed.

    Of several distances for GPS logs it is the smallest with which the path does not turn back.
    """
    least = options.minimum_distance
    usual = GPS_DISTANCES if geographic(raw) else (DUPLICATE,)
    tried = []
    for distance in usual if least is None else (least,):
        kept = _kept(raw, distance)
        tried.append((distance, kept, *_ends(_of(raw, kept), options)))
        if _reversal(points_of(tried[-1][2]), tried[-1][3]) is None:
            break
    else:
        tried = tried[:1]
    distance, kept, thinned, closed = tried[-1]
    count = len(raw.places) - len(kept)
    if geographic(raw) or least is not None:
        findings.metadata["dropped"] = count
        findings.metadata["minimum_distance"] = distance
    if count and not geographic(raw) and least is None and "speed" not in raw.columns:
        first = raw.places[int(np.argmin(np.append(kept, -1) == np.arange(len(kept) + 1)))]
        findings.warn(f"{count} duplicates under 1 mm merged (first: {first})")
    elif count:
        findings.notes.append(f"{count} points nearer than {distance:g} m or standing left out")
    if len(thinned.places) < MINIMUM_POINTS:
        raw.fail(f"{len(thinned.places)} distinct points, at least {MINIMUM_POINTS} are needed")
    return thinned, closed


def _ends(raw: RawPath, options: ImportOptions) -> tuple[RawPath, bool]:
    """Return the points without a repeated start, and whether the path is closed."""
    points = points_of(raw)
    closed = raw.closed if options.closed is None else options.closed
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


def _check_steps(raw: RawPath, closed: bool, findings: Findings) -> None:
    """Reject reversals and impossible lengths; warn of gaps."""
    points = points_of(raw)
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
            f"({raw.places[back[0]]}); if that is jitter, a minimum_distance "
            "(--minimum-distance) takes it out"
        )
    widest = int(np.argmax(distances))
    median = float(np.median(distances))
    if distances[widest] > GAP_FACTOR * median:
        findings.warn(
            f"gap of {distances[widest]:.1f} m after {raw.places[widest]}, "
            f"the median is {median:.2f} m"
        )


def points_of(raw: RawPath) -> Array:
    """Return x and y, (n, 2) m."""
    return np.column_stack([raw.columns["x"], raw.columns["y"]])


def _of(raw: RawPath, kept: NDArray[np.int_]) -> RawPath:
    """Keep some points, and every stop: it moves to the last kept point before it."""
    columns = {key: values[kept] for key, values in raw.columns.items()}
    if "speed" in columns:
        lowest = np.minimum.reduceat(raw.columns["speed"], kept)
        columns["speed"] = np.where(lowest < MINIMUM_SPEED, lowest, columns["speed"])
    return replace(raw, columns=columns, places=[raw.places[k] for k in kept])


def _kept(raw: RawPath, distance: float) -> NDArray[np.int_]:
    """Return the indices of points at least `distance` (m) from the last kept one.

    From points where the vehicle stands that is at least `SPACING`.
    """
    points = points_of(raw).tolist()
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
