"""A reference path from a recorded drive: positions of odometry or of fixes, smoothed.

Smoothing splines over time take the noise out of x and y, as much as generalised cross-validation
finds (Craven and Wahba, 1979) or to a given tolerance. What they pass is resampled by distance, so
standstill falls away, and becomes a path at 0.25 m of arc length with heading and curvature from a
spline's derivatives. The speed is the recorded one, the splines' own, or planned anew.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_smoothing_spline

from experiments.ros.read import BagError, Reading, info, read
from experiments.ros.topics import Datum, Fixes, Odometry
from trajectories.importers import IMPORT_LIMITS, MAX_STEERING_ANGLE, self_approach
from trajectories.path import ReferencePath
from trajectories.shapes import Geometry, from_geometry, smooth
from trajectories.speed import SpeedLimits

Array = NDArray[np.float64]

BIN = 0.1
"""s: positions nearer in time are averaged first; cross-validation takes a millisecond for each."""
SPACING = 0.5
"""m between the points that are left: standstill leaves one."""
SHAPE_TOLERANCE, SHAPE_SHARE = 3e-4, 0.05
"""m, and as a share of the noise: rms by which the path may pass the smoothed points. More noise
leaves ripples that bend a path of interpolating splines by up to 0.1 1/m (5 cm, 10 Hz)."""
LEAST_SPEED = 0.5
"""m/s to which a recorded speed is raised: a reference never stands still."""
OUTLIER, LEAST_OUTLIER = 6.0, 0.1
OUTLIER_ROUNDS = 8
"""Positions further off than so many deviations of the noise, and than so many m, are left out, and
the rest is smoothed again, which may show more of them."""
FEWEST_POSITIONS, SHORTEST = 8, 5.0
LONGEST_GAP = 2.0
"""s without a position, beyond which there is a warning."""
PENALTIES = (-12.0, 8.0)
PENALTY_RESOLUTION = 0.05
"""Powers of ten between which a penalty is bisected, and to what resolution."""


@dataclass(frozen=True)
class DrivenLine:
    """A drive's path, and what became of its positions."""

    path: ReferencePath
    topic: str
    positions: int
    deviation_rms: float
    deviation_max: float
    """m, distances of the recorded positions from where the splines are at their time."""
    warnings: list[str] = field(default_factory=list)


def reference(
    file: Path,
    *,
    source: str | None = None,
    topic: str | None = None,
    datum: tuple[float, float, float] | None = None,
    smoothing: float | None = None,
    limits: SpeedLimits | None = None,
    name: str | None = None,
) -> DrivenLine:
    """Make a reference path of a recorded drive.

    Parameters
    ----------
    file
        The bag.
    source
        "odometry" or "fix"; if None, odometry if there is any.
    topic
        The topic's name, where the bag has several of the kind.
    datum
        Of fixes: latitude, longitude (deg) and height (m) of x = y = 0; if None, the bag's own
        (geographic_msgs/GeoPointStamped), else the first fix.
    smoothing
        m, rms distance of the positions from the smoothed ones; found by cross-validation if None.
    limits
        Plan the speed within these; if None, the recorded speed is kept, from 0.5 m/s upwards.
    name
        The path's name; the bag's unless given.

    Raises
    ------
    BagError
        If the bag cannot be read, or its drive is no path: too short, or turning back.
    ValueError
        For a tolerance that is not positive.
    """
    if smoothing is not None and not (math.isfinite(smoothing) and smoothing > 0.0):
        raise ValueError(f"smoothing must be positive, not {smoothing}")
    metadata: dict[str, Any] = {}
    if source is None:
        source = "odometry" if info(file).of_kind(Odometry) else "fix"
    reading: Reading[Any]
    if source == "odometry":
        reading = read(file, Odometry, topic)
        points = np.column_stack([reading.data.x, reading.data.y])
        metadata["frame"] = f"{reading.data.frame}: x, y in m, heading counter-clockwise from x"
    else:
        reading = read(file, Fixes, topic)
        origin = datum or datum_of(file, reading.data)
        points = reading.data.positions(origin)
        metadata["frame"] = "east-north-up at origin (WGS-84): x east, y north, m"
        metadata["origin"] = dict(
            zip(("latitude_deg", "longitude_deg", "height_m"), origin, strict=True)
        )
    metadata["source"] = f"{source} of a recorded drive: {file.name}, {reading.topic}"
    try:
        return _line(
            reading, points, smoothing, limits, file.stem if name is None else name, metadata
        )
    except _NoPathError as error:
        raise BagError(f"{file}: {reading.topic}: {error}") from error


