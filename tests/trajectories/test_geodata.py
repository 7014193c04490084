"""GPX, KML, GeoJSON and NMEA files: the same lap from each, their variants, and hostile ones."""

import json
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ellipeinc

from trajectories import load
from trajectories.formats import reader_of
from trajectories.raw_path import RawPath

CENTRE = 48.15, 11.57
ANGLES = np.linspace(0.0, 2.0 * math.pi, 120, endpoint=False)
LATITUDE = np.round(CENTRE[0] + 2.69784e-4 * np.sin(ANGLES), 8)
LONGITUDE = np.round(CENTRE[1] + 8.07850e-4 * np.cos(ANGLES), 8)
POINTS = list(zip(LATITUDE.tolist(), LONGITUDE.tolist(), strict=True))
"""An ellipse, 60 m and 30 m from its centre in the east and the north."""


def read(file: Path, text: str | bytes, part: str | None = None) -> RawPath:
    """Write a file, and read it by the reader that recognition chooses."""
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    reader = reader_of(file, file.read_bytes()[:500])
    assert reader is not None
    return reader(file, part)


def places(raw: RawPath) -> list[tuple[float, float]]:
    latitude, longitude = raw.columns["latitude"], raw.columns["longitude"]
    return list(zip(latitude.tolist(), longitude.tolist(), strict=True))


def gpx(*inner: str, head: str = 'version="1.1" creator="phone"') -> str:
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<gpx {head}>{"".join(inner)}</gpx>'


def segment(points: list[tuple[float, float]], tag: str = "trkpt", inner: str = "") -> str:
    return "".join(f'<{tag} lat="{a:.8f}" lon="{b:.8f}">{inner}</{tag}>' for a, b in points)


def kml(*inner: str, head: str = 'xmlns="http://www.opengis.net/kml/2.2"') -> str:
    return f'<?xml version="1.0"?><kml {head}><Document>{"".join(inner)}</Document></kml>'


def line_string(points: list[tuple[float, float]], tag: str = "LineString") -> str:
    text = "\n".join(f"{b:.8f},{a:.8f},500" for a, b in points)
    return f"<Placemark><{tag}><coordinates>\n{text}\n</coordinates></{tag}></Placemark>"


def lonlat(points: list[tuple[float, float]]) -> list[list[float]]:
    return [[b, a] for a, b in points]


def nmea(body: str) -> str:
    checksum = 0
    for character in body:
        checksum ^= ord(character)
    return f"${body}*{checksum:02X}"


def degrees_minutes(value: float, digits: int) -> str:
    whole = int(abs(value))
    return f"{whole:0{digits}d}{60.0 * (abs(value) - whole):010.7f}"


def gga(k: int, latitude: float, longitude: float, quality: int = 4, clock: int = 36_000) -> str:
    at = clock + k
    return nmea(
        f"GPGGA,{at // 3600 % 24:02d}{at // 60 % 60:02d}{at % 60:02d}.00,"
        f"{degrees_minutes(latitude, 2)},{'N' if latitude >= 0 else 'S'},"
        f"{degrees_minutes(longitude, 3)},{'E' if longitude >= 0 else 'W'},"
        f"{quality},12,0.8,500.0,M,46.0,M,,"
    )


def rmc(k: int, latitude: float, longitude: float, knots: float) -> str:
    position = gga(k, latitude, longitude).split(",")
    return nmea(f"GNRMC,{position[1]},A,{','.join(position[2:6])},{knots},90.0,010526,,,A")


# --- the same lap from every format ---


