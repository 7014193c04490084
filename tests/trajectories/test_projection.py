"""The compiled projection: the quick search finds what a search of all nodes finds, to rounding."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize_scalar

from trajectories import ReferencePath, load, projection, table

NAMES = ("T1", "T4", "T2-raw", "circle", "figure-eight", "sine", "u-turn", "random-7")


def hairpin() -> ReferencePath:
    """Two straights 1 m apart joined by a half circle: within the window there are two branches."""
    arc = np.arange(0.0, 40.0, 0.05)
    radius, straight = 0.5, 18.0
    angle = np.clip((arc - straight) / radius, 0.0, math.pi)
    x = np.minimum(arc, straight) + radius * np.sin(angle)
    x -= np.maximum(arc - straight - math.pi * radius, 0.0)
    return ReferencePath(
        arc, x, radius * (1.0 - np.cos(angle)), angle,
        np.where((angle > 0.0) & (angle < math.pi), 1.0 / radius, 0.0), np.ones_like(arc),
        name="hairpin",
    )  # fmt: skip


def polyline() -> ReferencePath:
    """Kinks of 90 degrees that the columns of heading and curvature say nothing about."""
    arc = 0.25 * np.arange(161)
    legs = (arc / 5.0).astype(int)
    along = arc - 5.0 * legs
    east = (legs + 1) // 2 * 5.0 + np.where(legs % 2 == 0, along, 0.0)
    north = legs // 2 * 5.0 + np.where(legs % 2 == 1, along, 0.0)
    zero = np.zeros_like(arc)
    return ReferencePath(arc, east, north, zero, zero, np.ones_like(arc), name="polyline")


PATHS = {**{name: load(name) for name in NAMES}, "hairpin": hairpin(), "polyline": polyline()}
TIGHTEST = {name: projection.tightest_turn(path.table, path.closed) for name, path in PATHS.items()}


def both(name: str, x: float, y: float, near: float, ahead: float, window: float) -> Any:
    path = PATHS[name]
    start = (path.table, path.length, path.closed, x, y, near)
    return (
        projection.follow(*start, ahead, window, TIGHTEST[name])[:3],
        projection.project(*start, window)[:3],
    )


@pytest.mark.parametrize("name", PATHS)
@settings(deadline=None, max_examples=300)
@given(
    share=st.floats(0.0, 1.0), lateral=st.floats(-12.0, 12.0), offset=st.floats(-3.5, 3.5),
    ahead=st.floats(-4.0, 4.0), window=st.sampled_from([0.3, 3.0, 7.0]),
)  # fmt: skip
def test_quick_search_finds_what_the_full_search_finds(
    name: str, share: float, lateral: float, offset: float, ahead: float, window: float
) -> None:
    path = PATHS[name]
    s = share * path.length
    at = path.sample(s)
    x = float(at.x - lateral * np.sin(at.heading))
    y = float(at.y + lateral * np.cos(at.heading))
    quick, full = both(name, x, y, s + offset, ahead, window)
    assert quick == pytest.approx(full, rel=0, abs=1e-12)


@pytest.mark.parametrize("name", ["circle", "figure-eight"])
def test_quick_search_goes_on_over_laps(name: str) -> None:
    path = PATHS[name]
    for s in np.linspace(-1.5, 3.5, 60) * path.length:
        at = path.sample(s)
        quick, full = both(name, float(at.x) + 0.1, float(at.y) - 0.1, s - 0.3, 0.3, 3.0)
        assert quick == pytest.approx(full, rel=0, abs=1e-12)
        assert quick[0] == pytest.approx(s, abs=0.2)


@pytest.mark.parametrize("name", ["T1", "T4", "circle", "figure-eight", "sine", "random-7"])
def test_foot_point_is_the_nearest_point(name: str) -> None:
    """Against SciPy's minimiser on the interpolated path, within the bends' radius."""
    path = PATHS[name]
    rng = np.random.default_rng(2)
    ends = (
        np.column_stack([path.x, path.y]),
        np.column_stack([np.cos(path.heading), np.sin(path.heading)]),
    )
    spline = CubicHermiteSpline(path.arc_length, *ends)
    tangent = spline.derivative()
    reach = min(3.0, 0.6 / TIGHTEST[name])
    for s, share in zip(
        rng.uniform(2.0, path.length - 2.0, 40), rng.uniform(-1, 1, 40), strict=True
    ):
        at = path.sample(s)
        lateral = share * reach
        x = float(at.x - lateral * np.sin(at.heading))
        y = float(at.y + lateral * np.cos(at.heading))

        def distance(t: float, x: float = x, y: float = y) -> float:
            px, py = table.position_at(path.table, path.length, path.closed, t)
            return math.hypot(x - px, y - py)

        best = minimize_scalar(distance, bounds=(s - 0.5, s + 0.5), method="bounded",
                               options={"xatol": 1e-10})  # fmt: skip
        quick, _ = both(name, x, y, s - 0.4, 0.35, 3.0)
        assert abs(quick[1]) == pytest.approx(best.fun, abs=1e-9)
        assert abs(quick[1]) <= best.fun + 1e-12
        # The foot point itself, where the line of sight is square to the path: much sharper than
        # any minimiser finds it, for the distance is flat there.
        sight = np.array([x, y]) - spline(quick[0] % path.length)
        assert abs(sight @ tangent(quick[0] % path.length)) < 1e-9


def test_far_away_is_no_trap() -> None:
    """Beyond the centre of a bend the distance has several minima: the certificate must fail."""
    for x, y in ((0.0, 30.0), (5.0, 31.0), (200.0, 0.0), (-1e9, 1e9)):
        quick, full = both("circle", x, y, 20.0, 0.3, 40.0)
        assert quick == pytest.approx(full, rel=1e-12, abs=1e-9)


def test_tightest_turn() -> None:
    assert TIGHTEST["circle"] == pytest.approx(1.0 / 30.0, rel=1e-4)
    assert TIGHTEST["hairpin"] == pytest.approx(2.0, rel=1e-3)
    # A right angle at a node is pi / 2 over a chord of 0.25 m.
    assert TIGHTEST["polyline"] == pytest.approx(0.5 * math.pi / 0.25)
    assert projection.tightest_turn(load("straight").table, False) < 1e-9
