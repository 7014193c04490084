"""ReferencePath against brute force and analytic answers: sampling, projection, preview."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trajectories import ReferencePath, load

SMOOTH = ("T1", "T4", "circle", "figure-eight", "sine", "u-turn", "random-7")
RADIUS = 30.0
"""m, of the catalogue's circle."""


def off_path(path: ReferencePath, s: float, lateral: float) -> tuple[float, float]:
    """Position at a signed distance to the left of the path."""
    at = path.sample(s)
    return (
        float(at.x - lateral * np.sin(at.heading)),
        float(at.y + lateral * np.cos(at.heading)),
    )


@pytest.mark.parametrize("name", SMOOTH)
def test_positions_move_along_the_heading_at_unit_rate(name: str) -> None:
    path = load(name)
    s = np.linspace(1.0, path.length - 1.0, 301)
    step = 1e-3
    before, at, after = path.sample(s - step), path.sample(s), path.sample(s + step)
    dx, dy = (after.x - before.x) / (2 * step), (after.y - before.y) / (2 * step)
    # Hermite interpolation on h = 0.25 m: tangents are exact to O(h^3 kappa'').
    assert np.abs(dx - np.cos(at.heading)).max() < 1e-4
    assert np.abs(dy - np.sin(at.heading)).max() < 1e-4


@pytest.mark.parametrize("name", SMOOTH)
def test_curvature_is_the_derivative_of_heading(name: str) -> None:
    path = load(name)
    s = np.linspace(1.0, path.length - 1.0, 301)
    step = 1e-3
    slope = (path.sample(s + step).heading - path.sample(s - step).heading) / (2 * step)
    assert np.abs(slope - path.sample(s).curvature).max() < 1e-3


@pytest.mark.parametrize("name", SMOOTH)
def test_heading_change_is_the_integral_of_curvature(name: str) -> None:
    path = load(name)
    turned = np.trapezoid(path.curvature, path.arc_length)
    assert turned == pytest.approx(path.heading[-1] - path.heading[0], abs=1e-4)


def test_samples_at_nodes_are_the_nodes() -> None:
    path = load("T2")
    inner = slice(1, -1)
    at = path.sample(path.arc_length[inner])
    for sampled, node in zip(
        at[:5], (path.x, path.y, path.heading, path.curvature, path.speed), strict=True
    ):
        np.testing.assert_allclose(sampled, node[inner], rtol=0, atol=1e-11)
    np.testing.assert_allclose(at.time, path.time[inner], rtol=0, atol=1e-9)


def test_sample_keeps_the_shape_asked_for() -> None:
    path = load("T2")
    assert path.sample(3.0).x.shape == ()
    assert path.sample(np.zeros((2, 3))).time.shape == (2, 3)


@pytest.mark.parametrize(("name", "turns"), [("circle", 1), ("figure-eight", 0)])
def test_closed_paths_join(name: str, turns: int) -> None:
    path = load(name)
    assert path.closed
    assert np.hypot(path.x[-1] - path.x[0], path.y[-1] - path.y[0]) < 1e-9
    assert path.heading[-1] - path.heading[0] == pytest.approx(2 * np.pi * turns, abs=1e-9)
    assert path.curvature[-1] == pytest.approx(path.curvature[0], abs=1e-9)
    assert path.speed[-1] == path.speed[0]


def test_closed_paths_go_on_over_laps() -> None:
    path = load("circle")
    s = np.array([3.0, 77.7, 188.0])
    first, third = path.sample(s), path.sample(s + 2 * path.length)
    np.testing.assert_allclose(third.x, first.x, atol=1e-9)
    np.testing.assert_allclose(third.heading - first.heading, 4 * np.pi, atol=1e-9)
    np.testing.assert_allclose(third.time - first.time, 2 * path.duration, atol=1e-9)
    before = path.sample(s - path.length)
    np.testing.assert_allclose(before.heading - first.heading, -2 * np.pi, atol=1e-9)


def test_circle_is_a_circle_between_nodes() -> None:
    path = load("circle")
    at = path.sample(np.linspace(0, path.length, 5000))
    # Cubic Hermite on an arc of angle h / R: error R (h / R)^4 / 384, here 4e-10 m.
    assert np.abs(np.hypot(at.x, at.y - RADIUS) - RADIUS).max() < 1e-9
    assert path.length == pytest.approx(2 * np.pi * RADIUS, rel=1e-12)


@given(s=st.floats(0.0, 2 * np.pi * RADIUS), lateral=st.floats(-40.0, 15.0))
@settings(max_examples=200, deadline=None)
def test_projection_on_the_circle_is_analytic(s: float, lateral: float) -> None:
    path = load("circle")
    x, y = off_path(path, s, lateral)
    foot = path.project(x, y)
    assert foot.lateral_error == pytest.approx(RADIUS - np.hypot(x, y - RADIUS), abs=1e-6)
    along = (foot.arc_length - s + 0.5 * path.length) % path.length - 0.5 * path.length
    assert abs(along) < 1e-4
    assert foot.curvature == pytest.approx(1 / RADIUS)


