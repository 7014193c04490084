"""Read paths in latitude and longitude: GPX, KML, GeoJSON, and NMEA 0183 logs of receivers.

GPX and KML are read from their XML trees. A library for each was tried: one finds no lines in KML
files of another version or without a namespace, and says nothing; the other takes quadratic time
on hostile texts. NMEA sentences are parsed by pynmea2 (extra `maps`).
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from datetime import time as time_of_day
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from trajectories.arguments import shortened, shown
from trajectories.fileio import finite_number, read_bytes, read_json
from trajectories.geodesy import east_north_up
from trajectories.import_options import SPEED_UNITS
from trajectories.pieces import Piece, Pieces
from trajectories.raw_path import RawPath
from trajectories.text_table import MOST_BYTES
from trajectories.xml_tree import read_xml

DAY = 86_400.0
"""s."""
WGS84 = ("4326", "4979", "CRS84", "CRS84H")
"""Ends of names of coordinate systems that are latitude and longitude on WGS-84."""
_NMEA = re.compile(r"\$..(GGA|RMC|GNS|GLL),")
"""Sentences that hold a position and its time, of any talker."""


class Fix(NamedTuple):
    """A position: deg, deg, m, s, m/s; what is not known is None."""

    latitude: float
    longitude: float
    height: float | None = None
    time: float | None = None
    speed: float | None = None
    place: str = ""


@dataclass(frozen=True)
class Line:
    """Positions in order; a ring is closed."""

    fixes: Sequence[Fix]
    closed: bool | None = None

    def length(self) -> float:
        """Return the length, m."""
        at = np.array([fix[:2] for fix in self.fixes])
        origin = (float(at[0, 0]), float(at[0, 1]), 0.0)
        points = east_north_up(at[:, 0], at[:, 1], np.zeros(len(at)), origin)
        return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())

    def piece(self) -> Piece:
        """Return the columns: of height, time and speed those that every position has."""
        columns, missing = {}, []
        for key in ("latitude", "longitude", "height", "time", "speed"):
            known = [value for fix in self.fixes if (value := getattr(fix, key)) is not None]
            if len(known) == len(self.fixes):
                columns[key] = np.array(known)
            elif known:
                missing.append(f"{key} not used: {len(self.fixes) - len(known)} points lack it")
        if "time" in columns:
            columns["time"] = columns["time"] - columns["time"][0]
        metadata = {"missing": "; ".join(missing)} if missing else {}
        return Piece(columns, [fix.place for fix in self.fixes], self.closed, metadata)


def _path(file: Path, kind: str, lines: Sequence[Line], part: str | None) -> RawPath:
    """Return the line that `part` numbers from 1, by default the longest."""
    lines = [line for line in lines if len(line.fixes) > 1]
    if not lines:
        raise ValueError(f"{shortened(file)}: holds no {kind} of two points or more")
    numbered = {str(number): line for number, line in enumerate(lines, start=1)}
    longest = max(numbered, key=lambda name: numbered[name].length()) if len(lines) > 1 else "1"

    def read(name: str) -> Piece:
        if name not in numbered:
            pieces.unknown(name)
        return numbered[name].piece()

    pieces = Pieces(file, kind, "part", list(numbered), longest, read)
    return pieces.path(part)


def _stamp(text: str, file: Path, what: str) -> float:
    """Return an ISO 8601 time in seconds since 1970; without a zone it is UTC."""
    try:
        found = datetime.fromisoformat(text.strip())
    except ValueError:
        raise ValueError(f"{shortened(file)}: {what}: {shown(text)} is not a time") from None
    if found.tzinfo is None:
        found = found.replace(tzinfo=UTC)
    return found.timestamp()


# --- GPX ---


def read_gpx(file: Path, part: str | None = None) -> RawPath:
    """Read a GPX file: a part is a segment of a track, or a route; waypoints only without these.

    Height (`ele`), `time`, and `speed` (of GPX 1.0 or of an extension, m/s) are kept.

    Raises
    ------
    ValueError
        In one line, for what is no GPX, or holds no points.
    """
    root = read_xml(file)
    groups = [list(segment.iterfind("trkpt")) for segment in root.iter("trkseg")]
    groups += [list(route.iterfind("rtept")) for route in root.iter("rte")]
    if not any(groups):
        groups = [list(root.iterfind("wpt"))]
    lines = [
        Line([_gpx_fix(point, file, f"point {k}") for k, point in enumerate(group, start=1)])
        for group in groups
    ]
    return _path(file, "GPX track", lines, part)


def _gpx_fix(point: Element, file: Path, place: str) -> Fix:
    def child(tag: str) -> str | None:
        found = next(point.iter(tag), None)  # in extensions too
        return None if found is None or not (found.text or "").strip() else found.text

    latitude, longitude = (
        finite_number(point.get(key), file, f"{place}: {key}") for key in ("lat", "lon")
    )
    height, time, speed = child("ele"), child("time"), child("speed")
    return Fix(
        latitude, longitude,
        None if height is None else finite_number(height, file, f"{place}: ele"),
        None if time is None else _stamp(time, file, f"{place}: time"),
        None if speed is None else finite_number(speed, file, f"{place}: speed"),
        place,
    )  # fmt: skip


# --- KML ---


def read_kml(file: Path, part: str | None = None) -> RawPath:
    """Read a KML file: a part is a LineString, a LinearRing (closed) or a gx:Track with its times.

    Placemarks of points are read as one line if there are no others.

    Raises
    ------
    ValueError
        In one line, for what is no KML, or holds no lines.
    """
    root = read_xml(file)
    lines = []
    for element in root.iter():
        if element.tag in {"LineString", "LinearRing"}:
            lines.append(Line(_kml_fixes(element, file), element.tag == "LinearRing" or None))
        elif element.tag == "Track":
            lines.append(Line(_track_fixes(element, file)))
    if not lines:
        points = [fix for point in root.iter("Point") for fix in _kml_fixes(point, file)]
        lines = [Line(points)]
    return _path(file, "KML line", lines, part)


def _kml_fixes(element: Element, file: Path) -> list[Fix]:
    """Read `longitude,latitude[,height]` tuples, which white space separates."""
    tuples = (element.findtext("coordinates") or "").split()
    return [_fix(text.split(","), file, f"point {k}") for k, text in enumerate(tuples, start=1)]


def _track_fixes(track: Element, file: Path) -> list[Fix]:
    """Read the positions `longitude latitude height` of a gx:Track, and their times."""
    texts = [element.text or "" for element in track.iterfind("coord")]
    times = [element.text or "" for element in track.iterfind("when")]
    if times and len(times) != len(texts):
        raise ValueError(
            f"{shortened(file)}: a gx:Track has {len(times)} times for {len(texts)} positions"
        )
    fixes = []
    for k, text in enumerate(texts):
        if text.strip():  # a position may be missing
            fix = _fix(text.split(), file, f"point {k + 1}")
            if times:
                fix = fix._replace(time=_stamp(times[k], file, f"{fix.place}: when"))
            fixes.append(fix)
    return fixes


def _fix(values: Any, file: Path, place: str) -> Fix:
    """Return the position that longitude, latitude and perhaps height, in this order, stand for."""
    if not isinstance(values, list) or len(values) < 2:
        raise ValueError(
            f"{shortened(file)}: {place}: {shown(values)} is not longitude, latitude[, height]"
        )
    numbers = [finite_number(value, file, place) for value in values[:3]]
    return Fix(numbers[1], numbers[0], numbers[2] if len(numbers) > 2 else None, place=place)


# --- GeoJSON ---


def read_geojson(file: Path, part: str | None = None) -> RawPath:
    """Read a GeoJSON file (RFC 7946): a part is a line, or a ring of a polygon (closed).

    Points are read as one line if there are no others.

    Raises
    ------
    ValueError
        In one line, for other JSON, for coordinates that are not WGS-84, or without lines.
    """
    document = read_json(file, MOST_BYTES)
    found = list(_geometries(document))
    if not found:
        kind = document.get("type") if isinstance(document, dict) else None
        named = f"its type is {shown(kind)}" if kind else "it has no type"
        raise ValueError(
            f"{shortened(file)}: is JSON but no GeoJSON ({named}): write the points as a CSV file "
            "with the columns x_m,y_m or lat,lon, or use ReferencePath.from_waypoints"
        )
    _check_system(document, file)
    lines: list[Line] = []
    points: list[Fix] = []
    for kind, coordinates in found:
        closed = kind == "Polygon" or None
        if kind == "Point":
            points.append(_fix(coordinates, file, f"point {len(points) + 1}"))
            continue
        if not isinstance(coordinates, list):
            raise ValueError(f"{shortened(file)}: coordinates of a {kind} are not a list")  # noqa: TRY004
        lines.append(
            Line([_fix(one, file, f"point {k}") for k, one in enumerate(coordinates, 1)], closed)
        )
    return _path(file, "GeoJSON line", lines or [Line(points)], part)


def _geometries(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield LineString, Polygon (its rings) and Point geometries, and their coordinates."""
    kind = value.get("type") if isinstance(value, dict) else None
    if kind in ("FeatureCollection", "GeometryCollection"):
        members = value.get("features" if kind[0] == "F" else "geometries")
        for member in members if isinstance(members, list) else []:
            yield from _geometries(member)
    elif kind == "Feature":
        yield from _geometries(value.get("geometry"))
    elif kind in ("LineString", "Point"):
        yield kind, value.get("coordinates")
    elif kind in ("MultiLineString", "Polygon", "MultiPoint"):
        coordinates = value.get("coordinates")
        for one in coordinates if isinstance(coordinates, list) else []:
            yield kind.removeprefix("Multi"), one
    elif kind == "MultiPolygon":
        coordinates = value.get("coordinates")
        for polygon in coordinates if isinstance(coordinates, list) else []:
            yield from _geometries({"type": "Polygon", "coordinates": polygon})


