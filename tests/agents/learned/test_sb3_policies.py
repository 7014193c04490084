"""Policies out of models of Stable-Baselines3: the same actions, and what is refused."""

import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import agents
from agents.learned import Policy, read
from experiments.cli import main
from lpv_track_env import PATH_TRACKING
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.vehicle import VEHICLES
from tests.helpers.learned_policies import act, observations


def box(low: Any, high: Any, size: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(np.float32(low), np.float32(high), (size,), np.float32)


class Spaces(gymnasium.Env):
    """An environment of which a model takes the spaces."""

    def __init__(self, size: int, actions: gymnasium.spaces.Box) -> None:
        self.observation_space, self.action_space = box(-100.0, 100.0, size), actions


def sb3_model(
    algorithm: str, activation: str, size: int, actions: gymnasium.spaces.Box, **kwargs: Any
) -> Any:
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    import torch

    kind = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[activation]
    kwargs = {"policy_kwargs": {"activation_fn": kind, "net_arch": [32, 16]}, **kwargs}
    if algorithm != "ppo":
        kwargs = {"buffer_size": 10, **kwargs}
    model = getattr(stable_baselines3, algorithm.upper())(
        "MlpPolicy", Spaces(size, actions), seed=0, device="cpu", **kwargs
    )
    if algorithm == "ppo":
        # Its last layer begins a hundred times smaller than the others: nothing would be clipped.
        with torch.no_grad():
            model.policy.action_net.weight.mul_(300.0)
    return model


SI = gymnasium.spaces.Box(np.float32([-5.0, -0.5]), np.float32([3.5, 0.5]), dtype=np.float32)


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "td3"])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("actions", [box(-1.0, 1.0, 2), SI], ids=["unit", "si"])
def test_a_policy_is_its_sb3_model(
    algorithm: str, activation: str, actions: gymnasium.spaces.Box
) -> None:
    from agents.learned.sb3_policies import network_of

    rng = np.random.default_rng(0)
    weight, bias = rng.normal(size=(9, 48)) / 5.0, rng.normal(size=9)
    model = sb3_model(algorithm, activation, 9, actions)
    policy = Policy(
        **network_of(model)._asdict(), layout=ObservationLayout(), control_period=0.05,
        algorithm=algorithm, feature_weight=weight, feature_bias=bias, feature_limit=2.0,
        origin="zero", centre=np.zeros(2), half=np.ones(2),
    )  # fmt: skip
    rows = observations(200)
    features = np.clip(
        rows.astype(np.float32) @ policy.feature_weight.T + policy.feature_bias, -2.0, 2.0
    )
    expected = model.predict(features, deterministic=True)[0]
    middle, reach = 0.5 * (actions.high + actions.low), 0.5 * (actions.high - actions.low)
    u = (expected - middle) / reach
    assert np.ptp(u, axis=0).min() > 0.1
    if algorithm == "ppo":
        assert (np.abs(u) > 0.9999).any()
    np.testing.assert_allclose(act(policy, rows, np.zeros((200, 2))), u, atol=1e-5)


def test_what_sb3_has_besides_is_refused() -> None:
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    import torch

    from agents.learned.sb3_policies import network_of

    def refused(model: Any) -> str:
        with pytest.raises(ValueError, match="cannot be taken") as raised:
            network_of(model)
        assert "\n" not in str(raised.value)
        return str(raised.value)

    unit = box(-1.0, 1.0, 2)
    elu = {"policy_kwargs": {"activation_fn": torch.nn.ELU}}
    assert "Tanh or ReLU" in refused(sb3_model("ppo", "tanh", 9, unit, **elu))
    assert "use_sde=False" in refused(sb3_model("ppo", "tanh", 9, unit, use_sde=True))
    assert "use_sde=False" in refused(sb3_model("sac", "tanh", 9, unit, use_sde=True))
    dqn = gymnasium.make("CartPole-v1")
    assert "only MlpPolicy" in refused(stable_baselines3.DQN("MlpPolicy", dqn, buffer_size=10))

    class Extractor(stable_baselines3.common.torch_layers.FlattenExtractor):
        pass

    own = {"policy_kwargs": {"features_extractor_class": Extractor}}
    assert "train with FlattenExtractor" in refused(sb3_model("td3", "relu", 9, unit, **own))


# lpv-track import-policy.


@pytest.fixture(params=["si", "rescaled"])
def saved(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, Any, Any]:
    """A model of plain SB3 on this project's environment, saved, and that environment."""
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    env: Any = gymnasium.make(PATH_TRACKING, trajectory="u-turn", preview_steps=10)
    if request.param == "rescaled":
        env = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=32, batch_size=32, seed=0, device="cpu")
    model.learn(32)
    model.save(tmp_path / "model.zip")
    return tmp_path / "model.zip", model, env


def imported(model: Path, *more: str) -> int:
    return main(
        ["import-policy", str(model), "--algorithm", "ppo", "--trust",
         "--out", str(model.with_name("mine.json")), *more]
    )  # fmt: skip


def test_a_model_of_plain_sb3_is_imported(
    saved: tuple[Path, Any, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    file, model, env = saved
    assert imported(file, "--preview-steps", "10") == 0
    assert "28 -> 28 -> 64 -> 64 -> 2" in capsys.readouterr().out
    policy = read(file.with_name("mine.json"))
    assert policy.training["steps"] == 32
    agent = agents.make(str(file.with_name("mine.json")), env.unwrapped)
    observation, _ = env.reset(seed=0)
    half = np.array([4.25, np.pi / 6])
    for _ in range(10):
        chosen = model.predict(observation, deterministic=True)[0]
        if env.action_space.high[0] == 1.0:
            expected = np.array([-0.75, 0.0]) + half * chosen
        else:
            expected = chosen
        # 1e-5 of the range
        np.testing.assert_allclose(
            agent.predict(observation)[0] / half, expected / half, rtol=0.0, atol=1e-5
        )
        observation = env.step(env.action_space.sample())[0]


def test_a_model_of_something_else_is_one_line(
    saved: tuple[Path, Any, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    file, _, env = saved

    def refused(*more: str, model: Path = file) -> str:
        assert imported(model, *more) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert not model.with_name("mine.json").exists()
        return said

    assert "say --preview-steps" in refused()
    assert "unknown vehicle" in refused("--vehicle", "m2-bus")
    with zipfile.ZipFile(file.with_name("other.zip"), "w") as archive:
        archive.writestr("data", "{}")
    assert "PPO of Stable-Baselines3" in refused(model=file.with_name("other.zip"))
    file.with_name("none.zip").write_bytes(b"none")
    assert "PPO of Stable-Baselines3" in refused(model=file.with_name("none.zip"))
    if env.action_space.high[0] != 1.0:
        wide = file.with_name("wide.json")
        wide.write_text(vehicle_json())
        assert "say --vehicle" in refused("--preview-steps", "10", "--vehicle", str(wide))


def vehicle_json() -> str:
    """The default vehicle with more steering."""
    values = VEHICLES["m2-minibus"].as_dict()
    return json.dumps({**values, "name": "wide", "max_steering_angle": 0.7})


def test_without_sb3_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    (tmp_path / "model.zip").write_bytes(b"")
    assert imported(tmp_path / "model.zip") == 2
    assert "pip install 'lpv-track-env[rl]'" in capsys.readouterr().err