@pytest.mark.parametrize("name", ["T1", "T4", "u-turn", "sine", "random-7"])
def test_projection_agrees_with_brute_force(name: str) -> None:
    path = load(name)
    rng = np.random.default_rng(5)
    coarse = np.linspace(0.0, path.length, 4001)
    at = path.sample(coarse)
    for s, lateral in zip(rng.uniform(0, path.length, 40), rng.uniform(-3, 3, 40), strict=True):
        x, y = off_path(path, s, lateral)
        best = int(np.argmin(np.hypot(at.x - x, at.y - y)))
        dense = np.linspace(coarse[max(best - 1, 0)], coarse[min(best + 1, 4000)], 1001)
        near = path.sample(dense)
        distances = np.hypot(near.x - x, near.y - y)
        best = int(np.argmin(distances))
        foot = path.project(x, y)
        assert abs(foot.lateral_error) == pytest.approx(distances[best], abs=2e-3)
        assert foot.arc_length == pytest.approx(dense[best], abs=2e-3)
        local = path.project(x, y, near=s + rng.uniform(-1.5, 1.5))
        assert local.arc_length == pytest.approx(s, abs=1e-3)
        assert local.lateral_error == pytest.approx(lateral, abs=1e-6)


def test_projection_stays_on_the_local_branch_at_a_crossing() -> None:
    path = load("figure-eight")
    half = 0.5 * path.length  # the second passage of the crossing, which is the start
    assert np.hypot(path.sample(half).x, path.sample(half).y) < 1e-6
    for branch, lateral in ((0.0, 0.3), (half, 0.3), (path.length, -0.3)):
        x, y = off_path(path, branch + 0.4, lateral)
        foot = path.project(x, y, near=branch)
        assert foot.arc_length == pytest.approx(branch + 0.4, abs=1e-4)
        assert foot.lateral_error == pytest.approx(lateral, abs=1e-6)
        assert foot.heading == pytest.approx(path.sample(branch + 0.4).heading, abs=1e-4)


def test_following_the_figure_eight_never_changes_branch() -> None:
    path = load("figure-eight")
    near = 0.0
    for s in np.arange(0.0, 2.5 * path.length, 0.7):
        foot = path.project(*off_path(path, s, 0.5 * np.sin(s)), near=near)
        near = foot.arc_length
        assert near == pytest.approx(s, abs=1e-3)


def test_projection_beyond_an_open_end_stays_at_the_end() -> None:
    path = load("straight")
    assert path.project(-5.0, 2.0).arc_length == 0.0
    foot = path.project(path.length + 7.0, -1.5, near=path.length)
    assert foot.arc_length == path.length
    assert foot.lateral_error == pytest.approx(-1.5)


@pytest.mark.parametrize("name", ["T1", "T5", "figure-eight"])
def test_time_and_arc_length_are_inverse(name: str) -> None:
    path = load(name)
    times = np.linspace(0.0, path.duration, 777)[1:-1]
    s = path.arc_length_at(times)
    assert (np.diff(s) > 0).all()
    np.testing.assert_allclose(path.sample(s).time, times, rtol=0, atol=1e-8)


def test_time_is_the_integral_of_slowness() -> None:
    path = load("T3")
    dense = np.linspace(0.0, path.length, 200_001)
    duration = np.trapezoid(1.0 / path.sample(dense[::20]).speed, dense[::20])
    assert path.duration == pytest.approx(duration, rel=1e-5)


def test_time_beyond_the_end() -> None:
    straight, circle = load("straight"), load("circle")
    later = straight.arc_length_at(straight.duration + 2.0)
    assert later == pytest.approx(straight.length + 2.0 * straight.speed[-1])
    lapped = circle.arc_length_at(2 * circle.duration + 1.0)
    assert lapped == pytest.approx(2 * circle.length + circle.speed[0], rel=1e-9)


@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.parametrize("period", [0.02, 0.1])
def test_preview_headings_follow_exactly(name: str, period: float) -> None:
    path = load(name)
    count = 40
    for s in np.linspace(0.0, 0.9 * path.length, 7):
        preview = path.preview(s, period, count)
        now = float(path.sample(s).time)
        nodes = np.concatenate([[s], path.arc_length_at(now + period * np.arange(1, count + 1))])
        if path.closed:
            assert nodes[-1] > s
        inside = nodes <= path.length if not path.closed else np.full(count + 1, True)
        headings = path.sample(nodes).heading
        turned = np.concatenate([[0.0], np.cumsum(preview.curvature * np.diff(nodes))])
        assert np.abs((turned - headings + headings[0])[inside]).max() < 1e-9
        np.testing.assert_allclose(preview.speed, path.sample(nodes[1:]).speed, atol=1e-9)


