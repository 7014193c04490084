"""`lpv-track speed`: measure sections, keep every round, print tables, draw."""

import importlib.metadata
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from experiments.figures import save_figure
from experiments.run.process import Interrupts
from experiments.run.provenance import hardware, revision, versions
from experiments.speed import (
    environments,
    learning,
    loops,
    policies,
    processes,
    rendering,
    solvers,
    tables,
    wild,
)
from experiments.speed.figures import picture
from experiments.speed.measure import FULL, QUICK, Effort, Section, Tick
from trajectories.fileio import write_atomically
from trajectories.naming import choose

FORMAT = "lpv-track-speed/1"
Measure = Callable[[Section, Effort, Tick], None]

SECTIONS: dict[str, tuple[str, Measure]] = {
    "single": ("One environment through gymnasium.make", environments.single),
    "vector": ("Environments stepped together", environments.vector),
    "conditions": ("The same under the conditions of a real vehicle", environments.conditions),
    "learning": ("Share of PPO's time that the environments take", learning.learning),
    "training": ("PPO at its fast setting", policies.training),
    "solvers": ("NMPC solvers on the same observations", solvers.solvers),
    "policies": ("Learned policies beside the NMPC", policies.policies),
    "horizons": ("NMPC solvers over the horizon", solvers.horizons),
    "batches": ("NMPC on batches of observations", solvers.batches),
    "wild": ("The real-time NMPC on wild observations", wild.wild),
    "loops": ("Closed loops in compiled code", loops.loops),
    "tuning": ("Decisions on the NMPC's weights", loops.tuning),
    "rendering": ("Frames of a drive, headless", rendering.rendering),
    "memory": ("Memory of fresh processes", processes.memory),
    "startup": ("Start-up of fresh processes", processes.startup),
}
"""Title and function of each section, in the order in which they run: adding one is a line here,
and one in `figures.PANELS` if it is drawn."""
PEERS = ("highway-env", "gymnax", "jax", "envpool")


def run_speed(
    folder: Path, *, only: Sequence[str] = (), quick: bool = False, console: Console
) -> tuple[dict[str, Any], bool]:
    """Measure, write `speed.json` after each section and `speed.png` at the end, print tables.

    Returns
    -------
    result
        What `speed.json` holds.
    complete
        False if it was interrupted; what was measured until then is written all the same.

    Raises
    ------
    ValueError
        For an unknown section.
    OSError
        If the folder cannot be written.
    """
    chosen = [choose("section", name, tuple(SECTIONS)) for name in only] or list(SECTIONS)
    effort = QUICK if quick else FULL
    folder.mkdir(parents=True, exist_ok=True)
    result = _empty(effort, chosen, quick=quick)
    progress = Progress(
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip
    try:
        with progress, Interrupts() as interrupts:
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
    drawn = picture(result)
    if drawn is not None:
        save_figure(drawn, folder / "speed.png")
    tables.show(result, console)
    return result, bool(result["complete"])


def _measure(name: str, result: dict[str, Any], effort: Effort, tick: Tick) -> None:
    """One section into the result, also what an interrupted one has."""
    title, measure = SECTIONS[name]
    section = Section(title)
    before, began = _load(), time.perf_counter()
    try:
        measure(section, effort, tick)
    finally:
        result["sections"][name] = {
            **section.as_dict(),
            "seconds": time.perf_counter() - began,
            "load_average_before": before,
        }


def _empty(effort: Effort, chosen: Sequence[str], *, quick: bool) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "written": None,
        "complete": False,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "settings": {"quick": quick, "sections": list(chosen), **asdict(effort)},
        "machine": {
            **hardware(),
            "versions": {**versions(), **_peer_versions()},
            "revision": revision(),
            "threads": {
                name: os.environ[name] for name in sorted(os.environ) if name.endswith("_THREADS")
            },
            "load_average_before": _load(),
            "load_average_after": None,
        },
        "sections": {},
    }


def _peer_versions() -> Mapping[str, str]:
    found = {}
    for package in PEERS:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _load() -> list[float] | None:
    """Load average over 1, 5 and 15 minutes, where the system tells it."""
    return list(os.getloadavg()) if hasattr(os, "getloadavg") else None


def _write(result: dict[str, Any], folder: Path) -> None:
    result["written"] = datetime.now(UTC).isoformat(timespec="seconds")
    result["machine"]["load_average_after"] = _load()
    content = json.dumps(result, indent=1, allow_nan=False)
    write_atomically(folder / "speed.json", content.encode() + b"\n")
