"""Validation of a policy on paths that it does not train on, as cases of the benchmark."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from experiments.jobs.paths import VALIDATION_EPISODES, VALIDATION_PATHS, random_names
from experiments.run.case import Case, run_case
from experiments.training.settings import TrainingSettings


def validation_names(settings: TrainingSettings) -> list[str]:
    """Return the paths of the validation: the user's own, as in training, or else random ones."""
    if settings.trajectories:
        return list(settings.trajectories[: settings.validation])
    return random_names(VALIDATION_PATHS, settings.validation)


def cases(settings: TrainingSettings, policy: Path) -> list[dict[str, Any]]:
    """Return the cases of a validation."""
    return [
        Case(
            agent=str(policy),
            trajectory=name,
            vehicle=settings.vehicle,
            conditions=kind,
            seed=VALIDATION_EPISODES + k,
            control_period=settings.control_period,
            env_settings={
                "preview_steps": settings.preview_steps,
                "preview_period": settings.preview_period,
                "reward_weights": asdict(settings.reward_weights()),
            },
        ).as_dict()
        for kind in settings.conditions
        for k, name in enumerate(validation_names(settings))
    ]


def validate(settings: TrainingSettings, policy: Path) -> dict[str, float]:
    """Drive the validation cases; return the share that finished, ALE and MLE (m), steering.

    `loss`, by which the best policy is chosen, is 1 minus the mean reward per second: perfect
    tracking earns the training's reward at a rate of 1 a second.

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
    ale = np.array([result["metrics"]["ale"] for result in results])
    rewards = [
        result["metrics"]["reward"] / max(result["metrics"]["duration"], settings.control_period)
        for result in results
    ]
    return {
        "loss": 1.0 - float(np.mean(rewards)),
        "finished": float(finished.mean()),
        "mean_ale": float(ale.mean()),
        "worst_mle": float(max(result["metrics"]["mle"] for result in results)),
        "mean_steering_variation": float(
            np.mean([result["metrics"]["steering_variation"] for result in results])
        ),
    }
