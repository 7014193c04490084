"""`lpv-track tune`: tune the NMPC's weights."""

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from experiments.commands.options import (
    EXIT_FAILED,
    MOST_PATHS,
    add_conditions,
    add_job,
    add_settings,
    amount,
    engine_of,
    number,
    parse_settings,
    resumable,
    seeds_of_jobs,
    whole,
)
from experiments.tuning import METHODS

if TYPE_CHECKING:
    from rich.progress import Progress

    from experiments.tuning.settings import TuningSettings

EXAMPLE = "lpv-track tune --method rl --seed 0 --out results/tune/rl"

REPEATED = (
    "vehicle", "conditions", "conditions_set", "trajectories", "paths", "drives", "time_limit",
    "control_period", "preview_steps", "preview_period", "directions", "span", "window", "view",
    "set",
)  # fmt: skip
"""Options that the provenance's command repeats as they were given."""
PACKAGES = {
    "paper": ("tune", "cma"),
    "search": ("tune", "cma"),
    "bands": ("tune", "cma"),
    "gradient": ("tune", "cma"),
    "catalogue": ("rl", "stable_baselines3"),
    "rl": ("rl", "stable_baselines3"),
}
"""Extra that a method needs, and the package whose absence shows that it is missing."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--method", choices=METHODS, required=True,
        help="fixed: the default weights; paper: a set by the path's sharpest curvature; search: "
        "the best fixed set, by CMA-ES; bands: a set a band of curvature, by CMA-ES; gradient: the "
        "same by gradients of the closed loop; catalogue: PPO chooses sets while driving; rl: PPO "
        "multiplies weights while driving; paired: a linear policy does, learned from drives "
        "alike but for their weights",
    )  # fmt: skip
    add_job(parser, "results/tune/METHOD")
    parser.add_argument(
        "--solves", type=amount, default=300_000, metavar="N",
        help="budget in solves of the NMPC, e.g. 3e6 (default 3e5); never exceeded",
    )  # fmt: skip
    parser.add_argument(
        "--trajectories", "--paths", nargs="+", metavar="PATH", dest="trajectories",
        help="own paths, names or files, in place of random ones; not those of the evaluation",
    )  # fmt: skip
    parser.add_argument(
        "--random-paths", type=whole(1, MOST_PATHS), metavar="N", dest="paths",
        help="random paths (default 32)",
    )  # fmt: skip
    add_conditions(
        parser, None, "simulation, realtime, randomised (default: randomised)",
        "fields to change in them, e.g. gnss_noise=[0.01,0.3]",
    )  # fmt: skip
    parser.add_argument(
        "--drives", type=whole(1, 100_000), metavar="N",
        help="drives that score a candidate (default 16), environments of PPO (default 64), drives "
        "of paired (default 32)",
    )  # fmt: skip
    parser.add_argument(
        "--time-limit", type=number(0.0, 1e6, "s", above=True), metavar="S",
        help="of a drive (default 10 s, PPO 20 s)",
    )  # fmt: skip
    parser.add_argument(
        "--directions", metavar="NAME",
        help="what is chosen apart: joint (speed, heading, position), stages (these in Q and in S, "
        "the default), all (each of Q and S)",
    )  # fmt: skip
    parser.add_argument(
        "--span", type=number(1.0, 1e4, above=True), metavar="F",
        help="largest factor on a default weight (default 100)",
    )  # fmt: skip
    parser.add_argument(
        "--window", type=number(0.0, 1e6, "s", above=True), metavar="S",
        help="between decisions (default 0.4)",
    )  # fmt: skip
    parser.add_argument(
        "--view", metavar="NAME",
        help="what catalogue and rl see: all (default), path (curvature, speed, band), drive "
        "(errors' history, lags, noise)",
    )  # fmt: skip
    add_settings(
        parser, "--set",
        "hyperparameters: sigma of search and gradient; pairs, learning_rate of gradient; of "
        "catalogue and rl learning_rate, last_learning_rate, rollout, batch, epochs, discount, "
        "gae_lambda, clip_range, deviation, hidden, segment; of paired deviation, hold, curvature, "
        "response, least_curvature, half_life, step",
    )  # fmt: skip


def settings_of(options: argparse.Namespace) -> "TuningSettings":
    """Return the settings that the options ask for.

    Raises
    ------
    ValueError
        For an unknown name or an impossible value.
    """
    from experiments.tuning.settings import TuningSettings, usual

    changes = parse_settings(options.conditions_set)
    kind = options.conditions or "randomised"
    fields = TuningSettings.__dataclass_fields__
    given = {name: getattr(options, name) for name in REPEATED if name in fields}
    return usual(
        options.method, **{
            **given, "solves": options.solves, "seed": options.seed,
            "conditions": {"name": kind, **changes} if changes else kind,
            "hyperparameters": parse_settings(options.set),
        },
    )  # fmt: skip


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.jobs.console import TuningDisplay, check_resume, need

    if options.method in PACKAGES:
        need(f"tune --method {options.method}", *PACKAGES[options.method])
    from experiments.tuning.loop import WEIGHTS, tune

    folder = options.out = options.out or Path("results/tune") / options.method
    if (seeds := seeds_of_jobs(options)) is not None:
        return run_several(options, seeds, console)
    check_resume(folder, "tuning", resume=options.resume)
    settings = settings_of(options)

    display = TuningDisplay(console, settings.method, settings.solves)
    with resumable(options, console, "the same command with --resume"), display.progress:
        lines = tune(settings, folder, display, command=command_line(settings, options))
    if not lines:
        console.print(f"the default weights: {folder / WEIGHTS}", markup=False, soft_wrap=True)
        return 0
    last = lines[-1]
    console.out(
        f"{last['solves']:,} solves in {last['seconds']:.0f} s; weights: {folder / WEIGHTS} "
        f"(lpv-track benchmark --agents lpv-nmpc-tuned --agent-set weights={folder / WEIGHTS})",
        highlight=False,
    )
    return 0


def run_several(options: argparse.Namespace, seeds: Sequence[int], console: Console) -> int:
    """Tune once for each seed; return 1 if a tuning failed, else 0."""
    from experiments.jobs.console import TuningDisplay
    from experiments.jobs.curves import TUNING
    from experiments.jobs.several import Kind, run_seeds
    from experiments.tuning.loop import WEIGHTS, tune

    def job_of(own: argparse.Namespace) -> tuple["TuningSettings", str]:
        settings = settings_of(own)
        return settings, command_line(settings, own)

    def display(settings: Any, progress: "Progress", prefix: str) -> TuningDisplay:
        return TuningDisplay(console, settings.method, settings.solves, progress, prefix)

    def finished(_settings: Any, folder: Path) -> bool:
        # Written when no step is left.
        return (folder / WEIGHTS).exists()

    kind = Kind("tuning", tune, display, finished, TUNING, "solves")
    with resumable(options, console, "the same command with --resume"):
        failed = run_seeds(kind, options, seeds, job_of, engine_of(options), console)
    return EXIT_FAILED if failed else 0


def command_line(settings: "TuningSettings", options: argparse.Namespace) -> str:
    """Return the command that makes the weights again."""
    from experiments.jobs.console import repeated

    words = ["lpv-track", "tune", "--method", settings.method, "--solves", str(settings.solves)]
    words += ["--seed", str(settings.seed)]
    return shlex.join([*words, *repeated(options, REPEATED, {"paths": "--random-paths"})])
