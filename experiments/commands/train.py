"""`lpv-track train`: train a policy that drives."""

import argparse
import math
import shlex
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from experiments.commands.options import (
    EXIT_FAILED,
    MOST_PATHS,
    MOST_STEPS,
    add_job,
    add_settings,
    add_trajectories,
    amount,
    engine_of,
    number,
    parse_settings,
    resumable,
    seeds_of_jobs,
    whole,
)
from experiments.training import ALGORITHMS

if TYPE_CHECKING:
    from rich.progress import Progress

    from experiments.training.settings import TrainingSettings

EXAMPLE = "lpv-track train ppo --seed 0 --hours 0.1 --out results/ppo"

PLAIN = (
    "seed", "vehicle", "situations", "envs", "segment", "trajectories", "paths", "start", "device",
    "control_period", "preview_steps", "preview_period",
)  # fmt: skip
"""Options that are settings as they were given."""
REPEATED = (
    "vehicle", "situations", "conditions", "conditions_set", "trajectories", "paths", "envs",
    "segment", "start", "control_period", "preview_steps", "preview_period", "set", "reward",
    "device",
)  # fmt: skip
"""Options that the provenance's command repeats as they were given."""
TRIAL_UPDATES = {"ppo": 2, "residual": 2, "sac": 50, "td3": 50, "bc": 1}
"""Updates in a segment of a trial of `--hours`."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "algorithm", choices=ALGORITHMS,
        help="ppo, sac, td3; bc: cloning of lpv-nmpc with DAgger; residual: ppo on top of lpv-nmpc",
    )  # fmt: skip
    add_job(parser, "results/train/ALGORITHM")
    parser.add_argument(
        "--steps", type=amount, metavar="N", help="budget in environment steps, e.g. 2e7"
    )
    parser.add_argument(
        "--hours", type=number(0.0, 10_000.0, "h", above=True), metavar="H",
        help="budget in hours: as many steps as a trial says will fit, or --steps cut short",
    )  # fmt: skip
    parser.add_argument(
        "--fast",
        action="store_true",
        help="ppo: simulation only, half the updates, less than a minute",
    )
    parser.add_argument(
        "--conditions", nargs="+", metavar="NAME",
        help="kinds that share the environments (default: simulation realtime)",
    )  # fmt: skip
    add_settings(
        parser, "--conditions-set", "fields to change in each of them, e.g. friction=[0.4,1.0]"
    )
    parser.add_argument(
        "--situations", metavar="NAME",
        help="set of situations in place of vehicle, conditions and paths: limits mixes vehicles, "
        "friction, drives at the limit of grip, standing starts and starts far beside the path",
    )  # fmt: skip
    add_trajectories(
        parser, None, "own paths in place of random ones; not those of the suites paper and learned"
    )
    parser.add_argument(
        "--paths", type=whole(1, MOST_PATHS), metavar="N", help="random paths (default 48)"
    )
    parser.add_argument(
        "--envs", type=whole(1, 1_000_000), metavar="N",
        help="environments side by side (default: ppo 512, residual and bc 256, others 64)",
    )  # fmt: skip
    parser.add_argument(
        "--segment", type=whole(1, MOST_STEPS), metavar="N",
        help="steps between checkpoints, each with a validation (default: ppo 1,000,000, residual "
        "250,000, others 100,000)",
    )  # fmt: skip
    parser.add_argument(
        "--from",
        dest="start",
        metavar="POLICY",
        help="policy file to start from, e.g. of bc, or a folder of trainings: that of the same "
        "seed; ppo fits its value function alone in the first segment",
    )
    add_settings(
        parser, "--set",
        "hyperparameters, e.g. learning_rate=3e-4 hidden=[128,128]. All: learning_rate, "
        "last_learning_rate, hidden, activation, origin; ppo and residual: rollout, batch, epochs, "
        "discount, gae_lambda, clip_range, deviation; sac and td3: buffer, batch, gradient_steps, "
        "learning_starts, discount, target_rate, td3 noise; bc: round, updates, batch, "
        "expert_share, noise",
    )  # fmt: skip
    add_settings(parser, "--reward", "reward weights, e.g. input_rate=1.0 lateral_scale=0.1")
    parser.add_argument(
        "--device", metavar="NAME", help="cpu, cuda or auto (default: CUDA where there is one)"
    )


def settings_of(options: argparse.Namespace) -> "TrainingSettings":
    """Return the settings that the options ask for.

    Raises
    ------
    ValueError
        For an unknown name or an impossible value.
    """
    from experiments.training.settings import FAST, usual

    changes = parse_settings(options.conditions_set)
    kinds = [{"name": name, **changes} if changes else name for name in options.conditions or ()]
    if changes and not kinds:
        raise ValueError("--conditions-set needs --conditions, which it changes")
    given: dict[str, Any] = {name: getattr(options, name) for name in PLAIN}
    given["conditions"] = kinds or None
    if options.steps is not None:
        given["steps"] = options.steps
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


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.jobs.console import TrainingDisplay, check_resume, need

    need("training", "rl", "stable_baselines3", "torch", "tensorboard")
    from experiments.jobs.curves import TRAINING, draw
    from experiments.jobs.job import SETTINGS, stored_settings
    from experiments.jobs.several import start_of
    from experiments.training.loop import POLICY, train
    from experiments.training.settings import with_steps
    from trajectories.fileio import checked

    folder = options.out = options.out or Path("results/train") / options.algorithm
    if (seeds := seeds_of_jobs(options)) is not None:
        return run_several(options, seeds, console)
    options.start = start_of(options.start, options.seed)
    resumed = check_resume(folder, "training", resume=options.resume)
    settings = settings_of(options)
    at_most = math.inf
    if options.hours is not None:
        at_most = 3600.0 * options.hours
        if options.steps is None and resumed:
            # The number of steps that the first run found for its hours.
            stored = stored_settings(folder, "training") or {}
            steps = checked(stored.get("steps"), int, f"{folder / SETTINGS}: steps")
            settings = with_steps(settings, steps)
        elif options.steps is None:
            settings, at_most = fit_steps(settings, at_most, console)

    display = TrainingDisplay(console, settings.algorithm, settings.steps)
    with resumable(options, console, "the same command with --resume"), display.progress:
        lines = train(
            settings, folder, display, command=command_line(settings, options),
            seconds_at_most=at_most,
        )  # fmt: skip
    last = lines[-1]
    draw({settings.seed: lines}, TRAINING, "steps", folder / "training.png")
    console.out(
        f"{last['steps']:,} steps in {last['seconds']:.0f} s, {last['learning_seconds']:.0f} s of "
        f"them learning ({last['steps'] / last['learning_seconds']:,.0f} steps a second), "
        f"{last['solves']:,} NMPC solves; policy: {folder / POLICY}",
        highlight=False,
    )
    return 0


def run_several(options: argparse.Namespace, seeds: Sequence[int], console: Console) -> int:
    """Train once for each seed; return 1 if a training failed, else 0."""
    from experiments.jobs.console import TrainingDisplay
    from experiments.jobs.curves import TRAINING
    from experiments.jobs.job import PROGRESS, read_lines
    from experiments.jobs.several import Kind, run_seeds
    from experiments.training.loop import train

    if options.hours is not None:
        raise ValueError("--hours is the budget of one training: give --steps with --seeds")

    def job_of(own: argparse.Namespace) -> tuple["TrainingSettings", str]:
        settings = settings_of(own)
        return settings, command_line(settings, own)

    def display(settings: Any, progress: "Progress", prefix: str) -> TrainingDisplay:
        return TrainingDisplay(console, settings.algorithm, settings.steps, progress, prefix)

    def finished(settings: Any, folder: Path) -> bool:
        return (folder / PROGRESS).exists() and len(read_lines(folder)) >= settings.segments

    kind = Kind("training", train, display, finished, TRAINING, "steps")
    with resumable(options, console, "the same command with --resume"):
        failed = run_seeds(kind, options, seeds, job_of, engine_of(options), console)
    return EXIT_FAILED if failed else 0


def command_line(settings: "TrainingSettings", options: argparse.Namespace) -> str:
    """Return the command that makes the policy again: with `--steps`, also for `--hours`."""
    from experiments.jobs.console import repeated

    words = ["lpv-track", "train", settings.algorithm, "--steps", str(settings.steps)]
    words += ["--seed", str(settings.seed), *repeated(options, REPEATED, {"start": "--from"})]
    return shlex.join([*words, *(["--fast"] if options.fast else [])])


def fit_steps(
    settings: "TrainingSettings", seconds: float, console: Console
) -> tuple["TrainingSettings", float]:
    """Return the settings with as many steps as fit into a time, and the time left for them.

    A short trial of the same training, which is thrown away, measures steps and validation.
    """
    from experiments.jobs.job import Listener
    from experiments.training.loop import train
    from experiments.training.settings import with_steps

    console.print("measuring how many steps the time allows ...")
    began = time.perf_counter()
    trial = trial_of(settings)
    with tempfile.TemporaryDirectory() as scratch:
        lines = train(trial, Path(scratch), Listener(), command="trial")
    left = max(seconds - (time.perf_counter() - began), 1.0)
    # The first segment includes compilation.
    first, last = lines[0], lines[-1]
    driven = last["steps"] - first["steps"]
    learning = last["learning_seconds"] - first["learning_seconds"]
    validating = (last["seconds"] - first["seconds"] - learning) / (len(lines) - 1)
    step = learning / driven + validating / settings.segment
    least = settings.segment if settings.start else trial.segment
    steps = max(int(left / step), least + 1)
    console.print(f"{1.0 / step:,.0f} steps a second with validation: {steps:,}", highlight=False)
    return with_steps(settings, steps), left


def trial_of(settings: "TrainingSettings") -> "TrainingSettings":
    """Return the same training in three short segments, each with updates of the networks."""
    hyper = dict(settings.hyperparameters)
    once = settings.envs * hyper.get("rollout", hyper.get("round", 1))
    short = once * TRIAL_UPDATES[settings.algorithm]
    if "learning_starts" in hyper:
        hyper["learning_starts"] = once
    return replace(settings, steps=3 * short, segment=short, hyperparameters=hyper)
