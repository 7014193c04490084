"""Read paths from road maps: OpenDRIVE roads and lanes, and lanelets of CommonRoad scenarios.

Both are read from their XML trees. Packages that read OpenDRIVE are not kept up or bring hundreds
of megabytes; `commonroad-io` needs one old version of protobuf, which no other package allows.

OpenDRIVE (ASAM OpenDRIVE 1.4 to 1.8, sections on geometries and lanes): a road's reference line is
a chain of lines, arcs, spirals and cubic polynomials. Lines, arcs and spirals are a quadrature of
their heading; t, the offset of a lane, is to the left of the line.
"""

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from trajectories.arguments import shortened, shown
from trajectories.fileio import finite_number
from trajectories.pieces import MEETS, Piece, Pieces
from trajectories.raw_path import RawPath
from trajectories.shapes import LENGTHS, integrate
from trajectories.smoothing import chord_lengths
from trajectories.xml_tree import read_xml

Array = NDArray[np.float64]
Local: TypeAlias = tuple[Array, Array, Array]
"""Positions u, v (m) ahead and left of the start of a geometry, and headings (rad), each (n,)."""

STEP = 0.5
"""m: largest distance of points along a road."""
SHORTEST = 0.01
"""m: shorter geometries, which exporters leave at joints, are skipped."""
LONGEST_LANELET_STEP = 5.0
"""m: longer straight parts of a lanelet get points between."""
LENGTH_TOLERANCE = 0.1
"""Largest relative difference between the length of a parametric curve and the stated one."""
MOST_GEO_REFERENCE = 1000
"""Most characters of a geoReference that are kept."""

_LANE = re.compile(r"-?\d{1,9}")


class Frame(NamedTuple):
    """Points of a reference line, each (n,): arc length s (m), x, y (m), heading (rad)."""

    s: Array
    x: Array
    y: Array
    heading: Array


class _Map:
    """The tree of a map, with messages that begin with the file's name."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.root = read_xml(file)

    def refuse(self, message: str) -> ValueError:
        """Return an error that begins with the file's name."""
        return ValueError(f"{shortened(self.file)}: {message}")

    def number(self, text: str | None, what: str) -> float:
        """Return a finite number."""
        return finite_number(text, self.file, what)

    def attribute(self, element: Element, key: str, what: str) -> float:
        """Return a number in an attribute."""
        return self.number(element.get(key), f"{what}: {key} of {element.tag}")


# --- OpenDRIVE ---


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is refused
def read_opendrive(file: Path, part: str | None = None) -> RawPath:
    """Read the reference line of a road, by default the longest, or the centre of a lane.

    Parts are named by the road's id, as in `12`, or by the road's and a lane's, as in `12:-1`. All
    are driven in the direction of the road's reference line unless a minus sign stands before them.
    A lane's half width is kept as `width_left` and `width_right`.

    Raises
    ------
    ValueError
        In one line, for roads that are not whole, or geometries that do not meet.
    """
    found = _Map(file)
    roads = {road.get("id", ""): road for road in found.root.iterfind("road")}
    lengths = {name: _length(road) for name, road in roads.items()}
    if not roads:
        raise found.refuse("has no roads")

    def read(name: str) -> Piece:
        road, _, lane = name.partition(":")
        if road not in roads:
            pieces.unknown(road)
        frame = _reference_line(found, roads[road], f"road {shortened(road, 40)}")
        if not lane:
            columns = {"x": frame.x, "y": frame.y}
        else:
            columns = _lane(found, roads[road], frame, road, lane)
        return Piece(columns, [f"s = {s:.2f} m" for s in frame.s])

    reference = found.root.findtext("header/geoReference")
    metadata = {"geo_reference": shortened(reference, MOST_GEO_REFERENCE)} if reference else {}
    longest = max(lengths, key=lengths.__getitem__)
    kind = "OpenDRIVE lane" if part is not None and ":" in part else "OpenDRIVE road"
    pieces = Pieces(file, kind, "road", list(roads), longest, read, metadata)
    return pieces.path(part)


def _length(road: Element) -> float:
    """Return the length that a road states, m; 0 if it states none."""
    try:
        length = float(road.get("length", ""))
    except ValueError:
        return 0.0
    return length if math.isfinite(length) else 0.0


