"""Smoothing leaves no point by more than its bound and widens bends, on large and small tracks."""

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree

from trajectories import shapes, smoothing
from trajectories.shapes import Smoothed, smooth
from trajectories.speed import SpeedLimits

TRACKS = Path(__file__).parents[3] / "shared" / "tracks"
NAMES = ("Austin", "Budapest", "Norisring", "Spielberg", "Suzuka")


def track(name: str, length: float | None = None) -> np.ndarray:
    """Points (n, 2) of a circuit, scaled to a length in m if one is given."""
    file = TRACKS / f"{name}.csv"
    if not file.exists():
        pytest.skip(f"{file} is not there")
    points = np.loadtxt(file, delimiter=",", comments="#")[:, :2]
    around = np.hypot(*np.diff(np.vstack([points, points[:1]]), axis=0).T).sum()
    return points if length is None else points * (length / around)


def hairpin(spacing: float, radius: float = 8.0) -> np.ndarray:
    """Two straights of 1500 m and a half circle between them."""
    angle = np.arange(0.0, np.pi, spacing / radius)[1:]
    along = np.arange(0.0, 1500.0, spacing)
    x = np.r_[along, 1500.0 + radius * np.sin(angle), 1500.0 - along]
    y = np.r_[0.0 * along, radius * (1.0 - np.cos(angle)), 0.0 * along + 2.0 * radius]
    return np.column_stack([x, y])


def sharpest(smoothed: Smoothed) -> float:
    return float(np.abs(smoothed.geometry.curvature).max())


def check_bounds(smoothed: Smoothed, points: np.ndarray, tolerance: float) -> None:
    """Compare the stated deviations with the bounds, and the distances with what is stated."""
    assert smoothed.rms_deviation <= 1.01 * tolerance
    assert smoothed.max_deviation <= 1.01 * smoothing.REACH * tolerance
    nodes = np.column_stack([smoothed.geometry.x, smoothed.geometry.y])
    distances = cKDTree(nodes).query(points)[0]
    # A node is at most half a cell from the foot point.
    assert distances.max() <= smoothed.max_deviation + 0.501 * smoothed.geometry.arc_length[1]


@pytest.mark.parametrize("spacing", [5.0, 1.0])
def test_more_smoothing_widens_a_hairpin_and_stays_near(spacing: float) -> None:
    points, found = hairpin(spacing), []
    for tolerance in (0.02, 0.05, 0.1, 0.2, 0.3, 0.5):
        smoothed = smooth(points, tolerance)
        check_bounds(smoothed, points, tolerance)
        found.append(sharpest(smoothed))
    # To 2 %: the arc begins without a ramp, and where one is put in, the rest is a little sharper.
    assert all(after <= 1.02 * before for before, after in pairwise(found))
    assert found[0] < 1.05 / 8.0
    assert found[-1] < 1.0 / 8.0
    assert sharpest(smooth(points, 0.0)) > max(found)


@pytest.mark.parametrize("name", NAMES)
def test_more_smoothing_widens_the_bends_of_circuits(name: str) -> None:
    points, found = track(name), []
    for tolerance in (0.0, 0.02, 0.05, 0.1, 0.2):
        began = time.perf_counter()
        smoothed = smooth(points, tolerance, closed=True)
        assert time.perf_counter() - began < 3.0
        if tolerance > 0.0:
            check_bounds(smoothed, points, tolerance)
        found.append(sharpest(smoothed))
    assert (np.diff(found) < 0.0).all()
    assert found[2] < 0.95 * found[0]  # jitter is gone at 0.05 m


@pytest.mark.parametrize("name", ["Austin", "Norisring"])
@pytest.mark.parametrize("length", [60.0, 300.0])
def test_small_tracks_are_smoothed_like_large_ones(name: str, length: float) -> None:
    """Scaled with its tolerance, a circuit keeps its shape, up to the nodes' spacing."""
    large, small = track(name), track(name, length)
    scale = small[0, 0] / large[0, 0]
    for tolerance in (0.05, 0.2):
        one = smooth(large, tolerance, closed=True)
        other = smooth(small, tolerance * scale, closed=True)
        check_bounds(other, small, tolerance * scale)
        assert sharpest(other) * scale == pytest.approx(sharpest(one), rel=0.02)
        turns = np.abs(other.geometry.curvature) * other.geometry.arc_length[1]
        fewest = len(other.geometry.x) == shapes.MANY_NODES + 1
        assert turns.max() <= 1.05 * shapes.TURN or fewest


@pytest.mark.parametrize(
    ("spacing", "sigma", "tolerance"), [(5.0, 0.2, 0.2), (2.0, 0.5, 0.6), (5.0, 1.0, 1.2)]
)
def test_noise_is_taken_out_of_gps_logs(spacing: float, sigma: float, tolerance: float) -> None:
    road = shapes.build(
        shapes.fit(
            shapes.parse("S 200 | L 90 r12 | S 100 | R 90 r15 | S 150 | L 180 r12 | S 300"),
            SpeedLimits(15.0, 2.0, 1.5),
        )
    )
    line = np.column_stack([road.x, road.y])
    for seed in range(3):
        exact = line[:: round(spacing / 0.25)]
        points = exact + np.random.default_rng(seed).normal(0.0, sigma, exact.shape)
        smoothed = smooth(points, tolerance)
        check_bounds(smoothed, points, tolerance)
        assert sharpest(smoothed) < 1.35 * np.abs(road.curvature).max()
        nodes = np.column_stack([smoothed.geometry.x, smoothed.geometry.y])
        off = cKDTree(line).query(nodes)[0]
        assert np.sqrt(np.mean(off**2)) < sigma


