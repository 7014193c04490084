"""Random paths by a seed: for training, at a known share of grip, and closed ones for laps."""

import math
from itertools import count

import numpy as np

from trajectories import shapes
from trajectories.arguments import Whole, flag
from trajectories.path import ReferencePath
from trajectories.speed import GRAVITY, SpeedLimits

GENERATOR = "segments/1"
SEED = Whole(0, 2**128 - 1)
"""Rule of the seed of a random path."""
GRIPS = tuple(round(0.5 + 0.05 * step, 2) for step in range(10))
"""Lateral accelerations of limit paths as shares of g; the seed's last digit chooses one."""

CIRCUIT_LENGTHS = (500.0, 900.0)
CIRCUIT_RADII = (12.0, 60.0)
CIRCUIT_ANGLES = tuple(math.radians(angle) for angle in (12.0, 140.0))
"""Least and largest change of heading in a turn of a circuit, rad."""
STRAIGHT = 5.0
"""Shortest straight of a circuit, m."""
APART = 15.0
"""Least distance of different parts of a circuit, m."""
SAME_PART = 45.0
"""m of arc length up to which points are of the same part: half a turn of the tightest turns."""

Range = tuple[float, float]


def random_path(
    seed: int | np.random.Generator, *, length: float | None = None, fast: bool = False
) -> ReferencePath:
    """Draw a drivable path for training: turns of 9 to 60 m radius between straights.

    The same seed gives the same path. Speed limits are drawn too: 6 to 14 m/s (`fast`: 10 to 18),
    1.0 to 2.0 m/s^2 laterally, 1.3 to 2.0 m/s^2 longitudinally. Straights are 8 to 120 m long
    (`fast`: 40 to 400). Unless given, `length` (m) is drawn from 300 to 600 (`fast`: 600 to 1000).

    Raises
    ------
    ValueError
        If `length` does not keep to `shapes.LENGTHS`, or the seed is no whole number.
    """
    alone = isinstance(seed, np.random.Generator)
    seed = seed if isinstance(seed, np.random.Generator) else SEED.of("seed", seed)
    fast = flag("fast", fast)
    rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(seed)
    kind = "random-fast" if fast else "random"
    speeds, straights, lengths = (
        ((10.0, 18.0), (40.0, 400.0), (600.0, 1000.0))
        if fast
        else ((6.0, 14.0), (8.0, 120.0), (300.0, 600.0))
    )
    limits = SpeedLimits(
        max_speed=float(rng.uniform(*speeds)),
        max_lateral_acceleration=float(rng.uniform(1.0, 2.0)),
        max_acceleration=float(rng.uniform(1.3, 2.0)),
    )
    wanted = float(rng.uniform(*lengths)) if length is None else shapes.LENGTHS.of("length", length)
    segments = _segments(rng, limits, wanted, (9.0, 60.0), straights)
    return shapes.from_geometry(
        shapes.build(segments), limits, kind if alone else f"{kind}-{seed}",
        source=f"{kind} segments" if alone else f"{kind} segments, seed {seed}",
        generator=GENERATOR,
    )  # fmt: skip


def limit_path(seed: int) -> ReferencePath:
    """Draw a path for drives at the limit of grip: turns of 12 to 80 m radius between straights.

    The seed's last digit sets the lateral acceleration, from 0.50 g (digit 0) to 0.95 g (digit 9)
    in steps of 0.05 g, so that ten seeds in a row cover the range evenly. Top speeds of 20 to
    30 m/s and straights of 20 to 200 m are drawn, lengths from 500 to 900 m. Accelerations of
    2 m/s^2, decelerations of 3 m/s^2 and a jerk of 4 m/s^3 are within the limits of every preset
    vehicle; together with the lateral acceleration they keep within the circle of the same grip.

    Raises
    ------
    ValueError
        If the seed is no whole number from 0 to 2^128 - 1.
    """
    seed, rng, grip, limits = _at_grip(seed)
    wanted = float(rng.uniform(500.0, 900.0))
    segments = _segments(rng, limits, wanted, (12.0, 80.0), (20.0, 200.0))
    return shapes.from_geometry(
        shapes.build(segments), limits, f"random-limit-{seed}",
        source=f"random-limit segments, seed {seed}", generator=GENERATOR, grip=grip,
    )  # fmt: skip


def circuit(seed: int) -> ReferencePath:
    """Draw a closed path of 500 to 900 m: turns of 12 to 60 m radius between straights.

    The turns round the corners of a polygon that is drawn about a point, so some lead to either
    side. Different parts of the path are at least `APART` from each other. It starts in the middle
    of its longest straight. Speed limits are those of `limit_path` for the same seed's last digit.

    Raises
    ------
    ValueError
        If the seed is no whole number from 0 to 2^128 - 1.
    """
    seed, rng, grip, limits = _at_grip(seed)
    geometry = next(found for _ in count() if (found := _closed(rng, limits)) is not None)
    return shapes.from_geometry(
        geometry, limits, f"circuit-{seed}", closed=True,
        source=f"circuit segments, seed {seed}", generator=GENERATOR, grip=grip,
    )  # fmt: skip