def _check_system(document: Any, file: Path) -> None:
    """Refuse a coordinate system other than WGS-84, which files before RFC 7946 could name."""
    system = document.get("crs")
    properties = system.get("properties") if isinstance(system, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if isinstance(name, str) and not name.upper().endswith(WGS84):
        raise ValueError(
            f"{shortened(file)}: coordinates are in {shown(name)}: export it in WGS-84 "
            "(EPSG:4326), which GeoJSON needs, or as a CSV file with the columns x_m,y_m"
        )


# --- NMEA ---


def read_nmea(file: Path, part: str | None = None) -> RawPath:
    """Read a log of NMEA 0183 sentences: positions of GGA, RMC, GNS or GLL, speed of RMC.

    Sentences of one time are one point. Left out are sentences without a fix, those that cannot be
    read or whose checksum is wrong, and, where most points have a speed, those that have none;
    their numbers are in `metadata["skipped"]`.

    Raises
    ------
    ValueError
        In one line, if pynmea2 is missing, or if more sentences are wrong than right.
    """
    try:
        from pynmea2 import parse
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{shortened(file)}: reading NMEA logs needs pynmea2: pip install 'lpv-track-env[maps]'"
        ) from error
    fixes: list[Fix] = []
    wrong = without = 0
    text = read_bytes(file, MOST_BYTES).decode("ascii", errors="replace")
    for number, line in enumerate(text.split("\n"), start=1):
        if (found := _NMEA.search(line)) is not None:
            try:
                fix = _nmea_fix(parse(line[found.start() :]), f"line {number}")
            except ValueError:
                wrong += 1
                continue
            if fix is None:
                without += 1
            else:
                fixes.append(fix)
    if wrong > len(fixes) + without:
        raise ValueError(
            f"{shortened(file)}: {wrong} of {wrong + len(fixes) + without} NMEA sentences have a "
            "wrong checksum or cannot be read"
        )
    points = _epochs(fixes)
    moving = [point for point in points if point.speed is not None]
    if len(moving) > 0.5 * len(points):
        points, partial = moving, len(points) - len(moving)
    else:
        partial = 0
    raw = _path(file, "NMEA log", [Line(points)], part)
    counts = ((wrong, "wrong checksum or torn"), (without, "no fix"), (partial, "no speed"))
    skipped = ", ".join(f"{count} with {why}" for count, why in counts if count)
    metadata = {**raw.metadata, "skipped": f"NMEA: {skipped}"} if skipped else raw.metadata
    return replace(raw, metadata=metadata)


