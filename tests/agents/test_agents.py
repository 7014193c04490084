"""The contract of everything that drives, over every registered name and over learned policies."""

import copy
import functools
import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import agents
import lpv_track_env  # noqa: F401  registers the environments
import trajectories
from agents.base import TrackingAgent
from agents.registry import check_settings
from experiments.run.case import Case, run_case
from lpv_track_env import PATH_TRACKING
from lpv_track_env.vehicle import M2_MINIBUS
from tests.helpers.learned_policies import DRIVING, driving_file

each_agent = pytest.mark.parametrize("name", [*agents.names(), *DRIVING])
SETTINGS = {"lpv-mpc-frozen": {"horizon": 20, "stages": 0.05}}
"""What the error of the frozen form, which grows with the stages, leaves able to drive."""


def environment(trajectory: Any = "u-turn", **settings: Any) -> gymnasium.Env:
    return gymnasium.make(
        "lpv_track_env/PathTracking-v0", trajectory=trajectory, vehicle="m2-minibus", **settings
    )


def new(name: str, **settings: Any) -> Any:
    known = str(driving_file(name)) if name in DRIVING else name
    return agents.make(known, environment(), **{**SETTINGS.get(name, {}), **settings})


@functools.cache
def shared(name: str, number: int) -> Any:
    return new(name)


def made(name: str, number: int = 0) -> Any:
    """An agent that remembers nothing; of each number there is one, since some take a second."""
    agent = shared(name, number)
    agent.reset()
    return agent


class Drive(NamedTuple):
    rows: NDArray[np.float32]
    """(n, size) observations."""
    actions: NDArray[np.float32]
    """(n, 2)."""
    lateral_error: NDArray[np.float64]
    end: str


@functools.cache
def u_turn(name: str) -> Drive:
    """One drive of each agent, whose observations the tests share."""
    env = environment()
    agent = new(name)
    observation, info = env.reset(seed=0)
    rows, actions, errors = [], [], []
    done = False
    while not done:
        action, _ = agent.predict(observation)
        rows.append(observation)
        actions.append(action)
        observation, _, terminated, truncated, info = env.step(action)
        errors.append(info["lateral_error"])
        done = terminated or truncated
    return Drive(np.array(rows), np.array(actions), np.array(errors), info["end"])


def in_the_bend(name: str) -> int:
    """Index of a step in the middle of the turn."""
    steering = np.abs(u_turn(name).rows[:, 4])
    return int(np.flatnonzero(steering > 0.9 * steering.max())[0])


@each_agent
def test_drives_a_u_turn_to_its_end(name: str) -> None:
    drive = u_turn(name)
    assert drive.end == "finished"
    assert np.abs(drive.lateral_error).max() < 0.5


@each_agent
def test_every_action_lies_in_the_action_space(name: str) -> None:
    env, agent = environment(), made(name)
    bound = env.unwrapped.layout.bound
    slices = env.unwrapped.layout.slices
    usual = u_turn(name).rows[50]
    signs = np.where(np.arange(bound.size) % 2 == 0, 1.0, -1.0).astype(np.float32)
    standing, backwards = usual.copy(), usual.copy()
    standing[slices["longitudinal_speed"]] = 0.0
    standing[slices["preview_speed"]] = 0.0
    standing[slices["reference_speed"]] = 0.0
    backwards[slices["longitudinal_speed"]] = -3.0
    blind = [usual.copy() for _ in range(bound.size)]
    for k, row in enumerate(blind):
        row[k] = (np.nan, np.inf, -np.inf)[k % 3]
    situations = [
        usual, bound, -bound, signs * bound, np.zeros_like(bound), standing, backwards,
        np.full_like(bound, np.nan), *blind, usual,
    ]  # fmt: skip
    for row in situations:
        action, _ = agent.predict(row)
        assert action.dtype == np.float32
        assert action.shape == (2,)
        assert env.action_space.contains(action), row


@each_agent
def test_a_sample_of_nan_leaves_no_trace(name: str) -> None:
    start = in_the_bend(name)
    rows = u_turn(name).rows[start - 6 : start + 2]
    seeing, blinded = made(name), made(name, 1)
    for row in rows[:-2]:
        seeing.predict(row)
        blinded.predict(row)
    lost = rows[-2].copy()
    lost[5] = np.nan
    before = seeing.predict(rows[-2])[0]
    instead = blinded.predict(lost)[0]
    # It does not let go of the steering in the bend.
    assert abs(before[1]) > 0.1
    assert instead[1] == pytest.approx(before[1], abs=0.05)
    # What it remembers of the drive differs by one period at most.
    after, recovered = seeing.predict(rows[-1])[0], blinded.predict(rows[-1])[0]
    np.testing.assert_allclose(recovered, after, atol=0.05)
    assert recovered[1] != 0.0


