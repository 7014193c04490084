"""Environments to compare with, made where their packages are installed.

Every function raises `Unavailable` with one line for the user where it cannot.
"""

import importlib
import time
import warnings
from collections.abc import Callable
from itertools import cycle, islice
from typing import Any

import gymnasium
import numpy as np

from experiments.speed.measure import Run

INSTALL = {
    "highway_env": "pip install 'lpv-track-env[highway]'",
    "stable_baselines3": "pip install 'lpv-track-env[rl]'",
    "torch": "pip install 'lpv-track-env[rl]'",
    "gymnax": "pip install gymnax",
    "jax": "pip install gymnax",
    "envpool": "pip install envpool",
}
"""Optional packages by module, and what installs them."""
LANE_KEEPING = {"simulation_frequency": 200, "policy_frequency": 20}
"""Hz: a Runge-Kutta step of 5 ms in its BicycleVehicle, ten to an env step of 50 ms, as ours."""
SCAN = 64
"""Steps that gymnax compiles into one call."""


class Unavailable(Exception):  # noqa: N818  not an error: said, and gone on
    """Something that cannot be measured here, with the reason in one line."""


def module(name: str) -> Any:
    """Import an optional package's module.

    Raises
    ------
    Unavailable
        Saying how to install it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = (error.name or name).partition(".")[0]
        hint = INSTALL.get(missing, f"pip install {missing}")
        raise Unavailable(f"{missing} is not installed: {hint}") from error


def lane_keeping() -> gymnasium.Env[Any, Any]:
    """highway-env's lane keeping with as many Runge-Kutta steps as ours."""
    module("highway_env")
    return gymnasium.make("lane-keeping-v0", config=dict(LANE_KEEPING))


def cartpole_vector(n: int) -> Run:
    """Gymnasium's own NumPy-vectorised CartPole."""
    env = gymnasium.make_vec("CartPole-v1", num_envs=n, vectorization_mode="vector_entry_point")
    return stepping(env, np.random.default_rng(0).integers(0, 2, (16, n)))


def cartpole_envpool(n: int) -> Run:
    """CartPole of envpool on one thread."""
    make = module("envpool").make_gymnasium
    actions = np.random.default_rng(0).integers(0, 2, (16, n)).astype(np.int32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the precision of its own spaces, of the reset's seed
        return stepping(make("CartPole-v1", num_envs=n, num_threads=1, seed=0), actions)


def cartpole_gymnax(n: int) -> Run:
    """CartPole of gymnax as it is meant to be used: compiled over envs and over SCAN steps."""
    gymnax, jax = module("gymnax"), module("jax")
    env, parameters = gymnax.make("CartPole-v1")

    def once(carry: Any, actions: Any) -> Any:
        states, key = carry
        key, mine = jax.random.split(key)
        observation, states, *_ = jax.vmap(env.step, (0, 0, 0, None))(
            jax.random.split(mine, n), states, actions, parameters
        )
        return (states, key), observation

    scan = jax.jit(lambda carry, actions: jax.lax.scan(once, carry, actions))
    key = jax.random.key(0)
    _, states = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(key, n), parameters)
    actions = jax.numpy.asarray(np.random.default_rng(0).integers(0, 2, (SCAN, n)))
    carry = jax.block_until_ready(scan((states, key), actions))[0]

    def run(count: int) -> float:
        nonlocal carry
        calls = -(-count // SCAN)
        began = time.perf_counter()
        for _ in range(calls):
            carry, _ = jax.block_until_ready(scan(carry, actions))
        return (time.perf_counter() - began) * count / (calls * SCAN)

    return run


def stepping(env: Any, actions: np.ndarray[Any, Any]) -> Run:
    """Steps of a vector environment, its automatic resets within the clock.

    Parameters
    ----------
    env
        A Gymnasium vector environment.
    actions
        (k, n, ...) batches of actions, taken in turn.
    """
    env.reset(seed=0)
    batches = cycle(list(actions))

    def run(count: int) -> float:
        step = env.step
        chosen = list(islice(batches, count))
        began = time.perf_counter()
        for action in chosen:
            step(action)
        return time.perf_counter() - began

    return run


def available(
    factories: dict[str, Callable[[], Any]], lacks: Callable[[str, str], None]
) -> dict[str, Any]:
    """What can be made, by name; `lacks` is told of the rest and why."""
    made = {}
    for name, factory in factories.items():
        try:
            made[name] = factory()
        except Unavailable as reason:
            lacks(name, str(reason))
    return made
