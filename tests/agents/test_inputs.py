"""Inputs of `predict`: absurd numbers, wrong types, memories of others, and NaN in return."""

import functools
import warnings
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import agents
from agents.base import TrackingAgent, blind_control, stopping_acceleration
from agents.inputs import observation_rows
from experiments.run.rollout import NOT_FINITE, rollout
from lpv_track_env import PATH_TRACKING

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in agents.names()},
    "paired": ("lpv-nmpc-tuned", {"weights": "paired"}),
}
each_agent = pytest.mark.parametrize("name", list(VARIANTS))
ABSURD = (1e154, -1e154, 1e300, -1e300, 3.4e38, -3.4e38, 1e20, -1e4)


@functools.cache
def environment(conditions: str = "simulation") -> Any:
    return gymnasium.make(PATH_TRACKING, trajectory="u-turn", conditions=conditions)


@functools.cache
def made(name: str, conditions: str = "simulation") -> Any:
    agent, settings = VARIANTS[name]
    return agents.make(agent, environment(conditions), **settings)


@functools.cache
def good_rows() -> Any:
    """Observations of a few seconds' drive, (60, size)."""
    env, agent = environment(), made("stanley")
    observation, _ = env.reset(seed=0, options={"lateral_error": 0.3})
    rows = []
    for _ in range(60):
        rows.append(observation)
        observation = env.step(agent.predict(observation)[0])[0]
    return np.array(rows)


@each_agent
@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
def test_absurd_numbers_of_one_row_change_no_other(name: str, conditions: str) -> None:
    agent, rows = made(name, conditions), good_rows().astype(np.float64)
    rng = np.random.default_rng(0)
    space, entries = environment(conditions).action_space, rows.shape[1]
    tries = 3 if "ipopt" in name else 40
    good, memory = agent.predict(rows[:2], None, np.ones(2, dtype=bool))
    alone, mixed = [good], None
    for k in range(1, tries):
        good, memory = agent.predict(rows[k : k + 2], memory)
        alone.append(good)
    for k in range(tries):
        bad = rows[k].copy()
        bad[rng.integers(entries, size=rng.integers(1, 4))] = rng.choice(ABSURD)
        batch = np.stack([rows[k], bad, rows[k + 1]])
        starts = np.full(3, k == 0)
        actions, mixed = agent.predict(batch, mixed, starts)
        np.testing.assert_array_equal(actions[[0, 2]], alone[k])
        assert space.contains(actions[1]), (k, bad)


@each_agent
def test_absurd_numbers_are_those_at_the_bounds(name: str) -> None:
    agent, row = made(name), good_rows()[20].astype(np.float64)
    bound = environment().unwrapped.layout.bound.astype(np.float64)
    signs = np.where(np.arange(row.size) % 3 == 0, -1.0, 1.0)
    start = np.array([True])
    at_bounds, _ = agent.predict(signs * bound, None, start)
    for size in (1e20, 1e154, 1e300):
        np.testing.assert_array_equal(agent.predict(signs * size, None, start)[0], at_bounds)


def test_nothing_within_the_bounds_is_changed() -> None:
    bound = environment().unwrapped.layout.bound
    for rows in (good_rows(), bound[None], -bound[None], np.full((1, bound.size), 5e-324)):
        np.testing.assert_array_equal(observation_rows(rows, bound.size), rows)
    lost = np.full((1, bound.size), np.nan)
    lost[0, ::2] = -np.inf
    np.testing.assert_array_equal(observation_rows(lost, bound.size), lost)


WRONG: dict[str, Any] = {
    "torch with gradients": lambda row: torch.tensor(row, requires_grad=True),
    "strings": lambda row: [str(value) for value in row],
    "text": lambda _: "observation",
    "objects": lambda row: row.astype(object),
    "None": lambda _: None,
    "a mapping": lambda row: {"tracking": row},
    "complex": lambda row: row.astype(complex),
    "truth values": lambda row: row > 0.0,
    "ragged": lambda row: [row, row[:3]],
    "three dimensions": lambda row: row[None, None],
    "a number": lambda _: 1.0,
}


@each_agent
@pytest.mark.parametrize("kind", list(WRONG))
def test_other_observations_are_refused_in_one_line(name: str, kind: str) -> None:
    with pytest.raises(ValueError, match=r"^observation ") as raised:
        made(name).predict(WRONG[kind](good_rows()[0]))
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) <= 300


@each_agent
@pytest.mark.parametrize("starts", [[True] * 3, "yes", [None, None], [0.5, 0.5], [[True], [False]]])
def test_other_beginnings_of_episodes_are_refused(name: str, starts: Any) -> None:
    with pytest.raises(ValueError, match=r"^episode_start "):
        made(name).predict(good_rows()[:2], None, starts)


@each_agent
def test_beginnings_may_be_given_in_every_usual_form(name: str) -> None:
    agent, rows = made(name), good_rows()
    numbers = 1.0, [1, 1], [1.0, 1.0], np.ones(2, dtype=np.float32), torch.ones(2)
    truths = True, [True], np.ones(2, dtype=bool), torch.ones(2, dtype=torch.bool)
    for starts in (*numbers, *truths):
        again, _ = agent.predict(rows[:2], None, starts)
        agent.reset()
        np.testing.assert_array_equal(again, agent.predict(rows[:2])[0])


