"""Drives whose weights are switched at random or by an adversary, and the vehicles lost."""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import agents
from agents.weight_tuning.choice import SLEW
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.features import TUNED
from agents.weight_tuning.score import failed
from agents.weights import HIGHEST, LOWEST, TrackingWeights
from experiments.jobs.job import random_names
from experiments.run.statistics import rate_bound
from lpv_track_env import kernels as k
from lpv_track_env.vector_env import PathTrackingVectorEnv

Array = NDArray[Any]

PATHS = 40
WINDOW = 0.4
"""Time between switches, s: that of the tuned policies."""
TIME_LIMIT = 20.0
BATCH = 250
"""Episodes driven side by side."""
CONTROL, RANDOM, ADVERSARY = "not switched", "random", "adversary"
WHOLE = math.inf
"""Span that stands for the whole bounds of weights."""
BEFORE = 5
"""Windows before a loss whose weights are compared with all others: 2 s."""
TUNED_NAMES = tuple(f"{matrix}_{state}" for matrix in "QS" for state in ("vx", "psi", "x", "y"))


@dataclass(frozen=True)
class Arm:
    """A way to switch weights.

    Parameters
    ----------
    mode
        `CONTROL`: the base weights throughout. `RANDOM`: Q and S are drawn anew in every window.
        `ADVERSARY`: of several draws, the one with the largest lateral error in the window.
    span
        Each weight of Q and S is drawn independently and log-uniformly between base / span and
        base * span; `WHOLE`: between the bounds of weights.
    slew
        Largest change of a weight's logarithm, 1/s.
    """

    mode: str
    span: float = 1.0
    slew: float = math.inf

    @property
    def label(self) -> str:
        """Name in results."""
        if self.mode == CONTROL:
            return self.mode
        span = "whole" if self.span == WHOLE else f"{self.span:g}"
        return f"{self.mode}, {span}, {'no limit' if self.slew == math.inf else 'slew limit'}"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values; None for no limit, and for the whole bounds."""
        span = None if self.span == WHOLE else self.span
        return {
            "mode": self.mode, "span": span, "slew": None if self.slew == math.inf else self.slew,
        }  # fmt: skip

    def draw(self, rng: np.random.Generator, count: int, base: Array) -> Array:
        """Draw sets of weights (count, 12) around the base (12,)."""
        sets = np.tile(base, (count, 1))
        if self.mode == CONTROL:
            return sets
        if self.span == WHOLE:
            low, high = np.full(TUNED, LOWEST), np.full(TUNED, HIGHEST)
        else:
            low = np.maximum(base[:TUNED] / self.span, LOWEST)
            high = np.minimum(base[:TUNED] * self.span, HIGHEST)
        sets[:, :TUNED] = np.exp(rng.uniform(np.log(low), np.log(high), (count, TUNED)))
        return sets


def arms_of(spans: tuple[float, ...]) -> list[Arm]:
    """Return the control and both ways to switch, over every span, with and without slew limit."""
    switched = [
        Arm(mode, span, slew)
        for span in spans
        for mode in (RANDOM, ADVERSARY)
        for slew in (SLEW, math.inf)
    ]
    return [Arm(CONTROL), *switched]


@dataclass(frozen=True)
class Setup:
    """Episodes to drive: on random paths, slow and fast in turn, each from a random place."""

    episodes: int = 2000
    conditions: str = "realtime"
    vehicle: str = "m2-minibus"
    paths: int = PATHS
    time_limit: float = TIME_LIMIT
    candidates: int = 4
    """Number of draws that the adversary chooses from."""
    seed: int = 0
    weights: TrackingWeights = field(default_factory=TrackingWeights)
    """Base weights."""
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("episodes", "paths", "candidates", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, not {self.seed}")

    @property
    def trajectories(self) -> list[str]:
        """Names of the paths."""
        return random_names(0, self.paths)

    @property
    def windows(self) -> int:
        """Number of windows in an episode that ends by its time limit."""
        return math.ceil(self.time_limit / WINDOW - 1e-9)


@dataclass
class Outcome:
    """Results of the episodes of an arm; arrays with an entry for each."""

    seeds: Array
    ends: Array
    largest: Array
    """Largest absolute lateral error, m."""
    lateral_square: Array
    steps: Array
    solves: Array
    failures: Array
    """Failed solves."""
    not_finite: Array
    """True if a number of the vehicle, its action or its weights was ever not finite."""
    used: Array
    """ln(Q, S in use / base) at the ends of windows, (episodes, windows, 8); NaN after an end."""
    statuses: Counter[str] = field(default_factory=Counter)
    """Failed solves by status, and the fallbacks that replaced them."""


class Branches:
    """A closed loop in which every episode has several branches, from window to window."""

    def __init__(self, setup: Setup, arm: Arm, episodes: int) -> None:
        self.arm, self.episodes = arm, episodes
        self.count = setup.candidates if arm.mode == ADVERSARY else 1
        n = episodes * self.count
        envs = PathTrackingVectorEnv(
            n, list(setup.trajectories), setup.vehicle, conditions=setup.conditions,
            random_start=True, time_limit=setup.time_limit, autoreset_mode="Disabled",
        )  # fmt: skip
        agent: Any = agents.make("lpv-nmpc", envs.single)
        self.loop = ClosedLoop(envs, agent, slew=arm.slew, threads=min(setup.threads, n))
        self.window = max(round(WINDOW / envs.single.control_period), 1)
        self.base = setup.weights.as_array()

    def drive(
        self, setup: Setup, first: int, rng: np.random.Generator, tick: Callable[[], None]
    ) -> Outcome:
        """Drive episodes of seeds first, first + 1, ...; `tick` is called after every window."""
        loop, n = self.loop, self.episodes
        seeds = np.arange(first, first + n)
        loop.reset(seed=np.repeat(seeds, self.count).tolist())
        sums = np.zeros((len(Tally._fields), n))
        largest, not_finite = np.zeros(n), np.zeros(n, dtype=np.bool_)
        used = np.full((n, setup.windows, TUNED), np.nan, dtype=np.float32)
        for window in range(setup.windows):
            running = loop.running[:: self.count]
            if not running.any():
                for _ in range(window, setup.windows):
                    tick()
                break
            tally = np.array(loop.drive(self.window, self.arm.draw(rng, n * self.count, self.base)))
            chosen = self._worst(Tally(*tally))
            sums += np.where(running, tally[:, chosen], 0.0)
            largest = np.fmax(largest, np.where(running, Tally(*tally).max_lateral[chosen], 0.0))
            nmpc = loop.memory.nmpc
            numbers = [loop.envs.records[chosen], nmpc.actions[chosen], nmpc.weights[chosen]]
            not_finite |= ~np.isfinite(np.concatenate(numbers, axis=1)).all(axis=1)
            used[running, window] = np.log(nmpc.weights[chosen, :TUNED] / self.base[:TUNED])[
                running
            ]
            self._follow(chosen, running)
            tick()
        total = Tally(*sums)
        statuses: Counter[str] = Counter()
        for row, fallback in loop.memory.nmpc.fallbacks.items():
            if row % self.count == 0:
                statuses.update(fallback.counts)
        return Outcome(
            seeds, loop.envs.arrays.ends[:: self.count].copy(), largest, total.lateral_square,
            total.steps, total.solves, total.failures, not_finite, used, statuses,
        )  # fmt: skip

    def _worst(self, tally: Tally) -> Array:
        """Return the row of each episode's branch with the worst window, (episodes,)."""
        harm = np.where(failed(self.loop.envs.arrays.ends), np.inf, tally.max_lateral)
        harm = np.nan_to_num(harm.reshape(self.episodes, self.count), nan=np.inf, posinf=np.inf)
        chosen: Array = np.arange(self.episodes) * self.count + harm.argmax(axis=1)
        return chosen

    def _follow(self, chosen: Array, running: Array) -> None:
        """Continue all branches of the running episodes from the chosen one."""
        if self.count == 1:
            return
        rows = np.flatnonzero(np.repeat(running, self.count))
        self.loop.copy(np.repeat(chosen, self.count)[rows], rows)


