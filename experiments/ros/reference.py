"""Reference path from a recorded drive: smoothed positions of odometry or of fixes.

Smoothing splines over time remove noise from x and y, by generalised cross-validation (Craven and
Wahba, 1979) or to a given tolerance. The splines are resampled by distance, which removes
standstill, and become a path at 0.25 m of arc length, with heading and curvature from a spline's
derivatives. The speed is that of the smoothing splines, or planned.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_smoothing_spline

from experiments.ros.read import BagError, Reading, info, read
from experiments.ros.topics import Datum, Fixes, GeoPoint, Odometry
from trajectories.oddities import oddities
from trajectories.path import ReferencePath
from trajectories.shapes import Geometry, from_geometry, smooth
from trajectories.smoothing import chord_lengths, largest_penalty
from trajectories.speed import SpeedLimits

Array = NDArray[np.float64]

BIN = 0.1
"""Bin width for averaging positions before smoothing, s; validation takes 1 ms per position."""
SPACING = 0.5
"""Distance between resampled points, m; standstill leaves one point."""
SHAPE_TOLERANCE, SHAPE_SHARE = 3e-4, 0.05
"""Allowed rms distance of the path from the smoothed points: m, and as a share of the noise. An
interpolating path would keep ripples of up to 0.1 1/m in curvature (noise of 5 cm, 10 Hz)."""
LEAST_SPEED = 0.5
"""Lower bound on a reference's speed, m/s."""
OUTLIER, LEAST_OUTLIER = 6.0, 0.1
"""Positions are outliers if farther off than this many standard deviations, and this many m."""
OUTLIER_ROUNDS = 8
"""Largest number of rounds of leaving out outliers and smoothing again."""
FEWEST_POSITIONS, SHORTEST = 8, 5.0
"""Smallest number of positions, and smallest length, m, of a path."""
LONGEST_GAP = 2.0
"""Longest time without a position before a warning, s."""
PENALTIES = (-12.0, 8.0)
"""Powers of ten between which the smoothing penalty is bisected."""


@dataclass(frozen=True)
class DrivenLine:
    """Path of a drive, and statistics of its positions."""

    path: ReferencePath
    topic: str
    positions: int
    deviation_rms: float
    deviation_max: float
    """Distances of the recorded positions from the splines at the same time, m."""
    warnings: list[str] = field(default_factory=list)


