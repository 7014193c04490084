"""Context of a policy: one network for many vehicles, told once which one it drives."""

import dataclasses
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import agents
import lpv_track_env  # noqa: F401  registers the environments
from agents.base import DrivingTask
from agents.learned import Policy, read, write
from agents.learned.agent import LearnedPolicy
from agents.learned.context import CONTEXT, Followed, context_of, increments, with_context
from agents.learned.learner import CONTEXT_SCALES, LearnerVecEnv, usual_scaling
from agents.reference import local_reference
from experiments.run.case import run_case
from lpv_track_env import PATH_TRACKING
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import VEHICLES
from tests.helpers.learned_policies import (
    act,
    observations,
    plain_act,
    random_policy,
    same,
    written,
)
from tests.helpers.policy_files import beside

NAMES = ("rear_compliance", "wheelbase", "inverse_least_friction")
KINDS: tuple[dict[str, Any], ...] = (
    {"vehicle": "m2-minibus"},
    {"vehicle": "bmw-320i", "conditions": {"name": "realtime", "friction": [0.5, 1.0]}},
)


def task(**settings: Any) -> DrivingTask:
    return DrivingTask.of(gymnasium.make(PATH_TRACKING, **{"trajectory": "u-turn", **settings}))


def context_policy(origin: str = "zero", **changes: Any) -> Policy:
    """A random policy whose features see the context as well."""
    plain = random_policy(origin=origin, centre=np.array([0.1, 0.0]))
    more = np.random.default_rng(9).normal(size=(12, len(NAMES)))
    weight = np.hstack([plain.feature_weight, more])
    return dataclasses.replace(plain, feature_weight=weight, context=NAMES, **changes)


@pytest.mark.parametrize("origin", ["zero", "actuators", "lpv-nmpc"])
@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("settings", KINDS)
def test_the_context_is_a_further_input(
    origin: str, symmetric: bool, settings: dict[str, Any]
) -> None:
    here = task(**settings)
    policy = context_policy(origin, symmetric=symmetric)
    folded = with_context(policy, here)
    assert (folded.context, folded.inputs) == ((), policy.inputs - len(NAMES))
    rows, base = observations(20), np.zeros((20, 2))
    seen = rows
    if origin == "actuators":
        base = rows[:, [3, 4]]
    elif origin == "lpv-nmpc":
        base = np.random.default_rng(1).normal(size=(20, 2))
        seen = np.hstack([rows, base])
    seen = np.hstack([seen, np.tile(context_of(NAMES, here), (20, 1))])
    if origin == "actuators":
        assert folded.half.tolist() == increments(here).tolist()
        assert abs(policy.half - folded.half).max() > 0.1
        policy = dataclasses.replace(policy, half=folded.half)
    expected = plain_act(policy, seen, base)
    if symmetric:
        turned = plain_act(policy, seen * policy.mirror, base * [1.0, -1.0]) * [1.0, -1.0]
        expected = 0.5 * (expected + turned)
    # float32 sums of some tens of terms of size one
    np.testing.assert_allclose(act(folded, rows, base), expected, atol=2e-5)


def test_a_policy_drives_each_vehicle_by_its_own_constants() -> None:
    policy = context_policy()
    rows = np.abs(0.3 * observations(5))
    one, other = (act(with_context(policy, task(**kind)), rows, np.zeros((5, 2))) for kind in KINDS)
    assert np.abs(one - other).max() > 0.1
    followed = rows.copy()
    Followed(task(**KINDS[1])).replace(followed)
    other = act(with_context(policy, task(**KINDS[1])), followed, np.zeros((5, 2)))
    agent = LearnedPolicy(task(**KINDS[1]), policy)
    low, high = agent.task.action_bounds
    np.testing.assert_allclose(agent.predict(rows)[0], np.clip(other, low, high), atol=1e-6)