def lap_of(kind: str) -> str:
    if kind == "gpx":
        points = "".join(
            f'<trkpt lat="{a:.8f}" lon="{b:.8f}"><ele>500.0</ele>'
            f"<time>2026-05-01T10:{k // 60:02d}:{k % 60:02d}Z</time></trkpt>\n"
            for k, (a, b) in enumerate(POINTS)
        )
        return gpx(f"<trk><name>lap</name><trkseg>\n{points}</trkseg></trk>")
    if kind == "kml":
        return kml(line_string(POINTS))
    if kind == "geojson":
        geometry = {"type": "LineString", "coordinates": lonlat(POINTS)}
        feature = {"type": "Feature", "properties": {}, "geometry": geometry}
        return json.dumps({"type": "FeatureCollection", "features": [feature]})
    return "\r\n".join(gga(k, a, b) for k, (a, b) in enumerate(POINTS)) + "\r\n"


@pytest.mark.parametrize(
    ("kind", "digits", "columns"),
    [
        ("gpx", 1e-12, {"height", "time"}),
        ("kml", 1e-12, {"height"}),
        ("geojson", 1e-12, set()),
        ("nmea", 1e-9, {"height", "time"}),  # 1e-7 minutes
    ],
)
def test_every_format_gives_the_same_lap(
    kind: str, digits: float, columns: set[str], tmp_path: Path
) -> None:
    if kind == "nmea":
        pytest.importorskip("pynmea2", reason="pynmea2 is not installed")
    raw = read(tmp_path / f"19_track.{kind}", lap_of(kind))
    assert set(raw.columns) == {"latitude", "longitude"} | columns
    assert raw.name == "19_track"
    np.testing.assert_allclose(raw.columns["latitude"], LATITUDE, rtol=0.0, atol=digits)
    np.testing.assert_allclose(raw.columns["longitude"], LONGITUDE, rtol=0.0, atol=digits)
    if "height" in columns:
        assert (raw.columns["height"] == 500.0).all()
    if "time" in columns:
        np.testing.assert_array_equal(raw.columns["time"], np.arange(120.0))
    assert len(raw.places) == 120


@pytest.mark.parametrize("suffix", ["gpx", "kml", "geojson"])
def test_content_counts_before_the_suffix_and_a_byte_order_mark_is_no_harm(
    suffix: str, tmp_path: Path
) -> None:
    text = lap_of(suffix)
    assert len(places(read(tmp_path / "track.txt", b"\xef\xbb\xbf" + text.encode()))) == 120
    if suffix != "geojson":
        wide = text.replace(' encoding="UTF-8"', "").encode("utf-16")
        assert len(places(read(tmp_path / "wide.xml", wide))) == 120


@pytest.mark.parametrize("kind", ["gpx", "kml", "geojson", "nmea", "csv"])
def test_the_lap_is_loaded_as_from_a_table(kind: str, tmp_path: Path) -> None:
    if kind == "nmea":
        pytest.importorskip("pynmea2", reason="pynmea2 is not installed")
    table = "lat,lon\n" + "".join(f"{a:.8f},{b:.8f}\n" for a, b in POINTS)
    file = tmp_path / f"lap.{kind}"
    file.write_text(table if kind == "csv" else lap_of(kind))
    path = load(file)
    around = 2.0 * 60.0 * ellipeinc(2.0 * math.pi, 1.0 - 0.25) / 2.0
    assert path.closed
    assert path.length == pytest.approx(around, rel=2e-3)  # and the smoothing cuts bends a little
    assert path.metadata["imported"].startswith(path.metadata["source"].split(":")[0])


def test_what_was_taken_of_a_file_is_in_the_line_of_the_import(tmp_path: Path) -> None:
    file = tmp_path / "many.gpx"
    file.write_text(
        gpx(
            f"<trk><trkseg>{segment(POINTS[:40])}</trkseg>"
            f"<trkseg>{segment(POINTS[40:])}</trkseg></trk>"
        )
    )
    longest = "part 2, the longest of 2 (the option part names others)"
    assert longest in load(file).metadata["imported"]
    assert load(file, part=1).length < load(file, part="2").length
    assert "; part 1 of 2" in load(file, part=1).metadata["imported"]


# --- GPX ---


