"""Reference paths from recorded drives, against the line that was driven."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

import trajectories
from experiments.ros.read import BagError
from experiments.ros.reference import LEAST_SPEED, reference
from experiments.ros.runs import DATUM, topics_of
from experiments.ros.topics import SECOND, Datum, Fixes, Odometry, Topic
from experiments.ros.write import write
from experiments.run.rollout import Trace
from tests.helpers.recorded_drives import driven
from trajectories import ReferencePath
from trajectories.files import write as write_path
from trajectories.geodesy import geodetic
from trajectories.import_options import IMPORT_LIMITS

pytest.importorskip("rosbags", reason="rosbags is not installed")

Array = NDArray[np.float64]


def fixes(stamp: Any, x: Array, y: Array, noise: float = 0.0) -> Fixes:
    """Fixes of positions about the usual datum, with white noise of each axis."""
    error = noise * np.random.default_rng(0).normal(size=(len(x), 2))
    points = np.column_stack([x + error[:, 0], y + error[:, 1], np.zeros_like(x)])
    return Fixes(np.asarray(stamp), *geodetic(points, DATUM))


def datum() -> Datum:
    return Datum(np.array([SECOND]), *(np.array([value]) for value in DATUM))


def feet(path: ReferencePath, x: Array, y: Array) -> tuple[Array, Array]:
    """Lateral offsets of points from a path, and its curvature there, (n,)."""
    rows, near = [], 0.0
    for point in zip(x, y, strict=True):
        foot = path.project(*point, near=near)
        near = foot.arc_length
        rows.append((foot.lateral_error, foot.curvature))
    offset, curvature = np.array(rows).T
    return offset, curvature


def driven_curvature(trace: Trace) -> Array:
    """Curvature (n - 2,) of the line that was driven: turn of the course over two periods' way.

    At an instant it jumps, by up to 0.01 1/m, with the steering's steps from period to period.
    """
    vx, vy, psi, _, _, _ = trace.state.T
    course = psi + np.arctan2(vy, vx)
    way = cumulative_trapezoid(np.hypot(vx, vy), trace.time)
    way = np.concatenate([[0.0], way])
    curvature: Array = (course[2:] - course[:-2]) / (way[2:] - way[:-2])
    return curvature


@pytest.fixture(scope="module")
def run_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("reference") / "run.bag"
    write(bag, topics_of(driven()))
    return bag


@pytest.mark.parametrize("source", ["odometry", "fix"])
def test_a_run_read_back_is_the_driven_line(run_bag: Path, source: str) -> None:
    trace = driven()
    line = reference(run_bag, source=source)
    offset, curvature = feet(line.path, trace.state[:, 4], trace.state[:, 5])
    assert np.abs(offset).max() < 0.003
    # The sharpest is 0.1 1/m.
    assert np.abs(curvature[1:-1] - driven_curvature(trace)).max() < 0.003
    inner = slice(20, -20)
    speed = np.hypot(trace.state[:, 0], trace.state[:, 1])
    arcs = [line.path.project(x, y).arc_length for x, y in trace.state[inner, 4:6]]
    assert np.abs(line.path.sample(arcs).speed - speed[inner]).max() < 0.05
    assert line.warnings == []
    assert line.path.metadata["source"] == f"{source} of a recorded drive: run.bag, {line.topic}"


def test_noise_of_5_cm_at_10_hz(tmp_path: Path) -> None:
    """What remains is under half of the noise; measured: 0.015 m rms, 0.042 m at most."""
    trace = driven("T2")
    x, y = trace.state[::2, 4], trace.state[::2, 5]
    stamp = SECOND + np.arange(len(x)) * SECOND // 10
    write(tmp_path / "a.bag", {"/fix": fixes(stamp, x, y, noise=0.05), "/datum": datum()})
    line = reference(tmp_path / "a.bag")
    offset, curvature = feet(line.path, trace.state[:, 4], trace.state[:, 5])
    assert np.sqrt(np.mean(offset**2)) < 0.025
    assert np.abs(offset).max() < 0.1
    apart = curvature[1:-1] - driven_curvature(trace)
    assert np.sqrt(np.mean(apart**2)) < 0.005
    assert np.abs(apart).max() < 0.02
    # The noise is found: sqrt(2) 5 cm, less what the splines follow of it.
    assert 0.055 < line.deviation_rms < 0.075
    assert line.warnings == []


def test_fixes_that_are_wrong_altogether_are_left_out(tmp_path: Path) -> None:
    trace = driven()
    x, y = trace.state[::2, 4].copy(), trace.state[::2, 5].copy()
    wrong = np.array([20, 21, 90, 150, 200])
    x[wrong] += 3.0
    stamp = SECOND + np.arange(len(x)) * SECOND // 10
    write(tmp_path / "a.bag", {"/fix": fixes(stamp, x, y, noise=0.02), "/datum": datum()})
    line = reference(tmp_path / "a.bag")
    assert line.path.metadata["outliers"] == len(wrong)
    assert line.warnings == ["5 positions lie far off the others: left out"]
    offset, _ = feet(line.path, trace.state[:, 4], trace.state[:, 5])
    assert np.abs(offset).max() < 0.06


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_standstill_and_duplicates_fall_away(tmp_path: Path, noise: float) -> None:
    """Up to 5 m/s, a stop of 15 s half way round the bend, and on."""
    path = trajectories.load("u-turn")
    ramp = np.concatenate([np.linspace(0.0, 5.0, 60), np.full(40, 5.0), np.linspace(5.0, 0.0, 60)])
    speed = np.concatenate([ramp, np.zeros(150), ramp])
    arc = 0.1 * np.cumsum(speed)
    assert arc[-1] < path.length
    at = path.sample(arc)
    stamp = SECOND + np.arange(len(arc)) * SECOND // 10
    write(tmp_path / "a.bag", {"/fix": fixes(stamp, at.x, at.y, noise), "/datum": datum()})
    line = reference(tmp_path / "a.bag")
    assert abs(line.path.length - (arc[-1] - arc[0])) < 0.5 + 2.0 * noise
    offset, _ = feet(line.path, at.x[speed > 0.5], at.y[speed > 0.5])
    assert np.abs(offset).max() < 0.003 + 3.0 * noise
    assert line.path.speed.min() == LEAST_SPEED
    assert np.abs(line.path.curvature).max() < 1.3 * np.abs(path.curvature).max()


def test_speed_can_be_planned_anew(run_bag: Path) -> None:
    path = reference(run_bag, limits=IMPORT_LIMITS).path
    assert path.speed.max() <= IMPORT_LIMITS.max_speed
    assert path.acceleration.max() <= IMPORT_LIMITS.max_acceleration + 1e-6
    assert path.metadata["limits"]["max_speed"] == IMPORT_LIMITS.max_speed


def test_the_native_file_loads_as_the_path(run_bag: Path, tmp_path: Path) -> None:
    path = reference(run_bag, source="fix", name="mine").path
    write_path(path, tmp_path / "path.csv")
    loaded = trajectories.load(tmp_path / "path.csv")
    assert loaded.name == "mine"
    assert_allclose(loaded.table, path.table, rtol=0.0, atol=0.0)
    latitude, longitude, height = DATUM
    assert loaded.metadata["origin"] == {
        "latitude_deg": latitude, "longitude_deg": longitude, "height_m": height,
    }  # fmt: skip
    assert "deviation" in "".join(loaded.metadata)


def test_a_datum_can_be_given(run_bag: Path) -> None:
    path = reference(run_bag, source="fix").path
    moved = reference(run_bag, source="fix", datum=(45.0, 10.001, 0.0)).path
    # A thousandth of a degree of longitude at 45 degrees north: N cos(phi) dlambda.
    assert_allclose(path.x[0] - moved.x[0], 78.85, atol=0.01)


def test_without_a_datum_the_first_fix_is_the_origin(tmp_path: Path) -> None:
    trace = driven()
    there = fixes(SECOND * np.arange(1, 41) // 10, trace.state[:400:10, 4], trace.state[:400:10, 5])
    write(tmp_path / "a.bag", {"/fix": there})
    path = reference(tmp_path / "a.bag").path
    assert_allclose((path.x[0], path.y[0]), 0.0, atol=1e-2)


def test_a_tolerance_can_be_given(run_bag: Path) -> None:
    line = reference(run_bag, smoothing=0.02)
    assert 0.015 < line.deviation_rms <= 0.02
    with pytest.raises(ValueError, match="smoothing must be positive, not -1"):
        reference(run_bag, smoothing=-1.0)


def test_a_gap_is_told(tmp_path: Path) -> None:
    trace = driven()
    odom: Any = topics_of(trace)["/odom"]
    kept = np.r_[0:100, 160 : len(odom)]
    columns = {name: getattr(odom, name)[kept] for name in odom.columns()}
    write(tmp_path / "a.bag", {"/odom": replace(odom, stamp=odom.stamp[kept], **columns)})
    line = reference(tmp_path / "a.bag")
    assert len(line.warnings) == 1
    assert line.warnings[0].startswith("no positions for 3.")


def odometry(x: Array, y: Array) -> dict[str, Topic]:
    zero = np.zeros_like(x)
    stamp = SECOND + np.arange(len(x)) * SECOND // 10
    return {"/odom": Odometry(stamp, x, y, zero, zero, zero, zero)}


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (
            np.concatenate([np.arange(0.0, 30.0), np.arange(30.0, 0.0, -1.0)]),
            "the drive turns back",
        ),
        (np.linspace(0.0, 3.0, 50), "the drive goes 2.5 m, at least 5 m are needed"),
        (np.zeros(50), "the drive goes 0.0 m"),
        (np.arange(5.0), "5 positions over time, 8 are needed"),
    ],
)
def test_what_is_no_path(tmp_path: Path, x: Array, message: str) -> None:
    write(tmp_path / "a.bag", odometry(x, np.zeros_like(x)))
    with pytest.raises(BagError, match=message):
        reference(tmp_path / "a.bag")


def test_neither_odometry_nor_fixes(tmp_path: Path) -> None:
    write(tmp_path / "a.bag", {"/datum": datum()})
    with pytest.raises(BagError, match=r"no topic with messages sensor_msgs/NavSatFix"):
        reference(tmp_path / "a.bag")