def observed(path: str, speed: float | None = None, **settings: Any) -> tuple[Any, Any]:
    """An observation on a path, with the task."""
    env = gymnasium.make(PATH_TRACKING, trajectory=path, **settings)
    start = {"arc_length": 20.0, **({} if speed is None else {"speed": speed})}
    row, _ = env.reset(options=start)
    return DrivingTask.of(env), row[None].astype(np.float64)


def test_a_reference_that_the_vehicle_can_follow_stays_as_it_is() -> None:
    here, rows = observed("T2")
    seen = rows.copy()
    Followed(here).replace(seen)
    np.testing.assert_allclose(seen, rows, atol=1e-6)


def test_features_see_a_reference_that_friction_allows() -> None:
    slippery = {"name": "ideal", "friction": [0.3, 0.5]}
    here, rows = observed("random-limit-9", vehicle="bmw-320i", conditions=slippery)
    seen = rows.copy()
    Followed(here).replace(seen)
    before, after = here.layout.unpack(rows[0]), here.layout.unpack(seen[0])
    assert (after.preview_speed <= before.preview_speed + 1e-9).all()
    # It is the NMPC's own.
    nodes = local_reference(
        before, 0.1, np.full(20, 0.1), leading=2.0, grip=0.88 * 0.3 * GRAVITY, braking=4.0
    )
    again = local_reference(after, 0.1)
    np.testing.assert_allclose(again.speed, nodes.speed, atol=1e-9)
    np.testing.assert_allclose(again.heading, nodes.heading, atol=1e-9)


def test_a_standing_vehicle_sees_a_reference_that_it_can_reach() -> None:
    here, rows = observed("T2", speed=0.0)
    rows = np.vstack([rows, rows])
    rows[1, 30] = np.nan
    seen = rows.copy()
    Followed(here).replace(seen)
    after = here.layout.unpack(seen[0])
    assert after.reference_speed == pytest.approx(0.3)
    assert after.preview_speed[-1] == pytest.approx(0.3 + 0.8 * 2.0 * 2.0)
    np.testing.assert_array_equal(seen[1], rows[1])


def test_an_agent_with_a_context_answers_any_numbers() -> None:
    here = task(**KINDS[1])
    agent = LearnedPolicy(here, context_policy("actuators"))
    rng, bound = np.random.default_rng(3), here.layout.bound.astype(np.float64)
    rows = rng.uniform(-1.0, 1.0, (400, here.layout.size)) * bound
    rows[::2] = 0.0
    rows[::4, rng.integers(0, here.layout.size, 100)] = 1e300
    rows[1::8, 5] = np.nan
    actions = agent.predict(rows)[0]
    low, high = here.action_bounds
    assert np.isfinite(actions).all()
    assert ((low <= actions) & (actions <= high)).all()


@pytest.mark.parametrize("name", VEHICLES)
def test_what_the_context_says_of_a_vehicle(name: str) -> None:
    here = task(vehicle=name)
    car, known = here.vehicle, dict(zip(CONTEXT, context_of(tuple(CONTEXT), here), strict=True))
    gradient = known["front_compliance"] - known["rear_compliance"]
    assert gradient == pytest.approx(car.understeer_gradient, abs=1e-9)
    assert known["wheelbase"] * known["front_axle_share"] == pytest.approx(car.front_axle_distance)
    assert (known["inverse_least_friction"], known["inverse_largest_friction"]) == (0.0, 0.0)
    slippery = task(vehicle=name, conditions={"name": "ideal", "friction": [0.5, 0.8]})
    assert context_of(
        ("inverse_least_friction", "inverse_largest_friction"), slippery
    ).tolist() == ([2.0, 1.25])
    assert set(CONTEXT_SCALES) == set(CONTEXT)
    scaling = usual_scaling(here, context=tuple(CONTEXT))
    features = with_context(scaling, here).features_of(np.zeros((1, here.layout.size)))[0]
    if car.wheelbase > 2.0:  # scales are those of cars: karts and model cars stand out
        assert np.abs(features[-len(CONTEXT) :]).max() < 2.5