def test_gpx_takes_the_longest_segment_unless_a_part_is_named(tmp_path: Path) -> None:
    short, long, route = POINTS[:10], POINTS[20:90], POINTS[90:100]
    text = gpx(
        segment(POINTS[:2], "wpt"),
        f"<rte>{segment(route, 'rtept')}</rte>",
        f"<trk><trkseg>{segment(short)}</trkseg><trkseg>{segment(long)}</trkseg></trk>",
        "<trk><trkseg></trkseg></trk>",
    )
    file = tmp_path / "many.gpx"
    raw = read(file, text)
    assert places(raw) == long
    assert raw.metadata["part"] == "part 2, the longest of 3 (the option part names others)"
    assert places(read(file, text, "1")) == short
    assert places(read(file, text, "3")) == route
    assert places(read(file, text, "-1")) == short[::-1]
    assert places(read(file, text, "1, 2")) == short + long
    with pytest.raises(ValueError, match=r"many.gpx: has no part '4': it has 1, 2, 3"):
        read(file, text, "4")


def test_gpx_waypoints_are_a_path_only_if_there_is_nothing_else(tmp_path: Path) -> None:
    assert places(read(tmp_path / "w.gpx", gpx(segment(POINTS, "wpt")))) == POINTS
    with pytest.raises(ValueError, match=r"w\.gpx: holds no GPX track of two points or more"):
        read(tmp_path / "w.gpx", gpx())


def test_gpx_speeds_of_version_1_0_and_of_extensions(tmp_path: Path) -> None:
    old = gpx(
        f"<trk><trkseg>{segment(POINTS, inner='<speed>3.5</speed>')}</trkseg></trk>",
        head='version="1.0" xmlns="http://www.topografix.com/GPX/1/0"',
    )
    assert (read(tmp_path / "old.gpx", old).columns["speed"] == 3.5).all()
    inner = (
        "<time>2026-05-01T12:00:00.25+02:00</time><extensions><x:TrackPointExtension>"
        "<x:speed>2.5</x:speed></x:TrackPointExtension></extensions>"
    )
    new = gpx(
        f"<trk><trkseg>{segment(POINTS, inner=inner)}</trkseg></trk>",
        head='xmlns="http://www.topografix.com/GPX/1/1" xmlns:x="http://www.garmin.com/x/v2"',
    )
    raw = read(tmp_path / "new.gpx", new)
    assert (raw.columns["speed"] == 2.5).all()
    assert (raw.columns["time"] == 0.0).all()


def test_a_quantity_that_some_points_lack_is_left_out_and_said(tmp_path: Path) -> None:
    text = gpx(
        f"<trk><trkseg>{segment(POINTS[:3])}{segment(POINTS[3:], inner='<ele>1</ele>')}"
        "</trkseg></trk>"
    )
    raw = read(tmp_path / "holes.gpx", text)
    assert set(raw.columns) == {"latitude", "longitude"}
    assert raw.metadata["missing"] == "height not used: 3 points lack it"


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ('<trkpt lat="48" lon="x"/>', "point 1: lon: 'x' is not a finite number"),
        ('<trkpt lat="48"/>', "point 1: lon: None is not a finite number"),
        ('<trkpt lat="nan" lon="11"/>', "point 1: lat: 'nan' is not a finite number"),
        ('<trkpt lat="48" lon="11"><time>noon</time></trkpt>', "point 1: time: 'noon' is not a"),
        ('<trkpt lat="48" lon="11"><ele>1,5</ele></trkpt>', "point 1: ele: '1,5' is not a finite"),
        ("<trkpt>", "is not well-formed XML: mismatched tag"),
    ],
)
def test_bad_gpx_is_refused_in_one_line(point: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"^[^\n]*bad.gpx: {message}[^\n]*$"):
        read(tmp_path / "bad.gpx", gpx(f"<trk><trkseg>{point}</trkseg></trk>"))


# --- KML ---


@pytest.mark.parametrize(
    "head",
    ['xmlns="http://earth.google.com/kml/2.1"', "", 'xmlns="http://www.opengis.net/kml/2.3"'],
)
def test_kml_of_any_version(head: str, tmp_path: Path) -> None:
    assert places(read(tmp_path / "old.kml", kml(line_string(POINTS), head=head))) == POINTS


