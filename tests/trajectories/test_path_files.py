"""Path files: bit-identical round trips, importers against known geometry, every error named."""

import math
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trajectories import ReferencePath, SpeedLimits, load, statistics
from trajectories.files import read, read_gps, read_native, read_racetrack, read_xy, write
from trajectories.geodesy import earth_centred, east_north_up

TRACKS = Path(__file__).parents[3] / "shared/tracks"
ARRAYS = (
    "arc_length", "x", "y", "heading", "curvature", "speed", "acceleration", "time",
)  # fmt: skip


def same(one: ReferencePath, other: ReferencePath) -> bool:
    return all(np.array_equal(getattr(one, a), getattr(other, a)) for a in ARRAYS)


# --- native format ---


@pytest.mark.parametrize("name", ["T2", "T4-raw", "circle", "figure-eight", "random-3"])
def test_round_trip_is_bit_identical(name: str, tmp_path: Path) -> None:
    path, file = load(name), tmp_path / "path.csv"
    write(path, file)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        back = load(file)
    assert same(path, back)
    assert (back.name, back.closed) == (path.name, path.closed)
    assert {k: v for k, v in back.metadata.items() if k not in {"frame", "achieved"}} == dict(
        path.metadata
    )
    assert back.metadata["achieved"]["total_curvature"] == statistics(path).total_curvature
    again = tmp_path / "again.csv"
    write(back, again)
    assert again.read_bytes() == file.read_bytes()


def test_the_file_is_as_specified(tmp_path: Path) -> None:
    file = tmp_path / "T2.csv"
    write(load("T2"), file)
    lines = file.read_text().splitlines()
    assert lines[0] == '# format: "refpath/1"'
    assert '# name: "T2"' in lines
    assert "# closed: false" in lines
    for key in ("frame", "source", "published", "achieved", "limits", "generator"):
        assert sum(line.startswith(f"# {key}: ") for line in lines) == 1
    header = lines.index("s_m,x_m,y_m,psi_rad,kappa_1pm,v_mps,ax_mps2,t_s")
    assert len(lines) - header - 1 == len(load("T2").x)


def test_speed_can_be_replanned_and_the_name_changed(tmp_path: Path) -> None:
    file = tmp_path / "T2.csv"
    write(load("T2").with_speed(12.0), file)
    assert (read_native(file).speed == 12.0).all()
    limits = SpeedLimits(max_speed=5.0, max_lateral_acceleration=1.0, max_acceleration=1.0)
    path = read_native(file, limits=limits, name="slow")
    assert path.name == "slow"
    assert path.speed.max() <= 5.0
    assert path.metadata["limits"]["max_speed"] == 5.0
    assert (path.speed**2 * np.abs(path.curvature)).max() <= 1.005


def edited(tmp_path: Path, edit: Callable[[list[str]], list[str]], name: str = "T2") -> Path:
    """A native file after an edit of its lines; rows start at line number `first_row`."""
    file = tmp_path / "edited.csv"
    write(load(name), file)
    file.write_text("\n".join(edit(file.read_text().split("\n"))))
    return file


def first_row(lines: list[str]) -> int:
    return next(k for k, line in enumerate(lines) if line.startswith("s_m,")) + 1


