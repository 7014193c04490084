"""Rollouts: an agent drives an environment for an episode, which is recorded as a trace."""

import math
import time
import warnings
from collections.abc import Callable, Generator
from dataclasses import dataclass, fields
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from agents import Agent
from agents.base import DrivingTask, blind_control
from experiments.run.time_limit import check_time
from lpv_track_env.bicycle import STATE_SIZE
from lpv_track_env.validation import two_numbers
from trajectories import ReferencePath

Array = NDArray[np.float64]

NOT_FINITE = "not finite"
"""Name, among the fallbacks, of the controlled stop in place of an action that is not finite."""


@dataclass(frozen=True)
class Trace:
    """Record of an episode at its start (index 0) and at the ends of n periods: arrays (n + 1,).

    `state` is (n + 1, 6): vx, vy, psi, r, X, Y; `estimate` is the estimate that the observation is
    made from, under ideal conditions the state itself. `acceleration` and `steering_angle` are the
    actuators' values at the end of the period (under ideal conditions, throughout it). `solve_time`
    (s) is the duration of the agent's `predict` call in that period, 0 at the start. `stopping`
    marks periods in which the vehicle braked by itself, `deadline_misses` counts computations that
    came too late. `friction` is that of tyres and road where the vehicle is; it is 0 where
    tyres are linear, since files of traces hold finite numbers alone.
    """

    time: Array
    state: Array
    estimate: Array
    arc_length: Array
    lateral_error: Array
    heading_error: Array
    reference_speed: Array
    acceleration: Array
    steering_angle: Array
    solve_time: Array
    reward: Array
    clipped: Array
    stopping: Array
    deadline_misses: Array
    friction: Array

    def as_dict(self) -> dict[str, Array]:
        """Return the arrays by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True)
class Rollout:
    """A finished episode."""

    trace: Trace
    end: str
    path: ReferencePath
    control_period: float
    statuses: dict[str, int]
    """Solves by status, empty for agents that solve nothing."""
    fallbacks: dict[str, int]
    """Number of steps in which a fallback replaced a failed solve, by its name; `NOT_FINITE` counts
    controlled stops in place of actions."""
    solver_seconds: Array
    """Time inside the solver, (n,) s; empty for agents that solve nothing."""
    iterations: Array
    slack: Array
    """Largest slack on (vx, vy, vx') over all plans, (3,)."""


def rollout(
    env: gymnasium.Env[Any, Any],
    agent: Agent,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    on_step: Callable[[int, dict[str, Any]], None] | None = None,
    computing_time: Callable[[int, float], tuple[float, float]] | None = None,
) -> Rollout:
    """Drive one episode from reset to its end.

    `on_step(k, info)` is called after each step, with the agent's diagnostics under "agent"; for
    the rest see `steps`.
    """
    driving = steps(env, agent, seed, options, computing_time)
    while True:
        try:
            k, info = next(driving)
        except StopIteration as end:
            done: Rollout = end.value
            return done
        if on_step is not None:
            on_step(k, info)


def steps(
    env: gymnasium.Env[Any, Any],
    agent: Agent,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    computing_time: Callable[[int, float], tuple[float, float]] | None = None,
) -> Generator[tuple[int, dict[str, Any]], None, Rollout]:
    """Drive one episode step by step, so that a caller can drive several side by side.

    Yields each step's number, from 1, and its info, with the agent's diagnostics under "agent" and
    the observation before the step under "observation". `computing_time(k, seconds)` receives the
    duration of the agent's call and returns the times (s, s) until the action of step k takes
    effect and until the next may be computed, see `PathTrackingEnv.set_computing_time`. While the
    agent is busy with an earlier action it computes no new one; its `solve_time` is 0 there. A
    controlled stop replaces an action that is not finite; a warning says how many there were.
    """
    observation, info = env.reset(seed=seed, options=options)
    inner: Any = env.unwrapped
    period = inner.control_period
    rows: list[list[float]] = []
    states: list[Array] = []
    estimates: list[Array] = []

    def note(info: dict[str, Any], seconds: float, reward: float) -> None:
        acceleration, steering_angle = inner.actuators
        states.append(info["state"])
        estimates.append(info.get("estimate", info["state"]))
        rows.append(
            [
                info["arc_length"],
                info["lateral_error"],
                info["heading_error"],
                float(info["state"][0] - info["speed_error"]),
                acceleration,
                steering_angle,
                seconds,
                reward,
                float(info["clipped"]),
                float(info.get("stopping", False)),
                float(info.get("deadline_misses", 0)),
                _road_friction(inner),
            ]
        )

    note(info, 0.0, 0.0)
    memory: Any = None
    start = np.array([True])
    statuses: dict[str, int] = {}
    fallbacks: dict[str, int] = {}
    solver_seconds: list[float] = []
    iterations: list[int] = []
    slack = np.zeros(3)
    explain, hold = getattr(agent, "diagnostics", None), getattr(agent, "hold", None)
    driver = _Driver(env, agent)
    done = False
    while not done:
        computed = not inner.controller_busy
        seconds = 0.0
        if computed:
            action, memory, seconds = driver.predict(observation, memory, start)
        elif hold is not None:
            hold(memory)
        start = np.array([False])
        if computing_time is not None and computed:
            inner.set_computing_time(*computing_time(len(rows) - 1, seconds))
        before = observation
        observation, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        note(info, seconds, float(reward))
        solve = explain(memory[0]) if explain is not None and computed else {}
        if solve:
            statuses[solve["status"]] = statuses.get(solve["status"], 0) + 1
            if solve["fallback"]:
                fallbacks[solve["fallback"]] = fallbacks.get(solve["fallback"], 0) + 1
            solver_seconds.append(solve["seconds"])
            iterations.append(solve["iterations"])
            if solve["slack"] is not None:
                slack = np.maximum(slack, solve["slack"])
        yield len(rows) - 1, {**info, "agent": solve, "observation": before}
    driver.tell(fallbacks, len(rows) - 1)
    table = np.array(rows).T
    trace = Trace(
        period * np.arange(len(rows)),
        np.array(states).reshape(-1, STATE_SIZE),
        np.array(estimates).reshape(-1, STATE_SIZE),
        *table,
    )
    return Rollout(
        trace=trace,
        end=str(info["end"]),
        path=inner.path,
        control_period=period,
        statuses=statuses,
        fallbacks=fallbacks,
        solver_seconds=np.array(solver_seconds),
        iterations=np.array(iterations, dtype=float),
        slack=slack,
    )


def _road_friction(env: Any) -> float:
    """Return the friction where an environment's vehicle is, as traces hold it."""
    friction: float = getattr(env, "road_friction", math.inf)
    return friction if friction < math.inf else 0.0


class _Driver:
    """An agent's calls, timed; controlled stops replace actions that are not finite.

    A `TrackingAgent` makes and counts these stops itself.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], agent: Agent) -> None:
        self._env, self._agent = env, agent
        self._count = -self._by_agent

    @property
    def _by_agent(self) -> int:
        count: int = getattr(self._agent, "replaced_actions", 0)
        return count

    def predict(self, observation: Any, memory: Any, start: Any) -> tuple[Any, Any, float]:
        """Return an action, the agent's memory, and the time that its call took, s."""
        began = time.perf_counter()
        action, memory = self._agent.predict(observation, memory, episode_start=start)
        seconds = time.perf_counter() - began
        check_time()
        if not all(map(math.isfinite, two_numbers(action))):
            self._count += 1
            task = DrivingTask.of(self._env)
            seen = task.layout.unpack(task.layout.tracking_part(observation))
            action = np.array(blind_control(task.vehicle, seen), dtype=np.float32)
        return action, memory, seconds

    def tell(self, fallbacks: dict[str, int], steps: int) -> None:
        """Add the number of stops to the fallbacks, and warn of them, if there are any."""
        stops = self._count + self._by_agent
        if stops == 0:
            return
        fallbacks[NOT_FINITE] = stops
        warnings.warn(
            f"{stops} of {steps} actions were not finite, controlled stops replaced them",
            UserWarning,
            stacklevel=3,
        )
