"""A training as a resumable job: segments, each validated, the best policy kept."""

import contextlib
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from stable_baselines3.common.logger import Logger, configure

from agents.learned.policy import read as read_policy
from agents.learned.policy import write as write_policy
from agents.learned.storage import remove_files
from experiments.jobs import checkpoint
from experiments.jobs.job import (
    VALIDATION_EPISODES,
    Job,
    Line,
    Listener,
    claimed,
    load_paths,
    run_job,
)
from experiments.run.case import Case, run_case
from experiments.run.provenance import provenance
from experiments.training.cloning import CloningTrainer
from experiments.training.sb3_trainer import Sb3Trainer
from experiments.training.settings import TrainingSettings
from experiments.training.situations import NEAR
from experiments.training.trainer import Trainer, make_learner_env, path_names
from lpv_track_env import vehicle
from trajectories.fileio import checked

POLICY = "policy.json"


def make_trainer(settings: TrainingSettings, paths: list[Any], logger: Logger) -> Trainer:
    """Make the trainer of an algorithm, with its environments.

    Raises
    ------
    ValueError
        If the policy to start from does not fit, or there is no such device.
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


def train(
    settings: TrainingSettings,
    folder: Path,
    listener: Listener,
    *,
    command: str,
    seconds_at_most: float = math.inf,
) -> list[Line]:
    """Train, or resume from the folder's checkpoint; return the lines of `progress.jsonl`.

    The folder gets `settings.json`, `policy.json` and its weights (the best on the validation
    paths so far), `checkpoint.pt`, `progress.jsonl` and TensorBoard's files.

    Raises
    ------
    ValueError
        If the folder's training has other settings, or a file in it cannot be used.
    KeyboardInterrupt
        On Ctrl-C; the last checkpoint is kept.
    """
    packages = "torch", "stable-baselines3"
    with (
        claimed(folder, settings, "training", packages) as resumed,
        contextlib.ExitStack() as closing,
    ):
        car = vehicle.load(settings.vehicle)
        paths = load_paths(path_names(settings), listener.loading, car)
        logger = configure(str(folder / "tensorboard"), ["tensorboard"])
        closing.callback(logger.close)
        trainer = make_trainer(settings, paths, logger)
        closing.callback(trainer.env.close)
        training = Training(trainer, folder, listener, logger, command)
        if resumed:
            training.restore(folder)
        return run_job(training, folder, listener, seconds_at_most=seconds_at_most)


class TrainingLine(TypedDict):
    """Entries of a line that later ones and the figure are made from."""

    seconds: float
    learning_seconds: float
    steps: int
    solves: int
    best: bool
    validation: dict[str, float]


class Training(Job):
    """Segments of a trainer, with a validation after each; the best policy so far is kept."""

    def __init__(
        self, trainer: Trainer, folder: Path, listener: Listener, logger: Logger, command: str
    ) -> None:
        super().__init__(trainer.settings)
        self.trainer, self.folder, self.command = trainer, folder, command
        self._listener, self._logger = listener, logger
        start = trainer.settings.start
        self._start: Mapping[str, Any] = read_policy(Path(start)).training if start else {}

    @property
    def done(self) -> bool:
        """True after the last segment."""
        return len(self.lines) >= self.trainer.settings.segments

    def step(self) -> Line:
        """Train one segment."""
        number, trainer = len(self.lines), self.trainer
        before = self.lines[-1]["learning_seconds"] if self.lines else 0.0
        began = time.perf_counter()
        figures = trainer.segment(number, self._listener.tick)
        return {
            "segment": number, "steps": trainer.steps, "solves": trainer.solves,
            "learning_seconds": before + time.perf_counter() - began, **figures,
        }  # fmt: skip

    def conclude(self, line: Line) -> Line:
        """Validate the present policy; it replaces the kept one if it is the best so far.

        The provenance of the kept policy counts the cost of the whole training, including that of
        the policy it started from, even after the segment that the policy comes from.
        """
        trainer, candidate = self.trainer, self.folder / "candidate.json"
        kept = self.folder / POLICY
        try:
            write_policy(trainer.policy({}), candidate)
            validation = validate(trainer.settings, candidate)
        finally:
            remove_files(candidate)
        least = min((line["validation"]["loss"] for line in self.lines), default=math.inf)
        best = validation["loss"] < least
        origin = {"kept_at": line["steps"], "validation": validation}
        if best:
            policy = trainer.policy(self._provenance(line, origin))
        else:
            policy = read_policy(kept)
            origin = {key: policy.training[key] for key in origin}
            policy = replace(policy, training=self._provenance(line, origin))
        write_policy(policy, kept)
        for name, value in validation.items():
            self._logger.record(f"validation/{name}", value)
        self._logger.dump(trainer.steps)
        return {**line, "validation": validation, "best": best}

    def _provenance(self, line: Line, origin: Mapping[str, Any]) -> dict[str, Any]:
        """Return where a policy comes from and what it cost, in plain JSON."""
        settings, start = self.trainer.settings, self._start
        names = path_names(settings)
        cars = list(dict.fromkeys(part.car().name for part in settings.parts))
        return {
            "command": self.command,
            "settings": settings.as_dict(),
            "vehicle": cars[0] if len(cars) == 1 else cars,
            "device": str(self.trainer.device),
            "paths": [names[0], names[-1]],
            "steps": line["steps"] + start.get("steps", 0),
            "solves": line["solves"] + start.get("solves", 0),
            "seconds": round(line["seconds"] + start.get("seconds", 0.0), 1),
            "start": start.get("command"),
            **origin,
            **provenance(),
        }

    def save(self, folder: Path) -> None:
        """Write the trainer's state and the lines."""
        checkpoint.write(folder, {"trainer": self.trainer.state(), "lines": self.lines})

    def restore(self, folder: Path) -> bool:
        """Read the trainer's state and the lines; False if there is no checkpoint."""
        stored = checkpoint.read(folder)
        if stored is None:
            return False
        try:
            self.trainer.restore(stored["trainer"])
            checked(stored["lines"], list[TrainingLine], "lines")
        except (KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
            # PyTorch writes a line for every layer that does not fit.
            reason = str(error).split("\n", 1)[0]
            raise ValueError(checkpoint.unusable(folder, reason)) from None
        self.lines = stored["lines"]
        return True


# Validation ---------------------------------------------------------------------------------------


def cases(settings: TrainingSettings, policy: Path) -> list[dict[str, Any]]:
    """Return the cases of a validation."""
    return [
        Case(
            agent=str(policy),
            trajectory=name,
            vehicle=part.vehicle,
            vehicle_changes=part.changes,
            conditions=part.conditions,
            **part.speed,
            seed=VALIDATION_EPISODES + k,
            control_period=settings.control_period,
            env_settings={
                "preview_steps": settings.preview_steps,
                "preview_period": settings.preview_period,
                "reward_weights": asdict(settings.reward_weights()),
                **({"initial_error_range": part.errors} if part.errors != NEAR else {}),
            },
        ).as_dict()
        for part in settings.parts
        for k, name in enumerate(settings.validation_paths(part))
    ]


def validate(settings: TrainingSettings, policy: Path) -> dict[str, float]:
    """Drive the validation cases; return the share that finished, ALE and MLE (m), steering.

    Errors and steering are those of the drives that finished, and are left out if none did: a
    vehicle that leaves the road at once has small ones. `loss`, by which the best policy is chosen,
    is 1 minus the reward per second of all drives together: perfect tracking earns the training's
    reward at a rate of 1 a second.

    Raises
    ------
    ValueError
        If a case could not be run.
    """
    results = [run_case(case) for case in cases(settings, policy)]
    for result in results:
        if result["status"] != "ok":
            raise ValueError(f"validation on {result['trajectory']}: {result['error']}")
    finished = np.array([result["end"] == "finished" for result in results])
    reward, seconds = (
        sum(result["metrics"][key] for result in results) for key in ("reward", "duration")
    )
    figures = {"loss": 1.0 - reward / seconds, "finished": float(finished.mean())}
    if not finished.any():
        return figures
    ale, mle, steering = (
        np.array([one["metrics"][key] for one in results])[finished]
        for key in ("ale", "mle", "steering_variation")
    )
    return {
        **figures,
        "mean_ale": float(ale.mean()),
        "worst_mle": float(mle.max()),
        "mean_steering_variation": float(steering.mean()),
    }
