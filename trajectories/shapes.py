"""Path geometry from segments, from parametric curves, and from measured points.

Segments are written in one readable line: straights in metres, turns in degrees with their apex
radius in metres, optionally the length of their transitions (m) and the share of the lateral
acceleration that the turn uses::

    S 45 | L 90 r11 | S 40 | R 60 r20 t15 a0.8

A turn's curvature is a Bloss ramp (3u^2 - 2u^3), an arc and a Bloss ramp, so curvature is
continuously differentiable and its integral, the heading, has a closed form. Arc length is the
parameter, so lengths are exact; positions are Gauss-Legendre quadratures of the tangent.

Measured points become a smoothing spline, see `trajectories.smoothing`; closed curves are exactly
periodic.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories import plan_cache, smoothing
from trajectories.arguments import Number, shown
from trajectories.path import SPACING, ReferencePath
from trajectories.smoothing import ABSCISSAE, WEIGHTS, chord_lengths
from trajectories.speed import SpeedLimits, plan_speed

Array = NDArray[np.float64]
Derivatives: TypeAlias = tuple[Array, Array, Array, Array, Array, Array]
"""x, y, their first and their second derivatives, each (n,)."""

LENGTHS = Number(0.0, 30_000.0, "m")
"""Rule of a path's length: planning the speed of the longest takes a minute."""
LEAST_LEFT = 0.5
"""Least length of a smoothed curve as a share of the diagonal of the box around its points."""
TURN, MANY_NODES = 0.1, 8000
"""Largest turn from node to node of a smoothed curve, rad: on the tracks of small cars the spacing
is below `SPACING` for it, but not with more nodes than this number."""

_SEGMENT = re.compile(
    r"^(?:S\s*(?P<straight>[\d.]+)"
    r"|(?P<side>[LR])\s*(?P<angle>[\d.]+)\s+r\s*(?P<radius>[\d.]+)"
    r"(?:\s+t\s*(?P<transition>[\d.]+))?(?:\s+a\s*(?P<share>[\d.]+))?)$"
)


class Geometry(NamedTuple):
    """A path without speed: (n,) arrays on a uniform grid of arc length.

    `share` is the share of the lateral acceleration limit that the speed may use at a point.
    """

    arc_length: Array
    x: Array
    y: Array
    heading: Array
    curvature: Array
    share: Array


@dataclass(frozen=True)
class Segment:
    """A straight (`turn` 0) with a length (m), or a turn by an angle (rad, left positive)."""

    length: float = 0.0
    turn: float = 0.0
    radius: float = math.inf
    transition: float | None = None
    share: float = 1.0


def parse(text: str) -> list[Segment]:
    """Read segments from text; see the module for its language.

    Raises
    ------
    ValueError
        If a segment cannot be read or has a number that is not positive; the segment is named.
    """
    segments = []
    for position, part in enumerate(text.split("|"), start=1):
        match = _SEGMENT.match(part.strip())
        if match is None:
            raise ValueError(
                f"segment {position} ({shown(part.strip())}) is not 'S metres' or "
                "'L|R degrees r metres [t metres] [a share]'"
            )
        try:
            numbers = {
                key: float(value)
                for key, value in match.groupdict().items()
                if value is not None and key != "side"
            }
        except ValueError:
            numbers = {"bad": 0.0}
        if min(numbers.values()) <= 0:
            raise ValueError(
                f"segment {position} ({shown(part.strip())}): numbers must be positive"
            )
        if "straight" in numbers:
            segments.append(Segment(length=numbers["straight"]))
            continue
        sign = 1.0 if match["side"] == "L" else -1.0
        segments.append(
            Segment(
                turn=sign * math.radians(numbers["angle"]),
                radius=numbers["radius"],
                transition=numbers.get("transition"),
                share=numbers.get("share", 1.0),
            )
        )
    return segments


