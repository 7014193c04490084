"""Closed loops in compiled code against `predict` and `step` in turns, bit for bit."""

from typing import Any

import numba
import numpy as np
import pytest

import agents
from agents.nmpc.rti_agent import RtiMemory
from agents.nmpc.schedule import NO_BAND
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.loop_kernels import drive_rows
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env import kernels as k
from lpv_track_env.conditions import REALTIME, layout
from lpv_track_env.vehicle import M2_MINIBUS
from tests.helpers.closed_loops import (
    CALM,
    LIVELY,
    InTurns,
    assert_same,
    environments,
    loop_of,
    traced,
    weights_of,
)
from tests.helpers.nmpc_situations import WEIGHTS
from trajectories import CurvatureBands

# Equality ------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 3, 17])
def test_is_predict_and_step_in_turns(n: int) -> None:
    """Through ends and resets of some, each environment with weights of its own."""
    weights = weights_of(n)
    loop, turns = loop_of(n, LIVELY), InTurns(n, LIVELY, weights)
    loop.reset(seed=5)
    turns.reset(seed=5)
    ends: set[int] = set()
    for _ in range(3):
        tally, trace = traced(loop, 25, weights)
        np.testing.assert_array_equal(trace, turns.drive(25))
        assert_same(loop, turns)
        np.testing.assert_array_equal(tally.steps, np.isfinite(trace[:, :, 0]).sum(axis=1))
        ended = ~loop.running
        ends |= set(loop.envs.arrays.ends.tolist())
        if ended.any():
            # What has ended stands still, and nothing is counted for it.
            still, _ = traced(loop, 3, weights)
            assert not np.array(still)[:, ended].any()
            turns.drive(3)
            loop.reset(options={"reset_mask": ended})
            turns.reset(np.flatnonzero(ended))
            assert loop.running.all()
            assert_same(loop, turns)
    if n == 17:
        assert ends >= {k.RUNNING, k.LEFT_CORRIDOR, k.TIME_LIMIT}
        names = {(loop.envs.task_of(i).path.name, loop.envs.task_of(i).vehicle.name)
                 for i in range(n)}  # fmt: skip
        assert len(names) == 4


def test_weights_for_all_and_the_agents_own() -> None:
    given, own, changed = (loop_of(3, CALM) for _ in range(3))
    other = TrackingWeights(Q=(2.0, 3.0, 4.0, 5.0))
    assert changed.agent.set_weights(other)
    for loop in (given, own, changed):
        loop.reset(seed=1)
    rows = [given.drive(10, WEIGHTS), own.drive(10), changed.drive(10)]
    np.testing.assert_array_equal(rows[0], rows[1])
    assert not np.array_equal(rows[1], rows[2])
    own.reset(seed=1)
    np.testing.assert_array_equal(own.drive(10, np.tile(other.as_array(), (3, 1))), rows[2])


def test_any_array_of_weights_does() -> None:
    """None has the loop compiled for it anew."""
    loop, sets = loop_of(3, CALM), weights_of(3)
    loop.reset(seed=1)
    wanted = loop.drive(5, sets)
    known = len(drive_rows.signatures)  # type: ignore[attr-defined]
    fixed = sets.copy()
    fixed.flags.writeable = False
    for same in (np.asfortranarray(sets), np.repeat(sets, 2, axis=1)[:, ::2], sets.tolist(), fixed):
        loop.reset(seed=1)
        np.testing.assert_array_equal(loop.drive(5, same), wanted)
        assert len(drive_rows.signatures) == known  # type: ignore[attr-defined]