def test_kml_rings_are_closed_and_points_are_a_path_only_alone(tmp_path: Path) -> None:
    ring = line_string([*POINTS, POINTS[0]], "LinearRing")
    point = line_string(POINTS[:1], "Point")
    assert read(tmp_path / "ring.kml", kml(point, ring)).closed is True
    assert read(tmp_path / "line.kml", kml(line_string(POINTS))).closed is None
    alone = kml(*(line_string([one], "Point") for one in POINTS))
    assert places(read(tmp_path / "points.kml", alone)) == POINTS


def test_kml_tracks_have_times(tmp_path: Path) -> None:
    whens = "".join(f"<when>2026-05-01T10:00:{k:02d}Z</when>" for k in range(4))
    coords = [f"<gx:coord>{b:.8f} {a:.8f} 5.0</gx:coord>" for a, b in POINTS[:4]]
    head = 'xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"'

    def track(texts: list[str]) -> str:
        inner = f"<Placemark><gx:Track>{whens}{''.join(texts)}</gx:Track></Placemark>"
        return kml(inner, head=head)

    raw = read(tmp_path / "track.kml", track(coords))
    assert places(raw) == POINTS[:4]
    assert raw.columns["time"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert raw.columns["height"].tolist() == [5.0] * 4
    hole = read(tmp_path / "hole.kml", track([coords[0], "<gx:coord/>", *coords[2:]]))
    assert hole.columns["time"].tolist() == [0.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="a gx:Track has 4 times for 3 positions"):
        read(tmp_path / "short.kml", track(coords[:3]))


def test_kml_with_spaces_in_its_tuples_is_refused(tmp_path: Path) -> None:
    text = "<LineString><coordinates>11.5, 48.1, 0 11.6, 48.2, 0</coordinates></LineString>"
    with pytest.raises(ValueError, match=r"point 1: '' is not a finite number"):
        read(tmp_path / "spaces.kml", kml(text))


# --- GeoJSON ---


def test_geojson_geometries(tmp_path: Path) -> None:
    file = tmp_path / "g.geojson"
    lines = {"type": "MultiLineString", "coordinates": [lonlat(POINTS[:9]), lonlat(POINTS[9:])]}
    raw = read(file, json.dumps(lines))
    assert places(raw) == POINTS[9:]
    assert raw.metadata["part"].startswith("part 2, the longest of 2")
    ring = [*POINTS, POINTS[0]]
    polygon = {"type": "Polygon", "coordinates": [lonlat(ring)]}
    raw = read(file, json.dumps({"type": "Feature", "geometry": polygon, "properties": None}))
    assert (raw.closed, places(raw)) == (True, ring)
    several = {"type": "MultiPolygon", "coordinates": [[lonlat(ring)]]}
    collection = {"type": "GeometryCollection", "geometries": [several]}
    assert places(read(file, json.dumps(collection))) == ring
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [b, a, 3.0]}}
        for a, b in POINTS
    ]
    raw = read(file, json.dumps({"type": "FeatureCollection", "features": features}))
    assert places(raw) == POINTS
    assert (raw.columns["height"] == 3.0).all()


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"points": [[0, 0]]}, r"is JSON but no GeoJSON \(it has no type\)"),
        ([[0, 0], [1, 1]], r"is JSON but no GeoJSON \(it has no type\)"),
        ({"type": "Polyline"}, "its type is 'Polyline'"),
        ({"type": ["LineString"], "coordinates": []}, r"its type is \['LineString'\]"),
        ({"type": "LineString", "coordinates": 3}, "coordinates of a LineString are not a list"),
        ({"type": "LineString", "coordinates": [[1.0]]}, "is not longitude, latitude"),
        ({"type": "LineString", "coordinates": [[True, 1], [2, 2]]}, "point 1: True is not a"),
        ({"type": "LineString", "coordinates": [["11,5", 1], [2, 2]]}, "'11,5' is not a finite"),
        ({"type": "FeatureCollection", "features": []}, "is JSON but no GeoJSON"),
        ({"type": "Topology", "objects": {}}, "is a TopoJSON file, which is not read: export it"),
        (
            {
                "type": "LineString",
                "coordinates": [[691000.0, 5335000.0], [691010.0, 5335000.0]],
                "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}},
            },
            "coordinates are in 'urn:ogc:def:crs:EPSG::25832': export it in WGS-84",
        ),
    ],
)
def test_other_json_is_refused(document: object, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "x.json", json.dumps(document))


