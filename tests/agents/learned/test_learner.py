"""What learners see and send: the same as the agents that come of it."""

from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor

import agents
import lpv_track_env  # noqa: F401  registers the environments
from agents.base import DrivingTask
from agents.learned.agent import LearnedPolicy
from agents.learned.learner import LIMIT, LearnerVecEnv, Scaling, usual_scaling
from agents.learned.policy import ORIGINS, Policy
from lpv_track_env import PATH_TRACKING
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.vector_env import PathTrackingVectorEnv

SETTINGS: dict[str, Any] = {
    "trajectory": "u-turn", "random_start": True, "initial_error_range": (0.3, 0.05, 0.5),
}  # fmt: skip


def vec_env(n: int, **settings: Any) -> Any:
    env = PathTrackingVectorEnv(n, autoreset_mode="SameStep", **{**SETTINGS, **settings})
    return agents.sb3_vec_env(env)


def random_policy(task: DrivingTask, origin: str, seed: int = 0) -> Policy:
    """A network that steers somewhat wildly, but drives on."""
    rng = np.random.default_rng(seed)
    scaling = usual_scaling(task, origin)
    sizes = (scaling.features, 8, 2)
    layers = tuple(
        (
            rng.normal(0.0, 0.3 / np.sqrt(a), (b, a)).astype(np.float32),
            rng.normal(0.0, 0.1, b).astype(np.float32),
        )
        for a, b in pairwise(sizes)
    )
    return Policy(
        algorithm="random", layout=task.layout, control_period=task.control_period, layers=layers,
        activation="tanh", squash="clip", **vars(scaling),
    )  # fmt: skip


def outputs_of(policy: Policy, features: Any) -> Any:
    """The network's outputs for features, in plain NumPy."""
    x = features
    for weight, bias in policy.layers[:-1]:
        x = np.tanh(x @ weight.T + bias)
    weight, bias = policy.layers[-1]
    return np.clip(x @ weight.T + bias, -1.0, 1.0)


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
@pytest.mark.parametrize("origin", ORIGINS)
def test_a_policy_does_as_an_agent_what_it_did_as_a_learner(conditions: str, origin: str) -> None:
    """Whole episodes, start to start: features, delays, the NMPC below, the actions' meaning."""
    single = gymnasium.make(PATH_TRACKING, conditions=conditions, **SETTINGS)
    policy = random_policy(DrivingTask.of(single), origin)
    learner = LearnerVecEnv(
        vec_env(3, conditions=conditions, time_limit=4.0),
        usual_scaling(DrivingTask.of(single), origin),
    )
    learner.seed(11)
    features = learner.reset()
    rewards: list[list[float]] = [[], [], []]
    ends: list[Any] = [None] * 3
    while not all(ends):
        features, reward, done, infos = learner.step(outputs_of(policy, features))
        for k in range(3):
            if ends[k] is None:
                rewards[k].append(float(reward[k]))
                if done[k]:
                    ends[k] = infos[k]
    for k in range(3):
        env = gymnasium.make(PATH_TRACKING, conditions=conditions, time_limit=4.0, **SETTINGS)
        agent = agents.make("agents.learned.agent:LearnedPolicy", env, policy=policy)
        observation, _ = env.reset(seed=11 + k)
        driven, done_here, start = [], False, np.array([True])
        while not done_here:
            action, _ = agent.predict(observation, episode_start=start)
            start = np.array([False])
            observation, reward_here, terminated, truncated, info = env.step(action)
            driven.append(float(reward_here))
            done_here = terminated or truncated
        assert info["end"] == ends[k]["end"]
        # Features in float32 are summed in another order.
        np.testing.assert_allclose(driven, rewards[k], atol=2e-4)


def test_several_kinds_of_conditions_stand_one_after_another() -> None:
    parts = [vec_env(2), vec_env(3, conditions="realtime")]
    learner = LearnerVecEnv(parts)
    alone = [LearnerVecEnv(vec_env(2)), LearnerVecEnv(vec_env(3, conditions="realtime"))]
    learner.seed(5)
    alone[0].seed(5)
    alone[1].seed(7)
    np.testing.assert_array_equal(learner.reset(), np.vstack([one.reset() for one in alone]))
    rng = np.random.default_rng(0)
    for _ in range(30):
        outputs = rng.uniform(-1.0, 1.0, (5, 2))
        features, rewards, dones, _ = learner.step(outputs)
        apart = [one.step(part) for one, part in zip(alone, np.split(outputs, [2]), strict=True)]
        np.testing.assert_array_equal(features, np.vstack([part[0] for part in apart]))
        np.testing.assert_array_equal(rewards, np.concatenate([part[1] for part in apart]))
        np.testing.assert_array_equal(dones, np.concatenate([part[2] for part in apart]))
    assert learner.get_attr("control_period") == [0.05] * 5
    assert learner.env_is_wrapped(Monitor) == [True] * 5
    assert learner.env_is_wrapped(gymnasium.wrappers.RescaleAction) == [False] * 5
    assert learner.num_envs == 5


