"""Sections of the environments: one at a time, and many at once."""

import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle, islice
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from experiments.speed import peers
from experiments.speed.measure import Effort, Run, Section, Tick, calibrated, interleave
from experiments.speed.numpy_env import NumpyTracking
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.registration import PATH_TRACKING
from lpv_track_env.vector_env import PathTrackingVectorEnv

OURS = "lpv-track-env"
BARE = "lpv-track-env without gymnasium's wrappers"
TRAJECTORY = "T2"
EPISODE = 500
"""Steps after which an episode is cut."""
MOST_IN_SEQUENCE = 256
"""Environments beyond which a loop over single ones tells nothing new."""


def single(section: Section, effort: Effort, tick: Tick) -> None:
    """One environment through `gymnasium.make` against others', the same way."""
    section.notes.append(
        "Seconds per step() of random actions from the env's own action space; resets stand "
        f"outside the clock. {OURS} drives {TRAJECTORY}, a step is 50 ms in 10 Runge-Kutta steps; "
        "lane-keeping-v0 is set to the same."
    )
    envs = peers.available(
        {
            OURS: partial(gymnasium.make, PATH_TRACKING, trajectory=TRAJECTORY),
            "CartPole-v1": partial(gymnasium.make, "CartPole-v1"),
            "Pendulum-v1": partial(gymnasium.make, "Pendulum-v1"),
            "highway-env lane-keeping-v0": peers.lane_keeping,
        },
        section.lacks,
    )
    envs[BARE] = PathTrackingEnv(trajectory=TRAJECTORY)
    pairs = []
    for name, env in envs.items():
        tick(f"single environment: {name}")
        series = section.add(name, "s/step")
        pairs.append((series, calibrated(single_run(env), effort.round_seconds)))
        if name not in {OURS, BARE}:
            section.compare(pairs[0][0], series)
    tick("single environment: rounds in turn")
    interleave(pairs, effort.rounds)


def single_run(env: gymnasium.Env[Any, Any]) -> Run:
    """Steps of one environment; its resets stand outside the clock."""
    env.action_space.seed(0)
    actions = cycle([env.action_space.sample() for _ in range(256)])
    env.reset(seed=0)

    def run(count: int) -> float:
        remaining = islice(actions, count)
        seconds, taken = 0.0, 0
        while taken < count:
            env.reset()
            took, steps = _episode(env.step, islice(remaining, EPISODE))
            seconds, taken = seconds + took, taken + steps
        return seconds

    return run


def _episode(step: Callable[[Any], Any], actions: Iterator[Any]) -> tuple[float, int]:
    """Seconds and number of steps until the episode or the actions end."""
    count = 0
    began = time.perf_counter()
    for count, action in enumerate(actions, start=1):  # noqa: B007  the last count is returned
        _, _, terminated, truncated, _ = step(action)
        if terminated or truncated:
            break
    return time.perf_counter() - began, count


def vector(section: Section, effort: Effort, tick: Tick) -> None:
    """Environments stepped together, over their number."""
    section.notes.append(
        "Seconds per env-step: of one step() of n environments, divided by n. Random actions; "
        "episodes that end begin anew by themselves, within the clock (in NumPy there is no such "
        "reset). One thread unless said; "
        "gymnax takes as many as XLA does, and compiles "
        f"{peers.SCAN} steps into one call."
    )
    for n in effort.sizes:
        pairs = {}
        for (name, threads), run in _vector_runs(section, n, effort.threads).items():
            tick(f"{n} environments: {name}")
            series = section.add(name, "s/env-step", n=n, threads=threads)
            once = calibrated(run, effort.round_seconds)
            pairs[name, threads] = (series, lambda once=once: once() / n)  # noqa: B023
        ours = pairs.get((OURS, 1))
        for key, (series, _) in pairs.items():
            if ours is not None and key != (OURS, 1):
                section.compare(ours[0], series)
        tick(f"{n} environments: rounds in turn")
        interleave(pairs.values(), effort.rounds)


CONDITIONS: dict[str, Any] = {
    "simulation": "simulation",
    "realtime": "realtime",
    "realtime, perfect sensors": {"name": "realtime", "estimator": "truth"},
}


def conditions(section: Section, effort: Effort, tick: Tick) -> None:
    """The vector environment under the conditions of a real vehicle, over its number."""
    section.notes.append(
        "Seconds per env-step, as above, one thread. Real-time conditions have noise, lags, other "
        "tyres and wind for every vehicle, and its own Kalman filter, fixes coming two periods "
        "late; with perfect sensors there is no filter."
    )
    for n in effort.sizes[::2]:
        pairs = []
        for name, given in CONDITIONS.items():
            tick(f"{n} environments: {name}")
            series = section.add(name, "s/env-step", n=n, threads=1)
            run = peers.stepping(make_vector(n, conditions=given), _actions(n))
            once = calibrated(run, effort.round_seconds)
            pairs.append((series, lambda once=once: once() / n))  # noqa: B023
            if name != "simulation":
                section.compare(pairs[0][0], series)
        tick(f"{n} environments: rounds in turn")
        interleave(pairs, effort.rounds)


def _vector_runs(section: Section, n: int, threads: tuple[int, ...]) -> dict[tuple[str, int], Run]:
    factories: dict[tuple[str, int], Callable[[int], Run]] = {
        (OURS, count): partial(ours_vector, threads=count) for count in threads
    }
    factories["the same in NumPy", 1] = numpy_vector
    if n <= MOST_IN_SEQUENCE:
        factories["SyncVectorEnv of single ones", 1] = sequential
    factories["Gymnasium CartPole-v1, NumPy", 1] = peers.cartpole_vector
    factories["gymnax CartPole-v1", 1] = peers.cartpole_gymnax
    factories["envpool CartPole-v1", 1] = peers.cartpole_envpool
    runs = {}
    for (name, count), factory in factories.items():
        made = peers.available({name: partial(factory, n)}, section.lacks)
        if name in made:
            runs[name, count] = made[name]
    return runs


def _actions(n: int) -> NDArray[np.float32]:
    """(16, n, 2) actions [m/s^2, rad] at random within the bounds of the default vehicle."""
    space = gymnasium.make(PATH_TRACKING, trajectory="straight").action_space
    space.seed(0)
    low, high = (np.asarray(getattr(space, side)) for side in ("low", "high"))
    return np.random.default_rng(0).uniform(low, high, (16, n, 2)).astype(np.float32)


def make_vector(n: int, **settings: Any) -> Any:
    """Our vector environment."""
    return PathTrackingVectorEnv(trajectory=TRAJECTORY, num_envs=n, **settings)


def ours_vector(n: int, threads: int) -> Run:
    """Steps of our vector environment on some threads."""
    return peers.stepping(make_vector(n, threads=threads), _actions(n))


def numpy_vector(n: int) -> Run:
    """Steps of the same environment written with NumPy, which knows no resets.

    Every round begins from the start of the episode, so that no vehicle gets far from its path.
    """
    env = make_vector(n)
    env.reset(seed=0)
    actions = _actions(n).astype(np.float64)

    def run(count: int) -> float:
        yardstick = NumpyTracking(env.tasks[0], env.records)
        step = yardstick.step
        chosen = list(islice(cycle(actions), count))
        began = time.perf_counter()
        for action in chosen:
            step(action)
        return time.perf_counter() - began

    return run


def sequential(n: int) -> Run:
    """Steps of n of our single environments, one after another."""
    env = gymnasium.make_vec(
        PATH_TRACKING, num_envs=n, vectorization_mode="sync", trajectory=TRAJECTORY
    )
    return peers.stepping(env, _actions(n))
