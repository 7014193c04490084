"""`lpv-track speed`: how fast the environments and the solvers are, against their peers."""

import argparse
import importlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from experiments.commands.options import EXIT_INTERRUPTED, add_out

if TYPE_CHECKING:
    from experiments.speed.measure import Effort, Tick

EXAMPLE = "lpv-track speed --only single vector --out results/speed"
FORMAT = "lpv-track-speed/1"
SECTIONS = {
    "single": ("environments", "One environment through gymnasium.make"),
    "vector": ("environments", "Environments stepped together"),
    "conditions": ("environments", "The same under the conditions of a real vehicle"),
    "learning": ("loops", "Share of PPO's time that the environments take"),
    "training": ("loops", "PPO at its fast setting"),
    "solvers": ("solvers", "NMPC solvers on the same observations"),
    "policies": ("solvers", "Learned policies beside the NMPC"),
    "horizons": ("solvers", "NMPC solvers over the horizon"),
    "batches": ("solvers", "NMPC on batches of observations"),
    "wild": ("solvers", "The real-time NMPC on wild observations"),
    "loops": ("loops", "Closed loops in compiled code"),
    "tuning": ("loops", "Decisions on the NMPC's weights"),
    "rendering": ("environments", "Frames of a drive, headless"),
    "memory": ("processes", "Memory of fresh processes"),
    "startup": ("processes", "Start-up of fresh processes"),
}
"""Module and title of each section, in the order in which they run. The section's function has its
name and is in that module of `experiments.speed`; `display.PANELS` draws it, if listed there."""
PEERS = ("gymnax", "jax", "envpool")
"""Packages of other projects' environments; their versions are stored with the results."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_out(parser, "results/speed")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="SECTION",
        help=f"default: all of {', '.join(SECTIONS)}",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="tiny: shows that it works, no more")


def run(options: argparse.Namespace, console: Console) -> int:
    """Measure, write `speed.json` and `speed.png`, print tables, and return the exit code.

    Raises
    ------
    ValueError
        For an unknown section.
    """
    from experiments.figures import save_figure
    from experiments.speed.display import figure_of, show
    from trajectories.naming import choose

    folder: Path = options.out
    chosen = [choose("section", name, tuple(SECTIONS)) for name in options.only] or list(SECTIONS)
    folder.mkdir(parents=True, exist_ok=True)
    result = _measure_all(folder, chosen, quick=options.quick, console=console)
    figure = figure_of(result)
    if figure is not None:
        save_figure(figure, folder / "speed.png")
    show(result, console)
    complete = result["complete"]
    measured = "every round" if complete else "interrupted; what was measured"
    console.out(f"{measured}: {folder / 'speed.json'}", highlight=False)
    return 0 if complete else EXIT_INTERRUPTED


def _measure_all(
    folder: Path, chosen: Sequence[str], *, quick: bool, console: Console
) -> dict[str, Any]:
    """Measure the chosen sections and write `speed.json` after each; Ctrl-C ends early."""
    from experiments.run.benchmark import progress_bar
    from experiments.run.engines import Interrupts
    from experiments.speed.measure import FULL, QUICK

    effort = QUICK if quick else FULL
    result = _empty(effort, chosen, quick=quick)
    try:
        with progress_bar(console) as progress, Interrupts() as interrupts:
            bar = progress.add_task("", total=len(chosen))

            def tick(text: str) -> None:
                interrupts.check()
                progress.update(bar, description=text)

            for name in SECTIONS:
                if name not in chosen:
                    continue
                _measure(name, result, effort, tick)
                interrupts.check()
                _write(result, folder)
                progress.advance(bar)
                if not console.is_terminal:
                    seconds = result["sections"][name]["seconds"]
                    console.print(f"{name}: {seconds:.0f} s", highlight=False)
        result["complete"] = True
    except KeyboardInterrupt:
        pass
    _write(result, folder)
    return result


def _measure(name: str, result: dict[str, Any], effort: "Effort", tick: "Tick") -> None:
    """Measure a section into the result; an interrupted section keeps its finished rounds."""
    from experiments.run.provenance import load_average
    from experiments.speed.measure import Section

    module, title = SECTIONS[name]
    measure = getattr(importlib.import_module(f"experiments.speed.{module}"), name)
    section = Section(title)
    before, began = load_average(), time.perf_counter()
    try:
        measure(section, effort, tick)
    finally:
        result["sections"][name] = {
            **section.as_dict(),
            "seconds": time.perf_counter() - began,
            "load_average_before": before,
        }


def _empty(effort: "Effort", chosen: Sequence[str], *, quick: bool) -> dict[str, Any]:
    """Return the content of `speed.json` before the first section."""
    from experiments.run.provenance import measured_on

    result = {
        "format": FORMAT,
        "written": None,
        "complete": False,
        "settings": {"quick": quick, "sections": list(chosen), **asdict(effort)},
        **measured_on(*PEERS),
        "sections": {},
    }
    result["machine"]["threads"] = {
        name: os.environ[name] for name in sorted(os.environ) if name.endswith("_THREADS")
    }
    return result


def _write(result: dict[str, Any], folder: Path) -> None:
    """Write `speed.json`."""
    from experiments.run.provenance import load_average
    from trajectories.fileio import write_atomically

    result["written"] = datetime.now(UTC).isoformat(timespec="seconds")
    result["machine"]["load_average_after"] = load_average()
    content = json.dumps(result, indent=1, allow_nan=False)
    write_atomically(folder / "speed.json", content.encode() + b"\n")
