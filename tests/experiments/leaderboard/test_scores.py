"""Interquartile means of losses of which some are infinite, and their two intervals."""

import numpy as np
import pytest
from scipy.stats import trim_mean

from experiments.leaderboard.scores import score
from experiments.run.resampling import Plan, plan_of


def seeds_of(*paths: str) -> Plan:
    """Plan of one drive after another, the seeds of a path counted from 0."""
    return plan_of([("s", path, paths[:k].count(path)) for k, path in enumerate(paths)])


def test_the_mean_is_that_of_the_middle_half() -> None:
    losses = np.array([[8.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]])
    assert score(losses, seeds_of(*["T1"] * 8)).value == np.mean([3.0, 4.0, 5.0, 6.0])


def test_a_quarter_of_failed_drives_is_left_out_and_more_is_infinite() -> None:
    values = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, np.inf, np.inf]
    plan = seeds_of(*["T1"] * 8)
    assert score(np.array([values]), plan).value == np.mean([3.0, 4.0, 5.0, 6.0])
    found = score(np.array([[*values[1:], np.inf]]), plan)
    assert found.value == np.inf
    assert found.drives is not None
    assert found.drives[0] < found.drives[1] == np.inf


def test_drives_are_drawn_within_their_path() -> None:
    """Between paths of equal values nothing varies, whatever lies between them."""
    losses = np.array([[1.0, 1.0, 9.0, 9.0]])
    assert score(losses, seeds_of("T1", "T1", "T2", "T2")).drives == (5.0, 5.0)
    assert score(losses, seeds_of("T1", "T1", "T1", "T1")).drives == (1.0, 9.0)


def test_one_drive_and_one_training_have_no_interval() -> None:
    assert score(np.array([[1.0]]), seeds_of("T1")) == (1.0, None, None)


def test_the_spread_over_trainings_is_apart_from_that_over_drives() -> None:
    losses = np.array([[1.0, 1.0], [3.0, 3.0]])
    found = score(losses, seeds_of("T1", "T1"))
    assert found.value == 2.0
    assert found.drives == (2.0, 2.0)
    assert found.trainings == (1.0, 3.0)


def test_the_interval_is_that_of_an_independent_bootstrap() -> None:
    random = np.random.default_rng(3)
    paths = [f"T{k % 3}" for k in range(60)]
    losses = random.lognormal(size=(1, 60))
    found = score(losses, seeds_of(*paths))
    draws = []
    for _ in range(4000):
        # A seed is drawn for all three paths.
        seeds = random.integers(20, size=20)
        draws.append(trim_mean(losses.reshape(20, 3)[seeds].ravel(), 0.25))
    width = np.std(draws)  # of which an end of either bootstrap varies by some 0.04
    assert found.drives is not None
    assert found.drives == pytest.approx(np.quantile(draws, [0.025, 0.975]), abs=0.15 * width)
