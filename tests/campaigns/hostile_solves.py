"""Observations of every absurd kind, for every shipped agent, alone and in batches.

Nothing may raise, every action must be finite and within its bounds, the good rows of a batch must
get bit for bit the action that they get among themselves, and after all of it a good drive must
work. Every other batch goes on with the memory of the one before.
"""

import time
import warnings
from collections import Counter
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
from lpv_track_env import PATH_TRACKING
from lpv_track_env.observation import (
    HEADING_ERROR,
    LONGITUDINAL_SPEED,
    PREVIEW_START,
    REFERENCE_SPEED,
)
from tests.campaigns import Counts, Say

Rows = NDArray[np.float64]

FAST, SLOW = (64, 4096), (5, 40)
"""Rows of a batch, and of all batches between two drives, by the speed of the agent."""
SECONDS = {"lpv-nmpc-ipopt": 25.0}
"""Longest time for a row, s; IPOPT's own limit is 20 s."""
USUAL_SECONDS = 2.0
IPOPT_SHARE = 500
"""Number of rows in all for each row that IPOPT gets."""
VALUES = {
    "1e154": (1e154, -1e154),
    "1e300": (1e300, -1e300),
    "largest float32": (3.4028235e38, -3.4028235e38),
    "largest float64": (1.7976931348623157e308, -1.7976931348623157e308),
    "NaN": (np.nan,),
    "infinity": (np.inf, -np.inf),
    "denormal": (5e-324, -5e-324, 1e-40, -1e-40),
    "zero": (0.0, -0.0),
    "large": (1e9, -1e9, 1e4, -1e4),
}
KINDS = (
    *VALUES, "reverse", "across", "sharp preview", "wild preview", "at the bounds", "random bits",
    "everything",
)  # fmt: skip


class Subject(NamedTuple):
    """An agent with settings, under conditions."""

    name: str
    settings: dict[str, Any]
    conditions: str
    share: float
    """Share of all rows."""

    def __str__(self) -> str:
        extra = "".join(f" {key}={value}" for key, value in self.settings.items())
        return f"{self.name}{extra} ({self.conditions})"


def subjects() -> list[Subject]:
    """List every shipped agent with its variants, without delays and with their compensation."""
    variants: list[tuple[str, dict[str, Any]]] = [(name, {}) for name in agents.names()]
    variants += [
        ("lpv-nmpc-tuned", {"weights": "paired"}),
        ("lpv-mpc-frozen", {"form": "sinc"}),
        ("lpv-nmpc", {"horizon": 10}),
    ]
    # Agents of microseconds get most of the rows.
    costs = {"lpv-nmpc": 1.0, "lpv-nmpc-tuned": 1.0, "ppo": 1.0, "sac": 1.0, "bc": 1.0,
             "lpv-nmpc-ipopt": 0.0, "lpv-mpc-frozen": 0.02}  # fmt: skip
    weights = [costs.get(name, 0.25) for name, _ in variants]
    total = 2.0 * sum(weights)
    return [
        Subject(name, settings, conditions, weight / total or 0.5 / IPOPT_SHARE)
        for (name, settings), weight in zip(variants, weights, strict=True)
        for conditions in ("simulation", "realtime")
    ]


def hostile(good: Rows, rng: np.random.Generator, seen: Counter[str]) -> Rows:
    """Make a row (size,) of one absurd kind of a good one."""
    row, kind = good.copy(), KINDS[rng.integers(len(KINDS))]
    seen[kind] += 1
    steps = (row.size - PREVIEW_START) // 2
    if kind in VALUES:
        places = rng.integers(row.size, size=rng.choice([1, 1, 2, 5, row.size]))
        row[places] = rng.choice(VALUES[kind], size=len(places))
    elif kind == "reverse":
        row[[LONGITUDINAL_SPEED, REFERENCE_SPEED]] = -rng.uniform(0.0, 50.0, 2)
    elif kind == "across":
        row[HEADING_ERROR] = rng.choice([-1.0, 1.0]) * rng.uniform(1.5, np.pi)
    elif kind == "sharp preview":
        row[PREVIEW_START : PREVIEW_START + steps] = rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(
            -1.0, 6.0
        )
    elif kind == "wild preview":
        row[PREVIEW_START:] = rng.normal(size=2 * steps) * 10.0 ** rng.uniform(-3.0, 12.0)
    elif kind == "at the bounds":
        row[:] = rng.choice([-1.0, 1.0], row.size) * 10.0 ** rng.uniform(0.0, 4.0)
    elif kind == "random bits":
        row[:] = rng.integers(2**63, size=row.size, dtype=np.uint64).view(np.float64)
    else:
        row[:] = rng.normal(size=row.size) * 10.0 ** rng.uniform(-320.0, 307.0, row.size)
    return row


