"""Evaluation of weights on paths that nothing was tuned on: whole drives in compiled closed loops.

The drives are those of `lpv-track benchmark` with `lpv-nmpc-tuned`, bit for bit, only in batches.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import agents
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.decision import Decider
from agents.weight_tuning.policy import WeightPolicy
from agents.weight_tuning.score import PARTS, SCALES, failed, parts_of, scores_of
from experiments.run.metrics import BANDS, KEPT
from experiments.run.suites import HELD_OUT, RAW, RAW_PREVIEW, SIX
from experiments.tuning.tuner import Result, threads
from lpv_track_env import kernels as k
from lpv_track_env.bicycle import VX, VY
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import ReferencePath
from trajectories.importers import read_racetrack

Array = NDArray[Any]

IN_BANDS = tuple(f"in_{name}" for name in BANDS.names)
"""Names of the scores of the periods in each band of |curvature| at the foot point."""
FIGURES = (
    *PARTS, "score", "max_cte", "ale", "aoe", "failed", "violated", "clipped", "failures",
    *IN_BANDS,
)  # fmt: skip
"""Names of the figures of a drive.

The parts of the score and the score; the largest lateral error (m) and its rms (m); the heading
error's rms (rad); 1 if the drive failed; the shares of periods in which |vy| / vx or the steering's
or jerk's limit was broken, and in which an actuator clipped its command; failed solves; the scores
in bands, NaN where the path has none.
"""


@dataclass(frozen=True)
class EvaluationSet:
    """Paths and conditions to evaluate weights on; each path is driven once for every seed.

    Seeds count from 0, which no tuning, training or validation uses.
    """

    name: str
    trajectories: tuple[str | ReferencePath, ...]
    conditions: Any = "randomised"
    seeds: int = 8
    vehicle: str = "m2-minibus"
    env_settings: dict[str, Any] = field(default_factory=dict)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the paths."""
        return tuple(
            path.name if isinstance(path, ReferencePath) else path for path in self.trajectories
        )

    def environments(
        self, path: str | ReferencePath, count: int | None = None
    ) -> PathTrackingVectorEnv:
        """Make the environments of a path's drives: one for each seed, or `count` of them."""
        return PathTrackingVectorEnv(
            self.seeds if count is None else count, path, self.vehicle, conditions=self.conditions,
            autoreset_mode="Disabled", **self.env_settings,
        )  # fmt: skip


def usual_sets(seeds: int) -> list[EvaluationSet]:
    """Return the sets of the study: held-out random paths, the paper's six, raw waypoints.

    The held-out paths also come without disturbances, and with perfect sensors.
    """
    return [
        EvaluationSet("held-out", HELD_OUT, seeds=seeds),
        EvaluationSet("held-out, simulation", HELD_OUT, "simulation", 1),
        # The best state knowledge that a controller can have, whatever its weights.
        EvaluationSet(
            "held-out, perfect sensors",
            HELD_OUT,
            {"name": "randomised", "estimator": "truth"},
            min(seeds, 2),
        ),
        EvaluationSet("six, realtime", SIX, "realtime", seeds),
        EvaluationSet("six, simulation", SIX, "simulation", 1),
        EvaluationSet("raw waypoints, realtime", RAW, "realtime", seeds, env_settings=RAW_PREVIEW),
    ]


