"""`lpv-track switching`, tiny: draws of weights, branches that are followed, results."""

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

import agents
from agents.weight_tuning.choice import SLEW
from agents.weight_tuning.closed_loop import ClosedLoop
from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule
from experiments import cli
from experiments.commands.switching import base_of, widest_kept
from experiments.run.statistics import rate_bound
from experiments.study import weight_switching
from experiments.study.weight_switching import (
    ADVERSARY,
    CONTROL,
    RANDOM,
    WHOLE,
    WINDOW,
    Arm,
    Branches,
    Outcome,
    Setup,
    arms_of,
    drive_arm,
    summary,
    weights_before_loss,
)
from lpv_track_env import kernels as k
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import CurvatureBands

SMALL = Setup(episodes=5, paths=3, time_limit=2.0, candidates=3)
BASE = TrackingWeights().as_array()


def nothing() -> None:
    pass


def outcome_of(arm: Arm, setup: Setup = SMALL) -> Outcome:
    return drive_arm(setup, arm, nothing)


def assert_same(one: Outcome, other: Outcome) -> None:
    for name in Outcome.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


# What is drawn -------------------------------------------------------------------------------


@pytest.mark.parametrize("span", [10.0, 1000.0, WHOLE])
def test_draws_fill_their_bounds_evenly_in_logarithms(span: float) -> None:
    sets = Arm(RANDOM, span).draw(np.random.default_rng(0), 4000, BASE)
    low = np.full(8, LOWEST) if span == WHOLE else BASE[:8] / span
    high = np.full(8, HIGHEST) if span == WHOLE else BASE[:8] * span
    share = np.log(sets[:, :8] / low) / np.log(high / low)
    assert (share >= 0.0).all()
    assert (share <= 1.0).all()
    np.testing.assert_allclose(np.quantile(share, [0.1, 0.5, 0.9], axis=0).T - [0.1, 0.5, 0.9],
                               0.0, atol=0.05)  # fmt: skip
    # Each by itself, and R as it is.
    assert np.abs(np.corrcoef(share.T) - np.eye(8)).max() < 0.08
    np.testing.assert_array_equal(sets[:, 8:], np.tile(BASE[8:], (4000, 1)))


def test_arms_are_the_control_and_both_ways_with_the_slew_limit_and_without() -> None:
    arms = arms_of((10.0, WHOLE))
    assert arms[0].mode == CONTROL
    assert len({arm.label for arm in arms}) == len(arms) == 9
    assert {arm.slew for arm in arms[1:]} == {SLEW, math.inf}
    sets = arms[0].draw(np.random.default_rng(0), 3, BASE)
    np.testing.assert_array_equal(sets, np.tile(BASE, (3, 1)))


@pytest.mark.parametrize("slew", [SLEW, math.inf])
def test_weights_in_use_keep_to_the_slew_limit_and_reach_what_is_drawn(slew: float) -> None:
    arm = Arm(RANDOM, WHOLE, slew)
    used = outcome_of(arm).used
    assert used.shape == (5, 5, 8)
    change = np.abs(np.diff(used, axis=1))
    if slew < math.inf:
        assert np.nanmax(change) <= slew * WINDOW * (1.0 + 1e-4)
    rng = np.random.default_rng([SMALL.seed, 0])
    drawn = np.array([np.log(arm.draw(rng, 5, BASE)[:, :8] / BASE[:8]) for _ in range(5)])
    # At once in the first window, whatever the limit.
    known = 1 if slew < math.inf else 5
    np.testing.assert_allclose(used.swapaxes(0, 1)[:known], drawn[:known], atol=1e-4)


# What is driven ------------------------------------------------------------------------------


def test_the_control_is_the_closed_loop_with_the_default_weights() -> None:
    found = outcome_of(Arm(CONTROL))
    envs = PathTrackingVectorEnv(
        5, SMALL.trajectories, conditions="realtime", random_start=True, time_limit=2.0,
        autoreset_mode="Disabled",
    )  # fmt: skip
    agent: Any = agents.make("lpv-nmpc", envs.single)
    loop = ClosedLoop(envs, agent)
    loop.reset(seed=0)
    tally = loop.drive(60)
    np.testing.assert_array_equal(found.largest, tally.max_lateral)
    np.testing.assert_allclose(found.lateral_square, tally.lateral_square, rtol=1e-12)
    for name in ("steps", "solves", "failures"):
        np.testing.assert_array_equal(getattr(found, name), getattr(tally, name))
    np.testing.assert_array_equal(found.ends, envs.arrays.ends)
    np.testing.assert_allclose(found.used[found.steps > 36], 0.0, atol=1e-6)


def test_an_adversary_with_one_draw_is_chance() -> None:
    one = Setup(episodes=5, paths=3, time_limit=2.0, candidates=1)
    assert_same(outcome_of(Arm(ADVERSARY, WHOLE), one), outcome_of(Arm(RANDOM, WHOLE), one))


