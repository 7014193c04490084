"""The command `lpv-track`, the same as `python -m experiments`."""

import argparse
import importlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn

from experiments.commands.options import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE
from experiments.run.worker_process import one_thread

if TYPE_CHECKING:
    from rich.console import Console

COMMANDS = {
    "benchmark": "Run agents x trajectories x seeds, print the paper's table, write report.html.",
    "reproduce": "Run cases of a results folder again, and compare every value bit for bit.",
    "report": "Rebuild the table and report.html from saved cases alone.",
    "merge": "Join folders of results, such as the shards of one benchmark, into one.",
    "leaderboard": "Rank folders of results on one page, and run a sample of each row again.",
    "compare": "Compare folders of results, or agents within one, drive by drive: table, LaTeX, "
    "figures.",
    "drive": "Watch a run live, or write its frames or a video; several agents side by side.",
    "trajectories": "Read paths and files, print the paper's rows of them, draw and write them.",
    "limits": "Compute the physical limits of lane changes and laps by optimal control.",
    "speed": "Measure how fast the environments and the solvers are, against their peers.",
    "ablation": "Drive with each disturbance of a real vehicle alone, with and without "
    "compensation.",
    "latency": "Compare estimation and control in sequence with both in parallel, times being "
    "delays.",
    "switching": "Switch the NMPC's weights at random and by an adversary: are vehicles lost?",
    "highway": "Drive laps among highway-env's traffic, beside its own controllers.",
    "verify": "Check the real-time NMPC against independent solvers, models and derivatives.",
    "identify": "Identify a vehicle's parameters, with their uncertainty, from logs of its drives.",
    "excite": "Drive a simulated vehicle with rich excitation and record a log for identify.",
    "bag": "Exchange drives with ROS: export, info, reference, replay.",
    "run-parallel": "Drive in real time with estimator and controller as processes of their own.",
    "train": "Train a policy that drives, on random paths under randomised conditions.",
    "tune": "Tune the NMPC's weights Q and S, on random paths under randomised conditions.",
    "tuning-study": "Compare the ways to weights: the whole ladder, held-out paths, oracles, one "
    "report.",
    "import-policy": "Take the policy out of a model that Stable-Baselines3 has saved. The model "
    "must have been trained on lpv_track_env/PathTracking-v0, observations as they come, actions "
    "in SI units or behind gymnasium.wrappers.RescaleAction(env, -1, 1).",
    "export": "Write a learned policy as an ONNX model, and check it against the agent.",
}
"""Commands and their summaries; a command's module is `experiments.commands.NAME`."""


LONGEST_LINE = 1000
"""Characters of the longest error message: the longest list of known names has about 800."""
LONGEST_WORD = 200
"""Characters of a user's word that a message repeats."""


class Parser(argparse.ArgumentParser):
    """Parser whose errors are one line, and that knows options with two names.

    `--traj` is short for both names of an option, not ambiguous.
    """

    def _get_option_tuples(self, option_string: str) -> list[Any]:
        # Python 3.11 refuses a prefix of two names even if they belong to one option.
        found = super()._get_option_tuples(option_string)
        return list({option[0]: option for option in found}.values())

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        # Python 3.11 takes `--option=--` for an option with an empty list.
        if action.option_strings and "--" in arg_strings:
            raise argparse.ArgumentError(action, "'--' is no value")
        return super()._get_values(action, arg_strings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments; refuse unknown ones here, where it is known whose they are."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        """Raise a ValueError, which is one line, in place of the usage and an exit."""
        # As all other messages name an option and what it must be.
        words = message.removeprefix("argument ").replace(": must be ", " must be ", 1)
        raise ValueError(f"{_short(words)}; {self.prog} --help lists the options")


def _short(message: str) -> str:
    """Return a message on one line, with its long words, which are the user's, cut."""
    return " ".join(
        word if len(word) <= LONGEST_WORD else f"{word[:LONGEST_WORD]}..."
        for word in message.split()
    )


def module_of(command: str) -> Any:
    """Import and return a command's module, see `experiments.commands`."""
    return importlib.import_module(f"experiments.commands.{command.replace('-', '_')}")


def parser(declared: Collection[str] = tuple(COMMANDS)) -> argparse.ArgumentParser:
    """Return the parser of `lpv-track`: all commands, with the options of those `declared`."""
    root = Parser(
        prog="lpv-track",
        description="Path tracking with a dynamic bicycle: an LPV-NMPC and others, benchmarked.",
        epilog="example: lpv-track benchmark --suite quick --out results/quick",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = root.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, summary in COMMANDS.items():
        command = commands.add_parser(
            name,
            help=summary,
            description=summary,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name in declared:
            module = module_of(name)
            command.epilog = f"example: {module.EXAMPLE}"
            module.add_options(command)
    return root


def run(options: argparse.Namespace) -> int:
    """Run a parsed command and return its exit code."""
    from rich.console import Console

    # Piped output keeps the tables' width; a terminal, or COLUMNS, has its own.
    wide = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 120
    console = Console(width=wide)
    with _imports_said(console), _warnings_in_lines():
        code: int = module_of(options.command).run(options, console)
    return code


@contextmanager
def _imports_said(console: "Console") -> Iterator[None]:
    """Print the line about each path that this process imports from a file, each line once."""
    from trajectories.arguments import shortened

    process, said = os.getpid(), set()

    def once(record: logging.LogRecord) -> bool:
        line = shortened(record.getMessage(), LONGEST_LINE)
        if os.getpid() == process and line not in said:
            said.add(line)
            console.out(line, highlight=False)
        return True

    log = logging.getLogger("trajectories.importers")
    level = log.level
    log.setLevel(logging.INFO)
    log.addFilter(once)
    try:
        yield
    finally:
        log.removeFilter(once)
        log.setLevel(level)


@contextmanager
def _warnings_in_lines() -> Iterator[None]:
    """Print warnings for users as one line each, once; others with their place in the sources."""
    said: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        line = f"lpv-track: warning: {message}"
        if category is not UserWarning:
            usual(message, category, *place, **more)
        elif line not in said:
            said.add(line)
            print(line, file=sys.stderr)

    usual = warnings.showwarning
    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `lpv-track`; errors that the user can correct are one line and EXIT_USAGE."""
    # Before any numerical library is imported.
    one_thread()
    _open_streams()
    given = sys.argv[1:] if arguments is None else arguments
    try:
        code = run(parser(given[:1]).parse_args(given))
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read the output has read enough
        _drop_output()
        return EXIT_FAILED
    except (ValueError, OSError, ModuleNotFoundError) as error:
        _drop_output()
        from trajectories.arguments import shortened

        print("lpv-track:", shortened(_short(str(error)), LONGEST_LINE), file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return code


def _open_streams() -> None:
    """Make the standard streams usable: closed ones lead nowhere, any character can be printed."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def _drop_output() -> None:
    """Drop what standard output cannot take, so that the end of the process says nothing of it."""
    try:
        sys.stdout.flush()
    except OSError:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
