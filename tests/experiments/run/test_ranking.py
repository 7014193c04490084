"""Ranking of agents over regimes: ranks by hand, failures, intervals, drives in common."""

import numpy as np
import pytest

from experiments.run.ranking import ranking
from experiments.run.statistics import rate_interval
from tests.helpers.made_results import case

AGENTS = ("lpv-nmpc", "stanley", "pid")


def drives(regime: str, errors: dict[str, list[float | None]], first: int = 0) -> list[dict]:
    """Return cases of a regime: an agent's largest errors, None for a drive that failed."""
    return [
        case(
            first + 100 * k + seed, agent=agent, regime=regime, seed=seed,
            metrics={} if error is None else {"mle": error},
            end="left_corridor" if error is None else "finished",
        )
        for k, (agent, found) in enumerate(errors.items())
        for seed, error in enumerate(found)
    ]  # fmt: skip


def test_ranks_are_counted_drive_by_drive_and_every_regime_counts_alike() -> None:
    a = drives("a", dict(zip(AGENTS, ([0.1, 0.1], [0.2, 0.2], [0.3, None]), strict=True)))
    b = drives("b", dict(zip(AGENTS, ([0.3], [0.1], [0.2]), strict=True)), first=1000)
    places = {place.label: place for place in ranking([*a, *b])}
    assert {name: place.rank for name, place in places.items()} == {
        "lpv-nmpc": (1.0 + 3.0) / 2, "stanley": (2.0 + 1.0) / 2, "pid": (3.0 + 2.0) / 2,
    }  # fmt: skip
    assert [place.label for place in ranking([*a, *b])] == ["stanley", "lpv-nmpc", "pid"]
    assert [places[name].failed for name in AGENTS] == [0, 0, 1]
    assert {place.drives for place in places.values()} == {3}
    assert [places[name].among_best for name in AGENTS] == [1, 1, 0]
    low, high = (100.0 * end for end in rate_interval(1, 3))
    assert places["pid"].cells[-2:] == ["1", f"{low:.1f} to {high:.1f} %"]


def test_agents_that_fail_share_the_last_ranks_and_close_ones_are_both_among_the_best() -> None:
    found = drives("a", dict(zip(AGENTS, ([0.100], [None], [None]), strict=True)))
    assert [place.rank for place in ranking(found)] == [1.0, 2.5, 2.5]
    close = drives("a", dict(zip(AGENTS, ([0.100], [0.104], [0.106]), strict=True)))
    assert {place.label: place.among_best for place in ranking(close)} == {
        "lpv-nmpc": 1, "stanley": 1, "pid": 0,
    }  # fmt: skip
    none = drives("a", dict(zip(AGENTS, ([None], [None], [None]), strict=True)))
    assert [place.among_best for place in ranking(none)] == [0, 0, 0]


def test_higher_entry_speeds_are_better() -> None:
    found = drives("a", dict(zip(AGENTS, ([0.1], [0.1], [0.1]), strict=True)))
    for one, speed in zip(found, (15.0, 18.0, 16.0), strict=True):
        one["search"] = {"setting": "fixed_speed"}
        one["metrics"]["highest_fixed_speed"] = speed
    assert [place.label for place in ranking(found)] == ["stanley", "pid", "lpv-nmpc"]


def test_only_drives_that_all_agents_have_count() -> None:
    found = drives("a", dict(zip(AGENTS, ([0.1, 0.2], [0.2], [0.3]), strict=True)))
    assert {place.drives for place in ranking(found)} == {1}
    assert ranking([case(1)]) == []


def test_the_interval_covers_the_true_mean_rank_as_often_as_it_says() -> None:
    """Of agents whose errors are drawn alike the mean rank is 2: 95 % of intervals hold it."""
    random, held = np.random.default_rng(0), 0
    trials = 100
    for trial in range(trials):
        errors = {name: list(random.uniform(0.1, 1.0, 40)) for name in AGENTS}
        place = next(one for one in ranking(drives("a", errors), seed=trial) if one.label == "pid")
        held += place.low <= 2.0 <= place.high
    # 95 % of 100, less than four standard deviations away
    assert held == pytest.approx(95, abs=4 * (0.05 * 0.95 * trials) ** 0.5)
