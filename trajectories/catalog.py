"""Trajectories by name: the paper's six (drivable and raw), analytic shapes, random paths."""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trajectories import files, lane_changes, shapes
from trajectories.arguments import instance_of, shown
from trajectories.curvature import PathStatistics, signed_waypoint_curvature
from trajectories.import_options import ImportOptions
from trajectories.naming import suggestion
from trajectories.path import SPACING, ReferencePath
from trajectories.random_paths import GENERATOR, circuit, limit_path, random_path
from trajectories.speed import plan_speed
from trajectories.speed_limits import PlannedVehicle, SpeedLimits

Array = NDArray[np.float64]

KMH = 1.0 / 3.6
SEED_DIGITS = 40
"""Most digits of the seed of a random path."""


@dataclass(frozen=True)
class Published:
    """A trajectory of the paper: its published statistics, and this project's segments for them."""

    rows: PathStatistics
    segments: str


PUBLISHED: dict[str, Published] = {
    # kumar2025lpv, table of trajectories: largest speed, longitudinal and lateral acceleration
    # (m/s^2), length (m), largest and total curvature (1/m).
    # Campus blocks, a long fast straight, sharp turns.
    "T1": Published(
        PathStatistics(50.36 * KMH, 1.32, 1.10, 783.51, 1.81, 42.57),
        "S 45 | L 90 r11 | S 40 | R 90 r11 | S 215 | R 90 r13 | S 35 | R 45 r20 | S 25 | L 45 r20 "
        "| S 30 | L 90 r11 | S 45 | R 90 r11 | S 30 | L 70 r18 | S 35",
    ),
    # A quiet loop.
    "T2": Published(
        PathStatistics(28.05 * KMH, 2.01, 1.50, 513.17, 2.79, 24.49),
        "S 50 | R 90 r12 | S 60 | L 45 r30 | S 40 | L 90 r15 | S 60 | R 36 r40 | S 40 | R 90 r10 "
        "| S 60",
    ),
    # A chicane, a hairpin, sweepers.
    "T3": Published(
        PathStatistics(31.01 * KMH, 1.51, 1.89, 1033.47, 3.98, 44.35),
        "S 90 | L 90 r15 | S 70 | R 60 r20 | S 30 | L 60 r20 | S 110 | L 160 r12 | S 120 "
        "| R 90 r25 | S 60 | R 90 r14 | S 90 | L 85 r22 | S 70",
    ),
    # A slow grid of right angles.
    "T4": Published(
        PathStatistics(23.01 * KMH, 2.00, 1.20, 500.00, 4.00, 44.00),
        "S 45 | L 90 r10 | S 18 | R 90 r10 | S 30 | R 90 r10 | S 50 | L 90 r12 | S 25 | L 90 r10 "
        "| S 30 | R 90 r11 | S 20 | R 90 r15 | S 40",
    ),
    # A test track with prolonged bends.
    "T5": Published(
        PathStatistics(38.59 * KMH, 1.85, 1.56, 2119.60, 4.00, 45.00),
        "S 260 | L 190 r42 | S 180 | R 180 r38 | S 260 | R 75 r60 | S 130 | L 110 r30 | S 220 "
        "| R 90 r16 | S 240",
    ),
    # A ring road, prolonged bends at the lateral limit.
    "T6": Published(
        PathStatistics(28.12 * KMH, 1.86, 2.00, 1959.30, 2.00, 20.00),
        "S 380 | L 110 r27 | S 420 | L 60 r120 | S 250 | R 70 r26 | S 420 | L 46.5 r30 | S 250",
    ),
}  # fmt: skip
"""The paper's six trajectories; it published no paths, so the segments are this project's."""