@each_agent
def test_a_vehicle_without_measurements_stops_and_stands(name: str) -> None:
    env, agent = environment("straight"), made(name)
    observation, info = env.reset(seed=0)
    speeds = []
    for k in range(260):
        if k >= 20:
            observation[5] = np.nan
        observation, _, _, _, info = env.step(agent.predict(observation)[0])
        speeds.append(info["state"][0])
        assert not info["end"]
    assert max(speeds) > 2.0
    assert min(speeds) >= 0.0
    assert abs(speeds[-1]) < 0.1


@each_agent
def test_two_of_a_kind_act_alike(name: str) -> None:
    one, other = made(name), made(name, 1)
    for row in u_turn(name).rows[:200:8]:
        np.testing.assert_array_equal(one.predict(row)[0], other.predict(row)[0])


@each_agent
def test_reset_and_episode_start_forget_the_drive(name: str) -> None:
    start = in_the_bend(name)
    rows, begin = u_turn(name).rows, np.array([True])
    agent = made(name)
    fresh = agent.predict(rows[0])[0]
    for row in rows[start : start + 10]:
        agent.predict(row)
    agent.reset()
    np.testing.assert_array_equal(agent.predict(rows[0])[0], fresh)
    for row in rows[start : start + 10]:
        agent.predict(row)
    np.testing.assert_array_equal(agent.predict(rows[0], None, begin)[0], fresh)
    # The same where the caller keeps the memory.
    _, memory = agent.predict(rows[start], None, begin)
    np.testing.assert_array_equal(agent.predict(rows[0], memory, begin)[0], fresh)


@each_agent
def test_a_batch_acts_as_single_agents(name: str) -> None:
    rows, begins = u_turn(name).rows, (0, in_the_bend(name), 300)
    together, alone = made(name), made(name, 1)
    batches = []
    for k in range(5):
        actions, memories = together.predict(np.stack([rows[begin + k] for begin in begins]))
        assert actions.shape == (3, 2)
        assert len(memories) == 3
        batches.append(actions)
    for j, begin in enumerate(begins):
        alone.reset()
        for k in range(5):
            np.testing.assert_array_equal(batches[k][j], alone.predict(rows[begin + k])[0])


@each_agent
def test_copies_go_on_alike(name: str) -> None:
    start = in_the_bend(name)
    rows, agent = u_turn(name).rows[start : start + 10], made(name)
    for row in rows[:5]:
        agent.predict(row)
    clones = [copy.deepcopy(agent), pickle.loads(pickle.dumps(agent))]  # noqa: S301
    for row in rows[5:]:
        action, _ = agent.predict(row)
        for clone in clones:
            np.testing.assert_array_equal(clone.predict(row)[0], action)


@each_agent
@pytest.mark.parametrize("change", [-1, 2])
def test_an_observation_of_another_size_is_refused(name: str, change: int) -> None:
    agent = made(name)
    size = agent.task.layout.size
    with pytest.raises(ValueError, match=rf"\({size + change},\).* {size} entries"):
        agent.predict(np.zeros(size + change, dtype=np.float32))


@each_agent
def test_a_mirrored_path_gives_mirrored_actions(name: str) -> None:
    path = trajectories.load("u-turn")
    env, mirror = environment(path), environment(path.mirrored())
    agent, image = made(name), made(name, 1)  # a path is known to them by observations alone
    options = {"arc_length": 45.0, "lateral_error": 0.3, "heading_error": 0.05}
    observation, _ = env.reset(options=options)
    reflected, _ = mirror.reset(options={**options, "lateral_error": -0.3, "heading_error": -0.05})
    steering = []
    for _ in range(25):
        action, opposite = agent.predict(observation)[0], image.predict(reflected)[0]
        np.testing.assert_allclose(opposite, action * np.array([1.0, -1.0]), atol=1e-4)
        steering.append(action[1])
        observation, reflected = env.step(action)[0], mirror.step(opposite)[0]
    assert np.abs(steering).max() > 0.05


def test_an_unknown_name_lists_the_known_and_the_nearest() -> None:
    with pytest.raises(ValueError, match="unknown agent 'stanly'") as raised:
        agents.make("stanly", environment())
    assert all(name in str(raised.value) for name in agents.names())
    assert "nearest: stanley" in str(raised.value)


@each_agent
def test_an_unknown_setting_names_the_agent(name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}(\.json)?' has no setting 'no_such_thing'"):
        new(name, no_such_thing=1)


