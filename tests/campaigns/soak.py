"""Soak: environments step for hours under every setting, and stay finite, bounded and repeatable.

A round draws a setting from the campaign's seed and its own number, so a fault is repeated by
`vector_round(seed, number, steps)` or `single_round(...)`. A round checks every observation and
reward, refuses what must be refused, and replays an episode bit for bit in another environment.
Memory, threads and open files are those of the second quarter of the campaign at its end.
"""

import faulthandler
import gc
import importlib.util
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import trajectories
from lpv_track_env import PATH_TRACKING
from lpv_track_env.conditions import PRESETS
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import VEHICLES
from tests.campaigns import Counts, Say

Array = NDArray[Any]
Settings = dict[str, Any]

ROUND = 200_000
"""Steps of a round of the full campaign."""
SINGLE_SHARE, PLANT_SHARE, MAKE_SHARE = 100, 20, 3000
"""Steps of vector environments for one in a single environment, steps there for one with another
plant than the bicycle, and steps for one `make` and `close`."""
LONGEST = 300.0
"""Time after which a round has hung, s; the process then ends with the place where it hangs."""
MARGIN = 32.0
"""Growth of the resident memory that counts as none, MiB."""
CONDITIONS: tuple[Any, ...] = (
    *PRESETS, {"name": "realtime", "estimator": "raw"}, {"name": "realtime", "estimator": "truth"},
    {"name": "realtime", "gnss_dropout_rate": 0.5, "gnss_outlier_rate": 0.2, "gnss_noise": 1.0},
)  # fmt: skip
ERROR_RANGES = ((0, 0, 0), (1, 0.3, 0.5), (1000, 6.2, 1), (1e15, 1e15, 1))
"""Of speed at most 1 m/s: no path is slower throughout."""
SPEEDS: tuple[Settings, ...] = (
    {"speed_mode": "variable"}, {"speed_mode": "fixed"}, {"speed_mode": "grip", "grip": 0.7},
)  # fmt: skip
PLANTS = ("bicycle", "single-track", "drift", "multi-body")
PLANTED = ("ford-escort", "bmw-320i", "vw-vanagon")
"""Vehicles that every plant knows."""
EXTREMES = np.array([0.0, -0.0, 5e-324, 1.0, -1.0, 1e3, -1e3, 3.4e38, -3.4e38, 1e300, -1.7e308])
ABSURD: tuple[Settings, ...] = (
    {"lateral_error": 1e154}, {"heading_error": -1e300}, {"speed_error": float("nan")},
    {"arc_length": -1.0}, {"arc_length": 1e12}, {"lateral_error": "much"}, {"speed": -1.0},
)  # fmt: skip


class BrokenError(Exception):
    """Something that must hold does not."""


def need(held: object, what: str) -> None:
    """Raise a BrokenError if something does not hold."""
    if not held:
        raise BrokenError(what)


def settings(rng: np.random.Generator) -> Settings:
    """Draw the settings that single and vector environments share."""
    period = float(rng.choice([0.01, 0.02, 0.05, 0.1]))
    return {
        "conditions": CONDITIONS[rng.integers(len(CONDITIONS))],
        "control_period": period,
        "preview_steps": int(rng.integers(1, 30)),
        "preview_period": 0.1 if rng.random() < 0.5 else float(rng.uniform(0.01, 0.2)),
        "max_lateral_error": float(rng.choice([0.5, 5.0, 1000.0])),
        "time_limit": None if rng.random() < 0.3 else float(rng.uniform(1.0, 30.0)),
        "initial_error_range": ERROR_RANGES[rng.integers(len(ERROR_RANGES))],
        "random_start": bool(rng.random() < 0.7),
        **SPEEDS[rng.integers(len(SPEEDS))],
    }


def path(rng: np.random.Generator) -> Any:
    """Draw a shipped or a random path."""
    if rng.random() < 0.5:
        return str(rng.choice(trajectories.names()))
    return trajectories.random_path(int(rng.integers(2**31)), fast=bool(rng.random() < 0.3))


def actions(rng: np.random.Generator, space: Any, rows: int) -> Array:
    """Draw actions (rows, 2) within the bounds, beyond them, or extreme, of any number type."""
    kind = rng.integers(5)
    drawn = rng.uniform(space.low, space.high, (rows, 2))
    if kind == 1:
        drawn *= 20.0
    elif kind == 2:
        drawn = rng.choice(EXTREMES, (rows, 2))
    elif kind == 3:
        drawn = np.where(rng.random((rows, 2)) < 0.5, space.low, space.high)
    elif kind == 4:
        drawn = np.rint(drawn).astype(np.int64)
    return drawn.astype(np.float32) if kind in {0, 3} else drawn


