"""Pairs of competitors, their drives and the results of a comparison, against values by hand."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.comparison.competitors import (
    Folder,
    pairs_between,
    pairs_within,
    read_folder,
)
from experiments.comparison.measures import DEFAULTS, FOUND, measure_of
from experiments.comparison.outcomes import Outcome, compare
from tests.helpers.compared_folders import folder, results
from tests.helpers.made_results import case, folder_of

ALE = [measure_of("ale")]


def read(path: Path, names: Any = ("ale",)) -> Folder:
    return read_folder(path, [measure_of(name) for name in names], [])


def within(path: Path, names: Any = ("ale",), **targets: float) -> Outcome:
    found = read(path, names)
    (pair,) = pairs_within(found, [], None)
    return compare(*pair, found.drives, [measure_of(name) for name in names], targets)


def test_a_comparison_by_hand(tmp_path: Path) -> None:
    """Two paths, two seeds; B fails one drive that A passes, both fail another."""
    a = "lpv-nmpc", {"T2": [0.1, 0.2], "T4": [0.4, None]}
    b = "stanley", {"T2": [0.2, 0.2], "T4": [None, None]}
    outcome = within(folder(tmp_path, a, b), ale=0.1)
    assert (outcome.a.label, outcome.b.label) == ("lpv-nmpc", "stanley")
    (metric,) = outcome.metrics
    # Means over the two drives that both passed.
    assert metric.pairs == 2
    assert metric.mean_a == pytest.approx(0.15)
    assert metric.mean_b == pytest.approx(0.2)
    assert metric.difference.value == pytest.approx(0.05)
    assert metric.relative.value == pytest.approx(1 / 3)
    # Middle half of 0.1, 0.2, 0.4, inf and of 0.2, 0.2, inf, inf.
    assert metric.iqm_a.value == pytest.approx(0.3)
    assert metric.iqm_b.value == math.inf
    # T2: 0.2 < 0.1 no, 0.2 = 0.2 half, twice: 1 of 4. T4: inf against inf half, twice: 1 of 4.
    assert metric.improvement.value == pytest.approx(0.25)
    assert (metric.wins, metric.ties, metric.losses) == (0, 2, 2)
    # 1 - (1 + 1/2 + 1/4 + 0) / 4 and 1 - (1/2 + 1/2) / 4.
    assert metric.gap_a is not None
    assert metric.gap_b is not None
    assert metric.gap_a.value == pytest.approx(2.25 / 4)
    assert metric.gap_b.value == pytest.approx(3 / 4)
    assert (outcome.failed_a, outcome.failed_b, outcome.a_alone, outcome.b_alone) == (1, 2, 0, 1)
    assert outcome.failures_p == 1.0
    profile = metric.profile
    np.testing.assert_allclose(profile.levels[[0, -1]], [0.1, 0.4])
    assert [profile.a[0].value, profile.a[-1].value] == [0.25, 0.75]
    assert [profile.b[0].value, profile.b[-1].value] == [0.0, 0.5]
    assert outcome.seconds_a == 0.002


def test_more_is_better_of_rewards(tmp_path: Path) -> None:
    more = [
        case(k, agent, metrics={"reward": value}, seed=k % 2)
        for k, (agent, value) in enumerate(
            [("lpv-nmpc", 10.0), ("lpv-nmpc", 20.0), ("stanley", 30.0), ("stanley", 10.0)]
        )
    ]
    folder_of(tmp_path, more, traces=False)
    (metric,) = within(tmp_path, ["reward"]).metrics
    assert metric.difference.value == 5.0
    assert metric.difference.low <= 5.0 <= metric.difference.high
    assert metric.iqm_b.value == 20.0
    assert (metric.wins, metric.losses) == (1, 1)
    # 30 > 10, 30 > 20, 10 = 10, 10 < 20.
    assert metric.improvement.value == 2.5 / 4
    with pytest.raises(ValueError, match="needs a metric of which less is better"):
        within(tmp_path, ["reward"], reward=5.0)


def test_figures_of_a_search_are_those_of_the_drives_that_search(tmp_path: Path) -> None:
    search = {"setting": "fixed_speed", "low": 1.0, "high": 9.0, "resolution": 1.0}
    made = []
    for place, agent in enumerate(("lpv-nmpc", "stanley")):
        speed = {"highest_fixed_speed": 12.0 + place}
        made += [
            case(10 * place, agent, metrics=speed, search=search, regime="lane change"),
            case(10 * place + 1, agent, end="left_corridor", regime="lane change", seed=1,
                 search=search),
            case(10 * place + 2, agent, end="left_corridor", regime="rain"),
        ]  # fmt: skip
    folder_of(tmp_path, made, traces=False)
    (speed,) = within(tmp_path, [*FOUND]).metrics
    assert speed.measure.key == "highest_fixed_speed"
    # The failed drive that does not search has no such figure, the failed one that does is a tie.
    assert (speed.drives, speed.pairs, speed.wins, speed.ties) == (2, 1, 1, 1)
    assert speed.difference.value == 1.0


def test_drives_of_one_side_alone_are_named(tmp_path: Path) -> None:
    a, b = results("stanley", {"T2": [0.1, 0.2]}), results("stanley", {"T2": [0.1], "T4": [0.3]})
    folder_of(tmp_path / "a", a, traces=False)
    folder_of(tmp_path / "b", b, traces=False)
    folders = [read(tmp_path / "a"), read(tmp_path / "b")]
    (pair,) = pairs_between(folders, [], None)
    outcome = compare(*pair, {**folders[0].drives, **folders[1].drives}, ALE, {})
    assert [(one.path, one.seed) for one in outcome.drives] == [("T2", 0)]
    assert [(one.path, one.seed) for one in outcome.only_a] == [("T2", 1)]
    assert [(one.path, one.seed) for one in outcome.only_b] == [("T4", 0)]
    assert math.isnan(outcome.metrics[0].difference.low)
    folder_of(tmp_path / "c", results("stanley", {"T5": [0.1]}), traces=False)
    folders[1] = read(tmp_path / "c")
    (pair,) = pairs_between(folders, [], None)
    with pytest.raises(ValueError, match="no drive in common"):
        compare(*pair, {**folders[0].drives, **folders[1].drives}, ALE, {})


def test_drives_pair_whatever_agent_settings_and_ids(tmp_path: Path) -> None:
    """A repeated drive counts once, its last result; other vehicles are other drives."""
    plain = results("stanley", {"T2": [0.1, 0.2]})
    changed = results("stanley", {"T2": [9.0, 0.5]}, 50, agent_settings={"gain": 2.0})
    again = {**changed[0], "id": "7" * 16, "metrics": {**changed[0]["metrics"], "ale": 0.4}}
    other = results("stanley", {"T2": [0.1]}, 90, vehicle="f1tenth")
    folder_of(tmp_path, [*plain, *changed, *other, again], traces=False)
    (metric,) = (outcome := within(tmp_path)).metrics
    assert metric.difference.value == pytest.approx(0.3)
    assert len(outcome.only_a) == 1
    assert outcome.b.label == "stanley (gain=2.0)"


def test_trainings_are_drawn_apart_from_drives(tmp_path: Path) -> None:
    """Three trainings that differ by as much on every drive: no spread over drives."""
    made = results("lpv-nmpc", {"T2": [0.1] * 4})
    for seed, extra in enumerate((0.1, 0.2, 0.3)):
        agent = f"policies/mine/seed-{seed}/policy.json"
        made += results(agent, {"T2": [0.1 + extra] * 4}, 100 * (seed + 1))
    folder_of(tmp_path, made, traces=False)
    outcome = within(tmp_path)
    assert outcome.trainings == (1, 3)
    assert outcome.b.label == "policies/mine"
    assert outcome.resampled.startswith("3 trainings of B; 4 seeds")
    (metric,) = outcome.metrics
    assert (metric.pairs, outcome.runs_a, outcome.runs_b) == (12, 4, 12)
    assert metric.difference.value == pytest.approx(0.2)
    ends = metric.over_drives.low, metric.over_drives.high
    np.testing.assert_allclose(ends, 0.2)
    ends = metric.over_trainings.low, metric.over_trainings.high
    np.testing.assert_allclose(ends, [0.1, 0.3])
    assert outcome.failures_p is None
    # A drive that one training lacks is left out and named.
    folder_of(tmp_path / "less", made[:-1], traces=False)
    outcome = within(tmp_path / "less")
    assert (len(outcome.drives), [one.seed for one in outcome.only_a]) == (3, [3])


def test_pairs_are_of_all_trainings_that_passed(tmp_path: Path) -> None:
    made = results("lpv-nmpc", {"T2": [0.1, None]})
    made += results("mine/seed-0/policy.json", {"T2": [0.3, 0.3]}, 100)
    made += results("mine/seed-1/policy.json", {"T2": [None, 0.5]}, 200)
    folder_of(tmp_path, made, traces=False)
    (metric,) = (outcome := within(tmp_path)).metrics
    assert metric.pairs == 1
    assert metric.difference.value == pytest.approx(0.2)
    assert (metric.wins, metric.ties, metric.losses) == (2, 0, 2)
    assert (outcome.a_alone, outcome.b_alone) == (2, 1)


def names(pairs: Any) -> list[tuple[str, str]]:
    return [(f"{a.folder.name}:{a.label}", f"{b.folder.name}:{b.label}") for a, b in pairs]


def test_who_meets_whom(tmp_path: Path) -> None:
    errors = {"T2": [0.1]}
    one = read(folder(tmp_path / "x", ("pid", errors), ("lqr", errors), ("lpv-nmpc", errors)))
    two = read(folder(tmp_path / "y", ("pid", errors), ("stanley", errors)))
    base = "x:lpv-nmpc"
    assert names(pairs_within(one, [], None)) == [(base, "x:lqr"), (base, "x:pid")]
    assert names(pairs_within(one, ["pid", "lqr"], None)) == [("x:pid", "x:lqr")]
    assert names(pairs_within(one, [], "lqr")) == [("x:lqr", "x:lpv-nmpc"), ("x:lqr", "x:pid")]
    assert names(pairs_within(two, [], None)) == [("y:stanley", "y:pid")]
    assert names(pairs_between([one, two], [], None)) == [("x:pid", "y:pid")]
    assert names(pairs_between([one, two], ["stanley"], "lqr")) == [("x:lqr", "y:stanley")]
    alone = read(folder(tmp_path / "z", ("pure-pursuit", errors)))
    assert names(pairs_between([alone, two], [], None)) == [
        ("z:pure-pursuit", "y:stanley"), ("z:pure-pursuit", "y:pid"),
    ]  # fmt: skip
    with pytest.raises(ValueError, match="say with --baseline which of lpv-nmpc, lqr, pid"):
        pairs_between([one, alone], [], None)
    with pytest.raises(ValueError, match="no agent to compare with pure-pursuit"):
        pairs_within(alone, [], None)
    with pytest.raises(ValueError, match=r"unknown agent 'stanly'; known: .*nearest: stanley"):
        pairs_between([one, two], ["stanly"], None)
    with pytest.raises(ValueError, match="none of the agents lqr is in a folder after the first"):
        pairs_between([one, two], ["lqr"], None)


def test_a_label_is_known_by_its_agents_name_where_only_one_has_it(tmp_path: Path) -> None:
    changed = results("lqr", {"T2": [0.1]}, 9, agent_settings={"gain": 2.0})
    folder_of(tmp_path, [*results("stanley", {"T2": [0.1]}), *changed], traces=False)
    found = read(tmp_path)
    assert names(pairs_within(found, ["stanley", "lqr"], None))[0][1].endswith(":lqr (gain=2.0)")


def test_no_metric_in_common_is_no_metric(tmp_path: Path) -> None:
    """Metrics that old results lack are left out, all others compared."""
    errors = {"T2": [0.1, 0.2]}
    path = folder(tmp_path, ("stanley", errors), ("pid", errors))
    keys = [one.measure.key for one in within(path, DEFAULTS).metrics]
    assert keys == ["ale", "mle", "aoe"]
