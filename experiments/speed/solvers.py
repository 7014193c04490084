"""Sections of `predict`: NMPC solvers over horizon and batch, learned policies, worst case."""

import itertools
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
from agents.nmpc.problem import Status
from experiments.run.rollout import steps
from experiments.run.suites import LEARNED, PAPER_VEHICLES
from experiments.speed.measure import (
    COLD_START,
    PREDICT,
    WINDOW_MEDIAN,
    Effort,
    Run,
    Section,
    Series,
    Tick,
    Unavailable,
    calibrated,
    interleave,
)
from lpv_track_env import PATH_TRACKING
from lpv_track_env.observation import PREVIEW_START

NMPC = "lpv-nmpc"
DRIVER = "lpv-nmpc-ipopt"
"""Agent that drives the recorded loops, so that all solvers get the same observations."""
SOLVERS: dict[str, tuple[str, dict[str, Any]]] = {
    NMPC: (NMPC, {}),
    DRIVER: (DRIVER, {}),
    f"{DRIVER}, fatrop": (DRIVER, {"solver": "fatrop"}),
}
"""Agent name and settings by label; the first is compared with the others."""
START = {"lateral_error": 0.2, "heading_error": 0.03, "speed_error": -0.3}
"""Initial errors of a window, which the agent has to correct, m, rad, m/s."""
CONTROL_PERIOD, HORIZON = 0.05, 15
"""s, and the number of stages that the NMPC has by default then."""
SLOW_BATCH = 16
"""Largest batch for an agent that solves its rows one by one with IPOPT."""
TRIES = 3
"""Solves of each random observation; the fastest counts, the others were disturbed."""
RANGES = (
    (0.0, 30.0), (-3.0, 3.0), (-1.5, 1.5), (-9.0, 6.0), (-0.8, 0.8), (-5.0, 5.0), (-1.0, 1.0),
    (0.0, 30.0),
)  # fmt: skip
"""Range of each of `observation.SCALARS` in random observations: speeds to 30 m/s, errors to 5 m
and 1 rad, actuators beyond their bounds."""

Observations = NDArray[np.float32]


@dataclass(frozen=True)
class Window:
    """Observations (k, size) of consecutive control periods in a closed loop."""

    trajectory: str
    arc_length: float
    observations: Observations


def environment(trajectory: str) -> gymnasium.Env[Any, Any]:
    """Make the environment that the solvers are measured on."""
    return gymnasium.make(PATH_TRACKING, trajectory=trajectory, control_period=CONTROL_PERIOD)


def record(trajectory: str, windows: int, length: int) -> list[Window]:
    """Record windows of a closed loop from `windows` evenly spaced places on a trajectory."""
    env = environment(trajectory)
    driver = agents.make(DRIVER, env)
    path = env.unwrapped.path  # type: ignore[attr-defined]
    recorded = []
    for k in range(windows):
        arc_length = k / windows * path.length
        start = {**START, "arc_length": arc_length}
        driven = itertools.islice(steps(env, driver, seed=0, options=start), length)
        observations = [info["observation"] for _, info in driven]
        recorded.append(Window(trajectory, arc_length, np.stack(observations)))
    return recorded


def make(label: str, env: gymnasium.Env[Any, Any], **settings: Any) -> agents.base.Agent:
    """Make an agent of `SOLVERS`.

    Raises
    ------
    Unavailable
        If CasADi was built without its solver.
    """
    name, own = SOLVERS[label]
    try:
        return agents.make(name, env, **own, **settings)
    except ValueError as error:
        raise Unavailable(str(error).partition(";")[0]) from error


def solve_times(agent: agents.base.Agent, window: Window) -> list[float]:
    """Return the seconds of every `predict` over a window, the first without a warm start."""
    seconds = []
    starts = [np.array([True]), np.array([False])]
    for k, observation in enumerate(window.observations):
        start = starts[min(k, 1)]
        began = time.perf_counter()
        agent.predict(observation, episode_start=start)
        seconds.append(time.perf_counter() - began)
    return seconds