@each_agent
def test_a_memory_of_another_agent_is_refused(name: str) -> None:
    rows = good_rows()[:2]
    foreign = {
        other: made(other).predict(rows)[1]
        for other in ("lpv-nmpc", "lpv-nmpc-tuned", "pid", "stanley")
    }
    shorter = agents.make("lpv-nmpc", environment(), horizon=5).predict(rows)[1]
    own = type(made(name).predict(rows)[1])
    for state in (*foreign.values(), shorter, (None, None), "state", 3, np.zeros(2)):
        if type(state) is own and state is not shorter:
            continue
        if state is shorter and name != "lpv-nmpc":
            continue
        with pytest.raises(TypeError, match="state is not this agent's memory"):
            made(name).predict(rows, state)


def test_classical_memories_are_not_exchanged() -> None:
    rows = good_rows()[:2]
    _, memory = made("pid").predict(rows)
    with pytest.raises(TypeError, match="not this agent's memory but PidMemory"):
        made("stanley").predict(rows, memory)


class Lost(TrackingAgent[None]):
    """Returns what is not finite from the third step on."""

    def __init__(self, task: Any, given: Any = (0.1, np.nan)) -> None:
        super().__init__(task)
        self.given, self.calls = given, 0

    def new_memory(self) -> None:
        return None

    def control(self, observation: Any, memory: None) -> Any:  # noqa: ARG002
        self.calls += 1
        return self.given if self.calls > 2 else (0.1, 0.0)


@pytest.mark.parametrize("given", [(0.1, np.nan), (np.nan, 0.0), (np.inf, 0.0), (0.0, -np.inf)])
def test_inputs_that_are_not_finite_become_a_stop_that_is_counted_and_told_once(given: Any) -> None:
    task, rows = made("stanley").task, good_rows()[:4].copy()
    rows[:, 4] = 0.2
    agent = Lost(task, given)
    with pytest.warns(UserWarning, match="Lost returns inputs that are not finite") as told:
        actions, _ = agent.predict(rows)
    assert (agent.replaced_actions, len(told)) == (2, 1)
    expected = blind_control(task.vehicle, task.layout.unpack(rows[3]))
    np.testing.assert_array_equal(actions[3], np.float32(expected))
    assert actions[3, 1] == np.float32(0.2)
    assert actions[3, 0] == np.float32(stopping_acceleration(task.vehicle, float(rows[3, 0])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agent.predict(rows)
    assert agent.replaced_actions == 6


@pytest.mark.parametrize("given", [None, "left", (1.0,), (1.0, 2.0, 3.0), ("1", "2"), [[1.0, 2.0]]])
def test_what_is_no_pair_of_inputs_is_refused(given: Any) -> None:
    agent = Lost(made("stanley").task, given)
    with pytest.raises(ValueError, match="action must be two numbers"):
        agent.predict(good_rows()[:3])


def test_a_batch_of_one_is_a_pair_of_inputs() -> None:
    task, rows = made("stanley").task, good_rows()[:3]
    for given in (np.array([[0.1, 0.0]]), torch.tensor([[0.1, 0.0]])):
        actions, _ = Lost(task, given).predict(rows)
        np.testing.assert_array_equal(actions, np.float32([[0.1, 0.0]] * 3))


class Varied(TrackingAgent[Any]):
    """Makes memories of two types by turns."""

    made = 0

    def new_memory(self) -> Any:
        self.made += 1
        return {} if self.made % 2 else None

    def control(self, observation: Any, memory: Any) -> tuple[float, float]:  # noqa: ARG002
        return 0.1, 0.0


def test_memories_of_one_agent_may_differ_in_type() -> None:
    agent, rows = Varied(made("stanley").task), good_rows()[:3]
    _, memory = agent.predict(rows)
    agent.predict(rows, memory, [True, False, False])
    with pytest.raises(TypeError, match="not this agent's memory but list"):
        agent.predict(rows, [[], [], []])


@pytest.mark.parametrize("own", [True, False])
def test_a_drive_tells_how_many_stops_replaced_actions(own: bool) -> None:
    env = gymnasium.make(PATH_TRACKING, trajectory="straight", time_limit=1.0)
    agent: Any = Lost(made("stanley").task)
    if not own:
        calls = iter(range(100))
        agent = SimpleNamespace(
            predict=lambda *_, **__: (np.array([0.1, np.nan if next(calls) > 1 else 0.0]), None)
        )
    with pytest.warns(UserWarning, match="18 of 20 actions were not finite"):
        done = rollout(env, agent, seed=0)
    assert done.fallbacks == {NOT_FINITE: 18}
    assert np.isfinite(done.trace.state).all()


def test_an_environment_is_no_task() -> None:
    for name in agents.names():
        with pytest.raises(TypeError, match="task must be a DrivingTask, not "):
            agents.registry.agent_class(name)(environment())
