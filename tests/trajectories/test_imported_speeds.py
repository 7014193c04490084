"""Speeds, widths and ends of imported paths, the options of `load`, and paths of arrays."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trajectories
from lpv_track_env import vehicle
from trajectories import ReferencePath, SpeedLimits, load
from trajectories.files import read_native, write
from trajectories.import_options import ImportOptions
from trajectories.path import MINIMUM_SPEED


def table(folder: Path, header: str, *columns: Any) -> Path:
    file = folder / "points.csv"
    rows = np.column_stack(np.broadcast_arrays(*columns)).tolist()
    file.write_text("\n".join([header, *(",".join(map(repr, row)) for row in rows), ""]))
    return file


def circle(radius: float = 60.0, n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    angle = 2.0 * math.pi * np.arange(n) / n
    return radius * np.cos(angle), radius * np.sin(angle)


X = np.arange(0.0, 101.0)


# --- speeds of the file ---


def test_a_lap_takes_the_time_of_the_file(tmp_path: Path) -> None:
    """Speeds of a raceline come back: the lap's time is that of its rows, within 1 %."""
    x, y = circle(150.0, 400)
    speed = 16.0 + 3.0 * np.sin(np.linspace(0.0, 6.0 * math.pi, 400, endpoint=False))
    path = load(table(tmp_path, "# x_m,y_m,vx_mps", x, y, speed), vehicle=vehicle.load("bmw-320i"))
    step = 2.0 * math.pi * 150.0 / 400
    lap = float((2.0 * step / (speed + np.roll(speed, -1))).sum())
    assert path.closed
    assert path.duration == pytest.approx(lap, rel=1e-3)
    at = np.arange(400) * step * path.length / (400 * step)
    np.testing.assert_allclose(
        path.sample(at).speed, speed, atol=0.05
    )  # v^2 is linear between rows
    assert "speeds of vx_mps, 13 to 19 m/s, up to 2.4 m/s² laterally" in path.metadata["imported"]
    assert path.metadata["imported"].endswith("kept")


def test_squared_speeds_are_interpolated_so_that_accelerations_are_constant() -> None:
    points = np.column_stack([X[::10], np.zeros(11)])
    speed = np.sqrt(4.0 + 2.0 * 0.5 * X[::10])  # 0.5 m/s^2 from 2 m/s
    path = ReferencePath.from_waypoints(points, speed=speed)
    np.testing.assert_allclose(path.acceleration, 0.5, rtol=1e-6)


def test_thinning_keeps_the_speeds_at_the_points_that_are_left() -> None:
    """Points 0.2 m apart, 4 m/s^2 of braking; only each twentieth is kept."""
    x = np.arange(0.0, 40.01, 0.2)
    speed = np.sqrt(400.0 - 2.0 * 4.0 * x)
    points = np.column_stack([x, np.zeros(len(x))])
    path = ReferencePath.from_waypoints(points, speed=speed, minimum_distance=3.9)
    np.testing.assert_allclose(path.speed, np.sqrt(400.0 - 8.0 * path.arc_length), rtol=1e-6)
    speed[100] = 0.0  # at 20 m, which is kept
    stopped = ReferencePath.from_waypoints(points, speed=speed, minimum_distance=3.9)
    assert stopped.arc_length[np.argmin(stopped.speed)] == pytest.approx(20.0, abs=0.125)
    speed[[100, 110]] = speed[99], 0.0  # at 22 m, which is not
    stopped = ReferencePath.from_waypoints(points, speed=speed, minimum_distance=3.9)
    assert stopped.speed.min() == MINIMUM_SPEED
    assert stopped.arc_length[np.argmin(stopped.speed)] == pytest.approx(20.0, abs=0.125)


def test_a_stop_in_a_file_is_a_stop_of_the_path(tmp_path: Path) -> None:
    """One row at 0 m/s, at 50 m; and again between two nodes."""
    for place in (50, 33):
        speed = np.where(place == X, 0.0, 5.0)
        path = load(table(tmp_path, "s_m;x_m;y_m;vx_mps".replace(";", ","), X, X, 0.0, speed))
        node = int(np.argmin(path.speed))
        assert path.speed[node] == MINIMUM_SPEED
        assert path.arc_length[node] == pytest.approx(place, abs=0.5 * path.spacing + 1e-6)
        assert path.speed[[0, -1]] == pytest.approx([5.0, 5.0])
        assert path.duration > 20.0
        assert (path.speed == MINIMUM_SPEED).sum() == 1


