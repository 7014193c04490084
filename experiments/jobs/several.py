"""Jobs that differ in their seed, side by side; the job of seed N has the folder `seed-N`."""

import argparse
import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numba
from rich.console import Console
from rich.progress import Progress

from experiments.jobs.console import Display, check_resume
from experiments.jobs.curves import Curve, draw
from experiments.jobs.job import (
    PROGRESS,
    Line,
    Listener,
    Settings,
    difference,
    read_lines,
    stored_settings,
)
from experiments.run.benchmark import progress_bar
from experiments.run.case import in_words
from experiments.run.engines import Engine
from experiments.run.training_folders import POLICY, seed_folder
from trajectories.arguments import shown

Spec = dict[str, Any]

LOOK = 1.0
"""Time between looks at the progress of the jobs, s."""


@dataclass(frozen=True)
class Kind:
    """A kind of job.

    Parameters
    ----------
    name
        "training" or "tuning".
    run
        Runs or resumes a job: settings, folder, listener and `command`.
    display
        Makes the display of a job from its settings, a progress bar and a prefix of its lines.
    finished
        Returns whether the job of given settings in a folder is finished.
    curves, budget
        Arguments of `curves.draw`.
    """

    name: str
    run: Callable[..., Sequence[Line]]
    display: Callable[[Any, Progress, str], Display]
    finished: Callable[[Any, Path], bool]
    curves: Sequence[Curve]
    budget: str


def start_of(start: str | None, seed: int) -> str | None:
    """Return the policy to start from: of a folder of trainings that of the same seed.

    Raises
    ------
    ValueError
        If the folder has none of this seed.
    """
    if start is None or not Path(start).is_dir():
        return start
    file = seed_folder(Path(start), seed) / POLICY
    if not file.is_file():
        raise ValueError(
            f"--from {shown(start)} has no {file.relative_to(start)}: give a folder with a "
            "training of every seed, or one policy file"
        )
    return str(file)


def run_seeds(
    kind: Kind,
    options: argparse.Namespace,
    seeds: Sequence[int],
    job_of: Callable[[argparse.Namespace], tuple[Settings, str]],
    engine: Engine,
    console: Console,
) -> int:
    """Run or resume the job of each seed, draw `KIND.png`; return the number of those that failed.

    `job_of` returns settings and command of a job from its options, as if it were given alone. A
    job that fails does not stop the others.

    Raises
    ------
    ValueError
        If a folder holds a job and `--resume` is off, or one of other settings.
    KeyboardInterrupt
        On Ctrl-C; every folder keeps the steps of its job but the last.
    """
    specs: list[Spec] = []
    for seed in seeds:
        folder = seed_folder(options.out, seed)
        own = argparse.Namespace(**{**vars(options), "seed": seed, "out": folder})
        own.start = start_of(getattr(options, "start", None), seed)
        settings, command = job_of(own)
        specs.append({"seed": seed, "folder": folder, "settings": settings, "command": command})
    left = _unfinished(kind, specs, options, console)
    failed = _run(kind, left, engine, console)
    if runs := {spec["seed"]: lines for spec in specs if (lines := _lines(spec["folder"]))}:
        draw(runs, kind.curves, kind.budget, options.out / f"{kind.name}.png")
    done = len(seeds) - failed
    drive = f" (lpv-track benchmark --agents {options.out})" if done else ""
    console.out(f"{done} of {len(seeds)} {kind.name}s: {options.out}{drive}", highlight=False)
    return failed


def _unfinished(
    kind: Kind, specs: Sequence[Spec], options: argparse.Namespace, console: Console
) -> list[Spec]:
    """Return the specs whose jobs are not finished, once all folders can be used."""
    if stored_settings(options.out, kind.name) is not None:
        raise ValueError(f"{options.out} holds a single {kind.name}: give another --out")
    for spec in specs:
        folder: Path = spec["folder"]
        if check_resume(folder, kind.name, resume=options.resume):
            stored = stored_settings(folder, kind.name) or {}
            if differs := difference(spec["settings"], stored):
                raise ValueError(
                    f"{folder} holds a {kind.name} with other settings: {differs}: give the same "
                    "options, or another --out"
                )
    left = [spec for spec in specs if not kind.finished(spec["settings"], spec["folder"])]
    if done := [spec["seed"] for spec in specs if spec not in left]:
        seeds = ", ".join(map(str, done))
        console.print(f"finished already: seed{'s' * (len(done) > 1)} {seeds}", highlight=False)
    return left


def _run(kind: Kind, specs: Sequence[Spec], engine: Engine, console: Console) -> int:
    failed = 0
    with progress_bar(console) as progress, _followed(kind, specs, progress):
        results = engine.run(
            specs, partial(_attempt, kind.run), failed=_outcome, files=_files, folder=_folder
        )
        for result in results:
            if result["error"] is not None:
                failed += 1
                console.print(
                    f"seed {result['seed']} failed: {result['error']}", markup=False, style="red"
                )
    return failed


def _attempt(run: Callable[..., Any], spec: Spec) -> dict[str, Any]:
    """Run a job in one thread; whatever goes wrong in it becomes its result."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        run(spec["settings"], spec["folder"], Listener(), command=spec["command"])
    except Exception as error:  # noqa: BLE001  the other jobs go on
        return _outcome(spec, in_words(error))
    finally:
        numba.set_num_threads(before)
    return _outcome(spec)


def _outcome(spec: Mapping[str, Any], error: str | None = None) -> dict[str, Any]:
    return {"seed": spec["seed"], "error": error}


def _files(spec: Mapping[str, Any]) -> list[Path]:
    settings: Settings = spec["settings"]
    return [Path(name) for name in settings.as_dict()["files"]]


def _folder(spec: Mapping[str, Any]) -> Path:
    folder: Path = spec["folder"]
    return folder


def _lines(folder: Path) -> list[Line]:
    return read_lines(folder) if (folder / PROGRESS).exists() else []


@contextlib.contextmanager
def _followed(kind: Kind, specs: Sequence[Spec], progress: Progress) -> Iterator[None]:
    """Show the lines that jobs write into their folders, in a thread."""
    ended = threading.Event()
    seen = {spec["seed"]: len(_lines(spec["folder"])) for spec in specs}
    displays = {
        spec["seed"]: kind.display(spec["settings"], progress, f"seed {spec['seed']}: ")
        for spec in specs
    }

    def look() -> None:
        for spec in specs:
            seed = spec["seed"]
            # A folder that comes from another computer may be incomplete at this moment.
            with contextlib.suppress(ValueError, OSError):
                lines = _lines(spec["folder"])
                for line in lines[seen[seed] :]:
                    displays[seed].line(line)
                seen[seed] = len(lines)

    def follow() -> None:
        while not ended.wait(LOOK):
            look()

    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        look()
