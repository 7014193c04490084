"""Geometry against analytic answers: the segment language, ramps, parametric curves."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ellipe

from trajectories import SpeedLimits, shapes
from trajectories.path import SPACING

LIMITS = SpeedLimits(max_speed=8.0, max_lateral_acceleration=1.5, max_acceleration=1.5)


def geometry(text: str, **targets: float) -> shapes.Geometry:
    return shapes.build(shapes.fit(shapes.parse(text), LIMITS, **targets))


def test_language_is_read() -> None:
    straight, left, right = shapes.parse("S 45|L 90 r11 |  R 60 r20 t15 a0.8")
    assert straight == shapes.Segment(length=45.0)
    assert left == shapes.Segment(turn=math.radians(90), radius=11.0)
    assert right == shapes.Segment(turn=-math.radians(60), radius=20.0, transition=15.0, share=0.8)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("S 45 | X 3", r"segment 2 \('X 3'\)"),
        ("S 45 | L 90", r"segment 2 \('L 90'\)"),
        ("S 45 | L 90 r11 | S -4", r"segment 3 \('S -4'\)"),
        ("S 0 | L 90 r11", r"segment 1 \('S 0'\): numbers must be positive"),
        ("S 4 | L 90 r0", r"segment 2 \('L 90 r0'\): numbers must be positive"),
        ("S 4 || S 4", r"segment 2 \(''\)"),
        ("", r"segment 1 \(''\)"),
        ("S 1.2.3", r"segment 1 \('S 1.2.3'\)"),
        ("S nan", r"segment 1 \('S nan'\)"),
        ("l 90 r11", r"segment 1 \('l 90 r11'\)"),
    ],
)
def test_errors_name_the_segment(text: str, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        shapes.parse(text)


@given(st.text(alphabet="SLRrta 0123456789.|-", max_size=40))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        segments = shapes.parse(text)
    except ValueError as error:
        segments, message = [], str(error)
    else:
        message = "segment"
    assert "segment" in message
    assert all(math.isfinite(s.length) and math.isfinite(s.turn) for s in segments)


def test_turns_that_were_not_fitted_are_refused() -> None:
    with pytest.raises(ValueError, match="segment 2 has no length"):
        shapes.build(shapes.parse("S 10 | L 90 r10 | S 10"))


def test_turning_cannot_be_scaled_without_turns() -> None:
    with pytest.raises(ValueError, match="no turns"):
        shapes.fit(shapes.parse("S 10"), LIMITS, total_turning=1.0)


def test_turns_longer_than_the_length_are_refused() -> None:
    with pytest.raises(ValueError, match="no straights are left"):
        shapes.fit(shapes.parse("S 10 | L 180 r20 | S 10"), LIMITS, length=60.0)


def test_length_and_turning_are_met_exactly() -> None:
    path = geometry("S 40 | L 90 r11 | S 40 | R 60 r20 | S 40", length=300.0, total_turning=3.0)
    assert path.arc_length[-1] == pytest.approx(300.0, rel=1e-14)
    segments = shapes.fit(
        shapes.parse("S 40 | L 90 r11 | S 40 | R 60 r20 | S 40"), LIMITS, 300.0, 3.0
    )
    assert sum(abs(s.turn) for s in segments) == pytest.approx(3.0, rel=1e-14)
    assert path.heading[-1] == pytest.approx(3.0 * (90 - 60) / 150, rel=1e-12)


def test_straight_is_straight() -> None:
    path = geometry("S 100")
    np.testing.assert_allclose(path.x, path.arc_length, rtol=1e-14)
    assert (path.y == 0).all()
    assert (path.curvature == 0).all()


def test_turn_with_short_ramps_is_nearly_an_arc() -> None:
    path = geometry("S 20 | L 90 r20 t0.001 | S 20")
    assert path.arc_length[-1] == pytest.approx(40.001 + 0.5 * math.pi * 20.0, rel=1e-12)
    # Two straights of 20 m and a quarter of a circle of radius 20 m end at (40, 40).
    assert path.x[-1] == pytest.approx(40.0, abs=2e-3)
    assert path.y[-1] == pytest.approx(40.0, abs=2e-3)


def test_bloss_ramp_is_continuously_differentiable() -> None:
    ramp, radius = 15.0, 20.0
    path = geometry("S 20 | L 90 r20 t15 | S 20")
    s, kappa = path.arc_length, path.curvature
    u = ((s - 20.0) / ramp).clip(0.0, 1.0)
    rising = s < 20.0 + ramp
    np.testing.assert_allclose(kappa[rising], ((3 * u**2 - 2 * u**3) / radius)[rising], atol=1e-14)
    slope = np.diff(kappa) / np.diff(s)
    steepest = 1.5 / (radius * ramp)
    assert np.abs(slope).max() == pytest.approx(steepest, rel=1e-3)
    # C1: the slope changes by at most h max|kappa''| = h 6 / (R t^2) from cell to cell.
    assert np.abs(np.diff(slope)).max() <= 1.01 * SPACING * 6.0 / (radius * ramp**2)


@given(st.lists(
    st.one_of(
        st.builds("S {:.1f}".format, st.floats(1.0, 80.0)),
        st.builds(
            "{} {:.1f} r{:.1f}".format,
            st.sampled_from("LR"), st.floats(5.0, 180.0), st.floats(8.0, 60.0),
        ),
    ),
    min_size=1, max_size=8,
))  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_any_path_is_consistent(parts: list[str]) -> None:
    segments = shapes.fit(shapes.parse(" | ".join(parts)), LIMITS)
    path = shapes.build(segments)
    length = sum(s.length for s in segments)
    assert path.arc_length[-1] == pytest.approx(length, rel=1e-12)
    assert path.heading[-1] == pytest.approx(sum(s.turn for s in segments), abs=1e-9)
    h = path.arc_length[1]
    # A chord is shorter than its arc by (kappa h)^2 / 24 of it at most.
    chords = np.hypot(np.diff(path.x), np.diff(path.y))
    sharpest = max((1 / s.radius for s in segments), default=0.0)
    assert (chords <= h * (1 + 1e-12)).all()
    assert (chords >= h * (1 - (sharpest * h) ** 2 / 24 - 1e-12)).all()
    assert np.abs(path.curvature).max() <= sharpest + 1e-12
    steered = np.abs(np.gradient(np.arctan(LIMITS.wheelbase * path.curvature), h))
    speed = np.minimum(
        LIMITS.max_speed,
        np.sqrt(LIMITS.max_lateral_acceleration / np.maximum(sharpest, 1e-9)),
    )
    full = [s for s in segments if s.turn and s.transition < abs(s.turn) * s.radius - 1e-9]
    if len(full) == sum(s.turn != 0 for s in segments) == 1:  # a ramp as long as was asked for
        assert steered.max() * speed <= 1.02 * LIMITS.max_steering_rate


def ellipse(a: float, b: float) -> Callable[[np.ndarray], shapes.Derivatives]:
    def curve(t: np.ndarray) -> shapes.Derivatives:
        c, s = np.cos(t), np.sin(t)
        return a * c, b * s, -a * s, b * c, -a * c, -b * s

    return curve


def test_parametric_circle() -> None:
    path = shapes.parametric(ellipse(25.0, 25.0), 2 * math.pi)
    assert path.arc_length[-1] == pytest.approx(50.0 * math.pi, rel=1e-12)
    np.testing.assert_allclose(path.curvature, 1 / 25.0, rtol=1e-12)
    np.testing.assert_allclose(path.heading, 0.5 * math.pi + path.arc_length / 25.0, atol=1e-12)


@pytest.mark.parametrize("b", [20.0, 10.0, 3.0])
def test_parametric_ellipse(b: float) -> None:
    a = 40.0
    path = shapes.parametric(ellipse(a, b), 2 * math.pi)
    assert path.arc_length[-1] == pytest.approx(4 * a * ellipe(1 - (b / a) ** 2), rel=1e-13)
    # On the ellipse kappa = a b / (a^2 sin^2 + b^2 cos^2)^(3/2), with cos = x / a, sin = y / b.
    expected = a * b / ((a * path.y / b) ** 2 + (b * path.x / a) ** 2) ** 1.5
    np.testing.assert_allclose(path.curvature, expected, rtol=1e-9)
    quarter = np.interp(0.25 * path.arc_length[-1], path.arc_length, path.y)
    assert quarter == pytest.approx(b, abs=1e-3)


def test_parametric_arc_length_is_uniform_where_the_parameter_is_not() -> None:
    def parabola(t: np.ndarray) -> shapes.Derivatives:
        return t, 0.05 * t * t, np.ones_like(t), 0.1 * t, np.zeros_like(t), 0.1 * np.ones_like(t)

    path = shapes.parametric(parabola, 60.0, pieces=500)
    # Length of y = c x^2 / 2 from 0 to x: (u sqrt(1 + u^2) + asinh u) / (2 c), u = c x.
    u = 0.1 * path.x
    np.testing.assert_allclose(
        (u * np.sqrt(1 + u * u) + np.arcsinh(u)) / 0.2, path.arc_length, rtol=0, atol=1e-9
    )


def test_grid_is_as_near_to_the_spacing_as_fits() -> None:
    s = shapes.grid(100.1)
    assert len(s) == 401
    assert s[-1] == 100.1
    assert len(shapes.grid(0.1)) == 4


def test_polyline_counts_its_legs() -> None:
    x, y = shapes.polyline([math.pi / 2], [3, 2])
    np.testing.assert_allclose(x, [0, 1, 2, 3, 3, 3], atol=1e-15)
    np.testing.assert_allclose(y, [0, 0, 0, 0, 1, 2], atol=1e-15)
