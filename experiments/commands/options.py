"""Options that several commands share, and how their values are read."""

import argparse
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from rich.console import Console

EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


def add_out(parser: argparse.ArgumentParser, default: str) -> None:
    """Add `--out DIR`."""
    parser.add_argument("--out", type=Path, default=Path(default), metavar="DIR")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add `--workers N`, all cores by default."""
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores"
    )


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add `--seed`, 0 by default."""
    parser.add_argument("--seed", type=int, default=0)


def add_seeds(parser: argparse.ArgumentParser, default: int, meaning: str = "") -> None:
    """Add `--seeds N`; `seeds_of` reads it."""
    parser.add_argument(
        "--seeds", type=int, default=default, metavar="N", help=meaning or f"default {default}"
    )


def seeds_of(options: argparse.Namespace) -> range:
    """Return the seeds 0 to N - 1 of `--seeds N`.

    Raises
    ------
    ValueError
        If N is below 1.
    """
    if options.seeds < 1:
        raise ValueError(f"--seeds must be at least 1, not {options.seeds}")
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


def add_settings(parser: argparse.ArgumentParser, option: str, meaning: str | None = None) -> None:
    """Add an option that takes KEY=VALUE pairs; `parse_settings` reads them."""
    parser.add_argument(option, nargs="+", default=[], metavar="KEY=VALUE", help=meaning)


def parse_settings(pairs: Sequence[str]) -> dict[str, Any]:
    """Read KEY=VALUE pairs; values are JSON where they parse as such, text otherwise.

    Raises
    ------
    ValueError
        For a pair without "=", or a number that is not finite.
    """

    def refuse(constant: str) -> NoReturn:
        raise OverflowError(constant)

    settings: dict[str, Any] = {}
    for pair in pairs:
        key, separator, value = pair.partition("=")
        if not separator or not key:
            raise ValueError(f"{pair!r} is not KEY=VALUE")
        try:
            settings[key] = json.loads(value, parse_constant=refuse)
        except OverflowError:
            raise ValueError(f"{pair}: numbers must be finite") from None
        except ValueError:
            settings[key] = value
    return settings


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
