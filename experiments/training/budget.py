"""How many steps some time allows: `--hours`."""

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.training.settings import TrainingSettings, with_steps

ROUNDS = {"ppo": 2, "residual": 2, "sac": 50, "td3": 50, "bc": 1}
"""Updates in a segment of a trial."""


def fitted(
    settings: TrainingSettings, seconds: float, console: Console
) -> tuple[TrainingSettings, float]:
    """Settings with as many steps as fit into some time, and the time left for them.

    A short trial of the same training, which is thrown away, tells what steps and validation take.
    """
    from experiments.training.loop import Listener, train

    def silent(*_: Any) -> None:
        return

    console.print("measuring how many steps the time allows ...")
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        lines = train(
            trial_of(settings), Path(scratch), Listener(silent, silent, silent), command="trial"
        )
    left = max(seconds - (time.perf_counter() - began), 1.0)
    # The first segment compiles.
    first, last = lines[0], lines[-1]
    driven = last["steps"] - first["steps"]
    learning = last["learning_seconds"] - first["learning_seconds"]
    validating = (last["seconds"] - first["seconds"] - learning) / (len(lines) - 1)
    step = learning / driven + validating / settings.segment
    least = settings.segment if settings.start else trial_of(settings).segment
    steps = max(int(left / step), least + 1)
    console.print(f"{1.0 / step:,.0f} steps a second with validation: {steps:,}", highlight=False)
    return with_steps(settings, steps), left


def trial_of(settings: TrainingSettings) -> TrainingSettings:
    """The same in three short segments, in all of which the networks learn."""
    hyper = dict(settings.hyperparameters)
    once = settings.envs * hyper.get("rollout", hyper.get("round", 1))
    short = once * ROUNDS[settings.algorithm]
    if "learning_starts" in hyper:
        hyper["learning_starts"] = once
    return replace(settings, steps=3 * short, segment=short, hyperparameters=hyper)
