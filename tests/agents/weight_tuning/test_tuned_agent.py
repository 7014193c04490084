"""`lpv-nmpc-tuned`: the compiled loop's own decisions, one `predict` at a time."""

import copy
import dataclasses
import itertools
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import agents
from agents.delay import DelayCompensated
from agents.weight_tuning import policy as policies
from agents.weight_tuning.agent import SHIPPED, TunedNmpc
from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.closed_loop import ClosedLoop
from agents.weight_tuning.decision import Decider
from agents.weight_tuning.features import size
from agents.weight_tuning.loop_kernels import take_in
from agents.weight_tuning.policy import WeightPolicy
from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule
from experiments.run import case as cases
from experiments.run.case import run_case
from lpv_track_env import kernels
from lpv_track_env.conditions import REALTIME
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.vector_env import PathTrackingVectorEnv
from tests.helpers.closed_loops import CALM, LIVELY, InTurns, assert_same, environments, traced
from trajectories import CurvatureBands

Array = NDArray[Any]
NAME = "lpv-nmpc-tuned"
SLOW_COMPUTER = REALTIME.replace(computing_delay=(0.03, 0.09))
SETS = tuple(TrackingWeights(R=(0.01, scale)) for scale in (1.0, 10.0, 100.0, 1000.0))
SCHEDULE = WeightSchedule(CurvatureBands(), SETS, slew=5.0)
LAYOUT = ObservationLayout()


def policy_of(
    choice: WeightChoice | None = None, *, gain: float = 0.5, seed: int = 0, **more: Any
) -> WeightPolicy:
    """A network of random weights, which decides otherwise in every window."""
    choice = WeightChoice(window=0.2) if choice is None else choice
    rng, widths = np.random.default_rng(seed), (size(len(choice.bands)), 16, choice.entries)
    layers = tuple(
        (rng.normal(0.0, gain, (out, into)).astype(np.float32), np.zeros(out, dtype=np.float32))
        for into, out in itertools.pairwise(widths)
    )
    return WeightPolicy(choice, layers, **{"layout": LAYOUT, **more})


CATALOGUE = policy_of(WeightChoice(catalogue=SETS, window=0.2), gain=2.0, seed=1)
POLICIES = {
    "joint": policy_of(),
    "all": policy_of(WeightChoice(SCHEDULE, directions="all", span=5.0)),
    "catalogue": CATALOGUE,
}


def loop_of(n: int, settings: dict[str, Any], policy: WeightPolicy, **more: Any) -> ClosedLoop:
    envs = environments(n, **settings)
    decider = Decider(policy.choice, policy.layers, envs.single.control_period)
    return ClosedLoop(envs, agents.make("lpv-nmpc", envs.single, **more), decider=decider)


