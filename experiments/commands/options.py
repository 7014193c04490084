"""Options that several commands share, and how their values are read."""

import argparse
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.run.engines import ENGINES, Engine
from trajectories.arguments import shown

EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130

MOST_SEEDS, MOST_WORKERS, MOST_PATHS, MOST_STEPS = 10_000, 1024, 1000, 10**12


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return the type of an option that is a whole number from `low` to `high`."""

    def read(text: str) -> int:
        from trajectories.arguments import Whole

        value: int = _of(Whole(low, high), _converted(int, text))
        return value

    return read


def amount(text: str) -> int:
    """Read a number of steps or solves, at least 1, which may be given as 2e6."""
    from trajectories.arguments import Whole

    number = _converted(float, text)
    if isinstance(number, float) and number.is_integer():
        number = int(number)
    value: int = _of(Whole(1, MOST_STEPS), number)
    return value


def number(
    low: float | None = None, high: float | None = None, unit: str = "", *, above: bool = False
) -> Callable[[str], float]:
    """Return the type of an option that is a finite number, see `trajectories.arguments.Number`."""

    def read(text: str) -> float:
        from trajectories.arguments import LARGEST, Number

        bounds = -LARGEST if low is None else low, LARGEST if high is None else high
        value: float = _of(Number(*bounds, unit, above), _converted(float, text))
        return value

    return read


def file_name(text: str) -> Path:
    """Read the name of a file or folder, which must not be empty."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError("is not the name of a file or folder")
    return Path(text)


def _converted(convert: Callable[[str], float], text: str) -> Any:
    try:
        return convert(text)
    except ValueError:
        return text


def _of(rule: Any, value: Any) -> Any:
    """Apply a rule; its error becomes the one with which the option is named."""
    try:
        return rule.of("", value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).strip()) from None


PREVIEW_STEPS = whole(1, 1000)
PREVIEW_PERIOD = number(0.0, 10.0, "s", above=True)


def add_out(parser: argparse.ArgumentParser, default: str) -> None:
    """Add `--out DIR`."""
    parser.add_argument("--out", type=file_name, default=Path(default), metavar="DIR")