def test_batches_and_threads_change_nothing_but_the_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = outcome_of(Arm(CONTROL))
    monkeypatch.setattr(weight_switching, "BATCH", 2)
    assert_same(outcome_of(Arm(CONTROL)), whole)


def test_the_adversary_follows_the_worst_branch() -> None:
    """Window by window, against branches that are driven one by one from the same past."""
    arm, windows, count = Arm(ADVERSARY, WHOLE), 3, SMALL.candidates
    short = Setup(episodes=2, paths=3, time_limit=windows * WINDOW, candidates=count)
    found = outcome_of(arm, short)
    rng = np.random.default_rng([0, 0])
    draws = [arm.draw(rng, 2 * count, BASE).reshape(2, count, 12) for _ in range(windows)]
    for episode in range(2):
        taken: list[Any] = []
        for sets in draws:
            harms = []
            for j in range(count):
                branches = Branches(short, Arm(RANDOM, WHOLE), 2)
                branches.loop.reset(seed=0)
                tallies = [
                    branches.loop.drive(branches.window, one) for one in [*taken, sets[episode, j]]
                ]
                harms.append(tallies[-1].max_lateral[episode])
            worst = int(np.argmax(harms))
            taken.append(sets[episode, worst])
        largest = max(tally.max_lateral[episode] for tally in tallies[:-1])
        np.testing.assert_allclose(
            found.used[episode], np.log(np.array(taken)[:, :8] / BASE[:8]), rtol=1e-5, atol=1e-5
        )
        assert found.largest[episode] == max(largest, *harms)


def test_lost_vehicles_are_lost_once_and_what_failed_is_counted() -> None:
    """A corridor that nobody keeps to, and weights under which solves fail."""
    setup = Setup(episodes=12, paths=2, time_limit=4.5, conditions="simulation")
    branches = Branches(setup, Arm(RANDOM, WHOLE), 12)
    branches.loop.envs.arrays.observations[:] = np.nan
    loop = branches.loop
    loop.envs.arrays.constants[:, k.CORRIDOR] = 0.02
    found = branches.drive(setup, 0, np.random.default_rng(0), nothing)
    told = summary(found)
    assert 0 < told["lost"] == told["ends"]["left_corridor"]
    lost = found.ends == k.LEFT_CORRIDOR
    assert told["lost_seeds"] == np.flatnonzero(lost).tolist()
    assert (found.largest[lost] > 0.02).all()
    assert (found.largest[~lost] <= 0.02).all()
    assert (found.steps[lost] < 90).all()
    # Nothing is noted of a vehicle after its end.
    assert (np.isfinite(found.used[:, :, 0]).sum(axis=1) == np.ceil(found.steps / 8)).all()
    assert told["lost_upper_bound"] > told["lost"] / 12
    assert told["not_finite"] == 0


# What is told --------------------------------------------------------------------------------


@pytest.mark.parametrize(("failures", "episodes"), [(0, 2000), (1, 50), (7, 30), (49, 50)])
def test_the_bound_is_the_rate_at_which_so_few_failures_are_improbable(
    failures: int, episodes: int
) -> None:
    bound = rate_bound(failures, episodes)
    assert binom.cdf(failures, episodes, bound) == pytest.approx(0.05, rel=1e-9)


def test_the_bound_of_none_kept_is_one_and_of_none_lost_the_rule_of_three() -> None:
    assert rate_bound(5, 5) == 1.0
    assert rate_bound(0, 2000) == pytest.approx(1.0 - 0.05 ** (1 / 2000), rel=1e-12)
    assert rate_bound(0, 2000) == pytest.approx(3.0 / 2000, rel=0.01)


def test_weights_before_a_loss() -> None:
    """Ten windows of two episodes; the first is lost in its eighth."""
    used = np.zeros((2, 10, 8))
    used[0, 3:8, 3] = -3.0 * math.log(10.0)  # Q on the lateral position, in the last five
    used[0, 8:] = np.nan
    ends = np.array([k.LEFT_CORRIDOR, k.TIME_LIMIT])
    zeros = np.zeros(2)
    outcome = Outcome(zeros, ends, zeros, zeros, zeros, zeros, zeros, zeros, used, Counter())
    found = weights_before_loss(outcome)
    assert found["Q_y"]["before_loss"] == pytest.approx(-3.0)
    assert found["Q_y"]["all"] == pytest.approx(-3.0 * 5 / 18)
    assert found["S_y"] == {"before_loss": 0.0, "all": 0.0, "spread": 0.0}
    assert found["Q_psi - Q_y"]["before_loss"] == pytest.approx(3.0)