# Equality ------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)
@pytest.mark.parametrize(
    "conditions", ["simulation", "realtime", SLOW_COMPUTER], ids=["sim", "real", "slow"]
)
def test_is_the_compiled_loop(conditions: Any, policy: WeightPolicy) -> None:
    """Through ends, resets of some, and periods in which the computer was busy."""
    settings = {**LIVELY, "conditions": conditions, "max_lateral_error": 1.5}
    loop, turns = loop_of(5, settings, policy), InTurns(5, settings, None, NAME, weights=policy)
    loop.reset(seed=5)
    turns.reset(seed=5)
    used = []
    for _ in range(3):
        tally, trace = traced(loop, 15)
        np.testing.assert_array_equal(trace, turns.drive(15))
        assert_same(loop, turns)
        memories = [agent._memory for agent in turns.agents]
        for name in ("history", "tables"):
            found = np.concatenate([getattr(memory, name) for memory in memories])
            np.testing.assert_array_equal(getattr(loop.memory, name), found, err_msg=name)
        for name in ("weights", "bands"):
            found = np.concatenate([getattr(memory.nmpc, name) for memory in memories])
            np.testing.assert_array_equal(getattr(loop.memory.nmpc, name), found, err_msg=name)
        used.append(loop.memory.nmpc.weights.copy())
        assert tally.steps.any()
        # One ended, perhaps, and one in the middle of its drive.
        again = ~loop.running | (np.arange(5) == 2)
        loop.reset(options={"reset_mask": again})
        turns.reset(np.flatnonzero(again))
    assert len(np.unique(np.concatenate(used), axis=0)) > (2 if policy is CATALOGUE else 5)
    # One compiled form at most for the loop and the agent: none, where both were on disk.
    assert len(take_in.signatures) <= 1  # type: ignore[attr-defined]


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
def test_failing_solves_are_those_of_the_compiled_loop(conditions: str) -> None:
    settings, policy = {**CALM, "conditions": conditions}, POLICIES["joint"]
    loop = loop_of(3, settings, policy, max_failures=3)
    turns = InTurns(3, settings, None, NAME, weights=policy, max_failures=3)
    loop.reset(seed=9)
    turns.reset(seed=9)
    fallbacks = []
    for period in range(14):
        # Row 1 from the start on, row 2 once it has a plan.
        for row, first in ((1, 0), (2, 4)):
            if first <= period < 10:
                loop.envs.arrays.observations[row, 5] = np.nan
                turns.envs[row].arrays.observations[0, 5] = np.nan
        turns.failures[:] = 0.0
        tally, trace = traced(loop, 1)
        np.testing.assert_array_equal(trace, turns.drive(1))
        np.testing.assert_array_equal(tally.failures, turns.failures)
        fallbacks.append(turns.fallbacks.copy())
    assert [row[1] for row in fallbacks] == ["stanley"] * 3 + ["stop"] * 7 + [""] * 4
    assert [row[2] for row in fallbacks] == [""] * 4 + ["plan"] * 3 + ["stop"] * 3 + [""] * 4
    for row in (1, 2):
        memory = turns.agents[row]._memory
        assert loop.memory.nmpc.fallbacks[row].counts == memory.nmpc.fallbacks[0].counts


def test_a_batch_whose_rows_begin_and_fail_on_their_own_is_the_compiled_loop() -> None:
    """One agent for all, `episode_start` in place of resets; its memory is the loop's."""
    settings, policy = {**CALM, "conditions": "realtime"}, POLICIES["joint"]
    loop, envs = loop_of(4, settings, policy), environments(4, **settings)
    agent = agents.make(NAME, envs.single, weights=policy)
    loop.reset(seed=3)
    envs.reset(seed=3)
    memory, starts = None, np.ones(4, dtype=np.bool_)
    for period in range(30):
        if period in {6, 7, 29}:
            loop.envs.arrays.observations[period % 4, 5] = np.nan
            envs.arrays.observations[period % 4, 5] = np.nan
        loop.drive(1)
        actions, memory = agent.predict(envs.arrays.observations.copy(), memory, starts)
        envs.step(actions)
        np.testing.assert_array_equal(envs.records, loop.envs.records)
        starts = np.arange(4) == period % 9
        options = {"reset_mask": starts}
        if starts.any():
            loop.reset(options=options)
            envs.reset(options=options)
    assert sorted(memory.nmpc.fallbacks) == sorted(loop.memory.nmpc.fallbacks) != []


@pytest.mark.parametrize("conditions", ["simulation", SLOW_COMPUTER], ids=["sim", "slow"])
@pytest.mark.parametrize("weights", [SCHEDULE, SETS[2]], ids=["schedule", "set"])
def test_with_a_schedule_or_a_set_it_is_lpv_nmpc(conditions: Any, weights: Any) -> None:
    settings = {**LIVELY, "conditions": conditions, "max_lateral_error": 1.5}
    plain = InTurns(4, settings, None, weights=weights)
    tuned = InTurns(4, settings, None, NAME, weights=weights)
    for turns in (plain, tuned):
        turns.reset(seed=5)
    for period in range(3):
        for turns in (plain, tuned):
            turns.envs[period].arrays.observations[0, 3] = np.inf
        np.testing.assert_array_equal(tuned.drive(15), plain.drive(15))
        ended = [i for i, env in enumerate(plain.envs) if env.arrays.ends[0] != 0]
        for turns in (plain, tuned):
            turns.reset(ended)