def datum_of(file: Path, fixes: Fixes) -> tuple[float, float, float]:
    """Where x = y = 0 of a bag lies (deg, deg, m): as it says itself, else at the first fix."""
    if info(file).of_kind(Datum):
        return read(file, Datum).data.last
    height = float(fixes.height[0])
    return (
        float(fixes.latitude[0]), float(fixes.longitude[0]), 0.0 if math.isnan(height) else height
    )  # fmt: skip


class _NoPathError(ValueError):
    """Positions that make no path."""


def _line(
    reading: Reading[Any],
    points: Array,
    smoothing: float | None,
    limits: SpeedLimits | None,
    name: str,
    metadata: dict[str, Any],
) -> DrivenLine:
    told: list[str] = []
    time, means = _averaged(reading.data.time, points)
    if len(time) < FEWEST_POSITIONS:
        raise _NoPathError(f"{len(time)} positions over time, {FEWEST_POSITIONS} are needed")
    gap = int(np.argmax(np.diff(time)))
    if time[gap + 1] - time[gap] > LONGEST_GAP:
        told.append(
            f"no positions for {time[gap + 1] - time[gap]:.1f} s from {time[gap]:.1f} s on: bridged"
        )
    centre = means.mean(axis=0)  # coordinates of a map's grid would cost digits
    means -= centre
    splines, kept = _robust(time, means, smoothing)
    if not kept.all():
        told.append(f"{int((~kept).sum())} positions lie far off the others: left out")
    distance = _distances(splines, time[kept], means[kept])
    noise = float(np.sqrt(np.mean(distance**2)))
    at, chain = _resampled(splines, time)
    shape = smooth(chain + centre, max(SHAPE_TOLERANCE, SHAPE_SHARE * noise))
    told.extend(_oddities(shape.geometry, limits or IMPORT_LIMITS))
    metadata.update(
        smoothing="cross-validated" if smoothing is None else smoothing,
        rms_deviation=noise, max_deviation=float(distance.max()),
        positions=len(points), outliers=int((~kept).sum()), duplicates=reading.duplicates,
        out_of_order=reading.out_of_order, unusable=reading.unusable, warnings=told,
    )  # fmt: skip
    try:
        if limits is not None:
            path = from_geometry(shape.geometry, limits, name, **metadata)
        else:
            path = ReferencePath(
                *shape.geometry[:5], name=name, metadata={**metadata, "speed": "as recorded"},
                speed=_recorded_speed(splines, at, chain, shape.geometry),
            )  # fmt: skip
    except RuntimeError as error:  # the linear programme found no profile
        raise _NoPathError(str(error)) from error
    return DrivenLine(path, reading.topic, len(points), noise, float(distance.max()), told)


def _averaged(time: Array, points: Array) -> tuple[Array, Array]:
    """Means of time (m,) and positions (m, 2) within bins of time that hold any."""
    cell = np.floor(time / BIN + 1e-6).astype(np.int64)
    _, group = np.unique(cell, return_inverse=True)
    count = np.bincount(group)
    sums = (np.bincount(group, weights=values) for values in (time, *points.T))
    when, x, y = (total / count for total in sums)
    return when, np.column_stack([x, y])


def _robust(
    time: Array, points: Array, tolerance: float | None
) -> tuple[tuple[BSpline, BSpline], NDArray[np.bool_]]:
    """Smoothing splines of points (m, 2) without those far off, and which were kept (m,)."""
    kept = np.ones(len(time), dtype=np.bool_)
    for _ in range(OUTLIER_ROUNDS):
        splines = _smoothed(time[kept], points[kept], tolerance)
        distance = _distances(splines, time, points)
        # The median distance of white noise in the plane is 1.18 of its deviation in each axis.
        noise = float(np.median(distance[kept])) / 1.1774
        far = distance > max(OUTLIER * noise, LEAST_OUTLIER)
        if (far == ~kept).all():
            break
        kept = ~far
    return splines, kept


