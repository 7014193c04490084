"""Jobs that run in steps, can be interrupted anywhere, and resume with the same bits.

A job has a folder to itself. The folder holds `settings.json`, `progress.jsonl` with a line for
every step, the state that the job resumes from, and its result. Each step depends only on the
settings and on the state before it: a resumed job ends with the same bits as an uninterrupted one.
"""

import contextlib
import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, Required, TypedDict

import trajectories
from experiments.run.engines import Interrupts
from experiments.run.folder_lock import locked
from experiments.run.provenance import COMPUTING, computing_versions, file_digest
from experiments.run.suites import CIRCUITS, HELD_OUT, LIMIT_PATHS, SIX
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath
from trajectories.arguments import shown
from trajectories.fileio import checked, parse_json, read_bytes, read_json, write_atomically

SETTINGS, PROGRESS, VERSIONS = "settings.json", "progress.jsonl", "versions.json"
JOBS, FIRST = "lpv-track-env jobs", "1"
"""Name of the version of what jobs compute, and the version of files that do not name it."""
JOBS_VERSION = "3"
"""It counts up with every change of environments or of the NMPC after which a job learns another
thing: 2 has a preview of 2 s, stages that grow, and weights on the rates of inputs; 3 validates by
the reward of all drives together."""

Line = dict[str, Any]


class ProgressLine(TypedDict, total=False):
    """Entries of a progress line that are read again; there may be further ones."""

    seconds: Required[float]
    learning_seconds: float
    steps: int
    solves: int
    score: float
    best: bool | float
    validation: dict[str, float]


class Settings(Protocol):
    """Settings that determine the result of a job."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, equal to what JSON gives back."""


class Listener:
    """Receives the progress of a job; this one ignores it."""

    def loading(self, done: int, count: int) -> None:
        """Receive how many of all paths are loaded."""

    def tick(self, done: int, words: str) -> None:
        """Receive the progress within a step, and a few words on it."""

    def line(self, line: Line) -> None:
        """Receive the line of a step, once its state is saved."""


class Job(ABC):
    """A computation in steps; `lines` has the progress line of every step so far."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.lines: list[Line] = []

    @property
    @abstractmethod
    def done(self) -> bool:
        """True when no step is left."""

    @abstractmethod
    def step(self) -> Line:
        """Run one step; return the entries of its line, except `seconds`."""

    def conclude(self, line: Line) -> Line:
        """Complete the line of a step; the time that this takes counts in the next line only."""
        return line

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write the state that `restore` reads, atomically."""

    @abstractmethod
    def restore(self, folder: Path) -> bool:
        """Read the state that `save` wrote, with its lines; False if there is none.

        Raises
        ------
        ValueError
            In one line, if a file cannot be used.
        """


def run_job(
    job: Job, folder: Path, listener: Listener, *, seconds_at_most: float = math.inf
) -> list[Line]:
    """Run the steps that are left, or as many as the time allows; return all lines.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C; the folder keeps every step but the interrupted one.
    """
    write_settings(folder, job.settings)
    if job.lines:
        _write_lines(folder, job.lines)
    before = job.lines[-1]["seconds"] if job.lines else 0.0
    began = time.perf_counter()
    with Interrupts() as interrupts:
        while not job.done:
            entries = job.step()
            interrupts.check()
            line = job.conclude({**entries, "seconds": before + time.perf_counter() - began})
            interrupts.check()
            job.lines.append(line)
            # A job that is killed between these two resumes from the state before the line.
            _write_lines(folder, job.lines)
            job.save(folder)
            listener.line(line)
            if line["seconds"] > seconds_at_most:
                break
    return job.lines


@contextlib.contextmanager
def claimed(
    folder: Path, settings: Settings, kind: str, packages: Sequence[str] = ()
) -> Iterator[bool]:
    """Make a folder a job's own; the value is True if it holds the same job already.

    `kind` is "training" or "tuning", for the messages; `packages` compute in it, beside those that
    compute everything.

    Raises
    ------
    ValueError
        If another process uses the folder, or it holds a job with other settings, or of other
        versions: half of its steps would be of either, and nobody could repeat it.
    """
    with locked(folder):
        stored = stored_settings(folder, kind)
        file = folder / VERSIONS
        own = {JOBS: JOBS_VERSION, **computing_versions(*COMPUTING, *packages)}
        # A user who removes the file goes on all the same.
        kept = stored is not None and file.exists()
        if kept:
            _check_versions(folder, kind, own)
        if stored is not None and (differs := difference(settings, stored)):
            raise ValueError(
                f"{folder} holds a {kind} with other settings: {differs}: give the same options, "
                "or another --out"
            )
        if not kept:
            write_atomically(file, json.dumps(own, indent=2).encode())
        yield stored is not None


