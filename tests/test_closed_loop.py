"""Closed loops in compiled code against `predict` and `step` in turns, bit for bit."""

from typing import Any

import gymnasium
import numba
import numpy as np
import pytest
from nmpc_situations import WEIGHTS
from numpy.typing import NDArray

import agents
from agents.nmpc.closed_loop import ClosedLoop, Tally, drive_rows
from agents.nmpc.rti_agent import RtiNmpc
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env import kernels as k
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import M2_MINIBUS
from trajectories import CurvatureBands

Array = NDArray[Any]

# Two paths, two vehicles; some end within seconds, by the corridor or by time.
LIVELY: dict[str, Any] = {
    "trajectory": ["figure-eight", "T1"],
    "vehicle": ["m2-minibus", "course-car"],
    "initial_error_range": (0.6, 0.2, 2.0),
    "random_start": True,
    "max_lateral_error": 0.65,
    "time_limit": 1.8,
}
# None of these ends within the tests.
CALM: dict[str, Any] = {**LIVELY, "max_lateral_error": 5.0, "time_limit": 60.0}


def environments(n: int, **settings: Any) -> PathTrackingVectorEnv:
    return PathTrackingVectorEnv(n, **{"autoreset_mode": "Disabled", **settings})


def loop_of(n: int, settings: dict[str, Any], *, threads: int = 1, **more: Any) -> ClosedLoop:
    envs = environments(n, **settings)
    return ClosedLoop(envs, agents.make("lpv-nmpc", envs.single, **more), threads=threads)


def weights_of(n: int) -> Array:
    """A set for each environment."""
    return WEIGHTS * 10.0 ** np.random.default_rng(0).uniform(-0.7, 0.7, (n, 10))


class InTurns:
    """n environments of one each, with an agent each: `predict`, then `step`, in Python."""

    def __init__(self, n: int, settings: dict[str, Any], sets: Array | None, **more: Any) -> None:
        self.envs = [environments(1, **settings) for _ in range(n)]
        self.agents: list[RtiNmpc] = []
        for i, env in enumerate(self.envs):
            agent = agents.make("lpv-nmpc", env.single, **more)
            assert isinstance(agent, RtiNmpc)
            assert sets is None or agent.set_weights(sets[i])
            self.agents.append(agent)
        self.failures, self.iterations = np.zeros(n), np.zeros(n)
        self.fallbacks: list[str] = [""] * n

    def reset(self, rows: Any = None, *, seed: int | None = None, **options: Any) -> None:
        for i in range(len(self.envs)) if rows is None else rows:
            self.envs[i].reset(seed=None if seed is None else seed + i, options=options)
            self.agents[i].reset()

    def drive(self, periods: int) -> Array:
        """Memories after each period, (n, periods, MEMORY_SIZE); NaN where the episode is over."""
        trace = np.full((len(self.envs), periods, k.MEMORY_SIZE), np.nan)
        for i, (env, agent) in enumerate(zip(self.envs, self.agents, strict=True)):
            for period in range(periods):
                if env.arrays.ends[0] != k.RUNNING:
                    break
                # A copy: tests put what they like in place of what is seen.
                actions, memory = agent.predict(env.arrays.observations.copy())
                told = agent.diagnostics(memory[0])
                self.failures[i] += told["status"] != "SUCCESS"
                self.iterations[i] += told["iterations"]
                self.fallbacks[i] = told["fallback"]
                env.step(actions)
                trace[i, period] = env.memories[0]
        return trace


def assert_same(loop: ClosedLoop, turns: InTurns) -> None:
    for i, env in enumerate(turns.envs):
        np.testing.assert_array_equal(loop.envs.memories[i], env.memories[0])
        np.testing.assert_array_equal(loop.envs.arrays.observations[i], env.arrays.observations[0])
        assert loop.envs.arrays.ends[i] == env.arrays.ends[0]


def traced(loop: ClosedLoop, periods: int, weights: Any = None) -> tuple[Tally, Array]:
    trace = np.full((loop.envs.num_envs, periods, k.MEMORY_SIZE), np.nan)
    return loop.drive(periods, weights, trace=trace), trace


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
        actions, memory = mixed.agent.predict(mixed.envs.arrays.observations.copy(), mixed.memory)
        assert memory is mixed.memory
        mixed.envs.step(actions)
    mixed.drive(4)
    np.testing.assert_array_equal(mixed.envs.memories, whole.envs.memories)


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


# What is told --------------------------------------------------------------------------------


