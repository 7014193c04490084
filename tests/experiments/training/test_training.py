"""Training: exact, resumable, honest about what it trains on, and it learns."""

import importlib.util
import io
import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch
from stable_baselines3.common.logger import Logger

from agents.learned.context import CONTEXT
from agents.learned.policy import read as read_policy
from experiments import cli
from experiments.jobs import checkpoint
from experiments.jobs.job import (
    JOBS,
    TRAINING_EPISODES,
    TRAINING_PATHS,
    VALIDATION_EPISODES,
    VALIDATION_PATHS,
    VERSIONS,
    Listener,
    difference,
    episode_seed,
    load_paths,
)
from experiments.run.case import run_case
from experiments.run.folder_lock import locked
from experiments.run.suites import HELD_OUT, SIX
from experiments.training import ALGORITHMS
from experiments.training.loop import cases, make_trainer, train, validate
from experiments.training.settings import HYPERPARAMETERS, REWARD, TrainingSettings, usual
from experiments.training.trainer import path_names
from lpv_track_env.vehicle import VEHICLES
from tests.helpers.policy_files import beside

TINY: dict[str, dict[str, Any]] = {
    "ppo": {"steps": 768, "hyperparameters": {"rollout": 16, "batch": 64}},
    "residual": {"steps": 768, "hyperparameters": {"rollout": 16, "batch": 64}},
    "sac": {"steps": 384, "hyperparameters": {"learning_starts": 200, "gradient_steps": 2,
                                              "batch": 32, "buffer": 256}},
    "td3": {"steps": 384, "hyperparameters": {"learning_starts": 64, "gradient_steps": 3,
                                              "batch": 32, "buffer": 256}},
    "bc": {"steps": 768, "hyperparameters": {"round": 16, "updates": 20, "batch": 64}},
}  # fmt: skip


