"""`lpv-track tune`: options to settings, and what is seen while it runs."""

import argparse
import math
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from experiments.commands.options import parse_settings
from experiments.run.benchmark import progress_bar
from experiments.tuning.settings import PPO_METHODS, TuningSettings, usual

PLAIN = (
    "vehicle", "conditions", "conditions_set", "trajectories", "paths", "drives", "time_limit",
    "control_period", "preview_steps", "preview_period", "directions", "span", "window", "view",
    "set",
)  # fmt: skip
"""Options that a command line repeats as they are."""


def settings_of(options: argparse.Namespace) -> TuningSettings:
    """Settings that the options ask for.

    Raises
    ------
    ValueError
        For an unknown name or an impossible value.
    """
    solves = options.solves
    if not (math.isfinite(solves) and solves >= 1 and solves == int(solves)):
        raise ValueError(f"--solves must be a whole number of at least 1, not {solves:g}")
    changes = parse_settings(options.conditions_set)
    kind = options.conditions or "randomised"
    given = {name: getattr(options, name) for name in PLAIN if name in _FIELDS}
    return usual(
        options.method, **{
            **given, "solves": int(solves), "seed": options.seed,
            "conditions": {"name": kind, **changes} if changes else kind,
            "hyperparameters": parse_settings(options.set),
        },
    )  # fmt: skip


_FIELDS = set(TuningSettings.__dataclass_fields__)


class Display:
    """Progress on a terminal, a line a tenth of the budget elsewhere."""

    def __init__(self, console: Console, settings: TuningSettings) -> None:
        self._console, self._settings = console, settings
        self.progress: Progress = progress_bar(console)
        self._bar = self.progress.add_task("paths", total=None)
        self._told = 0

    def loading(self, done: int, count: int) -> None:
        """So many paths are loaded."""
        self.progress.update(self._bar, description="paths", completed=done, total=count)

    def step(self, line: dict[str, Any]) -> None:
        """A generation or a segment is done."""
        settings = self._settings
        self.progress.update(
            self._bar, description=f"{settings.method} score {line['score']:.3f}",
            completed=line["solves"], total=settings.solves,
        )  # fmt: skip
        if (tenth := 10 * line["solves"] // settings.solves) > self._told:
            self._told = tenth
            self._console.print(
                f"{line['solves']:>11,} solves {line['seconds']:5.0f} s  score of what was tried "
                f"{line['score']:.3f}",
                markup=False, highlight=False,
            )  # fmt: skip


def run_tuning(options: argparse.Namespace, console: Console) -> int:
    """Tune as the options say; the exit code."""
    _need(options.method)
    from experiments.tuning.loop import WEIGHTS, Listener, stored_settings, tune

    folder: Path = options.out or Path("results/tune") / options.method
    if stored_settings(folder) is not None and not options.resume:
        raise ValueError(f"{folder} holds a tuning already: say --resume, or give another --out")
    settings = settings_of(options)
    display = Display(console, settings)
    try:
        with display.progress:
            lines = tune(
                settings, folder, Listener(display.loading, display.step),
                command=command_line(settings, options),
            )  # fmt: skip
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command with --resume goes on from {folder}")
        return 130
    if not lines:
        console.print(f"the default weights: {folder / WEIGHTS}", markup=False, soft_wrap=True)
        return 0
    last = lines[-1]
    console.print(
        f"{last['solves']:,} solves in {last['seconds']:.0f} s; weights: {folder / WEIGHTS} "
        f"(lpv-track benchmark --agents lpv-nmpc-tuned --agent-set weights={folder / WEIGHTS})",
        markup=False, highlight=False, soft_wrap=True,
    )  # fmt: skip
    return 0


def command_line(settings: TuningSettings, options: argparse.Namespace) -> str:
    """The command that makes these weights again."""
    words = ["lpv-track", "tune", "--method", settings.method, "--solves", str(settings.solves)]
    words += ["--seed", str(settings.seed)]
    for name in PLAIN:
        value = getattr(options, name)
        if value:
            many = value if isinstance(value, list) else [value]
            option = "--random-paths" if name == "paths" else "--" + name.replace("_", "-")
            words += [option, *map(str, many)]
    return shlex.join(words)


def _need(method: str) -> None:
    """Say what to install where a method's packages are missing.

    Raises
    ------
    ModuleNotFoundError
        One line that names the extra.
    """
    needed = {"search": ("cma", "tune"), "bands": ("cma", "tune"), "paper": ("cma", "tune")}
    if method in PPO_METHODS:
        needed[method] = ("stable_baselines3", "rl")
    if method in needed and find_spec(needed[method][0]) is None:
        package, extra = needed[method]
        raise ModuleNotFoundError(
            f"tune --method {method} needs {package}: pip install 'lpv-track-env[{extra}]'"
        )