def test_tally_is_the_sums_over_the_trace() -> None:
    settings = {**LIVELY, "control_period": 0.1}
    # It believes the steering to be quicker than it is, so that commands are clipped.
    quick = M2_MINIBUS.replace(max_steering_rate=2.0 * M2_MINIBUS.max_steering_rate)
    loop, turns = loop_of(9, settings, model=quick), InTurns(9, settings, None, model=quick)
    loop.reset(seed=8)
    turns.reset(seed=8)
    before = loop.envs.memories.copy()
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


# Failing solves ------------------------------------------------------------------------------


@pytest.mark.parametrize(("entry", "value"), [(5, np.nan), (0, np.inf), (2, 1e20)])
def test_failing_solves_go_down_the_ladder_as_in_predict(entry: int, value: float) -> None:
    """Not finite, or finite and beyond solving: plan, then a stop; Stanley without a plan."""
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
        assert loop.memory.ladders[row].counts == memory.ladders[0].counts


def test_diagnostics_after_a_drive_are_those_of_its_last_period() -> None:
    loop = loop_of(2, CALM, max_failures=3)
    loop.reset(seed=9)
    loop.envs.arrays.observations[1, 5] = np.nan
    loop.drive(1)
    told = [loop.agent.diagnostics(loop.memory[row]) for row in range(2)]
    assert [(t["status"], t["fallback"]) for t in told] == [("SUCCESS", ""), ("NAN", "stanley")]
    loop.drive(1)
    told = [loop.agent.diagnostics(loop.memory[row]) for row in range(2)]
    assert [(t["status"], t["fallback"]) for t in told] == [("SUCCESS", "")] * 2


def test_failures_in_the_middle_of_a_call() -> None:
    """Solves that fail while others go on, many in one call: none is lost, none counted twice."""
    # A corridor this wide lets vehicles drift to where weights like these cannot be solved for.
    settings = {
        **CALM, "max_lateral_error": 300.0, "initial_error_range": (30.0, 1.5, 10.0),
        "preview_steps": 50,
    }  # fmt: skip
    weights = WEIGHTS * 10.0 ** np.random.default_rng(1).uniform(-3, 3, (17, 10))
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
    with pytest.raises(ValueError, match=rf"threads must be from 1 to \d+, not {threads}"):
        loop_of(2, CALM, threads=threads)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones(9), r"weights must be \(10,\) or \(3, 10\), not \(9,\)"),
        (np.ones((2, 10)), r"not \(2, 10\)"),
        (np.ones((3, 10, 1)), r"not \(3, 10, 1\)"),
        (1.0, r"not \(\)"),
        ([WEIGHTS, WEIGHTS * np.nan, WEIGHTS], "weights of environment 1 must be finite"),
        ([WEIGHTS, WEIGHTS, -WEIGHTS], "weights of environment 2 must be finite and >= 0"),
        (WEIGHTS * np.inf, "weights of environment 0 must be finite"),
    ],
)
def test_bad_weights_are_refused_and_nothing_moves(weights: Any, message: str) -> None:
    loop = loop_of(3, CALM)
    loop.reset(seed=0)
    before = loop.envs.memories.copy()
    with pytest.raises(ValueError, match=message):
        loop.drive(5, weights)
    np.testing.assert_array_equal(loop.envs.memories, before)


@pytest.mark.parametrize("shape", [(3, 4, k.MEMORY_SIZE), (2, 5, k.MEMORY_SIZE), (3, 5), (3, 5, 6)])
def test_a_trace_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    loop = loop_of(3, CALM)
    loop.reset(seed=0)
    with pytest.raises(ValueError, match=r"trace must have shape \(3, 5, 24\)"):
        loop.drive(5, trace=np.zeros(shape))


def test_a_drive_before_the_first_reset_is_refused() -> None:
    """As the environments' own step is: there is no episode to drive."""
    loop = loop_of(2, CALM)
    with pytest.raises(gymnasium.error.ResetNeeded):
        loop.drive(3)


def test_a_schedule_is_followed_or_refused() -> None:
    """An agent that chooses weights by curvature must not be driven with others in silence."""
    sets = tuple(TrackingWeights(R=(0.01, scale)) for scale in (1.0, 10.0, 100.0, 1000.0))
    schedule = WeightSchedule(CurvatureBands(), sets)
    turns = InTurns(3, CALM, None, weights=schedule)
    turns.reset(seed=1)
    try:
        loop = loop_of(3, CALM, weights=schedule)
        loop.reset(seed=1)
        trace = traced(loop, 10)[1]
    except ValueError as error:
        assert "schedule" in str(error)  # noqa: PT017
    else:
        np.testing.assert_array_equal(trace, turns.drive(10))
