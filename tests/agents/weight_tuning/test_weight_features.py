"""What a chooser of weights sees, worked out again in NumPy from recorded drives."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import trajectories
from agents.weight_tuning import features
from agents.weight_tuning.env import WeightTuningEnv
from agents.weight_tuning.features import (
    AGE,
    HISTORY,
    LAST,
    LIMIT,
    QUICK,
    SCALES,
    SEEN,
    SLOW,
    STATISTICS,
    end_period,
    fill_features,
    update_history,
)  # fmt: skip
from agents.weights import HIGHEST, LOWEST
from lpv_track_env.observation import ObservationLayout
from tests.helpers.tuned_drives import CALM, CHOICES, ByHand, random_actions

Array = NDArray[Any]
CHOICE = CHOICES["stages"]
NAMES = features.names(CHOICE.bands.names)
PERIOD = 0.05


def exponential_means(squares: Array, time: float) -> Array:
    """Means of (k,) squares with a memory of `time` s, plain averages while that is longer."""
    mean, means = 0.0, []
    for count, square in enumerate(squares, start=1):
        share = max(1.0 - np.exp(-PERIOD / time), 1.0 / count)
        mean = (1.0 - share) * mean + share * square
        means.append(mean)
    return np.array(means)


def statistics(layout: ObservationLayout, observations: list[Array], actions: list[Array]) -> Array:
    """What mean squares are kept of, (k, 10), from observations (k + 1) and commands (k)."""
    o = layout.unpack(np.array(observations, dtype=np.float64))
    commands = np.vstack([[o.acceleration[0], o.steering_angle[0]], np.array(actions, dtype=float)])
    sin, cos = np.sin(o.heading_error[:-1]), np.cos(o.heading_error[:-1])
    moved = o.longitudinal_speed[:-1] * sin + o.lateral_speed[:-1] * cos
    turned = o.yaw_rate[:-1] - o.preview_curvature[:-1, 0] * o.longitudinal_speed[:-1]
    return np.column_stack([
        o.lateral_error[1:],
        o.heading_error[1:],
        (o.longitudinal_speed - o.reference_speed)[1:],
        np.diff(o.lateral_error) - PERIOD * moved,
        np.diff(o.heading_error) - PERIOD * turned,
        commands[1:, 1] - o.steering_angle[1:],
        commands[1:, 0] - o.acceleration[1:],
        np.diff(o.steering_angle) / PERIOD,
        np.diff(o.acceleration) / PERIOD,
        np.diff(commands[:, 1]) / PERIOD,
    ])  # fmt: skip


def wanted_features(hand: ByHand, driven: int) -> dict[str, float]:
    """Every feature by its definition, after a drive by hand; `driven` periods had its last window.

    Of what was observed, commanded, solved and chosen, and nothing else.
    """
    layout = hand.env.layout
    last = layout.unpack(np.asarray(hand.observations[-1], dtype=np.float64))
    curvature, speeds = np.abs(last.preview_curvature), last.preview_speed
    values = [
        last.longitudinal_speed / 10.0 - 1.0,
        abs(last.lateral_speed) / 0.5,
        abs(last.yaw_rate) / 0.3,
        last.acceleration / 2.0,
        abs(last.steering_angle) / 0.2,
        abs(last.lateral_error) / 0.1,
        abs(last.heading_error) / 0.1,
        last.longitudinal_speed - last.reference_speed,
        *(quarter.max() / 0.05 for quarter in np.split(curvature, 4)),
        (speeds[(len(speeds) - 1) // 2] - last.reference_speed) / 5.0,
        (speeds[-1] - last.reference_speed) / 5.0,
    ]
    squares = np.zeros((0, len(STATISTICS)))
    if hand.actions:
        squares = statistics(layout, hand.observations, hand.actions) ** 2
    for time in (0.4, 4.0):
        for j, scale in enumerate(SCALES):
            mean = exponential_means(squares[:, j], time)[-1] if len(squares) else 0.0
            values.append(0.25 * np.log(mean / scale**2 + 1e-3))
    values += [np.mean(hand.iterations[-driven:]) / 10.0 if driven else 0.0, 0.0]
    base = hand.choice.schedule.weights[hand.band or 0].as_array()
    used = base if hand.used is None else hand.used
    values += list(np.log(used / base)[:8] / np.log(hand.choice.span))
    values += [float(k == hand.band) for k in range(len(hand.choice.bands))]
    names = features.names(hand.choice.bands.names)
    return dict(zip(names, np.clip(values, -5.0, 5.0), strict=True))


# Against a drive by hand ---------------------------------------------------------------------


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
@pytest.mark.parametrize("name", ["stages", "schedule", "catalogue"])
def test_features_are_made_of_what_the_agent_sees_and_does(name: str, conditions: str) -> None:
    """Under "realtime" nothing of the true state, vehicle or disturbances is in them."""
    choice = CHOICES[name]
    given = {**CALM, "conditions": conditions}
    env, hand = WeightTuningEnv(choice=choice, **given), ByHand(choice, **given)
    observation, _ = env.reset(seed=7)
    hand.reset(seed=7)
    steps, seen = 0, []
    for action in [*random_actions(choice, 25), None]:
        wanted = wanted_features(hand, steps)
        found = dict(zip(wanted, observation.tolist(), strict=True))
        assert found == pytest.approx(wanted, rel=2e-6, abs=2e-6)
        seen.append(observation)
        if action is not None:
            observation, *_ = env.step(action)
            steps = hand.step(action)
    # None is the same all the time but failures: no solve fails here.
    assert np.ptp(seen, axis=0)[np.array(list(wanted)) != "failures"].astype(bool).sum() > 40


# Entries -------------------------------------------------------------------------------------


def test_names_are_those_of_the_entries() -> None:
    assert len(set(NAMES)) == len(NAMES) == features.size(4) == 48
    assert NAMES[-4:] == ("band_straight", "band_gentle", "band_moderate", "band_sharp")
    assert len(STATISTICS) == len(SCALES) == 10


def filled(o: Any, w: Array, used: Array | None = None, band: int = 0) -> Array:
    base = np.array([one.as_array() for one in CHOICE.schedule.weights])
    x = np.full(features.size(4), np.nan, dtype=np.float32)
    fill_features(
        np.asarray(o, dtype=np.float32), w, np.zeros(12) if used is None else used, base, band,
        SCALES, np.log(3.0), x,
    )  # fmt: skip
    return x


def history_of(observations: Any, actions: Any) -> Array:
    w = np.zeros(HISTORY)
    for period, (o, (a, delta)) in enumerate(zip(observations, actions, strict=True)):
        if period > 0:
            end_period(w)
        update_history(w, np.asarray(o, dtype=np.float32), float(a), float(delta), PERIOD)
    return w


number = st.floats(width=32) | st.floats(-1.0, 1.0, width=32)
rows = st.lists(number, min_size=14, max_size=14)


@settings(max_examples=80, deadline=None)
@given(
    st.lists(rows, min_size=1, max_size=5),
    st.lists(st.tuples(number, number), min_size=5, max_size=5),
    st.lists(st.floats(LOWEST, HIGHEST), min_size=12, max_size=12), st.integers(-1, 3),
)  # fmt: skip
def test_whatever_is_observed_gives_finite_features(
    observations: list[list[float]],
    actions: list[tuple[float, float]],
    used: list[float],
    band: int,
) -> None:
    """NaN and infinities, or three entries of preview only, too; actions are finite, as ever."""
    finite = [tuple(np.nan_to_num(pair, posinf=1e3, neginf=-1e3)) for pair in actions]
    w = history_of(observations, finite[: len(observations)])
    x = filled(observations[-1], w, np.array(used), band)
    assert np.isfinite(x).all()
    assert (np.abs(x) <= LIMIT).all()
    assert x[-4:].tolist() == [float(k == band) for k in range(4)]


def test_an_observation_that_is_not_finite_is_passed_over() -> None:
    """It is forgotten, not taken for a jump there and back; others are compared beyond it."""
    rng = np.random.default_rng(0)
    observations, actions = rng.normal(size=(6, 20)), rng.normal(size=(6, 2))
    broken = observations.copy()
    broken[3, 5] = np.nan
    seen = history_of(broken[:4], actions[:4])
    assert (seen[SEEN], seen[AGE]) == (3, 1)
    np.testing.assert_array_equal(seen[QUICK:], history_of(observations[:3], actions[:3])[QUICK:])
    ramp = np.zeros((9, 20))
    ramp[:, 3] = np.arange(9) * 0.2
    broken = ramp.copy()
    broken[[2, 5, 6], 0] = np.inf
    jerk = QUICK + STATISTICS.index("jerk")
    for drive in (ramp, broken):
        assert history_of(drive, ramp[:, 3:5])[jerk] == pytest.approx((0.2 / PERIOD) ** 2, rel=1e-5)


def test_means_follow_at_their_time_constants() -> None:
    """A constant error is its own mean square at once; when it ends it is forgotten as exp(-t)."""
    o = np.zeros((200, 20))
    o[:100, 5] = 0.3
    still = np.zeros((200, 2))
    w = history_of(o[:100], still[:100])
    assert (w[QUICK], w[SLOW]) == pytest.approx((0.09, 0.09), rel=1e-6)
    w = history_of(o[:140], still[:140])
    assert w[QUICK] == pytest.approx(0.09 * np.exp(-2.0 / 0.4), rel=1e-6)
    assert w[SLOW] == pytest.approx(0.09 * np.exp(-2.0 / 4.0), rel=1e-2)
    assert w[LAST] == 0.0


# Mirror symmetry -----------------------------------------------------------------------------


def test_mirrored_observations_have_the_same_features() -> None:
    """Bit for bit."""
    hand = ByHand(CHOICE, **CALM)
    hand.reset(seed=4)
    for action in random_actions(CHOICE, 6):
        hand.step(action)
    observations, actions = np.array(hand.observations[1:]), np.array(hand.actions)
    k = hand.env.layout.preview_steps
    sign = np.concatenate([[1, -1, -1, 1, -1, -1, -1, 1], -np.ones(k), np.ones(k)])
    ones, others = (
        history_of(observations, actions),
        history_of(observations * sign, actions * [1, -1]),
    )
    np.testing.assert_array_equal(
        filled(observations[-1], ones), filled(observations[-1] * sign, others)
    )


def test_a_mirrored_path_gives_the_same_features_and_weights() -> None:
    path = trajectories.load("random-3")
    left, right = (WeightTuningEnv(one, conditions="simulation") for one in (path, path.mirrored()))
    options = {"arc_length": 20.0, "lateral_error": 0.4, "heading_error": -0.1}
    observation, _ = left.reset(seed=0, options=options)
    mirrored, _ = right.reset(
        seed=0, options={**options, "lateral_error": -0.4, "heading_error": 0.1}
    )
    np.testing.assert_array_equal(mirrored, observation)
    bands = set()
    for action in random_actions(left.choice, 60):
        observation, reward, *_, info = left.step(action)
        mirrored, other, *_, mirrored_info = right.step(action)
        np.testing.assert_array_equal(mirrored_info["weights"], info["weights"])
        assert mirrored_info["band"] == info["band"]
        assert mirrored_info["steps"] == info["steps"]
        np.testing.assert_allclose(mirrored, observation, rtol=0.0, atol=1e-5)
        assert other == pytest.approx(reward, rel=1e-6)
        bands.add(info["band"])
    assert len(bands) > 1