ANALYTIC = (
    "straight", "circle", "figure-eight", "double-lane-change", "sine", "u-turn", "hairpins",
)  # fmt: skip
_FILE = re.compile(r"[/\\]|\.[A-Za-z]\w{1,7}$")
"""Mark of a file's name: a folder or a suffix."""
RANDOM = ("random", "random-fast", "random-limit", "circuit")
"""Kinds of random paths, named KIND-SEED."""
SHAPE_LIMITS = SpeedLimits(
    max_speed=10.0, max_lateral_acceleration=2.0, max_acceleration=1.5, end_speed=3.0
)
HAIRPIN_LIMITS = SpeedLimits(
    max_speed=28.0, max_lateral_acceleration=4.0, max_acceleration=2.0, max_deceleration=3.5,
    max_jerk=3.0, end_speed=28.0,
)  # fmt: skip
"""Limits of `hairpins`, which is entered and left at 28 m/s."""


def names() -> list[str]:
    """Names that `load` knows.

    It also loads each of `RANDOM` with any other SEED >= 0, and each of `lane_changes.NAMES` with
    any other WIDTH of a vehicle, m.
    """
    return [
        *PUBLISHED, *(f"{name}-raw" for name in PUBLISHED), *ANALYTIC,
        *(f"{kind}-1.8" for kind in lane_changes.NAMES), *(f"{kind}-0" for kind in RANDOM),
    ]  # fmt: skip


def load(
    trajectory: str | Path | ReferencePath,
    *,
    vehicle: PlannedVehicle | None = None,
    closed: bool | None = None,
    scale: float = 1.0,
    smoothing: float | None = None,
    minimum_distance: float | None = None,
    speeds: str | None = None,
    speed_unit: str | None = None,
    columns: Sequence[str] | None = None,
    part: str | None = None,
    origin: Sequence[float] | None = None,
    max_speed: float | None = None,
    max_lateral_acceleration: float | None = None,
    max_acceleration: float | None = None,
    limits: SpeedLimits | None = None,
    name: str | None = None,
) -> ReferencePath:
    """Load a path by its name or from a file of any format that `trajectories.files.read` reads.

    A `ReferencePath` is returned as it is. The options are those of
    `trajectories.import_options.ImportOptions`, and belong to files; a path that ships, or one that
    was made already, has its own speed whatever the vehicle.

    Raises
    ------
    ValueError
        For an unknown name (the message lists the known ones and the nearest), a bad file, an
        option that means nothing for what is loaded, or anything else, such as an array.
    """
    options = ImportOptions(
        vehicle, closed, scale, smoothing, minimum_distance, speeds, speed_unit, columns, part,
        origin, max_speed, max_lateral_acceleration, max_acceleration, limits, name,
    )  # fmt: skip
    words = "a name, a file or a ReferencePath (ReferencePath.from_waypoints makes one of an array)"
    instance_of("trajectory", trajectory, str | Path | ReferencePath, words)
    if not isinstance(trajectory, ReferencePath):
        if (path := _built_in(str(trajectory))) is None:
            return files.read(_file(trajectory), options)
        trajectory = path
    if given := options.given():
        raise ValueError(f"{given[0]} is an option of files, and {shown(trajectory.name)} is none")
    return trajectory


def is_file(trajectory: str | Path) -> bool:
    """Return whether `load` takes a text for a file's name."""
    return _built_in(str(trajectory)) is None


def _built_in(name: str) -> ReferencePath | None:
    """Return the path of a name that this project knows, None for any other."""
    if name in PUBLISHED:
        return _drivable(name)
    if name.endswith("-raw") and name[:-4] in PUBLISHED:
        return _raw(name[:-4])
    if (shape := _analytic(name) if name in ANALYTIC else _lane_change(name)) is not None:
        return shape
    kind, _, seed = name.rpartition("-")
    if kind in RANDOM and seed.isdecimal():
        if len(seed) > SEED_DIGITS:
            raise ValueError(f"trajectory {shown(name)}: a seed has at most {SEED_DIGITS} digits")
        return _random(kind, int(seed))
    return None


def _file(trajectory: str | Path) -> Path:
    """Return the file that is meant; raise a ValueError for a text that can only be a name."""
    name = str(trajectory)
    named = isinstance(trajectory, Path) or _FILE.search(name)
    if named or os.path.isfile(name):  # noqa: PTH113  Path's raises for long names
        return Path(name)
    known = suggestion(name, names(), " and others by their SEED or WIDTH")
    raise ValueError(f"unknown trajectory {shown(name)}; {known}, or give a .csv file")