def change_column(
    column: int, change: Callable[[float], str], rows: slice = slice(None)
) -> Callable[[list[str]], list[str]]:
    """An edit that changes one column's cells in some rows."""

    def edit(lines: list[str]) -> list[str]:
        first = first_row(lines)
        for k in range(first, len(lines) - 1)[rows]:
            cells = lines[k].split(",")
            cells[column] = change(float(cells[column]))
            lines[k] = ",".join(cells)
        return lines

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda ls: [ls[0].replace("/1", "/2"), *ls[1:]], "format 'refpath/2' is not known"),
        (lambda ls: ls[:-40], "torn"),
        (lambda ls: [*ls[:-2], ls[-2][:-3]], "torn: line .* has no end"),
        (lambda ls: [*ls[:-41], ""], "torn: .* of 2054 points"),
        (lambda ls: [*ls[:-41], ls[-41][:20], ""], "columns, not 8"),
        (lambda ls: [ls[0], "# limits {", *ls[1:]], "line 2 is not '# key: JSON'"),
        (lambda ls: [ls[0], "# limits: {", *ls[1:]], "line 2: limits: is not JSON"),
        (lambda ls: [ls[0], "# a: " + "[" * 100_000, *ls[1:]], "line 2: a: is not JSON"),
        (lambda ls: [ls[0], "# a: NaN", *ls[1:]], "line 2: a: is not JSON"),
        (lambda ls: [ls[0], *ls], "line 2 is not .* new key"),
        (lambda ls: [ln.replace("false", "3") for ln in ls], r"`int` - at `\$.closed`"),
        (lambda ls: [ln.replace("psi_rad", "psi") for ln in ls], "is not the header"),
        (lambda ls: [ln.replace("false", "true") for ln in ls], "ends are .* apart"),
        (change_column(1, lambda _: "nan", slice(7, 8)), "column x_m: 'nan' is not finite"),
        (change_column(5, lambda _: "fast", slice(7, 8)), "column v_mps: 'fast' is not a number"),
        (change_column(5, lambda _: "-1.0", slice(7, 8)), r"speed\[7\] is -1.0"),
        (change_column(0, lambda _: "3.0", slice(40, 41)), "does not increase at index 40"),
        (change_column(0, lambda s: repr(1.2 * s)), "s_m disagrees .* at index 1 "),
        (change_column(3, lambda p: repr(p + 0.1)), "psi_rad disagrees .* at index 0 "),
        (change_column(3, lambda p: repr(-p)), r"heading\[296\] is .* must be in radians"),
        (change_column(4, lambda k: repr(-k)), "kappa_1pm disagrees"),
        (change_column(4, lambda k: repr(1.3 * k)), "kappa_1pm disagrees"),
        (change_column(4, lambda _: "0.05", slice(9, 10)), "kappa_1pm disagrees .* at index 9 "),
        (change_column(2, lambda y: repr(y + 0.1), slice(9, 10)), "disagrees"),
    ],
)  # fmt: skip
def test_bad_native_files_are_refused(
    tmp_path: Path, edit: Callable[[list[str]], list[str]], message: str
) -> None:
    file = edited(tmp_path, edit)
    with pytest.raises(ValueError, match=message) as caught:
        read(file)
    assert "edited.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_wrapped_headings_are_unwrapped(tmp_path: Path) -> None:
    wrapped = change_column(3, lambda psi: repr(math.remainder(psi, 2 * math.pi)))
    path = read(edited(tmp_path, wrapped))
    assert np.abs(np.diff(path.heading)).max() < 0.1
    np.testing.assert_allclose(path.heading, load("T2").heading, atol=1e-12)


def test_time_that_does_not_follow_from_speed_is_warned_of(tmp_path: Path) -> None:
    file = edited(tmp_path, change_column(7, lambda t: repr(1.1 * t)))
    with pytest.warns(UserWarning, match="t_s does not follow from v_mps"):
        path = read(file)
    np.testing.assert_array_equal(path.time, load("T2").time)


def test_coordinates_rounded_to_millimetres_are_accepted(tmp_path: Path) -> None:
    file = tmp_path / "rounded.csv"
    write(load("T4"), file)
    lines = file.read_text().split("\n")
    for column in (1, 2):
        lines = change_column(column, lambda v: f"{v:.3f}")(lines)
    file.write_text("\n".join(lines))
    path = read(file)
    np.testing.assert_allclose(path.x, load("T4").x, atol=6e-4)


def test_metadata_that_json_cannot_hold_is_named(tmp_path: Path) -> None:
    path = load("T2")
    for key, value in (("odd", object()), ("infinite", math.inf)):
        with pytest.raises(ValueError, match=f"metadata.'{key}'. cannot be written"):
            write(path.with_speed(path.speed, **{key: value}), tmp_path / "T2.csv")
    with pytest.raises(ValueError, match="must be a word"):
        write(path.with_speed(path.speed, **{"two\nlines": 1}), tmp_path / "T2.csv")
    write(path.with_speed(path.speed, numbers=np.arange(3), one=np.float64(2)), tmp_path / "a.csv")
    assert read(tmp_path / "a.csv").metadata["numbers"] == [0, 1, 2]
    assert os.listdir(tmp_path) == ["a.csv"]  # noqa: PTH208


