"""Errors by curvature band, against an episode computed by hand, and what holds for every one."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.run import metrics
from experiments.run.metrics import BANDS, by_band, trapezoidal_weights
from experiments.run.rollout import Trace
from lpv_track_env import vehicle
from trajectories import ReferencePath

CAR = vehicle.load("m2-minibus")


def spiral(length=100.0):
    """A clothoid to the left of curvature s / 1000: the bands change at 5, 20 and 50 m."""
    s = np.linspace(0.0, length, 4001)
    heading = s**2 / 2000.0
    x, y = (
        np.concatenate([[0.0], np.cumsum(0.5 * (f[1:] + f[:-1]) * np.diff(s))])
        for f in (np.cos(heading), np.sin(heading))
    )
    return ReferencePath(s, x, y, heading, s / 1000.0, np.full(len(s), 5.0), name="spiral")


SPIRAL = spiral()


def episode(time, arc_length, lateral, heading=0.0):
    """A trace on a path of which only time, arc length and errors matter."""
    n = len(time)
    heading = np.broadcast_to(np.asarray(heading, dtype=float), (n,)).copy()
    zero = np.zeros(n)
    rest = dict.fromkeys(
        ("reference_speed", "acceleration", "steering_angle", "solve_time", "reward", "clipped",
         "stopping", "deadline_misses", "friction"), zero,
    )  # fmt: skip
    return Trace(
        time=np.asarray(time, dtype=float),
        state=np.zeros((n, 6)),
        estimate=np.zeros((n, 6)),
        arc_length=np.asarray(arc_length, dtype=float),
        lateral_error=np.asarray(lateral, dtype=float),
        heading_error=heading,
        **rest,
    )


def test_an_episode_by_hand():
    # Weights 0.5, 1, 1.5, 1.5, 1, 1.5, 1 s of 8; the bands hold two, two, one and two samples.
    time = [0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 8.0]
    arc_length = [0.0, 4.0, 10.0, 15.0, 30.0, 60.0, 70.0]
    lateral = [0.0, -2.0, 1.0, 3.0, -4.0, 2.0, 0.0]
    heading = [0.1, 0.1, -0.2, 0.2, 0.3, 0.0, -0.5]
    found = by_band(episode(time, arc_length, lateral, heading), SPIRAL, CAR)
    assert found == pytest.approx(
        {
            "share_straight": 1.5 / 8, "share_gentle": 3.0 / 8,
            "share_moderate": 1.0 / 8, "share_sharp": 2.5 / 8,
            "ale_straight": math.sqrt(4.0 / 1.5), "ale_gentle": math.sqrt((1.5 + 13.5) / 3.0),
            "ale_moderate": 4.0, "ale_sharp": math.sqrt(6.0 / 2.5),
            "mle_straight": 2.0, "mle_gentle": 3.0, "mle_moderate": 4.0, "mle_sharp": 2.0,
            "aoe_straight": 0.1, "aoe_gentle": 0.2, "aoe_moderate": 0.3,
            "aoe_sharp": math.sqrt(0.25 / 2.5),
        }
    )  # fmt: skip


def test_a_right_bend_counts_like_a_left_one():
    drive = episode([0.0, 1.0, 2.0], [1.0, 30.0, 80.0], [0.1, 0.2, 0.3])
    assert by_band(drive, SPIRAL.mirrored(), CAR) == by_band(drive, SPIRAL, CAR)


def test_a_threshold_belongs_to_the_sharper_band():
    for threshold, name in zip(BANDS.thresholds, BANDS.names[1:], strict=True):
        at = 1000.0 * threshold
        found = by_band(episode([0.0, 1.0], [at - 0.1, at + 0.001], 2 * [0.1]), SPIRAL, CAR)
        assert found[f"share_{name}"] == 0.5


def test_a_band_never_visited_has_no_entries():
    found = by_band(episode([0.0, 0.1, 0.2], [1.0, 2.0, 3.0], 3 * [-0.4]), SPIRAL, CAR)
    assert found == pytest.approx(
        {"ale_straight": 0.4, "mle_straight": 0.4, "aoe_straight": 0.0, "share_straight": 1.0}
    )


def test_an_episode_without_a_step_is_all_in_one_band():
    drive = episode([0.0], [30.0], [0.7], 0.2)
    found = metrics.evaluate(drive, SPIRAL, CAR)
    assert (found["ale"], found["mle"]) == (found["ale_moderate"], found["mle_moderate"])
    assert found["share_moderate"] == 1.0
    assert not [name for name in found if name.startswith("share_") and name[6:] != "moderate"]


seconds = st.floats(0.01, 2.0)
metres = st.floats(0.0, 100.0)
# In whole nanometres or nanoradians: what is smaller by a hundred decades has no square in float64.
errors = st.integers(-(5 * 10**9), 5 * 10**9).map(lambda count: 1e-9 * count)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(seconds, metres, errors, errors), min_size=2, max_size=40))
def test_bands_divide_the_episode(samples):
    steps, arc_length, lateral, heading = map(np.array, zip(*samples, strict=True))
    drive = episode(np.cumsum(steps), arc_length, lateral, heading)
    found = by_band(drive, SPIRAL, CAR)
    visited = [name for name in BANDS.names if f"share_{name}" in found]
    assert len(found) == 4 * len(visited)

    def mean_square(key):
        return sum(found[f"share_{name}"] * found[f"{key}_{name}"] ** 2 for name in visited)

    whole = {"ale": metrics.rms(drive.time, lateral), "aoe": metrics.rms(drive.time, heading)}
    assert sum(found[f"share_{name}"] for name in visited) == pytest.approx(1.0, rel=1e-12)
    assert max(found[f"mle_{name}"] for name in visited) == np.abs(lateral).max()
    for key, value in whole.items():
        assert mean_square(key) == pytest.approx(value**2, rel=1e-9, abs=1e-15)
    for name in visited:
        assert found[f"ale_{name}"] <= found[f"mle_{name}"] * (1.0 + 1e-12)
    # A vehicle that drives the other way round sees the same.
    assert by_band(episode(*reversed_in_time(drive)), SPIRAL, CAR) == pytest.approx(found)


def reversed_in_time(drive):
    time = drive.time[-1] - drive.time[::-1]
    return time, drive.arc_length[::-1], drive.lateral_error[::-1], drive.heading_error[::-1]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(seconds, errors), min_size=1, max_size=20))
def test_weights_are_those_of_the_trapezoidal_rule(samples):
    steps, values = map(np.array, zip(*samples, strict=True))
    time = np.cumsum(steps)
    weights = trapezoidal_weights(time)
    assert weights @ values == pytest.approx(np.trapezoid(values, time), rel=1e-9, abs=1e-9)
