"""The Stable-Baselines3 adapter against SB3's own DummyVecEnv over the single environment."""

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import agents
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import COURSE_CAR

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

LIVELY: dict[str, Any] = {
    "trajectory": "figure-eight",
    "initial_error_range": (0.7, 0.3, 3.0),
    "random_start": True,
    "max_lateral_error": 0.8,
    "time_limit": 2.0,
}


def make(n: int, **settings: Any) -> Any:
    settings = {**LIVELY, "autoreset_mode": "SameStep", **settings}
    return agents.sb3_vec_env(PathTrackingVectorEnv(n, **settings))


def dummy(n: int) -> DummyVecEnv:
    one: Callable[[], Any] = lambda: Monitor(PathTrackingEnv(**LIVELY))  # noqa: E731
    return DummyVecEnv([one] * n)


def same(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    for key, value in one.items():
        if key == "episode":
            assert {k: v for k, v in value.items() if k != "t"} == {
                k: v for k, v in other[key].items() if k != "t"
            }
            assert value["t"] > 0.0
        elif isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, other[key], strict=True)
        else:
            assert type(value) is type(other[key])
            assert value == other[key]


def test_transitions_are_those_of_dummy_vec_env() -> None:
    ours, theirs = make(6), dummy(6)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.seed(3) == theirs.seed(3)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    for one, other in zip(ours.reset_infos, theirs.reset_infos, strict=True):
        same(one, other)
    rng = np.random.default_rng(0)
    ends = set()
    for _ in range(150):
        actions = rng.uniform([-3.0, -0.2], [4.0, 0.2], (6, 2)).astype(np.float32)
        results = ours.step(actions), theirs.step(actions)
        for one, other in zip(*(result[:3] for result in results), strict=True):
            np.testing.assert_array_equal(one, other, strict=True)
        for i in range(6):
            if results[0][2][i]:
                same(results[0][3][i], results[1][3][i])
                ends.add(results[0][3][i]["end"])
                same(ours.reset_infos[i], theirs.reset_infos[i])
            else:
                assert results[0][3][i] == {}
    assert {"left_corridor", "time_limit"} <= ends


def test_infos_are_not_shared() -> None:
    env = make(3, initial_error_range=(0.0, 0.0, 0.0), time_limit=20.0)
    env.reset()
    infos = env.step(np.zeros((3, 2)))[3]
    infos[0]["mine"] = 1
    assert infos[1] == infos[2] == {}
    assert env.step(np.zeros((3, 2)))[3] == [{}, {}, {}]


def test_time_limit_is_told_from_a_crash() -> None:
    env = make(2, time_limit=0.05, initial_error_range=(0.0, 0.0, 0.0))
    env.reset()
    *_, done, infos = env.step(np.zeros((2, 2)))
    assert done.all()
    assert all(info["TimeLimit.truncated"] is True for info in infos)
    crash = make(1, initial_error_range=(0.0, 0.0, 0.0))
    crash.set_options({"lateral_error": 3.0})
    crash.reset()
    info = crash.step(np.zeros((1, 2)))[3][0]
    assert (info["TimeLimit.truncated"], info["end"]) == (False, "left_corridor")


def test_seeds_and_options_hold_for_one_reset() -> None:
    ours, theirs = make(3), dummy(3)
    for env in (ours, theirs):
        env.seed(5)
        env.set_options([{"arc_length": 3.0}, {}, {"arc_length": 3.0, "lateral_error": 0.2}])
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    assert [info["arc_length"] for info in ours.reset_infos][::2] == pytest.approx([3.0, 3.0])
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    assert min(info["arc_length"] for info in ours.reset_infos) > 3.1


def test_attributes_and_methods_of_environments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    env = make(2, vehicle=COURSE_CAR, render_mode="rgb_array")
    env.reset()
    assert env.get_attr("vehicle") == [COURSE_CAR] * 2
    assert env.get_attr("path", indices=[1])[0].name == "figure-eight"
    assert env.render_mode == "rgb_array"
    assert not env.has_attr("engine")
    np.testing.assert_array_equal(env.get_attr("state")[1], env.env.state[1])
    assert [frame.shape for frame in env.env_method("render")] == [(600, 900, 3)] * 2
    frame = env.render()
    assert frame is not None
    assert frame.mean() > 0.0
    assert env.env_is_wrapped(Monitor) == [True, True]
    assert env.env_is_wrapped(VecNormalize) == [False, False]  # type: ignore[arg-type]
    with pytest.raises(AttributeError, match=r"cannot set 'mass'.*use set_options\(\)"):
        env.set_attr("mass", 1.0)
    env.close()


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_other_modes_are_refused(mode: str) -> None:
    with pytest.raises(ValueError, match=f"needs autoreset_mode='SameStep'.* has '{mode}'"):
        make(2, autoreset_mode=mode)


def test_ppo_learns_on_it_and_logs_returns() -> None:
    env = VecNormalize(make(4))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=2, seed=0, device="cpu")
    model.learn(512)
    assert model.ep_info_buffer is not None
    assert len(model.ep_info_buffer) > 4
    lengths = [episode["l"] for episode in model.ep_info_buffer]
    assert 1 <= min(lengths) <= max(lengths) <= 40


def test_sac_learns_on_it_and_is_evaluated() -> None:
    model = SAC("MlpPolicy", make(2), learning_starts=50, batch_size=32, seed=0, device="cpu")
    model.learn(120)
    rewards, lengths = evaluate_policy(
        model, make(2), n_eval_episodes=4, return_episode_rewards=True
    )
    assert len(rewards) == 4  # type: ignore[arg-type]
    assert max(lengths) <= 40  # type: ignore[type-var]


def test_wrappers_of_sb3_take_it() -> None:
    env = VecFrameStack(make(3), 2)
    assert env.reset().shape == (3, 96)  # type: ignore[union-attr]
    assert env.step(np.zeros((3, 2)))[0].shape == (3, 96)  # type: ignore[union-attr]


def test_nothing_else_loads_torch() -> None:
    code = (
        "import sys, agents\n"
        "from lpv_track_env.vector_env import PathTrackingVectorEnv\n"
        "PathTrackingVectorEnv(2, 'straight').reset(seed=0)\n"
        "print([m for m in ('torch', 'stable_baselines3') if m in sys.modules])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.strip() == "[]"
