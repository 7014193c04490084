"""Timing: rounds of several things in turn (A B A B ...), raw values kept, ratios round by round.

A machine's speed drifts with its load and clock, by tens of per cent and for seconds at a time. Two
things timed one after the other differ by that drift; round k of one against round k of the other,
taken within a moment, do not, and the spread of those ratios shows what noise is left.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Run = Callable[[int], float]
"""Does something a number of times and returns the seconds it took, set-up excluded."""
Round = Callable[[], float]
"""One round: the value that it measured, for one time of what is done."""
Tick = Callable[[str], None]
"""Told what is being measured now."""

SHORTEST = 1e-7
"""s, that a clock's reading is taken for at least."""
PREDICT = "s/predict"
COLD_START = "s/predict, first of an episode"
WINDOW_MEDIAN = "s/predict, median of a window"
"""Unit of rounds that are medians themselves: for ratios, beside a series of every solve."""
MANY = 100
"""Rounds from which on a 99th percentile says something."""


@dataclass(frozen=True)
class Effort:
    """How much is measured."""

    rounds: int = 9
    round_seconds: float = 0.08
    """About how long a round takes."""
    sizes: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096, 16384)
    """Numbers of environments stepped together."""
    threads: tuple[int, ...] = (1, 2)
    learning_rounds: int = 3
    learning_steps: int = 4096
    """Env-steps of a round of PPO, over all its environments."""
    trajectories: tuple[str, ...] = ("T2", "T4")
    window: int = 60
    """Control periods in a row that solvers are given."""
    windows: int = 4
    """Windows a trajectory, evenly along it."""
    repeats: int = 2
    """Times that every solver solves every window."""
    horizons: tuple[int, ...] = (10, 20, 30, 40, 50)
    batches: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    wild: int = 6000
    """Wild observations for each vehicle."""
    frames: int = 5000
    """Frames of a drive that are drawn at most."""
    processes: int = 3
    """Fresh processes of a kind."""
    cold: bool = True
    """Whether processes with an empty numba cache are measured, 10 s and more each."""
    large: int = 4096
    """Environments of the vector env whose memory is measured."""


FULL = Effort()
QUICK = Effort(
    rounds=3, round_seconds=0.005, sizes=(1, 16), learning_rounds=1, learning_steps=128,
    trajectories=("T2",), window=6, windows=2, repeats=1, horizons=(10, 20), batches=(1, 4),
    wild=60, frames=40, processes=1, cold=False, large=64,
)  # fmt: skip


@dataclass
class Series:
    """Rounds of one thing, each a value in `unit`, and what it was made with."""

    name: str
    unit: str
    settings: dict[str, Any] = field(default_factory=dict)
    rounds: list[float] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Everything, with the median, least and greatest round."""
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
        """Both names and settings, the ratio of each round, their median, least and greatest."""
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
    """What one section measured, and what it could not. Filled as it goes, so it may be cut off."""

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
        """Have the ratio other / ours worked out."""
        self.comparisons.append(Comparison(ours, other))

    def lacks(self, name: str, reason: str) -> None:
        """Note what cannot be measured here, once."""
        note = {"name": name, "reason": reason}
        if note not in self.unavailable:
            self.unavailable.append(note)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; what has no round yet is left out."""
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
    """Median, least and greatest, of many the 99th percentile too; empty without rounds."""
    if not rounds:
        return {}
    found = {"median": np.median(rounds), "min": np.min(rounds), "max": np.max(rounds)}
    if len(rounds) >= MANY:
        found["p99"] = np.percentile(rounds, 99)
    return {name: float(value) for name, value in found.items()}


def calibrated(run: Run, seconds: float) -> Round:
    """A round of about `seconds`: the number of times is found here.

    The first time of all is not counted on: it may compile.
    """
    run(1)
    count, took = 1, run(1)
    while took < 0.25 * seconds:
        count *= 2
        took = run(count)
    count = max(round(count * seconds / took), 1)
    return lambda: run(count) / count


def interleave(pairs: Iterable[tuple[Series, Round]], rounds: int) -> None:
    """Measure rounds of each in turn, A B C A B C ..., into their series."""
    pairs = list(pairs)
    for _ in range(rounds):
        for series, once in pairs:
            series.rounds.append(once())


def clock(work: Callable[[], object]) -> float:
    """Seconds that some work takes."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