def fit(
    segments: Sequence[Segment],
    limits: SpeedLimits,
    length: float | None = None,
    total_turning: float | None = None,
) -> list[Segment]:
    """Scale all turn angles to a total turning (rad) and all straights to a total length (m).

    Transitions without a length get the one that the steering rate needs at the turn's speed: a
    Bloss ramp of curvature kappa and length t has its steepest slope 1.5 kappa/t halfway.

    Raises
    ------
    ValueError
        If the turns alone are longer than `length`, or there is nothing to scale.
    """
    turning = sum(abs(segment.turn) for segment in segments)
    if total_turning is not None and turning == 0.0:
        raise ValueError("no turns to scale to a total turning")
    scale = 1.0 if total_turning is None else total_turning / turning
    fitted = []
    for segment in segments:
        if segment.turn == 0.0:
            fitted.append(segment)
            continue
        turn, kappa = segment.turn * scale, 1.0 / segment.radius
        speed = min(
            limits.max_speed, math.sqrt(segment.share * limits.max_lateral_acceleration / kappa)
        )
        bend = limits.wheelbase * kappa
        needed = 1.5 * bend * speed / (limits.max_steering_rate * (1.0 + (0.5 * bend) ** 2))
        transition = segment.transition if segment.transition is not None else needed
        transition = min(transition, abs(turn) / kappa)
        arc = abs(turn) / kappa + transition
        fitted.append(replace(segment, turn=turn, transition=transition, length=arc))
    if length is not None:
        straights = sum(segment.length for segment in fitted if segment.turn == 0.0)
        turns = sum(segment.length for segment in fitted if segment.turn != 0.0)
        if straights <= 0 or turns >= length:
            raise ValueError(
                f"turns take {turns:.1f} m: no straights are left in a length of {length:.1f} m"
            )
        stretch = (length - turns) / straights
        fitted = [
            replace(segment, length=segment.length * stretch) if segment.turn == 0.0 else segment
            for segment in fitted
        ]
    return fitted


def grid(length: float, spacing: float = SPACING) -> Array:
    """Uniform arc lengths from 0 to `length`, with a spacing as near to `spacing` as fits."""
    return np.linspace(0.0, length, max(round(LENGTHS.of("length", length) / spacing), 3) + 1)


def build(segments: Sequence[Segment]) -> Geometry:
    """Compute the geometry of segments from `fit`, starting at the origin along x.

    Raises
    ------
    ValueError
        If a segment has no length, as turns have none before `fit`.
    """
    for position, segment in enumerate(segments, start=1):
        if segment.length <= 0.0:
            raise ValueError(f"segment {position} has no length: turns get theirs from fit()")
    if not segments:
        raise ValueError("no segments")
    # Pieces of curvature: start, length, curvature at both ends, heading at the start, share.
    pieces: list[tuple[float, float, float, float, float, float]] = []
    start = heading = 0.0
    for segment in segments:
        if segment.turn == 0.0:
            parts = [(segment.length, 0.0, 0.0)]
        else:
            kappa = math.copysign(1.0 / segment.radius, segment.turn)
            ramp = segment.transition or 0.0
            parts = [
                (ramp, 0.0, kappa),
                (segment.length - 2 * ramp, kappa, kappa),
                (ramp, kappa, 0.0),
            ]
        for length, first, last in parts:
            if length <= 0.0:
                continue
            pieces.append((start, length, first, last, heading, segment.share))
            start += length
            heading += 0.5 * (first + last) * length
    table = np.array(pieces)

    def evaluate(s: Array) -> tuple[Array, Array, Array]:
        rows = table[np.searchsorted(table[:, 0], s, side="right").clip(1) - 1]
        begin, extent, first, last, before, share = rows.T
        u = ((s - begin) / extent).clip(0.0, 1.0)
        curvature = first + (last - first) * u * u * (3.0 - 2.0 * u)
        turned = extent * (first * u + (last - first) * u**3 * (1.0 - 0.5 * u))
        return curvature, before + turned, share

    s = grid(start)
    curvature, headings, share = evaluate(s)
    x, y = integrate(lambda at: evaluate(at)[1], s)
    return Geometry(s, x, y, headings, curvature, share)


def integrate(heading: Callable[[Array], Array], s: Array) -> tuple[Array, Array]:
    """Integrate a heading function to positions x, y on a grid s, each (n,), from the origin."""
    steps = np.diff(s)
    inner = heading((s[:-1, None] + steps[:, None] * ABSCISSAE).ravel()).reshape(-1, len(ABSCISSAE))
    x = np.concatenate([[0.0], np.cumsum((np.cos(inner) @ WEIGHTS) * steps)])
    y = np.concatenate([[0.0], np.cumsum((np.sin(inner) @ WEIGHTS) * steps)])
    return x, y