@pytest.mark.parametrize("origin", ["actuators", "lpv-nmpc"])
def test_the_last_features_of_an_episode_are_those_of_its_last_observation(origin: str) -> None:
    """What is bootstrapped from is what the next step would have been shown."""
    task = DrivingTask.of(gymnasium.make(PATH_TRACKING, conditions="realtime", **SETTINGS))
    scaling = usual_scaling(task, origin)
    short, long = (
        LearnerVecEnv(vec_env(2, conditions="realtime", time_limit=limit), scaling)
        for limit in (0.5, 5.0)
    )
    for learner in (short, long):
        learner.seed(3)
        learner.reset()
    for _ in range(10):
        outputs = np.full((2, 2), 0.1)
        _, _, dones, infos = short.step(outputs)
        features, _, _, _ = long.step(outputs)
    assert dones.all()
    assert infos[0]["TimeLimit.truncated"]
    last = np.array([info["terminal_observation"] for info in infos])
    # The NMPC's own answer there is found without its warm start.
    np.testing.assert_allclose(last, features, atol=1e-6 if origin == "actuators" else 5e-2)


def test_layouts_that_differ_are_refused() -> None:
    with pytest.raises(ValueError, match="share layout"):
        LearnerVecEnv([vec_env(1), vec_env(1, preview_steps=5)])
    with pytest.raises(ValueError, match="at least one"):
        LearnerVecEnv([])
    with pytest.raises(TypeError, match=r"agents\.sb3_vec_env"):
        LearnerVecEnv(PathTrackingVectorEnv(1, autoreset_mode="SameStep"))  # type: ignore[arg-type]


@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("layout", [ObservationLayout(), ObservationLayout(3, 0.2)])
def test_the_usual_scaling_says_what_its_docstring_does(
    origin: str, layout: ObservationLayout
) -> None:
    env = gymnasium.make(
        PATH_TRACKING, preview_steps=layout.preview_steps, preview_period=layout.preview_period
    )
    scaling = usual_scaling(DrivingTask.of(env), origin)
    car, k = env.unwrapped.vehicle, layout.preview_steps
    values = np.zeros((1, scaling.feature_weight.shape[1]))
    values[0, layout.slices["longitudinal_speed"]] = 9.0
    values[0, layout.slices["reference_speed"]] = 8.0
    values[0, layout.slices["preview_speed"]] = 6.5
    values[0, layout.slices["lateral_error"]] = 0.1
    x = scaling.features_of(values)[0]
    speeds = x[10 + k : 10 + 2 * k]
    np.testing.assert_allclose(speeds, -1.5, rtol=1e-6)
    assert x[9] == pytest.approx(1.0)
    assert x[5:7].tolist() == pytest.approx([0.2, 2.0])
    assert scaling.features == len(x) == 10 + 2 * k + 2 * (origin == "lpv-nmpc")
    rates = np.array([car.max_jerk, car.max_steering_rate]) * 0.05
    if origin == "actuators":
        np.testing.assert_allclose(scaling.half, rates)
    values[:] = 1e6
    assert np.abs(scaling.features_of(values)).max() == LIMIT


def test_actions_stay_within_the_action_space() -> None:
    task = DrivingTask.of(gymnasium.make(PATH_TRACKING))
    wide = Scaling(**{**vars(usual_scaling(task, "zero")), "half": np.array([100.0, 10.0])})
    below = vec_env(4)
    sent: list[Any] = []
    send = below.step_async

    def noted(actions: Any) -> None:
        sent.append(np.array(actions))
        send(actions)

    below.step_async = noted
    learner = LearnerVecEnv(below, wide)
    learner.reset()
    # Beyond [-1, 1], as a policy's noise may be.
    learner.step(np.array([[1.0, 1.0], [-1.0, -1.0], [9.0, -9.0], [0.0, 0.0]]))
    low, high = task.action_bounds
    expected = [high, low, [high[0], low[1]], wide.centre.astype(np.float32)]
    np.testing.assert_array_equal(sent[0], expected)
    assert all(below.action_space.contains(action) for action in sent[0])
    with pytest.raises(ValueError, match="unknown origin"):
        usual_scaling(task, "nmpc")


def test_the_agent_is_told_of_by_name() -> None:
    assert isinstance(
        agents.make(
            "agents.learned.agent:LearnedPolicy", gymnasium.make(PATH_TRACKING),
            policy=random_policy(DrivingTask.of(gymnasium.make(PATH_TRACKING)), "zero"),
        ),
        LearnedPolicy,
    )  # fmt: skip
