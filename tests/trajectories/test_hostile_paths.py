"""Paths that ask for endless work, and headers that say anything: linear time or one line."""

import json
import math
import os
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trajectories
from trajectories import (
    ReferencePath,
    SpeedLimits,
    cleaning,
    importers,
    plan_speed,
    random_path,
    shapes,
    text_table,
)
from trajectories.files import read, write
from trajectories.import_options import IMPORT_LIMITS, USUAL
from trajectories.oddities import APPROACH, APPROACH_ALONG, self_approach
from trajectories.raw_path import RawPath
from trajectories.shapes import Geometry


def refusal(call: Any, *arguments: Any, **named: Any) -> str:
    with pytest.raises(ValueError, match=r".") as caught:
        call(*arguments, **named)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) <= 500
    return message


def spiral(pitch: float, length: float) -> Geometry:
    """An Archimedean spiral from a radius of 6 m on, its arms `pitch` apart."""
    s = np.arange(0.0, length, 0.25)
    rate = pitch / (2.0 * math.pi)
    angle = np.sqrt(2.0 * s / rate + (6.0 / rate) ** 2)
    return Geometry(s, rate * angle * np.cos(angle), rate * angle * np.sin(angle), s, s, s)


def test_a_spiral_that_lies_over_itself_takes_little_time_and_memory() -> None:
    geometry = spiral(pitch=0.002, length=29_000.0)  # 10^9 pairs of points within 2.5 m
    tracemalloc.start()
    began = time.perf_counter()
    found = self_approach(geometry, closed=False)
    took, (_, peak) = time.perf_counter() - began, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found is not None
    assert found[2] == pytest.approx(0.002, rel=1e-3)
    assert found[1] - found[0] > APPROACH_ALONG
    assert peak < 200e6
    assert took < 60.0  # about a second on an idle machine


@pytest.mark.parametrize("closed", [False, True])
def test_the_closest_approach_is_that_of_all_pairs(closed: bool) -> None:
    rng = np.random.default_rng(4)
    answers = []
    for _ in range(20):
        n = int(rng.integers(8, 1500))
        heading = np.cumsum(rng.normal(0.0, 0.15, n))
        s = 0.25 * np.arange(n)
        x, y = 0.25 * np.cumsum(np.cos(heading)), 0.25 * np.cumsum(np.sin(heading))
        found = self_approach(Geometry(s, x, y, heading, heading, s), closed)
        points, at = np.column_stack([x, y])[::2], s[::2]
        distances = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
        along = np.abs(at[:, None] - at[None])
        if closed:
            along = np.minimum(along, s[-1] - along)
        distances[along <= APPROACH_ALONG] = math.inf
        answers.append(found)
        if found is None:
            assert distances.min() >= APPROACH
        else:
            assert found[2] == pytest.approx(distances.min(), rel=1e-12)
            i, j = np.searchsorted(at, found[0]), np.searchsorted(at, found[1])
            assert distances[i, j] == pytest.approx(found[2], rel=1e-12)
    assert None in answers
    assert any(answers)


def test_a_duplicate_in_the_last_of_many_rows_is_named_at_once() -> None:
    n = 300_000
    columns = {"x": 0.1 * np.append(np.arange(n), n - 1), "y": np.zeros(n + 1)}
    raw = RawPath("x,y", "long.csv", "long", columns, [f"line {k}" for k in range(1, n + 2)])
    began = time.perf_counter()
    with pytest.warns(UserWarning, match=rf"1 duplicates .*first: line {n + 1}\b"):
        assert len(cleaning._thinned(raw, USUAL, cleaning.Findings("long.csv"))[0].places) == n
    assert time.perf_counter() - began < 20.0  # it took hours when it was quadratic


def test_pipes_and_files_too_large_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "path.csv"
    os.mkfifo(file)
    assert "no regular file" in refusal(trajectories.load, file)
    file.unlink()
    file.touch()
    os.truncate(file, 2**40)
    assert "1099511627776 bytes are too many" in refusal(trajectories.load, file)
    file.write_text("x,y\n" + "1,2\n" * 50)
    monkeypatch.setattr(text_table, "MOST_ROWS", 40)
    assert "more than 40 rows" in refusal(trajectories.load, file)
    file.write_text(",".join(map(str, range(2000))) + "\n")
    assert "more than 1000 columns" in refusal(trajectories.load, file)


@pytest.mark.parametrize(
    "change",
    [
        {"max_speed": 0.0}, {"max_speed": math.inf}, {"max_acceleration": 1e-9},
        {"max_deceleration": -1.0}, {"max_jerk": math.nan}, {"wheelbase": "5"},
        {"end_speed": True}, {"min_speed": None},
    ],
)  # fmt: skip
def test_speed_limits_are_bounded(change: dict[str, Any]) -> None:
    usual = {"max_speed": 10.0, "max_lateral_acceleration": 2.0, "max_acceleration": 1.5}
    name = next(iter(change))
    assert f"{name} must be in [0.001, 1e+06]" in refusal(SpeedLimits, **{**usual, **change})