def add_job(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add the options that trainings and tunings share; `folder` is the default of `--out`."""
    parser.add_argument("--out", type=file_name, metavar="DIR", help=f"default: {folder}")
    parser.add_argument("--resume", action="store_true", help="go on from the last state in DIR")
    seeds = parser.add_mutually_exclusive_group()
    seeds.add_argument("--seed", type=whole(0, 999), default=0, help="0 to 999 (default 0)")
    seeds.add_argument(
        "--seeds", type=whole(0, 999), nargs="+", metavar="SEED",
        help="run once for each of these seeds, side by side, in DIR/seed-SEED",
    )  # fmt: skip
    add_engine(parser)
    parser.add_argument("--vehicle", metavar="NAME", help="preset or .json (default m2-minibus)")
    add_control_period(parser)
    parser.add_argument("--preview-steps", type=PREVIEW_STEPS, metavar="K", help="default 20")
    parser.add_argument(
        "--preview-period", type=PREVIEW_PERIOD, metavar="S",
        help="s (default 0.1)",
    )  # fmt: skip


def add_control_period(parser: argparse.ArgumentParser, default: float | None = None) -> None:
    """Add `--control-period S`; its default is that of the environment unless one is given."""
    parser.add_argument(
        "--control-period", type=number(0.001, 1.0, "s"), default=default, metavar="S",
        help="s (default 0.05)",
    )  # fmt: skip


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add `--workers N`, all cores by default."""
    parser.add_argument(
        "--workers", type=whole(1, MOST_WORKERS), default=os.cpu_count() or 1, metavar="N",
        help="default: all cores",
    )  # fmt: skip


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Add `--workers`, `--engine` and `--address`; `engine_of` reads them."""
    parser.add_argument(
        "--workers", type=whole(1, MOST_WORKERS), metavar="N",
        help="processes (default: all cores; with --engine ray, all CPUs of the cluster)",
    )  # fmt: skip
    parser.add_argument(
        "--engine", choices=ENGINES, default=ENGINES[0],
        help="local processes (default), or a Ray cluster: pip install 'lpv-track-env[ray]'",
    )  # fmt: skip
    parser.add_argument(
        "--address", metavar="ADDRESS",
        help="address of the Ray cluster, e.g. 10.0.0.1:6379 or auto (default: a Ray on this "
        "computer)",
    )  # fmt: skip


def engine_of(options: argparse.Namespace) -> Engine:
    """Return the engine that `--workers`, `--engine` and `--address` ask for.

    Raises
    ------
    ValueError
        For an address without `--engine ray`.
    """
    return Engine(options.workers, options.engine, options.address)


def seeds_of_jobs(options: argparse.Namespace) -> list[int] | None:
    """Return the seeds of `--seeds` of a training or tuning; None if it was not given.

    Raises
    ------
    ValueError
        For a seed that is given twice, and for an engine without `--seeds`.
    """
    engine = engine_of(options)
    if options.seeds is None:
        if engine != Engine():
            raise ValueError("--workers, --engine, --address are for several seeds: give --seeds")
        return None
    if len(set(options.seeds)) < len(options.seeds):
        raise ValueError(f"--seeds names a seed twice: {' '.join(map(str, options.seeds))}")
    return list(options.seeds)


def add_start(parser: argparse.ArgumentParser) -> None:
    """Declare `--start`, the reset options that say where the vehicle starts."""
    add_settings(
        parser, "--start", "where the vehicle starts, e.g. arc_length=40 lateral_error=2 speed=0"
    )


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add `--seed`, 0 by default."""
    parser.add_argument("--seed", type=whole(0, 2**63 - 1), default=0)


def add_seeds(parser: argparse.ArgumentParser, default: int, meaning: str = "") -> None:
    """Add `--seeds N`; `seeds_of` reads it."""
    parser.add_argument(
        "--seeds", type=whole(1, MOST_SEEDS), default=default, metavar="N",
        help=meaning or f"default {default}",
    )  # fmt: skip


def seeds_of(options: argparse.Namespace) -> range:
    """Return the seeds 0 to N - 1 of `--seeds N`."""
    return range(options.seeds)


def add_vehicle(parser: argparse.ArgumentParser) -> None:
    """Add `--vehicle NAME`."""
    parser.add_argument("--vehicle", default="m2-minibus", metavar="NAME")


def add_conditions(
    parser: argparse.ArgumentParser,
    default: str | None = "simulation",
    meaning: str | None = None,
    changes: str | None = None,
) -> None:
    """Add `--conditions NAME` and `--conditions-set KEY=VALUE ...`; `conditions_of` reads both."""
    parser.add_argument("--conditions", default=default, metavar="NAME", help=meaning)
    add_settings(parser, "--conditions-set", changes)


def add_settings(
    parser: argparse.ArgumentParser, option: str, meaning: str | None = None, nargs: str = "+"
) -> None:
    """Add an option that takes KEY=VALUE pairs; `parse_settings` reads them."""
    parser.add_argument(option, nargs=nargs, default=[], metavar="KEY=VALUE", help=meaning)


def parse_settings(pairs: Sequence[str]) -> dict[str, Any]:
    """Read KEY=VALUE pairs; values are JSON where they parse as such, text otherwise.

    Raises
    ------
    ValueError
        For a pair without "=", or JSON beyond the bounds of `trajectories.fileio.parse_json`.
    """
    from trajectories.arguments import shown
    from trajectories.fileio import parse_json

    settings: dict[str, Any] = {}
    for pair in pairs:
        key, separator, value = pair.partition("=")
        if not separator or not key:
            raise ValueError(f"{shown(pair)} is not KEY=VALUE")
        try:
            json.loads(value)
        except ValueError:
            settings[key] = value
        except RecursionError:
            raise ValueError(f"{shown(pair)}: nested too deeply") from None
        else:
            settings[key] = parse_json(value, pair)
    return settings


def add_agents(
    parser: argparse.ArgumentParser, meaning: str, default: list[str] | None = None
) -> None:
    """Add `--agents` alias `--agent`, one name or several."""
    _add_names(parser, "--agents", "--agent", default=default, help=meaning)


def add_trajectories(
    parser: argparse.ArgumentParser, default: list[str] | None, meaning: str | None = None
) -> None:
    """Add `--trajectories` alias `--trajectory`, one name or several."""
    _add_names(parser, "--trajectories", "--trajectory", default=default, help=meaning)


def add_vehicles(
    parser: argparse.ArgumentParser, default: list[str] | None, meaning: str | None = None
) -> None:
    """Add `--vehicles` alias `--vehicle`, one name or several."""
    _add_names(parser, "--vehicles", "--vehicle", default=default, help=meaning)


def add_speed_modes(parser: argparse.ArgumentParser, default: list[str] | None) -> None:
    """Add `--speed-modes` alias `--speed-mode`, and `--grip`; `speed_modes_of` reads both."""
    choices = ["variable", "fixed", "grip"]
    _add_names(parser, "--speed-modes", "--speed-mode", default=default, choices=choices)
    parser.add_argument(
        "--grip", nargs="+", type=number(0.05, 2.0), default=[], metavar="SHARE",
        help="speed mode grip: plan the speed for the vehicle and this share of what friction "
        "allows, e.g. 0.8",
    )  # fmt: skip


def speed_modes_of(options: argparse.Namespace) -> list[str]:
    """Return the modes of `--speed-modes`: "grip" if there are none but a `--grip`.

    Raises
    ------
    ValueError
        If there is a share of grip without the mode, or the mode without a share.
    """
    modes: list[str] = options.speed_modes or []
    if options.grip and not modes:
        return ["grip"]
    if bool(options.grip) != ("grip" in modes):
        raise ValueError("--speed-modes grip and --grip SHARE belong together: give both")
    return modes


def _add_names(parser: argparse.ArgumentParser, *names: str, **more: Any) -> None:
    metavar = None if "choices" in more else "NAME"
    parser.add_argument(*names, nargs="+", metavar=metavar, action=_OneSpelling, **more)


class _OneSpelling(argparse.Action):
    """Store the values; refuse an option that is given under both of its names."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,  # noqa: ARG002
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        seen = f"_spelling_of_{self.dest}"
        if getattr(namespace, seen, option_string) != option_string:
            raise ValueError(f"give {self.option_strings[1]} or {self.option_strings[0]}, not both")
        setattr(namespace, seen, option_string)
        setattr(namespace, self.dest, values)


def only_one(kind: str, names: Sequence[Any]) -> Any:
    """Return the one name that was given.

    Raises
    ------
    ValueError
        If there are several.
    """
    if len(names) > 1:
        raise ValueError(f"one {kind} is driven at a time, not {' '.join(map(str, names))}")
    return names[0]


def add_agent_settings(parser: argparse.ArgumentParser, nargs: str = "+") -> None:
    """Add `--agent-set`; `agent_settings` reads it."""
    parser.add_argument(
        "--agent-set", nargs=nargs, default=[], metavar="[NAME:]KEY=VALUE",
        help="settings of every agent, or of the agent NAME alone, e.g. "
        'lpv-nmpc:weights={"Q":[1,1,20,20]}',
    )  # fmt: skip


def agent_settings(
    pairs: Sequence[str], agents: Iterable[str], of_folders: Mapping[str, str] | None = None
) -> dict[str, dict[str, Any]]:
    """Return the settings of each agent from `--agent-set`.

    KEY=VALUE sets every agent, NAME:KEY=VALUE the agent NAME alone, whatever the former says.
    `of_folders` gives the agent of each name that is a folder of trainings.

    Raises
    ------
    ValueError
        For a NAME that is not among the agents; a setting that an agent does not know; and one that
        is to hold for all agents although their defaults for it are different names or files, such
        as the weights of `lpv-nmpc` and `lpv-nmpc-tuned`: it would turn one agent into another.
    """
    from agents.registry import check_settings, parameters_of
    from trajectories.naming import choose

    made = {name: (of_folders or {}).get(name, name) for name in agents}
    names = tuple(made)
    common: dict[str, Any] = {}
    own: dict[str, dict[str, Any]] = {name: {} for name in names}
    for key, value in parse_settings(pairs).items():
        name, separator, setting = key.rpartition(":")
        if separator:
            own[choose("agent in --agent-set", name, names)][setting] = value
        else:
            common[key] = value
    for key in common:
        defaults = {
            name: known[key].default
            for name, agent in made.items()
            if key not in own[name] and key in (known := parameters_of(agent) or {})
        }
        named = any(isinstance(default, str | Path) for default in defaults.values())
        if named and len({repr(default) for default in defaults.values()}) > 1:
            raise ValueError(
                f"setting {shown(key)} has different defaults for {', '.join(defaults)}: say whose "
                f"it is, as --agent-set {next(iter(defaults))}:{key}=..."
            )
    for name in names:
        try:
            check_settings(made[name], {**common, **own[name]})
        except ValueError as error:
            if not common or len(names) == 1:
                raise
            raise ValueError(f"{error}; --agent-set NAME:KEY=VALUE sets one agent alone") from None
    return {name: {**common, **own[name]} for name in names}


def conditions_of(options: argparse.Namespace) -> str | dict[str, Any]:
    """Return the name of the conditions, or a dictionary of it and the changed fields."""
    changes = parse_settings(options.conditions_set)
    name = options.conditions or "simulation"
    return {"name": name, **changes} if changes else name


@contextmanager
def resumable(
    options: argparse.Namespace, console: Console, how: str = "the same command"
) -> Iterator[None]:
    """On Ctrl-C, say how to go on with `--out`; `lpv-track` then ends with EXIT_INTERRUPTED."""
    try:
        yield
    except KeyboardInterrupt:
        console.print(f"interrupted: {how} goes on from {options.out}")
        raise
