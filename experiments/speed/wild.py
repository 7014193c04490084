"""Section of the worst case: `predict` on observations that no drive would bring about."""

import time
from collections import Counter
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
from agents.nmpc.problem import Status
from experiments.run.suites import PAPER_VEHICLES
from experiments.speed.measure import PREDICT, Effort, Section, Tick
from lpv_track_env.observation import SCALARS
from lpv_track_env.registration import PATH_TRACKING

TRIES = 3
"""Times that an observation is solved, of which the fastest counts: the others were disturbed."""

# Range of each of `observation.SCALARS`: speeds to 30 m/s, errors to 5 m and 1 rad, and actuators
# beyond their bounds.
RANGES = (
    (0.0, 30.0), (-3.0, 3.0), (-1.5, 1.5), (-9.0, 6.0), (-0.8, 0.8), (-5.0, 5.0), (-1.0, 1.0),
    (0.0, 30.0),
)  # fmt: skip


def wild_observations(rng: np.random.Generator, count: int, steps: int) -> NDArray[np.float32]:
    """Observations (count, size) of any kind, a twentieth of them not finite."""
    first = len(SCALARS)
    rows = np.empty((count, first + 2 * steps))
    for k, bounds in enumerate(RANGES):
        rows[:, k] = rng.uniform(*bounds, count)
    # Half of the paths bend steadily, half jump about; a tenth are beyond any path.
    curvature = rng.uniform(-0.5, 0.5, (count, 1)) * np.ones(steps)
    jumping = rng.random(count) < 0.5
    curvature[jumping] = rng.uniform(-0.5, 0.5, (int(jumping.sum()), steps))
    curvature[rng.random(count) < 0.1] *= 10.0
    rows[:, first : first + steps] = curvature
    ramp = rng.uniform(-3.0, 3.0, (count, 1)) * 0.05 * np.arange(1, steps + 1)
    rows[:, first + steps :] = np.clip(rows[:, 7:8] + ramp, 0.0, 30.0)
    broken = np.flatnonzero(rng.random(count) < 0.05)
    rows[broken, rng.integers(0, rows.shape[1], len(broken))] = rng.choice(
        [np.nan, np.inf, -np.inf], len(broken)
    )
    return rows.astype(np.float32)


def wild(section: Section, effort: Effort, tick: Tick) -> None:
    """`predict` of the real-time NMPC on wild observations, one by one, without a warm start."""
    section.notes.append(
        f"Seconds per predict() of {effort.wild} observations for each vehicle: speeds to 30 m/s, "
        f"errors to 5 m and 1 rad, any curvature. The fastest of {TRIES} tries each, without a "
        "warm start; those that are not finite need no solve and are left out."
    )
    begin = np.array([True])
    for vehicle in PAPER_VEHICLES:
        env: gymnasium.Env[Any, Any] = gymnasium.make(PATH_TRACKING, vehicle=vehicle)
        agent = agents.make("lpv-nmpc", env)
        rows = wild_observations(
            np.random.default_rng(0), effort.wild, agent.task.layout.preview_steps  # type: ignore[attr-defined]
        )  # fmt: skip
        agent.predict(rows[0], episode_start=begin)
        series = section.add("lpv-nmpc", PREDICT, vehicle=vehicle)
        statuses: Counter[str] = Counter()
        for k, row in enumerate(rows):
            if k % 100 == 0:
                tick(f"wild observations: {vehicle}")
            if not np.isfinite(row).all():
                continue
            best = np.inf
            for _ in range(TRIES):
                began = time.perf_counter()
                _, memory = agent.predict(row, episode_start=begin)
                best = min(best, time.perf_counter() - began)
            series.rounds.append(best)
            statuses[agent.diagnostics(memory[0])["status"]] += 1  # type: ignore[attr-defined]
        failed = {key: value for key, value in statuses.items() if key != Status.SUCCESS.value}
        section.notes.append(
            f"{vehicle}: {statuses.total()} solves, "
            f"{', '.join(f'{value} {key}' for key, value in failed.items()) or 'none failed'}; the "
            f"slowest took {max(series.rounds) / np.median(series.rounds):.1f} times the median."
        )
