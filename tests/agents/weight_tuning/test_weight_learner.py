"""Learning to choose weights with Stable-Baselines3, and networks at work in compiled code."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import agents
from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.closed_loop import ClosedLoop
from agents.weight_tuning.decision import Decider
from agents.weight_tuning.env import WeightTuningEnv, WeightTuningVectorEnv
from agents.weight_tuning.features import REJECTED, names
from tests.helpers.closed_loops import environments, traced
from tests.helpers.tuned_drives import CALM, CHOICES, LIVELY, random_actions

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from agents.weight_tuning.learner import WeightLearnerVecEnv

Array = NDArray[Any]
Layers = tuple[tuple[Array, Array], ...]
Forward = Callable[[Array], Array]


def learner(n: int, seen: Array | None = None, **settings: Any) -> WeightLearnerVecEnv:
    settings = {**LIVELY, "autoreset_mode": "SameStep", **settings}
    return WeightLearnerVecEnv(WeightTuningVectorEnv(n, **settings), seen)


# As SB3's environment ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["joint", "catalogue"])
def test_transitions_are_those_of_dummy_vec_env(name: str) -> None:
    choice = CHOICES[name]
    ours = learner(5, choice=choice)
    theirs = DummyVecEnv([lambda: WeightTuningEnv(choice=choice, **LIVELY)] * 5)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.seed(3) == theirs.seed(3)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    ends = []
    for action in random_actions(choice, 30, 5):
        one, other = ours.step(action), theirs.step(action)
        for found, wanted in zip(one[:3], other[:3], strict=True):
            np.testing.assert_array_equal(found, wanted, strict=True)
        for i, done in enumerate(one[2]):
            if done:
                found, wanted = one[3][i], other[3][i]
                assert found.keys() == {
                    "terminal_observation", "TimeLimit.truncated", "score", "end",
                }  # fmt: skip
                for key, value in found.items():
                    np.testing.assert_array_equal(value, wanted[key])
                ends.append(found["end"])
            else:
                assert one[3][i] == {}
    assert set(ends) == {"left_corridor", "time_limit"}


def test_seeds_and_options_hold_for_one_reset() -> None:
    ours, theirs = learner(3), DummyVecEnv([lambda: WeightTuningEnv(**LIVELY)] * 3)
    for env in (ours, theirs):
        env.seed(5)
        env.set_options([{"arc_length": 3.0}, {}, {"arc_length": 3.0, "lateral_error": 0.2}])
    for _ in range(2):
        np.testing.assert_array_equal(ours.reset(), theirs.reset())


def test_other_modes_and_factors_are_refused() -> None:
    with pytest.raises(ValueError, match="autoreset_mode='SameStep'"):
        learner(2, autoreset_mode="NextStep")
    with pytest.raises(ValueError, match=r"feature_mask must have shape \(48,\), not \(3,\)"):
        learner(2, np.ones(3))


def test_attributes_and_frames(
    monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    env = learner(2, render_mode="rgb_array")
    assert env.render_mode == "rgb_array"
    assert learner(1).render_mode is None
    assert not recwarn.list
    assert env.get_attr("choice", [1]) == [env.envs.choice]
    assert env.env_is_wrapped(Monitor) == [False, False]
    env.reset()
    frame = env.render()
    assert frame is not None
    assert frame.mean() > 0
    env.close()


def test_ppo_learns_on_it() -> None:
    env = VecMonitor(VecNormalize(learner(4), norm_obs=False))
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=32, n_epochs=2, seed=0, device="cpu")
    before = [weight.clone() for weight in model.policy.parameters()]
    model.learn(128)
    assert model.ep_info_buffer
    assert any(
        not torch.equal(one, other)
        for one, other in zip(before, model.policy.parameters(), strict=True)
    )
    inner = env.unwrapped
    assert isinstance(inner, WeightLearnerVecEnv)
    assert 128 < inner.solves <= 128 * 8


# Networks ------------------------------------------------------------------------------------


def actor_of(model: PPO) -> Layers:
    """Layers of PPO's mean action."""
    linear = [one for one in model.policy.mlp_extractor.policy_net if hasattr(one, "weight")]
    return tuple(
        (one.weight.detach().numpy(), one.bias.detach().numpy())
        for one in (*linear, model.policy.action_net)
    )


def test_a_policy_is_blind_to_what_is_hidden() -> None:
    """Its actions are PPO's on what the learner is shown, whatever the hidden features are."""
    hidden = np.array([name.startswith(("quick", "band")) for name in names(("a", "b", "c", "d"))])
    env = learner(2, np.where(hidden, 0.0, 1.0))
    shown = env.reset()
    assert not shown[:, hidden].any()
    assert shown[:, ~hidden].any()
    assert not env.step(np.zeros((2, 3)))[0][:, hidden].any()
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=16, seed=0, device="cpu")
    policy = env.policy_of(actor_of(model), "ppo", {"seed": 0})
    x = np.random.default_rng(0).normal(size=(50, 48)).astype(np.float32)
    with torch.no_grad():
        wanted = model.policy.get_distribution(torch.as_tensor(x * env.feature_mask)).mode().numpy()
    for noise in (0.0, 100.0):
        np.testing.assert_allclose(forward(policy.layers)(x + noise * hidden), wanted, atol=1e-6)
    assert not policy.layers[0][0][:, hidden].any()
    assert policy.choice == env.envs.choice
    assert policy.control_period == 0.05


