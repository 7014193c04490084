"""Sections of learned policies: what `predict` takes, and how fast they learn."""

import time
from dataclasses import replace
from typing import Any

import agents
from experiments.run.suites import LEARNED
from experiments.speed import peers, solvers
from experiments.speed.measure import PREDICT, Effort, Section, Tick

NMPC = "lpv-nmpc"


def policies(section: Section, effort: Effort, tick: Tick) -> None:
    """`predict` of each shipped policy on the observations that the solvers are given."""
    section.notes.append(
        "Seconds per predict(), all in, from Python, one thread, one vehicle, over windows of "
        f"{effort.window} control periods of a closed loop."
    )
    windows = []
    for trajectory in effort.trajectories:
        tick(f"policies: recording {trajectory}")
        windows += solvers.record(trajectory, solvers.HORIZON, effort.windows, effort.window)
    env = solvers.environment(effort.trajectories[0])
    made = {name: agents.make(name, env) for name in (*LEARNED, NMPC)}
    series = {name: section.add(name, PREDICT) for name in made}
    for agent in made.values():
        solvers.solve_times(agent, windows[0])
    for window in windows * effort.repeats:
        tick("policies in turn")
        for name, agent in made.items():
            series[name].rounds += solvers.solve_times(agent, window)[1:]


def training(section: Section, effort: Effort, tick: Tick) -> None:
    """PPO at the settings of `lpv-track train ppo --fast`, after its first segment."""
    section.notes.append(
        "Seconds per environment step of PPO.learn, collecting and updating, without validation; "
        "one thread."
    )
    try:
        peers.module("stable_baselines3")
        peers.module("torch")
    except peers.Unavailable as error:
        section.lacks("PPO", str(error))
        return
    from stable_baselines3.common.logger import Logger

    from experiments.training.environments import load_paths
    from experiments.training.loop import make_trainer
    from experiments.training.settings import FAST, usual

    settings = usual("ppo", **{**FAST, "paths": 4})
    segment = max(settings.envs * settings.hyperparameters["rollout"], 8 * effort.learning_steps)
    settings = replace(settings, steps=segment * (effort.learning_rounds + 1), segment=segment)
    tick("training: loading paths")
    trainer: Any = make_trainer(settings, load_paths(settings), Logger(None, []))
    series = section.add("PPO, --fast", "s/env-step of learning", n=settings.envs)
    trainer.segment(0, lambda *_: None)
    for number in range(1, settings.segments):
        tick(f"training: PPO, round {number} of {effort.learning_rounds}")
        began, before = time.perf_counter(), trainer.steps
        trainer.segment(number, lambda *_: None)
        series.rounds.append((time.perf_counter() - began) / (trainer.steps - before))
