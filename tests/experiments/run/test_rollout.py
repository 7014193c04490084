"""One case end to end on a short path, and what goes wrong in a case."""

import json
import sys
import types

import gymnasium
import numpy as np
import pytest

from agents import TrackingAgent, make
from experiments.run import case as cases
from experiments.run import metrics
from experiments.run.case import Case, run_case
from experiments.run.rollout import rollout

SHORT = {"agent": "stanley", "trajectory": "u-turn"}


@pytest.fixture(scope="module")
def driven():
    return run_case(SHORT)


def test_a_case_comes_to_a_result(driven):
    assert driven["status"] == "ok"
    assert driven["end"] == "finished"
    assert driven["metrics"]["ale"] < 0.05
    assert driven["metrics"]["completed"] == 1.0
    assert {"median", "p99", "max", "failures"} <= set(driven["solver"])
    assert driven["solver"]["solves"] == 0
    assert driven["solver"]["slack"] is None
    assert driven["seconds"] > 0
    without = {key: value for key, value in driven.items() if key != "trace"}
    assert json.loads(json.dumps(without, allow_nan=False)) == without


def test_a_result_carries_its_whole_case(driven):
    case = Case(**SHORT)
    assert driven["id"] == case.id
    assert {key: driven[key] for key in case.as_dict()} == case.as_dict()


def test_the_same_case_twice_is_the_same_bit_for_bit_but_for_times(driven):
    again = run_case(SHORT)
    assert again["id"] == driven["id"]
    assert again["metrics"] == driven["metrics"]
    for name, values in driven["trace"].items():
        if name != "solve_time":
            assert np.array_equal(values, again["trace"][name]), name


def test_randomness_comes_from_the_seed_alone():
    spec = {**SHORT, "env_settings": {"initial_error_range": [0.3, 0.05, 0.5]}}
    first, same, other = (run_case({**spec, "seed": seed}) for seed in (1, 1, 2))
    assert first["metrics"] == same["metrics"]
    assert first["metrics"] != other["metrics"]


def test_lengths_of_a_trace_agree_and_it_begins_at_the_start(driven):
    trace = driven["trace"]
    n = len(trace["time"])
    assert trace["state"].shape == (n, 6)
    assert {len(values) for values in trace.values()} == {n}
    assert trace["time"] == pytest.approx(0.05 * np.arange(n))
    assert trace["arc_length"][0] == pytest.approx(0.0, abs=1e-9)
    assert trace["solve_time"][0] == trace["reward"][0] == 0.0
    assert (trace["solve_time"][1:] > 0).all()
    assert driven["metrics"]["duration"] == pytest.approx(0.05 * (n - 1))


def test_the_trace_holds_the_end_of_each_period():
    env = Case(**SHORT).make_env()
    told = []
    done = rollout(env, make("stanley", env), on_step=lambda k, info: told.append((k, info)))
    assert [k for k, _ in told] == list(range(1, len(done.trace.time)))
    assert done.trace.state[1:] == pytest.approx(np.array([info["state"] for _, info in told]))
    errors = [info["lateral_error"] for _, info in told]
    assert done.trace.lateral_error[1:] == pytest.approx(errors)
    assert told[-1][1]["end"] == done.end


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 1},
        {"agent": "pid"},
        {"trajectory": "circle"},
        {"vehicle": "course-car"},
        {"speed_mode": "fixed"},
        {"control_period": 0.04},
        {"agent_settings": {"gain": 2.0}},
        {"env_settings": {"max_lateral_error": 4.0}},
        {"vehicle_changes": {"mass": 3000.0}},
    ],
)
def test_the_id_changes_with_everything_in_the_case(change):
    assert Case(**{**SHORT, **change}).id != Case(**SHORT).id


def test_the_id_does_not_depend_on_the_order_of_settings():
    one = Case(**SHORT, env_settings={"preview_steps": 9, "max_lateral_error": 4.0})
    other = Case(**SHORT, env_settings={"max_lateral_error": 4.0, "preview_steps": 9})
    assert one.id == other.id


def test_the_id_changes_with_the_sources(monkeypatch):
    before = Case(**SHORT).id
    monkeypatch.setattr(cases, "project_digest", lambda: "another revision")
    assert Case(**SHORT).id != before