def test_preview_beyond_an_open_end_is_straight_at_the_last_speed() -> None:
    path = load("T2")
    preview = path.preview(path.length - 0.1, 0.1, 30)
    np.testing.assert_allclose(preview.curvature[2:], 0.0, atol=1e-12)
    np.testing.assert_allclose(preview.speed[2:], path.speed[-1])


def test_preview_over_the_seam_of_a_circle() -> None:
    path = load("circle")
    preview = path.preview(path.length - 1.0, 0.1, 30)
    np.testing.assert_allclose(preview.curvature, 1 / RADIUS, rtol=1e-9)


@pytest.mark.parametrize("name", ["T2", "circle"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_are_refused(name: str, value: float) -> None:
    path = load(name)
    for call in (
        lambda: path.sample(value),
        lambda: path.project(value, 0.0),
        lambda: path.project(0.0, 0.0, near=value),
        lambda: path.preview(value, 0.1, 3),
        lambda: path.arc_length_at(value),
    ):
        with pytest.raises(ValueError, match="must be finite"):
            call()


def test_mirrored_path_gives_mirrored_projection() -> None:
    path = load("T4")
    mirrored = path.mirrored()
    for s, lateral in ((30.0, 1.0), (123.0, -0.7), (321.0, 0.2)):
        x, y = off_path(path, s, lateral)
        assert mirrored.project(x, -y).lateral_error == pytest.approx(-lateral, abs=1e-9)
        assert mirrored.sample(s).curvature == -path.sample(s).curvature


def test_with_speed_keeps_the_geometry() -> None:
    path = load("T2").with_speed(4.0)
    assert path.duration == pytest.approx(path.length / 4.0)
    assert (path.acceleration == 0).all()


def test_pickled_path_is_the_same() -> None:
    path = load("circle")
    assert path.table.shape == (len(path.x), 8)
    copy = pickle.loads(pickle.dumps(path))  # noqa: S301
    np.testing.assert_array_equal(copy.table, path.table)
    assert copy.closed
    assert copy.name == "circle"


def arrays(n: int = 5) -> dict[str, np.ndarray]:
    s = 0.25 * np.arange(n)
    zero = np.zeros(n)
    return {
        "arc_length": s, "x": s, "y": zero, "heading": zero, "curvature": zero,
        "speed": np.ones(n),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y": [0, 0, np.nan, 0, 0]}, r"y\[2\] is nan"),
        ({"speed": [1, 1, 1, np.inf, 1]}, r"speed\[3\] is inf"),
        ({"speed": [1, 1, 0, 1, 1]}, r"speed\[2\] is 0.0"),
        ({"heading": [0, 0, 0]}, "heading has shape"),
        ({"arc_length": [0, 0.25, 0.25, 0.75, 1.0]}, "does not increase at index 2"),
        ({"arc_length": [0, 0.25, 0.5, 0.8, 1.0]}, "uniform"),
        ({"arc_length": 1.0 + 0.25 * np.arange(5)}, "start at 0"),
        ({"closed": True}, "ends are 1 m apart"),
    ],
)
def test_bad_arrays_are_named(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ReferencePath(**{**arrays(), **change})  # type: ignore[arg-type]


def test_wrapped_headings_are_unwrapped() -> None:
    s = np.linspace(0.0, 160.0, 641)
    psi = s / 25.0
    wrapped = np.arctan2(np.sin(psi), np.cos(psi))
    x, y = 25.0 * np.sin(psi), 25.0 * (1.0 - np.cos(psi))
    path = ReferencePath(s, x, y, wrapped, np.full_like(s, 1 / 25.0), np.full_like(s, 6.0))
    assert wrapped.min() < -3.0
    np.testing.assert_allclose(path.heading, psi, atol=1e-12)


@pytest.mark.parametrize("unit", [180.0 / np.pi, -1.0])
def test_headings_that_point_backwards_are_refused(unit: float) -> None:
    s = np.linspace(0.0, 160.0, 641)
    psi = s / 25.0
    x, y = 25.0 * np.sin(psi), 25.0 * (1.0 - np.cos(psi))
    with pytest.raises(ValueError, match=r"heading\[\d+\] is .* must be in radians"):
        ReferencePath(s, x, y, unit * psi, np.full_like(s, 1 / 25.0), np.full_like(s, 6.0))


def test_closed_path_must_turn_whole_turns() -> None:
    circle = load("circle")
    with pytest.raises(ValueError, match="whole"):
        ReferencePath(
            circle.arc_length, circle.x, circle.y, 0.99 * circle.heading, circle.curvature,
            circle.speed, closed=True,
        )  # fmt: skip


def test_three_points_are_too_few() -> None:
    with pytest.raises(ValueError, match="3 points, at least 4"):
        ReferencePath(**arrays(3))


def test_arrays_cannot_be_changed_behind_a_paths_back() -> None:
    given_arrays = arrays()
    path = ReferencePath(**given_arrays)
    given_arrays["x"][2] = 99.0
    assert path.x[2] == 0.5
    with pytest.raises(ValueError, match="read-only"):
        path.x[0] = 1.0