def test_geojson_may_name_wgs84(tmp_path: Path) -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    document = {"type": "LineString", "coordinates": lonlat(POINTS), "crs": crs}
    assert places(read(tmp_path / "crs.json", json.dumps(document))) == POINTS


# --- NMEA ---


class TestNmea:
    @pytest.fixture(autouse=True)
    def _parser(self) -> None:
        pytest.importorskip("pynmea2", reason="pynmea2 is not installed")

    def test_hemispheres_and_minutes(self, tmp_path: Path) -> None:
        text = "\n".join(
            nmea(f"GPGGA,10000{k}.50,3352.1234,S,07034.5678,W,1,8,1.0,5.5,M,0,M,,")
            for k in range(3)
        )
        raw = read(tmp_path / "south.nmea", text)
        np.testing.assert_allclose(raw.columns["latitude"], -(33 + 52.1234 / 60), atol=1e-12)
        np.testing.assert_allclose(raw.columns["longitude"], -(70 + 34.5678 / 60), atol=1e-12)
        assert raw.columns["height"].tolist() == [5.5] * 3

    def test_sentences_of_one_time_are_one_point_with_its_speed(self, tmp_path: Path) -> None:
        lines = [rmc(0, *POINTS[0], 9.0)]
        for k, (a, b) in enumerate(POINTS):
            lines += [gga(k, a, b), rmc(k, a, b, 10.0 + k), nmea("GPGSA,A,3,04,05,,,,2.5,1.3,2.1")]
        raw = read(tmp_path / "log.txt", "\n".join(lines))
        assert len(raw.places) == 120
        knots = raw.columns["speed"] / (1852.0 / 3600.0)
        np.testing.assert_allclose(knots, [9.0, *(10.0 + np.arange(1, 120))], rtol=1e-12)
        assert set(raw.columns) == {"latitude", "longitude", "height", "time", "speed"}

    def test_what_cannot_be_used_is_skipped_and_counted(self, tmp_path: Path) -> None:
        lines = [gga(k, a, b) for k, (a, b) in enumerate(POINTS)]
        lines[5] = lines[5].replace("4809", "4909")  # its checksum is wrong now
        lines[7] = gga(7, *POINTS[7], quality=0)
        lines[9] = nmea("GPGGA,100009.00,,,,,4,12,0.8,500.0,M,46.0,M,,")
        lines[11] = nmea("GPGGA,nonsense,4809.1,N,01134.1,E,4,12,0.8,500.0,M,46.0,M,,")
        lines[13] = lines[13][:30]
        raw = read(tmp_path / "skips.nmea", "\n".join(lines))
        assert raw.metadata["skipped"] == "NMEA: 4 with wrong checksum or torn, 1 with no fix"
        assert len(raw.places) == 115
        assert raw.places[5] == "line 7"

    def test_sentences_stand_behind_times_and_between_binary_messages(self, tmp_path: Path) -> None:
        lines = [gga(k, a, b).encode() for k, (a, b) in enumerate(POINTS)]
        stamped = b"\n".join(b"2026-05-01 10:00:00.1; " + line for line in lines)
        mixed = b"\xb5\x62\x01\x07\0\0\xff\x0a".join(line + b"\r\n" for line in lines)
        for content in (stamped, mixed):
            raw = read(tmp_path / "log.nmea", content)
            np.testing.assert_allclose(raw.columns["latitude"], LATITUDE, rtol=0.0, atol=1e-9)

    def test_a_log_of_wrong_checksums_is_refused(self, tmp_path: Path) -> None:
        text = "\n".join(gga(k, a, b)[:-2] + "00" for k, (a, b) in enumerate(POINTS))
        with pytest.raises(ValueError, match="NMEA sentences have a wrong checksum or"):
            read(tmp_path / "wrong.nmea", text)

    def test_time_goes_on_past_midnight(self, tmp_path: Path) -> None:
        text = "\n".join(gga(k, a, b, clock=86_340) for k, (a, b) in enumerate(POINTS))
        raw = read(tmp_path / "night.nmea", text)
        np.testing.assert_array_equal(raw.columns["time"], np.arange(120.0))