def _reference_line(found: _Map, road: Element, what: str) -> Frame:
    """Return the points of a road's reference line, at most `STEP` apart."""
    parts: list[Frame] = []
    geometries = road.findall("planView/geometry")
    total = sum(found.attribute(geometry, "length", what) for geometry in geometries)
    try:
        LENGTHS.of(f"the length of {what}", total)
    except ValueError as error:
        raise found.refuse(str(error)) from None
    for geometry in geometries:
        s, x, y, heading, length = (
            found.attribute(geometry, key, what) for key in ("s", "x", "y", "hdg", "length")
        )
        where = f"{what}: geometry at s = {s:g} m"
        if length < SHORTEST:
            continue
        at = np.linspace(0.0, length, math.ceil(length / STEP) + 1)
        u, v, turned = _local(found, geometry, at, where)
        cosine, sine = math.cos(heading), math.sin(heading)
        frame = Frame(
            s + at, x + u * cosine - v * sine, y + u * sine + v * cosine, heading + turned
        )
        if parts:
            gap = math.hypot(frame.x[0] - parts[-1].x[-1], frame.y[0] - parts[-1].y[-1])
            if gap > MEETS:
                raise found.refuse(f"{where} begins {gap:.4g} m from the end of the one before")
            parts[-1] = Frame(*(column[:-1] for column in parts[-1]))
        parts.append(frame)
    if not parts:
        raise found.refuse(f"{what} has no geometry")
    return Frame(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _local(found: _Map, geometry: Element, s: Array, where: str) -> Local:
    """Return the points of one geometry at arc lengths s from its start."""
    length = float(s[-1])
    for shape in geometry:
        keys: tuple[str, ...]
        if shape.tag == "line":
            return s, np.zeros_like(s), np.zeros_like(s)
        if shape.tag == "arc":
            curvature = found.attribute(shape, "curvature", where)
            return _turning(s, curvature, curvature)
        if shape.tag == "spiral":
            keys = "curvStart", "curvEnd"
            return _turning(s, *(found.attribute(shape, key, where) for key in keys))
        if shape.tag == "poly3":
            a, b, c, d = (found.attribute(shape, key, where) for key in "abcd")
            return _poly3(s, (a, b, c, d))
        if shape.tag == "paramPoly3":
            keys = ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV")
            values = [found.attribute(shape, key, where) for key in keys]
            p = s if shape.get("pRange") == "arcLength" else s / length
            u, v, heading = _cubics(p, values)
            reached = float(np.hypot(np.diff(u), np.diff(v)).sum())
            if abs(reached - length) > max(LENGTH_TOLERANCE * length, STEP):
                raise found.refuse(
                    f"{where} is {reached:.4g} m long, not {length:g} m: "
                    f"pRange {shown(shape.get('pRange'))} may be wrong"
                )
            return u, v, heading
    raise found.refuse(f"{where} is no line, arc, spiral, poly3 or paramPoly3")


def _turning(s: Array, first: float, last: float) -> Local:
    """Return a curve whose curvature (1/m) is linear in arc length: an arc or a clothoid."""
    slope = (last - first) / s[-1]

    def heading(at: Array) -> Array:
        turned: Array = first * at + 0.5 * slope * at * at
        return turned

    return *integrate(heading, s), heading(s)


def _poly3(s: Array, coefficients: Sequence[float]) -> Local:
    """Return v = a + b u + c u^2 + d u^3 at arc lengths s, by inverting the length of the curve."""
    a, b, c, d = coefficients
    u = np.linspace(0.0, s[-1], 20 * len(s))
    v = a + u * (b + u * (c + u * d))
    lengths = chord_lengths(np.column_stack([u, v]))
    at = np.interp(s, lengths, u)
    return at, a + at * (b + at * (c + at * d)), np.arctan(b + at * (2.0 * c + 3.0 * at * d))


def _cubics(p: Array, values: Sequence[float]) -> Local:
    """Return the points of two cubics u(p), v(p), whose coefficients follow each other."""
    (au, bu, cu, du), (av, bv, cv, dv) = values[:4], values[4:]
    u, v = au + p * (bu + p * (cu + p * du)), av + p * (bv + p * (cv + p * dv))
    ahead, left = bu + p * (2.0 * cu + 3.0 * p * du), bv + p * (2.0 * cv + 3.0 * p * dv)
    return u, v, np.unwrap(np.arctan2(left, ahead))


def _lane(found: _Map, road: Element, frame: Frame, road_id: str, lane_id: str) -> dict[str, Array]:
    """Return the centre of a lane, and half of its width on both sides.

    The lane's id is that of the first section; further sections are followed by its links.
    """
    what = f"lane {shortened(lane_id, 20)} of road {shortened(road_id, 40)}"
    sections = sorted(
        road.findall("lanes/laneSection"), key=lambda one: found.attribute(one, "s", what)
    )
    if not sections:
        raise found.refuse(f"road {shortened(road_id, 40)} has no lanes")
    starts = [found.attribute(section, "s", what) for section in sections]
    offset = _cubic(found, road.findall("lanes/laneOffset"), "s", what)(frame.s)
    width = np.zeros_like(frame.s)
    current = lane_id
    for k, section in enumerate(sections):
        end = starts[k + 1] if k + 1 < len(sections) else math.inf
        within = (frame.s >= starts[k] if k else frame.s > -math.inf) & (frame.s < end)
        lanes = {
            name: lane
            for lane in section.iter("lane")
            if _LANE.fullmatch(name := lane.get("id", ""))
        }
        if current not in lanes or current == "0":
            known = ", ".join(shortened(name, 20) for name in sorted(lanes) if name != "0")
            raise found.refuse(
                f"road {shortened(road_id, 40)} has no lane {shown(current)} at s = {starts[k]:g} "
                f"m: it has {known}"
            )
        side = -1 if current.startswith("-") else 1
        at = frame.s[within] - starts[k]
        inner = np.zeros_like(at)
        for name, lane in lanes.items():
            if 0 < side * int(name) < side * int(current):
                inner += _width(found, lane, what)(at)
        own = _width(found, lanes[current], what)(at)
        offset[within] += side * (inner + 0.5 * own)
        width[within] = own
        link = lanes[current].find("link/successor")
        current = current if link is None else link.get("id", "")
    half = 0.5 * width
    return {
        "x": frame.x - offset * np.sin(frame.heading),
        "y": frame.y + offset * np.cos(frame.heading),
        "width_right": half,
        "width_left": half,
    }


def _width(found: _Map, lane: Element, what: str) -> Callable[[Array], Array]:
    """Return a lane's width as a function of the distance from its section's start."""
    records = lane.findall("width")
    if not records:
        raise found.refuse(f"{what}: lane {shown(lane.get('id'))} has no widths")
    return _cubic(found, records, "sOffset", what)


def _cubic(
    found: _Map, records: Sequence[Element], key: str, what: str
) -> Callable[[Array], Array]:
    """Return a function of cubic polynomials, each of which begins where its `key` says."""
    table = np.array(
        [[found.attribute(one, name, what) for name in (key, *"abcd")] for one in records]
    ).reshape(-1, 5)
    table = table[np.argsort(table[:, 0], kind="stable")]

    def value(s: Array) -> Array:
        if not len(table):
            return np.zeros_like(s)
        start, a, b, c, d = table[np.searchsorted(table[:, 0], s, side="right").clip(1) - 1].T
        along = s - start
        cubic: Array = a + along * (b + along * (c + along * d))
        return cubic

    return value


# --- CommonRoad ---


@np.errstate(over="ignore", invalid="ignore")
def read_commonroad(file: Path, part: str | None = None) -> RawPath:
    """Read centre lines of lanelets, by default those of the longest chain of successors.

    The centre line is halfway between the two bounds; half of their distance is kept as
    `width_left` and `width_right`. Parts are ids of lanelets.

    Raises
    ------
    ValueError
        In one line, for a map without lanelets, or lanelets that are not whole.
    """
    found = _Map(file)
    lanelets = {one.get("id", ""): one for one in found.root.iterfind("lanelet")}
    if not lanelets:
        raise found.refuse("has no lanelets")

    def read(name: str) -> Piece:
        if name not in lanelets:
            pieces.unknown(name)
        return _centre(found, lanelets[name], f"lanelet {shortened(name, 40)}")

    longest = "" if part is not None else ",".join(_longest_chain(lanelets, read))
    pieces = Pieces(file, "CommonRoad lanelets", "lanelet", list(lanelets), longest, read)
    return pieces.path(part)


def _centre(found: _Map, lanelet: Element, what: str) -> Piece:
    bounds = []
    for key in ("leftBound", "rightBound"):
        points = [
            [found.number(point.findtext(axis), f"{what}: {axis} of its {key}") for axis in "xy"]
            for point in lanelet.iterfind(f"{key}/point")
        ]
        if len(points) < 2:
            raise found.refuse(f"{what}: its {key} has {len(points)} points, 2 are needed")
        bounds.append(np.array(points))
    if len(bounds[0]) != len(bounds[1]):
        bounds = _paired(*bounds)
    left, right = bounds
    centre, half = 0.5 * (left + right), 0.5 * np.hypot(*(left - right).T)
    lengths = chord_lengths(centre)
    if not LENGTHS.holds(float(lengths[-1])):
        raise found.refuse(f"{what} is {lengths[-1]:.4g} m long, at most {LENGTHS.high:g} are read")
    at = _subdivided(lengths)
    x, y, width = (np.interp(at, lengths, values) for values in (*centre.T, half))
    columns = {"x": x, "y": y, "width_left": width, "width_right": width}
    return Piece(columns, [f"{s:.2f} m along it" for s in at])


def _paired(left: Array, right: Array) -> list[Array]:
    """Give two bounds the same number of points, at the same shares of their lengths."""
    shares = []
    for bound in (left, right):
        lengths = chord_lengths(bound)
        shares.append(lengths / max(lengths[-1], 1e-9))
    both = np.union1d(*shares)
    return [
        np.column_stack([np.interp(both, share, axis) for axis in bound.T])
        for share, bound in zip(shares, (left, right), strict=True)
    ]


def _subdivided(lengths: Array) -> Array:
    """Return arc lengths with points between those that are far from each other."""
    steps = np.diff(lengths)
    if not (steps > 0.0).any():
        return lengths
    most = float(np.clip(5.0 * np.median(steps), 1.0, LONGEST_LANELET_STEP))
    most = min(most, lengths[-1] / 3.0)  # four points at least
    counts = np.maximum(np.ceil(steps / most).astype(int), 1)
    pieces = [
        np.linspace(start, stop, count, endpoint=False)
        for start, stop, count in zip(lengths[:-1], lengths[1:], counts, strict=True)
    ]
    return np.concatenate([*pieces, lengths[-1:]])


def _longest_chain(lanelets: dict[str, Element], read: Callable[[str], Piece]) -> list[str]:
    """Return the names of the longest chain of successors whose ends meet.

    Depth first from the lanelets without predecessors; a successor that is its own ancestor ends
    a chain, so in a roundabout the chain need not be the longest one.
    """
    ends: dict[str, tuple[Array, Array]] = {}
    length: dict[str, float] = {}
    for name in lanelets:
        one = read(name)
        ends[name] = one.end(0), one.end(-1)
        length[name] = float(np.hypot(np.diff(one.columns["x"]), np.diff(one.columns["y"])).sum())
    following = {
        name: [
            other
            for link in lanelet.iterfind("successor")
            if (other := link.get("ref", "")) in lanelets
            and math.dist(ends[name][1], ends[other][0]) <= MEETS
        ]
        for name, lanelet in lanelets.items()
    }
    entered = {other for others in following.values() for other in others}
    best: dict[str, float] = {}  # length of the longest chain that begins here
    chosen: dict[str, str] = {}
    for start in sorted(lanelets, key=lambda name: name in entered):
        stack, within = [start], {start}
        while stack:
            name = stack[-1]
            ahead = [one for one in following[name] if one not in best and one not in within]
            if name not in best and ahead:
                stack.append(ahead[0])
                within.add(ahead[0])
                continue
            if name not in best:
                done = [one for one in following[name] if one in best]
                after = max(done, key=best.__getitem__, default=None)
                best[name] = length[name] + (best[after] if after else 0.0)
                if after:
                    chosen[name] = after
            within.discard(stack.pop())
    chain = [max(best, key=best.__getitem__)]
    while chain[-1] in chosen:
        chain.append(chosen[chain[-1]])
    return chain
