"""Time several things in interleaved rounds (A B A B ...) and compare them round by round.

A machine's speed drifts with its load and clock, by tens of per cent and for seconds at a time. Two
things timed one after the other differ by that drift. Round k of one and round k of the other are
taken within a moment of each other, so the drift cancels in their ratio, and the spread of the
ratios shows the noise that is left.
"""

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Run = Callable[[int], float]
"""Repeats some work a number of times and returns the seconds that it took, without set-up."""
Round = Callable[[], float]
"""Measures one round and returns the value per repetition."""
Tick = Callable[[str], None]
"""Receives the name of the current measurement for the progress bar."""

SHORTEST = 1e-7
"""Lower bound on a measured time in the denominator of a ratio, s."""
PREDICT = "s/predict"
COLD_START = "s/predict, first of an episode"
WINDOW_MEDIAN = "s/predict, median of a window"
"""Unit of rounds that are medians themselves; ratios of solvers are computed from these."""
MANY = 100
"""Number of rounds from which on a 99th percentile is reported."""
INSTALL = {
    "highway_env": "pip install 'lpv-track-env[highway]'",
    "stable_baselines3": "pip install 'lpv-track-env[rl]'",
    "torch": "pip install 'lpv-track-env[rl]'",
    "gymnax": "pip install gymnax",
    "jax": "pip install gymnax",
    "envpool": "pip install envpool",
}
"""Command that installs each optional package, by module."""


@dataclass(frozen=True)
class Effort:
    """Amount of measuring."""

    rounds: int = 9
    round_seconds: float = 0.08
    """Approximate duration of a round, s."""
    sizes: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096, 16384)
    """Numbers of environments stepped together."""
    threads: tuple[int, ...] = (1, 2)
    learning_rounds: int = 3
    learning_steps: int = 4096
    """Environment steps in a round of PPO, over all its environments."""
    trajectories: tuple[str, ...] = ("T2", "T4")
    window: int = 60
    """Consecutive control periods in a window of observations for the solvers."""
    windows: int = 4
    """Windows per trajectory, evenly spaced along it."""
    repeats: int = 2
    """Number of times that every solver solves every window."""
    horizons: tuple[int, ...] = (10, 20, 30, 40, 50)
    batches: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    wild: int = 6000
    """Random observations per vehicle in the section `wild`."""
    frames: int = 5000
    """Largest number of frames to draw."""
    processes: int = 3
    """Fresh processes per program."""
    cold: bool = True
    """True to also start processes with an empty numba cache, 10 s or more each."""
    large: int = 4096
    """Environments in the vector environment whose memory is measured."""


FULL = Effort()
QUICK = Effort(
    rounds=3, round_seconds=0.005, sizes=(1, 16), learning_rounds=1, learning_steps=128,
    trajectories=("T2",), window=6, windows=2, repeats=1, horizons=(10, 20), batches=(1, 4),
    wild=60, frames=40, processes=1, cold=False, large=64,
)  # fmt: skip


@dataclass
class Series:
    """Rounds of one measurement in `unit`, and the settings that they were taken with."""

    name: str
    unit: str
    settings: dict[str, Any] = field(default_factory=dict)
    rounds: list[float] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return all fields and the statistics of the rounds."""
        return {
            "name": self.name,
            "unit": self.unit,
            "settings": self.settings,
            "rounds": list(self.rounds),
            **summary(self.rounds),
        }


@dataclass(frozen=True)
class Comparison:
    """Ratio other / ours, round by round: how many times faster (or smaller) ours is."""

    ours: Series
    other: Series

    def as_dict(self) -> dict[str, Any]:
        """Return names and settings of both series, the ratio of each round, and its statistics."""
        # An interrupted run has the last round of some series only.
        pairs = zip(self.ours.rounds, self.other.rounds, strict=False)
        rounds = [other / max(ours, SHORTEST) for ours, other in pairs]
        return {
            "ours": self.ours.name,
            "other": self.other.name,
            "unit": self.ours.unit,
            "settings": {"ours": self.ours.settings, "other": self.other.settings},
            "rounds": rounds,
            **summary(rounds),
        }


@dataclass
class Section:
    """Measurements of one section, filled as they are taken, so that an interrupt keeps them."""

    title: str
    notes: list[str] = field(default_factory=list)
    series: list[Series] = field(default_factory=list)
    comparisons: list[Comparison] = field(default_factory=list)
    unavailable: list[dict[str, str]] = field(default_factory=list)

    def add(self, name: str, unit: str, **settings: Any) -> Series:
        """Begin a series."""
        series = Series(name, unit, settings)
        self.series.append(series)
        return series

    def compare(self, ours: Series, other: Series) -> None:
        """Report the ratio other / ours."""
        self.comparisons.append(Comparison(ours, other))

    def leave_out(self, name: str, reason: str) -> None:
        """Note once that something cannot be measured here."""
        note = {"name": name, "reason": reason}
        if note not in self.unavailable:
            self.unavailable.append(note)

    def available(self, factories: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
        """Call the factories and return the results by name, noting those that are unavailable."""
        made = {}
        for name, factory in factories.items():
            try:
                made[name] = factory()
            except Unavailable as reason:
                self.leave_out(name, str(reason))
        return made

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, without series that have no round yet."""
        return {
            "title": self.title,
            "notes": list(self.notes),
            "series": [series.as_dict() for series in self.series if series.rounds],
            "ratios": [
                pair.as_dict()
                for pair in self.comparisons
                if pair.ours.rounds and pair.other.rounds
            ],
            "unavailable": list(self.unavailable),
        }


def summary(rounds: Sequence[float]) -> dict[str, float]:
    """Return median, minimum, maximum and, from `MANY` rounds on, the 99th percentile; or {}."""
    if not rounds:
        return {}
    found = {"median": np.median(rounds), "min": np.min(rounds), "max": np.max(rounds)}
    if len(rounds) >= MANY:
        found["p99"] = np.percentile(rounds, 99)
    return {name: float(value) for name, value in found.items()}


def calibrated(run: Run, seconds: float, items: int = 1) -> Round:
    """Return a round of about `seconds`, with the number of repetitions found here.

    A round's value is the time of one repetition divided by `items`, the number of things that a
    repetition does at once. The first call is not timed, since it may compile.
    """
    run(1)
    count, took = 1, run(1)
    while took < 0.25 * seconds:
        count *= 2
        took = run(count)
    count = max(round(count * seconds / took), 1)
    return lambda: run(count) / count / items


def interleave(pairs: Iterable[tuple[Series, Round]], rounds: int) -> None:
    """Measure the rounds of all series in turn, A B C A B C ..."""
    pairs = list(pairs)
    for _ in range(rounds):
        for series, measure_round in pairs:
            series.rounds.append(measure_round())


class Unavailable(Exception):  # noqa: N818  reported as a note, not as an error
    """Something that cannot be measured here, with the reason in one line."""


def module(name: str) -> Any:
    """Import a module of an optional package.

    Raises
    ------
    Unavailable
        With the command that installs the package.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = (error.name or name).partition(".")[0]
        hint = INSTALL.get(missing, f"pip install {missing}")
        raise Unavailable(f"{missing} is not installed: {hint}") from error