def forward(layers: Layers) -> Forward:
    """Network of torch."""
    modules: list[torch.nn.Module] = []
    for weight, bias in layers:
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        linear.weight.data = torch.tensor(weight, dtype=torch.float32)
        linear.bias.data = torch.tensor(bias, dtype=torch.float32)
        modules += [linear, torch.nn.Tanh()]
    network = torch.nn.Sequential(*modules[:-1])
    return lambda x: np.asarray(network(torch.as_tensor(x, dtype=torch.float32)).detach().numpy())


def summed_in_order(layers: Layers) -> Forward:
    """A linear network, its float32 sums in the order of the inputs."""
    ((weight, bias),) = layers

    def act(x: Array) -> Array:
        y = np.tile(bias, (len(x), 1))
        for i in range(weight.shape[1]):
            y = y + x[:, i : i + 1] * weight[:, i]
        return y

    return act


def random_layers(choice: WeightChoice, *hidden: int, seed: int = 0) -> Layers:
    rng = np.random.default_rng(seed)
    sizes = [44 + len(choice.bands), *hidden, choice.entries]
    return tuple(
        (
            (rng.normal(size=(b, a)) / np.sqrt(a)).astype(np.float32),
            rng.normal(0.0, 0.3, b).astype(np.float32),
        )
        for a, b in itertools.pairwise(sizes)
    )


def driven_both_ways(
    choice: WeightChoice, layers: Layers, act: Forward, conditions: str
) -> tuple[Array, Array, Array, Array]:
    """States at the windows' ends and weights of a policy in the compiled loop, and by steps."""
    n, settings = 4, {**CALM, "conditions": conditions}
    envs = environments(n, **settings)
    decider = Decider(choice, layers, envs.single.control_period)
    loop = ClosedLoop(envs, agents.make("lpv-nmpc", envs.single), decider=decider)
    loop.reset(seed=3)
    _, trace = traced(loop, 100)
    tuning = WeightTuningVectorEnv(n, choice=choice, autoreset_mode="Disabled", **settings)
    observations, _ = tuning.reset(seed=3)
    driven, rows = np.zeros(n, dtype=np.int64), np.arange(n)
    compiled, stepped = [], []
    while True:
        actions = act(observations)
        if choice.catalogue:
            actions = actions.argmax(axis=1)
        observations, *_, infos = tuning.step(actions)
        driven += infos["steps"]
        if (driven > 100).any():
            break
        compiled.append(trace[rows, driven - 1, :6])
        stepped.append(tuning.drives.state)
    return np.array(compiled), np.array(stepped), loop.memory.tables, tuning.loop.memory.tables


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
@pytest.mark.parametrize("name", CHOICES)
def test_a_policy_in_the_loop_is_the_network_and_steps_bit_for_bit(
    name: str, conditions: str
) -> None:
    """A linear one, summed in the same order."""
    choice = CHOICES[name]
    layers = random_layers(choice)
    compiled, stepped, *_ = driven_both_ways(choice, layers, summed_in_order(layers), conditions)
    np.testing.assert_array_equal(compiled, stepped)
    assert len(compiled) > 5


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
def test_a_policy_in_the_loop_is_torchs_network_and_steps(conditions: str) -> None:
    """To the rounding of float32: torch sums in another order and has another tanh."""
    choice = CHOICES["stages"]
    layers = random_layers(choice, 32, 16)
    compiled, stepped, ours, theirs = driven_both_ways(choice, layers, forward(layers), conditions)
    np.testing.assert_allclose(compiled, stepped, rtol=1e-5, atol=1e-5)
    known = choice.sets
    assert not np.allclose(ours, known)
    assert not np.allclose(theirs, known)


def test_a_network_that_makes_no_number_leaves_the_base() -> None:
    choice = WeightChoice()
    (weight, bias), *_ = random_layers(choice)
    broken = ((np.full_like(weight, 3e38), np.full_like(bias, 3e38)),)
    n, settings = 3, {**CALM, "conditions": "realtime"}
    loops = []
    for layers in (broken, None):
        envs = environments(n, **settings)
        decider = None if layers is None else Decider(choice, layers, 0.05)
        loop = ClosedLoop(envs, agents.make("lpv-nmpc", envs.single), decider=decider)
        loop.reset(seed=1)
        loop.drive(40)
        loops.append(loop)
    np.testing.assert_array_equal(loops[0].envs.records, loops[1].envs.records)
    assert (loops[0].memory.history[:, REJECTED] >= 5).all()