def start(rng: np.random.Generator) -> Settings:
    """Draw reset options that are allowed, up to their bounds."""
    scale = rng.choice([0.01, 1.0, 1e12])
    drawn = scale * rng.uniform((-1.0, -1.0, 0.0), 1.0) * (1000.0, 6.28, 100.0)
    values = zip(("lateral_error", "heading_error", "speed"), drawn.tolist(), strict=True)
    return {key: value for key, value in values if rng.random() < 0.7}


def check(observation: Array, reward: Any, terminated: Any, truncated: Any, space: Any) -> None:
    """Check what a step returned."""
    need(observation.dtype == np.float32, "dtype of the observation")
    need((np.abs(observation) <= space.high).all(), "observation beyond its bounds")
    need(np.isfinite(reward).all(), f"reward {reward}")
    need(not np.any(np.logical_and(terminated, truncated)), "terminated and truncated")


def check_infos(infos: Any) -> None:
    """Check that everything in infos is finite."""
    for key, value in infos.items():
        if isinstance(value, dict):
            check_infos(value)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
            need(np.isfinite(value).all(), f"info {key}")
        elif isinstance(value, float):
            need(np.isfinite(value), f"info {key}: {value}")


def refuses(env: Any, rng: np.random.Generator, bad: Array) -> None:
    """Check that an action and a reset that make no sense are refused, and change nothing."""
    state, absurd = env.state, ABSURD[rng.integers(len(ABSURD))]
    for refused, call in (
        ("a NaN action", lambda: env.step(bad)),
        (f"reset options {absurd}", lambda: env.reset(options=dict(absurd))),
    ):
        try:
            call()
        except (ValueError, gymnasium.error.ResetNeeded):
            pass
        else:
            raise BrokenError(f"{refused} accepted")
    need(np.array_equal(state, env.state), "a refused call changed the state")


