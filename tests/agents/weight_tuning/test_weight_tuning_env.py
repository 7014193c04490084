"""`WeightTuning-v0` as Gymnasium, Stable-Baselines3 and its users meet it."""

import copy
import inspect
import pickle
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import PassiveEnvChecker
from numpy.typing import NDArray

from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.env import WeightTuningEnv, WeightTuningVectorEnv
from lpv_track_env import WEIGHT_TUNING
from lpv_track_env.env import PathTrackingEnv
from tests.helpers.tuned_drives import CALM, CHOICES, LIVELY, SCHEDULE, random_actions

Array = NDArray[Any]

OPTIONS: dict[str, dict[str, Any]] = {
    **{name: {"choice": choice} for name, choice in CHOICES.items()},
    "simulation": {"conditions": "simulation"},
    "course-car": {"vehicle": "course-car", "speed_mode": "fixed", "fixed_speed": 4.0},
    "uncompensated": {"delay_compensation": False},
    "two-nodes": {"preview_steps": 2, "preview_period": 0.1, "trajectory": "u-turn"},
    "errors": {"trajectory": "T2", "initial_error_range": (0.5, 0.1, 1.0), "random_start": True},
    "short": {"time_limit": 0.6},
    "frames": {"render_mode": "rgb_array"},
}


def make(**settings: Any) -> WeightTuningEnv:
    env = gymnasium.make(WEIGHT_TUNING, **settings).unwrapped
    assert isinstance(env, WeightTuningEnv)
    return env


def assert_same(one: Any, other: Any) -> None:
    """Steps, bit for bit."""
    np.testing.assert_array_equal(one[0], other[0])
    assert one[1:4] == other[1:4]
    assert one[4].keys() == other[4].keys()
    for key, value in one[4].items():
        np.testing.assert_array_equal(value, other[4][key])