def test_an_unknown_setting_lists_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"'gian'; known: gain, .*nearest: gain"):
        check_settings("stanley", {"gian": 2.0})
    with pytest.raises(ValueError, match="unknown agent"):
        check_settings("stanly", {})


OWN_AGENT = """
from agents import TrackingAgent

class Steady(TrackingAgent[None]):
    def __init__(self, task, *, steering=0.0):
        super().__init__(task)
        self.steering = steering
    def new_memory(self):
        return None
    def control(self, observation, memory):
        return 0.5 * float(observation.reference_speed - observation.longitudinal_speed), self.steering
"""  # noqa: E501


def test_ones_own_class_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_agents_of_this_test.py").write_text(OWN_AGENT)
    monkeypatch.syspath_prepend(tmp_path)
    name = "my_agents_of_this_test:Steady"
    agent = agents.make(name, environment(), steering=0.1)
    assert isinstance(agent, TrackingAgent)
    assert agent.predict(u_turn("stanley").rows[0])[0][1] == np.float32(0.1)
    result = run_case({"agent": name, "trajectory": "straight"})
    assert (result["status"], result["end"]) == ("ok", "finished")
    with pytest.raises(ValueError, match=r"has no setting 'stearing'.*nearest: steering"):
        agents.make(name, environment(), stearing=0.1)


def test_ones_own_file_drives_and_its_contents_belong_to_the_case(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(OWN_AGENT)
    spec = {"agent": f"{file}:Steady", "trajectory": "straight"}
    result = run_case(spec)
    assert (result["status"], result["end"]) == ("ok", "finished")
    assert result["id"] == Case(**spec).id
    file.write_text(OWN_AGENT + "# changed\n")
    assert result["id"] != Case(**spec).id


@pytest.mark.parametrize(
    "name", ["no.such.module:Thing", "json:NoSuchClass", "no_such_file.py:Thing"]
)
def test_a_class_that_cannot_be_loaded_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"agent '{name}' cannot be loaded"):
        agents.make(name, environment())


@pytest.mark.parametrize("name", agents.names())
def test_an_agent_drives_by_the_model_it_is_given(name: str, tmp_path: Path) -> None:
    """`model` is the vehicle that an agent takes for its own: a name, a file or parameters."""
    car = M2_MINIBUS.replace(front_cornering_stiffness=5e4, mass=2500.0)
    file = tmp_path / "believed.json"
    file.write_text(json.dumps(car.as_dict()))
    observation, _ = environment().reset(options={"lateral_error": 0.02})
    own, *others = [
        new(name, **given).predict(observation)[0]
        for given in ({}, {"model": car}, {"model": str(file)}, {"model": "m2-minibus"})
    ]
    np.testing.assert_array_equal(others[0], others[1])
    np.testing.assert_array_equal(others[2], own)
    if name in {"lpv-nmpc", "lqr"}:
        assert not np.array_equal(others[0], own)


def test_a_model_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown vehicle 'm2-minibuss'"):
        new("stanley", model="m2-minibuss")
    with pytest.raises(ValueError, match=r"a \.json file or VehicleParameters"):
        new("stanley", model=3)


def test_another_kind_of_environment_is_refused() -> None:
    with pytest.raises(ValueError, match="CartPoleEnv is not a path tracking environment"):
        agents.make("stanley", gymnasium.make("CartPole-v1"))


def test_stanley_loads_neither_casadi_nor_torch() -> None:
    heavy = {"casadi", "torch", "stable_baselines3", "scipy.interpolate"}
    code = (
        "import sys, gymnasium, agents, lpv_track_env\n"
        "agents.names()\n"
        "env = gymnasium.make('lpv_track_env/PathTracking-v0', trajectory='straight')\n"
        "agents.make('stanley', env).predict(env.reset()[0])\n"
        f"print(sorted({heavy} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.parametrize("name", ["stanley", "lpv-nmpc", "lpv-nmpc-ipopt"])
def test_agents_pass_through_sb3s_evaluate_policy(name: str) -> None:
    """Two environments at once, four episodes; perfect tracking returns 1 a second."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    venv = make_vec_env(PATH_TRACKING, n_envs=2, env_kwargs={"trajectory": "u-turn"})
    env = gymnasium.make(PATH_TRACKING, trajectory="u-turn")
    returns, lengths = evaluate_policy(
        agents.make(name, env), venv, n_eval_episodes=4, return_episode_rewards=True
    )
    assert len(returns) == 4
    assert len(set(returns)) == 1, "warm starts or memories leak from row to row"
    duration = env.unwrapped.path.duration
    assert 0.9 * duration < returns[0] <= duration
    assert lengths[0] == pytest.approx(duration / 0.05, rel=0.02)