def _check_versions(folder: Path, kind: str, own: Mapping[str, str]) -> None:
    """Compare the versions of what computes with those that a job began with."""
    file = folder / VERSIONS
    begun_with = checked(read_json(file), dict[str, str], file)
    if begun_with.get(JOBS, FIRST) != own[JOBS]:
        raise ValueError(
            f"{folder} holds a {kind} of another version of lpv-track-env, whose preview and NMPC "
            f"differ: give another --out to begin anew, or go on with that version"
        )
    for name, version in own.items():
        if (then := begun_with.get(name, version)) != version:
            raise ValueError(
                f"{folder} holds a {kind} made with {name} {then}, here is {version}: install that "
                f"one, give another --out, or remove {VERSIONS} to go on all the same"
            )


def stored_settings(folder: Path, kind: str) -> Mapping[str, Any] | None:
    """Read the settings of the job in a folder; None if there is none.

    Raises
    ------
    ValueError
        If the file cannot be read.
    """
    file = folder / SETTINGS
    if not file.exists():
        return None
    try:
        return checked(read_json(file), dict[str, Any], file)
    except ValueError as error:
        raise ValueError(f"{folder} holds no {kind} to go on with: {error}") from None


def write_settings(folder: Path, settings: Settings) -> None:
    """Write the settings of a job."""
    write_atomically(folder / SETTINGS, json.dumps(settings.as_dict(), indent=2).encode())


def difference(settings: Settings, stored: Mapping[str, Any]) -> str | None:
    """Describe the first difference between settings and stored ones; None if they are equal."""
    for key, value in settings.as_dict().items():
        if stored.get(key) != value:
            return f"{key} is {shown(value)}, there {shown(stored.get(key))}"
    return None


def plain_values(settings: Any, named: Iterable[str]) -> dict[str, Any]:
    """Convert a dataclass to what JSON gives back, with the digests of the named files."""
    files = {name: file_digest(Path(name)) for name in named if Path(name).is_file()}
    plain: dict[str, Any] = json.loads(json.dumps({**asdict(settings), "files": files}))
    return plain


def read_lines(folder: Path) -> list[Line]:
    """Read the lines of a folder's `progress.jsonl`.

    Raises
    ------
    ValueError
        In one line that names the file and line, for one that is no progress line.
    """
    file = folder / PROGRESS
    lines = []
    for number, text in enumerate(read_bytes(file).splitlines(), start=1):
        line = parse_json(text, name := f"{file}, line {number}")
        checked(line, ProgressLine, name)
        lines.append(line)
    return lines


def _write_lines(folder: Path, lines: Sequence[Line]) -> None:
    text = "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)
    write_atomically(folder / PROGRESS, text.encode())


# Paths and seeds, which never overlap with those of evaluation ------------------------------------

TRAINING_PATHS, VALIDATION_PATHS = 10_000_000, 20_000_000  # smaller seeds are for evaluation
MOST_PATHS = 1000
"""Largest number of random paths for one seed of a job: the next seed's paths follow them."""
# Seeds of episodes: evaluation counts from 0. Under one seed, a vehicle meets the same disturbances
# on every path.
VALIDATION_EPISODES, TRAINING_EPISODES = 2 * 10**8, 10**9


def random_names(first: int, count: int) -> list[str]:
    """Return names of random paths with seeds from `first` on, slow and fast ones in turn."""
    return [f"random-{'fast-' * (k % 2)}{first + k}" for k in range(count)]


def training_names(own: Sequence[str], seed: int, count: int) -> list[str]:
    """Return the user's own paths, or else the random ones that belong to a job's seed."""
    return list(own) or random_names(TRAINING_PATHS + MOST_PATHS * seed, count)


def episode_seed(seed: int, number: int) -> int:
    """Return the seed of the first episode in step `number` of a job; the others count on."""
    return TRAINING_EPISODES * (1 + seed) + 1_000_000 * number


def load_paths(
    names: Sequence[str],
    tick: Callable[[int, int], None] = lambda *_: None,
    car: VehicleParameters | None = None,
) -> list[ReferencePath]:
    """Load paths, those in files for a car; `tick(done, all)` is called after each."""
    paths = []
    for k, name in enumerate(names):
        paths.append(trajectories.load(name, vehicle=car))
        tick(k + 1, len(names))
    return paths


def check_paths(own: Sequence[str], count: int, seed: int, *, verb: str) -> None:
    """Refuse paths of the evaluation, more random paths than a seed has, and a wrong seed.

    Raises
    ------
    ValueError
        Naming what is wrong; `verb` is "train" or "tune".
    """
    if count > MOST_PATHS:
        raise ValueError(f"paths must be at most {MOST_PATHS}, not {count}")
    if not 0 <= seed < 1000:
        raise ValueError(f"seed must be in [0, 999], not {seed}")
    for name in own:
        if name.removesuffix("-raw") in (*SIX, *HELD_OUT, *LIMIT_PATHS, *CIRCUITS):
            raise ValueError(f"{name} is for evaluation: {verb} on other paths")