# Other people's checkers ---------------------------------------------------------------------


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_gymnasium_check_env(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(**options)
        check_env(env, skip_render_check="render_mode" not in options)
        env.close()


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_stable_baselines_check_env(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(**options)
        checker.check_env(env, skip_render_check="render_mode" not in options)
        env.close()


def test_passive_checker_finds_nothing_in_an_episode() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(WEIGHT_TUNING, trajectory="u-turn", disable_env_checker=False)
        assert isinstance(env.env, PassiveEnvChecker)  # type: ignore[attr-defined]
        env.reset(seed=3)
        done = False
        while not done:
            _, _, terminated, truncated, info = env.step(env.action_space.sample())
            done = terminated or truncated
        assert info["end"] == "finished"


def test_module_qualified_id_needs_no_import(tmp_path: Path) -> None:
    code = (
        "import gymnasium\n"
        "name = 'lpv_track_env:lpv_track_env/WeightTuning-v0'\n"
        "env = gymnasium.make(name, trajectory='straight')\n"
        "env.reset(seed=0)\n"
        "print(env.step(env.action_space.sample())[0].shape, env.spec.id)\n"
        "envs = gymnasium.make_vec(name, num_envs=3, vectorization_mode='vector_entry_point')\n"
        "print(envs.reset(seed=0)[0].shape, type(envs).__name__)\n"
        "print(gymnasium.make_vec(name, num_envs=2, vectorization_mode='sync').reset()[0].shape)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120,
        check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == [
        "(48,) lpv_track_env/WeightTuning-v0", "(3, 48) WeightTuningVectorEnv", "(2, 48)",
    ]  # fmt: skip


# Arguments -----------------------------------------------------------------------------------


def test_arguments_are_those_of_the_tracking_environment_and_documented() -> None:
    tracking = inspect.signature(PathTrackingEnv).parameters
    single, vector = (
        inspect.signature(kind).parameters for kind in (WeightTuningEnv, WeightTuningVectorEnv)
    )
    own = {"choice", "delay_compensation"}
    assert set(single) == set(tracking) - {"reward_weights", "plant", "render_colour"} | own
    assert set(vector) == set(single) | {"num_envs", "autoreset_mode", "threads"}
    for name in set(single) - own - {"conditions"}:
        assert single[name].default == vector[name].default == tracking[name].default
    documented = (inspect.getdoc(WeightTuningEnv) or "").split("## Arguments")[1]
    assert all(name in documented for name in own)


def test_every_argument_reaches_its_place() -> None:
    given: dict[str, Any] = {
        "trajectory": "T3", "vehicle": "course-car", "speed_mode": "fixed", "fixed_speed": 3.0,
        "conditions": {"name": "realtime", "estimator": "raw"}, "control_period": 0.1,
        "render_mode": "rgb_array", "preview_steps": 12, "preview_period": 0.15,
        "max_lateral_error": 2.0, "time_limit": 7.0, "initial_error_range": (0.1, 0.2, 0.3),
        "random_start": True,
    }  # fmt: skip
    env = make(**given, choice=WeightChoice(SCHEDULE, window=0.5))
    wanted = PathTrackingEnv(**given)
    inner = env.drives.drives.single
    assert inner.base_task.path.name == wanted.base_task.path.name == "T3"
    np.testing.assert_array_equal(inner.base_task.path.table, wanted.base_task.path.table)
    np.testing.assert_array_equal(inner.base_task.constants(), wanted.base_task.constants())
    for name in ("vehicle", "conditions", "control_period", "layout", "actuation"):
        assert getattr(inner, name) == getattr(wanted, name)
    agent = env.drives.loop.agent
    assert agent.task.vehicle.name == "course-car"
    assert agent.problem.first_period == 0.1
    assert agent.problem.times[-1] == pytest.approx(12 * 0.15)
    assert agent.preview_steps == 12
    assert env.observation_space.shape == (44 + 3,)
    assert env.metadata["render_fps"] == 2
    assert env.drives._decider.window == 5
    assert env.render_mode == env.drives.render_mode == "rgb_array"


def test_delays_are_compensated_where_there_are_any() -> None:
    for settings, compensated in (
        ({}, True), ({"conditions": "simulation"}, False), ({"delay_compensation": False}, False),
    ):  # fmt: skip
        assert bool(make(**settings).drives.loop.memory.arrays.delays.size) == compensated


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trajectory": "T9"}, "unknown trajectory 'T9'"),
        ({"render_mode": "ansi"}, "render_mode"),
        ({"preview_steps": 0}, "preview_steps"),
    ],
)
def test_wrong_arguments(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as told:
        WeightTuningEnv(**settings)
    assert "\n" not in str(told.value)


# Episodes ------------------------------------------------------------------------------------


def test_same_seed_same_episodes() -> None:
    one, other = make(**LIVELY), make(**LIVELY)
    starts = [env.reset(seed=11)[0] for env in (one, other)]
    np.testing.assert_array_equal(*starts)
    for action in random_actions(one.choice, 4):
        assert_same(one.step(action), other.step(action))
        if one.drives.drives.arrays.ends[0]:
            break
    following = [env.reset()[0] for env in (one, other)]
    np.testing.assert_array_equal(*following)
    assert not np.array_equal(following[0], starts[0])
    assert not np.array_equal(one.reset(seed=12)[0], starts[0])
    np.testing.assert_array_equal(one.reset(seed=11)[0], starts[0])


def test_nothing_of_an_episode_is_left_in_the_next() -> None:
    """Warm starts, tables, bands, statistics and counts: it is as with a new environment."""
    used, fresh = make(**CALM), make(**CALM)
    used.reset(seed=1)
    for action in random_actions(used.choice, 12):
        used.step(3.0 * action)
    first, second = used.reset(seed=2), fresh.reset(seed=2)
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1]["clipped"] == 0
    for action in random_actions(used.choice, 12, seed=1):
        assert_same(used.step(action), fresh.step(action))


@pytest.mark.parametrize("way", ["pickle", "deepcopy"])
@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
def test_a_copy_made_in_mid_episode_goes_on_alike(way: str, conditions: str) -> None:
    env = make(**CALM, conditions=conditions)
    env.reset(seed=5, options={"lateral_error": 0.3})
    actions = random_actions(env.choice, 20)
    for action in actions[:7]:
        env.step(action)
    clone = pickle.loads(pickle.dumps(env)) if way == "pickle" else copy.deepcopy(env)  # noqa: S301
    for action in actions[7:]:
        assert_same(env.step(action), clone.step(action))
    np.testing.assert_array_equal(env.reset()[0], clone.reset()[0])


def test_reset_options_hold_for_one_episode() -> None:
    env = make(trajectory="T1")
    env.reset(seed=0, options={"trajectory": "circle", "arc_length": 3.0, "lateral_error": 0.2})
    drives = env.drives.drives
    assert drives.task_of(0).path.name == "circle"
    assert drives.info_of(0)["arc_length"] == pytest.approx(3.0)
    assert drives.info_of(0)["lateral_error"] == pytest.approx(0.2)
    env.reset()
    assert drives.task_of(0).path.name == "T1"


@pytest.mark.parametrize("key", ["arc_lenght", "reset_mask"])
def test_an_unknown_reset_option_changes_nothing(key: str) -> None:
    env, other = make(**CALM), make(**CALM)
    for one in (env, other):
        one.reset(seed=0)
    with pytest.raises(ValueError, match=f"unknown reset option '{key}'"):
        env.reset(seed=4, options={key: np.ones(1, dtype=bool)})
    assert env.np_random_seed == other.np_random_seed
    for action in random_actions(env.choice, 3):
        assert_same(env.step(action), other.step(action))


def test_reset_needed() -> None:
    env = WeightTuningEnv(time_limit=0.2)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"not begun: call reset\(\) first"):
        env.step(np.zeros(3))
    env.reset(seed=0)
    assert env.step(np.zeros(3))[3]
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"has ended: call reset\(\) before"):
        env.step(np.zeros(3))


def test_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    env = make(trajectory="T2", render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    first = env.render()
    for _ in range(5):
        env.step(np.zeros(3))
    second = env.render()
    assert second.shape == (600, 900, 3)
    assert second.dtype == np.uint8
    assert second.mean() > 0
    assert not np.array_equal(first, second)
    env.close()
