"""Infos have the same flat structure at the reset and in every step, as RL libraries need it."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from lpv_track_env import HIGHWAY_TRACK, PATH_TRACKING, WEIGHT_TUNING, kernels
from lpv_track_env.episodes import End

SHORT: dict[str, Any] = {"trajectory": "u-turn", "random_start": True, "time_limit": 1.0}


def racetrack() -> gymnasium.Env[Any, Any]:
    from lpv_track_env.highway.wrapper import HighwayTracking

    config = {"action": {"type": "ContinuousAction"}, "policy_frequency": 15}
    return HighwayTracking(gymnasium.make("racetrack-v1", config=config))


ENVS: dict[str, Callable[[], gymnasium.Env[Any, Any]]] = {
    "simulation": lambda: gymnasium.make(PATH_TRACKING, **SHORT),
    "realtime": lambda: gymnasium.make(PATH_TRACKING, conditions="realtime", **SHORT),
    "raw": lambda: gymnasium.make(
        PATH_TRACKING, conditions={"name": "realtime", "estimator": "raw"}, **SHORT
    ),
    "multi-body": lambda: gymnasium.make(
        PATH_TRACKING, vehicle="bmw-320i", plant="multi-body", **SHORT
    ),
    "weight-tuning": lambda: gymnasium.make(WEIGHT_TUNING, **SHORT),
    "highway": lambda: gymnasium.make(HIGHWAY_TRACK, time_limit=1.0),
    "empty road": lambda: gymnasium.make(HIGHWAY_TRACK, time_limit=1.0, other_vehicles=0),
    "highway-env's own": racetrack,
}


def test_an_end_is_a_number_and_its_name() -> None:
    for code, name in enumerate(("", *kernels.END_NAMES[1:])):
        end = End(code)
        assert end == name
        assert (end != name) is False
        assert end != "elsewhere"
        assert {end, name} == {name}
        assert (str(end), f"{end:>12}", repr(end)) == (name, f"{name:>12}", repr(name))
        assert (int(end), bool(end)) == (code, code > 0)
        assert np.asarray([end]).tolist() == [code]
        assert np.asarray([end]).dtype == np.int64
        assert pickle.loads(pickle.dumps(end)) is copy.deepcopy(end) is end  # noqa: S301
    assert len(End) == len(kernels.END_NAMES)


def structure(info: dict[str, Any]) -> dict[str, Any]:
    """Type of every entry, with the shape and dtype of arrays."""
    found = {}
    for key, value in info.items():
        found[key] = (type(value), getattr(value, "shape", None), getattr(value, "dtype", None))
        assert not isinstance(value, dict), key
        assert value is not None, key
        assert not np.isnan(value).any(), key  # a TypeError for texts
    return found


@pytest.mark.parametrize("name", ENVS)
def test_infos_never_change_their_structure(name: str) -> None:
    if "highway" in name or name == "empty road":
        pytest.importorskip("highway_env")
    if name == "multi-body":
        pytest.importorskip("vehiclemodels")
    env = ENVS[name]()
    _, info = env.reset(seed=0)
    wanted = structure(info)
    env.action_space.seed(0)
    ends = 0
    for _ in range(60):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        assert structure(info) == wanted
        if "end" in info:
            assert bool(info["end"]) == (terminated or truncated)
        if terminated or truncated:
            ends += 1
            _, info = env.reset()
            assert structure(info) == wanted
            assert info.get("end", "") == ""
    assert ends > 0 or name in {"highway-env's own", "weight-tuning"}


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
@pytest.mark.parametrize("mode", AutoresetMode)
def test_infos_of_the_vector_environment_never_change_theirs(
    mode: AutoresetMode, conditions: str
) -> None:
    env = gymnasium.make_vec(
        PATH_TRACKING, num_envs=4, vectorization_mode="vector_entry_point", autoreset_mode=mode,
        conditions=conditions, **SHORT,
    )  # fmt: skip
    _, infos = env.reset(seed=0)
    wanted = {key: (value.shape, value.dtype) for key, value in infos.items()}
    finals = 0
    for _ in range(45):
        *_, terminated, truncated, infos = env.step(np.zeros((4, 2)))
        final, mask = infos.pop("final_info", {}), infos.pop("_final_info", None)
        for key in ("final_obs", "_final_obs"):
            infos.pop(key, None)
        assert {key: (value.shape, value.dtype) for key, value in infos.items()} == wanted
        ended = terminated | truncated
        if final:
            finals += 1
            assert {key: (value.shape, value.dtype) for key, value in final.items()} == wanted
            assert [bool(end) for end in final["end"]] == mask.tolist() == ended.tolist()
        elif mode is not AutoresetMode.SAME_STEP:
            assert [bool(end) for end in infos["end"]] == ended.tolist()
        if mode is AutoresetMode.DISABLED and ended.any():
            env.reset(options={"reset_mask": ended})
    assert (finals > 0) == (mode is AutoresetMode.SAME_STEP)


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
def test_torchrl_batches_environments(conditions: str) -> None:
    """TorchRL makes tensors of all infos, those of ended episodes included."""
    gym = pytest.importorskip("torchrl.envs.libs.gym", reason="torchrl is not installed")
    settings = {**SHORT, "conditions": conditions}
    single = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make(PATH_TRACKING, **settings)] * 2,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    native = gymnasium.make_vec(
        PATH_TRACKING, num_envs=2, vectorization_mode="vector_entry_point",
        autoreset_mode="SameStep", **settings,
    )  # fmt: skip
    for env in (single, native):
        driven = gym.GymWrapper(env).rollout(60, break_when_any_done=False)["next"]
        assert driven["done"].sum() >= 4
        assert driven["end"].unique().tolist() == [End.RUNNING, End.TIME_LIMIT]
        assert driven["state"].shape == (2, 60, 6)


def test_ends_pass_between_processes() -> None:
    env = gymnasium.make_vec(PATH_TRACKING, num_envs=2, vectorization_mode="async", **SHORT)
    env.reset(seed=0)
    ends = {end for _ in range(21) for end in env.step(env.action_space.sample())[4]["end"]}
    env.close()
    assert End.TIME_LIMIT in ends
    assert all(type(end) is End for end in ends)