def test_cutting_a_drive_into_calls_changes_nothing() -> None:
    whole, parts = loop_of(5, LIVELY), loop_of(5, LIVELY)
    for loop in (whole, parts):
        loop.reset(seed=2)
    (all_in_one, trace), tallies, traces = traced(whole, 20), [], []
    for periods in (10, 1, 9):
        tally, piece = traced(parts, periods)
        tallies.append(tally)
        traces.append(piece)
    np.testing.assert_array_equal(np.concatenate(traces, axis=1), trace)
    np.testing.assert_array_equal(parts.envs.state, whole.envs.state)
    for name in Tally._fields:
        pieces = [getattr(tally, name) for tally in tallies]
        total = np.max(pieces, axis=0) if name.startswith("max") else np.sum(pieces, axis=0)
        np.testing.assert_allclose(total, getattr(all_in_one, name), rtol=1e-12, err_msg=name)


def test_drive_and_predict_share_one_memory() -> None:
    """Periods driven by hand, in between, with the loop's own environments and memory."""
    whole, mixed = loop_of(3, CALM), loop_of(3, CALM)
    for loop in (whole, mixed):
        loop.reset(seed=3)
    whole.drive(12)
    mixed.drive(5)
    for _ in range(3):
        actions, memory = mixed.agent.predict(
            mixed.envs.arrays.observations.copy(), mixed.memory.nmpc
        )
        assert memory is mixed.memory.nmpc
        mixed.envs.step(actions)
    mixed.drive(4)
    np.testing.assert_array_equal(mixed.envs.records, whole.envs.records)


def test_environments_are_the_same_in_any_number() -> None:
    few, many = loop_of(3, LIVELY), loop_of(20, LIVELY)
    few.reset(seed=4)
    many.reset(seed=4)
    weights = weights_of(20)
    ours, theirs = few.drive(40, weights[:3]), many.drive(40, weights)
    np.testing.assert_array_equal(ours, np.array(theirs)[:, :3])


def test_threads_change_nothing() -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:  # type: ignore[attr-defined]
        pytest.skip("numba sees one processor")
    for n in (1, 3, 17):
        one, two = loop_of(n, LIVELY), loop_of(n, LIVELY, threads=2)
        for loop in (one, two):
            loop.reset(seed=6)
            # One that fails at once, in the second thread's part.
            loop.envs.arrays.observations[n - 1] = np.nan
        weights = weights_of(n)
        for _ in range(2):
            for ours, theirs in zip(
                traced(one, 20, weights), traced(two, 20, weights), strict=True
            ):
                np.testing.assert_array_equal(ours, theirs)


def test_reset_of_some_and_with_options() -> None:
    loop, turns = loop_of(4, CALM), InTurns(4, CALM, None)
    loop.reset(seed=7)
    turns.reset(seed=7)
    for marked, options in (
        ([0, 2], {}), ([1], {"trajectory": "sine"}), ([3], {"arc_length": 30.0}),
    ):  # fmt: skip
        np.testing.assert_array_equal(traced(loop, 8)[1], turns.drive(8))
        loop.reset(options={**options, "reset_mask": np.isin(np.arange(4), marked)})
        turns.reset(marked, **options)
    np.testing.assert_array_equal(traced(loop, 8)[1], turns.drive(8))


def agent_memory(agent: Any) -> RtiMemory:
    """Own memory of an agent of `InTurns`, with delay compensation around it or not."""
    memory: RtiMemory = agent._memory.inner if hasattr(agent, "future") else agent._memory
    return memory


# Conditions and schedules --------------------------------------------------------------------

SLOW_COMPUTER = REALTIME.replace(computing_delay=(0.03, 0.09))


@pytest.mark.parametrize("conditions", ["realtime", "ideal", SLOW_COMPUTER], ids=str)
def test_conditions_too_are_predict_and_step_in_turns(conditions: Any) -> None:
    """Delay compensation, drawn vehicles, the filter; a computer that misses its deadlines."""
    settings = {**LIVELY, "conditions": conditions, "max_lateral_error": 1.5}
    weights = weights_of(9)
    loop, turns = loop_of(9, settings), InTurns(9, settings, weights)
    loop.reset(seed=5)
    turns.reset(seed=5)
    for _ in range(2):
        tally, trace = traced(loop, 25, weights)
        np.testing.assert_array_equal(trace, turns.drive(25))
        assert_same(loop, turns)
        np.testing.assert_array_equal(tally.failures, turns.failures)
        assert tally.steps.max() > 10
        turns.failures[:] = 0.0
        if (ended := ~loop.running).any():
            loop.reset(options={"reset_mask": ended})
            turns.reset(np.flatnonzero(ended))
    given = loop.envs.condition_arrays
    assert given is not None
    assert given[0][:, layout.MISSES].any() == (conditions is SLOW_COMPUTER)


