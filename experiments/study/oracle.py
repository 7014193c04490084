"""Oracles: how much could be gained by weights that are chosen with knowledge of the drive.

A pool of sets of weights is driven on all drives. An oracle that knows the path, the conditions or
the drive takes the best set for it; the headroom is its gain over the best single set. Each has two
figures: in hindsight, chosen on the drives that are scored, an upper bound that includes luck; and
by foresight, chosen on the drives of other seeds. A greedy oracle may change the set in every
window: it looks a few windows ahead on a copy of the drive, disturbances included.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress
from scipy.stats import qmc

import agents
from agents.weight_tuning.choice import DIRECTIONS, SLEW
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.policy import load
from agents.weight_tuning.score import failed, parts_of, scores_of
from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule
from agents.weights import WEIGHTS as SET_SIZE
from experiments.study.evaluation import EvaluationSet
from experiments.study.study import Study
from experiments.tuning.loop import WEIGHTS
from experiments.tuning.tuner import threads, weights_at
from lpv_track_env import kernels as k
from lpv_track_env.conditions import layout
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import CurvatureBands
from trajectories.fileio import checked, read_json, write_atomically

Array = NDArray[Any]

FILE = "oracle.json"
SPAN = 100.0
"""Largest factor on a default weight in the pool, as in the tunings."""
POOL, QUICK_POOL = 64, 4
"""Sets drawn for the pool; powers of two, for the Sobol sequence."""
BRANCHES, QUICK_BRANCHES = 12, 3
"""Sets that the greedy oracle tries in every window."""
KNOWN = (layout.GNSS_NOISE, layout.STEERING_LAG, layout.STEERING_DEAD_TIME)
"""Conditions that an oracle may know, each as high or low against its median."""


def study_oracles(
    study: Study, progress: Progress, *, quick: bool
) -> tuple[list["Headroom"], float | None]:
    """Compute the headroom of a study's first set and the greedy oracle's score.

    Both are kept in the study's folder and read from there the next time.
    """
    file = study.folder / FILE
    if file.exists():
        kept = checked(read_json(file), StoredOracles, file)
        return kept["headroom"], kept["greedy"]
    given = study.sets[0]
    found = [
        result.weights[0]
        for rung, seed in study.trainings()
        if rung.method == "search"
        and isinstance(result := load(study.training(rung.label, seed) / WEIGHTS), WeightSchedule)
    ]
    pool = pool_of(QUICK_POOL if quick else POOL, found)
    paths = len(given.trajectories)
    driven = list(
        progress.track(
            scores_of_pool(given, pool), paths, description="oracle: every set on every drive"
        )
    )
    table = np.stack([scores for scores, _ in driven])
    rows = headroom(table, np.stack([known for _, known in driven]))
    # A few drives a path: each tries many sets in every window.
    few = replace(given, seeds=min(given.seeds, 2))
    some = pool[varied(table, QUICK_BRANCHES if quick else BRANCHES)]
    greedy_scores = list(
        progress.track(greedy(few, some), paths, description="oracle: greedy, every window")
    )
    best = table.mean(axis=(0, 2)).argmin()
    # The ratio to the best fixed set on the greedy oracle's few drives, scaled to all drives.
    share = np.mean(greedy_scores) / table[:, best, : few.seeds].mean()
    value = float(rows[0].hindsight * share)
    content = {"headroom": [vars(row) for row in rows], "greedy": value}
    write_atomically(file, json.dumps(content, indent=2).encode())
    return rows, value


def pool_of(count: int, found: Sequence[TrackingWeights], seed: int = 0) -> Array:
    """Return sets of weights (sets, 12): default, `found` by tunings, a Sobol sequence in the span.

    `count` is the length of the sequence, a power of two, and `seed` the seed of its scrambling.
    """
    limit = np.log(SPAN)
    points = qmc.Sobol(DIRECTIONS["stages"].shape[1], seed=seed).random(count)
    drawn = weights_at(limit * (2.0 * points - 1.0), "stages", SPAN)
    given = np.array([one.as_array() for one in found]).reshape(-1, SET_SIZE)
    base = TrackingWeights().as_array()
    pool: Array = np.clip(np.vstack([base, given, drawn]), LOWEST, HIGHEST)
    return pool


def loop_of(envs: PathTrackingVectorEnv) -> ClosedLoop:
    """Return the closed loop of environments, with the tuner's slew limit."""
    agent: Any = agents.make("lpv-nmpc", envs.single)
    return ClosedLoop(
        envs, agent, bands=CurvatureBands(), slew=SLEW, threads=min(threads(), envs.num_envs)
    )


def scores_of_pool(given: EvaluationSet, pool: Array) -> Iterator[tuple[Array, Array]]:
    """Yield scores (sets, seeds) and known conditions (seeds, 3) of each path of a set."""
    for path in given.trajectories:
        envs = given.environments(path)
        loop = loop_of(envs)
        scores = np.empty((len(pool), given.seeds))
        for i, weights in enumerate(pool):
            loop.reset(seed=0)
            tally = loop.drive(envs.single.task.max_steps, weights)
            scores[i] = scores_of(tally, envs.arrays.ends)
        drawn = envs.condition_arrays
        known = np.zeros((given.seeds, len(KNOWN))) if drawn is None else drawn[0][:, KNOWN].copy()
        yield scores, known