def _at_grip(seed: int) -> tuple[int, np.random.Generator, float, SpeedLimits]:
    """Return the seed, its generator, share of g and speed limits, which are drawn first."""
    seed = SEED.of("seed", seed)
    rng, grip = np.random.default_rng(seed), GRIPS[seed % len(GRIPS)]
    limits = SpeedLimits(
        max_speed=float(rng.uniform(20.0, 30.0)), max_lateral_acceleration=grip * GRAVITY,
        max_acceleration=2.0, max_deceleration=3.0, max_jerk=4.0, end_speed=10.0,
        max_total_acceleration=grip * GRAVITY,
    )  # fmt: skip
    return seed, rng, grip, limits


def _closed(rng: np.random.Generator, limits: SpeedLimits) -> shapes.Geometry | None:
    """Draw a polygon and round its corners; None if that does not make a circuit."""
    corners = int(rng.integers(8, 13))
    angles = 2.0 * math.pi * (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) / corners
    radii = rng.uniform(0.25, 1.0, corners)
    points = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    edges = np.roll(points, -1, axis=0) - points
    perimeter = 1.1 * float(rng.uniform(*CIRCUIT_LENGTHS))
    edges *= perimeter / np.hypot(*edges.T).sum()
    lengths, heading = np.hypot(*edges.T), np.arctan2(edges[:, 1], edges[:, 0])
    # Turn k leads from edge k - 1 to edge k.
    turning = np.angle(np.exp(1j * (heading - np.roll(heading, 1))))
    if not ((np.abs(turning) > CIRCUIT_ANGLES[0]) & (np.abs(turning) < CIRCUIT_ANGLES[1])).all():
        return None
    turns, tangents = [], np.zeros(corners)
    for k in range(corners):
        radius = float(np.exp(rng.uniform(*np.log(CIRCUIT_RADII))))
        room = 0.5 * (min(lengths[k - 1], lengths[k]) - STRAIGHT)
        while True:
            turn = shapes.fit([shapes.Segment(turn=float(turning[k]), radius=radius)], limits)[0]
            rounded = shapes.build([turn])
            tangents[k] = rounded.x[-1] - rounded.y[-1] / math.tan(turn.turn)
            if tangents[k] <= room:
                break
            radius *= 0.9
            if radius < CIRCUIT_RADII[0]:
                return None
        turns.append(turn)
    straights = lengths - tangents - np.roll(tangents, -1)
    segments: list[shapes.Segment] = []
    first = int(np.argmax(straights))
    for k in ((np.arange(corners) + first + 1) % corners).tolist():
        segments += [turns[k], shapes.Segment(length=float(straights[k]))]
    half = shapes.Segment(length=0.5 * float(straights[first]))
    geometry = shapes.build([half, *segments[:-1], half])
    shortest, longest = CIRCUIT_LENGTHS
    within = shortest <= geometry.arc_length[-1] <= longest
    return geometry if within and _apart(geometry) >= APART else None


def _apart(geometry: shapes.Geometry) -> float:
    """Return the least distance of points more than `SAME_PART` of a lap from each other, m."""
    every = slice(0, -1, 8)
    s, points = geometry.arc_length[every], np.column_stack([geometry.x, geometry.y])[every]
    along = np.abs(s[:, None] - s)
    along = np.minimum(along, geometry.arc_length[-1] - along)
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    return float(distances[along > SAME_PART].min())


def _segments(
    rng: np.random.Generator, limits: SpeedLimits, wanted: float, radii: Range, straights: Range
) -> list[shapes.Segment]:
    """Draw turns between straights, at least `wanted` (m) long, fitted to the limits."""
    segments = [shapes.Segment(length=float(rng.uniform(20.0, 50.0)))]
    planned = segments[0].length
    while planned < wanted:
        radius = float(np.exp(rng.uniform(np.log(radii[0]), np.log(radii[1]))))
        angle = math.radians(float(rng.uniform(20.0, 110.0 if radius > 12.0 else 95.0)))
        turn = shapes.Segment(turn=float(rng.choice([-1.0, 1.0])) * angle, radius=radius)
        straight = shapes.Segment(length=float(np.exp(rng.uniform(*np.log(straights)))))
        segments += [turn, straight]
        planned = sum(part.length for part in shapes.fit(segments, limits))
    return shapes.fit(segments, limits)