def _nmea_fix(sentence: Any, place: str) -> Fix | None:
    """Return the position of a sentence with one, None without a fix.

    Raises
    ------
    ValueError
        For a position or time that is not whole.
    """
    kind = sentence.sentence_type
    if kind == "GGA":
        valid = sentence.gps_qual != 0
    elif kind == "GNS":
        valid = sentence.mode_indicator.strip("N") != ""
    else:
        valid = sentence.status == "A"
    if not valid:
        return None
    at = sentence.timestamp
    if sentence.lat_dir not in {"N", "S"} or sentence.lon_dir not in {"E", "W"}:
        raise ValueError("a position without its hemisphere")
    if not isinstance(at, time_of_day):
        raise ValueError("a position without its time")  # noqa: TRY004
    known = {}
    if kind == "GGA" and isinstance(sentence.altitude, float):
        known["height"] = sentence.altitude
    if kind == "RMC" and isinstance(sentence.spd_over_grnd, float):
        known["speed"] = sentence.spd_over_grnd * SPEED_UNITS["kn"]
    seconds = at.hour * 3600.0 + at.minute * 60.0 + at.second + at.microsecond * 1e-6
    fix = Fix(sentence.latitude, sentence.longitude, time=seconds, place=place, **known)
    if not all(math.isfinite(value) for value in fix[:5] if value is not None):
        raise ValueError("a number that is not finite")
    return fix


def _epochs(fixes: Sequence[Fix]) -> list[Fix]:
    """Merge positions of one time to one each; time goes on past midnight."""
    points: list[Fix] = []
    clock, day = -1.0, 0.0
    for fix in fixes:
        time = fix.time or 0.0
        if time == clock:
            last = points[-1]
            points[-1] = last._replace(
                height=fix.height if last.height is None else last.height,
                speed=fix.speed if last.speed is None else last.speed,
            )
        else:
            day += DAY if time < clock - 0.5 * DAY else 0.0
            clock = time
            points.append(fix._replace(time=time + day))
    return points