def test_a_log_that_begins_and_ends_at_standstill_is_read(tmp_path: Path) -> None:
    """Odometry that trembles by millimetres while it stands, before, between and after."""
    rng = np.random.default_rng(5)
    places = np.concatenate([np.zeros(40), np.linspace(0.0, 30.0, 61), np.full(30, 30.0),
                             np.linspace(30.0, 60.0, 61), np.full(40, 60.0)])  # fmt: skip
    speed = np.concatenate([np.zeros(40), np.full(61, 3.0), np.zeros(30), np.full(61, 3.0),
                            np.zeros(40)])  # fmt: skip
    standing = speed == 0.0
    jitter = np.where(standing[:, None], rng.normal(0.0, 0.004, (len(places), 2)), 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = load(table(tmp_path, "x,y,v", places + jitter[:, 0], jitter[:, 1], speed))
    assert path.length == pytest.approx(60.0, abs=0.3)
    stops = path.arc_length[path.speed == MINIMUM_SPEED]
    np.testing.assert_allclose(stops, [0.0, 30.0, path.length], atol=0.6)
    assert "points nearer than 0.001 m or standing left out" in path.metadata["imported"]
    assert path.speed.max() == pytest.approx(3.0)


def test_speeds_are_cut_by_the_vehicle_and_the_limit_is_named(tmp_path: Path) -> None:
    car = vehicle.load("m2-minibus")
    fastest = car.speed_range[1]
    fast = load(table(tmp_path, "x,y,v", X, 0.0, fastest + 5.0), vehicle=car)
    assert (fast.speed == fastest).all()
    assert (
        "lowered on 100 % of the length, at most by 5.00 m/s at 0 m (top speed)"
        in (fast.metadata["imported"])
    )
    file = table(tmp_path, "x,y,v", X, 0.0, np.where(X < 50.0, 12.0, 2.0))
    assert load(file).acceleration.min() < -60.0  # without a vehicle nothing is cut
    slow = load(file, vehicle=car)
    assert slow.acceleration.min() >= car.longitudinal_acceleration_range[0] * 1.001
    assert "(acceleration or braking)" in slow.metadata["imported"]
    assert slow.speed.min() == pytest.approx(2.0)
    x, y = circle(20.0)
    bend = load(table(tmp_path, "x,y,v", x, y, 9.0), max_lateral_acceleration=2.0)
    assert (bend.speed**2 * np.abs(bend.curvature)).max() <= 2.0 * (1 + 1e-9)
    assert "(lateral acceleration)" in bend.metadata["imported"]


def test_speeds_are_planned_where_asked_or_needed(tmp_path: Path) -> None:
    x, y = circle()
    file = table(tmp_path, "x,y,v", x, y, 3.0)
    assert (load(file).speed == pytest.approx(3.0)) is True
    planned = load(file, speeds="planned")
    assert planned.metadata["speeds"] == "planned"
    assert planned.speed.max() == pytest.approx(10.0)
    assert "speed planned for at most 10 m/s and 2 m/s² laterally" in planned.metadata["imported"]
    assert load(file, speeds="planned", max_speed=7.0).speed.max() == pytest.approx(7.0)
    scaled = load(file, scale=0.5)
    assert scaled.metadata["speeds"] == "planned"
    assert "speeds in v not used, since the path is scaled" in scaled.metadata["imported"]
    np.testing.assert_allclose(load(file, scale=0.5, speeds="file").speed, 3.0)
    with pytest.raises(ValueError, match=r"points\.csv: has no column of speeds"):
        load(table(tmp_path, "x,y", x, y), speeds="file")
    with pytest.warns(UserWarning, match="its speeds, in v, are all 0: planned instead"):
        zero = load(table(tmp_path, "x,y,v", x, y, 0.0))
    assert zero.metadata["speeds"] == "planned"


def test_a_plan_follows_the_vehicle(tmp_path: Path) -> None:
    x, y = circle(5.0, 100)
    file = table(tmp_path, "x,y", x, y)
    assert load(file).metadata["warnings"] == []  # which bends it turns, a vehicle has to say
    for name in ("m2-minibus", "f1tenth"):
        car = vehicle.load(name)
        wanted = SpeedLimits.of(car)
        path = load(file, vehicle=car)
        assert SpeedLimits(**path.metadata["limits"]) == wanted
        lateral = (path.speed**2 * np.abs(path.curvature)).max()
        assert lateral == pytest.approx(car.max_lateral_acceleration, rel=0.01)
        own = load(file, vehicle=car, max_lateral_acceleration=1.0)
        assert (own.speed**2 * np.abs(own.curvature)).max() == pytest.approx(1.0, rel=0.01)
        assert own.metadata["limits"]["max_jerk"] == wanted.max_jerk


def test_speeds_in_kmh_are_suspected_by_the_times(tmp_path: Path) -> None:
    latitude = 48.0 + X * 5.0 / 111_200.0  # 5 m/s in steps of 1 s
    columns = (X, latitude, 11.0)
    with pytest.warns(UserWarning, match=r"3\.6 times .* give speed_unit='km/h'"):
        load(table(tmp_path, "t,lat,lon,speed", *columns, 18.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = load(table(tmp_path, "t,lat,lon,speed", *columns, 18.0), speed_unit="km/h")
        assert "5 to 5 m/s" in path.metadata["imported"]
        load(table(tmp_path, "t,lat,lon,speed", *columns, 5.0))


# --- ends, widths, noise ---


@pytest.mark.parametrize("turn", [0.7, 1.4, math.pi, 4.5, 2.0 * math.pi])
def test_the_ends_decide_whether_a_road_with_widths_is_closed(turn: float, tmp_path: Path) -> None:
    angle = np.arange(0.0, turn * 40.0, 2.66) / 40.0
    if turn > 6.0:
        angle = np.linspace(0.0, turn, 95, endpoint=False)
    right, left = 3.0 + 0.5 * np.sin(angle), 5.0
    header = "# x_m,y_m,w_tr_right_m,w_tr_left_m"
    file = table(tmp_path, header, 40.0 * np.cos(angle), 40.0 * np.sin(angle), right, left)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = load(file)
    assert path.closed == (turn > 6.0)
    assert path.length == pytest.approx(40.0 * (turn if path.closed else angle[-1]), rel=0.01)
    assert path.widths is not None
    at = path.arc_length / path.length * (turn if path.closed else angle[-1])
    np.testing.assert_allclose(path.widths[:, 0], 3.0 + 0.5 * np.sin(at), atol=0.01)
    np.testing.assert_allclose(path.widths[:, 1], 5.0)


def test_widths_belong_to_the_path(tmp_path: Path) -> None:
    path = ReferencePath.from_waypoints(
        np.column_stack([X, np.zeros(101)]), widths=np.column_stack([2.0 + X, np.full(101, 3.0)])
    )
    assert path.widths is not None
    write(path, tmp_path / "native.csv")
    back = read_native(tmp_path / "native.csv")
    np.testing.assert_array_equal(back.widths, path.widths)
    assert back.metadata["imported"] == path.metadata["imported"]
    np.testing.assert_array_equal(path.mirrored().widths, path.widths[:, ::-1])
    part = path.section(10.0, 20.0)
    assert part.widths is not None
    np.testing.assert_allclose(part.widths[:, 0], 12.0 + part.arc_length, atol=0.01)
    assert path.with_speed(3.0).widths is path.widths or np.array_equal(
        path.with_speed(3.0).widths, path.widths
    )
    with pytest.raises(ValueError, match=r"widths has shape \(4,\)"):
        ReferencePath(X, X, 0 * X, 0 * X, 0 * X, X + 1, widths=np.ones(4))
    with pytest.raises(ValueError, match=r"widths\[0\] is negative"):
        ReferencePath(X, X, 0 * X, 0 * X, 0 * X, X + 1, widths=-np.ones((101, 2)))


@pytest.mark.parametrize("noise", [0.05, 0.3, 0.5, 0.7])
def test_a_receiver_that_stands_is_thinned_by_its_noise(noise: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    east = np.concatenate([np.arange(0.0, 100.0, 2.0), np.full(60, 100.0), np.arange(100, 200, 2)])
    standing = east == 100.0
    wander = np.where(standing[:, None], rng.normal(0.0, noise, (len(east), 2)), 0.02)
    file = table(
        tmp_path, "lat,lon", 48.15 + wander[:, 1] / 111_205.0,
        11.57 + (east + wander[:, 0]) / 74_445.0,
    )  # fmt: skip
    path = load(file)
    # The end of the last spacing may be left out.
    assert 198.0 - path.metadata["minimum_distance"] - 1.0 < path.length < 200.0
    assert np.abs(path.y).max() < 2.5
    dropped = f"points nearer than {path.metadata['minimum_distance']:g} m or standing left out"
    assert dropped in path.metadata["imported"]
    assert load(file, minimum_distance=5.0).metadata["minimum_distance"] == 5.0
    if noise > 0.1:
        with pytest.raises(ValueError, match=r"jitter, a minimum_distance .* takes it out"):
            load(file, minimum_distance=0.25)


# --- options ---


def test_options_of_files_are_refused_elsewhere(tmp_path: Path) -> None:
    for given in ({"scale": 2.0}, {"closed": False}, {"name": "a"}, {"columns": ["x", "y"]}):
        option = next(iter(given))
        with pytest.raises(ValueError, match=f"{option} is an option of files, and 'T2' is none"):
            load("T2", **given)
        with pytest.raises(ValueError, match=f"{option} is an option of files"):
            load(load("T2"), **given)
    assert load("T2", vehicle=vehicle.load("f1tenth")) is load("T2")
    write(load("u-turn"), tmp_path / "native.csv")
    with pytest.raises(ValueError, match=r"native\.csv: closed means nothing for a native path"):
        load(tmp_path / "native.csv", closed=True)
    slow = load(tmp_path / "native.csv", max_speed=4.0, name="slow")
    assert (slow.name, slow.speed.max()) == ("slow", pytest.approx(4.0))
    np.testing.assert_array_equal(
        load(tmp_path / "native.csv", vehicle=vehicle.load("f1tenth")).speed, load("u-turn").speed
    )
    xy = table(tmp_path, "x,y", X, 0.0)
    with pytest.raises(ValueError, match=r"part means nothing for a table"):
        load(xy, part="1")
    with pytest.raises(ValueError, match="origin belongs to latitudes and longitudes"):
        load(xy, origin=(48.0, 11.0, 0.0))


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("vehicle", "f1tenth"), ("closed", "yes"), ("scale", 0.0), ("scale", "2"),
        ("smoothing", -1.0), ("minimum_distance", math.nan), ("speeds", "fast"),
        ("speed_unit", "furlong"), ("columns", "xy"), ("columns", [1, 2]), ("part", 1.5),
        ("origin", (1.0, 2.0)), ("max_speed", 0.0), ("max_lateral_acceleration", "2"),
        ("max_acceleration", math.inf), ("limits", {}), ("name", 3),
    ],
)  # fmt: skip
def test_options_are_checked_at_once(option: str, value: Any, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=option) as caught:
        load(table(tmp_path, "x,y", X, 0.0), **{option: value})
    assert len(str(caught.value)) < 300
    assert str(caught.value).isprintable()


def test_the_arguments_of_load_are_the_import_options() -> None:
    import inspect
    from dataclasses import fields

    arguments = list(inspect.signature(load).parameters.values())[1:]
    assert [(a.name, a.default) for a in arguments] == [
        (item.name, item.default) for item in fields(ImportOptions)
    ]


def test_names_of_files_need_no_csv(tmp_path: Path) -> None:
    text = "\n".join(f"{x} 0" for x in range(50))
    for name in ("path", "T2.0", "my.path.of.today"):
        (tmp_path / name).write_text(text)
        assert load(tmp_path / name).length == pytest.approx(49.0)
        assert load(str(tmp_path / name)).name == Path(name).stem
    for name in ("none.gpx", "folder/none", "none.txt"):
        with pytest.raises(ValueError, match=f"{name}: cannot be read: No such file"):
            load(name)
    with pytest.raises(ValueError, match="T2: cannot be read"):
        load(Path("folder") / "T2")


# --- arrays ---


def test_an_array_of_waypoints_makes_a_path() -> None:
    angle = np.linspace(0.0, 6.28, 120)
    points = np.column_stack([60.0 * np.cos(angle), 30.0 * np.sin(angle)])
    with pytest.raises(ValueError, match=r"ReferencePath\.from_waypoints makes one of an array"):
        trajectories.load(points)  # type: ignore[arg-type]
    path = ReferencePath.from_waypoints(points, name="ellipse", smoothing=0.0)
    assert path.closed
    assert path.length == pytest.approx(290.67, abs=0.05)
    assert path.name == "ellipse"
    assert path.metadata["imported"].startswith("waypoints of 120 points: closed, 290.7 m")
    assert not ReferencePath.from_waypoints(points[:60], closed=False).closed
    listed = ReferencePath.from_waypoints(points.tolist(), smoothing=0.0)
    np.testing.assert_array_equal(listed.x, path.x)
    car = vehicle.load("f1tenth")
    own = ReferencePath.from_waypoints(points, speed=np.full(120, 30.0), vehicle=car)
    assert own.speed.max() <= car.speed_range[1]


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (np.zeros((9, 3)), {}, r"points must be of shape \(9, 2\), not \(9, 3\)"),
        (np.zeros(9), {}, r"points must be of shape \(9, 2\), not \(9,\)"),
        ("T2", {}, "points must be numbers"),
        (3.0, {}, "points must be of shape"),
        (np.zeros((0, 2)), {}, "array: has no points"),
        (np.zeros((9, 2)), {}, "array: 1 distinct points, at least 4"),
        ([[0, 0], [1, math.nan]], {}, r"points\[1\] is .* must be finite"),
        (np.column_stack([X, X]), {"speed": [1.0]}, r"speed must be of shape \(101,\), not \(1,\)"),
        (np.column_stack([X, X]), {"speed": -X}, "array: point 1: speed -1 m/s is not"),
        (np.column_stack([X, X]), {"widths": X}, r"widths must be of shape \(101, 2\)"),
        (np.column_stack([X, X]), {"lapse": X}, "unknown option of from_waypoints 'lapse'"),
        (np.column_stack([X, X])[[0, 5, 2, 3, 4]], {}, "turns back by 180 degrees at point 1 "),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_arrays_that_are_no_path_are_refused(points: Any, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        ReferencePath.from_waypoints(points, **options)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("column", "unit"),
    [("velocity_kmph", 1 / 3.6), ("speedKmh", 1 / 3.6), ("v_ref", 1.0), ("linear_velocity", 1.0)],
)
def test_other_names_of_speeds(tmp_path: Path, column: str, unit: float) -> None:
    file = tmp_path / "line.csv"
    file.write_text(f"x,y,{column}\n" + "".join(f"{5 * k},0,18\n" for k in range(20)))
    assert load(file).speed.max() == pytest.approx(18.0 * unit)


def test_columns_among_which_there_is_no_speed_are_named(tmp_path: Path) -> None:
    file = tmp_path / "line.csv"
    file.write_text("x,y,Tempo,z\n" + "".join(f"{5 * k},0,18,1\n" for k in range(20)))
    said = load(file).metadata["imported"]
    assert "no speed among its other columns tempo, z" in said.lower()


def test_speeds_that_no_tyre_holds_may_be_in_kmh(tmp_path: Path) -> None:
    file = tmp_path / "circle.csv"
    angles = np.linspace(0.0, 2.0 * np.pi, 100)
    rows = [f"{30 * np.cos(a)},{30 * np.sin(a)},36" for a in angles]
    file.write_text("\n".join(["x,y,speed", *rows]))
    with pytest.warns(UserWarning, match=r"need up to 43 m/s² laterally: if they are in km/h"):
        load(file)
