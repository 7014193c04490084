"""Shared parts of the commands that run jobs: display, repeated command line, needed packages."""

import argparse
import importlib.util
from collections.abc import Iterable, Mapping
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from experiments.jobs.job import Line, Listener, stored_settings
from experiments.run.benchmark import progress_bar


class Display(Listener):
    """Shows the progress of a job: a bar on a terminal, printed lines everywhere."""

    def __init__(self, console: Console, total: int) -> None:
        self.progress: Progress = progress_bar(console)
        self._console, self._total = console, total
        self._bar = self.progress.add_task("paths", total=None)

    def loading(self, done: int, count: int) -> None:
        """Show how many of all paths are loaded."""
        self.progress.update(self._bar, description="paths", completed=done, total=count)

    def show(self, done: int, words: str) -> None:
        """Show how much of the total is done, and a few words on it."""
        self.progress.update(self._bar, description=words, completed=done, total=self._total)

    def say(self, text: str) -> None:
        """Print a line."""
        self._console.print(text, markup=False, highlight=False)


class TrainingDisplay(Display):
    """Prints a line for every segment."""

    def __init__(self, console: Console, algorithm: str, steps: int) -> None:
        super().__init__(console, steps)
        self._algorithm = algorithm

    def tick(self, done: int, words: str) -> None:
        """Show the steps so far."""
        self.show(done, f"{self._algorithm} {words}")

    def line(self, line: Line) -> None:
        """Print the validation after a segment."""
        validation = line["validation"]
        self.say(
            f"{line['steps']:>11,} steps {line['seconds']:5.0f} s  "
            f"loss {validation['loss']:7.4f}  finished {validation['finished']:4.0%}  "
            f"ALE {validation['mean_ale']:.4f} m{'  best' if line['best'] else ''}"
        )


class TuningDisplay(Display):
    """Prints a line for every tenth of the budget."""

    def __init__(self, console: Console, method: str, solves: int) -> None:
        super().__init__(console, solves)
        self._method, self._solves, self._printed = method, solves, 0

    def line(self, line: Line) -> None:
        """Show the score of a step, and print it once in a tenth."""
        self.show(line["solves"], f"{self._method} score {line['score']:.3f}")
        if (tenth := 10 * line["solves"] // self._solves) > self._printed:
            self._printed = tenth
            self.say(
                f"{line['solves']:>11,} solves {line['seconds']:5.0f} s  score of the "
                f"candidates {line['score']:.3f}"
            )


def check_resume(folder: Path, kind: str, *, resume: bool) -> bool:
    """Return whether a folder holds a job already, which only `--resume` may go on with.

    Raises
    ------
    ValueError
        If it holds one and `resume` is off, or its settings cannot be read.
    """
    held = stored_settings(folder, kind) is not None
    if held and not resume:
        raise ValueError(f"{folder} holds a {kind} already: say --resume, or give another --out")
    return held


def repeated(
    options: argparse.Namespace, names: Iterable[str], renamed: Mapping[str, str]
) -> list[str]:
    """Return the words of the options that were given, for the command that makes a result again.

    `renamed` has the options that are not called like their name in `options`.
    """
    words: list[str] = []
    for name in names:
        value = getattr(options, name)
        if value:
            many = value if isinstance(value, list) else [value]
            words += [renamed.get(name, "--" + name.replace("_", "-")), *map(str, many)]
    return words


def need(activity: str, extra: str, *packages: str) -> None:
    """Check that optional packages are installed.

    Raises
    ------
    ModuleNotFoundError
        In one line that names the missing packages and the extra that brings them.
    """
    missing = [name for name in packages if not importlib.util.find_spec(name)]
    if missing:
        raise ModuleNotFoundError(
            f"{activity} needs {', '.join(missing)}: pip install 'lpv-track-env[{extra}]'"
        )
