"""Sections of the environments: a single one, many in parallel, their frames, and their peers."""

import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle, islice
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from experiments.drive import agent_notes, world_plan
from experiments.run.case import Case
from experiments.run.rollout import steps
from experiments.speed.measure import Effort, Run, Section, Tick, calibrated, interleave, module
from experiments.speed.numpy_env import NumpyTracking
from lpv_track_env import PATH_TRACKING
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.vector_env import PathTrackingVectorEnv

OURS = "lpv-track-env"
BARE = "lpv-track-env without gymnasium's wrappers"
TRAJECTORY = "T2"
EPISODE = 500
"""Steps after which an episode of a single environment is cut off."""
MOST_IN_SEQUENCE = 256
"""Largest number of environments that SyncVectorEnv is measured with; its time grows linearly."""
LANE_KEEPING = {"simulation_frequency": 200, "policy_frequency": 20}
"""Hz: ten Runge-Kutta steps of 5 ms per environment step of 50 ms in highway-env, as in ours."""
SCAN = 64
"""Steps that gymnax compiles into one call."""
CONDITIONS: dict[str, Any] = {
    "simulation": "simulation",
    "realtime": "realtime",
    "realtime, perfect sensors": {"name": "realtime", "estimator": "truth"},
}
RENDERED_TRAJECTORY, RENDERED_AGENT = "T3", "lpv-nmpc"