def vector_round(seed: int, number: int, steps: int, seen: Counter[str]) -> int:
    """Step a vector environment of drawn settings; return the number of steps of its vehicles."""
    rng = np.random.default_rng([seed, number, 0])
    shared = settings(rng)
    n = max(1, min(int(2.0 ** rng.uniform(3.0, 11.0)), steps // 20))
    mode = list(AutoresetMode)[number % 3]
    names = list(VEHICLES)
    paths = [path(rng) for _ in range(rng.integers(1, 4))]
    cars = [str(rng.choice(names)) for _ in range(rng.integers(1, 3))]
    threads = 1 + number // 3 % 2
    env = PathTrackingVectorEnv(
        num_envs=n, trajectory=paths, vehicle=cars, autoreset_mode=mode, threads=threads, **shared
    )
    first_seed, row = int(rng.integers(2**31)), int(rng.integers(n))
    taken: list[tuple[Array, Array, float]] = []
    observation, infos = env.reset(seed=first_seed)
    check_infos(infos)
    task, first = env.task_of(row), observation[row].copy()
    space, own, replaying = env.observation_space, env.single_action_space, True
    for k in range(-(-steps // n)):
        action = actions(rng, own, n)
        observation, rewards, terminated, truncated, infos = env.step(action)
        check(observation, rewards, terminated, truncated, space)
        ended = terminated | truncated
        seen["ended episodes"] += int(ended.sum())
        if replaying:
            last = observation[row]
            if mode is AutoresetMode.SAME_STEP and ended[row]:
                last = infos["final_obs"][row]
            taken.append((action[row], last.copy(), float(rewards[row])))
            replaying = not ended[row] and k < 400
        if k % 40 == 0:
            check_infos(infos)
            bad = action.astype(np.float64)
            bad[rng.integers(n)] = np.nan
            if mode is not AutoresetMode.NEXT_STEP or not ended.any():
                refuses(env, rng, bad)
        if mode is AutoresetMode.DISABLED and ended.any():
            observation, _ = env.reset(options={**start(rng), "reset_mask": ended})
            check(observation, 0.0, False, False, space)
        elif rng.random() < 0.02:
            replaying = False
            options = {**start(rng), "reset_mask": rng.random(n) < 0.5}
            options["reset_mask"][0] = True
            if rng.random() < 0.3:
                options["trajectory"] = path(rng)
            observation, infos = env.reset(options=options)
            check(observation, 0.0, False, False, space)
            check_infos(infos)
            seen["resets with options"] += 1
    env.close()
    alone = PathTrackingEnv(
        task.path, task.vehicle, **shared | {"speed_mode": "variable", "grip": None}
    )
    replay(alone, first_seed + row, first, taken)
    seen["replayed steps"] += len(taken)
    return -(-steps // n) * n


def replay(env: Any, seed: int, first: Array, taken: list[Any]) -> None:
    """Repeat an episode by its seed: equal bits."""
    observation, _ = env.reset(seed=seed)
    need(np.array_equal(observation, first), "another first observation in a replay")
    for k, (action, expected, reward) in enumerate(taken):
        observation, own, terminated, truncated, _ = env.step(action)
        same = np.array_equal(observation, expected) and own == reward
        need(same, f"another outcome of step {k} in a replay")
        if terminated or truncated:
            break
    env.close()


def single_round(seed: int, number: int, steps: int, seen: Counter[str]) -> int:
    """Step one environment with one of the plants, which are slow; return the number of steps."""
    rng = np.random.default_rng([seed, number, 1])
    plant = PLANTS[number % 4] if importlib.util.find_spec("vehiclemodels") else PLANTS[0]
    if plant != PLANTS[0]:
        steps = steps // PLANT_SHARE + 1
    shared = {**settings(rng), "plant": plant, "trajectory": path(rng)}
    shared["vehicle"] = str(rng.choice(PLANTED))
    env, episodes = PathTrackingEnv(**shared), 0
    done, first_seed = 0, int(rng.integers(2**31))
    while done < steps:
        options = start(rng) if episodes % 2 else None
        observation, info = env.reset(seed=first_seed + episodes, options=options)
        check_infos(info)
        first, taken, ended = observation, [], False
        while not ended and len(taken) < min(steps, 300):
            action = actions(rng, env.action_space, 1)[0]
            observation, reward, terminated, truncated, info = env.step(action)
            check(observation, reward, terminated, truncated, env.observation_space)
            check_infos(info)
            ended = terminated or truncated
            taken.append((action, observation, reward))
        if not ended:
            refuses(env, rng, np.array([np.nan, 0.0]))
        if options is None:
            replay(PathTrackingEnv(**shared), first_seed + episodes, first, taken)
            seen["replayed steps"] += len(taken)
        done, episodes = done + len(taken), episodes + 1
    seen["single steps"] += done
    seen["ended episodes"] += episodes
    env.close()
    return done


def make_and_close(seed: int, number: int) -> None:
    """Make an environment as users do, step it, and close it."""
    rng = np.random.default_rng([seed, number, 2])
    env = gymnasium.make(
        PATH_TRACKING, conditions=CONDITIONS[rng.integers(len(CONDITIONS))],
        trajectory=str(rng.choice(trajectories.names())),
    )  # fmt: skip
    env.reset(seed=number)
    for _ in range(3):
        observation, reward, *_ = env.step(actions(rng, env.action_space, 1)[0])
        check(observation, reward, False, False, env.observation_space)
    env.close()


def resources() -> tuple[float, int, int]:
    """Return resident memory (MiB), threads and open files of this process; 0 where unknown."""
    gc.collect()
    memory, files, tasks = Path("/proc/self/statm"), Path("/proc/self/fd"), Path("/proc/self/task")
    if not memory.exists():
        return 0.0, threading.active_count(), 0
    pages = int(memory.read_text().split()[1])
    return pages * 4096 / 2**20, len(list(tasks.iterdir())), len(list(files.iterdir()))


def run(count: int, seed: int, say: Say) -> Counts:
    """Step vector environments `count` times, single ones a hundredth, with makes and closes."""
    faults: list[str] = []
    seen: Counter[str] = Counter()
    size = max(min(ROUND, count // 12), 1)
    rounds = -(-count // size)
    used, tried, made = [resources()], 0, 0
    for number in range(rounds):
        for kind, steps in ((vector_round, size), (single_round, size // SINGLE_SHARE + 1)):
            faulthandler.dump_traceback_later(LONGEST, exit=True)
            try:
                done = kind(seed, number, steps, seen)
                tried += done if kind is vector_round else 0
            except Exception as error:  # noqa: BLE001  whatever is raised is a fault
                message = f"{type(error).__name__}: {error}"
                faults.append(f"{kind.__name__}({seed}, {number}, {steps}): {message}")
                tried += steps if kind is vector_round else 0
            faulthandler.cancel_dump_traceback_later()
        while made < count * (number + 1) // rounds // MAKE_SHARE:
            make_and_close(seed, made)
            made += 1
        used.append(resources())
        say(
            f"round {number + 1} of {rounds}: {tried:,} steps, {len(faults)} faults, "
            f"{used[-1][0]:.0f} MiB, {used[-1][1]} threads, {used[-1][2]} files"
        )
    quarter = max(len(used) // 4, 1)
    before, after = used[quarter : 2 * quarter + 1], used[-quarter:]
    for k, (what, margin) in enumerate((("MiB", MARGIN), ("threads", 0), ("open files", 0))):
        low, high = max(row[k] for row in before), min(row[k] for row in after)
        if high > low + margin:
            faults.append(f"run({count}, {seed}): {what} grew from {low:.0f} to {high:.0f}")
    seen.update({"makes and closes": made, "MiB at the end": round(used[-1][0])})
    return Counts(tried, faults, dict(seen))