def drive_arm(setup: Setup, arm: Arm, tick: Callable[[], None]) -> Outcome:
    """Drive all episodes of an arm; arms differ in the weights alone."""
    parts: list[Outcome] = []
    branches: Branches | None = None
    for first in range(0, setup.episodes, BATCH):
        count = min(BATCH, setup.episodes - first)
        if branches is None or branches.episodes != count:
            branches = Branches(setup, arm, count)
        rng = np.random.default_rng([setup.seed, first])
        parts.append(branches.drive(setup, setup.seed * setup.episodes + first, rng, tick))
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in Outcome.__dataclass_fields__
        if name != "statuses"
    }
    return Outcome(**arrays, statuses=sum((part.statuses for part in parts), Counter()))


def summary(outcome: Outcome) -> dict[str, Any]:
    """Return the results of an arm in plain values."""
    lost = failed(outcome.ends)
    episodes, failures = len(lost), int(lost.sum())
    ends = Counter(k.END_NAMES[int(end)] for end in outcome.ends)
    kept = outcome.largest[~lost]
    return {
        "episodes": episodes,
        "lost": failures,
        "lost_seeds": outcome.seeds[lost].tolist(),
        "lost_upper_bound": rate_bound(failures, episodes),
        "ends": dict(ends),
        "not_finite": int(outcome.not_finite.sum()),
        "periods": int(outcome.steps.sum()),
        "solves": int(outcome.solves.sum()),
        "failed_solves": int(outcome.failures.sum()),
        "episodes_with_failed_solves": int((outcome.failures > 0).sum()),
        "failed_by_status": dict(outcome.statuses),
        "rms_lateral": math.sqrt(outcome.lateral_square.sum() / max(outcome.steps.sum(), 1.0)),
        "largest_lateral": float(outcome.largest.max()),
        "largest_lateral_not_lost": float(kept.max()) if kept.size else None,
        "largest_lateral_median": float(np.median(outcome.largest)),
        "largest_lateral_p99": float(np.quantile(outcome.largest, 0.99)),
        "weights_before_loss": weights_before_loss(outcome) if failures else None,
    }


def weights_before_loss(outcome: Outcome) -> Mapping[str, Any]:
    """Compare the weights in the last windows of lost episodes with those of all windows.

    For log10(weight / base), for its mean over the four weights on position and for differences:
    the mean before a loss, the mean and the standard deviation over all windows.
    """
    lost = failed(outcome.ends)
    decades = outcome.used / np.float32(math.log(10.0))
    driven = np.isfinite(decades[:, :, 0])
    left = driven[:, ::-1].cumsum(axis=1)[:, ::-1]
    before = driven & (left <= BEFORE) & lost[:, None]
    values = {name: decades[:, :, j] for j, name in enumerate(TUNED_NAMES)}
    values["Q_psi - Q_y"] = values["Q_psi"] - values["Q_y"]
    values["S_psi - S_y"] = values["S_psi"] - values["S_y"]
    values["position"] = decades[:, :, [2, 3, 6, 7]].mean(axis=2)
    values["Q_vx - position"] = values["Q_vx"] - values["position"]
    return {
        name: {
            "before_loss": float(value[before].mean()),
            "all": float(value[driven].mean()),
            "spread": float(value[driven].std()),
        }
        for name, value in values.items()
    }
