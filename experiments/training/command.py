"""`lpv-track train`: options to settings, budgets, and what is seen while it runs."""

import argparse
import math
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from experiments.commands.options import parse_settings
from experiments.run.benchmark import progress_bar
from experiments.training.budget import fitted
from experiments.training.settings import FAST, TrainingSettings, usual, with_steps


def settings_of(options: argparse.Namespace) -> TrainingSettings:
    """Settings that the options ask for.

    Raises
    ------
    ValueError
        For an unknown name or an impossible value.
    """
    changes = parse_settings(options.conditions_set)
    kinds = [{"name": name, **changes} if changes else name for name in options.conditions or ()]
    if changes and not kinds:
        raise ValueError("--conditions-set needs --conditions, which it changes")
    given: dict[str, Any] = {
        "steps": None if options.steps is None else _whole(options.steps),
        "seed": options.seed,
        "vehicle": options.vehicle,
        "conditions": kinds or None,
        "envs": options.envs,
        "segment": options.segment,
        "trajectories": options.trajectories,
        "paths": options.paths,
        "start": options.start,
        "device": options.device,
        "control_period": options.control_period,
        "preview_steps": options.preview_steps,
        "preview_period": options.preview_period,
    }
    given = {key: value for key, value in given.items() if value is not None}
    hyperparameters = parse_settings(options.set)
    if options.fast:
        if options.algorithm != "ppo":
            raise ValueError("--fast is for ppo")
        hyperparameters = {**FAST["hyperparameters"], **hyperparameters}
        given = {**FAST, **given}
    reward = parse_settings(options.reward)
    settings = usual(options.algorithm, **{**given, "hyperparameters": hyperparameters})
    return replace(settings, reward={**settings.reward, **reward}) if reward else settings


def _whole(value: float) -> int:
    """A number of steps, also as 2e6.

    Raises
    ------
    ValueError
        Unless it is a whole number, at least 1.
    """
    if not (math.isfinite(value) and value >= 1 and value == int(value)):
        raise ValueError(f"--steps must be a whole number of at least 1, not {value:g}")
    return int(value)


class Display:
    """Progress on a terminal, a line a segment elsewhere."""

    def __init__(self, console: Console, settings: TrainingSettings) -> None:
        self._console, self._settings = console, settings
        self.progress: Progress = progress_bar(console)
        self._bar = self.progress.add_task("paths", total=None)

    def loading(self, done: int, count: int) -> None:
        """So many paths are loaded."""
        self.progress.update(self._bar, description="paths", completed=done, total=count)

    def step(self, steps: int, said: str) -> None:
        """So many steps are done."""
        self.progress.update(
            self._bar, description=f"{self._settings.algorithm} {said}",
            completed=steps, total=self._settings.steps,
        )  # fmt: skip

    def segment(self, line: dict[str, Any]) -> None:
        """A segment is done and validated."""
        judged = line["validation"]
        self._console.print(
            f"{line['steps']:>11,} steps {line['seconds']:5.0f} s  loss {judged['loss']:7.4f}  "
            f"finished {judged['finished']:4.0%}  ALE {judged['mean_ale']:.4f} m"
            f"{'  best' if line['best'] else ''}",
            markup=False, highlight=False,
        )  # fmt: skip


def run_training(options: argparse.Namespace, console: Console) -> int:
    """Train as the options say; the exit code."""
    _need_learning()
    from experiments.training.figures import draw
    from experiments.training.loop import (
        POLICY,
        Listener,
        has_training,
        stored_settings,
        train,
    )

    folder: Path = options.out or Path("results/train") / options.algorithm
    going_on = has_training(folder)
    if going_on and not options.resume:
        raise ValueError(f"{folder} holds a training already: say --resume, or give another --out")
    settings = settings_of(options)
    at_most = None
    if options.hours is not None:
        if not options.hours > 0.0:
            raise ValueError(f"--hours must be positive, not {options.hours}")
        at_most = 3600.0 * options.hours
        if going_on and options.steps is None:
            # What the first run made of its hours holds.
            settings = with_steps(settings, int(stored_settings(folder)["steps"]))
        elif options.steps is None:
            settings, at_most = fitted(settings, at_most, console)
    display = Display(console, settings)
    listener = Listener(display.loading, display.step, display.segment)
    try:
        with display.progress:
            lines = train(
                settings, folder, listener, command=command_line(settings, options),
                seconds_at_most=at_most,
            )  # fmt: skip
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command with --resume goes on from {folder}")
        return 130
    last = lines[-1]
    draw(lines, folder / "training.png")
    console.print(
        f"{last['steps']:,} steps in {last['seconds']:.0f} s, {last['learning_seconds']:.0f} s of "
        f"them learning ({last['steps'] / last['learning_seconds']:,.0f} steps a second), "
        f"{last['solves']:,} NMPC solves; policy: {folder / POLICY}",
        markup=False, highlight=False, soft_wrap=True,
    )  # fmt: skip
    return 0


def command_line(settings: TrainingSettings, options: argparse.Namespace) -> str:
    """The command that makes this policy again: with steps, however its budget was given."""
    words = ["lpv-track", "train", settings.algorithm, "--steps", str(settings.steps)]
    words += ["--seed", str(settings.seed)]
    for name in (
        "vehicle", "conditions", "conditions_set", "trajectories", "paths", "envs", "segment",
        "start", "control_period", "preview_steps", "preview_period", "set", "reward", "device",
    ):  # fmt: skip
        value = getattr(options, name)
        if value:
            many = value if isinstance(value, list) else [value]
            option = "--from" if name == "start" else "--" + name.replace("_", "-")
            words += [option, *map(str, many)]
    return shlex.join([*words, *(["--fast"] if options.fast else [])])


def _need_learning() -> None:
    """Say what to install where learning's packages are missing.

    Raises
    ------
    ModuleNotFoundError
        One line that names the extra.
    """
    from importlib.util import find_spec

    missing = [
        name for name in ("stable_baselines3", "torch", "tensorboard") if not find_spec(name)
    ]
    if missing:
        raise ModuleNotFoundError(
            f"training needs {', '.join(missing)}: pip install 'lpv-track-env[rl]'"
        )