_lane_change = lru_cache(maxsize=64)(lane_changes.load)


@lru_cache(maxsize=256)
def _random(kind: str, seed: int) -> ReferencePath:
    if kind == "random-limit":
        return limit_path(seed)
    if kind == "circuit":
        return circuit(seed)
    return random_path(seed, fast=kind == "random-fast")


def _limits(rows: PathStatistics) -> SpeedLimits:
    """Speed limits whose profile reaches the published statistics."""
    return SpeedLimits(
        max_speed=rows.max_speed,
        max_lateral_acceleration=rows.max_lateral_acceleration,
        max_acceleration=rows.max_acceleration,
    )


@cache
def _drivable(name: str) -> ReferencePath:
    published = PUBLISHED[name]
    limits = _limits(published.rows)
    segments = shapes.fit(
        shapes.parse(published.segments),
        limits,
        length=published.rows.length,
        total_turning=SPACING * published.rows.total_curvature,
    )
    return shapes.from_geometry(
        shapes.build(segments), limits, name,
        source="kumar2025lpv: published rows; segments by lpv-track-env",
        generator=GENERATOR, segments=published.segments, published=asdict(published.rows),
    )  # fmt: skip


def _kink_curvature(angle: float, spacing: float) -> tuple[float, float]:
    """Curvature at a kink by `signed_waypoint_curvature`, and summed with both neighbours, 1/m."""
    half = 0.5 * angle
    top = math.sin(half) / (spacing * math.cos(half) ** 2)
    return top, top + math.sin(angle) / (2.0 * spacing)


@cache
def _raw(name: str) -> ReferencePath:
    """Make kinked waypoints whose discrete curvature has both published maximum and total.

    Turns of the drivable path become kinks in their middle, none sharper than the angle whose
    curvature is the published maximum. The first kink of the sharpest turn has exactly that angle;
    all others are scaled by one factor that makes the sum of |kappa_i| the published total.
    """
    from scipy.optimize import brentq

    rows, drivable = PUBLISHED[name].rows, _drivable(name)
    counts = round(rows.length / SPACING)
    spacing = rows.length / counts
    sharpest = brentq(
        lambda d: _kink_curvature(d, spacing)[0] - rows.max_curvature, 1e-3, 0.9 * math.pi
    )
    turns, places = [], []
    turning = np.flatnonzero(np.abs(drivable.curvature) > 1e-9)
    for run in np.split(turning, np.flatnonzero(np.diff(turning) > 1) + 1):
        angle = float(drivable.heading[run[-1]] - drivable.heading[run[0]])
        parts = max(math.ceil(abs(angle) / (0.98 * sharpest)), 1)
        for part in range(parts):
            turns.append(angle / parts)
            places.append(run[0] + (part + 0.5) / parts * (run[-1] - run[0]))
    top = int(np.argmax(np.abs(turns)))

    def kinks(factor: float) -> list[float]:
        scaled = [factor * turn for turn in turns]
        scaled[top] = math.copysign(sharpest, turns[top])
        return scaled

    def excess(factor: float) -> float:
        total = sum(_kink_curvature(abs(kink), spacing)[1] for kink in kinks(factor))
        return total - rows.total_curvature

    angles = kinks(float(brentq(excess, 0.05, 1.02)))
    corners = [0, *np.rint(np.array(places)).astype(int), counts]
    x, y = shapes.polyline(angles, np.diff(corners))
    x, y = x * spacing, y * spacing
    return _kinked(x, y, spacing, name)


