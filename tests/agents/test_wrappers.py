"""Agents behind wrappers: the same drive bit for bit, or one line that names the wrapper."""

import copy
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers as w
from gymnasium.wrappers import vector
from numpy.typing import NDArray

import agents
from lpv_track_env import HIGHWAY_TRACK, PATH_TRACKING

Env = gymnasium.Env[Any, Any]
ONE = np.float32(1)


def bare(**settings: Any) -> Env:
    given = {"trajectory": "u-turn", "time_limit": 3.0, "initial_error_range": (0.3, 0.1, 0.5)}
    return gymnasium.make(PATH_TRACKING, **{**given, **settings})


def drive(env: Env, name: str = "stanley") -> NDArray[np.float64]:
    """True states of a drive."""
    agent = agents.make(name, env)
    observation, info = env.reset(seed=2)
    states, memory, over = [info["state"]], None, False
    while not over:
        action, memory = agent.predict(observation, memory)
        observation, _, terminated, truncated, info = env.step(action)
        states.append(info["state"])
        over = terminated or truncated
    return np.array(states)


class Logged(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A user's wrapper, which only looks on."""

    def step(self, action: Any) -> Any:
        self.last = action
        return super().step(action)


class Trusted(Logged):
    passes_through = True


class Idle(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A user's wrapper that leaves steps and resets alone."""

    def render(self) -> Any:
        return None


class Cheaper(gymnasium.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> Any:
        return 0.5 * float(reward)


class Halved(gymnasium.ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return 0.5 * action


class OwnMonitor(w.RecordEpisodeStatistics[Any, Any]):
    """A subclass that changes nothing of its base class's steps."""


class Odd(w.RescaleAction[Any, Any, Any]):
    """A subclass that changes what its base class does."""

    def action(self, action: Any) -> Any:
        return -super().action(action)


def monitored(env: Env) -> Env:
    return pytest.importorskip("stable_baselines3.common.monitor").Monitor(env)


HARMLESS: dict[str, Callable[[Env], Env]] = {
    "TimeLimit": lambda env: w.TimeLimit(env, 1000),
    "OrderEnforcing": w.OrderEnforcing,
    "PassiveEnvChecker": w.PassiveEnvChecker,
    "RecordEpisodeStatistics": w.RecordEpisodeStatistics,
    "Autoreset": w.Autoreset,
    "NormalizeReward": w.NormalizeReward,
    "ClipReward": lambda env: w.ClipReward(env, -1.0, 1.0),
    "TransformReward": lambda env: w.TransformReward(env, lambda reward: 2 * float(reward)),
    "ClipAction": w.ClipAction,
    "FlattenObservation": w.FlattenObservation,
    "DtypeObservation": lambda env: w.DtypeObservation(env, np.float64),
    "RescaleAction": lambda env: w.RescaleAction(env, -ONE, ONE),
    "RescaleAction twice": lambda env: w.RescaleAction(
        w.RescaleAction(env, -ONE, ONE), np.float32(0), np.float32(10)
    ),
    "RescaleAction of ClipAction": lambda env: w.RescaleAction(
        w.ClipAction(env), np.float32([-np.inf] * 2), np.float32([np.inf] * 2)
    ),
    "Monitor": monitored,
    "trusted": Trusted,
    "idle": Idle,
    "rewards": Cheaper,
    "subclass": OwnMonitor,
    "stack": lambda env: w.RescaleAction(w.TimeLimit(Trusted(env), 1000), -ONE, ONE),
}


@pytest.fixture(scope="module")
def unwrapped_drive() -> NDArray[np.float64]:
    return drive(bare())


@pytest.mark.parametrize("name", HARMLESS)
def test_harmless_wrappers_are_seen_through(
    name: str, unwrapped_drive: NDArray[np.float64]
) -> None:
    found = drive(HARMLESS[name](bare()))
    if name.startswith("RescaleAction"):
        # In the wrappers' units float64 resolves small actions to 1e-16: see the next test.
        np.testing.assert_allclose(found, unwrapped_drive, rtol=0, atol=1e-12)
    else:
        np.testing.assert_array_equal(found, unwrapped_drive)


def test_rescaled_actions_are_exact_and_in_the_wrappers_space() -> None:
    env = w.RescaleAction(bare(), -ONE, ONE)
    agent: Any = agents.make("stanley", env)
    low, high = bare().action_space.low, bare().action_space.high
    rng = np.random.default_rng(0)
    wanted = rng.uniform(low, high, (10_000, 2)).astype(np.float32)
    wanted[:2] = low, high
    agent.agent = type("Fixed", (), {"predict": lambda *_: (wanted, None)})()
    given, _ = agent.predict(None)
    np.testing.assert_allclose(np.abs(given).max(), 1.0, rtol=1e-6)
    # The float64 of the wrapper reaches every action to the last bit, but for those next to 0.
    np.testing.assert_allclose(env.action(given), wanted, rtol=0, atol=1e-16)
    clear = np.abs(wanted) > 0.02
    np.testing.assert_array_equal(env.action(given)[clear], wanted[clear])


def test_the_nmpc_behind_rescaled_actions_drives_as_without() -> None:
    env = w.RescaleAction(bare(conditions="realtime"), -ONE, ONE)
    wanted = drive(bare(conditions="realtime"), "lpv-nmpc")
    np.testing.assert_allclose(drive(env, "lpv-nmpc"), wanted, rtol=0, atol=1e-9)


def test_agents_of_rescaled_actions_can_be_copied_and_keep_their_attributes() -> None:
    agent: Any = agents.make("stanley", w.RescaleAction(bare(), -ONE, ONE))
    assert copy.deepcopy(agent).task.vehicle == agent.task.vehicle == agent.agent.task.vehicle


REFUSED: dict[str, Callable[[Env], Env]] = {
    "NormalizeObservation": w.NormalizeObservation,
    "RescaleObservation": lambda env: w.RescaleObservation(env, -ONE, ONE),
    "FrameStackObservation": lambda env: w.FrameStackObservation(env, 4),
    "TimeAwareObservation": lambda env: w.TimeAwareObservation(w.TimeLimit(env, 100)),
    "DelayObservation": lambda env: w.DelayObservation(env, 2),
    "MaxAndSkipObservation": lambda env: w.MaxAndSkipObservation(env, 2),
    "ReshapeObservation": lambda env: w.ReshapeObservation(env, (2, 24)),
    "DiscretizeObservation": lambda env: w.DiscretizeObservation(env, 3),
    "DtypeObservation": lambda env: w.DtypeObservation(env, np.float16),
    "TransformObservation": lambda env: w.TransformObservation(
        env, lambda seen: 2 * seen, env.observation_space
    ),
    "TransformAction": lambda env: w.TransformAction(env, lambda given: given, env.action_space),
    "DiscretizeAction": lambda env: w.DiscretizeAction(env, 3),
    "StickyAction": lambda env: w.StickyAction(env, 0.25),
    "RepeatAction": lambda env: w.RepeatAction(env, 2),
    "Halved": Halved,
    "Logged": Logged,
    "Odd": lambda env: Odd(env, -ONE, ONE),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_wrappers_are_refused_in_one_line(name: str) -> None:
    env = REFUSED[name](bare())
    for outer in (env, w.TimeLimit(env, 100)):
        with pytest.raises(ValueError, match=rf"^{name} changes .*{name}.passes_through") as error:
            agents.make("stanley", outer)
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 300
    with pytest.raises(ValueError, match=name):
        agents.DrivingTask.of(env)


def test_a_task_alone_cannot_undo_what_a_wrapper_does() -> None:
    with pytest.raises(ValueError, match=r"agents.make\(name, env\) undoes it"):
        agents.DrivingTask.of(w.RescaleAction(bare(), -ONE, ONE))


def many() -> dict[str, Callable[[], Any]]:
    def make(**more: Any) -> Any:
        return gymnasium.make_vec(
            PATH_TRACKING, num_envs=2, vectorization_mode="vector_entry_point", **more
        )

    def sb3() -> Any:
        return agents.sb3_vec_env(make(autoreset_mode="SameStep"))

    def normalised() -> Any:
        return pytest.importorskip("stable_baselines3.common.vec_env").VecNormalize(sb3())

    return {
        "PathTrackingVectorEnv": make,
        "NormalizeObservation": lambda: vector.NormalizeObservation(make()),
        "SyncVectorEnv": lambda: gymnasium.vector.SyncVectorEnv([bare, bare]),
        "TrackingVecEnv": sb3,
        "VecNormalize": normalised,
    }


@pytest.mark.parametrize("name", many())
def test_many_environments_in_one_are_refused(name: str) -> None:
    pytest.importorskip("stable_baselines3")
    with pytest.raises(ValueError, match=f"{name} holds 2 environments: make the agent for one"):
        agents.make("stanley", many()[name]())


def test_the_tracking_part_of_a_dictionary_may_be_filtered() -> None:
    pytest.importorskip("highway_env")
    wanted = drive(gymnasium.make(HIGHWAY_TRACK, time_limit=1.0))
    env = gymnasium.make(HIGHWAY_TRACK, time_limit=1.0)
    np.testing.assert_array_equal(drive(w.FilterObservation(env, ["tracking"])), wanted)
    for wrong in (w.FilterObservation(env, ["surroundings"]), w.FlattenObservation(env)):
        with pytest.raises(ValueError, match="Observation changes observations"):
            agents.make("stanley", wrong)
