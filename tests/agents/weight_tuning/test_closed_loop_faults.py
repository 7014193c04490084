"""Closed loops in compiled code: solves that fail, and what is refused."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import agents
from agents.weight_tuning.closed_loop import ClosedLoop
from lpv_track_env import kernels as k
from tests.helpers.closed_loops import CALM, InTurns, assert_same, environments, loop_of, traced
from tests.helpers.nmpc_situations import WEIGHTS

# Failing solves ------------------------------------------------------------------------------


@pytest.mark.parametrize(("entry", "value"), [(5, np.nan), (0, np.inf)])
def test_failing_solves_go_to_the_fallback_as_in_predict(entry: int, value: float) -> None:
    """Plan, then a stop; Stanley without a plan."""
    loop = loop_of(3, CALM, max_failures=3)
    turns = InTurns(3, CALM, None, max_failures=3)
    loop.reset(seed=9)
    turns.reset(seed=9)
    seen = []
    for period in range(12):
        # Row 0 never fails; row 1 from the start on, row 2 once it has a plan.
        for row, first in ((1, 0), (2, 4)):
            if first <= period < 10:
                loop.envs.arrays.observations[row, entry] = value
                turns.envs[row].arrays.observations[0, entry] = value
        turns.failures[:] = 0.0
        tally, trace = traced(loop, 1)
        np.testing.assert_array_equal(trace, turns.drive(1))
        np.testing.assert_array_equal(tally.failures, turns.failures)
        seen.append(turns.fallbacks.copy())
    assert [row[0] for row in seen] == [""] * 12
    assert [row[1] for row in seen] == ["stanley"] * 3 + ["stop"] * 7 + [""] * 2
    assert [row[2] for row in seen] == [""] * 4 + ["plan"] * 3 + ["stop"] * 3 + [""] * 2
    for row in (1, 2):
        _, memory = turns.agents[row].predict(turns.envs[row].arrays.observations.copy())
        assert loop.memory.nmpc.fallbacks[row].counts == memory.fallbacks[0].counts


def test_diagnostics_after_a_drive_are_those_of_its_last_period() -> None:
    loop = loop_of(2, CALM, max_failures=3)
    loop.reset(seed=9)
    loop.envs.arrays.observations[1, 5] = np.nan
    loop.drive(1)
    report = [loop.agent.diagnostics(loop.memory.nmpc[row]) for row in range(2)]
    assert [(t["status"], t["fallback"]) for t in report] == [("SUCCESS", ""), ("NAN", "stanley")]
    loop.drive(1)
    report = [loop.agent.diagnostics(loop.memory.nmpc[row]) for row in range(2)]
    assert [(t["status"], t["fallback"]) for t in report] == [("SUCCESS", "")] * 2


def test_failures_in_the_middle_of_a_call() -> None:
    """Solves that fail while others go on, many in one call: none is lost, none counted twice."""
    # A corridor this wide lets vehicles drift to where weights like these cannot be solved for.
    settings = {
        **CALM, "max_lateral_error": 300.0, "initial_error_range": (30.0, 1.5, 10.0),
        "preview_steps": 50,
    }  # fmt: skip
    weights = WEIGHTS * 10.0 ** np.random.default_rng(0).uniform(-5, 5, (17, 12))
    loop, turns = loop_of(17, settings), InTurns(17, settings, weights.clip(1e-4, 1e6))
    loop.reset(seed=10)
    turns.reset(seed=10)
    tally, trace = traced(loop, 40, weights.clip(1e-4, 1e6))
    np.testing.assert_array_equal(trace, turns.drive(40))
    np.testing.assert_array_equal(tally.failures, turns.failures)
    np.testing.assert_array_equal(tally.iterations, turns.iterations)
    assert_same(loop, turns)
    assert 0 < tally.failures.sum() < tally.steps.sum()


# What is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_other_autoreset_modes_are_refused(mode: str) -> None:
    envs = environments(2, autoreset_mode=mode)
    with pytest.raises(ValueError, match="autoreset_mode='Disabled'"):
        ClosedLoop(envs, agents.make("lpv-nmpc", envs.single))


def test_an_agent_for_another_layout_is_refused() -> None:
    envs, other = environments(2), environments(2, preview_steps=25)
    with pytest.raises(ValueError, match=r"preview_steps=25.*agents.make\(name, envs.single\)"):
        ClosedLoop(envs, agents.make("lpv-nmpc", other.single))


@pytest.mark.parametrize("threads", [0, -1, 10_000])
def test_impossible_threads_are_refused(threads: int) -> None:
    with pytest.raises(ValueError, match=rf"threads must be from 1 to \d+ .*, not {threads}"):
        loop_of(2, CALM, threads=threads)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones(10), r"weights must be \(12,\) or \(3, 12\), not \(10,\)"),
        (np.ones((2, 12)), r"not \(2, 12\)"),
        (np.ones((3, 12, 1)), r"not \(3, 12, 1\)"),
        (1.0, r"not \(\)"),
        ([WEIGHTS, WEIGHTS * np.nan, WEIGHTS], "weights of environment 1 must be finite"),
        ([WEIGHTS, WEIGHTS, -WEIGHTS], "weights of environment 2 must be finite and >= 0"),
        (WEIGHTS * np.inf, "weights of environment 0 must be finite"),
    ],
)
def test_bad_weights_are_refused_and_nothing_moves(weights: Any, message: str) -> None:
    loop = loop_of(3, CALM)
    loop.reset(seed=0)
    before = loop.envs.records.copy()
    with pytest.raises(ValueError, match=message):
        loop.drive(5, weights)
    np.testing.assert_array_equal(loop.envs.records, before)


def read_only() -> np.ndarray:
    array = np.zeros((3, 5, k.RECORD_SIZE))
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    "trace",
    [
        np.zeros((3, 4, k.RECORD_SIZE)),
        np.zeros((2, 5, k.RECORD_SIZE)),
        np.zeros((3, 5)),
        np.zeros((3, 5, 6)),
        np.zeros((3, 5, k.RECORD_SIZE), dtype=np.float32),
        np.zeros((k.RECORD_SIZE, 5, 3)).T,
        read_only(),
    ],
)
def test_a_trace_of_another_kind_is_refused(trace: np.ndarray) -> None:
    loop = loop_of(3, CALM)
    loop.reset(seed=0)
    with pytest.raises(ValueError, match=r"trace must be a writable C-ordered .* \(3, 5, 24\)"):
        loop.drive(5, trace=trace)


@pytest.mark.parametrize("periods", [0, -3])
def test_less_than_one_period_is_refused(periods: int) -> None:
    loop = loop_of(2, CALM)
    loop.reset(seed=0)
    with pytest.raises(ValueError, match=f"periods must be at least 1, not {periods}"):
        loop.drive(periods)
    with pytest.raises(TypeError):
        loop.drive(2.5)  # type: ignore[arg-type]


def test_a_drive_before_the_first_reset_is_refused() -> None:
    """As the environments' own step is: there is no episode to drive."""
    loop = loop_of(2, CALM)
    with pytest.raises(gymnasium.error.ResetNeeded):
        loop.drive(3)
