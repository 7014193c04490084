"""Agents of learned policies: what they compute, what they refuse, what belongs to a case."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import agents
from agents import registry
from agents.base import DrivingTask
from agents.learned import read, write
from agents.learned.agent import Bc, LearnedPolicy, Ppo, Sac
from agents.learned.network import Network
from experiments.cli import main
from experiments.run.case import Case, run_case
from lpv_track_env import PATH_TRACKING
from lpv_track_env.observation import ObservationLayout
from tests.helpers.learned_policies import (
    act,
    driving_file,
    driving_policy,
    observations,
    plain_act,
    random_policy,
    written,
)

SHAPES = ((), (1,), (33,), (5, 64, 3))


def environment(**settings: Any) -> gymnasium.Env:
    return gymnasium.make(PATH_TRACKING, **{"trajectory": "u-turn", **settings})


def task(**settings: Any) -> DrivingTask:
    return DrivingTask.of(environment(**settings))


# What the network computes.


@pytest.mark.parametrize("origin", ["zero", "actuators", "lpv-nmpc"])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("squash", ["tanh", "clip"])
@pytest.mark.parametrize("hidden", SHAPES)
def test_the_network_is_the_policys_formula(
    origin: str, activation: str, squash: str, hidden: tuple[int, ...]
) -> None:
    policy = random_policy(origin=origin, activation=activation, squash=squash, hidden=hidden)
    rows, base = observations(20), np.zeros((20, 2))
    seen = rows
    if origin == "actuators":
        base = rows[:, [3, 4]]
    elif origin == "lpv-nmpc":
        base = np.random.default_rng(1).normal(size=(20, 2))
        seen = np.hstack([rows, base])
    expected = plain_act(policy, seen, base)
    given = base if origin == "lpv-nmpc" else np.full((20, 2), 7.0)
    # float32 sums of some tens of terms of size one
    np.testing.assert_allclose(act(policy, rows, given), expected, atol=2e-5)
    np.testing.assert_array_equal(
        act(policy, rows, given, bound=0.5), act(policy, rows, given).clip(-0.5, 0.5)
    )


@pytest.mark.parametrize("origin", ["zero", "actuators", "lpv-nmpc"])
def test_a_symmetric_policy_does_not_know_left_from_right(origin: str) -> None:
    policy = random_policy(origin=origin, symmetric=True, centre=np.array([0.1, 0.0]))
    once = dataclasses.replace(policy, symmetric=False)
    rng, size = np.random.default_rng(4), policy.layout.size
    rows, base = rng.normal(size=(50, size)), rng.normal(scale=0.1, size=(50, 2))
    flip, turned = policy.layout.mirror.astype(np.float64), np.array([1.0, -1.0])
    far = np.array([9.0, 9.0])
    results = {}
    for name, kind, given, at in (
        ("both", policy, rows, base), ("mirrored", policy, rows * flip, base * turned),
        ("one", once, rows, base), ("other", once, rows * flip, base * turned),
    ):  # fmt: skip
        results[name] = at.copy()
        assert Network.of(kind, -far, far).act(given, results[name]) == 0
    np.testing.assert_array_equal(results["mirrored"], results["both"] * turned)
    mean = 0.5 * (results["one"] + results["other"] * turned)
    np.testing.assert_allclose(results["both"], mean, atol=1e-12)
    assert np.abs(results["one"] - results["other"] * turned).max() > 0.1
    with pytest.raises(ValueError, match="steers about 0"):
        random_policy(symmetric=True)


def test_features_are_clipped() -> None:
    policy = random_policy(feature_limit=0.01)
    rows = observations(5)
    expected = plain_act(policy, rows, np.zeros((5, 2)))
    np.testing.assert_allclose(act(policy, rows, np.zeros((5, 2))), expected, atol=1e-6)
    wider = plain_act(random_policy(feature_limit=1e9), rows, np.zeros((5, 2)))
    assert np.abs(wider - expected).max() > 0.1


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_the_network_is_torchs(activation: str) -> None:
    torch = pytest.importorskip("torch")
    policy = random_policy(hidden=(64, 64), activation=activation, squash="clip")
    kind = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[activation]
    modules: list[Any] = []
    for weight, bias in policy.layers:
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict(
            {"weight": torch.tensor(weight.copy()), "bias": torch.tensor(bias.copy())}
        )
        modules += [linear, kind()]
    network = torch.nn.Sequential(*modules[:-1])
    rows = observations(50)
    features = torch.nn.functional.linear(
        torch.tensor(rows, dtype=torch.float32),
        torch.tensor(policy.feature_weight.copy()),
        torch.tensor(policy.feature_bias.copy()),
    ).clamp(-3.0, 3.0)
    with torch.no_grad():
        u = network(features).clamp(-1.0, 1.0).numpy().astype(np.float64)
    expected = policy.centre + policy.half * u
    np.testing.assert_allclose(act(policy, rows, np.zeros((50, 2))), expected, atol=1e-5)


@pytest.mark.parametrize("n", [2, 7, 64])
def test_a_row_does_not_depend_on_the_others(n: int) -> None:
    policy = random_policy(hidden=(33, 64))
    rows = observations(n)
    alone = np.vstack([act(policy, row[None], np.zeros((1, 2))) for row in rows])
    np.testing.assert_array_equal(act(policy, rows, np.zeros((n, 2))), alone)
    np.testing.assert_array_equal(act(policy, rows[::-1].copy(), np.zeros((n, 2))), alone[::-1])


@pytest.mark.parametrize("squash", ["tanh", "clip"])
def test_where_the_network_makes_no_number_the_vehicle_stops(squash: str) -> None:
    # Two sums beyond float32 whose difference is no number.
    huge = np.full((4, 12), 3e38, dtype=np.float32)
    layers = ((huge, np.zeros(4)), (np.array([[1e38, -1e38, 1.0, 1.0]] * 2), np.zeros(2)))
    policy = random_policy(
        activation="relu", squash=squash, feature_weight=np.zeros((12, 48)),
        feature_bias=np.full(12, 3.0), layers=layers,
    )  # fmt: skip
    agent = LearnedPolicy(task(), policy)
    row = observations(1)[0]
    row[0], row[4] = 4.0, 0.2
    lost = row.copy()
    lost[7] = np.nan
    action = agent.predict(row)[0]
    np.testing.assert_array_equal(action, agent.predict(lost)[0])
    assert action[0] < 0.0
    assert action[1] == np.float32(0.2)


# An observation that is not finite.


def test_a_blind_residual_leaves_it_to_the_nmpc() -> None:
    env = environment()
    residual, nmpc = agents.make(str(driving_file("residual")), env), agents.make("lpv-nmpc", env)
    observation, _ = env.reset(options={"arc_length": 45.0, "lateral_error": 0.3})
    first = residual.predict(observation)[0], nmpc.predict(observation)[0]
    assert abs(first[0] - first[1]).max() > 1e-4
    observation[5] = np.nan
    np.testing.assert_array_equal(residual.predict(observation)[0], nmpc.predict(observation)[0])


def test_rows_that_are_blind_do_not_touch_the_others() -> None:
    agent = LearnedPolicy(task(), random_policy())
    rows = observations(4)
    whole = agent.predict(rows)[0]
    rows[1, 5], rows[3, 40] = np.inf, 1e39  # more than float32 holds
    torn = agent.predict(rows)[0]
    np.testing.assert_array_equal(torn[[0, 2]], whole[[0, 2]])
    assert np.isfinite(torn).all()


# On top of the NMPC.


def test_without_a_residual_it_is_the_nmpc() -> None:
    layout = ObservationLayout()
    nothing = random_policy(origin="lpv-nmpc", layout=layout, centre=np.zeros(2), half=np.zeros(2))
    env = environment()
    residual, nmpc = LearnedPolicy(DrivingTask.of(env), nothing), agents.make("lpv-nmpc", env)
    observation, _ = env.reset(options={"lateral_error": 0.3})
    memory = own = None
    for k in range(20):
        start = np.array([k in {0, 12}])
        action, memory = residual.predict(observation, memory, start)
        expected, own = nmpc.predict(observation, own, start)
        np.testing.assert_array_equal(action, expected)
        told, plain = residual.diagnostics(memory[0]), nmpc.diagnostics(own[0])  # type: ignore[attr-defined]
        assert told["status"] == "SUCCESS"
        np.testing.assert_array_equal(told["plan"], plain["plan"])
        observation = env.step(action)[0]


def test_a_case_of_a_residual_counts_the_nmpcs_solves() -> None:
    result = run_case({"agent": str(driving_file("residual")), "trajectory": "u-turn"})
    assert (result["status"], result["end"]) == ("ok", "finished")
    assert result["solver"]["solves"] > 100
    assert result["solver"]["failures"] == 0


# Environments that it was not made for.


def test_another_preview_is_refused_with_what_to_do() -> None:
    with pytest.raises(ValueError, match="sees") as raised:
        agents.make(str(driving_file("linear")), environment(preview_steps=30, preview_period=0.2))
    assert str(raised.value) == (
        f"policy {driving_file('linear')} sees preview_steps=20, preview_period=0.1 s; this "
        "environment has 30 and 0.2: make the environment with preview_steps=20, "
        "preview_period=0.1, or train one for it"
    )


def test_both_at_once_are_told_at_once() -> None:
    with pytest.raises(ValueError, match=r"with .*preview_period=0\.1, control_period=0\.05, or"):
        agents.make(
            str(driving_file("linear")), environment(control_period=0.02, preview_period=0.02)
        )


def test_another_control_period_is_refused_with_what_to_do() -> None:
    with pytest.raises(
        ValueError,
        match=r"policy 'ppo' acts every 0\.05 s, this environment every 0\.02: make the "
        r"environment with control_period=0\.05, or train one for it",
    ):
        LearnedPolicy(task(control_period=0.02), random_policy())


def test_periods_that_differ_by_rounding_are_the_same() -> None:
    policy = random_policy(control_period=0.1 * 3, layout=ObservationLayout(20, 0.1 * 3))
    LearnedPolicy(task(control_period=0.3, preview_period=0.3), policy)


# Names.


@pytest.mark.parametrize("kind", [Ppo, Sac, Bc])
def test_the_named_agents_take_a_policy(kind: Callable[..., LearnedPolicy], tmp_path: Path) -> None:
    file, row = written(tmp_path), observations(1)[0]
    expected = LearnedPolicy(task(), file).predict(row)[0]
    for given in (file, str(file), read(file)):
        np.testing.assert_array_equal(kind(task(), policy=given).predict(row)[0], expected)


def test_shipped_policies_are_named_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(registry.REGISTRY, "ppo", "agents.learned.agent:Ppo")
    monkeypatch.setattr(registry, "CHECKPOINTS", tmp_path)
    spec = {"agent": "ppo", "trajectory": "straight"}
    assert registry.source_file("ppo") is None
    without = Case(**spec).id
    write(random_policy(), tmp_path / "ppo.json")
    assert registry.source_file("ppo") == tmp_path / "ppo.json"
    assert Case(**spec).id != without
    file = written(tmp_path, name="other.json")
    agent = agents.make("ppo", environment(), policy=str(file))
    assert isinstance(agent, Ppo)
    with pytest.raises(ValueError, match="'ppo' has no setting 'polcy'; known: policy"):
        agents.make("ppo", environment(), polcy=str(file))


@pytest.mark.parametrize("name", ["none.json", "none.safetensors", "none.zip"])
def test_a_policy_that_is_not_there_is_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = str(tmp_path / name), str(tmp_path / "out")
    arguments = ["--agents", file, "--trajectories", "straight", "--out", out]
    assert main(["benchmark", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert name in said
    assert not Path(out).exists()


# Cases.


@pytest.mark.parametrize(
    "spec",
    [{"agent": "{file}"}, {"agent": "stanley", "agent_settings": {"policy": "{file}"}}],
    ids=["name", "setting"],
)
def test_a_cases_id_changes_with_the_policys_weights(spec: dict[str, Any], tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    spec = json.loads(json.dumps({**spec, "trajectory": "straight"}).replace("{file}", str(file)))
    ids = []
    for policy in (random_policy(0), random_policy(1), random_policy(0)):
        write(policy, file)
        ids.append(Case(**spec).id)
    assert ids[0] == ids[2] != ids[1]


def test_a_benchmark_with_a_policy_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "experiments.report.build.write_report", lambda folder, _: folder / "cases.jsonl"
    )
    monkeypatch.chdir(tmp_path)
    write(driving_policy("linear"), tmp_path / "mine.json")
    arguments = ["--agents", "mine.json", "--trajectories", "u-turn", "--workers", "1"]
    assert main(["benchmark", *arguments, "--out", "results"]) == 0
    (case,) = [json.loads(line) for line in Path("results/cases.jsonl").read_text().splitlines()]
    assert (case["agent"], case["status"], case["end"]) == ("mine.json", "ok", "finished")
    assert "mine.json" in capsys.readouterr().out


def test_another_vehicle_than_in_training_is_said_in_the_result(tmp_path: Path) -> None:
    training = {"vehicle": "m2-minibus"}
    policy = dataclasses.replace(driving_policy("linear"), training=training)
    file = written(tmp_path, policy)
    spec = {"agent": str(file), "trajectory": "u-turn"}
    assert run_case(spec)["warnings"] == []
    (said,) = run_case({**spec, "vehicle": "course-car"})["warnings"]
    assert "was trained for vehicle 'm2-minibus', not for 'course-car'" in said
    # A shipped policy's own folder would make results differ from installation to installation.
    (said,) = run_case({**spec, "agent": "sac", "vehicle": "course-car"})["warnings"]
    assert said == "policy sac.json was trained for vehicle 'm2-minibus', not for 'course-car'"
