"""Path geometry: the segment language, parametric curves, kinked polylines.

A path is one readable line: straights in metres, turns in degrees with their apex radius in metres,
optionally the length of the transitions and the share of lateral acceleration that the turn uses::

    S 45 | L 90 r11 | S 40 | R 60 r20 t15 a0.8

A turn's curvature is a Bloss ramp (3u^2 - 2u^3), an arc and a Bloss ramp, so curvature is
continuously differentiable and its integral, the heading, has a closed form. Arc length is the
parameter, so lengths are exact; positions are Gauss-Legendre quadratures of the tangent.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories.path import SPACING
from trajectories.speed import SpeedLimits

Array = NDArray[np.float64]
Derivatives: TypeAlias = tuple[Array, Array, Array, Array, Array, Array]
"""x, y, their first and their second derivatives, each (n,)."""

TRANSITION_RATE_SHARE = 1.0
_SEGMENT = re.compile(
    r"^(?:S\s*(?P<straight>[\d.]+)"
    r"|(?P<side>[LR])\s*(?P<angle>[\d.]+)\s+r\s*(?P<radius>[\d.]+)"
    r"(?:\s+t\s*(?P<transition>[\d.]+))?(?:\s+a\s*(?P<share>[\d.]+))?)$"
)
# Abscissae and weights of 5-point Gauss-Legendre quadrature on [0, 1].
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


class Geometry(NamedTuple):
    """A path without speed: (n,) arrays on a uniform grid of arc length, and each turn's share."""

    arc_length: Array
    x: Array
    y: Array
    heading: Array
    curvature: Array
    share: Array


@dataclass(frozen=True)
class Segment:
    """A straight (turn 0) of some length (m), or a turn of some angle (rad, left positive)."""

    length: float = 0.0
    turn: float = 0.0
    radius: float = math.inf
    transition: float | None = None
    share: float = 1.0


def parse(text: str) -> list[Segment]:
    """Read the segment language.

    Raises
    ------
    ValueError
        Naming the segment that cannot be read, or a number that is not positive.
    """
    segments = []
    for position, part in enumerate(text.split("|"), start=1):
        match = _SEGMENT.match(part.strip())
        if match is None:
            raise ValueError(
                f"segment {position} ({part.strip()!r}) is not 'S metres' or "
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
            raise ValueError(f"segment {position} ({part.strip()!r}): numbers must be positive")
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

    Transitions that were not given become as long as the steering rate needs at the turn's speed:
    a Bloss ramp of curvature kappa and length t has its steepest slope 1.5 kappa/t halfway.

    Raises
    ------
    ValueError
        If the turns alone are longer than the length asked for, or there is nothing to scale.
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
    """Uniform arc length from 0 to `length`, as near to `spacing` as fits."""
    return np.linspace(0.0, length, max(round(length / spacing), 3) + 1)


def build(segments: Sequence[Segment]) -> Geometry:
    """Geometry of fitted segments (every turn with its length and transition), from the origin.

    Raises
    ------
    ValueError
        Naming a segment without a length: a turn that did not go through `fit`.
    """
    for position, segment in enumerate(segments, start=1):
        if segment.length <= 0.0:
            raise ValueError(f"segment {position} has no length: turns get theirs from fit()")
    if not segments:
        raise ValueError("no segments")
    # Pieces of curvature: start, length, curvature at both ends, heading at the start.
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
    """Positions (n,) on a grid s (n,) from a heading function, starting at the origin."""
    steps = np.diff(s)
    inner = heading((s[:-1, None] + steps[:, None] * _NODES).ravel()).reshape(-1, len(_NODES))
    x = np.concatenate([[0.0], np.cumsum((np.cos(inner) @ _WEIGHTS) * steps)])
    y = np.concatenate([[0.0], np.cumsum((np.sin(inner) @ _WEIGHTS) * steps)])
    return x, y


def parametric(
    curve: Callable[[Array], Derivatives],
    end: float,
    *,
    pieces: int = 20_000,
) -> Geometry:
    """Geometry of a smooth curve over its parameter t in [0, end].

    `curve(t)` returns x, y and their first and second derivatives. Arc length is a Gauss-Legendre
    quadrature of |r'|, inverted by Newton's method; heading and curvature are the analytic ones.
    """
    knots = np.linspace(0.0, end, pieces + 1)
    steps = np.diff(knots)

    def speed(t: Array) -> Array:
        _, _, dx, dy, _, _ = curve(t)
        return np.hypot(dx, dy)

    inner = speed((knots[:-1, None] + steps[:, None] * _NODES).ravel()).reshape(-1, len(_NODES))
    lengths = np.concatenate([[0.0], np.cumsum((inner @ _WEIGHTS) * steps)])
    s = grid(float(lengths[-1]))
    index = (np.searchsorted(lengths, s, side="right") - 1).clip(0, pieces - 1)
    t = knots[index] + (s - lengths[index]) / speed(knots[index])
    for _ in range(3):
        span = t - knots[index]
        partial = speed((knots[index][:, None] + span[:, None] * _NODES).ravel())
        reached = lengths[index] + (partial.reshape(-1, len(_NODES)) @ _WEIGHTS) * span
        t = t + (s - reached) / speed(t)
    x, y, dx, dy, ddx, ddy = curve(t)
    heading = np.unwrap(np.arctan2(dy, dx))
    curvature = (dx * ddy - dy * ddx) / (dx * dx + dy * dy) ** 1.5
    return Geometry(s, x, y, heading, curvature, np.ones_like(s))


def polyline(kinks: Sequence[float], lengths: ArrayLike) -> tuple[Array, Array]:
    """Waypoints on straight legs joined by kinks (rad), legs given in whole steps of a grid.

    `lengths` has one leg more than `kinks`; each leg must be a multiple of the step it was counted
    in, so waypoints are the cumulative sum of unit steps.
    """
    headings = np.concatenate([[0.0], np.cumsum(kinks)])
    counts = np.asarray(lengths, dtype=int)
    steps = np.repeat(headings, counts)
    x = np.concatenate([[0.0], np.cumsum(np.cos(steps))])
    y = np.concatenate([[0.0], np.cumsum(np.sin(steps))])
    return x, y
