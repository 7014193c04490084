"""Weights in use, compiled, against plain code; and the limit of their change."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.nmpc.schedule import NO_BAND, Switching
from agents.weights import HIGHEST, LOWEST, WEIGHTS, TrackingWeights, WeightSchedule
from lpv_track_env.observation import PREVIEW_START
from trajectories import CurvatureBands

STEPS = 5
weight = st.floats(LOWEST, HIGHEST)
sets = st.lists(weight, min_size=WEIGHTS, max_size=WEIGHTS).map(TrackingWeights.from_array)
previews = st.lists(st.floats(-0.08, 0.08), min_size=STEPS, max_size=STEPS)


def rows_of(*curvatures: list[float]) -> np.ndarray:
    rows = np.zeros((len(curvatures), PREVIEW_START + 2 * STEPS))
    rows[:, PREVIEW_START : PREVIEW_START + STEPS] = curvatures
    return rows


class Follower:
    """Follows a schedule for n vehicles."""

    def __init__(self, schedule: WeightSchedule | TrackingWeights, n: int = 1) -> None:
        self.switching = Switching(schedule, 0.05)
        self.bands, self.weights = np.full(n, NO_BAND), np.zeros((n, WEIGHTS))

    def see(self, *curvatures: list[float], steps: int = STEPS) -> np.ndarray:
        self.switching.choose(rows_of(*curvatures), steps, self.bands, self.weights)
        return self.weights.copy()


def plain_select(
    schedule: WeightSchedule, curvature: list[float], band: int | None
) -> tuple[np.ndarray, int]:
    """Weights (12,) and band for a preview of curvature, written once more without compilation."""
    chosen = schedule.bands.select(curvature, band)
    rows = [weights.clipped().as_array() for weights in schedule.weights]
    if schedule.blend == 0.0:
        return rows[chosen], chosen
    sharpest = max(abs(value) for value in curvature)
    for k, edge in enumerate(schedule.bands.thresholds):
        low, high = edge * (1.0 - schedule.blend), edge * (1.0 + schedule.blend)
        if low < sharpest < high:
            share = (sharpest - low) / (high - low)
            return rows[k] ** (1.0 - share) * rows[k + 1] ** share, chosen
    return rows[int(schedule.bands.classify(sharpest))], chosen


@settings(max_examples=60, deadline=None)
@given(
    st.lists(sets, min_size=4, max_size=4), st.lists(previews, min_size=1, max_size=6),
    st.sampled_from([0.0, 0.2, 0.5]), st.sampled_from([0.0, 0.3]),
)  # fmt: skip
def test_follows_a_schedule_as_plain_code_does(
    chosen: list[TrackingWeights], seen: list[list[float]], hysteresis: float, blend: float
) -> None:
    schedule = WeightSchedule(CurvatureBands(hysteresis=hysteresis), tuple(chosen), blend)
    follower, band = Follower(schedule), None
    for curvature in seen:
        wanted, band = plain_select(schedule, curvature, band)
        found = follower.see(curvature)[0]
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
        assert follower.bands[0] == band


@settings(max_examples=60, deadline=None)
@given(st.lists(sets, min_size=4, max_size=4), st.lists(previews, min_size=2, max_size=6))
def test_slew_limits_every_weight(chosen: list[TrackingWeights], seen: list[list[float]]) -> None:
    follower = Follower(WeightSchedule(CurvatureBands(), tuple(chosen), slew=4.0))
    used = follower.see(seen[0])[0]
    # The first set is taken at once: there is nothing to come from.
    assert any(np.allclose(used, one.as_array()) for one in chosen)
    for curvature in seen[1:]:
        after = follower.see(curvature)[0]
        target = chosen[follower.bands[0]].as_array()
        change = np.abs(np.log(after / used))
        assert change.max() <= 4.0 * 0.05 * (1 + 1e-9)
        # Towards the target, and no further.
        before_gap, gap = np.abs(np.log(target / used)), np.abs(np.log(target / after))
        np.testing.assert_allclose(gap, np.maximum(before_gap - 0.2, 0.0), atol=1e-9)
        used = after


def test_rows_do_not_touch_one_another() -> None:
    schedule = WeightSchedule(
        CurvatureBands((0.01,), ("low", "high")),
        (TrackingWeights(), TrackingWeights(R=(1.0, 5.0))),
        slew=3.0,
    )
    both, alone = Follower(schedule, 2), Follower(schedule)
    for low, high in (([0.0] * 5, [0.02] * 5), ([0.02] * 5, [0.0] * 5)):
        np.testing.assert_array_equal(both.see(low, high)[1], alone.see(high)[0])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_preview_that_is_not_finite_changes_nothing(bad: float) -> None:
    schedule = WeightSchedule(
        CurvatureBands((0.01,), ("low", "high")), (TrackingWeights(), TrackingWeights(R=(1.0, 5.0)))
    )
    follower = Follower(schedule)
    # At the start the straightest band's set is as good as any: the solve fails anyway.
    np.testing.assert_array_equal(follower.see([bad] * 5)[0], TrackingWeights().as_array())
    assert follower.bands[0] == NO_BAND
    sharp = follower.see([0.02] * 5)
    np.testing.assert_array_equal(follower.see([0.0, bad, 0.0, 0.0, 0.0]), sharp)
    assert follower.bands[0] == 1
    # What lies beyond the horizon does not matter.
    np.testing.assert_array_equal(
        follower.see([0.0, 0.0, bad, 0.0, 0.0], steps=2)[0], TrackingWeights().as_array()
    )


def test_weights_of_a_table_come_within_their_bounds() -> None:
    wild = TrackingWeights(Q=(0, 1e12, 1, 1e-9), R=(1e7, 0))
    np.testing.assert_array_equal(Follower(wild).see([0.0] * 5)[0], wild.clipped().as_array())