def reference(
    file: Path,
    *,
    source: str | None = None,
    topic: str | None = None,
    datum: GeoPoint | None = None,
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
        "odometry" or "fix"; by default odometry if there is any.
    topic
        The topic's name, required if the bag has several of the kind.
    datum
        Origin for fixes; by default the bag's own (geographic_msgs/GeoPointStamped), else the first
        fix.
    smoothing
        Rms distance of the positions from the smoothed ones, m; by default cross-validated.
    limits
        Limits of a planned speed; by default the recorded speed, at least 0.5 m/s.
    name
        The path's name, by default the bag's.

    Raises
    ------
    BagError
        If the bag cannot be read, or its drive is too short or turns back.
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


def datum_of(file: Path, fixes: Fixes) -> GeoPoint:
    """Return the datum in a bag, else its first fix."""
    if info(file).of_kind(Datum):
        return read(file, Datum).data.last
    height = float(fixes.height[0])
    return (
        float(fixes.latitude[0]), float(fixes.longitude[0]), 0.0 if math.isnan(height) else height
    )  # fmt: skip


class _NoPathError(ValueError):
    """Positions that cannot become a path."""


def _line(
    reading: Reading[Any],
    points: Array,
    smoothing: float | None,
    limits: SpeedLimits | None,
    name: str,
    metadata: dict[str, Any],
) -> DrivenLine:
    """Make a path of positions (n, 2) and complete its metadata."""
    warnings: list[str] = []
    time, means = _averaged(reading.data.time, points)
    if len(time) < FEWEST_POSITIONS:
        raise _NoPathError(f"{len(time)} positions over time, {FEWEST_POSITIONS} are needed")
    gap = int(np.argmax(np.diff(time)))
    if time[gap + 1] - time[gap] > LONGEST_GAP:
        warnings.append(
            f"no positions for {time[gap + 1] - time[gap]:.1f} s from {time[gap]:.1f} s on: bridged"
        )
    centre = means.mean(axis=0)  # coordinates in a map's grid are large and would lose digits
    means -= centre
    splines, kept = _robust(time, means, smoothing)
    if not kept.all():
        warnings.append(f"{int((~kept).sum())} positions lie far off the others: left out")
    distance = _distances(splines, time[kept], means[kept])
    noise = float(np.sqrt(np.mean(distance**2)))
    at, chain = _resampled(splines, time)
    shape = smooth(chain + centre, max(SHAPE_TOLERANCE, SHAPE_SHARE * noise))
    warnings.extend(oddities(shape.geometry, closed=False, spacing=SPACING))
    metadata.update(
        smoothing="cross-validated" if smoothing is None else smoothing,
        rms_deviation=noise, max_deviation=float(distance.max()),
        positions=len(points), outliers=int((~kept).sum()), duplicates=reading.duplicates,
        out_of_order=reading.out_of_order, unusable=reading.unusable, warnings=warnings,
    )  # fmt: skip
    try:
        if limits is not None:
            path = from_geometry(shape.geometry, limits, name, **metadata)
        else:
            path = ReferencePath(
                *shape.geometry[:5], name=name, metadata={**metadata, "speed": "as recorded"},
                speed=_recorded_speed(splines, at, chain, shape.geometry),
            )  # fmt: skip
    except RuntimeError as error:  # the linear program found no profile
        raise _NoPathError(str(error)) from error
    return DrivenLine(path, reading.topic, len(points), noise, float(distance.max()), warnings)


def _averaged(time: Array, points: Array) -> tuple[Array, Array]:
    """Return mean times (m,) and positions (m, 2) of the bins of time that are not empty."""
    cell = np.floor(time / BIN + 1e-6).astype(np.int64)
    _, group = np.unique(cell, return_inverse=True)
    count = np.bincount(group)
    sums = (np.bincount(group, weights=values) for values in (time, *points.T))
    when, x, y = (total / count for total in sums)
    return when, np.column_stack([x, y])


def _robust(
    time: Array, points: Array, tolerance: float | None
) -> tuple[tuple[BSpline, BSpline], NDArray[np.bool_]]:
    """Return smoothing splines of points (m, 2) without outliers, and a mask (m,) of those kept."""
    kept = np.ones(len(time), dtype=np.bool_)
    for _ in range(OUTLIER_ROUNDS):
        splines = _smoothed(time[kept], points[kept], tolerance)
        distance = _distances(splines, time, points)
        # Median distance of white noise in the plane: 1.18 standard deviations of each axis.
        noise = float(np.median(distance[kept])) / 1.1774
        far = distance > max(OUTLIER * noise, LEAST_OUTLIER)
        if (far == ~kept).all():
            break
        kept = ~far
    return splines, kept


def _distances(splines: tuple[BSpline, BSpline], time: Array, points: Array) -> Array:
    """Return the distances (m,) of points (m, 2) from the splines at their times."""
    x, y = (spline(time) for spline in splines)
    distances: Array = np.hypot(x - points[:, 0], y - points[:, 1])
    return distances


def _smoothed(time: Array, points: Array, tolerance: float | None) -> tuple[BSpline, BSpline]:
    """Return smoothing splines of points (m, 2), cross-validated or to an rms distance, m."""
    if tolerance is None:
        # A constant coordinate (a straight to the east or north) leaves nothing to validate.
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

    return largest_penalty(fit, tolerance, PENALTIES)


def _resampled(splines: tuple[BSpline, BSpline], time: Array) -> tuple[Array, Array]:
    """Return times (m,) and points (m, 2) along the splines, `SPACING` apart."""
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
    """Return the speed (n,), m/s, on the path's grid from points (m, 2) passed at times (m,)."""
    speed = np.hypot(*(spline.derivative()(at) for spline in splines))
    along = chord_lengths(chain)
    along *= geometry.arc_length[-1] / along[-1]  # chords are shorter than arcs
    interpolated: Array = np.interp(geometry.arc_length, along, np.maximum(speed, LEAST_SPEED))
    return interpolated
