"""Suites: what they drive, and that all of it can be driven."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import pytest

import agents
import trajectories
from experiments.jobs.job import TRAINING_PATHS, VALIDATION_PATHS
from experiments.run.case import Case
from experiments.run.physical_limits import limit_of
from experiments.run.suites import (
    BESIDE,
    DEMONSTRATION,
    HELD_OUT,
    LEAST_SEEDS,
    LIMIT_PATHS,
    LIMITS,
    RAW,
    RECOVERY,
    REGIMES,
    SIX,
    SUITES,
    default_agents,
)
from lpv_track_env.observation import ObservationLayout
from tests.helpers.learned_policies import random_policy
from tests.helpers.policy_files import DRIVING


@pytest.mark.parametrize("suite", [one for one in SUITES if one not in ("limits", "recovery")])
def test_cases_of_a_suite_are_valid_and_distinct(suite: str) -> None:
    specs = SUITES[suite](default_agents(), [0, 1])
    cases = [Case(**spec) for spec in specs]
    assert len({case.id for case in cases}) == len(cases) > 0
    ideal = [
        case for case in cases if case.conditions == "simulation" and case.env_settings != BESIDE
    ]
    assert {case.seed for case in ideal} in (set(), {0, 1})
    # Where chance has a say, intervals must mean something.
    other = [case for case in cases if case not in ideal]
    assert {case.seed for case in other} in (set(), set(range(LEAST_SEEDS)))
    assert len(ideal) + len(other) == len(cases)


def test_limits_drives_every_regime_with_the_same_cases_for_each_agent() -> None:
    names = ["stanley", "lpv-nmpc", "lpv-nmpc-ipopt"]
    cases = [Case(**spec) for spec in SUITES["limits"](names, [0])]
    counts = [10, 10, 9, 10, 20, 20, 4, 8, 3, 6, 4, 10, 10, 10, 10, 10]
    assert Counter(case.agent for case in cases) == dict.fromkeys(names[:2], sum(counts) + 426)
    assert len({case.id for case in cases}) == len(cases)
    own = [case for case in cases if case.agent == "stanley"]
    for case in own[: sum(counts)]:
        case.check()
    drives = Counter(case.regime for case in own)
    assert tuple(drives) == REGIMES == (*LIMITS, *RECOVERY)
    assert list(drives.values())[: len(LIMITS)] == counts
    used = {case.trajectory for case in cases if case.trajectory.startswith("random-limit")}
    assert used < set(LIMIT_PATHS)
    # More seeds where something is drawn, and another one for each path.
    more = [Case(**spec) for spec in SUITES["limits"](["stanley"], range(5))]
    drives = Counter(case.regime for case in more)
    several = [10, 10, 9, 10, 50, 50, 4, 20, 3, 15, 4, 10, 10, 10, 50, 50]
    assert list(drives.values())[: len(LIMITS)] == several
    for name in ("0.55 g, friction unknown", "slow actuators"):
        seeds = [case.seed for case in more if case.regime == name]
        assert len(seeds) == len(set(seeds)) == 50


def test_the_limits_of_searched_cases_are_known() -> None:
    """Reports show entry speeds and lap times beside what is possible."""
    cases = [Case(**spec) for spec in SUITES["limits"](["stanley"], [0])]
    searched = [case for case in cases if case.search]
    assert len(searched) == 4 + 8 + 3 + 6
    for case in searched:
        assert isinstance(case.conditions, Mapping)
        limit = limit_of(case.trajectory, case.vehicle, case.conditions["friction"])
        assert limit is not None
        assert 10.0 < limit < 120.0


def test_recovery_drives_from_the_same_starts_with_each_agent() -> None:
    cases = [Case(**spec) for spec in SUITES["recovery"](["stanley", "lpv-nmpc-ipopt", "pid"], [0])]
    assert Counter(case.agent for case in cases) == {"stanley": 426, "pid": 426}
    for case in cases[::20]:
        case.check()
    assert len({case.id for case in cases}) == len(cases)
    starts = Counter(case.regime for case in cases if case.agent == "pid")
    assert list(starts.values()) == [183, 81, 81, 81]
    standing = [case for case in cases if case.regime == "standing starts"]
    assert {case.start["speed"] for case in standing} == {0.0}
    for name in ("T1", "T2", "T3", "T4", "T5", "T6", "u-turn"):
        arcs = [case.start["arc_length"] for case in standing if case.trajectory == name]
        assert 18.0 <= trajectories.load(name).length - max(arcs) < 18.0 + 38.0


def test_default_agents_are_those_to_drive_with() -> None:
    assert set(agents.names()) - set(default_agents()) == {DEMONSTRATION}
    drive = [Case(**spec) for suite in ("paper", "quick") for spec in
             SUITES[suite](default_agents(), [0])]  # fmt: skip
    assert {case.agent for case in drive} == set(default_agents())


def test_what_ipopt_does_not_drive_in_one_suite_it_drives_in_another() -> None:
    names, solved = default_agents(), "lpv-nmpc-ipopt"
    counts = {
        suite: Counter(
            (spec["agent"], spec["trajectory"], spec["vehicle"], spec["speed_mode"])
            for spec in SUITES[suite](names, [0])
            if spec.get("conditions") is None
        )
        for suite in ("paper", "converged")
    }
    both = counts["paper"] + counts["converged"]
    fast = {key[1:] for key in counts["paper"] if key[0] == "lpv-nmpc"}
    assert {key[1:] for key in both if key[0] == solved} == fast
    assert {key[1] for key in counts["paper"] if key[0] == solved} == set(SIX)
    assert {key[1] for key in both} == {*SIX, *RAW}


def test_realtime_drives_the_six_with_as_many_seeds_as_are_asked_for() -> None:
    specs = SUITES["realtime"](["lpv-nmpc", "stanley"], range(20))
    assert len(specs) == 2 * 6 * 20
    assert {spec["conditions"] for spec in specs} == {"realtime"}
    driven = Counter(spec["trajectory"] for spec in SUITES["paper"](["lpv-nmpc"], [0])
                     if spec.get("conditions") == "realtime")  # fmt: skip
    assert driven == dict.fromkeys(SIX, LEAST_SEEDS)


def test_frozen_compares_both_forms_with_the_nmpc() -> None:
    specs = SUITES["frozen"](["stanley"], [0])
    forms = Counter((spec["agent"], str(spec.get("agent_settings", {}))) for spec in specs)
    assert forms == {
        ("lpv-nmpc", "{}"): 6,
        (DEMONSTRATION, "{'form': 'literal'}"): 6,
        (DEMONSTRATION, "{'form': 'sinc'}"): 6,
    }


def test_learned_policies_are_compared_on_paths_that_nobody_trained_on() -> None:
    specs = SUITES["learned"](default_agents(), [0])
    fast = set(default_agents()) - {"lpv-nmpc-ipopt"}
    drives = Counter((spec["agent"], str(spec.get("conditions"))) for spec in specs)
    alone = 6 + 6 * LEAST_SEEDS + len(HELD_OUT)
    assert drives == {
        **{(name, "None"): alone for name in fast},
        **{(name, "realtime"): (6 + len(HELD_OUT)) * LEAST_SEEDS for name in fast},
    }
    numbers = [int(name.rpartition("-")[2]) for name in HELD_OUT]
    assert len(numbers) == 20
    assert max(numbers) < TRAINING_PATHS < VALIDATION_PATHS


@pytest.mark.parametrize(("steps", "period", "raw"), [(20, 0.05, 0), (30, 0.05, 0), (30, 0.1, 6)])
def test_a_policy_file_drives_raw_waypoints_if_it_was_made_for_their_preview(
    steps: int, period: float, raw: int, tmp_path: Path
) -> None:
    file = DRIVING.written(tmp_path, random_policy(layout=ObservationLayout(steps, period)))
    specs = SUITES["paper"]([str(file), "stanley"], [0])
    drives = Counter(spec["agent"] for spec in specs if spec["trajectory"] in RAW)
    assert drives == Counter({str(file): raw, "stanley": 6})