@pytest.mark.parametrize("origin", ["actuators", "lpv-nmpc"])
def test_learners_of_two_vehicles_are_the_agents_that_come_of_them(origin: str) -> None:
    common: dict[str, Any] = {
        "trajectory": "u-turn", "random_start": True, "initial_error_range": (0.3, 0.05, 0.5),
        "time_limit": 2.0,
    }  # fmt: skip
    scaling = usual_scaling(task(), origin, context=tuple(CONTEXT))
    rng = np.random.default_rng(0)
    layers = tuple(
        (rng.normal(0.0, 0.3 / math.sqrt(a), (b, a)), rng.normal(0.0, 0.1, b))
        for a, b in pairwise((scaling.features, 8, 2))
    )
    policy = Policy(
        algorithm="random", layout=task().layout, control_period=0.05, layers=layers,
        activation="tanh", squash="clip", **vars(scaling),
    )  # fmt: skip
    parts = [
        PathTrackingVectorEnv(1, autoreset_mode="SameStep", **common, **kind) for kind in KINDS
    ]
    learner = LearnerVecEnv([agents.sb3_vec_env(part) for part in parts], scaling)
    learner.seed(11)
    features = learner.reset()
    assert np.abs(features[0, -len(CONTEXT) :] - features[1, -len(CONTEXT) :]).max() > 0.5
    rewards = []
    for _ in range(30):
        x = features
        for weight, bias in policy.layers:
            x = x @ weight.T + bias
            x = np.tanh(x) if len(bias) == 8 else np.clip(x, -1.0, 1.0)
        features, reward, _, _ = learner.step(x)
        rewards.append(reward)
    for k, kind in enumerate(KINDS):
        env = gymnasium.make(PATH_TRACKING, **common, **kind)
        agent = agents.make("agents.learned.agent:LearnedPolicy", env, policy=policy)
        observation, _ = env.reset(seed=11 + k)
        driven = []
        for step in range(30):
            action, _ = agent.predict(observation, episode_start=np.array([step == 0]))
            observation, gained, *_ = env.step(action)
            driven.append(float(gained))
        # Features in float32 are summed in another order.
        np.testing.assert_allclose(driven, [one[k] for one in rewards], atol=2e-4)


def test_a_context_survives_its_file(tmp_path: Path) -> None:
    policy = context_policy()
    file = written(tmp_path, policy)
    assert json.loads(file.read_text())["context"] == list(NAMES)
    assert same(read(file), policy)
    (tmp_path / "plain").mkdir()
    plain = written(tmp_path / "plain")
    assert "context" not in json.loads(plain.read_text())
    assert read(plain).context == ()
    assert beside(plain).stat().st_size < beside(file).stat().st_size


@pytest.mark.parametrize(
    ("context", "said"),
    [
        (("wheelbse", *NAMES[1:]), "wheelbase"),
        ((NAMES[1], *NAMES[1:]), "twice"),
        (NAMES[:2], "must have shape"),
        ("wheelbase", "a list of names"),
        ((1, *NAMES[1:]), "entry of the context"),
    ],
)
def test_a_context_that_makes_no_sense_is_refused(context: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(context_policy(), context=context)


def test_vehicles_of_a_training_are_said_where_another_drives(tmp_path: Path) -> None:
    policy = dataclasses.replace(
        context_policy(), training={"vehicle": ["m2-minibus", "bmw-320i"]}, control_period=0.05
    )
    write(policy, tmp_path / "mine.json")
    spec = {"agent": str(tmp_path / "mine.json"), "trajectory": "u-turn"}
    assert run_case({**spec, "vehicle": "bmw-320i"})["warnings"] == []
    (said,) = run_case({**spec, "vehicle": "course-car"})["warnings"]
    assert "was trained for vehicle 'm2-minibus', 'bmw-320i', not for 'course-car'" in said