def solvers(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure every solver on recorded control periods."""
    section.notes.append(
        f"Seconds per predict(), all in, from Python, one thread, one vehicle; N {HORIZON}, a "
        f"control period of {CONTROL_PERIOD} s. Windows of {effort.window} consecutive control "
        f"periods of a closed loop on {' and '.join(effort.trajectories)}, each started 0.2 m off "
        "the path; the first solve of a window is a series of its own. A ratio is that of two "
        "medians over one window."
    )
    _over_windows(section, effort, tick, HORIZON, effort.windows)


def horizons(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure every solver over the number of stages N."""
    section.notes.append(
        "As above, on one window of each trajectory per number N of stages, which end with the "
        "same preview."
    )
    for horizon in effort.horizons:
        _over_windows(section, effort, tick, horizon, 1)


def _over_windows(section: Section, effort: Effort, tick: Tick, horizon: int, windows: int) -> None:
    """Measure every solver on every window in turn: each solve, and each window's median.

    A window's first solve has no warm start and is kept apart: there is one per episode.
    """
    recorded = _recorded(effort, tick, windows)
    env = environment(effort.trajectories[0])
    made = section.available(
        {label: partial(make, label, env, horizon=horizon) for label in SOLVERS}
    )
    series: dict[str, tuple[Series, Series, Series]] = {}
    for label, agent in made.items():
        warm, cold, median = (
            section.add(label, unit, horizon=horizon)
            for unit in (PREDICT, COLD_START, WINDOW_MEDIAN)
        )
        series[label] = warm, cold, median
        solve_times(agent, recorded[0])  # compiles, fills caches
    for window in recorded * effort.repeats:
        for label, agent in made.items():
            first, *others = solve_times(agent, window)
            tick(f"solvers in turn: {', '.join(made)}, horizon {horizon}")
            warm, cold, median = series[label]
            warm.rounds += others
            cold.rounds.append(first)
            median.rounds.append(float(np.median(others)))
    ours, *rest = made
    for other in rest:
        section.compare(series[ours][2], series[other][2])


def _recorded(effort: Effort, tick: Tick, windows: int) -> list[Window]:
    """Record `windows` windows on each trajectory."""
    recorded: list[Window] = []
    for trajectory in effort.trajectories:
        tick(f"recording {trajectory}")
        recorded += record(trajectory, windows, effort.window)
    return recorded


def policies(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure each shipped policy and the NMPC on the solvers' observations."""
    section.notes.append(
        "Seconds per predict(), all in, from Python, one thread, one vehicle, over windows of "
        f"{effort.window} control periods of a closed loop."
    )
    windows = _recorded(effort, tick, effort.windows)
    env = environment(effort.trajectories[0])
    made = {name: agents.make(name, env) for name in (*LEARNED, NMPC)}
    series = {name: section.add(name, PREDICT) for name in made}
    for agent in made.values():
        solve_times(agent, windows[0])
    for window in windows * effort.repeats:
        tick("policies in turn")
        for name, agent in made.items():
            series[name].rounds += solve_times(agent, window)[1:]


def batches(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure `predict` on many observations at once."""
    section.notes.append(
        "Seconds per solve: the time of one predict() on (n, size) observations, divided by n; "
        f"N {HORIZON}. Row i follows the recorded loop from a place of its own, with a warm start."
    )
    trajectory = effort.trajectories[0]
    env = environment(trajectory)
    tick(f"batches: recording {trajectory}")
    recorded = record(trajectory, effort.windows, effort.window)
    stream = np.concatenate([window.observations for window in recorded])
    factories = {
        (NMPC, 1): partial(make, NMPC, env),
        (NMPC, 2): partial(make, NMPC, env, threads=2),
        (DRIVER, 1): partial(make, DRIVER, env),
    }
    for n in effort.batches:
        pairs = []
        for (label, threads), factory in factories.items():
            if label == DRIVER and n > SLOW_BATCH:
                continue
            name = f"{label}, {threads} threads" if threads > 1 else label
            agent = section.available({name: factory}).get(name)
            if agent is None:
                continue
            tick(f"batches: {n} rows, {name}")
            series = section.add(label, "s/solve", n=n, threads=threads)
            run = batch_run(agent, stream, n)
            pairs.append((series, calibrated(run, effort.round_seconds, n)))
        interleave(pairs, effort.rounds)
        for series, _ in pairs[1:]:
            section.compare(pairs[0][0], series)


def batch_run(agent: agents.base.Agent, stream: Observations, n: int) -> Run:
    """Time `predict` on n rows, each of which moves on by one observation from call to call."""
    places = np.linspace(0, len(stream), n, endpoint=False).astype(int)
    agent.predict(stream[places], episode_start=np.ones(n, dtype=bool))
    calls = 0

    def run(count: int) -> float:
        nonlocal calls
        rows = [stream[(places + calls + k + 1) % len(stream)] for k in range(count)]
        calls += count
        began = time.perf_counter()
        for observations in rows:
            agent.predict(observations)
        return time.perf_counter() - began

    return run


def wild(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure the real-time NMPC on random observations, one by one, without a warm start."""
    section.notes.append(
        f"Seconds per predict() on {effort.wild} observations per vehicle: speeds to 30 m/s, "
        f"errors to 5 m and 1 rad, any curvature. The fastest of {TRIES} tries each, without a "
        "warm start; observations that are not finite need no solve and are left out."
    )
    begin = np.array([True])
    for vehicle in PAPER_VEHICLES:
        env: gymnasium.Env[Any, Any] = gymnasium.make(PATH_TRACKING, vehicle=vehicle)
        agent: Any = agents.make(NMPC, env)
        preview_steps = agent.task.layout.preview_steps
        rows = wild_observations(np.random.default_rng(0), effort.wild, preview_steps)
        agent.predict(rows[0], episode_start=begin)
        series = section.add(NMPC, PREDICT, vehicle=vehicle)
        statuses: Counter[str] = Counter()
        for k, row in enumerate(rows):
            if k % 100 == 0:
                tick(f"wild observations: {vehicle}")
            if not np.isfinite(row).all():
                continue
            best = np.inf
            for _ in range(TRIES):
                began = time.perf_counter()
                _, memory = agent.predict(row, episode_start=begin)
                best = min(best, time.perf_counter() - began)
            series.rounds.append(best)
            statuses[agent.diagnostics(memory[0])["status"]] += 1
        section.notes.append(f"{vehicle}: {_outcome(statuses, series.rounds)}")


def _outcome(statuses: Mapping[str, int], seconds: Sequence[float]) -> str:
    """Return the numbers of solves and of failures, and the ratio of the slowest to the median."""
    failed = [f"{n} {status}" for status, n in statuses.items() if status != Status.SUCCESS.value]
    return (
        f"{sum(statuses.values())} solves, {', '.join(failed) or 'none failed'}; the slowest took "
        f"{max(seconds) / np.median(seconds):.1f} times the median."
    )


def wild_observations(rng: np.random.Generator, count: int, steps: int) -> Observations:
    """Return random observations (count, size), a twentieth of which are not finite."""
    first = PREVIEW_START
    rows = np.empty((count, first + 2 * steps))
    for k, bounds in enumerate(RANGES):
        rows[:, k] = rng.uniform(*bounds, count)
    # Half of the paths have one curvature, half a random one per node; a tenth exceed any path's.
    curvature = rng.uniform(-0.5, 0.5, (count, 1)) * np.ones(steps)
    jumping = rng.random(count) < 0.5
    curvature[jumping] = rng.uniform(-0.5, 0.5, (int(jumping.sum()), steps))
    curvature[rng.random(count) < 0.1] *= 10.0
    rows[:, first : first + steps] = curvature
    ramp = rng.uniform(-3.0, 3.0, (count, 1)) * 0.05 * np.arange(1, steps + 1)
    rows[:, first + steps :] = np.clip(rows[:, 7:8] + ramp, 0.0, 30.0)
    broken = np.flatnonzero(rng.random(count) < 0.05)
    rows[broken, rng.integers(0, rows.shape[1], len(broken))] = rng.choice(
        [np.nan, np.inf, -np.inf], len(broken)
    )
    return rows.astype(np.float32)