@pytest.mark.parametrize("compensated", [None, False, True])
@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
def test_delays_are_compensated_as_make_is_told(conditions: str, compensated: bool | None) -> None:
    settings, policy = {**CALM, "conditions": conditions}, POLICIES["joint"]
    more = {"delay_compensation": compensated}
    loop = loop_of(2, settings, policy, **more)
    turns = InTurns(2, settings, None, NAME, weights=policy, **more)
    agent = turns.agents[0]
    assert isinstance(agent, TunedNmpc)
    wanted = conditions == "realtime" if compensated is None else compensated
    assert (agent.future is not None) == wanted
    loop.reset(seed=1)
    turns.reset(seed=1)
    np.testing.assert_array_equal(traced(loop, 20)[1], turns.drive(20))


# The rest of an agent ------------------------------------------------------------------------


def drive(agent: Any, env: PathTrackingVectorEnv, periods: int, memory: Any = None) -> Array:
    """Actions of some periods, (periods, n, 2)."""
    actions = []
    for _ in range(periods):
        action, memory = agent.predict(env.arrays.observations.copy(), memory)
        actions.append(action)
        env.step(action)
    return np.array(actions)


def test_copies_go_on_alike() -> None:
    envs = [environments(2, **CALM, conditions="realtime") for _ in range(3)]
    agent = agents.make(NAME, envs[0].single, weights=POLICIES["joint"])
    for env in envs:
        env.reset(seed=4)
    envs[0].arrays.observations[1, 5] = np.nan
    first = drive(agent, envs[0], 10)
    copies = [copy.deepcopy(agent), pickle.loads(pickle.dumps(agent))]  # noqa: S301
    for env in envs[1:]:
        for actions in first:
            env.step(actions)
    wanted = drive(agent, envs[0], 15)
    for one, env in zip(copies, envs[1:], strict=True):
        np.testing.assert_array_equal(drive(one, env, 15), wanted)


def test_reset_forgets_and_a_memory_is_its_holders() -> None:
    env = environments(1, **CALM, conditions="realtime")
    observation = env.reset(seed=0)[0]
    agent = agents.make(NAME, env.single, weights=POLICIES["joint"])
    fresh, memory = agent.predict(observation)
    drive(agent, env, 8)
    later = env.arrays.observations.copy()
    kept = agent.predict(later)[0]
    agent.reset()
    np.testing.assert_array_equal(agent.predict(observation)[0], fresh)
    # Held by the caller, it went on as the agent's own.
    assert len(memory) == 1
    again, _ = agent.predict(observation, memory, np.array([True]))
    np.testing.assert_array_equal(again, fresh)
    assert not np.array_equal(agent.predict(later)[0], kept)
    assert memory[-1].row == 0
    with pytest.raises(IndexError, match="row 1 of 1"):
        memory[1]


def test_holding_lets_a_period_pass() -> None:
    env = environments(1, **CALM, conditions="realtime")
    observation = env.reset(seed=0)[0]
    agent: Any = agents.make(NAME, env.single, weights=POLICIES["joint"])
    agent.hold()  # nothing has begun: nothing to do
    action, memory = agent.predict(observation)
    agent.hold()
    np.testing.assert_array_equal(memory.commands[0, :2], [action[0], action[0]])
    # Four periods to a window: with those that were held it is over after one more.
    for _ in range(2):
        agent.hold(memory)
    agent.predict(observation)
    assert memory.history[0, 2] == 1.0


