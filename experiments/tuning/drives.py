"""Drives that weights are judged on: a score and its cost in solves."""

from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

import agents
import trajectories
from agents.weight_tuning.choice import DIRECTIONS, SLEW
from agents.weight_tuning.closed_loop import ClosedLoop
from agents.weight_tuning.score import scores_of
from agents.weights import HIGHEST, LOWEST, TrackingWeights
from experiments.training.seeds import TRAINING_EPISODES, TRAINING_PATHS, random_names
from experiments.training.settings import MOST_PATHS
from experiments.tuning.settings import TuningSettings
from lpv_track_env import vehicle
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import CurvatureBands, ReferencePath

Array = NDArray[Any]
Tick = Callable[[int, int], None]


def path_names(settings: TuningSettings) -> list[str]:
    """Names of the paths of a tuning."""
    if settings.trajectories:
        return list(settings.trajectories)
    return random_names(TRAINING_PATHS + MOST_PATHS * settings.seed, settings.paths)


def load_paths(settings: TuningSettings, tick: Tick = lambda *_: None) -> list[ReferencePath]:
    """Load the paths of a tuning; `tick(done, all)` after each."""
    names, paths = path_names(settings), []
    for k, name in enumerate(names):
        paths.append(trajectories.load(name))
        tick(k + 1, len(names))
    return paths


def weights_at(point: Array, directions: str, span: float) -> Array:
    """Weights (..., 10) of log-multipliers (..., entries) on the default ones, within a span."""
    matrix = DIRECTIONS[directions]
    weights = np.broadcast_to(TrackingWeights().as_array(), (*point.shape[:-1], 10)).copy()
    limit = np.log(span)
    weights[..., :8] *= np.exp(np.clip(point, -limit, limit) @ matrix.T)
    return np.clip(weights, LOWEST, HIGHEST)


def environments(
    settings: TuningSettings, paths: list[ReferencePath], count: int
) -> PathTrackingVectorEnv:
    """Environments of a tuning's drives, each from a random place on."""
    return PathTrackingVectorEnv(
        count, paths, vehicle.load(settings.vehicle),
        conditions=settings.conditions, control_period=settings.control_period,
        preview_steps=settings.preview_steps, preview_period=settings.preview_period,
        time_limit=settings.time_limit, random_start=True, autoreset_mode="Disabled",
    )  # fmt: skip


def first_seed(settings: TuningSettings, number: int) -> int:
    """Seed of the first drive of round `number`; the others count on."""
    return TRAINING_EPISODES * (1 + settings.seed) + 1_000_000 * number


class TuningDrives:
    """Drives of a tuning, `settings.drives` side by side.

    Round k of them begins with seeds that belong to (seed, k): candidates of one round meet the
    same paths, places, vehicles and disturbances, those of another round other ones.
    """

    def __init__(
        self, settings: TuningSettings, paths: list[ReferencePath], count: int | None = None
    ) -> None:
        self.settings = settings
        self.bands = CurvatureBands()
        self.envs = environments(settings, paths, settings.drives if count is None else count)
        agent: Any = agents.make("lpv-nmpc", self.envs.single)
        self.loop = ClosedLoop(self.envs, agent, bands=self.bands, slew=SLEW, threads=threads())
        self.solves = 0

    @property
    def most(self) -> int:
        """Solves of a round at most."""
        return self.envs.num_envs * self.settings.periods

    def seeds(self, number: int) -> list[int]:
        """Seeds of round `number`, of all drives."""
        first = first_seed(self.settings, number)
        return [first + k for k in range(self.envs.num_envs)]

    def scores(self, tables: Array, number: int, seeds: Sequence[int] | None = None) -> Array:
        """Scores (n,) of round `number` under weights (10,), (n, 10) or (1 or n, bands, 10)."""
        self.loop.reset(seed=list(self.seeds(number) if seeds is None else seeds))
        tally = self.loop.drive(self.settings.periods, tables)
        self.solves += int(tally.solves.sum())
        return scores_of(tally, self.envs.arrays.ends)


def threads() -> int:
    """Threads of a tuning's compiled drives: two, where there are as many processors."""
    return min(2, int(numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
