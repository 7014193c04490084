"""Lane changes between cones: geometry of ISO 3888, distances from cones, the line between."""

import math
from pathlib import Path

import numpy as np
import pytest

from trajectories import files, load
from trajectories.lane_changes import BODY, GATE, MARGIN, clearance, lanes, outline
from trajectories.path import ReferencePath

WIDTHS = (1.61, 2.0, 2.55)
LANE = [(0.0, 10.0, -1.0, 1.0)]
CAR = outline(4.0, 1.6, 0.5)


def at(x: float, y: float, heading: float = 0.0) -> float:
    return clearance(LANE, [x], [y], [heading], CAR)


@pytest.mark.parametrize("width", WIDTHS)
def test_sections_are_those_of_the_standard(width: float) -> None:
    for part, lengths, total in (
        (1, (15.0, 30.0, 25.0, 25.0, 30.0), 125.0),
        (2, (12.0, 13.5, 11.0, 12.5, 12.0), 61.0),
    ):
        first, second, third = lanes(part, width)
        ends = np.array([*first[:2], *second[:2], *third[:2]])
        np.testing.assert_allclose(np.diff(ends), lengths, atol=1e-12)
        assert ends[0] == GATE
        assert ends[-1] - ends[0] == pytest.approx(total)


def test_widths_and_offsets_for_a_car_of_two_metres() -> None:
    # ISO 3888-1: 2.45, 2.65, 2.85 m, right lines at 0, 3.5, 0 m from the first one.
    sides = np.array([lane[2:] for lane in lanes(1, 2.0)])
    np.testing.assert_allclose(sides + 1.225, [[0, 2.45], [3.5, 6.15], [0, 2.85]], atol=1e-12)
    # ISO 3888-2: 2.45, 3, 3 m; a gap of 1 m on both ways.
    sides = np.array([lane[2:] for lane in lanes(2, 2.0)])
    np.testing.assert_allclose(sides - 1.225, [[-2.45, 0], [1, 4], [-3, 0]], atol=1e-12)
    assert np.diff(lanes(2, 2.4)[2][2:]) == pytest.approx(3.37)


def test_clearance_of_a_body_along_the_lane_is_what_is_left_beside_it() -> None:
    assert at(5.0, 0.0) == pytest.approx(0.2)
    assert at(5.0, 0.15) == pytest.approx(0.05)
    assert at(5.0, -0.3) == pytest.approx(-0.1)
    assert at(-2.6, 5.0) == math.inf  # its front, 2.5 m ahead, is not yet there
    assert at(-2.4, 5.0) == pytest.approx(1.0 - 5.8)
    assert at(11.4, 5.0) == pytest.approx(1.0 - 5.8)  # its rear, 1.5 m behind, still is
    assert at(11.6, 5.0) == math.inf


def test_clearance_counts_corners_and_sides() -> None:
    # Front left corner: (2.5, 0.8) turned by 0.1 rad.
    corner = 2.5 * math.sin(0.1) + 0.8 * math.cos(0.1)
    assert at(5.0, 0.0, 0.1) == pytest.approx(1.0 - corner)
    # All corners are before or behind a lane of 1 m: a side passes through its end.
    short = [(0.0, 1.0, -1.0, 1.0)]
    side = 0.8 / math.cos(0.3) + math.tan(0.3) * 1.0
    found = clearance(short, [0.0], [0.0], [0.3], CAR)
    assert found == pytest.approx(1.0 - side)


def test_clearance_is_that_of_a_finely_sampled_outline() -> None:
    rng = np.random.default_rng(1)
    share = np.linspace(0.0, 1.0, 2001)[:, None]
    around = np.roll(CAR, -1, axis=0)
    points = np.concatenate([a + share * (b - a) for a, b in zip(CAR, around, strict=True)])
    for _ in range(50):
        x, y, heading = rng.uniform((-3.0, -1.0, -1.5), (12.0, 1.0, 1.5))
        c, s = math.cos(heading), math.sin(heading)
        along, across = x + points @ (c, -s), y + points @ (s, c)
        here = across[(along >= 0.0) & (along <= 10.0)]
        expected = min(1.0 - here.max(), here.min() + 1.0) if here.size else math.inf
        assert at(x, y, heading) == pytest.approx(expected, abs=5e-3)


@pytest.mark.parametrize("part", [1, 2])
@pytest.mark.parametrize("width", WIDTHS)
def test_the_line_keeps_its_margin_and_ends_straight(part: int, width: float) -> None:
    path = load(f"iso-3888-{part}-{width}")
    cones = path.metadata["cones"]
    assert cones == [list(lane) for lane in lanes(part, width)]
    body = outline(BODY, width, 0.0)
    found = clearance(cones, path.x, path.y, path.heading, body)
    assert found == pytest.approx(MARGIN, abs=2e-3)
    start = (path.x[0], path.y[0], path.heading[0], path.curvature[0])
    assert start == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-9)
    after = path.x > cones[-1][1] + 0.5 * BODY
    np.testing.assert_allclose(path.curvature[after], 0.0, atol=1e-6)
    assert path.length - path.arc_length[after][0] > 25.0
    assert path.speed.min() == pytest.approx(path.speed.max())


def largest(path: ReferencePath) -> float:
    return float(np.abs(path.curvature).max())


def test_the_line_is_smoother_than_ramps_between_the_middles() -> None:
    """A quintic over a gap of 25 m and 3.5 m has 10 / sqrt(3) 3.5 / 25^2 = 0.0323 1/m."""
    assert largest(load("iso-3888-1-1.61")) < 0.3 * 0.0323
    assert largest(load("iso-3888-2-1.61")) < 0.04


def test_files_keep_the_cones(tmp_path: Path) -> None:
    path = load("iso-3888-2-1.8")
    files.write(path, tmp_path / "change.csv")
    again = load(tmp_path / "change.csv")
    assert again.metadata["cones"] == path.metadata["cones"]
    np.testing.assert_array_equal(again.table, path.table)


def test_names_name_the_width() -> None:
    assert load("iso-3888-1-2").name == "iso-3888-1-2"
    assert load("iso-3888-1-2.0").name == "iso-3888-1-2"
    with pytest.raises(ValueError, match=r"the width must be in \[0.1, 10\] m, not 0.0"):
        load("iso-3888-1-0.0")
    for name in ("iso-3888-1", "iso-3888-3-1.8", "iso-3888-1-1.8-raw", "iso-3888-1--1.8"):
        with pytest.raises(ValueError, match="unknown trajectory"):
            load(name)
