"""Sections of the closed loop: many environments, each with its NMPC and its weights."""

import time
from collections.abc import Callable

import numpy as np

import agents
from agents.weight_tuning.closed_loop import ClosedLoop
from agents.weight_tuning.vector_env import WeightTuningVectorEnv
from experiments.speed import peers
from experiments.speed.measure import Effort, Section, Tick, calibrated, interleave
from lpv_track_env.vector_env import PathTrackingVectorEnv

Once = Callable[[], float]

PERIODS = 20
"""Control periods a call: a decision of a weight policy each second, say."""
SPREAD = 0.3
"""Standard deviation of the logarithms of every environment's own weights."""
ERRORS = (0.3, 0.05, 0.5)
"""m, rad, m/s: range of the errors that episodes start with."""


def loops(section: Section, effort: Effort, tick: Tick) -> None:
    """Compiled closed loops over the number of environments and threads."""
    section.notes.append(
        "Seconds per control period of one environment, NMPC and plant together: calls of "
        f"{PERIODS} periods on {' and '.join(effort.trajectories)}, every environment with "
        "its own weights, "
        "started anywhere on its path with some error. Resets stand outside the clock."
    )

    def make(n: int, threads: int) -> Once:
        run = Driving(closed_loop(effort.trajectories, n, threads))
        once = calibrated(run, effort.round_seconds)
        return lambda: once() / run.periods

    _over_threads(section, effort, tick, ("closed loop", "s/period"), make)


def tuning(section: Section, effort: Effort, tick: Tick) -> None:
    """Decisions on weights, of `WeightTuning-v0`."""
    section.notes.append(
        "Seconds per decision on the NMPC's weights in WeightTuningVectorEnv: step() with random "
        "actions, up to 8 control periods (0.4 s) of estimator, delay compensation, NMPC and plant "
        f"under `randomised`, on {' and '.join(effort.trajectories)}; episodes begin anew in "
        "the clock."
    )

    def make(n: int, threads: int) -> Once:
        envs = WeightTuningVectorEnv(
            n, list(effort.trajectories), conditions="randomised", random_start=True,
            autoreset_mode="SameStep", threads=threads,
        )  # fmt: skip
        envs.action_space.seed(0)
        run = peers.stepping(envs, np.stack([envs.action_space.sample() for _ in range(16)]))
        once = calibrated(run, effort.round_seconds)
        return lambda: once() / n

    _over_threads(section, effort, tick, ("WeightTuning-v0", "s/decision"), make)


def _over_threads(
    section: Section,
    effort: Effort,
    tick: Tick,
    series: tuple[str, str],
    make: Callable[[int, int], Once],
) -> None:
    """Rounds of what `make(n, threads)` gives, a series (name, unit) each."""
    name, unit = series
    for n in effort.batches:
        pairs = []
        for threads in effort.threads:
            if threads > n:
                continue
            tick(f"{name}: {n} environments, {threads} threads")
            pairs.append((section.add(name, unit, n=n, threads=threads), make(n, threads)))
        interleave(pairs, effort.rounds)
        for many, _ in pairs[1:]:
            section.compare(many, pairs[0][0])


def closed_loop(trajectories: tuple[str, ...], n: int, threads: int) -> ClosedLoop:
    """N environments with an NMPC each."""
    envs = PathTrackingVectorEnv(
        n, list(trajectories), autoreset_mode="Disabled", random_start=True,
        initial_error_range=ERRORS,
    )  # fmt: skip
    agent = agents.make("lpv-nmpc", envs.single)
    return ClosedLoop(envs, agent, threads=threads)  # type: ignore[arg-type]


class Driving:
    """Calls of `drive` on episodes that begin anew each time."""

    def __init__(self, loop: ClosedLoop) -> None:
        n = loop.envs.num_envs
        spread = np.random.default_rng(0).normal(0.0, SPREAD, (n, 10))
        self.loop, self.weights = loop, loop.agent.fixed_weights * np.exp(spread)
        self.periods = 1.0
        """Control periods that a call of the last round drove, all environments together."""

    def __call__(self, count: int) -> float:
        """Seconds of `count` calls."""
        seconds = driven = 0.0
        for k in range(count):
            self.loop.reset(seed=k * self.loop.envs.num_envs)
            began = time.perf_counter()
            tally = self.loop.drive(PERIODS, self.weights)
            seconds += time.perf_counter() - began
            driven += float(tally.steps.sum())
        self.periods = driven / count
        return seconds