def _distances(splines: tuple[BSpline, BSpline], time: Array, points: Array) -> Array:
    """Distances (m,) of points (m, 2) from where splines are at their times."""
    x, y = (spline(time) for spline in splines)
    distances: Array = np.hypot(x - points[:, 0], y - points[:, 1])
    return distances


def _smoothed(time: Array, points: Array, tolerance: float | None) -> tuple[BSpline, BSpline]:
    """Smoothing splines of x and y (m, 2) over time, by cross-validation or to an rms distance."""
    if tolerance is None:
        # Positions that do not move at all have nothing to validate: a straight east or north.
        return tuple(
            make_smoothing_spline(time, values)
            if np.ptp(values) > 0.0
            else make_smoothing_spline(time, values, lam=1.0)
            for values in points.T
        )

    def fit(exponent: float) -> tuple[tuple[BSpline, BSpline], float]:
        x, y = (make_smoothing_spline(time, values, lam=10.0**exponent) for values in points.T)
        squares = (x(time) - points[:, 0]) ** 2 + (y(time) - points[:, 1]) ** 2
        return (x, y), float(np.sqrt(np.mean(squares)))

    low, high = PENALTIES
    if fit(high)[1] <= tolerance:
        low = high
    while high - low > PENALTY_RESOLUTION:
        middle = 0.5 * (low + high)
        if fit(middle)[1] <= tolerance:
            low = middle
        else:
            high = middle
    return fit(low)[0]


def _resampled(splines: tuple[BSpline, BSpline], time: Array) -> tuple[Array, Array]:
    """Times (m,) and points (m, 2) along the splines, each `SPACING` from the one before it."""
    fine = np.arange(time[0], time[-1], 0.1 * BIN)
    dense = np.column_stack([spline(fine) for spline in splines])
    kept = [0]
    for k in range(1, len(dense)):
        if math.dist(dense[k], dense[kept[-1]]) >= SPACING:
            kept.append(k)
    length = SPACING * (len(kept) - 1)
    if length < SHORTEST:
        raise _NoPathError(f"the drive goes {length:.1f} m, at least {SHORTEST:g} m are needed")
    steps = np.diff(dense[kept], axis=0)
    back = np.flatnonzero((steps[1:] * steps[:-1]).sum(axis=1) < 0.0)
    if back.size:
        raise _NoPathError(
            f"the drive turns back {fine[kept[back[0] + 1]]:.1f} s after its start: a reference "
            "path goes one way"
        )
    return fine[kept], dense[kept]


def _recorded_speed(
    splines: tuple[BSpline, BSpline], at: Array, chain: Array, geometry: Geometry
) -> Array:
    """Speed (n,) m/s on the path's grid, of points (m, 2) passed at times (m,)."""
    speed = np.hypot(*(spline.derivative()(at) for spline in splines))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(chain, axis=0).T))])
    along *= geometry.arc_length[-1] / along[-1]  # chords are shorter than their arcs
    interpolated: Array = np.interp(geometry.arc_length, along, np.maximum(speed, LEAST_SPEED))
    return interpolated


def _oddities(geometry: Geometry, limits: SpeedLimits) -> list[str]:
    """What is accepted but should be known."""
    told = []
    curvature = np.abs(geometry.curvature)
    sharpest = int(np.argmax(curvature))
    steerable = math.tan(MAX_STEERING_ANGLE) / limits.wheelbase
    if curvature[sharpest] > steerable:
        told.append(
            f"curvature {curvature[sharpest]:.3f} 1/m at {geometry.arc_length[sharpest]:.1f} m is "
            f"beyond the {steerable:.3f} 1/m that a wheelbase of {limits.wheelbase:g} m can steer: "
            "more smoothing may help"
        )
    near = self_approach(geometry, closed=False)
    if near is not None:
        told.append(
            f"the path comes within {near[2]:.2f} m of itself, at {near[0]:.1f} m and "
            f"{near[1]:.1f} m: project with the last arc length at hand"
        )
    return told