def _kinked(x: Array, y: Array, spacing: float, name: str) -> ReferencePath:
    """Make a raw path: heading and curvature by central differences, and a drivable speed."""
    rows = PUBLISHED[name].rows
    dx, dy = np.gradient(x), np.gradient(y)
    heading = np.unwrap(np.arctan2(dy, dx))
    # A vehicle smooths a kink by its own turning: spread it over 12 m by a Hann window.
    window = np.hanning(2 * round(6.0 / spacing) + 1)
    turning = np.gradient(heading, spacing)
    effective = np.convolve(turning, window / window.sum(), mode="same")
    limits = _limits(rows)
    return ReferencePath(
        arc_length=np.linspace(0.0, rows.length, len(x)),
        x=x, y=y, heading=heading, curvature=signed_waypoint_curvature(x, y),
        speed=plan_speed(effective, spacing, limits),
        name=f"{name}-raw",
        metadata={
            "source": f"kinked waypoints matching both curvature rows of {name} in kumar2025lpv",
            "generator": GENERATOR, "published": asdict(rows), "limits": asdict(limits),
            "warnings": [
                (
                    "curvature at the kinks is beyond every vehicle's: the speed follows the "
                    "turning averaged over 12 m, not the kinks"
                )
            ],
        },
    )  # fmt: skip


@cache
def _analytic(name: str) -> ReferencePath:
    closed, limits = False, SHAPE_LIMITS
    if name == "straight":
        geometry = shapes.build(shapes.parse("S 200"))
    elif name == "u-turn":
        segments = shapes.parse("S 40 | L 180 r10 | S 40")
        geometry = shapes.build(shapes.fit(segments, limits))
    elif name == "hairpins":
        limits = HAIRPIN_LIMITS
        segments = shapes.parse("S 250 | L 180 r12 | S 450 | R 180 r12 | S 250")
        geometry = shapes.build(shapes.fit(segments, limits))
    elif name == "circle":
        geometry, closed = shapes.parametric(_circle, 2.0 * math.pi), True
    elif name == "figure-eight":
        geometry, closed = shapes.parametric(_figure_eight, 2.0 * math.pi), True
    elif name == "sine":
        geometry = shapes.parametric(_sine, 160.0)
    else:
        geometry = shapes.parametric(_double_lane_change, 165.0)
    return shapes.from_geometry(geometry, limits, name, closed=closed, source=f"analytic: {name}")


def _circle(t: Array) -> shapes.Derivatives:
    radius = 30.0
    x, y = radius * np.sin(t), radius * (1.0 - np.cos(t))
    return x, y, radius * np.cos(t), radius * np.sin(t), -radius * np.sin(t), radius * np.cos(t)


def _figure_eight(t: Array) -> shapes.Derivatives:
    """Gerono's lemniscate, 88 m by 44 m, crossing itself at the origin.

    Its largest curvature, 0.109 1/m, is within the 0.115 1/m that a wheelbase of 5 m can steer.
    """
    a = 44.0
    x, y = a * np.sin(t), 0.5 * a * np.sin(2.0 * t)
    return x, y, a * np.cos(t), a * np.cos(2.0 * t), -x, -4.0 * y


def _sine(t: Array) -> shapes.Derivatives:
    """Sine with an amplitude of 2 m and a period of 40 m, 160 m long."""
    amplitude, k = 2.0, 2.0 * math.pi / 40.0
    sine, cosine = np.sin(k * t), np.cos(k * t)
    return (
        t, amplitude * sine, np.ones_like(t), amplitude * k * cosine,
        np.zeros_like(t), -amplitude * k * k * sine,
    )  # fmt: skip


def _double_lane_change(t: Array) -> shapes.Derivatives:
    """Centre line of the ISO 3888-1 course: 15 m, 30 m across, 25 m, 25 m back, then straight.

    The offset of 3.5 m is the standard's lane width; the ramps are quintic (smoothstep of second
    order), so curvature is continuous. A run-up of 20 m and a straight exit are added.
    """
    offset, up, down = 3.5, (35.0, 65.0), (90.0, 115.0)
    y, dy, ddy = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
    for (begin, end), sign in ((up, 1.0), (down, -1.0)):
        span = end - begin
        u = ((t - begin) / span).clip(0.0, 1.0)
        y += sign * offset * u**3 * (10.0 + u * (6.0 * u - 15.0))
        dy += sign * offset * 30.0 * u**2 * (1.0 - u) ** 2 / span
        ddy += sign * offset * 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / span**2
    return t, y, np.ones_like(t), dy, np.zeros_like(t), ddy