def drive(env: Any, agent: Any, steps: int) -> tuple[Rows, str]:
    """Drive a good episode; return its observations (steps, size), and what was wrong, if so."""
    observation, _ = env.reset(seed=1)
    rows, memory, start = [], None, np.array([True])
    for _ in range(steps):
        rows.append(observation)
        action, memory = agent.predict(observation, memory, start)
        start = np.array([False])
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    far = abs(info["lateral_error"])
    return np.array(rows, dtype=np.float64), f"{far} m off the path" if not far < 1.0 else ""


class Batches:
    """Batches of rows for one subject."""

    def __init__(self, subject: Subject, seed: int) -> None:
        self.subject, self.seed = subject, seed
        self.env = gymnasium.make(PATH_TRACKING, trajectory="T2", conditions=subject.conditions)
        self.agent = agents.make(subject.name, self.env, **subject.settings)
        self.slow = subject.name in {"lpv-nmpc-ipopt", "lpv-mpc-frozen"}
        stanley = agents.make("stanley", self.env)
        self.good, wrong = drive(self.env, stanley, 120)
        assert not wrong, wrong
        space: Any = self.env.action_space
        self.low, self.high = space.low, space.high
        self.limit = SECONDS.get(subject.name, USUAL_SECONDS)
        self.memory: Any = None
        self.among: Any = None

    def run(self, number: int, n: int, seen: Counter[str]) -> str:
        """Try batch `number` with n hostile rows; return what was wrong, or ""."""
        rng = np.random.default_rng([self.seed, number])
        anew = number % 2 == 0
        start = rng.integers(len(self.good) - 3)
        friends = self.good[start : start + 2]
        rows = np.stack([hostile(self.good[rng.integers(len(self.good))], rng, seen)
                         for _ in range(n)])  # fmt: skip
        if number % 5 == 4:
            return self._one_by_one(rows)
        batch = np.concatenate([friends[:1], rows, friends[1:]])
        if anew or self.memory is None or len(self.memory) != len(batch):
            self.memory, self.among = None, None
        starts = np.full(len(batch), self.memory is None)
        began = time.perf_counter()
        actions, self.memory = self.agent.predict(batch, self.memory, starts)
        seconds = time.perf_counter() - began
        alone, self.among = self.agent.predict(friends, self.among, starts[:2])
        if not np.array_equal(alone, actions[[0, -1]]):
            return f"good rows got {actions[[0, -1]].tolist()}, alone {alone.tolist()}"
        if seconds > self.limit * len(batch):
            return f"{seconds:.1f} s for {len(batch)} rows"
        return self._wrong(actions)

    def _one_by_one(self, rows: Rows) -> str:
        memory = None
        for k, row in enumerate(rows):
            began = time.perf_counter()
            action, memory = self.agent.predict(row, memory, np.array([k == 0]))
            seconds = time.perf_counter() - began
            if seconds > self.limit:
                return f"{seconds:.1f} s for row {k} alone"
            if wrong := self._wrong(action[None]):
                return f"row {k} alone: {wrong}"
        return ""

    def _wrong(self, actions: Any) -> str:
        inside = (actions >= self.low) & (actions <= self.high)  # NaN is not
        if inside.all():
            return ""
        row = int(np.argmin(inside.all(axis=1)))
        return f"row {row}: action {actions[row].tolist()}"


def run(count: int, seed: int, say: Say) -> Counts:
    """Try `count` hostile rows in all, of which one in `IPOPT_SHARE` is for IPOPT."""
    faults: list[str] = []
    seen: Counter[str] = Counter()
    tried = 0
    for subject in subjects():
        rows = max(round(count * subject.share), 4)
        began, done, number = time.perf_counter(), 0, 0
        batches = Batches(subject, seed)
        size, between = SLOW if batches.slow else FAST
        while done < rows:
            n = min(size, rows - done)
            where = f"{subject} seed {seed} batch {number} of {n} rows"
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    wrong = batches.run(number, n, seen)
                    if done // between != (done + n) // between or done + n >= rows:
                        steps = 10 if batches.slow else 100
                        off = drive(batches.env, batches.agent, steps)[1]
                        wrong = wrong or (off and f"a good drive afterwards: {off}")
                        seen["drives"] += 1
            except Exception as error:  # noqa: BLE001  what this campaign looks for
                wrong = f"{type(error).__name__}: {error}"
                batches = Batches(subject, seed)
            if wrong:
                faults.append(f"{where}: {wrong}")
            done, number = done + n, number + 1
        tried += done
        say(f"{subject}: {done:,} rows, {time.perf_counter() - began:.1f} s, {len(faults)} broke")
    return Counts(tried, faults, dict(seen))