def parametric(
    curve: Callable[[Array], Derivatives],
    end: float,
    *,
    pieces: int = 20_000,
    velocity: Callable[[Array], Array] | None = None,
    turn: float = math.inf,
) -> Geometry:
    """Compute the geometry of a smooth curve over its parameter t in [0, end].

    Arc length is a Gauss-Legendre quadrature of |r'|, inverted by Newton's method; heading and
    curvature are analytic.

    Parameters
    ----------
    curve
        Function of t (n,) that returns x, y and their first and second derivatives, each (n,).
    end
        Last t.
    pieces
        Number of pieces of the quadrature.
    velocity
        Function of t (n,) that returns the first derivatives (2, n) alone, where that is quicker.
    turn
        rad: largest turn between two nodes, up to `MANY_NODES`.
    """
    knots = np.linspace(0.0, end, pieces + 1)
    steps = np.diff(knots)

    def speed(t: Array) -> Array:
        dx, dy = curve(t)[2:4] if velocity is None else velocity(t)
        return np.hypot(dx, dy)

    inner = speed((knots[:-1, None] + steps[:, None] * ABSCISSAE).ravel()).reshape(
        -1, len(ABSCISSAE)
    )
    lengths = np.concatenate([[0.0], np.cumsum((inner @ WEIGHTS) * steps)])
    s = grid(float(lengths[-1]))
    if turn < math.inf:
        sharpest = float(np.abs(_curvature(*curve(knots)[2:])).max())
        finest = min(SPACING, float(lengths[-1]) / MANY_NODES)
        s = grid(float(lengths[-1]), max(min(SPACING, turn / max(sharpest, 1e-9)), finest))
    index = (np.searchsorted(lengths, s, side="right") - 1).clip(0, pieces - 1)
    t = knots[index] + (s - lengths[index]) / speed(knots[index])
    for _ in range(3):
        span = t - knots[index]
        partial = speed((knots[index][:, None] + span[:, None] * ABSCISSAE).ravel())
        reached = lengths[index] + (partial.reshape(-1, len(ABSCISSAE)) @ WEIGHTS) * span
        t = t + (s - reached) / speed(t)
    x, y, dx, dy, ddx, ddy = curve(t)
    heading = np.unwrap(np.arctan2(dy, dx))
    return Geometry(s, x, y, heading, _curvature(dx, dy, ddx, ddy), np.ones_like(s))


def _curvature(dx: Array, dy: Array, ddx: Array, ddy: Array) -> Array:
    curvature: Array = (dx * ddy - dy * ddx) / (dx * dx + dy * dy) ** 1.5
    return curvature


def polyline(kinks: Sequence[float], lengths: ArrayLike) -> tuple[Array, Array]:
    """Compute waypoints x, y, one unit apart, on straight legs joined by kinks (rad).

    `lengths` are the legs' numbers of steps, one leg more than `kinks`.
    """
    headings = np.concatenate([[0.0], np.cumsum(kinks)])
    counts = np.asarray(lengths, dtype=int)
    steps = np.repeat(headings, counts)
    x = np.concatenate([[0.0], np.cumsum(np.cos(steps))])
    y = np.concatenate([[0.0], np.cumsum(np.sin(steps))])
    return x, y


class Smoothed(NamedTuple):
    """A curve's geometry, and its distances from the points that it was fitted to, m.

    `places` are the arc lengths of the points, (n,) m; the first is again the last if closed.
    """

    geometry: Geometry
    max_deviation: float
    rms_deviation: float
    places: Array


