"""Tables of weights by search: CMA-ES (Hansen and Ostermeier 2001; package `cma`), and gradients.

What is searched are log-multipliers on the default Q and S. A search is resumed by playing it
again with the scores that are known: it draws the same candidates.
"""

import json
import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cma
import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.choice import DIRECTIONS, SLEW
from agents.weights import TrackingWeights, WeightSchedule
from experiments.tuning.drives import TuningDrives, weights_at
from experiments.tuning.settings import TuningSettings
from experiments.tuning.tuner import Tuner, unusable
from trajectories import CurvatureBands, ReferencePath
from trajectories.fileio import write_atomically

Array = NDArray[Any]

STATE, FORMAT = "search.json", "lpv-track-search/1"


class Search(Tuner):
    """Generations of points, judged on drives; what they were judged is all there is to keep."""

    rows: int
    """Sets of weights in a point."""

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath]) -> None:
        super().__init__(settings)
        self.paths = paths
        self.entries = DIRECTIONS[settings.directions].shape[1]
        self.limit = math.log(settings.span)
        self.judged: list[list[float]] = []
        """Scores of every generation's candidates."""
        self._solves = 0

    @property
    def solves(self) -> int:
        """NMPC solves so far."""
        return self._solves

    @property
    def played(self) -> dict[str, Any]:
        """All there is to keep, in plain JSON."""
        return {"judged": self.judged, "solves": self._solves}

    def play(self, played: Mapping[str, Any]) -> None:
        """Play kept scores again.

        Raises
        ------
        ValueError, KeyError, TypeError
            For what `played` has not given.
        """
        judged = [[float(score) for score in row] for row in played["judged"]]
        solves = int(played["solves"])
        for row in judged:
            if len(row) != len(self.ask()):
                raise ValueError("its generations are of another size")
            if not np.isfinite(row).all():
                raise ValueError("its scores are not finite")
            self.tell(row)
        self.judged, self._solves = judged, solves

    def save(self, folder: Path) -> None:
        """Write the scores so far."""
        write_state(folder, self.played)

    def restore(self, folder: Path) -> bool:
        """Play the scores of a folder again; False where there are none."""
        return restore_state(folder, self.play)

    @abstractmethod
    def ask(self) -> list[Array]:
        """Candidates of the next generation, points (rows * entries,)."""

    @abstractmethod
    def tell(self, scores: Sequence[float]) -> None:
        """Learn from the scores of what `ask` gave."""

    @abstractmethod
    def judge(self, points: list[Array], number: int) -> list[float]:
        """Scores of a generation's points."""

    @property
    @abstractmethod
    def point(self) -> Array:
        """Best guess so far, (rows, entries)."""

    def weights_of(self, point: Array) -> Array:
        """Weights (..., 10) of points (..., entries)."""
        return weights_at(point, self.settings.directions, self.settings.span)

    def step(self) -> dict[str, float]:
        """One generation."""
        points = self.ask()
        scores = self.judge(points, len(self.judged))
        self.tell(scores)
        self.judged.append(scores)
        return {"score": float(np.median(scores)), "best": float(np.min(scores))}

    def result(self, provenance: Mapping[str, Any]) -> WeightSchedule:
        """A schedule: a set for every band, all the same where there is but one."""
        bands = CurvatureBands()
        sets = self.weights_of(self.point)
        rows = np.broadcast_to(sets, (len(bands), 10))
        return WeightSchedule(
            bands, tuple(TrackingWeights.from_array(row) for row in rows), slew=SLEW,
            provenance=provenance,
        )  # fmt: skip


class CmaSearch(Search):
    """CMA-ES on the mean score of a round of drives, a new round every generation.

    `rows` 1 searches the best fixed set, one for each band a table. The result is the mean of the
    distribution: the best candidate of a noisy round would be the luckiest.
    """

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath], rows: int) -> None:
        super().__init__(settings, paths)
        self.rows = rows
        self.drives = TuningDrives(settings, paths)
        self._random: Any = np.random.get_state()  # noqa: NPY002
        with self._own_random():
            self._es = evolution(settings, rows * self.entries, settings.seed)

    @contextmanager
    def _own_random(self) -> Iterator[None]:
        """Lend CMA-ES, which draws from NumPy's global generator, a state of its own.

        Else searches side by side would disturb each other, and be others when played again.
        """
        outside = np.random.get_state()  # noqa: NPY002
        np.random.set_state(self._random)  # noqa: NPY002
        try:
            yield
        finally:
            self._random = np.random.get_state()  # noqa: NPY002
            np.random.set_state(outside)  # noqa: NPY002

    @property
    def cost(self) -> int:
        """Solves of a generation at most."""
        return int(self._es.popsize) * self.drives.most

    def ask(self) -> list[Array]:
        """Draw candidates."""
        with self._own_random():
            self._asked = self._es.ask()
        return [np.asarray(point) for point in self._asked]

    def tell(self, scores: Sequence[float]) -> None:
        """Update the distribution."""
        with self._own_random():
            self._es.tell(self._asked, list(scores))

    def judge(self, points: list[Array], number: int) -> list[float]:
        """Mean scores, all of the same drives."""
        before = self.drives.solves
        scores = []
        for point in points:
            table = self.weights_of(point.reshape(self.rows, self.entries))
            count = len(self.drives.bands)
            tables = np.broadcast_to(table, (count, 10))[None]
            scores.append(float(self.drives.scores(tables, number).mean()))
        self._solves += self.drives.solves - before
        return scores

    @property
    def point(self) -> Array:
        """Mean of the distribution."""
        mean: Array = np.asarray(self._es.result.xfavorite).reshape(self.rows, self.entries)
        return mean


def write_state(folder: Path, content: Mapping[str, Any]) -> None:
    """Write what a search is resumed from, atomically."""
    write_atomically(folder / STATE, json.dumps({"format": FORMAT, **content}).encode())


def restore_state(folder: Path, play: Callable[[Any], None]) -> bool:
    """Hand what `write_state` wrote to `play`; False where there is no such file.

    Raises
    ------
    ValueError
        In one line, if the file cannot be used.
    """
    file = folder / STATE
    if not file.exists():
        return False
    try:
        content = json.loads(file.read_text())
        if content["format"] != FORMAT:
            raise ValueError(f"its format is {content['format']!r}, not {FORMAT!r}")
        play(content)
    except KeyError as error:
        raise ValueError(unusable(file, f"no {error} in it")) from None
    except (OSError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise ValueError(unusable(file, str(error))) from None
    return True


def evolution(settings: TuningSettings, size: int, seed: int) -> Any:
    """A CMA-ES of so many variables, from the default weights on, bounded by the span."""
    limit = math.log(settings.span)
    return cma.CMAEvolutionStrategy(
        np.zeros(size), settings.hyperparameters["sigma"],
        {
            # 0 would mean a seed of the time.
            "seed": seed + 1, "verbose": -9, "bounds": [-limit, limit], "verb_log": 0,
            "tolfun": 0.0, "tolfunhist": 0.0, "tolx": 0.0,
        },
    )  # fmt: skip
