"""A training from its beginning, or its last checkpoint, to its end."""

import contextlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.logger import Logger, configure

from agents.learned.policy import read as read_policy
from agents.learned.policy import write as write_policy
from experiments.run.process import Interrupts
from experiments.run.provenance import hardware, revision, versions
from experiments.training import checkpoint
from experiments.training.cloning import CloningTrainer
from experiments.training.environments import load_paths, make_learner_env
from experiments.training.lock import alone_in
from experiments.training.sb3_trainer import Sb3Trainer
from experiments.training.seeds import path_names
from experiments.training.settings import TrainingSettings, difference
from experiments.training.trainer import Trainer
from experiments.training.validation import validate
from lpv_track_env import vehicle
from trajectories.fileio import write_atomically

POLICY, PROGRESS, SETTINGS = "policy.json", "progress.jsonl", "settings.json"


@dataclass(frozen=True)
class Listener:
    """What the loop tells while it runs."""

    loading: Callable[[int, int], None]
    """Paths loaded, and of how many."""
    step: Callable[[int, str], None]
    """Steps done, and what is worth saying."""
    segment: Callable[[dict[str, Any]], None]
    """A line of `progress.jsonl`."""


def make_trainer(settings: TrainingSettings, paths: list[Any], logger: Logger) -> Trainer:
    """The trainer of an algorithm, on its environments.

    Raises
    ------
    ValueError
        If there is a policy to start from and it does not fit, or the device is not there.
    """
    torch.set_num_threads(1)
    _check_device(settings.device)
    start = read_policy(Path(settings.start)) if settings.start else None
    kind = CloningTrainer if settings.algorithm == "bc" else Sb3Trainer
    return kind(settings, make_learner_env(settings, paths), start, logger)


def _check_device(name: str) -> None:
    if name == "auto":
        return
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"no device {name!r} here: say --device cpu or auto ({reason})") from None


def has_training(folder: Path) -> bool:
    """Whether a folder holds a training."""
    return (folder / SETTINGS).exists()


def stored_settings(folder: Path) -> dict[str, Any]:
    """Settings of the training in a folder.

    Raises
    ------
    ValueError
        If there is none, or they cannot be read.
    """
    try:
        content: dict[str, Any] = json.loads((folder / SETTINGS).read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{folder} holds no training to go on with: {error}") from None
    return content


def train(
    settings: TrainingSettings,
    folder: Path,
    listener: Listener,
    *,
    command: str,
    seconds_at_most: float | None = None,
) -> list[dict[str, Any]]:
    """Train, or go on where the folder's checkpoint is; the lines of `progress.jsonl`.

    The folder gets `settings.json`, `policy.json` and its weights (the best on the validation
    paths so far), `checkpoint.pt`, `progress.jsonl` and TensorBoard's files.

    Raises
    ------
    ValueError
        If the folder's training has other settings, or a file in it cannot be used.
    KeyboardInterrupt
        On Ctrl-C; what the last checkpoint has is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        return _train(settings, folder, listener, command, seconds_at_most)


def _train(
    settings: TrainingSettings,
    folder: Path,
    listener: Listener,
    command: str,
    seconds_at_most: float | None,
) -> list[dict[str, Any]]:
    if has_training(folder) and (differs := difference(settings, stored_settings(folder))):
        raise ValueError(f"{folder} holds a training with other settings: {differs}")
    kept = checkpoint.read(folder)
    paths = load_paths(settings, listener.loading)
    start = read_policy(Path(settings.start)).training if settings.start else {}
    with contextlib.ExitStack() as closing:
        logger = configure(str(folder / "tensorboard"), ["tensorboard"])
        closing.callback(logger.close)
        trainer = make_trainer(settings, paths, logger)
        closing.callback(trainer.env.close)
        _write_json(folder / SETTINGS, settings.as_dict())
        lines: list[dict[str, Any]] = []
        if kept is not None:
            trainer.restore(kept["trainer"])
            lines = kept["lines"]
        _write_lines(folder, lines)
        before, learned = (
            lines[-1][key] if lines else 0.0 for key in ("seconds", "learning_seconds")
        )
        began = time.perf_counter()
        with Interrupts() as interrupts:
            for number in range(len(lines), settings.segments):
                started = time.perf_counter()
                figures = trainer.segment(number, listener.step)
                learned += time.perf_counter() - started
                interrupts.check()
                line = _judge(trainer, folder, lines, {
                    "segment": number,
                    "steps": trainer.steps,
                    "solves": trainer.solves,
                    "seconds": before + time.perf_counter() - began,
                    "learning_seconds": learned,
                    **figures,
                }, command, start)  # fmt: skip
                interrupts.check()
                for name, value in line["validation"].items():
                    logger.record(f"validation/{name}", value)
                logger.dump(trainer.steps)
                lines.append(line)
                checkpoint.write(folder, {"trainer": trainer.state(), "lines": lines})
                _write_lines(folder, lines)
                listener.segment(line)
                if seconds_at_most is not None and line["seconds"] > seconds_at_most:
                    break
    return lines


def _judge(
    trainer: Trainer,
    folder: Path,
    lines: list[dict[str, Any]],
    line: dict[str, Any],
    command: str,
    start: Mapping[str, Any],
) -> dict[str, Any]:
    """Validate the policy as it is; it becomes the folder's if it is the best so far.

    Whether it does or not, the folder's policy tells what all of the training has cost by now,
    with that of the policy it started from (`start`, its `training`).
    """
    settings, candidate, kept = trainer.settings, folder / "candidate.json", folder / POLICY
    try:
        write_policy(trainer.policy({}), candidate)
        judged = validate(settings, candidate)
    finally:
        for file in (candidate, candidate.with_suffix(".safetensors")):
            file.unlink(missing_ok=True)
    best = min((earlier["validation"]["loss"] for earlier in lines), default=float("inf"))
    line = {**line, "validation": judged, "best": judged["loss"] < best}
    names = path_names(settings)
    found = {"kept_at": line["steps"], "validation": judged}
    if not line["best"]:
        before = read_policy(kept).training
        found = {key: before[key] for key in found}
    training = {
        "command": command,
        "settings": settings.as_dict(),
        "vehicle": vehicle.load(settings.vehicle).name,
        "device": str(trainer.device),
        "paths": [names[0], names[-1]],
        "steps": line["steps"] + start.get("steps", 0),
        "solves": line["solves"] + start.get("solves", 0),
        "seconds": round(line["seconds"] + start.get("seconds", 0.0), 1),
        "start": start.get("command"),
        **found,
        "versions": versions(),
        "revision": revision(),
        "hardware": hardware(),
    }
    policy = (
        trainer.policy(training) if line["best"] else replace(read_policy(kept), training=training)
    )
    write_policy(policy, kept)
    return line


def _write_json(file: Path, content: Any) -> None:
    write_atomically(file, json.dumps(content, indent=2).encode())


def _write_lines(folder: Path, lines: list[dict[str, Any]]) -> None:
    text = "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)
    write_atomically(folder / PROGRESS, text.encode())