def smooth(points: Array, tolerance: float, *, closed: bool = False) -> Smoothed:
    """Fit the smoothest curve that stays near points, and compute its geometry.

    The curve leaves the points by at most `tolerance` in the root mean square, and no point by more
    than about `smoothing.REACH` (3) times that, see `smoothing.smoothing_spline`. More smoothing
    does not sharpen bends: of five racing circuits, whose points are 5 m apart, the largest
    curvatures fall from 0.116, 0.085, 0.117, 0.162 and 0.059 1/m at 0 to 0.094, 0.059, 0.099, 0.114
    and 0.055 at 0.05 m, and to 0.078, 0.052, 0.090, 0.093 and 0.053 at 0.2 m. A hairpin of 8 m
    radius between straights of 1500 m has 0.149, 0.132, 0.130, 0.126 and 0.120 1/m at 0, 0.05, 0.1,
    0.2 and 0.5 m. From GPS positions 5 m apart with normal errors of 0.2 m on each axis, 0.2 m
    makes a curve that is 0.16 m (rms) from the road, 0.090 1/m at most where the road has 0.083;
    errors of 0.5 m and 1 m need 0.5 m and 1 m of smoothing for 0.088 and 0.096 1/m.

    Parameters
    ----------
    points
        (n, 2), m; a closed curve's first point is not repeated at the end.
    tolerance
        m; 0 interpolates with a cubic spline.
    closed
        Whether the curve goes on from the last point to the first.

    Raises
    ------
    ValueError
        If the tolerance is so large that little is left of the curve.
    """
    points = np.ascontiguousarray(points)
    content = (points.tobytes(), repr((float(tolerance), bool(closed), SPACING)).encode())
    sources = (__file__, smoothing.__file__)
    packed = plan_cache.computed(
        sources, content, lambda: _packed(_smoothed(points, tolerance, closed=closed))
    )
    count, (length, largest, rms) = int(packed[0]), packed[1:4].tolist()
    x, y, heading, curvature = packed[4 : 4 + 4 * count].reshape(4, count)
    s = np.linspace(0.0, length, count)
    geometry = Geometry(s, x, y, heading, curvature, np.ones(count))
    return Smoothed(geometry, largest, rms, packed[4 + 4 * count :])


def _packed(smoothed: Smoothed) -> Array:
    """Return all numbers of a smoothed curve in one row."""
    geometry, *deviations, places = smoothed
    ends = [len(geometry.x), geometry.arc_length[-1], *deviations]
    return np.concatenate([ends, *geometry[1:5], places])


def _smoothed(points: Array, tolerance: float, *, closed: bool) -> Smoothed:
    """Compute the result of `smooth`."""
    from scipy.interpolate import make_interp_spline

    chain = np.vstack([points, points[:1]]) if closed else points
    if tolerance > 0.0:
        spline, at = smoothing.smoothing_spline(points, tolerance, closed=closed)
    else:
        at = chord_lengths(chain)
        spline = make_interp_spline(at, chain, k=3, bc_type="periodic" if closed else None)
    across = math.hypot(*np.ptp(points, axis=0))
    if at[-1] < LEAST_LEFT * across:
        raise ValueError(
            f"a smoothing of {tolerance:g} m leaves {at[-1]:.3g} m of a path that is "
            f"{across:.4g} m across: take less"
        )
    deviation = np.hypot(*(spline(at[: len(points)]) - points).T)
    first, second = spline.derivative(), spline.derivative(2)

    def curve(t: Array) -> Derivatives:
        r, dr, ddr = spline(t).T, first(t).T, second(t).T
        return r[0], r[1], dr[0], dr[1], ddr[0], ddr[1]

    end = float(at[-1])
    geometry = parametric(curve, end, velocity=lambda t: first(t).T, turn=TURN)
    return Smoothed(
        geometry, float(deviation.max()), float(np.sqrt(np.mean(deviation**2))),
        _arc_lengths(first, at, geometry.arc_length),
    )  # fmt: skip


def _arc_lengths(velocity: Callable[[Array], Array], at: Array, s: Array) -> Array:
    """Return the arc lengths (n,) at parameters (n,) of a curve whose nodes have arc lengths s."""
    t = np.linspace(0.0, at[-1], len(s))
    speed = np.hypot(*velocity(t).T)
    lengths = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    places: Array = np.interp(at, t, lengths * (s[-1] / lengths[-1]))
    return places


def from_geometry(
    geometry: Geometry,
    limits: SpeedLimits,
    name: str,
    *,
    closed: bool = False,
    **metadata: object,
) -> ReferencePath:
    """Make a path from a geometry and the jerk-limited speed profile that the limits allow."""
    spacing = float(geometry.arc_length[1])
    speed = plan_speed(geometry.curvature, spacing, limits, closed=closed, share=geometry.share)
    return ReferencePath(
        *geometry[:5], speed=speed, name=name, closed=closed,
        metadata={"limits": asdict(limits), **metadata},
    )  # fmt: skip