def test_a_failed_write_leaves_the_old_file_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "path.csv"
    write(load("straight"), file)
    before = file.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot write the path: No space left.*path\.csv"):
        write(load("T2"), file)
    assert file.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["path.csv"]
    with pytest.raises(OSError, match=r"cannot write the path.*nowhere"):
        write(load("T2"), tmp_path / "nowhere" / "path.csv")


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    for file, message in ((tmp_path / "none.csv", "cannot be read"), (tmp_path, "cannot be read")):
        with pytest.raises(ValueError, match=message) as caught:
            read(file)
        assert str(file) in str(caught.value)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\x80\x81\x82")
    with pytest.raises(ValueError, match="not a text file"):
        read(binary)
    (tmp_path / "empty.csv").write_text("")
    with pytest.raises(ValueError, match="no rows"):
        read(tmp_path / "empty.csv")


# --- importers ---


def table(tmp_path: Path, points: np.ndarray, header: str = "", separator: str = ",") -> Path:
    file = tmp_path / "points.csv"
    rows = [separator.join(map(repr, row)) for row in np.asarray(points).tolist()]
    file.write_text("\n".join(([header] if header else []) + rows) + "\n")
    return file


def circle(radius: float = 30.0, n: int = 60) -> np.ndarray:
    t = 2 * math.pi * np.arange(n) / n
    return radius * np.column_stack([np.cos(t), np.sin(t)])


def sine(n: int = 81) -> np.ndarray:
    x = np.linspace(0.0, 160.0, n)
    return np.column_stack([x, 2.0 * np.sin(2 * np.pi * x / 40.0)])


@pytest.mark.parametrize("header", ["", "x,y", "# x_m,y_m", "East,North", '"x","y"', "# hello"])
@pytest.mark.parametrize("separator", [",", ";"])
def test_plain_points(tmp_path: Path, header: str, separator: str) -> None:
    path = read(table(tmp_path, sine(), header.replace(",", separator), separator))
    assert path.name == "points"
    assert not path.closed
    assert path.metadata["source"] == "x,y waypoints: points.csv"
    assert path.metadata["warnings"] == []
    assert 0.03 < path.metadata["rms_deviation"] <= 0.05
    assert path.metadata["rms_deviation"] <= path.metadata["max_deviation"] < 0.2
    # Reported deviation is measured from the points: none is further from the path.
    feet = [abs(path.project(x, y).lateral_error) for x, y in sine()[1:-1]]
    assert max(feet) <= path.metadata["max_deviation"] + 1e-3
    assert np.abs(path.curvature).max() == pytest.approx(2.0 * (2 * np.pi / 40.0) ** 2, rel=0.06)


def test_interpolation_of_a_circle_is_the_circle(tmp_path: Path) -> None:
    path = read_xy(table(tmp_path, circle()), smoothing=0.0)
    assert path.closed
    assert path.length == pytest.approx(2 * math.pi * 30.0, rel=1e-5)
    np.testing.assert_allclose(path.curvature, 1 / 30.0, rtol=5e-3)
    assert path.metadata["max_deviation"] < 1e-9
    assert path.speed.max() == pytest.approx(math.sqrt(2.0 * 30.0), rel=5e-3)


def test_smoothing_a_circle_shrinks_it_by_what_is_reported(tmp_path: Path) -> None:
    path = read_xy(table(tmp_path, circle()), smoothing=0.1)
    radius = np.hypot(path.x, path.y)
    deviation = path.metadata["max_deviation"]
    assert 0.05 < deviation <= 0.11
    np.testing.assert_allclose(radius, 30.0 - deviation, atol=2e-3)
    np.testing.assert_allclose(path.curvature, 1 / (30.0 - deviation), rtol=1e-3)