def test_failing_solves_under_conditions_are_those_of_predict() -> None:
    settings = {**CALM, "conditions": "realtime"}
    loop, turns = loop_of(3, settings, max_failures=3), InTurns(3, settings, None, max_failures=3)
    loop.reset(seed=9)
    turns.reset(seed=9)
    for period in range(10):
        if 3 <= period < 8:
            loop.envs.arrays.observations[1, 5] = np.nan
            turns.envs[1].arrays.observations[0, 5] = np.nan
        turns.failures[:] = 0.0
        tally, trace = traced(loop, 1)
        np.testing.assert_array_equal(trace, turns.drive(1))
        np.testing.assert_array_equal(tally.failures, turns.failures)
        assert tally.failures[1] == (3 <= period < 8)


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
@pytest.mark.parametrize("more", [{}, {"slew": 2.0}, {"blend": 0.3, "slew": 5.0}], ids=str)
def test_a_schedule_is_followed_as_predict_does(conditions: str, more: dict[str, Any]) -> None:
    sets = tuple(TrackingWeights(R=(0.01, scale)) for scale in (1.0, 10.0, 100.0, 1000.0))
    schedule = WeightSchedule(CurvatureBands(), sets, **more)
    settings = {**CALM, "conditions": conditions}
    # Stages that reach into 15 of the preview's 20 steps, and are fewer.
    chosen = {"weights": schedule, "stages": (0.05, 0.05, *[0.1] * 5, *[0.15] * 6)}
    loop, turns = loop_of(3, settings, **chosen), InTurns(3, settings, None, **chosen)
    loop.reset(seed=1)
    turns.reset(seed=1)
    for _ in range(3):
        np.testing.assert_array_equal(traced(loop, 20)[1], turns.drive(20))
    used = np.concatenate([agent_memory(agent).weights for agent in turns.agents])
    np.testing.assert_array_equal(loop.memory.nmpc.weights, used)
    assert len(set(used[:, 9])) > 1


def test_tables_with_a_set_for_each_band_are_a_schedule() -> None:
    sets = tuple(TrackingWeights(R=(0.01, scale)) for scale in (1.0, 10.0, 100.0, 1000.0))
    bands = CurvatureBands()
    followed = loop_of(3, CALM, weights=WeightSchedule(bands, sets, slew=3.0))
    envs = environments(3, **CALM)
    given_tables = ClosedLoop(envs, agents.make("lpv-nmpc", envs.single), bands=bands, slew=3.0)
    table = np.array([one.as_array() for one in sets])
    for loop in (followed, given_tables):
        loop.reset(seed=1)
    given = np.tile(table, (3, 1, 1))
    np.testing.assert_array_equal(given_tables.drive(60, given), followed.drive(60))
    np.testing.assert_array_equal(given_tables.memory.nmpc.weights, followed.memory.nmpc.weights)