def test_what_it_tells() -> None:
    env = PathTrackingEnv("T2", conditions="realtime")
    observation, _ = env.reset(seed=0)
    agent: Any = agents.make(NAME, env, weights=POLICIES["joint"])
    plain: Any = agents.make("lpv-nmpc", env)
    _, memory = agent.predict(observation)
    told = agent.diagnostics(memory[0])
    assert plain.set_weights(told["weights"])
    reference = plain.diagnostics(plain.predict(observation)[1][0])
    np.testing.assert_array_equal(told["plan"], reference["plan"])
    for name in ("status", "iterations", "cost", "fallback"):
        assert told[name] == reference[name]
    assert (told["band"], told["rejected"]) == (0, 0)
    assert told["seconds"] > 0.0
    base = TrackingWeights().as_array()
    assert not np.array_equal(told["weights"][:8], base[:8])
    np.testing.assert_array_equal(told["weights"][8:], base[8:])


def test_decisions_beyond_all_numbers_are_rejected_and_counted() -> None:
    """What was in use stays, and the drive goes on; wild ones are brought within the bounds."""
    env = environments(2, **CALM)
    wild = policy_of(WeightChoice(SCHEDULE, directions="all", span=1e4, window=0.2), gain=1e6)
    inputs, entries = size(len(wild.choice.bands)), wild.choice.entries
    largest = np.finfo(np.float32).max
    # Twice the largest number in every band.
    weight = np.zeros((entries, inputs), dtype=np.float32)
    weight[:, -len(wild.choice.bands) :] = largest
    beyond = dataclasses.replace(wild, layers=((weight, np.full(entries, largest)),))
    for policy, rejected in ((wild, 0), (beyond, 10)):
        env.reset(seed=0)
        agent: Any = agents.make(NAME, env.single, weights=policy)
        assert np.isfinite(drive(agent, env, 40)).all()
        for row in range(2):
            told = agent.diagnostics(agent._memory[row])
            # Of windows of four periods, one at least; of another band, another.
            assert told["rejected"] >= rejected
            assert (told["rejected"] > 0) == (rejected > 0)
            assert ((told["weights"] >= LOWEST) & (told["weights"] <= HIGHEST)).all()
            base = SETS[told["band"]].as_array()
            assert np.array_equal(told["weights"][:8], base[:8]) == (policy is beyond)


def test_numbers_beyond_float32_saturate() -> None:
    env = PathTrackingEnv("T2")
    observation, _ = env.reset(seed=0)
    agent: Any = agents.make(NAME, env, weights=POLICIES["joint"])
    wide = observation.astype(np.float64)
    wide[5] = 1e200
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        action, memory = agent.predict(wide)
    assert env.action_space.contains(action)
    assert agent.diagnostics(memory[0])["status"] == "SUCCESS"


# What is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"layout": ObservationLayout(30, 0.1)},
         r"sees preview_steps=30, preview_period=0.1 s; this environment has 20 and 0.1: make"),
        ({"control_period": 0.02},
         r"acts every 0.02 s, this environment every 0.05: make .* control_period=0.02"),
    ],
)  # fmt: skip
def test_a_policy_for_other_tasks_is_refused(made: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        agents.make(NAME, PathTrackingEnv("T2"), weights=policy_of(**made))


def test_a_policy_for_another_vehicle_is_warned_of() -> None:
    policy = policy_of(training={"vehicle": "course-car"})
    with pytest.warns(UserWarning, match="trained for vehicle 'course-car', not for 'm2-minibus'"):
        agents.make(NAME, PathTrackingEnv("T2"), weights=policy)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agents.make(NAME, PathTrackingEnv("T2", vehicle="course-car"), weights=policy)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({}, "schedule of weights search was tuned for vehicle 'm2-minibus', not for 'bmw-320i'"),
        (
            {"weights": "paired"},
            "policy of weights paired was trained for vehicle 'm2-minibus', not for 'bmw-320i'",
        ),
    ],
    ids=["fixed set", "policy"],
)
def test_shipped_weights_on_another_vehicle_are_told_in_the_result(
    settings: dict[str, str], said: str
) -> None:
    spec = {"agent": NAME, "trajectory": "u-turn", "agent_settings": settings,
            "env_settings": {"time_limit": 1.0}}  # fmt: skip
    assert run_case({**spec, "vehicle": "bmw-320i"})["warnings"] == [said]
    assert run_case(spec)["warnings"] == []


