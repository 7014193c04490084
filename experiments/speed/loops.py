"""Sections of many environments with agents: compiled closed loops, and learning over them."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np

import agents
from agents.weight_tuning.closed_loop import ClosedLoop
from agents.weight_tuning.env import WeightTuningVectorEnv
from agents.weights import WEIGHTS
from experiments.speed import environments
from experiments.speed.measure import (
    Effort,
    Round,
    Section,
    Tick,
    Unavailable,
    calibrated,
    interleave,
    module,
)
from lpv_track_env import PATH_TRACKING
from lpv_track_env.vector_env import PathTrackingVectorEnv

PERIODS = 20
"""Control periods per call, e.g. for a weight policy that decides once a second."""
SPREAD = 0.3
"""Standard deviation of the logarithms of each environment's weights."""
ERRORS = (0.3, 0.05, 0.5)
"""Half ranges of the initial errors of episodes, m, rad, m/s."""
ENVS = 8
ROLLOUT = 256
"""Steps per environment between two updates of PPO, 10 epochs in batches of 64 each (defaults)."""


def loops(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure compiled closed loops over the numbers of environments and threads."""
    section.notes.append(
        "Seconds per control period of one environment, NMPC and plant together: calls of "
        f"{PERIODS} periods on {' and '.join(effort.trajectories)}, every environment with weights "
        "of its own, started anywhere on its path with random errors. Resets are not timed."
    )

    def make(n: int, threads: int) -> Round:
        run = Driving(closed_loop(effort.trajectories, n, threads))
        seconds_per_call = calibrated(run, effort.round_seconds)
        return lambda: seconds_per_call() / run.periods

    _over_threads(section, effort, tick, ("closed loop", "s/period"), make)


def tuning(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure decisions on the NMPC's weights in `WeightTuning-v0`."""
    section.notes.append(
        "Seconds per decision on the NMPC's weights in WeightTuningVectorEnv: step() with random "
        "actions, up to 8 control periods (0.4 s) of estimator, delay compensation, NMPC and plant "
        f"under `randomised`, on {' and '.join(effort.trajectories)}; automatic resets are timed."
    )

    def make(n: int, threads: int) -> Round:
        envs = WeightTuningVectorEnv(
            n, list(effort.trajectories), conditions="randomised", random_start=True,
            autoreset_mode="SameStep", threads=threads,
        )  # fmt: skip
        envs.action_space.seed(0)
        actions = np.stack([envs.action_space.sample() for _ in range(16)])
        return calibrated(environments.stepping(envs, actions), effort.round_seconds, n)

    _over_threads(section, effort, tick, ("WeightTuning-v0", "s/decision"), make)


def _over_threads(
    section: Section,
    effort: Effort,
    tick: Tick,
    series: tuple[str, str],
    make: Callable[[int, int], Round],
) -> None:
    """Measure the rounds of `make(n, threads)`, in a series (name, unit) each."""
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
    """Make n environments with an NMPC each."""
    envs = PathTrackingVectorEnv(
        n, list(trajectories), autoreset_mode="Disabled", random_start=True,
        initial_error_range=ERRORS,
    )  # fmt: skip
    agent = agents.make("lpv-nmpc", envs.single)
    return ClosedLoop(envs, agent, threads=threads)  # type: ignore[arg-type]


class Driving:
    """Time calls of `drive`, each on new episodes."""

    def __init__(self, loop: ClosedLoop) -> None:
        n = loop.envs.num_envs
        spread = np.random.default_rng(0).normal(0.0, SPREAD, (n, WEIGHTS))
        self.loop, self.weights = loop, loop.agent.fixed_weights * np.exp(spread)
        self.periods = 1.0
        """Control periods driven per call in the last round, summed over the environments."""

    def __call__(self, count: int) -> float:
        """Return the seconds of `count` calls."""
        seconds = driven = 0.0
        for k in range(count):
            self.loop.reset(seed=k * self.loop.envs.num_envs)
            began = time.perf_counter()
            tally = self.loop.drive(PERIODS, self.weights)
            seconds += time.perf_counter() - began
            driven += float(tally.steps.sum())
        self.periods = driven / count
        return seconds


def learning(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure the share of wall time that stepping takes in Stable-Baselines3's PPO."""
    section.notes.append(
        f"Share of the wall time of PPO.learn ({ENVS} environments, default network and batches, "
        f"one thread, CPU, {ROLLOUT} steps per environment and update) within the VecEnv's step."
    )
    kinds = section.available(
        {environments.OURS: _compiled_vec_env, "DummyVecEnv of single ones": _dummy_vec_env}
    )
    shares, rates = {}, {}
    for name in kinds:
        shares[name] = section.add(name, "share of wall time", n=ENVS)
        rates[name] = section.add(name, "s/env-step of learning", n=ENVS)
    for k in range(effort.learning_rounds):
        for name, env in kinds.items():
            tick(f"PPO over {name}, round {k + 1} of {effort.learning_rounds}")
            share, seconds = _learn(env, effort.learning_steps)
            shares[name].rounds.append(share)
            rates[name].rounds.append(seconds)
    if len(kinds) > 1:
        ours, other = kinds
        section.compare(shares[ours], shares[other])
        section.compare(rates[ours], rates[other])


def _compiled_vec_env() -> Any:
    module("stable_baselines3")
    return agents.sb3_vec_env(environments.make_vector(ENVS, autoreset_mode="SameStep"))


def _dummy_vec_env() -> Any:
    vec_env = module("stable_baselines3.common.vec_env")
    make = partial(gymnasium.make, PATH_TRACKING, trajectory=environments.TRAJECTORY)
    return vec_env.DummyVecEnv([make] * ENVS)


def _learn(env: Any, steps: int) -> tuple[float, float]:
    """Return the VecEnv's share of the wall time of `learn`, and the seconds per env-step."""
    module("torch").set_num_threads(1)
    ppo = module("stable_baselines3").PPO
    rollout = min(ROLLOUT, max(steps // ENVS, 2))
    model = ppo("MlpPolicy", env, n_steps=rollout, device="cpu", seed=0)
    step, stepping = env.step, 0.0

    def timed_step(actions: Any) -> Any:
        nonlocal stepping
        began = time.perf_counter()
        result = step(actions)
        stepping += time.perf_counter() - began
        return result

    env.step = timed_step
    began = time.perf_counter()
    model.learn(total_timesteps=steps)
    wall = time.perf_counter() - began
    env.step = step
    return stepping / wall, wall / max(model.num_timesteps, 1)


def training(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure PPO at the settings of `lpv-track train ppo --fast`, after its first segment."""
    section.notes.append(
        "Seconds per environment step of PPO.learn, collecting and updating, without validation; "
        "one thread."
    )
    try:
        module("stable_baselines3")
        module("torch")
    except Unavailable as error:
        section.leave_out("PPO", str(error))
        return
    from stable_baselines3.common.logger import Logger

    from experiments.jobs.job import load_paths
    from experiments.training.loop import make_trainer
    from experiments.training.settings import FAST, usual
    from experiments.training.trainer import path_names

    settings = usual("ppo", **{**FAST, "paths": 4})
    segment = max(settings.envs * settings.hyperparameters["rollout"], 8 * effort.learning_steps)
    settings = replace(settings, steps=segment * (effort.learning_rounds + 1), segment=segment)
    tick("training: loading paths")
    trainer: Any = make_trainer(settings, load_paths(path_names(settings)), Logger(None, []))
    series = section.add("PPO, --fast", "s/env-step of learning", n=settings.envs)
    trainer.segment(0, lambda *_: None)
    for number in range(1, settings.segments):
        tick(f"training: PPO, round {number} of {effort.learning_rounds}")
        began, before = time.perf_counter(), trainer.steps
        trainer.segment(number, lambda *_: None)
        series.rounds.append((time.perf_counter() - began) / (trainer.steps - before))
