"""The compiled scalar functions: actuators, angles, saturation, the judgement of a step."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpv_track_env import integration, kernels
from lpv_track_env.task import Task
from lpv_track_env.vehicle import M2_MINIBUS

LIMITS = (0.5, 0.02, -5.0, 3.5, 0.25)
"""Steering range and step, acceleration range and step."""

finite = st.floats(-1e6, 1e6)
inner_a, inner_delta = st.floats(-5.0, 3.5), st.floats(-0.5, 0.5)


@pytest.mark.parametrize(
    ("action", "last", "wanted", "bits"),
    [
        ((0.1, 0.01), (0.0, 0.0), (0.1, 0.01), 0),
        ((0.25, -0.02), (0.0, 0.0), (0.25, -0.02), 0),
        ((1.0, 0.0), (0.0, 0.0), (0.25, 0.0), kernels.RATE_ACCELERATION),
        ((0.0, 0.3), (0.0, 0.0), (0.0, 0.02), kernels.RATE_STEERING),
        ((0.0, -0.3), (0.0, 0.1), (0.0, 0.08), kernels.RATE_STEERING),
        ((9.0, 0.0), (3.4, 0.0), (3.5, 0.0), kernels.RANGE_ACCELERATION),
        ((-9.0, 0.0), (-4.9, 0.0), (-5.0, 0.0), kernels.RANGE_ACCELERATION),
        ((0.0, 0.9), (0.0, 0.49), (0.0, 0.5), kernels.RANGE_STEERING),
        ((0.0, -0.9), (0.0, -0.49), (0.0, -0.5), kernels.RANGE_STEERING),
        ((9.0, 0.9), (0.0, 0.0), (0.25, 0.02), 15),
        ((1e300, -1e300), (0.0, 0.0), (0.25, -0.02), 15),
        # Rounding at a bound is not reported.
        ((3.5 + 1e-7, 0.5 + 1e-8), (3.5, 0.5), (3.5, 0.5), 0),
    ],
)
def test_actuators(
    action: tuple[float, float],
    last: tuple[float, float],
    wanted: tuple[float, float],
    bits: int,
) -> None:
    a, delta, clipped = kernels.actuate(*action, *last, *LIMITS)
    assert a == pytest.approx(wanted[0], abs=1e-15)
    assert delta == pytest.approx(wanted[1], abs=1e-15)
    assert clipped == bits


@settings(deadline=None)
@given(finite, finite, inner_a, inner_delta)
def test_actuators_keep_range_and_rate(a: float, delta: float, last_a: float, last: float) -> None:
    new_a, new_delta, bits = kernels.actuate(a, delta, last_a, last, *LIMITS)
    assert -5.0 <= new_a <= 3.5
    assert -0.5 <= new_delta <= 0.5
    assert abs(new_a - last_a) <= 0.25 + 1e-12
    assert abs(new_delta - last) <= 0.02 + 1e-12
    if bits == 0:
        assert (new_a, new_delta) == pytest.approx((a, delta), abs=2e-6)
    mirrored = kernels.actuate(a, -delta, last_a, -last, *LIMITS)
    assert mirrored == (new_a, -new_delta, bits)


@pytest.mark.parametrize(
    ("angle", "wanted"),
    [
        (0.0, 0.0),
        (math.pi, math.pi),
        (-math.pi, math.pi),
        (3.0 * math.pi, math.pi),
        (math.nextafter(-math.pi, 0.0), math.nextafter(-math.pi, 0.0)),
        (math.pi + 0.5, 0.5 - math.pi),
        (-math.pi - 0.5, math.pi - 0.5),
        (200.0 * math.pi + 1.0, 1.0),
        (-200.0 * math.pi - 1.0, -1.0),
    ],
)
def test_wrap(angle: float, wanted: float) -> None:
    assert kernels.wrap(angle) == pytest.approx(wanted, abs=1e-12)


@settings(deadline=None)
@given(st.floats(-1e4, 1e4))
def test_wrap_is_the_same_angle_within_a_turn(angle: float) -> None:
    wrapped = kernels.wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-11)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-11)
    if -math.pi < angle <= math.pi:
        assert wrapped == angle


def test_rotation_agrees_with_libm() -> None:
    """Error of the cosine's and sine's series: angle^8 / 8! and angle^9 / 9!, plus rounding."""
    rng = np.random.default_rng(0)
    for angle in [0.0, *rng.uniform(-0.1, 0.1, 2000)]:
        psi = rng.uniform(-math.pi, math.pi)
        c, s = integration.rotate(math.cos(psi), math.sin(psi), float(angle))
        bound = abs(angle) ** 8 / math.factorial(8) + abs(angle) ** 9 / math.factorial(9) + 5e-16
        assert math.hypot(c - math.cos(psi + angle), s - math.sin(psi + angle)) <= bound


def test_saturation() -> None:
    assert kernels.saturate(0.3, 1.0) == 0.3
    assert kernels.saturate(3.0, 1.0) == 1.0
    assert kernels.saturate(-3.0, 1.0) == -1.0
    assert kernels.saturate(math.inf, 1.0) == 1.0
    assert kernels.saturate(-math.inf, 1.0) == -1.0
    assert kernels.saturate(math.nan, 1.0) == 0.0


def constants(**changes: float) -> np.ndarray:
    values = np.zeros(kernels.CONSTANTS_SIZE)
    values[kernels.CORRIDOR], values[kernels.LENGTH], values[kernels.MAX_STEPS] = 5.0, 100.0, 50.0
    for name, value in changes.items():
        values[getattr(kernels, name)] = value
    return values


def record(**changes: float) -> np.ndarray:
    values = np.zeros(kernels.RECORD_SIZE)
    for name, value in changes.items():
        values[getattr(kernels, name)] = value
    return values


@pytest.mark.parametrize(
    ("changes", "closed", "wanted"),
    [
        ({}, 0.0, "running"),
        ({"LATERAL_ERROR": 5.0}, 0.0, "running"),
        ({"LATERAL_ERROR": -5.001}, 0.0, "left_corridor"),
        ({"LATERAL_ERROR": 5.001}, 0.0, "left_corridor"),
        ({"HEADING_ERROR": 0.5 * math.pi}, 0.0, "running"),
        ({"HEADING_ERROR": -1.58}, 0.0, "wrong_heading"),
        ({"ARC_LENGTH": 99.9}, 0.0, "running"),
        ({"ARC_LENGTH": 100.0}, 0.0, "finished"),
        ({"ARC_LENGTH": 100.0, "START": 20.0}, 0.0, "finished"),
        ({"ARC_LENGTH": 100.0, "START": 20.0}, 1.0, "running"),
        ({"ARC_LENGTH": 120.0, "START": 20.0}, 1.0, "finished"),
        ({"STEPS": 49.0}, 0.0, "running"),
        ({"STEPS": 50.0}, 0.0, "time_limit"),
        # An end of the task goes before the time limit, leaving before finishing.
        ({"STEPS": 50.0, "ARC_LENGTH": 100.0}, 0.0, "finished"),
        ({"STEPS": 50.0, "LATERAL_ERROR": 6.0}, 0.0, "left_corridor"),
        ({"ARC_LENGTH": 100.0, "LATERAL_ERROR": 6.0}, 0.0, "left_corridor"),
    ],
)
def test_judgement(changes: dict[str, float], closed: float, wanted: str) -> None:
    code = kernels.end_code(record(**changes), constants(CLOSED=closed), True)
    assert kernels.END_NAMES[code] == wanted
    assert (
        kernels.END_NAMES[kernels.end_code(record(**changes), constants(), False)] == "non_finite"
    )


def test_layout_of_memory_and_constants() -> None:
    """The named indices and what `Task.constants` packs must be the same list."""
    import trajectories
    from lpv_track_env.observation import ObservationLayout
    from lpv_track_env.reward import TERMS, RewardWeights

    weights = RewardWeights()
    task = Task(
        path=trajectories.load("circle"), vehicle=M2_MINIBUS, control_period=0.04,
        layout=ObservationLayout(7, 0.1), reward_weights=weights, max_lateral_error=3.0,
        time_limit=12.0, initial_error_range=(0.1, 0.2, 0.3), random_start=True,
    )  # fmt: skip
    packed = task.constants()
    assert packed.shape == (kernels.CONSTANTS_SIZE,)
    np.testing.assert_array_equal(packed[:7], M2_MINIBUS.as_array())
    wanted = {
        "MAX_STEERING": M2_MINIBUS.max_steering_angle,
        "STEERING_STEP": M2_MINIBUS.max_steering_rate * 0.04,
        "LOWEST_ACCELERATION": -5.0,
        "HIGHEST_ACCELERATION": 3.5,
        "ACCELERATION_STEP": M2_MINIBUS.max_jerk * 0.04,
        "PERIOD": 0.04,
        "SUBSTEPS": 8.0,
        "PREVIEW_PERIOD": 0.1,
        "CORRIDOR": 3.0,
        "MAX_STEPS": 300.0,
        "LENGTH": task.path.length,
        "CLOSED": 1.0,
        "START_RANGE": task.path.length,
        "LATERAL_RANGE": 0.1,
        "HEADING_RANGE": 0.2,
        "SPEED_RANGE": 0.3,
        "LOWEST_SPEED": 0.0,
    }
    for name, value in wanted.items():
        assert packed[getattr(kernels, name)] == value, name
    # Of a circle of 30 m: the chords' turn over their length comes a little above 1 / R.
    assert packed[kernels.TIGHTEST] == pytest.approx(1.0 / 30.0, rel=1e-4)
    np.testing.assert_array_equal(packed[kernels.WEIGHTS :], weights.as_array())
    assert kernels.TERMS + len(TERMS) == kernels.RECORD_SIZE