def test_smoothing_takes_out_noise(tmp_path: Path) -> None:
    true = load("u-turn")
    points = np.column_stack([true.x, true.y])[::8]
    noisy = points + 0.05 * np.random.default_rng(1).normal(size=points.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rough = read_xy(table(tmp_path, noisy), smoothing=0.0)
    smooth = read_xy(table(tmp_path, noisy), smoothing=0.07)
    assert np.abs(rough.curvature).max() > 0.13
    assert np.abs(smooth.curvature).max() < 0.12
    errors = [smooth.project(x, y).lateral_error for x, y in points]
    assert np.sqrt(np.mean(np.square(errors))) < 0.05


def test_repeated_first_point_closes(tmp_path: Path) -> None:
    points = circle()
    path = read(table(tmp_path, np.vstack([points, points[:1]])))
    assert path.closed
    assert path.metadata["warnings"] == []
    assert not read_xy(table(tmp_path, points), closed=False).closed


def test_scale_and_limits(tmp_path: Path) -> None:
    limits = SpeedLimits(max_speed=3.0, max_lateral_acceleration=1.0, max_acceleration=1.0)
    path = read_xy(table(tmp_path, circle()), scale=0.5, limits=limits, name="half")
    assert path.length == pytest.approx(math.pi * 30.0, rel=1e-2)
    assert path.name == "half"
    assert path.speed.max() == pytest.approx(3.0)
    assert path.metadata["scale"] == 0.5
    assert path.metadata["limits"]["max_speed"] == 3.0
    for bad in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="scale must be positive"):
            read_xy(table(tmp_path, circle()), scale=bad)
        with pytest.raises(ValueError, match="smoothing must be"):
            read_xy(table(tmp_path, circle()), smoothing=bad - 1.0)


def test_further_columns_are_found_by_name(tmp_path: Path) -> None:
    points = sine()
    rows = np.column_stack([np.arange(81), points[:, 1], points[:, 0]])
    named = read(table(tmp_path, rows, "index;y_m;x_m", ";"))
    assert same(named, read(table(tmp_path, points)))


@pytest.mark.parametrize("closed", [True, False])
def test_imported_paths_survive_a_round_trip(tmp_path: Path, closed: bool) -> None:
    path = read(table(tmp_path, circle() if closed else sine()))
    assert path.closed == closed
    write(path, tmp_path / "native.csv")
    assert same(read(tmp_path / "native.csv"), path)


def test_warnings_are_given_and_kept(tmp_path: Path) -> None:
    points = sine()

    def warned(points: np.ndarray, message: str) -> ReferencePath:
        with pytest.warns(UserWarning, match=message):
            path = read(table(tmp_path, points))
        assert any(message in warning for warning in path.metadata["warnings"])
        return path

    doubled = np.insert(points, 20, points[20] + 5e-4, axis=0)
    path = warned(doubled, "1 duplicates under 1 mm merged")
    assert "line 22" in path.metadata["warnings"][0]
    gap = points[(points[:, 0] < 60) | (points[:, 0] > 84)]
    warned(gap, "gap of ")
    t = np.linspace(0.0, 2 * np.pi, 120)[:-1]
    eight = np.column_stack([40 * np.sin(t), 20 * np.sin(2 * t)])
    crossing = warned(eight, "of itself")
    assert crossing.closed
    assert crossing.speed.min() > 1.0
    tight = np.column_stack([np.r_[0:20:1.0, 20 + 4 * np.sin(np.linspace(0, np.pi, 9)), 19:0:-1.0],
                             np.r_[np.zeros(20), 4 - 4 * np.cos(np.linspace(0, np.pi, 9)),
                                   np.full(19, 8.0)]])  # fmt: skip
    slow = read(table(tmp_path, tight))
    assert slow.metadata["warnings"] == []
    corner = np.column_stack([np.r_[0:31:5, np.full(6, 30.0)], np.r_[np.zeros(7), 5:31:5]])
    warned(corner, "between points 5 m apart: more smoothing may widen it")
    bend = np.abs(slow.curvature) > 0.2
    assert bend.any()
    assert slow.speed[bend].max() <= math.sqrt(2.0 / 0.2) * 1.01