def tiny(algorithm: str, **changes: Any) -> TrainingSettings:
    given = {
        "envs": 16, "paths": 1, "validation": 1, "time_limit": 3.0, **TINY[algorithm], **changes,
    }  # fmt: skip
    return usual(algorithm, **{"segment": given["steps"] // 3, **given})


def mixed(**changes: Any) -> TrainingSettings:
    return tiny("bc", situations="limits", envs=78, steps=4000, **changes)


def silent(*_: Any) -> None:
    return


SILENT = Listener()


class AfterSegments(Listener):
    """Calls a function after every segment."""

    def __init__(self, call: Callable[[dict[str, Any]], None]) -> None:
        self.call = call

    def line(self, line: dict[str, Any]) -> None:
        self.call(line)


def run(settings: TrainingSettings, folder: Path, listener: Listener = SILENT) -> dict[str, Any]:
    """Train; the last checkpoint."""
    train(settings, folder, listener, command="test")
    kept = checkpoint.read(folder)
    assert kept is not None
    return kept


def same_bits(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same_bits(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same_bits, one, other))
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and one.numpy().tobytes() == other.numpy().tobytes()
    return bool(one == other)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_same_seed_same_bits_also_when_interrupted(algorithm: str, tmp_path: Path) -> None:
    settings = tiny(algorithm)
    whole = run(settings, tmp_path / "whole")
    assert settings.segments == len(whole["lines"]) == 3
    assert whole["lines"][-1]["steps"] >= settings.steps

    def interrupt(line: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(settings, tmp_path / "parts", AfterSegments(interrupt))
    kept = checkpoint.read(tmp_path / "parts")
    assert kept is not None
    assert len(kept["lines"]) == 1
    assert not same_bits(kept["trainer"], whole["trainer"])
    parts = run(settings, tmp_path / "parts")
    assert same_bits(parts["trainer"], whole["trainer"])
    validations = [[line["validation"] for line in kept["lines"]] for kept in (whole, parts)]
    assert validations[0] == validations[1]
    weights = [beside(tmp_path / name / "policy.json") for name in ("whole", "parts")]
    assert weights[0].read_bytes() == weights[1].read_bytes()


def test_another_seed_gives_other_weights(tmp_path: Path) -> None:
    one, other = (
        run(tiny("bc", seed=seed), tmp_path / str(seed))["trainer"]["network"] for seed in (0, 1)
    )
    assert not same_bits(one, other)


def test_no_training_sees_what_is_evaluated(tmp_path: Path) -> None:
    seen: set[str] = set()
    for seed in (0, 1, 999):
        settings = tiny("ppo", seed=seed, paths=1000)
        names = set(path_names(settings))
        names |= set(path_names(mixed(seed=seed, paths=1000)))
        assert not names & seen
        seen |= names
        assert episode_seed(settings.seed, 0) >= TRAINING_EPISODES
        episodes = [episode_seed(settings.seed, k) for k in range(3)]
        assert np.diff(episodes).min() > settings.envs
    numbers = [int(name.rpartition("-")[2]) for name in seen]
    assert TRAINING_PATHS <= min(numbers) <= max(numbers) < VALIDATION_PATHS
    both = [
        *cases(tiny("ppo", validation=50), tmp_path),
        *cases(mixed(validation=50), tmp_path),
    ]
    validated = {case["trajectory"] for case in both}
    assert not validated & seen
    assert min(int(name.rpartition("-")[2]) for name in validated) >= VALIDATION_PATHS
    drawn = {case["seed"] for case in both}
    assert VALIDATION_EPISODES <= min(drawn) <= max(drawn) < TRAINING_EPISODES
    for name in (*SIX, "T2-raw", *HELD_OUT, "random-limit-3", "circuit-0"):
        with pytest.raises(ValueError, match="is for evaluation"):
            tiny("ppo", trajectories=("circle", name))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"hyperparameters": {"learning_rat": 1.0}}, "learning_rate"),
        ({"hyperparameters": {"learning_rate": "fast"}}, "must be like"),
        ({"hyperparameters": {"batch": 0}}, "batch must be in"),
        ({"hyperparameters": {"hidden": []}}, "must be like"),
        ({"hyperparameters": {"discount": float("nan")}}, "must be like"),
        ({"hyperparameters": {"activation": "selu"}}, "relu"),
        ({"hyperparameters": {"origin": "actuator"}}, "actuators"),
        ({"hyperparameters": {"origin": "lpv-nmpc"}}, "only residual"),
        ({"reward": {"laterall": 1.0}}, "lateral"),
        ({"reward": {"lateral": "high"}}, "must be a number"),
        ({"conditions": ("realtme",)}, "realtime"),
        ({"conditions": ()}, "at least one"),
        ({"envs": 1}, "envs must be at least 2"),
        ({"situations": "limit"}, "nearest: limits"),
        ({"situations": "limits"}, "envs must be at least 39"),
        ({"situations": "limits", "vehicle": "course-car"}, "leave out vehicle"),
        ({"situations": "limits", "trajectories": ("circle",)}, "leave out vehicle"),
        ({"seed": 1000}, "seed"),
        ({"vehicle": "m2"}, "m2-minibus"),
        ({"segment": 0}, "segment"),
        ({"segment": 255}, "at least 256 steps"),
        ({"segment": 768, "start": "clone.json"}, "less than steps, 768"),
        ({"hyperparameters": {"activation": "gelu"}}, "tanh"),
        ({"hyperparameters": {"batch": 1}}, "batch must be in"),
        ({"hyperparameters": {"discount": 1.5}}, "discount must be in"),
        ({"hyperparameters": {"deviation": 0.0}}, "deviation must be in"),
        ({"paths": 1001}, "at most 1000"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        tiny("ppo", **changes)
    with pytest.raises(ValueError, match="ppo"):
        usual("pppo")


def test_settings_survive_json_and_tell_what_differs() -> None:
    for algorithm in ALGORITHMS:
        settings = usual(algorithm)
        stored = json.loads(json.dumps(settings.as_dict()))
        assert difference(settings, stored) is None
        assert settings.hyperparameters == HYPERPARAMETERS[algorithm]
        assert "seed is 3, there 0" in str(difference(usual(algorithm, seed=3), stored))


def trained_clone(folder: Path, **changes: Any) -> Path:
    settings = tiny("bc", steps=6000, segment=6000, envs=32, paths=2, time_limit=20.0, **changes)
    train(settings, folder, SILENT, command="test")
    return folder / "policy.json"


def test_cloning_learns_to_drive(tmp_path: Path) -> None:
    policy = trained_clone(tmp_path, hyperparameters={"round": 100, "updates": 300, "batch": 512})
    for kind, limit in (("simulation", 0.1), ("realtime", 0.15)):
        result = run_case({"agent": str(policy), "trajectory": "random-1", "conditions": kind})
        assert result["end"] == "finished"
        assert result["metrics"]["ale"] < limit
    spent = read_policy(policy).training
    assert spent["steps"] == spent["solves"] >= 6000
    assert spent["seconds"] > 0.0
    assert spent["settings"]["algorithm"] == "bc"


def test_a_training_mixes_situations(tmp_path: Path) -> None:
    settings = mixed()
    trainer = make_trainer(settings, load_paths(path_names(settings)), Logger(None, []))
    sizes = [rows.stop - rows.start for rows in trainer.env.rows]
    shares = [part.share for part in settings.parts]
    assert sum(sizes) == 78
    assert all(size // share >= 2 for size, share in zip(sizes, shares, strict=True))
    for part, task in zip(settings.parts, trainer.env.tasks, strict=True):
        assert task.vehicle == part.car()
    assert {task.friction_range for task in trainer.env.tasks} >= {(0.8, 0.8), (0.5, 1.0)}
    train(settings, tmp_path, SILENT, command="test")
    policy = read_policy(tmp_path / "policy.json")
    assert policy.context == tuple(CONTEXT)
    assert {"m2-minibus", "bmw-320i"} < set(policy.training["vehicle"])
    assert policy.training["settings"]["situations"] == "limits"
    own = usual("ppo", start=str(tmp_path / "policy.json"))
    with pytest.raises(ValueError, match="differs in its context"):
        make_trainer(own, load_paths(path_names(tiny("ppo")))[:1] * 48, Logger(None, []))


def test_ppo_learns_to_drive_from_nothing(tmp_path: Path) -> None:
    settings = usual(
        "ppo", steps=1_000_000, segment=1_000_000, envs=256, paths=4, validation=1,
        conditions=("simulation",), reward={**REWARD, "lateral_scale": 0.1},
        hyperparameters={"batch": 2048, "last_learning_rate": 3e-4},
    )  # fmt: skip
    lines = train(settings, tmp_path, SILENT, command="test")
    assert lines[-1]["validation"]["finished"] == 1.0
    result = run_case({"agent": str(tmp_path / "policy.json"), "trajectory": "random-1"})
    assert result["end"] == "finished"
    assert result["metrics"]["ale"] < 0.3


def test_a_training_starts_from_a_policy_and_does_not_lose_it_at_once(tmp_path: Path) -> None:
    start = trained_clone(tmp_path / "clone")
    settings = tiny("ppo", start=str(start))
    other_layers = {"hidden": [64], **TINY["ppo"]["hyperparameters"]}
    zero = {"origin": "zero", **TINY["ppo"]["hyperparameters"]}
    trainer = make_trainer(settings, load_paths(path_names(settings)), Logger(None, []))
    before = read_policy(start)
    for (weight, bias), (given, offset) in zip(
        trainer.policy({}).layers, before.layers, strict=True
    ):
        np.testing.assert_array_equal(weight, given)
        np.testing.assert_array_equal(bias, offset)
    trainer.segment(0, silent)
    np.testing.assert_array_equal(trainer.policy({}).layers[0][0], before.layers[0][0])
    trainer.segment(1, silent)
    assert (trainer.policy({}).layers[0][0] != before.layers[0][0]).any()
    for changes, said in (
        ({"hyperparameters": other_layers}, "hidden layers"),
        ({"hyperparameters": zero}, "origin of actions"),
        ({"vehicle": "course-car"}, "features or range"),
        ({"preview_period": 0.05}, "preview period"),
        ({"preview_steps": 30}, "preview steps"),
    ):
        other = tiny("ppo", start=str(start), **changes)
        with pytest.raises(ValueError, match=said):
            make_trainer(other, load_paths(path_names(other)), Logger(None, []))
    with pytest.raises(ValueError, match="squashing"):
        make_trainer(
            tiny("sac", start=str(start), hyperparameters={"activation": "tanh"}),
            load_paths(path_names(settings)), Logger(None, []),
        )  # fmt: skip


class Payload:
    """Writes a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return Path.touch, (self.marker,)


def test_a_checkpoint_that_would_run_code_is_refused(tmp_path: Path) -> None:
    marker, file = tmp_path / "ran", tmp_path / "checkpoint.pt"
    torch.save({"format": checkpoint.FORMAT, "trainer": Payload(marker)}, file)
    with pytest.raises(ValueError, match="cannot be read") as caught:
        checkpoint.read(tmp_path)
    assert "\n" not in str(caught.value)
    assert not marker.exists()
    torch.load(file, weights_only=False)
    assert marker.exists()


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    assert checkpoint.read(tmp_path) is None
    checkpoint.write(tmp_path, {"trainer": {"network": torch.arange(100)}, "lines": []})
    kept = checkpoint.read(tmp_path)
    assert kept is not None
    assert kept["trainer"]["network"].tolist() == list(range(100))
    whole = (tmp_path / "checkpoint.pt").read_bytes()
    for size in (0, 1, len(whole) // 2, len(whole) - 1):
        (tmp_path / "checkpoint.pt").write_bytes(whole[:size])
        with pytest.raises(ValueError, match="cannot be read"):
            checkpoint.read(tmp_path)
    buffer = io.BytesIO()
    torch.save({"format": "lpv-track-checkpoint/0"}, buffer)
    (tmp_path / "checkpoint.pt").write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="checkpoint/0"):
        checkpoint.read(tmp_path)


def command(*words: str) -> int:
    return cli.main(["train", *words])


def test_the_command_trains_resumes_and_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "out")
    words = [
        "bc", "--steps", "512", "--segment", "256", "--envs", "16", "--paths", "1", "--set",
        "round=16", "updates=5", "--out", out,
    ]  # fmt: skip
    assert command(*words) == 0
    said = capsys.readouterr().out
    assert "512 steps" in said
    assert "  best\n" in said
    assert (tmp_path / "out" / "training.png").read_bytes().startswith(b"\x89PNG")
    again = read_policy(tmp_path / "out" / "policy.json").training["command"]
    assert again == (
        "lpv-track train bc --steps 512 --seed 0 --paths 1 --envs 16 --segment 256 "
        "--set round=16 updates=5"
    )
    assert command(*words) == 2
    assert "--resume" in capsys.readouterr().err
    assert command(*words, "--resume") == 0
    assert command(*words, "--resume", "--seed", "1") == 2
    assert "seed is 1, there 0" in capsys.readouterr().err
    for bad, told in (
        (["--steps", "0.5"], "whole number"), (["--hours", "-1"], "--hours"),
        (["--trajectories", "T1"], "evaluation"), (["--fast"], "ppo"),
        (["--set", "rounds=3"], "round"), (["--from", "none.json"], "none.json"),
        (["--device", "abacus"], "--device cpu"), (["--device", "cuda:99"], "--device cpu"),
        (["--conditions-set", "friction=0.5"], "--conditions"),
    ):  # fmt: skip
        assert command(*words[:-1], str(tmp_path / "other"), *bad) == 2, bad
        error = capsys.readouterr().err
        assert told in error
        assert error.count("\n") == 1


def test_hours_become_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert command(
        "bc", "--hours", "0.0005", "--segment", "256", "--envs", "16", "--paths", "1", "--set",
        "round=16", "updates=5", "--out", str(out),
    ) == 0  # fmt: skip
    assert "steps a second" in capsys.readouterr().out
    training = read_policy(out / "policy.json").training
    steps = json.loads((out / "settings.json").read_text())["steps"]
    assert f"--steps {steps}" in training["command"]


def test_the_best_policy_on_validation_is_kept(tmp_path: Path) -> None:
    kept = run(tiny("bc"), tmp_path)
    losses = [line["validation"]["loss"] for line in kept["lines"]]
    best = int(np.argmin(losses))
    policy = read_policy(tmp_path / "policy.json")
    assert policy.training["validation"]["loss"] == min(losses)
    assert policy.training["kept_at"] == kept["lines"][best]["steps"]
    assert policy.training["steps"] == kept["lines"][-1]["steps"]
    assert [line["best"] for line in kept["lines"]][best]
    # The weights are those that were validated then.
    assert validate(tiny("bc"), tmp_path / "policy.json") == policy.training["validation"]
    assert not list(tmp_path.glob("candidate*"))


def test_a_training_outlives_the_file_that_it_started_from(tmp_path: Path) -> None:
    start = tmp_path / "start" / "policy.json"
    train(tiny("bc", steps=256, segment=256), start.parent, SILENT, command="first")

    def take_away(line: dict[str, Any]) -> None:
        start.unlink(missing_ok=True)

    train(tiny("ppo", start=str(start)), tmp_path / "out",
          AfterSegments(take_away), command="second")  # fmt: skip
    training = read_policy(tmp_path / "out" / "policy.json").training
    assert (training["start"], training["command"]) == ("first", "second")
    assert training["steps"] == 768 + 256


def test_what_fails_leaves_no_thread_behind(tmp_path: Path) -> None:
    def full(line: dict[str, Any]) -> None:
        raise OSError("no space left on device")

    before = threading.active_count()
    with pytest.raises(OSError, match="no space"):
        train(tiny("ppo"), tmp_path, AfterSegments(full), command="test")
    assert threading.active_count() == before


def test_a_file_that_changed_is_another_training(tmp_path: Path) -> None:
    car = tmp_path / "mine.json"
    car.write_text(json.dumps(VEHICLES["m2-minibus"].as_dict()))
    settings = tiny("bc", vehicle=str(car))
    stored = settings.as_dict()
    assert list(stored["files"]) == [str(car)]
    assert difference(settings, stored) is None
    car.write_text(json.dumps(VEHICLES["course-car"].as_dict()))
    assert "files is" in str(difference(settings, stored))


def test_one_process_trains_in_a_folder(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(ValueError, match="another process writes"):
        run(tiny("bc"), tmp_path)
    assert len(run(tiny("bc"), tmp_path)["lines"]) == 3


def test_a_training_made_with_other_versions_is_not_gone_on_with(tmp_path: Path) -> None:
    settings = tiny("bc")
    run(settings, tmp_path)
    own = json.loads((tmp_path / VERSIONS).read_text())
    assert {"python", "machine", "numpy", "numba", "torch", "stable-baselines3"} <= set(own)
    (tmp_path / VERSIONS).write_text(json.dumps({**own, "numpy": "1.0.0"}))
    with pytest.raises(ValueError, match=f"made with numpy 1.0.0, here is {own['numpy']}: "):
        run(settings, tmp_path)
    # A package that was not there then could not compute anything; older folders have no versions.
    earlier = {name: version for name, version in own.items() if name != JOBS}
    (tmp_path / VERSIONS).write_text(json.dumps(earlier))
    with pytest.raises(ValueError, match="of another version of lpv-track-env, whose preview and"):
        run(settings, tmp_path)
    (tmp_path / VERSIONS).write_text(json.dumps({JOBS: own[JOBS], "numpy": own["numpy"]}))
    run(settings, tmp_path)
    (tmp_path / VERSIONS).unlink()
    run(settings, tmp_path)
    assert json.loads((tmp_path / VERSIONS).read_text()) == own


@pytest.mark.parametrize(
    "change",
    [
        {"lines": 3}, {"lines": [{"steps": 1}]}, {"trainer": {}}, {"trainer": None},
        {"trainer": {"network": {"weight": 1}}}, {"lines": [{"steps": "few"}]},
    ],
)  # fmt: skip
def test_a_checkpoint_that_does_not_fit_is_refused_in_one_line(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    settings = tiny("bc")
    run(settings, tmp_path)
    stored = checkpoint.read(tmp_path)
    assert stored is not None
    checkpoint.write(tmp_path, {**stored, **change})
    with pytest.raises(ValueError, match=r"checkpoint\.pt cannot be read .*: remove it") as caught:
        run(settings, tmp_path)
    assert "\n" not in str(caught.value)


def test_the_help_names_every_hyperparameter(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command("--help")
    said = " ".join(capsys.readouterr().out.split())
    for algorithm, defaults in HYPERPARAMETERS.items():
        assert algorithm in said
        for name in defaults:
            assert name in said


def test_without_the_extra_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = importlib.util.find_spec
    lacking = {"stable_baselines3", "tensorboard"}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name in lacking else found(name)
    )
    assert command("ppo", "--out", str(tmp_path)) == 2
    error = capsys.readouterr().err
    assert "stable_baselines3, tensorboard: pip install 'lpv-track-env[rl]'" in error
    assert error.count("\n") == 1


def test_errors_of_a_validation_are_those_of_drives_that_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vehicle that leaves the road at once has an error of nearly zero."""
    ends = iter(["left_corridor", "finished"] + 2 * ["left_corridor"])

    def drive(_case: dict[str, Any]) -> dict[str, Any]:
        end = next(ends)
        error = 0.25 if end == "finished" else 1e-6
        metrics = {"ale": error, "mle": 2 * error, "steering_variation": 8 * error}
        return {
            "status": "ok", "end": end, "metrics": {**metrics, "reward": 5.0, "duration": 10.0},
        }  # fmt: skip

    monkeypatch.setattr("experiments.training.loop.run_case", drive)
    settings = tiny("ppo", conditions=("simulation",), validation=2)
    assert validate(settings, tmp_path) == {
        "loss": 0.5, "finished": 0.5, "mean_ale": 0.25, "worst_mle": 0.5,
        "mean_steering_variation": 2.0,
    }  # fmt: skip
    assert validate(settings, tmp_path) == {"loss": 0.5, "finished": 0.0}