def track_set(folder: Path, seeds: int) -> EvaluationSet:
    """Return a set of real circuits in their own size, whose bends the default vehicle can steer.

    Raises
    ------
    ValueError
        If the folder holds no centre line.
    """
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise ValueError(f"{folder} holds no .csv of a centre line")
    paths = tuple(read_racetrack(file) for file in files)
    return EvaluationSet("real circuits, randomised", paths, "randomised", max(seeds // 4, 2))


class Evaluator:
    """Environments of an evaluation set, made once to evaluate many weights."""

    def __init__(self, given: EvaluationSet) -> None:
        self.drives = [given.environments(path) for path in given.trajectories]

    def evaluate(self, result: Result, *, by_path: bool = False) -> dict[str, Array]:
        """Drive the set; return the figures of every drive, (paths, seeds) each, by `FIGURES`.

        With `by_path`, a schedule's set is chosen once, by the path's sharpest curvature.
        """
        rows = [self._drive(envs, result, by_path) for envs in self.drives]
        return {name: np.stack([row[name] for row in rows]) for name in FIGURES}

    def _drive(
        self, envs: PathTrackingVectorEnv, result: Result, by_path: bool
    ) -> dict[str, Array]:
        loop = loop_with(result, envs, by_path=by_path)
        loop.reset(seed=0)
        limit = envs.single.task.max_steps
        trace = np.full((envs.num_envs, limit, k.RECORD_SIZE), np.nan)
        before = envs.records.copy()
        tally = loop.drive(limit, trace=trace)
        trace = np.concatenate([before[:, None], trace], axis=1)
        path = envs.single.task.path
        return {**figures_of(tally, envs, trace), **band_scores(trace, path, envs.single)}


def loop_with(result: Result, envs: PathTrackingVectorEnv, *, by_path: bool = False) -> ClosedLoop:
    """Return the closed loop of environments with a schedule or a policy choosing the weights."""
    settings: dict[str, Any] = {}
    decider = None
    if isinstance(result, WeightPolicy):
        decider = Decider(result.choice, result.layers, envs.single.control_period)
    else:
        settings = {"weights": result, "selection": "path" if by_path else "band"}
    agent: Any = agents.make("lpv-nmpc", envs.single, **settings)
    return ClosedLoop(envs, agent, decider=decider, threads=min(threads(), envs.num_envs))


def figures_of(tally: Tally, envs: PathTrackingVectorEnv, trace: Array) -> dict[str, Array]:
    """Return figures of ended drives, (n,) each; `trace` (n, 1 + periods, RECORD_SIZE)."""
    ends, car, period = envs.arrays.ends, envs.single.vehicle, envs.single.control_period
    parts, steps = parts_of(tally), np.maximum(tally.steps, 1.0)
    driven = np.isfinite(trace[:, 1:, 0])
    vx, vy = trace[:, 1:, VX], trace[:, 1:, VY]
    steering, jerk = (
        np.abs(np.diff(trace[:, :, entry], axis=1)) / period
        for entry in (k.STEERING, k.ACCELERATION)
    )
    broken = (
        (np.abs(vy) - car.max_lateral_velocity_ratio * vx > KEPT)
        | (steering - car.max_steering_rate > KEPT)
        | (jerk - car.max_jerk > KEPT)
    )
    return {
        **dict(zip(PARTS, parts.T, strict=True)),
        "score": scores_of(tally, ends),
        "max_cte": tally.max_lateral,
        "ale": np.sqrt(tally.lateral_square / steps),
        "aoe": np.sqrt(tally.heading_square / steps),
        "failed": failed(ends).astype(np.float64),
        "violated": (broken & driven).sum(axis=1) / steps,
        "clipped": tally.clipped / steps,
        "failures": tally.failures,
    }


def band_scores(trace: Array, path: ReferencePath, env: PathTrackingEnv) -> dict[str, Array]:
    """Return scores of the periods in each band, (n,) each; `trace` as in `figures_of`."""
    after = trace[:, 1:]
    rates = np.diff(trace[:, :, [k.STEERING, k.ACCELERATION]], axis=1) / env.control_period
    errors = after[:, :, [k.LATERAL_ERROR, k.HEADING_ERROR, k.SPEED_ERROR]]
    squares = (np.concatenate([errors, rates], axis=2) / SCALES) ** 2
    driven = np.isfinite(after[:, :, 0])
    place = np.where(driven, after[:, :, k.ARC_LENGTH], 0.0)
    bands = BANDS.classify(path.sample(place).curvature)
    found = {}
    for index, name in enumerate(IN_BANDS):
        here = driven & (bands == index)
        count = here.sum(axis=1)
        sums = np.where(here[:, :, None], squares, 0.0).sum(axis=1)
        parts = np.sqrt(sums / np.maximum(count, 1)[:, None])
        found[name] = np.where(count > 0, parts.sum(axis=1), np.nan)
    return found