def test_the_seam_of_a_closed_path_is_no_approach(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(table(tmp_path, circle(n=90)))


def bad(index: int, column: int, value: float) -> np.ndarray:
    points = sine()
    points[index, column] = value
    return points


@pytest.mark.parametrize(
    ("points", "header", "message"),
    [
        (bad(4, 1, math.nan), "x,y", "line 6, column y: 'nan' is not finite"),
        (bad(4, 0, math.inf), "", "line 5, column x_m: 'inf' is not finite"),
        (bad(4, 0, 2e7), "", "line 5: coordinate beyond"),
        (sine()[:3], "", "3 distinct points, at least 4"),
        (np.repeat(sine()[:3], 3, axis=0), "", "3 distinct points, at least 4"),
        (sine()[[0, 1, 2, 3, 4, 2, 5, 6, 7]], "", "turns back by 1.. degrees at point 4 .line 5"),
        (np.vstack([sine(), sine()[::-1]]), "x,y", "turns back by 180 degrees"),
        (sine() * 1000, "", "are these metres"),
        (sine() / 1000, "", "look like degrees"),
        ([[48.1 + 1e-4 * k, 11.5] for k in range(9)], "", "look like degrees: name the columns"),
        ([[1, 2, 3]] * 5, "", "3 columns without a header"),
        (sine(), "a,b", "no columns x and y in its header"),
        (sine(), "lat,y", "a GPS log needs latitudes and longitudes"),
        ([[5e5, 5.3e6 + k] for k in range(9)], "lat,lon", "latitude 500000 is beyond 90"),
        ([[48.0, 400.0 + k] for k in range(9)], "lat,lon", "longitude 400 is beyond 180"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_bad_points_are_refused(
    tmp_path: Path, points: np.ndarray, header: str, message: str
) -> None:
    file = table(tmp_path, points, header)
    with pytest.raises(ValueError, match=message) as caught:
        read(file)
    assert "points.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_torn_table_is_refused(tmp_path: Path) -> None:
    file = table(tmp_path, sine(), "x,y")
    file.write_text(file.read_text().rsplit(",", 1)[0])
    with pytest.raises(ValueError, match=r"line .* has 1 columns, not 2: torn"):
        read(file)


def test_wrong_importer_says_so(tmp_path: Path) -> None:
    file = table(tmp_path, sine(), "x,y")
    with pytest.raises(ValueError, match="no racetrack-database file"):
        read_racetrack(file)
    with pytest.raises(ValueError, match="no GPS log"):
        read_gps(file)
    with pytest.raises(ValueError, match="format None is not known"):
        read_native(file)


# --- real circuits ---


@pytest.mark.skipif(not TRACKS.is_dir(), reason=f"no real circuits: {TRACKS} is absent")
@pytest.mark.parametrize(
    ("name", "sharpest", "length", "crosses"),
    [("Norisring", 0.105, 2296.0, False), ("Spielberg", 0.115, 4316.0, False),
     ("Suzuka", 0.06, 5803.0, True)],
)  # fmt: skip
def test_real_circuits(name: str, sharpest: float, length: float, crosses: bool) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        path = read(TRACKS / f"{name}.csv")
    assert path.closed
    assert path.name == name
    assert path.length == pytest.approx(length, rel=1e-3)
    assert np.abs(path.curvature).max() < sharpest
    assert path.metadata["rms_deviation"] <= 0.05
    assert path.metadata["max_deviation"] < 0.8
    assert any("of itself" in warning for warning in path.metadata["warnings"]) == crosses
    assert len(caught) == len(path.metadata["warnings"])
    assert abs(path.speed[0] - path.speed[-1]) == 0.0
    assert (path.speed**2 * np.abs(path.curvature)).max() <= 2.0 * 1.001


# --- GPS ---


def test_earth_centred_coordinates_of_known_places() -> None:
    # The ellipsoid's semi-axes: 6378137.0 m and 6356752.314245 m.
    xyz = earth_centred(np.array([0.0, 0.0, 90.0]), np.array([0.0, 90.0, 0.0]), np.zeros(3))
    np.testing.assert_allclose(xyz[0], [6378137.0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(xyz[1], [0, 6378137.0, 0], atol=1e-6)
    np.testing.assert_allclose(xyz[2], [0, 0, 6356752.314245], atol=1e-5)


@given(st.floats(-89, 89), st.floats(-180, 180), st.floats(-100, 5000))
def test_earth_centred_coordinates_lie_on_the_ellipsoid(
    latitude: float, longitude: float, height: float
) -> None:
    a, b = 6378137.0, 6356752.314245179
    ground = earth_centred(np.array([latitude]), np.array([longitude]), np.zeros(1))[0]
    assert (ground[0] ** 2 + ground[1] ** 2) / a**2 + ground[2] ** 2 / b**2 == pytest.approx(1.0)
    above = earth_centred(np.array([latitude]), np.array([longitude]), np.array([height]))[0]
    normal = ground / np.array([a * a, a * a, b * b])  # gradient of the ellipsoid's equation
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(above - ground, height * normal, atol=1e-6)
    assert math.degrees(math.asin(normal[2])) == pytest.approx(latitude, abs=1e-9)


def test_east_and_north_agree_with_the_radii_of_curvature() -> None:
    """Meridian and prime-vertical radii at 48 degrees: 6 371 841 m and 6 389 974 m or so."""
    phi, step = math.radians(48.0), 1e-5
    e2 = 6.69437999014e-3
    w = math.sqrt(1 - e2 * math.sin(phi) ** 2)
    meridian, vertical = 6378137.0 * (1 - e2) / w**3, 6378137.0 / w
    enu = east_north_up(
        np.array([48.0 + step, 48.0]), np.array([11.0, 11.0 + step]), np.full(2, 500.0),
        (48.0, 11.0, 500.0),
    )  # fmt: skip
    angle = math.radians(step)
    np.testing.assert_allclose(enu[0], [0.0, (meridian + 500) * angle, 0.0], atol=2e-6)
    np.testing.assert_allclose(
        enu[1], [(vertical + 500) * angle * math.cos(phi), 0.0, 0.0], atol=2e-6
    )


def gps_rows(points: np.ndarray, latitude: float = 48.0, longitude: float = 11.0) -> np.ndarray:
    """Latitude and longitude of points by the radii of curvature: exact to millimetres here."""
    e2, phi = 6.69437999014e-3, math.radians(latitude)
    w = math.sqrt(1 - e2 * math.sin(phi) ** 2)
    north, east = 6378137.0 * (1 - e2) / w**3, 6378137.0 / w * math.cos(phi)
    return np.column_stack([
        latitude + np.degrees(points[:, 1] / north), longitude + np.degrees(points[:, 0] / east)
    ])  # fmt: skip


def test_gps_log(tmp_path: Path) -> None:
    points = sine() - sine()[0]
    path = read(table(tmp_path, gps_rows(points), "lat,lon"))
    assert path.metadata["origin"] == {
        "latitude_deg": 48.0, "longitude_deg": 11.0, "height_m": 0.0,
    }  # fmt: skip
    assert "east" in path.metadata["frame"]
    assert path.metadata["dropped"] == 0
    close = read_gps(table(tmp_path, gps_rows(points), "Latitude,Longitude"), smoothing=0.0)
    for x, y in points[1:-1]:
        assert abs(close.project(x, y).lateral_error) < 5e-3
    assert close.length == pytest.approx(load("sine").length, abs=0.1)


def test_gps_standstill_is_dropped_first(tmp_path: Path) -> None:
    points = sine() - sine()[0]
    rng = np.random.default_rng(2)
    waiting = points[30] + 0.05 * rng.normal(size=(50, 2)).clip(-1.5, 1.5)
    log = np.vstack([points[:31], waiting, points[31:]])
    path = read(table(tmp_path, gps_rows(log), "lat,lon"))
    assert path.metadata["dropped"] == 50
    assert same(path, read(table(tmp_path, gps_rows(points), "lat,lon")))


def test_gps_height_time_and_origin(tmp_path: Path) -> None:
    rows = gps_rows(sine() - sine()[0])
    full = np.column_stack([np.arange(81.0), rows, np.full(81, 500.0)])
    file = table(tmp_path, full, "time;lat;lon;height", ";")
    path = read_gps(file)
    assert path.metadata["origin"]["height_m"] == 500.0
    shifted = read_gps(file, origin=(48.0, 10.999, 500.0))
    # 0.001 degree of longitude at 48 degrees: 74.6 m of the parallel.
    assert shifted.x[0] - path.x[0] == pytest.approx(74.63, abs=0.05)
    full[40, 0] = 3.0
    with pytest.raises(ValueError, match="line 42: time goes back"):
        read_gps(table(tmp_path, full, "time,lat,lon,height"))
    stamped = tmp_path / "stamped.csv"
    stamps = [f"2024-05-01T10:{k // 60:02d}:{k % 60:02d}Z" for k in range(81)]
    lines = [f"{t},{a!r},{o!r}" for t, (a, o) in zip(stamps, rows.tolist(), strict=True)]
    stamped.write_text("\n".join(["time,lat,lon", *lines]))
    assert read(stamped).length == pytest.approx(path.length, rel=1e-3)
    stamped.write_text("\n".join(["time,lat,lon", *lines[:40], "noon,48.0,11.0", *lines[40:]]))
    with pytest.raises(ValueError, match="line 42: 'noon' is not a time"):
        read(stamped)


def test_gps_over_the_date_line(tmp_path: Path) -> None:
    rows = gps_rows(sine() - sine()[0], longitude=179.999)
    rows[:, 1] = (rows[:, 1] + 180.0) % 360.0 - 180.0
    assert rows[:, 1].min() < 0
    assert read(table(tmp_path, rows, "lat,lon")).length < 170.0


# --- garbage ---

NUMBERS = st.one_of(
    st.floats(-300, 300).map(repr),
    st.sampled_from(["nan", "inf", "-1e400", "1e308", "", "x", "1_0", "0", "0x1", "١"]),
)


def read_or_refuse(file: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", RuntimeWarning)
        try:
            path = read(file)
        except ValueError as error:
            message = str(error)
        else:
            message = ""
            assert np.isfinite(path.table).all()
    assert not message or file.name in message
    assert "\n" not in message


@given(st.binary(max_size=300))
@settings(max_examples=100, deadline=None)
def test_any_bytes_are_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    file = tmp_path_factory.getbasetemp() / "garbage.csv"
    file.write_bytes(data)
    read_or_refuse(file)


@given(
    st.sampled_from(["", "x,y", "lat,lon", "# x_m,y_m,w_tr_right_m,w_tr_left_m", "#format: 3"]),
    st.lists(st.lists(NUMBERS, min_size=2, max_size=2), max_size=9),
    st.sampled_from(["", ",1,1"]),
)
@settings(max_examples=150, deadline=None)
def test_any_table_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, header: str, rows: list[list[str]], tail: str
) -> None:
    file = tmp_path_factory.getbasetemp() / "garbage.csv"
    file.write_text("\n".join([header, *(",".join(row) + tail for row in rows)]))
    read_or_refuse(file)


@given(
    st.lists(st.tuples(st.floats(0, 9), st.floats(-3, 3)), min_size=4, max_size=12), st.booleans()
)
@settings(max_examples=60, deadline=None)
def test_any_points_are_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[float, float]], closed: bool
) -> None:
    file = tmp_path_factory.getbasetemp() / "garbage.csv"
    points = np.cumsum(steps, axis=0)
    if closed:
        order = np.argsort(np.arctan2(*(points - points.mean(axis=0)).T))
        points = points[order]
    file.write_text("\n".join(f"{x!r},{y!r}" for x, y in points.tolist()))
    read_or_refuse(file)


@given(st.integers(0, 3000), st.binary(min_size=1, max_size=4))
@settings(max_examples=60, deadline=None)
def test_a_damaged_native_file_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, place: int, damage: bytes
) -> None:
    file = tmp_path_factory.getbasetemp() / "garbage.csv"
    path = load("u-turn")
    write(path, file)
    data = file.read_bytes()
    file.write_bytes(data[:place] + damage + data[place + len(damage) :])
    read_or_refuse(file)
