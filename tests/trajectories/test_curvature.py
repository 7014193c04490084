"""Curvature formulas against analytic answers, statistics and bands."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajectories import CurvatureBands, load, statistics
from trajectories.curvature import circle_curvature, signed_waypoint_curvature, waypoint_curvature
from trajectories.shapes import polyline


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("radius", [5.0, 30.0, 400.0])
def test_circle(radius: float, sign: float) -> None:
    t = 0.25 / radius * np.arange(60)
    x, y = radius * np.sin(t), sign * radius * (1 - np.cos(t))
    np.testing.assert_allclose(circle_curvature(x, y), sign / radius, rtol=1e-7)
    inner = signed_waypoint_curvature(x, y)[2:-2]
    # Central differences of step theta: kappa = 1 / (R sin theta / theta ...), relative O(theta^2).
    np.testing.assert_allclose(inner, sign / radius, rtol=(0.25 / radius) ** 2)
    np.testing.assert_array_equal(waypoint_curvature(x, y)[2:-2], np.abs(inner))


def test_ellipse() -> None:
    a, b = 30.0, 12.0
    t = np.linspace(0.0, 2 * math.pi, 2001)
    x, y = a * np.cos(t), b * np.sin(t)
    expected = a * b / ((a * np.sin(t)) ** 2 + (b * np.cos(t)) ** 2) ** 1.5
    for formula in (circle_curvature, signed_waypoint_curvature):
        np.testing.assert_allclose(formula(x, y)[2:-2], expected[2:-2], rtol=1e-4)


@given(st.floats(0.01, 2.2), st.floats(0.05, 2.0), st.sampled_from([-1.0, 1.0]))
def test_kink(angle: float, spacing: float, sign: float) -> None:
    x, y = polyline([sign * angle], [6, 6])
    kappa = signed_waypoint_curvature(spacing * x, spacing * y)
    top = math.sin(angle / 2) / (spacing * math.cos(angle / 2) ** 2)
    beside = math.sin(angle) / (4 * spacing)
    expected = np.zeros(13)
    expected[5:8] = sign * np.array([beside, top, beside])
    np.testing.assert_allclose(kappa, expected, atol=1e-9 * max(top, 1.0))


def test_statistics_of_a_circle_are_analytic() -> None:
    path = load("circle")
    rows = statistics(path)
    assert rows.length == pytest.approx(2 * math.pi * 30.0)
    assert rows.max_curvature == pytest.approx(1 / 30.0)
    assert rows.max_speed == pytest.approx(math.sqrt(2.0 * 30.0))
    assert rows.max_lateral_acceleration == pytest.approx(2.0)
    # A closed path's seam counts once: n - 1 waypoints of 1 / 30, so the turning is 2 pi.
    assert rows.total_curvature * path.spacing == pytest.approx(2 * math.pi, rel=1e-12)


def test_bands_of_the_default_thresholds() -> None:
    bands = CurvatureBands()
    assert len(bands) == 4
    np.testing.assert_array_equal(
        bands.classify([0.0, 0.0049, 0.005, -0.019, 0.02, -0.049, 0.05, 9.0]),
        [0, 0, 1, 1, 2, 2, 3, 3],
    )
    # 1.1, 4.6 and 11.3 degrees of steering at a wheelbase of 4 m.
    steering = np.degrees(np.arctan(4.0 * np.array(bands.thresholds)))
    np.testing.assert_allclose(steering, [1.1, 4.6, 11.3], atol=0.06)


def test_selection_has_hysteresis_downwards_only() -> None:
    bands = CurvatureBands()
    assert bands.select([0.0, -0.06, 0.01]) == 3
    assert bands.select([0.049], current=3) == 3  # under the threshold, not by a fifth
    assert bands.select([0.0401], current=3) == 3
    assert bands.select([0.0399], current=3) == 2
    assert bands.select([0.0501], current=2) == 3  # upwards at once
    assert bands.select([0.017], current=3) == 2  # two bands below: as far as hysteresis holds
    assert bands.select([0.0], current=3) == 0
    assert bands.select([], current=2) == 0
    assert bands.select([0.049], current=None) == 2


@given(
    st.lists(st.floats(-0.2, 0.2), min_size=1, max_size=10), st.integers(0, 3), st.integers(0, 3)
)
def test_selection_is_stable_and_ordered(kappa: list[float], one: int, other: int) -> None:
    bands = CurvatureBands()
    selected = bands.select(kappa, one)
    assert bands.select(kappa, selected) == selected
    assert selected >= bands.select(kappa)
    assert bands.select(kappa, min(one, other)) <= bands.select(kappa, max(one, other))
    assert bands.select([-k for k in kappa], one) == selected


def test_no_flicker_around_a_threshold() -> None:
    bands, band, changes = CurvatureBands(), 2, 0
    for k in range(200):
        selected = bands.select([0.05 + 0.004 * math.sin(k)], band)
        changes += selected != band
        band = selected
    assert changes == 1


def test_shares_of_length() -> None:
    bands = CurvatureBands()
    np.testing.assert_array_equal(bands.shares(load("circle")), [0, 0, 1, 0])
    for name in ("T1", "T6"):
        assert bands.shares(load(name)).sum() == pytest.approx(1.0)
    assert bands.shares(load("T6"))[3] == 0.0
    assert bands.shares(load("T4"))[3] > 0.1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"thresholds": (0.02, 0.01, 0.05)}, "must increase"),
        ({"thresholds": (0.0, 0.01, 0.05)}, "above 0"),
        ({"thresholds": (0.01,)}, "need 2 names"),
        ({"hysteresis": 1.0}, "hysteresis"),
        ({"hysteresis": -0.1}, "hysteresis"),
    ],
)
def test_bad_bands_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CurvatureBands(**options)  # type: ignore[arg-type]


def test_nan_thresholds_are_refused() -> None:
    with pytest.raises(ValueError, match=r"thresholds\[\d\] must be a finite number"):
        CurvatureBands(thresholds=(0.01, math.nan, 0.05))
