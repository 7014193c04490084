"""OpenDRIVE roads and CommonRoad lanelets against closed forms, and their flaws by name."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import fresnel

from trajectories import load
from trajectories.formats import reader_of
from trajectories.raw_path import RawPath

Place = tuple[float, float, float]


def read(file: Path, text: str, part: str | None = None) -> RawPath:
    file.write_text(text)
    reader = reader_of(file, text[:400].encode())
    assert reader is not None
    return reader(file, part)


def points(raw: RawPath) -> np.ndarray:
    return np.column_stack([raw.columns["x"], raw.columns["y"]])


# --- OpenDRIVE ---


def geometry(shape: str, length: float, s: float = 0.0, at: Place = (0.0, 0.0, 0.0)) -> str:
    x, y, heading = at
    return (
        f'<geometry s="{s!r}" x="{x!r}" y="{y!r}" hdg="{heading!r}" length="{length!r}">'
        f"{shape}</geometry>"
    )


def road(name: str, *geometries: str, length: float = 50.0, lanes: str = "") -> str:
    return (
        f'<road name="" length="{length!r}" id="{name}" junction="-1">'
        f"<planView>{''.join(geometries)}</planView>{lanes}</road>"
    )


def drive(*roads: str, header: str = "") -> str:
    return (
        '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4">'
        f"{header}</header>{''.join(roads)}</OpenDRIVE>"
    )


LINE = "<line/>"
STRAIGHT = road("1", geometry(LINE, 50.0))


def test_a_straight_road(tmp_path: Path) -> None:
    raw = read(tmp_path / "40.xodr", drive(STRAIGHT))
    found = points(raw)
    assert (raw.kind, raw.name, raw.closed) == ("OpenDRIVE road", "40", None)
    np.testing.assert_array_equal(found[:, 0], np.linspace(0.0, 50.0, 101))
    assert not found[:, 1].any()
    assert "part" not in raw.metadata
    path = load(tmp_path / "40.xodr")
    assert (path.closed, path.length) == (False, pytest.approx(50.0, abs=1e-6))


def test_an_arc_lies_on_its_circle(tmp_path: Path) -> None:
    at = (10.0, -5.0, 0.7)
    text = drive(road("1", geometry('<arc curvature="-0.05"/>', 40.0, at=at)))
    found = points(read(tmp_path / "arc.xodr", text))
    centre = np.array([at[0], at[1]]) + 20.0 * np.array([math.sin(0.7), -math.cos(0.7)])
    np.testing.assert_allclose(np.hypot(*(found - centre).T), 20.0, rtol=1e-12)
    last = 0.7 + math.pi / 2 - 2.0
    end = centre + 20.0 * np.array([math.cos(last), math.sin(last)])
    np.testing.assert_allclose(found[-1], end, atol=1e-11)


@pytest.mark.parametrize(("length", "curvature"), [(60.0, 0.1), (35.0, -0.04), (300.0, 0.01)])
def test_a_spiral_is_a_clothoid(length: float, curvature: float, tmp_path: Path) -> None:
    shape = f'<spiral curvStart="0.0" curvEnd="{curvature!r}"/>'
    found = points(read(tmp_path / "s.xodr", drive(road("1", geometry(shape, length)))))
    s = np.linspace(0.0, length, len(found))
    scale = math.sqrt(math.pi * length / abs(curvature))
    sine, cosine = fresnel(s / scale)
    expected = scale * np.column_stack([cosine, math.copysign(1.0, curvature) * sine])
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_a_spiral_between_two_curvatures_is_part_of_a_clothoid(tmp_path: Path) -> None:
    """From 0.02 to 0.05 1/m in 30 m: the clothoid from 0 with the same slope, from 20 m on."""
    whole = '<spiral curvStart="0" curvEnd="0.05"/>'
    part = '<spiral curvStart="0.02" curvEnd="0.05"/>'
    long = points(read(tmp_path / "a.xodr", drive(road("1", geometry(whole, 50.0)))))
    start, turned = long[40].tolist(), 0.5 * 0.02 * 20.0
    text = drive(road("1", geometry(part, 30.0, at=(start[0], start[1], turned))))
    np.testing.assert_allclose(points(read(tmp_path / "b.xodr", text)), long[40:], atol=1e-11)


def test_a_poly3_is_its_cubic_and_as_long_as_stated(tmp_path: Path) -> None:
    text = drive(road("1", geometry('<poly3 a="0" b="0" c="0.01" d="-1e-4"/>', 40.0)))
    found = points(read(tmp_path / "p.xodr", text))
    u = found[:, 0]
    np.testing.assert_allclose(found[:, 1], 0.01 * u**2 - 1e-4 * u**3, atol=1e-12)
    fine = np.linspace(0.0, u[-1], 100_001)
    length = np.hypot(1.0, 0.02 * fine - 3e-4 * fine**2).mean() * u[-1]
    assert length == pytest.approx(40.0, rel=1e-5)


@pytest.mark.parametrize("kind", ["arcLength", "normalized", None])
def test_both_ranges_of_parametric_cubics(kind: str | None, tmp_path: Path) -> None:
    """A parabola u = 30 p, v = 8 p^2 for p in [0, 1], turned by 90 degrees; no range is [0, 1]."""
    bend = 2.0 * 8.0 / 30.0  # slope at the end; length of a parabola in closed form
    length = 0.5 * 30.0 * (math.hypot(1.0, bend) + math.asinh(bend) / bend)
    scale = 1.0 if kind != "arcLength" else length
    shape = (
        f'<paramPoly3 aU="0" bU="{30.0 / scale!r}" cU="0" dU="0" aV="0" bV="0" '
        f'cV="{8.0 / scale**2!r}" dV="0"' + (f' pRange="{kind}"/>' if kind else "/>")
    )
    text = drive(road("1", geometry(shape, length, at=(1.0, 2.0, math.pi / 2))))
    found = points(read(tmp_path / "pp.xodr", text))
    u, v = found[:, 1] - 2.0, -(found[:, 0] - 1.0)
    np.testing.assert_allclose(v, 8.0 * (u / 30.0) ** 2, atol=1e-12)
    np.testing.assert_allclose(found[-1], [1.0 - 8.0, 2.0 + 30.0], atol=1e-12)
    assert np.hypot(*np.diff(found, axis=0).T).max() < 0.6


def test_a_wrong_range_of_parametric_cubics_is_refused(tmp_path: Path) -> None:
    shape = '<paramPoly3 aU="0" bU="1" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0"/>'
    with pytest.raises(ValueError, match=r"is 1 m long, not 50 m: pRange None may be wrong"):
        read(tmp_path / "pp.xodr", drive(road("1", geometry(shape, 50.0))))


def test_geometries_follow_each_other_and_must_meet(tmp_path: Path) -> None:
    first = geometry(LINE, 20.0)
    tiny = geometry(LINE, 1e-6, s=20.0, at=(20.0, 0.0, 0.0))
    second = geometry('<arc curvature="0.1"/>', 10.0, s=20.0, at=(20.0, 0.0, 0.0))
    found = points(read(tmp_path / "two.xodr", drive(road("1", first, tiny, second))))
    steps = np.hypot(*np.diff(found, axis=0).T)
    assert len(found) == 61
    assert steps.min() > 0.499
    apart = geometry(LINE, 20.0, s=20.0, at=(23.0, 4.0, 0.0))
    with pytest.raises(ValueError, match=r"geometry at s = 20 m begins 5 m from the end of the"):
        read(tmp_path / "apart.xodr", drive(road("1", first, apart)))


def test_the_longest_road_unless_a_route_is_named(tmp_path: Path) -> None:
    file = tmp_path / "many.xodr"
    text = drive(
        road("12", geometry(LINE, 20.0), length=20.0),
        road("7", geometry(LINE, 30.0, at=(20.3, 0.0, 0.0)), length=30.0),
        road("9", geometry(LINE, 15.0, at=(65.0, 0.0, math.pi)), length=15.0),
        header="<geoReference><![CDATA[+proj=utm +zone=32 +datum=WGS84]]></geoReference>",
    )
    raw = read(file, text)
    assert raw.metadata["part"] == "road 7, the longest of 3 (the option part names others)"
    assert raw.metadata["geo_reference"] == "+proj=utm +zone=32 +datum=WGS84"
    assert points(read(file, text, "12"))[-1].tolist() == [20.0, 0.0]
    raw = read(file, text, "12,7,-9")
    assert raw.metadata["part"] == "roads 12,7,-9 of 3"
    found = points(raw)
    np.testing.assert_allclose(found[[0, -1]], [[0.0, 0.0], [65.0, 0.0]], atol=1e-12)
    assert (np.diff(found[:, 0]) > 0.15).all()
    assert (len(raw.places), raw.places[-1]) == (len(found), "road -9, s = 0.00 m")
    with pytest.raises(ValueError, match=r"road 9 begins 14.7 m from .* 7, .*: write -9 to drive"):
        read(file, text, "12,7,9")
    with pytest.raises(ValueError, match=r"road -9 begins 30 m from the end of 12, more than 0.5"):
        read(file, text, "12,-9")
    with pytest.raises(ValueError, match=r"has no road '5': it has 12, 7, 9"):
        read(file, text, "12,5")


def lane(number: int, *widths: str, successor: int | None = None) -> str:
    link = "" if successor is None else f'<link><successor id="{successor}"/></link>'
    return f'<lane id="{number}" type="driving">{link}{"".join(widths)}</lane>'


def width(a: float, b: float = 0.0, c: float = 0.0, d: float = 0.0, at: float = 0.0) -> str:
    return f'<width sOffset="{at!r}" a="{a!r}" b="{b!r}" c="{c!r}" d="{d!r}"/>'


LANES = (
    '<lanes><laneOffset s="0" a="1.0" b="0" c="0" d="0"/>'
    '<laneOffset s="25" a="1.0" b="0.02" c="0" d="0"/>'
    '<laneSection s="0"><left>' + lane(2, width(2.0)) + lane(1, width(3.0)) + "</left>"
    '<center><lane id="0"/></center><right>'
    + lane(-1, width(3.5), successor=-2) + "</right></laneSection>"
    '<laneSection s="30"><right>' + lane(-1, width(0.5))
    + lane(-2, width(3.5), width(3.5, 0.1, at=10.0)) + "</right></laneSection></lanes>"
)  # fmt: skip


def test_the_centre_of_a_lane_follows_offsets_widths_and_links(tmp_path: Path) -> None:
    text = drive(road("1", geometry(LINE, 50.0, at=(0.0, 0.0, math.pi / 2)), lanes=LANES))
    file = tmp_path / "lanes.xodr"
    raw = read(file, text, "1:-1")
    assert raw.kind == "OpenDRIVE lane"
    s, left = raw.columns["y"], -raw.columns["x"]
    np.testing.assert_allclose(s, np.linspace(0.0, 50.0, 101), atol=1e-12)
    offset = np.where(s < 25.0, 1.0, 1.0 + 0.02 * (s - 25.0))
    full = np.where(s < 40.0, 3.5, 3.5 + 0.1 * (s - 40.0))
    inner = np.where(s < 30.0, 0.0, 0.5)
    np.testing.assert_allclose(left, offset - inner - 0.5 * full, atol=1e-12)
    np.testing.assert_allclose(raw.columns["width_left"], 0.5 * full, atol=1e-12)
    np.testing.assert_array_equal(raw.columns["width_left"], raw.columns["width_right"])
    back = read(file, text, "-1:-1")
    np.testing.assert_array_equal(points(back), points(raw)[::-1])
    with pytest.raises(ValueError, match=r"road 1 has no lane '2' at s = 30 m: it has -1, -2"):
        read(file, text, "1:2")
    with pytest.raises(ValueError, match=r"road 1 has no lane '9' at s = 0 m: it has -1, 1, 2"):
        read(file, text, "1:9")


def test_lanes_of_a_bend_are_parallel_to_it(tmp_path: Path) -> None:
    lanes = f'<lanes><laneSection s="0"><left>{lane(1, width(4.0))}</left></laneSection></lanes>'
    text = drive(road("1", geometry('<arc curvature="0.02"/>', 60.0), lanes=lanes))
    found = points(read(tmp_path / "bend.xodr", text, "1:1"))
    np.testing.assert_allclose(np.hypot(*(found - [0.0, 50.0]).T), 48.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (drive(), "has no roads"),
        (drive(road("1")), "the length of road 1 must be|has no geometry"),
        (drive(road("1", geometry("<nurbs/>", 9.0))), "is no line, arc, spiral, poly3 or param"),
        (drive(road("1", geometry("<arc/>", 9.0))), "curvature of arc: None is not a finite"),
        (drive(road("1", geometry(LINE, math.inf))), "length of geometry: 'inf' is not a finite"),
        (drive(road("1", geometry(LINE, 1e9))), "length of road 1 must be .*at most 30000 m"),
        (drive(road("1", geometry(LINE, -5.0))), "length of road 1 must be"),
        (
            drive(road("1", geometry('<spiral curvStart="0" curvEnd="1e308"/>', 90.0))),
            "road 1 has numbers that are too large",
        ),
    ],
)  # fmt: skip
def test_flaws_of_roads_are_named(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "bad.xodr", text)


def test_a_route_is_loaded_as_a_path(tmp_path: Path) -> None:
    """A straight, a quarter of a circle of 20 m, and a straight that is drawn backwards."""
    file = tmp_path / "route.xodr"
    file.write_text(
        drive(
            road("a", geometry(LINE, 40.0)),
            road("b", geometry('<arc curvature="0.05"/>', 10.0 * math.pi, at=(40.0, 0.0, 0.0))),
            road("c", geometry(LINE, 40.0, at=(60.0, 60.0, -math.pi / 2))),
        )
    )
    path = load(file, part="a,b,-c", smoothing=0.0)
    assert path.length == pytest.approx(80.0 + 10.0 * math.pi, rel=1e-3)
    assert path.heading[-1] == pytest.approx(math.pi / 2, abs=1e-3)
    assert path.curvature[len(path.curvature) // 2] == pytest.approx(0.05, rel=0.05)
    assert path.metadata["imported"].startswith("OpenDRIVE road of")
    assert "roads a,b,-c of 3" in path.metadata["imported"]


# --- CommonRoad ---


def bound(side: str, line: list[tuple[float, float]]) -> str:
    inner = "".join(f"<point><x>{x!r}</x><y>{y!r}</y></point>" for x, y in line)
    return f"<{side}Bound>{inner}</{side}Bound>"


def lanelet(
    name: int,
    left: list[tuple[float, float]],
    right: list[tuple[float, float]],
    *successors: int,
) -> str:
    links = "".join(f'<successor ref="{other}"/>' for other in successors)
    return f'<lanelet id="{name}">{bound("left", left)}{bound("right", right)}{links}</lanelet>'


def straight(name: int, start: float, stop: float, *successors: int) -> str:
    left, right = [(start, 2.0), (stop, 2.0)], [(start, -2.0), (stop, -2.0)]
    return lanelet(name, left, right, *successors)


def scenario(*lanelets: str) -> str:
    return (
        "<?xml version='1.0' encoding='UTF-8'?>\n"
        f'<commonRoad timeStepSize="0.1" commonRoadVersion="2020a">{"".join(lanelets)}</commonRoad>'
    )


def test_a_lanelet_of_two_points_is_read(tmp_path: Path) -> None:
    raw = read(tmp_path / "41_commonroad.xml", scenario(straight(1, 0.0, 50.0)))
    found = points(raw)
    np.testing.assert_allclose(found[[0, -1]], [[0.0, 0.0], [50.0, 0.0]])
    path = load(tmp_path / "41_commonroad.xml")
    assert path.length == pytest.approx(50.0, abs=1e-6)
    assert path.widths is not None
    np.testing.assert_allclose(path.widths, 2.0)
    assert (raw.columns["width_left"] == 2.0).all()
    assert (raw.columns["width_right"] == 2.0).all()


def test_the_longest_chain_of_successors(tmp_path: Path) -> None:
    """3 and 2 follow 1; 4 follows 2 but begins elsewhere; 5 is alone and longer than each."""
    text = scenario(
        straight(1, 0.0, 30.0, 3, 2), straight(2, 30.0, 60.0, 4), straight(3, 30.0, 40.0),
        straight(4, 90.0, 130.0), straight(5, 200.0, 245.0),
    )  # fmt: skip
    file = tmp_path / "chain.xml"
    raw = read(file, text)
    assert raw.metadata["part"] == "lanelets 1,2, the longest of 5 (the option part names others)"
    assert points(raw)[[0, -1], 0].tolist() == [0.0, 60.0]
    assert (np.diff(points(raw)[:, 0]) > 0.0).all()
    assert points(read(file, text, "1,3"))[-1, 0] == 40.0
    assert points(read(file, text, "-3"))[[0, -1], 0].tolist() == [40.0, 30.0]
    with pytest.raises(ValueError, match="lanelet 4 begins 30 m from the end of 2"):
        read(file, text, "1,2,4")


def test_a_roundabout_is_one_lap(tmp_path: Path) -> None:
    def arc(name: int, successor: int) -> str:
        angles = np.linspace(0.0, math.pi / 2, 16) + name * math.pi / 2
        sides = [
            [(r * math.cos(a), r * math.sin(a)) for a in angles.tolist()] for r in (18.0, 22.0)
        ]
        return lanelet(name, sides[0], sides[1], successor)

    raw = read(tmp_path / "ring.xml", scenario(*(arc(k, (k + 1) % 4) for k in range(4))))
    found = points(raw)
    np.testing.assert_allclose(np.hypot(*found.T), 20.0, rtol=1e-12)
    np.testing.assert_allclose(found[0], found[-1], atol=1e-12)
    assert len(found) == 4 * 15 + 1
    np.testing.assert_allclose(raw.columns["width_left"], 2.0, rtol=1e-12)


def test_bounds_with_different_numbers_of_points(tmp_path: Path) -> None:
    left = [(0.0, 2.0), (10.0, 2.0), (40.0, 2.0)]
    text = scenario(lanelet(1, left, [(0.0, -2.0), (40.0, -2.0)]))
    raw = read(tmp_path / "uneven.xml", text)
    assert not raw.columns["y"].any()
    assert points(raw)[[0, -1], 0].tolist() == [0.0, 40.0]


def test_a_chain_of_thousands_needs_no_recursion(tmp_path: Path) -> None:
    count = 3000
    text = scenario(*(straight(k, 10.0 * k, 10.0 * k + 10.0, k + 1) for k in range(count)))
    raw = read(tmp_path / "long.xml", text)
    assert points(raw)[[0, -1], 0].tolist() == [0.0, 10.0 * count]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (scenario(), "has no lanelets"),
        (scenario('<lanelet id="1"/>'), "lanelet 1: its leftBound has 0 points, 2 are needed"),
        (
            scenario('<lanelet id="1"><leftBound><point><x>a</x></point></leftBound></lanelet>'),
            "lanelet 1: x of its leftBound: 'a' is not a finite number",
        ),
        (scenario(straight(1, -1e308, 1e308)), "lanelet 1 is inf m long, at most 30000 are read"),
    ],
)
def test_flaws_of_lanelets_are_named(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "bad.xml", text)