@dataclass(frozen=True)
class Headroom:
    """Mean scores of an oracle with some knowledge; None where there is no foresight."""

    knows: str
    hindsight: float
    foresight: float | None

    def gain(self, fixed: float) -> float:
        """Return the gain in hindsight, as a share of the best fixed set's score."""
        return 1.0 - self.hindsight / fixed


class StoredOracles(TypedDict):
    """Content of `oracle.json`."""

    headroom: list[Headroom]
    greedy: float | None


def headroom(scores: Array, known: Array) -> list[Headroom]:
    """Return the best fixed set, then the headroom of knowing path, conditions, or the drive.

    `scores` are those of the pool, (paths, sets, seeds); `known` the conditions `KNOWN` of the
    drives, (paths, seeds, 3).
    """
    paths, _, seeds = scores.shape
    cells = ((known > np.median(known, axis=(0, 1))) @ (1 << np.arange(known.shape[2]))).astype(int)
    path, seed = np.indices((paths, seeds))
    groups = {
        "nothing": np.zeros((paths, seeds), dtype=int),
        "the path": path,
        "noise, lag and dead time, each high or low": cells,
        "the drive, disturbances included": path * seeds + seed,
    }
    every, odd = np.ones((paths, seeds), dtype=np.bool_), seed % 2 == 1
    rows = []
    for name, group in groups.items():
        found = _chosen(scores, group, every, every) / (paths * seeds)
        ahead = None
        # Foresight chooses on drives of other seeds in the same group, if there are any.
        if seeds > 1 and len(np.unique(group)) < paths * seeds:
            ahead = (_chosen(scores, group, odd, ~odd) + _chosen(scores, group, ~odd, odd)) / (
                paths * seeds
            )
        rows.append(Headroom(name, found, ahead))
    return rows


def _chosen(scores: Array, group: Array, chosen_on: Array, scored_on: Array) -> float:
    """Return the sum of scores on `scored_on`, with the set of each group chosen on `chosen_on`.

    A group without drives to choose on takes the set that is best for all.
    """
    total = 0.0
    by_drive = scores.transpose(0, 2, 1)
    for value in np.unique(group):
        own = group == value
        seen = own & chosen_on if (own & chosen_on).any() else chosen_on
        total += by_drive[own & scored_on][:, by_drive[seen].mean(axis=0).argmin()].sum()
    return float(total)


def varied(scores: Array, count: int) -> list[int]:
    """Choose sets of a pool one after another, each to lower the mean of the best scores most.

    `scores` is (paths, sets, seeds); the first choice is the best set for all drives.
    """
    table = scores.transpose(1, 0, 2).reshape(scores.shape[1], -1)
    kept: list[int] = []
    best = np.full(table.shape[1], np.inf)
    for _ in range(min(count, len(table))):
        gains = np.minimum(table, best).mean(axis=1)
        gains[kept] = np.inf
        kept.append(int(gains.argmin()))
        best = np.minimum(best, table[kept[-1]])
    return kept


def greedy(
    given: EvaluationSet, pool: Array, *, window: int = 8, ahead: int = 3
) -> Iterator[Array]:
    """Yield scores (seeds,) of a greedy oracle on each path of a set.

    Every `window` periods it tries each set of the pool (sets, 12) over `ahead` windows on a copy
    of the drive, and takes the best one for one window.
    """
    count = len(pool)
    for path in given.trajectories:
        n = given.seeds
        envs = given.environments(path, n * (1 + count))
        loop = loop_of(envs)
        loop.reset(seed=[*range(n), *(seed for seed in range(n) for _ in range(count))])
        main, branches = np.arange(n), n + np.arange(n * count)
        tables = np.tile(pool[0], (n * (1 + count), 1))
        tables[n:] = np.tile(pool, (n, 1))
        sums = np.zeros((len(Tally._fields), n))
        running = loop.running[:n]
        while running.any():
            loop.copy(np.repeat(main, count), branches)
            ends = envs.arrays.ends
            # The main drives stand still meanwhile.
            kept = ends[:n].copy()
            ends[:n] = k.TIME_LIMIT
            tally = loop.drive(window * ahead, tables)
            ends[:n] = kept
            cost = parts_of(tally).sum(axis=1) * tally.steps / (window * ahead)
            cost[n:] += 1e3 * failed(ends[n:])
            best = cost[n:].reshape(n, count).argmin(axis=1)
            tables[:n] = pool[best]
            ends[n:] = k.TIME_LIMIT
            # The score reads squares and steps only: summed peaks have no meaning.
            sums += np.array(loop.drive(window, tables))[:, :n]
            running = loop.running[:n]
        yield scores_of(Tally(*sums), envs.arrays.ends[:n])