def test_profiles_that_would_take_hours_are_refused() -> None:
    for closed in (False, True):
        assert "is too long" in refusal(plan_speed, np.zeros(11), 1e4, IMPORT_LIMITS, closed=closed)
    assert "1e+08 m" in refusal(plan_speed, np.zeros(11), 1e7, IMPORT_LIMITS)


@pytest.mark.parametrize("length", [1e9, math.inf, math.nan, -1.0])
def test_paths_of_absurd_lengths_are_refused(length: float) -> None:
    assert "length must be >= 0 and at most 30000 m" in refusal(random_path, 0, length=length)
    if length > 0.0:
        segments = [shapes.Segment(length=length)]
        assert "length must be >= 0 and at most" in refusal(shapes.build, segments)


@pytest.mark.parametrize("name", ["random-" + "9" * 100_000, "x" * 500_000, "\0", "a\nb.csv"])
def test_names_of_any_length_are_refused_in_a_short_line(name: str) -> None:
    refusal(trajectories.load, name)


def test_an_array_is_no_trajectory() -> None:
    for given in (np.zeros((9, 2)), [[0, 1]], None, 3):
        assert "ReferencePath.from_waypoints makes one" in refusal(trajectories.load, given)


@pytest.fixture
def lines(tmp_path: Path) -> list[str]:
    write(trajectories.load("u-turn"), tmp_path / "path.csv")
    return (tmp_path / "path.csv").read_text().splitlines()


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("warnings", 5, "Expected `array`, got `int` - at `$.warnings`"),
        ("warnings", ["a", 5], "Expected `str`, got `int` - at `$.warnings[1]`"),
        ("limits", 5, "got `int` - at `$.limits`"),
        ("limits", {"max_speed": 1.0}, "missing required field"),
        ("limits", {"max_speed": -1.0, "max_lateral_acceleration": 1.0, "max_acceleration": 1.0},
         "speed limits: max_speed must be in"),
        ("origin", {"latitude_deg": "x"}, "$.origin"),
        ("source", [], "$.source"),
        ("name", 3, "$.name"),
        ("name", "a\nb", "is no line of at most 200 characters"),
        ("name", "n" * 500_000, "is no line of at most 200 characters"),
        ("points", 10**400, "points: is not JSON: integer"),
    ],
)  # fmt: skip
def test_a_header_that_code_relies_on_has_a_schema(
    key: str, value: object, reason: str, lines: list[str], tmp_path: Path
) -> None:
    kept = [line for line in lines if not line.startswith(f"# {key}:")]
    kept.insert(1, f"# {key}: {json.dumps(value)}")
    file = tmp_path / "edited.csv"
    file.write_text("\n".join([*kept, ""]))
    said = refusal(read, file)
    assert str(file) in said
    assert reason in said


def test_a_header_may_hold_any_other_json(lines: list[str], tmp_path: Path) -> None:
    lines.insert(1, '# own: {"a": [1, null, "x"]}')
    file = tmp_path / "edited.csv"
    file.write_text("\n".join([*lines, ""]))
    found = read(file)
    assert isinstance(found, ReferencePath)
    assert found.metadata["own"] == {"a": [1, None, "x"]}


WRONG: tuple[Any, ...] = (
    None,
    "x",
    [],
    {},
    math.nan,
    math.inf,
    -1.0,
    10**400,
    np.zeros((2, 2)),
    "x" * 500_000,
)


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("points") / "points.csv"
    angle = np.linspace(0.0, 2.0, 40)
    cells = [f"{48.0 + 2e-4 * math.sin(a)},{11.0 + 2e-4 * math.cos(a)}" for a in angle]
    file.write_text("\n".join(["lat,lon", *cells, ""]))
    return file


@pytest.mark.parametrize("wrong", WRONG, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("key", ["closed", "origin", "minimum_distance", "limits", "smoothing"])
def test_arguments_of_importers_are_refused_in_a_short_line(
    key: str, wrong: Any, points: Path
) -> None:
    if wrong is None:
        assert importers.read_gps(points).length > 20.0
    else:
        assert key in refusal(importers.read_gps, points, **{key: wrong})


@pytest.mark.parametrize("wrong", WRONG, ids=lambda value: type(value).__name__)
def test_arguments_of_paths_are_refused_in_a_short_line(wrong: Any) -> None:
    path = trajectories.load("straight")
    if wrong is not None:
        refusal(random_path, 0, length=wrong)
    refusal(random_path, "x" if wrong is None else wrong)
    refusal(path.preview, 0.0, 0.1, wrong)
    refusal(path.with_speed, wrong)
    refusal(plan_speed, path.curvature, wrong, IMPORT_LIMITS)
    refusal(plan_speed, wrong, 0.25, IMPORT_LIMITS)
    refusal(plan_speed, path.curvature, 0.25, wrong)
    refusal(trajectories.statistics, wrong)
    refusal(trajectories.CurvatureBands, thresholds=wrong)
