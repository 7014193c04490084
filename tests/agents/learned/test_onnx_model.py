"""ONNX models of policies act as the agents do."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import agents
from agents.base import CHECKPOINTS, DrivingTask
from agents.learned.policy import Policy, read
from experiments import cli
from lpv_track_env.env import PathTrackingEnv

reference = pytest.importorskip("onnx.reference")
onnxruntime = pytest.importorskip("onnxruntime")


def task(vehicle: str = "m2-minibus") -> DrivingTask:
    return DrivingTask.of(PathTrackingEnv("T2", vehicle))


def model(policy: Policy, given: DrivingTask) -> Any:
    from agents.learned.onnx_model import model_of

    return model_of(policy, given)


def small(**changes: Any) -> Policy:
    rng, inputs = np.random.default_rng(1), 48 + 2 * (changes.get("origin") == "lpv-nmpc")

    def weights(outputs: int, count: int) -> Any:
        return rng.normal(size=(outputs, count)) / np.sqrt(count)  # as networks are initialised

    given: dict[str, Any] = {
        "algorithm": "mine", "layout": task().layout, "control_period": 0.05,
        "feature_weight": weights(16, inputs), "feature_bias": rng.normal(size=16),
        "feature_limit": 3.0, "activation": "tanh", "squash": "tanh", "origin": "zero",
        "layers": ((weights(8, 16), rng.normal(size=8)), (weights(2, 8), np.zeros(2))),
        "centre": np.array([0.1, 0.0]), "half": np.array([2.0, 0.3]),
    }  # fmt: skip
    return Policy(**given | changes)


@pytest.mark.parametrize("vehicle", ["m2-minibus", "bmw-320i"])
@pytest.mark.parametrize("name", ["ppo", "sac", "bc"])
def test_shipped_policies_become_the_same_model(name: str, vehicle: str) -> None:
    from agents.learned.onnx_model import difference

    policy, given = read(CHECKPOINTS / f"{name}.json"), task(vehicle)
    assert difference(policy, given, model(policy, given)) < 5e-6


@pytest.mark.parametrize("squash", ["tanh", "clip"])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("origin", ["zero", "actuators", "lpv-nmpc"])
def test_every_kind_of_policy(origin: str, symmetric: bool, activation: str, squash: str) -> None:
    from agents.learned.onnx_model import difference

    policy = small(origin=origin, symmetric=symmetric, activation=activation, squash=squash)
    made = model(policy, task())
    assert difference(policy, task(), made) < 5e-6
    # A model of other weights is told apart.
    assert difference(small(origin=origin, feature_limit=1.0), task(), made) > 1e-3


def test_a_drive_of_the_model_is_that_of_the_agent() -> None:
    env = PathTrackingEnv("T2", time_limit=5.0, initial_error_range=(0.5, 0.1, 1.0))
    policy = read(CHECKPOINTS / "sac.json")
    agent = agents.make("sac", env)
    session = onnxruntime.InferenceSession(model(policy, task()).SerializeToString())
    # The reference evaluator of ONNX itself agrees with the runtime.
    evaluator = reference.ReferenceEvaluator(model(policy, task()))
    observation, _ = env.reset(seed=0)
    for _ in range(100):
        wanted, _ = agent.predict(observation)
        inputs = {"observation": observation[None]}
        [found], [other] = session.run(None, inputs), evaluator.run(None, inputs)
        np.testing.assert_allclose(found[0], wanted, rtol=0, atol=5e-6)
        np.testing.assert_allclose(other[0], wanted, rtol=0, atol=5e-6)
        observation, *_ = env.step(found[0])


def test_the_command_writes_a_model_with_its_description(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bc.onnx"
    assert cli.main(["export", "bc", "--out", str(file), "--vehicle", "bmw-320i"]) == 0
    assert "of the agent on 1000 random observations" in capsys.readouterr().out
    session = onnxruntime.InferenceSession(file)
    words = session.get_modelmeta().custom_metadata_map
    low, high = task("bmw-320i").action_bounds
    assert json.loads(words["action_low"]) == low.tolist()
    assert json.loads(words["action_high"]) == high.tolist()
    assert (words["vehicle"], words["observation_digest"]) == ("bmw-320i", task().layout.digest)
    assert json.loads(words["control_period_s"]) == 0.05
    assert sum(count for *_, count in json.loads(words["observation"])[1:]) == 48
    assert json.loads(words["context"])["wheelbase"] == pytest.approx(
        task("bmw-320i").vehicle.wheelbase
    )


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["stanley", "--out", "a.onnx"], "no learned policy"),
        (["ppo", "--out", "a.pt"], "must be a .onnx"),
        (["none.json", "--out", "a.onnx"], "none.json"),
    ],
)
def test_what_cannot_be_exported_is_told(
    words: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["export", *words]) == 2
    error = capsys.readouterr().err
    assert reason in error
    assert len(error.splitlines()) == 1
