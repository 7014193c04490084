"""How much there is to be gained at all: weights chosen by somebody who knows what will happen.

A pool of sets of weights is driven on all drives. Whoever knows the drive, the path or the
conditions may take the best set for it; that against the best set for all is the headroom. Two
figures of each: in hindsight (chosen on the drives that are scored: an upper bound, luck included)
and by foresight (chosen on the drives of other seeds). A greedy oracle may change the set every
window, and looks a few windows ahead on a copy of the drive, disturbances included.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

import agents
from agents.weight_tuning.choice import DIRECTIONS, SLEW
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.score import failed, parts_of, scores_of
from agents.weights import HIGHEST, LOWEST, TrackingWeights
from experiments.study.evaluation import EvaluationSet
from experiments.tuning.drives import threads, weights_at
from lpv_track_env import kernels as k
from lpv_track_env.conditions import layout
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import CurvatureBands

Array = NDArray[Any]

SPAN = 100.0
"""Largest factor on a default weight in the pool: the tunings' own."""
KNOWN = (layout.GNSS_NOISE, layout.STEERING_LAG, layout.STEERING_DEAD_TIME)
"""Conditions that cells are made of, each divided at its median."""


def pool_of(count: int, found: Sequence[TrackingWeights], seed: int = 0) -> Array:
    """Sets of weights (sets, 10): those found, and a Sobol sequence over the span around default.

    Parameters
    ----------
    count
        Of the sequence, a power of two.
    found
        Sets that tunings have come to.
    seed
        Of the sequence's scrambling.
    """
    limit = np.log(SPAN)
    points = qmc.Sobol(DIRECTIONS["stages"].shape[1], seed=seed).random(count)
    drawn = weights_at(limit * (2.0 * points - 1.0), "stages", SPAN)
    given = np.array([one.as_array() for one in found]).reshape(-1, 10)
    base = TrackingWeights().as_array()
    pool: Array = np.clip(np.vstack([base, given, drawn]), LOWEST, HIGHEST)
    return pool


def loop_of(envs: PathTrackingVectorEnv) -> ClosedLoop:
    """Closed loop of environments, with the tuner's slew limit."""
    agent: Any = agents.make("lpv-nmpc", envs.single)
    return ClosedLoop(
        envs, agent, bands=CurvatureBands(), slew=SLEW, threads=min(threads(), envs.num_envs)
    )


def scores_of_pool(given: EvaluationSet, pool: Array) -> Iterator[tuple[Array, Array]]:
    """Scores (sets, seeds) and known conditions (seeds, 3) of each path of a set, in turns."""
    for path in given.trajectories:
        envs = PathTrackingVectorEnv(
            given.seeds, path, given.vehicle, conditions=given.conditions,
            autoreset_mode="Disabled", **given.env_settings,
        )  # fmt: skip
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
    """Mean scores of choices by what is known, and how far they are below the best fixed set's."""

    knows: str
    hindsight: float
    foresight: float | None

    def gain(self, fixed: float) -> float:
        """Share of the best fixed set's score, in hindsight."""
        return 1.0 - self.hindsight / fixed


def headroom(scores: Array, known: Array) -> list[Headroom]:
    """Headroom of knowing path, conditions, or the drive itself; the first is the best fixed set.

    Parameters
    ----------
    scores
        (paths, sets, seeds).
    known
        (paths, seeds, 3) conditions.
    """
    paths, _, seeds = scores.shape
    cells = ((known > np.median(known, axis=(0, 1))) @ (1 << np.arange(known.shape[2]))).astype(int)
    rows, columns = np.indices((paths, seeds))
    groups = {
        "nothing": np.zeros((paths, seeds), dtype=int),
        "the path": rows,
        "noise, lag and dead time, each high or low": cells,
        "the drive, disturbances included": rows * seeds + columns,
    }
    every, odd = np.ones((paths, seeds), dtype=np.bool_), columns % 2 == 1
    told = []
    for name, group in groups.items():
        found = _chosen(scores, group, every, every) / (paths * seeds)
        ahead = None
        # One seed leaves none to choose on, and a drive by itself none like it.
        if seeds > 1 and len(np.unique(group)) < paths * seeds:
            ahead = (_chosen(scores, group, odd, ~odd) + _chosen(scores, group, ~odd, odd)) / (
                paths * seeds
            )
        told.append(Headroom(name, found, ahead))
    return told


def _chosen(scores: Array, group: Array, chosen_on: Array, scored_on: Array) -> float:
    """Sum of scores where every group takes the set that is best on some drives, on others.

    A group with none to choose on takes the set that is best for all.
    """
    total = 0.0
    by_drive = scores.transpose(0, 2, 1)
    for value in np.unique(group):
        own = group == value
        seen = own & chosen_on if (own & chosen_on).any() else chosen_on
        total += by_drive[own & scored_on][:, by_drive[seen].mean(axis=0).argmin()].sum()
    return float(total)


def varied(scores: Array, count: int) -> list[int]:
    """Sets of a pool that together leave least to be wished, chosen one after another.

    `scores` is (paths, sets, seeds); the first is the best for all.
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
    """Scores (seeds,) of a greedy oracle on each path of a set, in turns.

    Every `window` periods it tries each set of the pool (sets, 10) over `ahead` windows on a copy
    of the drive, and takes the best one for one window.
    """
    count = len(pool)
    for path in given.trajectories:
        n = given.seeds
        envs = PathTrackingVectorEnv(
            n * (1 + count), path, given.vehicle, conditions=given.conditions,
            autoreset_mode="Disabled", **given.env_settings,
        )  # fmt: skip
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
            # The main ones stand still meanwhile.
            kept = ends[:n].copy()
            ends[:n] = k.TIME_LIMIT
            tally = loop.drive(window * ahead, tables)
            ends[:n] = kept
            cost = parts_of(tally).sum(axis=1) * tally.steps / (window * ahead)
            cost[n:] += 1e3 * failed(ends[n:])
            best = cost[n:].reshape(n, count).argmin(axis=1)
            tables[:n] = pool[best]
            ends[n:] = k.TIME_LIMIT
            # Of the sums the score reads squares and steps alone; peaks among them mean nothing.
            sums += np.array(loop.drive(window, tables))[:, :n]
            running = loop.running[:n]
        yield scores_of(Tally(*sums), envs.arrays.ends[:n])