def test_until_band_stops_where_the_band_changes() -> None:
    envs = environments(5, **CALM, conditions="realtime")
    bands = CurvatureBands()
    stopping = ClosedLoop(envs, agents.make("lpv-nmpc", envs.single), bands=bands)
    whole = loop_of(5, {**CALM, "conditions": "realtime"})
    stopping.reset(seed=3)
    whole.reset(seed=3)
    _, trace = traced(whole, 60)
    driven = np.zeros(5, dtype=np.int64)
    stops = 0
    while (driven < 60).any():
        before = stopping.memory.nmpc.bands.copy()
        tally, piece = traced(stopping, 60, WEIGHTS, until_band=True)
        steps, after = tally.steps.astype(np.int64), stopping.memory.nmpc.bands
        assert steps.min() >= 1
        for row in range(5):
            count = max(min(steps[row], 60 - driven[row]), 0)
            np.testing.assert_array_equal(
                piece[row, :count], trace[row, driven[row] : driven[row] + count]
            )
            # It stopped for another band, in which it will be.
            assert steps[row] == 60 or before[row] == NO_BAND or before[row] != after[row]
        driven += steps
        stops += 1
    assert stops > 1


def test_copies_drive_as_their_originals() -> None:
    settings = {**CALM, "conditions": "realtime"}
    loop = loop_of(6, settings)
    loop.reset(seed=2)
    loop.envs.arrays.observations[1, 5] = np.nan
    loop.drive(15)
    loop.copy([0, 1, 0], [3, 4, 5])
    assert loop.memory.nmpc.fallbacks[4].counts == loop.memory.nmpc.fallbacks[1].counts
    weights = weights_of(2)[[0, 1, 0, 0, 1, 0]]
    tally, trace = traced(loop, 30, weights)
    for original, image in ((0, 3), (1, 4), (0, 5)):
        np.testing.assert_array_equal(trace[image], trace[original])
        assert [values[image] for values in tally] == [values[original] for values in tally]
    loop.copy([1, 1, 1], [4, 1, 5])
    assert {1, 4, 5} <= set(loop.memory.nmpc.fallbacks)
    loop.copy([0], [2])
    _, trace = traced(
        loop, 10, np.array([WEIGHTS, WEIGHTS, 3.0 ** np.arange(12) * WEIGHTS, *weights[3:]])
    )
    assert not np.array_equal(trace[2], trace[0])


# Tally -----------------------------------------------------------------------------------------


def test_tally_is_the_sums_over_the_trace() -> None:
    settings = {**LIVELY, "control_period": 0.1}
    # It believes the steering to be quicker than it is, so that commands are clipped.
    quick = M2_MINIBUS.replace(max_steering_rate=2.0 * M2_MINIBUS.max_steering_rate)
    loop, turns = loop_of(9, settings, model=quick), InTurns(9, settings, None, model=quick)
    loop.reset(seed=8)
    turns.reset(seed=8)
    before = loop.envs.records.copy()
    tally, trace = traced(loop, 25)
    turns.drive(25)
    for i in range(9):
        rows = trace[i][np.isfinite(trace[i, :, 0])]
        steps = np.vstack([before[i], rows])
        change = np.diff(steps[:, [k.ACCELERATION, k.STEERING]], axis=0)
        lateral, heading = rows[:, k.LATERAL_ERROR], rows[:, k.HEADING_ERROR]
        wanted = Tally(
            steps=len(rows), reward=rows[:, k.REWARD].sum(),
            lateral_square=lateral @ lateral, heading_square=heading @ heading,
            speed_square=(rows[:, k.SPEED_ERROR] ** 2).sum(),
            steering_rate_square=((change[:, 1] / 0.1) ** 2).sum(),
            jerk_square=((change[:, 0] / 0.1) ** 2).sum(),
            max_lateral=np.abs(lateral).max(), max_heading=np.abs(heading).max(),
            steering_variation=np.abs(change[:, 1]).sum(), failures=turns.failures[i],
            clipped=np.count_nonzero(rows[:, k.CLIPPED]), iterations=turns.iterations[i],
            solves=len(rows),
        )  # fmt: skip
        found = [values[i] for values in tally]
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-14)
    assert tally.clipped.any()
    assert len(set(tally.steps)) > 1
    # A tally that was handed out is the caller's.
    kept = np.array(tally)
    loop.reset(seed=8)
    loop.drive(3)
    np.testing.assert_array_equal(tally, kept)
