"""Section of learning: what share of a learner's time the environments take."""

import time
from typing import Any

import gymnasium

import agents
from experiments.speed import environments, peers
from experiments.speed.measure import Effort, Section, Tick
from lpv_track_env.registration import PATH_TRACKING

ENVS = 8
ROLLOUT = 256
"""Steps per environment between two updates of PPO; 10 epochs in batches of 64, as by default."""


def learning(section: Section, effort: Effort, tick: Tick) -> None:
    """Share of wall time that stepping takes under Stable-Baselines3's PPO with 8 environments."""
    section.notes.append(
        f"Share of the wall time of PPO.learn ({ENVS} environments, default network and batches, "
        f"one thread, CPU, {ROLLOUT} steps per environment and update) within the VecEnv's step."
    )
    kinds = peers.available(
        {environments.OURS: _ours, "DummyVecEnv of single ones": _in_sequence}, section.lacks
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


def _ours() -> Any:
    from gymnasium.vector import AutoresetMode

    peers.module("stable_baselines3")
    return agents.sb3_vec_env(
        environments.make_vector(ENVS, autoreset_mode=AutoresetMode.SAME_STEP)
    )


def _in_sequence() -> Any:
    vec_env = peers.module("stable_baselines3.common.vec_env")
    trajectory = environments.TRAJECTORY
    return vec_env.DummyVecEnv(
        [lambda: gymnasium.make(PATH_TRACKING, trajectory=trajectory) for _ in range(ENVS)]
    )


def _learn(env: Any, steps: int) -> tuple[float, float]:
    """Share of the wall time of `learn` spent within the VecEnv, and seconds per env-step."""
    peers.module("torch").set_num_threads(1)
    ppo = peers.module("stable_baselines3").PPO
    timed = _timed(env)
    rollout = min(ROLLOUT, max(steps // ENVS, 2))
    model = ppo("MlpPolicy", timed, n_steps=rollout, device="cpu", seed=0)
    began = time.perf_counter()
    model.learn(total_timesteps=steps)
    wall = time.perf_counter() - began
    return timed.seconds / wall, wall / max(model.num_timesteps, 1)


def _timed(env: Any) -> Any:
    """The VecEnv with a clock around its steps."""
    wrapper = peers.module("stable_baselines3.common.vec_env").VecEnvWrapper

    class Timed(wrapper):  # type: ignore[misc, valid-type]
        seconds = 0.0

        def reset(self) -> Any:
            return self.venv.reset()

        def step_async(self, actions: Any) -> None:
            began = time.perf_counter()
            self.venv.step_async(actions)
            self.seconds += time.perf_counter() - began

        def step_wait(self) -> Any:
            began = time.perf_counter()
            result = self.venv.step_wait()
            self.seconds += time.perf_counter() - began
            return result

    return Timed(env)
