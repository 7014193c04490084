"""Interquartile means of losses of which some are infinite, and their two intervals."""

import numpy as np
import pytest
from scipy.stats import trim_mean

from experiments.leaderboard.scores import score


def test_the_mean_is_that_of_the_middle_half() -> None:
    losses = np.array([[8.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]])
    assert score(losses, ["T1"] * 8).value == np.mean([3.0, 4.0, 5.0, 6.0])


def test_a_quarter_of_failed_drives_is_left_out_and_more_is_infinite() -> None:
    values = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, np.inf, np.inf]
    assert score(np.array([values]), ["T1"] * 8).value == np.mean([3.0, 4.0, 5.0, 6.0])
    found = score(np.array([[*values[1:], np.inf]]), ["T1"] * 8)
    assert found.value == np.inf
    assert found.drives is not None
    assert found.drives[0] < found.drives[1] == np.inf


def test_drives_are_drawn_within_their_stratum() -> None:
    """Between strata of equal values nothing varies, whatever lies between them."""
    losses = np.array([[1.0, 1.0, 9.0, 9.0]])
    assert score(losses, ["T1", "T1", "T2", "T2"]).drives == (5.0, 5.0)
    together = score(losses, ["T1"] * 4).drives
    assert together == (1.0, 9.0)


def test_one_drive_a_stratum_and_one_training_have_no_interval() -> None:
    found = score(np.array([[1.0, 2.0, 3.0, 4.0]]), ["T1", "T2", "T3", "T4"])
    assert found == (2.5, None, None)


def test_the_spread_over_trainings_is_apart_from_that_over_drives() -> None:
    losses = np.array([[1.0, 1.0], [3.0, 3.0]])
    found = score(losses, ["T1", "T1"])
    assert found.value == 2.0
    assert found.drives == (2.0, 2.0)
    assert found.trainings == (1.0, 3.0)


def test_the_interval_is_that_of_an_independent_bootstrap() -> None:
    random = np.random.default_rng(3)
    losses = random.lognormal(size=(1, 60))
    strata = [f"T{k % 3}" for k in range(60)]
    found = score(losses, strata)
    draws = []
    for _ in range(4000):
        chosen = [random.choice([k for k in range(60) if k % 3 == path], 20) for path in range(3)]
        draws.append(trim_mean(losses[0, np.concatenate(chosen)], 0.25))
    width = np.std(draws)  # of which an end of either bootstrap varies by some 0.04
    assert found.drives is not None
    assert found.drives == pytest.approx(np.quantile(draws, [0.025, 0.975]), abs=0.15 * width)


def test_many_drives_stay_within_memory_and_time() -> None:
    random = np.random.default_rng(0)
    found = score(random.normal(size=(1, 100_000)), ["T1"] * 100_000)
    assert found.drives is not None
    assert -0.02 < found.drives[0] < found.value < found.drives[1] < 0.02