def test_nmea_without_its_library_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pynmea2", None)
    with pytest.raises(
        ValueError, match=r"NMEA logs needs pynmea2: pip install 'lpv-track-env\[maps\]'$"
    ):
        read(tmp_path / "x.nmea", lap_of("nmea"))


# --- hostile XML ---

LAUGHS = (
    '<!DOCTYPE gpx [<!ENTITY a "ha">'
    + "".join(f'<!ENTITY a{k} "{f"&a{k - 1 or str()};" * 10}">' for k in range(1, 10))
    + "]>"
)


@pytest.mark.parametrize(
    "declared",
    [
        LAUGHS,
        '<!DOCTYPE gpx [<!ENTITY a9 SYSTEM "SECRET">]>',
        '<!DOCTYPE gpx SYSTEM "SECRET">',
        '<!DOCTYPE gpx [<!ENTITY % a SYSTEM "SECRET"> %a;]>',
    ],
)
def test_document_types_and_entities_are_refused(declared: str, tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("1.0")
    text = f'<?xml version="1.0"?>{declared}<gpx><trk><name>&a9;</name></trk></gpx>'
    with pytest.raises(ValueError, match=r"bad\.gpx: declares a document type"):
        read(tmp_path / "bad.gpx", text.replace("SECRET", secret.as_uri()))
    with pytest.raises(ValueError, match=r"bad\.gpx: is not well-formed XML: undefined entity"):
        read(tmp_path / "bad.gpx", gpx("<trk><name>&a9;</name></trk>"))


@pytest.mark.parametrize(
    ("inner", "message"),
    [
        ("<a>" * 200 + "</a>" * 200, "more than 100 elements inside each other are not read"),
        ("<a/>" * 1001, "more than 1000 elements are not read"),
        ("<a>" + "x" * 33 * 2**20 + "</a>", "bytes are too many: at most 33554432 are read"),
    ],
    ids=["deep", "many", "long"],
)
def test_xml_is_bounded(
    inner: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trajectories.xml_tree.MOST_ELEMENTS", 1000)
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "big.gpx", gpx(inner))


def test_an_unknown_encoding_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"x\.gpx: .*encoding"):
        read(tmp_path / "x.gpx", '<?xml version="1.0" encoding="klingon"?><gpx></gpx>')


@pytest.mark.parametrize("kind", ["gpx", "kml", "geojson", "nmea"])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_files_are_read_or_refused_in_one_line(kind: str, data: st.DataObject) -> None:
    text = lap_of(kind)[:1500]
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(text)))
        stop = data.draw(st.integers(start, min(start + 30, len(text))))
        inner = data.draw(
            st.sampled_from(["", "nan", "1e999", "[", "}", "<", "-->", ",", "S", "\0"])
        )
        text = text[:start] + inner + text[stop:]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"x.{kind}"
        file.write_text(text)
        message = f"{file}: "
        try:
            reader = reader_of(file, text.encode())
            if reader is not None:
                raw = reader(file, None)
                assert {len(values) for values in raw.columns.values()} == {len(raw.places)}
        except ValueError as error:
            message = str(error)
    assert message.startswith(f"{file}: ")
    assert message.isprintable()