def single(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure one environment of this project and of others through `gymnasium.make`."""
    section.notes.append(
        "Seconds per step() with random actions from the env's own action space; resets are not "
        f"timed. {OURS} drives {TRAJECTORY}; a step is 50 ms in 10 Runge-Kutta steps, and "
        "lane-keeping-v0 is set to the same."
    )
    envs = section.available(
        {
            OURS: partial(gymnasium.make, PATH_TRACKING, trajectory=TRAJECTORY),
            "CartPole-v1": partial(gymnasium.make, "CartPole-v1"),
            "Pendulum-v1": partial(gymnasium.make, "Pendulum-v1"),
            "highway-env lane-keeping-v0": lane_keeping,
        }
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
    """Time steps of one environment, without its resets."""
    env.action_space.seed(0)
    actions = cycle([env.action_space.sample() for _ in range(256)])
    env.reset(seed=0)

    def run(count: int) -> float:
        remaining = islice(actions, count)
        seconds, taken = 0.0, 0
        while taken < count:
            env.reset()
            took, episode_steps = _episode(env.step, islice(remaining, EPISODE))
            seconds, taken = seconds + took, taken + episode_steps
        return seconds

    return run


def _episode(step: Callable[[Any], Any], actions: Iterator[Any]) -> tuple[float, int]:
    """Return the seconds and the number of steps until the episode or the actions end."""
    count = 0
    began = time.perf_counter()
    for count, action in enumerate(actions, start=1):  # noqa: B007  the last count is returned
        _, _, terminated, truncated, _ = step(action)
        if terminated or truncated:
            break
    return time.perf_counter() - began, count


def vector(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure environments stepped together, over their number."""
    section.notes.append(
        "Seconds per env-step: the time of one step() of n environments, divided by n. Random "
        "actions; resets of finished episodes are timed (the NumPy form has no resets). One "
        "thread unless stated; gymnax takes as many as XLA does, and compiles "
        f"{SCAN} steps into one call."
    )
    for n in effort.sizes:
        runs: dict[tuple[str, int], Callable[[int], Run]] = {
            (OURS, threads): partial(vector_run, threads=threads) for threads in effort.threads
        }
        runs["the same in NumPy", 1] = numpy_run
        if n <= MOST_IN_SEQUENCE:
            runs["SyncVectorEnv of single ones", 1] = sequential_run
        runs["Gymnasium CartPole-v1, NumPy", 1] = cartpole_run
        runs["gymnax CartPole-v1", 1] = cartpole_gymnax_run
        runs["envpool CartPole-v1", 1] = cartpole_envpool_run
        ours, pairs = None, []
        for (name, threads), make in runs.items():
            run = section.available({name: partial(make, n)}).get(name)
            if run is None:
                continue
            tick(f"{n} environments: {name}")
            series = section.add(name, "s/env-step", n=n, threads=threads)
            pairs.append((series, calibrated(run, effort.round_seconds, n)))
            if ours is None and name == OURS:
                ours = series
            elif ours is not None:
                section.compare(ours, series)
        tick(f"{n} environments: rounds in turn")
        interleave(pairs, effort.rounds)


def conditions(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure the vector environment under real-time conditions, over the number of vehicles."""
    section.notes.append(
        "Seconds per env-step, as above, one thread. Under real-time conditions every vehicle has "
        "noise, lags, tyres and wind of its own and a Kalman filter, with fixes two periods late; "
        "with perfect sensors there is no filter."
    )
    for n in effort.sizes[::2]:
        pairs = []
        for name, given in CONDITIONS.items():
            tick(f"{n} environments: {name}")
            series = section.add(name, "s/env-step", n=n, threads=1)
            run = vector_run(n, conditions=given)
            pairs.append((series, calibrated(run, effort.round_seconds, n)))
            if name != "simulation":
                section.compare(pairs[0][0], series)
        tick(f"{n} environments: rounds in turn")
        interleave(pairs, effort.rounds)


def stepping(env: Any, actions: NDArray[Any]) -> Run:
    """Time steps of a vector environment, its automatic resets included.

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


def random_actions(n: int) -> NDArray[np.float32]:
    """Return random actions (16, n, 2) [m/s^2, rad] within the bounds of the default vehicle."""
    space = gymnasium.make(PATH_TRACKING, trajectory="straight").action_space
    space.seed(0)
    low, high = (np.asarray(getattr(space, side)) for side in ("low", "high"))
    return np.random.default_rng(0).uniform(low, high, (16, n, 2)).astype(np.float32)


def vector_run(n: int, **settings: Any) -> Run:
    """Time steps of this project's vector environment."""
    return stepping(make_vector(n, **settings), random_actions(n))


def make_vector(n: int, **settings: Any) -> Any:
    """Make this project's vector environment."""
    return PathTrackingVectorEnv(trajectory=TRAJECTORY, num_envs=n, **settings)


def numpy_run(n: int) -> Run:
    """Time steps of the same environment written with NumPy, which has no resets.

    Every round begins at the start of the episode, so that no vehicle gets far from its path.
    """
    env = make_vector(n)
    env.reset(seed=0)
    actions = random_actions(n).astype(np.float64)

    def run(count: int) -> float:
        step = NumpyTracking(env.tasks[0], env.records).step
        chosen = list(islice(cycle(actions), count))
        began = time.perf_counter()
        for action in chosen:
            step(action)
        return time.perf_counter() - began

    return run


def sequential_run(n: int) -> Run:
    """Time steps of n single environments of this project, one after another."""
    env = gymnasium.make_vec(
        PATH_TRACKING, num_envs=n, vectorization_mode="sync", trajectory=TRAJECTORY
    )
    return stepping(env, random_actions(n))


def lane_keeping() -> gymnasium.Env[Any, Any]:
    """Make highway-env's lane keeping with as many Runge-Kutta steps as this project's."""
    module("highway_env")
    return gymnasium.make("lane-keeping-v0", config=dict(LANE_KEEPING))


def cartpole_run(n: int) -> Run:
    """Time steps of Gymnasium's own CartPole, vectorised with NumPy."""
    env = gymnasium.make_vec("CartPole-v1", num_envs=n, vectorization_mode="vector_entry_point")
    return stepping(env, np.random.default_rng(0).integers(0, 2, (16, n)))


def cartpole_envpool_run(n: int) -> Run:
    """Time steps of envpool's CartPole on one thread."""
    make = module("envpool").make_gymnasium
    actions = np.random.default_rng(0).integers(0, 2, (16, n)).astype(np.int32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the precision of its spaces, the seed of reset
        return stepping(make("CartPole-v1", num_envs=n, num_threads=1, seed=0), actions)


def cartpole_gymnax_run(n: int) -> Run:
    """Time steps of gymnax's CartPole in its intended use: compiled over envs and `SCAN` steps."""
    gymnax, jax = module("gymnax"), module("jax")
    env, parameters = gymnax.make("CartPole-v1")

    def step_all(carry: Any, actions: Any) -> Any:
        states, key = carry
        key, step_key = jax.random.split(key)
        observation, states, *_ = jax.vmap(env.step, (0, 0, 0, None))(
            jax.random.split(step_key, n), states, actions, parameters
        )
        return (states, key), observation

    scan = jax.jit(lambda carry, actions: jax.lax.scan(step_all, carry, actions))
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


def rendering(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure every frame of a drive as an array, with the agent's plan and weights drawn."""
    case = Case(agent=RENDERED_AGENT, trajectory=RENDERED_TRAJECTORY)
    env = case.make_env(render_mode="rgb_array")
    inner: Any = env.unwrapped
    series = section.add(f"{RENDERED_AGENT} on {RENDERED_TRAJECTORY}", "s/frame")
    processor = 0.0
    tick("frames of a drive")
    for k, info in steps(env, case.make_agent(env), seed=0):
        inner.show_agent(world_plan(info), agent_notes(RENDERED_AGENT, info))
        began, busy = time.perf_counter(), time.process_time()
        frame = inner.render()
        series.rounds.append(time.perf_counter() - began)
        processor += time.process_time() - busy
        if k % 100 == 0:
            tick(f"frames of a drive: {k}")
        if k >= effort.frames:
            break
    height, width = frame.shape[:2]
    total = float(np.sum(series.rounds))
    section.notes.append(
        f"Seconds per render() of each of {len(series.rounds)} frames, {width} x {height} pixels, "
        f"as an array: {len(series.rounds) / total:.0f} frames per second over all of them, "
        f"preparations in the first included; {len(series.rounds) / processor:.0f} per second of "
        "processor time, which other programs disturb less."
    )
    env.close()