def test_the_widest_span_in_which_none_is_lost() -> None:
    def row(arm: Arm, lost: int) -> dict[str, Any]:
        return {**arm.as_dict(), "lost": lost}

    arms = [Arm(RANDOM, span) for span in (10.0, 100.0, 1000.0, WHOLE)]
    rows = {"control": row(Arm(CONTROL), 0)}
    rows.update({arm.label: row(arm, lost) for arm, lost in zip(arms, (0, 0, 1, 0), strict=True)})
    rows["slow"] = row(Arm(RANDOM, WHOLE, SLEW), 0)
    rows["worst"] = row(Arm(ADVERSARY, 10.0), 2)
    said = widest_kept({"arms": rows})
    assert "random, no limit: span 100;" in said
    assert "random, slew limit: the whole bounds;" in said
    assert "adversary, no limit: no span;" in said
    assert said.endswith("in every way: no span")
    del rows["worst"]
    assert widest_kept({"arms": rows}).endswith("in every way: span 100")


# The command ---------------------------------------------------------------------------------


def test_switching(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["switching", "--episodes", "2", "--spans", "10", "whole", "--candidates", "2",
               "--out", str(tmp_path)]  # fmt: skip
    driven: list[str] = []

    def counted(setup: Setup, arm: Arm, tick: Any) -> Outcome:
        if len(driven) == 3:
            raise KeyboardInterrupt
        driven.append(arm.label)
        small = Setup(**{**vars(setup), "paths": 2, "time_limit": 1.0})
        return drive_arm(small, arm, tick)

    monkeypatch.setattr(weight_switching, "drive_arm", counted)
    all_driven: list[str] = []
    for code in (cli.EXIT_INTERRUPTED, cli.EXIT_INTERRUPTED, 0, 0):
        driven.clear()
        capsys.readouterr()
        assert cli.main(command) == code
        all_driven += driven
    # What is there is not driven again.
    assert all_driven == [arm.label for arm in arms_of((10.0, WHOLE))]
    shown = capsys.readouterr().out
    result = json.loads((tmp_path / "switching.json").read_text())
    assert list(result["arms"]) == [arm.label for arm in arms_of((10.0, WHOLE))]
    assert result["setup"]["episodes"] == 2
    assert len(result["trajectories"]) == 40
    assert result["trajectories"][:3] == ["random-0", "random-fast-1", "random-2"]
    assert result["revision"].keys() == {"sources", "commit", "modified"}
    for label, row in result["arms"].items():
        assert row["episodes"] == 2
        assert label in shown
    assert "none lost within: " in shown


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--episodes", "0"], "--episodes must be a whole number"),
        (["--candidates", "0"], "--candidates must be a whole number"),
        (["--seed", "-1"], "--seed must be a whole number from 0"),
        (["--spans", "1"], "--spans are numbers above 1 and at most 10000, or whole; not 1"),
        (["--spans", "ten"], "or whole; not ten"),
        (["--spans", "nan"], "or whole; not nan"),
        (["--conditions", "fog"], "fog"),
        (["--vehicle", "bicycle"], "bicycle"),
        (["--threads", "0"], "--threads must be a whole number"),
    ],
)
def test_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: list[str], message: str
) -> None:
    assert cli.main(["switching", "--out", str(tmp_path / "out"), *given]) == cli.EXIT_USAGE
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["switching", "--help"])
    assert ended.value.code == 0
    assert "example: lpv-track switching " in capsys.readouterr().out


def test_other_weights_are_switched_around() -> None:
    base = TrackingWeights(Q=(LOWEST, 1.0, 2.0, 2.0), S=(1.0, HIGHEST, 3.0, 3.0))
    sets = Arm(RANDOM, 10.0).draw(np.random.default_rng(0), 2000, base.as_array())
    assert sets.min(axis=0)[[0, 2]] == pytest.approx([LOWEST, 0.2], rel=0.02)
    assert sets.max(axis=0)[[2, 5]] == pytest.approx([20.0, HIGHEST], rel=0.02)
    assert sets.min() >= LOWEST
    assert sets.max() <= HIGHEST
    other = Setup(**{**vars(SMALL), "weights": base})
    kept, usual = outcome_of(Arm(CONTROL), other), outcome_of(Arm(CONTROL))
    np.testing.assert_allclose(kept.used[kept.steps > 36], 0.0, atol=1e-6)
    assert (kept.lateral_square != usual.lateral_square).all()


def test_a_file_of_the_base_weights(tmp_path: Path) -> None:
    base = TrackingWeights(Q=(0.5, 1.0, 2.0, 2.0))
    bands = CurvatureBands()
    WeightSchedule(bands, (base,) * 4).write(tmp_path / "one.json")
    assert base_of(tmp_path / "one.json") == base
    assert base_of(None) == TrackingWeights()
    WeightSchedule(bands, (base, base, base, TrackingWeights())).write(tmp_path / "four.json")
    with pytest.raises(ValueError, match=r"four\.json holds no single set"):
        base_of(tmp_path / "four.json")
