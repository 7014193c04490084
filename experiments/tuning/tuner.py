"""Base of the ways to tune: the weights to choose from, and the drives that score them."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

import agents
from agents.weight_tuning.choice import DIRECTIONS, SLEW, WeightChoice
from agents.weight_tuning.closed_loop import ClosedLoop
from agents.weight_tuning.policy import WeightPolicy
from agents.weight_tuning.score import scores_of
from agents.weights import HIGHEST, LOWEST, WEIGHTS, TrackingWeights, WeightSchedule
from experiments.jobs.job import PROGRESS, Job, Line, episode_seed, read_lines
from experiments.tuning.settings import TuningSettings
from lpv_track_env import vehicle
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import CurvatureBands, ReferencePath

Array = NDArray[Any]
Result = WeightSchedule | WeightPolicy

# The catalogue of sets: factors on the position weights, each with every factor on the heading's.
POSITION_FACTORS = (1.0, 0.3, 0.1, 0.03, 0.01)
HEADING_FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0)


class Tuner(Job):
    """A tuning in steps, within a budget of NMPC solves."""

    settings: TuningSettings

    @property
    @abstractmethod
    def solves(self) -> int:
        """NMPC solves so far."""

    @property
    @abstractmethod
    def cost(self) -> int:
        """Largest number of solves of the next step, which is run only if the budget allows it."""

    @property
    def done(self) -> bool:
        """True when the budget allows no further step."""
        return self.solves + self.cost > self.settings.solves

    @abstractmethod
    def step(self) -> dict[str, float]:
        """Run one generation or segment; return figures to keep, by name."""

    def conclude(self, line: Line) -> Line:
        """Add the number of the step and the solves so far."""
        return {"step": len(self.lines), "solves": self.solves, **line}

    @abstractmethod
    def result(self, provenance: Mapping[str, Any]) -> Result:
        """Return the present weights."""

    @abstractmethod
    def read_state(self, folder: Path) -> bool:
        """Read the state that `save` wrote; False if there is none.

        Raises
        ------
        ValueError
            In one line, if the file cannot be used.
        """

    def restore(self, folder: Path) -> bool:
        """Read the state that `save` wrote, and its lines; False if there is none."""
        found = self.read_state(folder)
        if found:
            self.lines = lines_until(self.solves, folder)
        return found


def unusable(file: Path, reason: str) -> str:
    """Return the message for a file that a tuning cannot be resumed from, in one line."""
    reason = " ".join(reason.split())
    return f"{file} cannot be used ({reason}): remove it, and the tuning begins anew"


def lines_until(solves: int, folder: Path) -> list[Line]:
    """Read the lines of `progress.jsonl` up to a state, which is written after its line.

    Raises
    ------
    ValueError
        In one line, if they cannot be read or do not fit the state.
    """
    try:
        lines = read_lines(folder)
        kept = [line for line in lines if line["solves"] <= solves]
        if not kept or kept[-1]["solves"] != solves:
            raise ValueError(f"no line is of the step that ended at {solves:,} solves")
    except (OSError, KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"{folder / PROGRESS} cannot be used ({reason}): give another --out, and the tuning "
            "begins anew"
        ) from None
    return kept


# Weights ------------------------------------------------------------------------------------------


def weights_at(point: Array, directions: str, span: float) -> Array:
    """Return weights (..., 12) at log-multipliers (..., entries) of the default ones.

    Multipliers are clipped to `span` in either direction.
    """
    matrix = DIRECTIONS[directions]
    weights = np.broadcast_to(TrackingWeights().as_array(), (*point.shape[:-1], WEIGHTS)).copy()
    limit = np.log(span)
    weights[..., :8] *= np.exp(np.clip(point, -limit, limit) @ matrix.T)
    return np.clip(weights, LOWEST, HIGHEST)


def catalogue() -> tuple[TrackingWeights, ...]:
    """Return 25 sets, the default one first: less weight on position, more or less on heading."""
    base = TrackingWeights().as_array()
    sets: list[TrackingWeights] = []
    headings = sorted(HEADING_FACTORS, key=lambda factor: abs(np.log(factor)))
    for position, heading in product(POSITION_FACTORS, headings):
        weights = base.copy()
        weights[[2, 3, 6, 7]] *= position
        weights[[1, 5]] *= heading
        # The speed's weights serve comfort only: a tenth, except in the default set.
        weights[[0, 4]] *= 1.0 if not sets else 0.1
        sets.append(TrackingWeights.from_array(weights))
    return tuple(sets)


def choice_of(settings: TuningSettings) -> WeightChoice:
    """Return the weights that a learned policy may choose."""
    bands = CurvatureBands()
    base = WeightSchedule(bands, (TrackingWeights(),) * len(bands), slew=SLEW)
    sets = catalogue() if settings.method == "catalogue" else ()
    return WeightChoice(
        base, directions=settings.directions, span=settings.span, catalogue=sets,
        window=settings.window,
    )  # fmt: skip


def schedule_of(rows: Array, provenance: Mapping[str, Any]) -> WeightSchedule:
    """Return a schedule with a set (12,) for every band of curvature, (bands, 12)."""
    return WeightSchedule(
        CurvatureBands(), tuple(TrackingWeights.from_array(row) for row in rows), slew=SLEW,
        provenance=provenance,
    )  # fmt: skip


# Drives -------------------------------------------------------------------------------------------


def environments(
    settings: TuningSettings, paths: list[ReferencePath], count: int
) -> PathTrackingVectorEnv:
    """Make the environments of a tuning's drives, which start at random places of the paths."""
    return PathTrackingVectorEnv(
        count, paths, vehicle.load(settings.vehicle),
        conditions=settings.conditions, control_period=settings.control_period,
        preview_steps=settings.preview_steps, preview_period=settings.preview_period,
        time_limit=settings.time_limit, random_start=True, autoreset_mode="Disabled",
    )  # fmt: skip


class TuningDrives:
    """Drives of a tuning, `settings.drives` side by side, in rounds.

    The seeds of round k belong to (seed, k): candidates of one round meet the same paths, starts,
    vehicles and disturbances; other rounds have others.
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
        """Largest number of solves of a round."""
        return self.envs.num_envs * self.settings.periods

    def seeds(self, number: int) -> list[int]:
        """Return the seeds of round `number`, one for each drive."""
        first = episode_seed(self.settings.seed, number)
        return [first + k for k in range(self.envs.num_envs)]

    def scores(self, tables: Array, number: int, seeds: Sequence[int] | None = None) -> Array:
        """Return scores (n,) of round `number` under weights (12,), (n, 12) or (1 or n, bands, 12).

        `seeds` replace those of the round.
        """
        self.loop.reset(seed=list(self.seeds(number) if seeds is None else seeds))
        tally = self.loop.drive(self.settings.periods, tables)
        self.solves += int(tally.solves.sum())
        return scores_of(tally, self.envs.arrays.ends)


def threads() -> int:
    """Return the number of threads of compiled drives: two, or fewer if there are not as many."""
    return min(2, numba.get_num_threads())