def test_settings_reach_the_agent_the_vehicle_and_the_environment():
    spec = {
        **SHORT,
        "agent_settings": {"gain": 2.0},
        "vehicle_changes": {"mass": 3000.0, "speed_range": [1.0, 20.0]},
        "env_settings": {"max_lateral_error": 4.0},
    }
    case = Case(**spec)
    env = case.make_env()
    inner = env.unwrapped
    assert case.make_agent(env).gain == 2.0
    assert (inner.vehicle.mass, inner.vehicle.speed_range) == (3000.0, (1.0, 20.0))
    assert inner.task.max_lateral_error == 4.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"agent": "nosuch:Thing"}, "nosuch"),
        ({"agent": "stanly"}, "nearest: stanley"),
        ({"trajectory": "u-trun"}, "nearest: u-turn"),
        ({"vehicle": "lorry"}, "unknown vehicle"),
        ({"agent_settings": {"gian": 1.0}}, "gian"),
        ({"vehicle_changes": {"mass": -1.0}}, "mass"),
        ({"env_settings": {"max_error": 1.0}}, "max_error"),
        ({"start": {"speed": -1.0}}, "start at -1 m/s"),
    ],
)
def test_a_case_that_cannot_be_run_is_a_failed_result_with_its_error(change, message):
    result = run_case({**SHORT, **change})
    assert result["status"] == "failed"
    assert message in result["error"]
    assert result["end"] is None
    assert result["metrics"] == result["solver"] == result["trace"] == {}
    json.dumps(result, allow_nan=False)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"arc": 3.0}, r"unknown reset option 'arc'; .*nearest: arc_length"),
        ({"trajectory": "T1"}, "unknown reset option 'trajectory'"),
        ({"arc_length": 1e4}, "arc_length must be >= 0 and at most 117"),
        ({"speed_error": -9.0}, "start at -6 m/s, vehicle 'm2-minibus' .* give at least -3"),
        ({"speed": 0.0, "speed_error": 0.0}, "give one of them"),
        ({"lateral_error": "left"}, "lateral_error must be in"),
        ("here", "options must be a dictionary"),
    ],
)
def test_a_start_is_checked_before_anything_is_driven(start, message):
    with pytest.raises(ValueError, match=message):
        Case(agent="stanley", trajectory="u-turn", start=start).check()


def test_a_case_starts_where_it_says():
    start = {"arc_length": 45.0, "lateral_error": 1.0, "heading_error": 0.1, "speed": 0.0}
    spec = {"agent": "stanley", "trajectory": "u-turn"}
    Case(**spec, start=start).check()
    result = run_case({**spec, "start": start})
    assert (result["status"], result["end"], result["start"]) == ("ok", "finished", start)
    trace = result["trace"]
    assert trace["state"][0, :2] == pytest.approx([0.0, 0.0])
    assert trace["arc_length"][0] == pytest.approx(45.0, abs=1e-5)
    assert trace["lateral_error"][0] == pytest.approx(1.0)
    # The path's heading is that at the foot point, at a curvature of 0.1 1/m.
    assert trace["heading_error"][0] == pytest.approx(0.1, abs=0.1 * 1e-5)
    assert Case(**spec, start=start).id != Case(**spec).id


class Recorder(TrackingAgent):
    """Drives straight on and keeps what `predict` was given."""

    def __init__(self, task):
        super().__init__(task)
        self.calls = []

    def new_memory(self):
        return {}

    def control(self, _observation, _memory):
        return 0.2, 0.0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls.append((state, episode_start.copy(), deterministic))
        return super().predict(observation, state, episode_start, deterministic)


class Breaks(Recorder):
    def control(self, _observation, _memory):
        if len(self.calls) == 5:
            raise ZeroDivisionError("in the fifth step")
        return 0.2, 0.0


@pytest.fixture
def own_agents(monkeypatch):
    module = types.ModuleType("own_agents")
    module.Recorder, module.Breaks = Recorder, Breaks
    monkeypatch.setitem(sys.modules, "own_agents", module)


def test_episode_start_is_passed_at_the_start_only_and_memory_from_step_to_step():
    env = Case(**SHORT).make_env()
    agent = make("stanley", env)
    recorder = Recorder(agent.task)
    done = rollout(env, recorder)
    assert done.end == "left_corridor"  # straight on, where the path bends
    states, starts, deterministic = zip(*recorder.calls, strict=True)
    assert starts[0].tolist() == [True]
    assert not any(start.any() for start in starts[1:])
    assert states[0] is None
    assert all(state is states[1] or state == states[1] for state in states[1:])
    assert all(deterministic)


def test_users_own_agents_run_and_their_exceptions_end_the_case_alone(own_agents):
    spec = {"trajectory": "straight"}
    assert run_case({**spec, "agent": "own_agents:Recorder"})["status"] == "ok"
    broken = run_case({**spec, "agent": "own_agents:Breaks"})
    assert broken["status"] == "failed"
    assert broken["error"] == "ZeroDivisionError: in the fifth step"


def test_metrics_that_are_not_finite_fail_the_case(monkeypatch):
    """A line with NaN could not be written, and would end the sweep."""
    broken = (*metrics.METRICS, lambda *_: {"mine": float("nan")})
    monkeypatch.setattr(metrics, "METRICS", broken)
    result = run_case(SHORT)
    assert result["status"] == "failed"
    assert result["error"] == "ValueError: metrics not finite: mine"


def test_reset_options_reach_the_environment():
    env = Case(**SHORT).make_env()
    assert isinstance(env, gymnasium.Env)
    done = rollout(env, make("stanley", env), options={"lateral_error": 0.4})
    assert done.trace.lateral_error[0] == pytest.approx(0.4)
    assert np.abs(done.trace.lateral_error[-1]) < 0.05


def test_a_case_takes_reward_weights_as_plain_values() -> None:
    spec = {"agent": "stanley", "trajectory": "u-turn"}
    usual = run_case(spec)
    weighted = run_case({**spec, "env_settings": {"reward_weights": {"lateral_scale": 0.01}}})
    assert weighted["metrics"]["ale"] == usual["metrics"]["ale"]
    assert weighted["metrics"]["reward"] < usual["metrics"]["reward"]
    assert weighted["id"] != usual["id"]
    with pytest.raises(ValueError, match="lateral"):
        Case(**spec, env_settings={"reward_weights": {"laterall": 1.0}}).check()