def test_a_gap_is_bridged_and_a_bend_does_not_go_on_into_it() -> None:
    quarter = np.linspace(0.0, np.pi / 2.0, 30)[1:]
    arc = np.column_stack([1000.0 + 3.0 * np.sin(quarter), 3.0 - 3.0 * np.cos(quarter)])
    far = np.linspace(0.0, 1000.0, 11)
    points = np.vstack([np.column_stack([far, 0.0 * far]), arc,
                        np.column_stack([0.0 * far[1:] + 1003.0, far[1:]])])  # fmt: skip
    for tolerance in (0.05, 0.2):
        smoothed = smooth(points, tolerance)
        check_bounds(smoothed, points, tolerance)
        assert smoothed.geometry.arc_length[-1] < 2004.0
        assert np.ptp(smoothed.geometry.heading) < np.pi / 2.0 + 0.3


def test_a_straight_stays_straight_to_the_last_digits() -> None:
    x = np.linspace(0.0, 500.0, 101)
    smoothed = smooth(np.column_stack([x + 5e5, 0.0 * x + 4e6]), 0.05)
    assert smoothed.geometry.arc_length[-1] == pytest.approx(500.0, abs=1e-7)
    assert smoothed.max_deviation < 1e-7


def test_smoothing_that_leaves_nothing_is_refused() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 41)[:-1]
    circle = 30.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    with pytest.raises(ValueError, match=r"smoothing of 30 m leaves 0\.\d+ m of a path that is 8"):
        smooth(circle, 30.0, closed=True)


@pytest.mark.parametrize("closed", [False, True])
def test_the_fit_minimises_what_it_says(closed: bool) -> None:
    """Compare with a dense solution of the same problem by SciPy's matrices."""
    rng = np.random.default_rng(4)
    count = 60
    angle = np.linspace(0.0, 1.7 * np.pi, count)
    points = np.column_stack([20.0 * np.cos(angle), 15.0 * np.sin(angle)])
    points += rng.normal(0.0, 0.05, points.shape)
    chain = np.vstack([points, points[:1]]) if closed else points
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(chain, axis=0).T))])
    cells = 40
    tolerance = 0.1
    spline, largest = smoothing._penalised(points, at, tolerance, cells, closed=closed)
    assert largest < smoothing.REACH * tolerance  # no weights
    order = smoothing.DEGREE
    knots = at[-1] / cells * np.arange(-order, cells + order + 1)
    basis = BSpline.design_matrix(np.minimum(at[:count], at[-1] * (1 - 1e-15)), knots, order)
    wrapped = sparse.identity(cells).tocsr()[np.arange(cells + order) % cells] if closed else None
    matrix = (basis @ wrapped if closed else basis).toarray()
    third = np.diff(np.eye(cells + order), 3, axis=0)
    if closed:
        third = third[:cells] @ wrapped.toarray() if len(third) >= cells else third

    def dense(exponent: float) -> np.ndarray:
        left = np.vstack([matrix, 10.0 ** (0.5 * exponent) * third])
        right = np.vstack([points, np.zeros((len(third), 2))])
        return np.linalg.lstsq(left, right, rcond=None)[0]

    def fit(exponent: float) -> tuple[np.ndarray, float]:
        control = dense(exponent)
        return control, float(np.sqrt(np.mean(((matrix @ control - points) ** 2).sum(axis=1))))

    expected = smoothing.largest_penalty(fit, tolerance, smoothing.PENALTY_EXPONENTS)
    np.testing.assert_allclose(spline.c[: len(expected)], expected, atol=1e-5)


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(4, 200),
    scale=st.sampled_from([0.05, 1.0, 20.0]),
    tolerance=st.sampled_from([0.01, 0.1, 0.5]),
    closed=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_any_points_are_smoothed_within_the_bounds(
    seed: int, count: int, scale: float, tolerance: float, closed: bool
) -> None:
    rng = np.random.default_rng(seed)
    if closed:
        angle = 2.0 * np.pi * np.arange(count) / count
        radius = max(count, 12) * scale / 6.0 * (1.0 + 0.3 * np.sin(2.0 * angle))
        points = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    else:
        heading = np.cumsum(rng.uniform(-0.5, 0.5, count))
        points = scale * np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    points += rng.normal(0.0, 0.1 * scale, points.shape)
    smoothed = smooth(points, tolerance * scale, closed=closed)
    check_bounds(smoothed, points, tolerance * scale)
    assert np.isfinite(smoothed.geometry.curvature).all()
    assert len(smoothed.places) == count + closed