def test_files_of_weights(tmp_path: Path) -> None:
    env = environments(1, **CALM)
    env.reset(seed=0)
    file = tmp_path / "schedule.json"
    SCHEDULE.write(file)
    given, read = (
        agents.make(NAME, env.single, weights=weights) for weights in (SCHEDULE, str(file))
    )
    observation = env.arrays.observations.copy()
    np.testing.assert_array_equal(given.predict(observation)[0], read.predict(observation)[0])
    policies.write(POLICIES["joint"], tmp_path / "policy.json")
    given, read = (
        agents.make(NAME, env.single, weights=weights)
        for weights in (POLICIES["joint"], tmp_path / "policy.json")
    )
    assert read.predict(observation)[0].tolist() == given.predict(observation)[0].tolist()
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match=r"other.json"):
        agents.make(NAME, env.single, weights=tmp_path / "other.json")
    with pytest.raises(ValueError, match=r"weights .*none.json: no such file; give weights="):
        agents.make(NAME, env.single, weights=tmp_path / "none.json")
    with pytest.raises(ValueError, match="not list"):
        agents.make(NAME, env.single, weights=[1.0] * 12)
    with pytest.raises(ValueError, match=r"has no setting 'wheights'.*nearest: weights"):
        agents.make(NAME, env.single, wheights=SCHEDULE)


def test_make_wraps_nothing_around_it() -> None:
    env = PathTrackingEnv("T2", conditions="realtime")
    agent = agents.make(NAME, env, weights=SCHEDULE, delay_compensation=True)
    assert not isinstance(agent, DelayCompensated)
    with pytest.raises(ValueError, match="make the agent for this environment"):
        agent.predict(np.zeros(12, dtype=np.float32))


# As shipped ----------------------------------------------------------------------------------


def test_shipped_weights_are_what_their_commands_say() -> None:
    methods = {}
    for name, file in SHIPPED.items():
        result = policies.load(file)
        given = result.training if isinstance(result, WeightPolicy) else result.provenance
        assert given["settings"]["method"] == name
        assert f"--method {name}" in given["command"]
        assert not given["revision"]["modified"]
        methods[name] = type(result)
    assert methods == {"search": WeightSchedule, "paired": WeightPolicy}


@pytest.mark.parametrize("conditions", ["simulation", "realtime", "randomised"])
def test_the_shipped_policy_adapts_and_drives(conditions: str) -> None:
    policy = policies.load(SHIPPED["paired"])
    assert isinstance(policy, WeightPolicy)
    loop = loop_of(4, {"trajectory": "T2", "conditions": conditions}, policy)
    loop.reset(seed=3)
    used = []
    while loop.running.any():
        loop.drive(8)
        used.append(loop.memory.nmpc.weights.copy())
    assert (loop.envs.arrays.ends == kernels.FINISHED).all()
    # Position is worth less where fixes are bad than where all is known.
    assert np.ptp(np.log([row[:, 2] for row in used])) > 0.5
    assert np.mean([row[:, 2] for row in used]) < TrackingWeights().as_array()[2]


def test_shipped_weights_belong_to_a_case(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cases, "CHECKPOINTS", tmp_path)
    case = cases.Case(NAME, "T2", agent_settings={"weights": "paired"})
    without = case.id
    (tmp_path / SHIPPED["paired"].name).write_text("{}")
    assert case.id != without
    assert case.id == cases.Case(NAME, "T2", agent_settings={"weights": "paired"}).id
