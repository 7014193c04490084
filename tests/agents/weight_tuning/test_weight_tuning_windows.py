"""Windows of `WeightTuning-v0` against `predict` and `step` in turns, weights set by hand."""

from typing import Any

import numpy as np
import pytest

from agents.weight_tuning.env import WeightTuningEnv
from lpv_track_env.conditions import REALTIME, Conditions
from tests.helpers.tuned_drives import CALM, CHOICES, LIVELY, ByHand, random_actions


def assert_same_drive(env: WeightTuningEnv, hand: ByHand) -> None:
    """True state, observation, weights and band after a window, bit for bit."""
    drives = env.drives.drives
    np.testing.assert_array_equal(drives.state[0], hand.env.state)
    np.testing.assert_array_equal(drives.arrays.observations[0], hand.observations[-1])
    np.testing.assert_array_equal(env.drives.loop.memory.nmpc.weights[0], hand.used)
    assert env.drives.loop.memory.nmpc.bands[0] == hand.band


SLOW_COMPUTER = REALTIME.replace(name="slow", computing_delay=(0.06, 0.09))
CONDITIONS = ("simulation", "realtime", "slow-computer")


@pytest.mark.parametrize("conditions", ["simulation", "realtime", SLOW_COMPUTER], ids=CONDITIONS)
@pytest.mark.parametrize("name", CHOICES)
def test_windows_are_those_driven_by_hand(name: str, conditions: str | Conditions) -> None:
    """Weights, true states, lengths, parts, rewards; bands that end a window before its time."""
    choice = CHOICES[name]
    settings = {**CALM, "conditions": conditions, "time_limit": 6.0}
    env, hand = WeightTuningEnv(choice=choice, **settings), ByHand(choice, **settings)
    # From there the preview, two seconds long, enters another band under each choice of bands.
    env.reset(seed=5)
    hand.reset(seed=5)
    lengths, driven = [], 0
    for action in random_actions(choice, 60):
        _, reward, terminated, truncated, info = env.step(action)
        solved = len(hand.iterations)
        steps = hand.step(action)
        assert_same_drive(env, hand)
        solves = len(hand.iterations) - solved
        assert (info["steps"], info["solves"], info["failures"]) == (steps, solves, 0)
        assert solves == steps or conditions is SLOW_COMPUTER
        np.testing.assert_array_equal(info["weights"], hand.used)
        assert info["band"] == hand.band
        parts = hand.parts(driven, driven + steps)
        np.testing.assert_allclose(info["parts"], parts, rtol=1e-9, atol=1e-12)
        share = steps / round(choice.window / 0.05)
        added = hand.marginal(driven, driven + steps, round(choice.window / 0.05)).sum()
        assert reward == pytest.approx(-share * added, rel=1e-9)
        driven += steps
        lengths.append(steps)
        assert (terminated or truncated) == hand.done
        if hand.done:
            break
    assert truncated
    assert not terminated
    assert info["end"] == hand.truths[-1]["end"] == "time_limit"
    assert info["score"] == pytest.approx(hand.parts(0, driven).sum(), rel=1e-9)
    assert len(set(lengths[:-1])) > 1 or conditions is SLOW_COMPUTER
    assert (len(hand.iterations) < driven) == (conditions is SLOW_COMPUTER)


@pytest.mark.parametrize("seed", range(3))
def test_a_failed_drive_costs_ten_windows_of_the_worst(seed: int) -> None:
    settings = {**LIVELY, "conditions": "realtime", "max_lateral_error": 0.3, "time_limit": 30.0}
    env, hand = WeightTuningEnv(**settings), ByHand(CHOICES["joint"], **settings)
    env.reset(seed=seed, options={"lateral_error": 0.25, "heading_error": 0.2})
    hand.reset(seed=seed, options={"lateral_error": 0.25, "heading_error": 0.2})
    driven = 0
    for action in random_actions(CHOICES["joint"], 20, seed=seed):
        _, reward, terminated, truncated, info = env.step(action)
        steps = hand.step(action)
        if terminated:
            break
        driven += steps
    added = hand.marginal(driven, driven + steps).sum()
    assert reward == pytest.approx(-steps / 8 * added - 250.0, rel=1e-9)
    assert not truncated
    assert info["end"] == hand.truths[-1]["end"] == "left_corridor"
    assert info["score"] == 25.0


def test_delay_compensation_can_be_left_out() -> None:
    for delayed in (True, False):
        env = WeightTuningEnv(delay_compensation=delayed, **CALM)
        hand = ByHand(CHOICES["joint"], delayed=delayed, **CALM)
        env.reset(seed=1)
        hand.reset(seed=1)
        for action in random_actions(CHOICES["joint"], 10):
            env.step(action)
            hand.step(action)
            assert_same_drive(env, hand)
        ends: Any = env.drives.drives.state
        if delayed:
            first = ends.copy()
    assert not np.array_equal(ends, first)
