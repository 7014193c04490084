"""Shared parts of the commands that run jobs: display, repeated command line, needed packages."""

import argparse
import importlib.util
from collections.abc import Iterable, Mapping
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from experiments.jobs.curves import of_finished
from experiments.jobs.job import Line, Listener, stored_settings
from experiments.run.benchmark import progress_bar


class Display(Listener):
    """Shows the progress of a job: a bar on a terminal, printed lines everywhere.

    Of several jobs, each has a bar of a common `progress`, and a `prefix` of its lines.
    """

    def __init__(
        self, console: Console, total: int, progress: Progress | None = None, prefix: str = ""
    ) -> None:
        self.progress = progress_bar(console) if progress is None else progress
        self._console, self._total, self._prefix = console, total, prefix
        self._bar = self.progress.add_task(f"{prefix}paths", total=None)

    def loading(self, done: int, count: int) -> None:
        """Show how many of all paths are loaded."""
        words = f"{self._prefix}paths"
        self.progress.update(self._bar, description=words, completed=done, total=count)

    def show(self, done: int, words: str) -> None:
        """Show how much of the total is done, and a few words on it."""
        words = f"{self._prefix}{words}"
        self.progress.update(self._bar, description=words, completed=done, total=self._total)

    def say(self, text: str) -> None:
        """Print a line."""
        self._console.print(f"{self._prefix}{text}", markup=False, highlight=False)


class TrainingDisplay(Display):
    """Prints a line for every segment."""

    def __init__(
        self, console: Console, algorithm: str, steps: int, progress: Progress | None = None,
        prefix: str = "",
    ) -> None:  # fmt: skip
        super().__init__(console, steps, progress, prefix)
        self._algorithm = algorithm

    def tick(self, done: int, words: str) -> None:
        """Show the steps so far."""
        self.show(done, f"{self._algorithm} {words}")

    def line(self, line: Line) -> None:
        """Print the validation after a segment."""
        validation, ale = line["validation"], of_finished(line, "mean_ale")
        error = "–" if ale is None else f"{ale:.4f} m"
        self.show(line["steps"], self._algorithm)
        self.say(
            f"{line['steps']:>11,} steps {line['seconds']:5.0f} s  "
            f"loss {validation['loss']:7.4f}  finished {validation['finished']:4.0%}  "
            f"ALE {error:<8}{'  best' if line['best'] else ''}".rstrip()
        )


class TuningDisplay(Display):
    """Prints a line for every tenth of the budget."""

    def __init__(
        self, console: Console, method: str, solves: int, progress: Progress | None = None,
        prefix: str = "",
    ) -> None:  # fmt: skip
        super().__init__(console, solves, progress, prefix)
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
