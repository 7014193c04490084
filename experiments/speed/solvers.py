"""Sections of the solvers: what `predict` takes, over the horizon and over the batch."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
from experiments.speed import peers
from experiments.speed.measure import (
    COLD_START,
    PREDICT,
    WINDOW_MEDIAN,
    Effort,
    Run,
    Section,
    Series,
    Tick,
    calibrated,
    interleave,
)
from lpv_track_env.registration import PATH_TRACKING

DRIVER = "lpv-nmpc-ipopt"
"""Drives the recorded loops, so that every solver and every version gets the same observations."""
SOLVERS: dict[str, tuple[str, dict[str, Any]]] = {
    "lpv-nmpc": ("lpv-nmpc", {}),
    "lpv-nmpc-ipopt": ("lpv-nmpc-ipopt", {}),
    "lpv-nmpc-ipopt, fatrop": ("lpv-nmpc-ipopt", {"solver": "fatrop"}),
}
"""Label -> name and settings of an agent; the first is compared with the others."""
START = {"lateral_error": 0.2, "heading_error": 0.03, "speed_error": -0.3}
"""m, rad, m/s: where a window begins, so that there is something to correct."""
CONTROL_PERIOD, HORIZON = 0.05, 20
SLOW_BATCH = 16
"""Largest batch given to a solver that is not made for batches."""

Observations = NDArray[np.float32]


@dataclass(frozen=True)
class Window:
    """Observations (k, size) of control periods in a row, seen by a closed loop."""

    trajectory: str
    arc_length: float
    observations: Observations


def environment(trajectory: str, horizon: int = HORIZON) -> gymnasium.Env[Any, Any]:
    """The environment that the solvers are measured on."""
    return gymnasium.make(
        PATH_TRACKING,
        trajectory=trajectory,
        control_period=CONTROL_PERIOD,
        preview_steps=horizon,
    )


def record(trajectory: str, horizon: int, windows: int, length: int) -> list[Window]:
    """Windows of a closed loop at `windows` places evenly along a trajectory."""
    env = environment(trajectory, horizon)
    driver = agents.make(DRIVER, env)
    path = env.unwrapped.path  # type: ignore[attr-defined]
    recorded = []
    for k in range(windows):
        arc_length = k / windows * path.length
        observation, _ = env.reset(seed=0, options={**START, "arc_length": arc_length})
        seen: list[Observations] = []
        for step in range(length):
            seen.append(observation)
            action, _ = driver.predict(observation, episode_start=np.array([step == 0]))
            observation, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                break
        recorded.append(Window(trajectory, arc_length, np.stack(seen)))
    return recorded


def make(label: str, env: gymnasium.Env[Any, Any], **settings: Any) -> agents.base.Agent:
    """An agent of `SOLVERS`.

    Raises
    ------
    Unavailable
        Where this version has none such.
    """
    name, own = SOLVERS[label]
    try:
        return agents.make(name, env, **own, **settings)
    except ValueError as error:
        raise peers.Unavailable(str(error).partition(";")[0]) from error


def solve_times(agent: agents.base.Agent, window: Window) -> list[float]:
    """Seconds of every `predict` over a window of at least two, whose first one starts cold."""
    seconds = []
    starts = [np.array([True]), np.array([False])]
    for k, observation in enumerate(window.observations):
        start = starts[min(k, 1)]
        began = time.perf_counter()
        agent.predict(observation, episode_start=start)
        seconds.append(time.perf_counter() - began)
    return seconds


def _measure(
    section: Section,
    windows: Sequence[Window],
    solvers: dict[str, agents.base.Agent],
    repeats: int,
    tick: Tick,
    **settings: Any,
) -> None:
    """Every solver on every window in turn: its solves, and the median of each window's.

    A window's first solve has nothing to start from and is kept apart: there is one in an episode.
    """
    told = ", ".join([*solvers, *(f"{key} {value}" for key, value in settings.items())])
    series: dict[str, tuple[Series, Series, Series]] = {}
    for label, agent in solvers.items():
        series[label] = (
            section.add(label, PREDICT, **settings),
            section.add(label, COLD_START, **settings),
            section.add(label, WINDOW_MEDIAN, **settings),
        )
        solve_times(agent, windows[0])  # compiles, fills caches
    for window in list(windows) * repeats:
        for label, agent in solvers.items():
            first, *others = solve_times(agent, window)
            tick(f"solvers in turn: {told}")
            warm, cold, medians = series[label]
            warm.rounds += others
            cold.rounds.append(first)
            medians.rounds.append(float(np.median(others)))
    labels = list(solvers)
    for other in labels[1:]:
        section.compare(series[labels[0]][2], series[other][2])


def solvers(section: Section, effort: Effort, tick: Tick) -> None:
    """`predict` of each solver on the same recorded observations."""
    section.notes.append(
        f"Seconds per predict(), all in, from Python, one thread, one vehicle; N {HORIZON}, Ts "
        f"{CONTROL_PERIOD} s. Windows of {effort.window} control periods in a row of a closed loop "
        f"on {' and '.join(effort.trajectories)}, each begun 0.2 m beside the path; the first "
        "solve of each is counted apart. A ratio is that of two medians over one window."
    )
    windows = []
    for trajectory in effort.trajectories:
        tick(f"solvers: recording {trajectory}")
        windows += record(trajectory, HORIZON, effort.windows, effort.window)
    env = environment(effort.trajectories[0])
    made = peers.available({label: partial(make, label, env) for label in SOLVERS}, section.lacks)
    _measure(section, windows, made, effort.repeats, tick, horizon=HORIZON)


def horizons(section: Section, effort: Effort, tick: Tick) -> None:
    """`predict` of each solver over the horizon N."""
    section.notes.append("As above, on one window of each trajectory per horizon of N periods.")
    for horizon in effort.horizons:
        tick(f"solvers: N {horizon}")
        windows: list[Window] = []
        for trajectory in effort.trajectories:
            windows += record(trajectory, horizon, 1, effort.window)
        env = environment(effort.trajectories[0], horizon)
        made = peers.available(
            {label: partial(make, label, env) for label in SOLVERS}, section.lacks
        )
        _measure(section, windows, made, effort.repeats, tick, horizon=horizon)


def batches(section: Section, effort: Effort, tick: Tick) -> None:
    """`predict` on many observations at once."""
    section.notes.append(
        f"Seconds per solve: of one predict() on (n, size) observations, divided by n; N {HORIZON}."
        " Row i follows the recorded loop from its own place, so each has its warm start."
    )
    trajectory = effort.trajectories[0]
    env = environment(trajectory)
    tick(f"batches: recording {trajectory}")
    recorded = record(trajectory, HORIZON, effort.windows, effort.window)
    stream = np.concatenate([window.observations for window in recorded])
    factories = {
        ("lpv-nmpc", 1): partial(make, "lpv-nmpc", env),
        ("lpv-nmpc", 2): partial(make, "lpv-nmpc", env, threads=2),
        (DRIVER, 1): partial(make, DRIVER, env),
    }
    for n in effort.batches:
        pairs = []
        for (label, threads), factory in factories.items():
            if label == DRIVER and n > SLOW_BATCH:
                continue
            name = f"{label}, {threads} threads" if threads > 1 else label
            agent = peers.available({name: factory}, section.lacks).get(name)
            if agent is None:
                continue
            tick(f"batches: {n} rows, {name}")
            series = section.add(label, "s/solve", n=n, threads=threads)
            once = calibrated(_batch_run(agent, stream, n), effort.round_seconds)
            pairs.append((series, lambda once=once: once() / n))  # noqa: B023
        interleave(pairs, effort.rounds)
        for series, _ in pairs[1:]:
            section.compare(pairs[0][0], series)


def _batch_run(agent: agents.base.Agent, stream: Observations, n: int) -> Run:
    """Calls of `predict` on n rows, each a place further in the stream from call to call."""
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
