"""Tables of weights by search: CMA-ES (Hansen and Ostermeier 2001; package `cma`), and gradients.

The variables are log-multipliers of the default Q and S. A search is resumed by replaying it with
the scores that are known: it draws the same candidates again.

`GradientSearch` descends stochastic gradients of the closed loop's score. Its drives come in pairs
that meet the same path, start, vehicle and disturbances, with weights moved to either side in a
random direction; half the difference of their scores is the derivative along it, up to third order.
The mean over the pairs, each with its own direction, is the gradient of the Gaussian-smoothed score
(Nesterov and Spokoiny 2017, antithetic): it takes two drives a pair, however many weights there
are. Adam (Kingma and Ba 2015) descends it.

`PathClassSearch` follows the paper's rule (kumar2025lpv): a set for each class of path, by the
path's sharpest curvature. The paper does not publish its table of sets; here the set of each class
is searched on the paths of that class, with a share of the budget as large as its share of the
paths.
"""

import json
import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cma
import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.choice import DIRECTIONS
from agents.weights import WEIGHTS, WeightSchedule
from experiments.tuning.settings import TuningSettings
from experiments.tuning.tuner import Tuner, TuningDrives, schedule_of, unusable, weights_at
from trajectories import CurvatureBands, ReferencePath
from trajectories.arguments import shown
from trajectories.fileio import read_json, write_atomically

Array = NDArray[Any]

STATE, FORMAT = "search.json", "lpv-track-search/1"


class ReplayedTuner(Tuner):
    """A tuning that is resumed by repeating it with the known scores of its candidates."""

    @property
    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Scores and solves so far, in plain JSON."""

    @abstractmethod
    def replay(self, state: Mapping[str, Any]) -> None:
        """Repeat the tuning with the scores of a state.

        Raises
        ------
        ValueError, KeyError, TypeError
            If the state does not fit.
        """

    def save(self, folder: Path) -> None:
        """Write the state."""
        content = json.dumps({"format": FORMAT, **self.state})
        write_atomically(folder / STATE, content.encode())

    def read_state(self, folder: Path) -> bool:
        """Repeat the tuning with the scores that `save` wrote; False if there are none."""
        file = folder / STATE
        if not file.exists():
            return False
        try:
            content = read_json(file)
            if content["format"] != FORMAT:
                raise ValueError(f"its format is {shown(content['format'])}, not {FORMAT!r}")
            self.replay(content)
        except KeyError as error:
            raise ValueError(unusable(file, f"no {error} in it")) from None
        except (TypeError, AttributeError, ValueError) as error:
            raise ValueError(unusable(file, str(error))) from None
        return True


class Search(ReplayedTuner):
    """Generations of points, scored on drives."""

    rows: int
    """Number of sets of weights in a point."""

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath]) -> None:
        super().__init__(settings)
        self.paths = paths
        self.entries = DIRECTIONS[settings.directions].shape[1]
        self.limit = math.log(settings.span)
        self.scores: list[list[float]] = []
        """Scores of every generation's candidates."""
        self._solves = 0

    @property
    def solves(self) -> int:
        """NMPC solves so far."""
        return self._solves

    @property
    def state(self) -> dict[str, Any]:
        """Scores and solves so far, in plain JSON."""
        return {"judged": self.scores, "solves": self._solves}

    def replay(self, state: Mapping[str, Any]) -> None:
        """Repeat the search with the scores of a state."""
        scores = [[float(score) for score in row] for row in state["judged"]]
        solves = int(state["solves"])
        for row in scores:
            if len(row) != len(self.ask()):
                raise ValueError("its generations are of another size")
            if not np.isfinite(row).all():
                raise ValueError("its scores are not finite")
            self.tell(row)
        self.scores, self._solves = scores, solves

    @abstractmethod
    def ask(self) -> list[Array]:
        """Return the candidates of the next generation, points (rows * entries,)."""

    @abstractmethod
    def tell(self, scores: Sequence[float]) -> None:
        """Learn from the scores of the last candidates."""

    @abstractmethod
    def evaluate(self, points: list[Array], number: int) -> list[float]:
        """Return the scores of the points of generation `number`."""

    @property
    @abstractmethod
    def point(self) -> Array:
        """Present estimate of the optimum, (rows, entries)."""

    def weights_of(self, point: Array) -> Array:
        """Return the weights (..., 12) of points (..., entries)."""
        return weights_at(point, self.settings.directions, self.settings.span)

    def step(self) -> dict[str, float]:
        """Run one generation."""
        points = self.ask()
        scores = self.evaluate(points, len(self.scores))
        self.tell(scores)
        self.scores.append(scores)
        return {"score": float(np.median(scores)), "best": float(np.min(scores))}

    def result(self, provenance: Mapping[str, Any]) -> WeightSchedule:
        """Return a schedule with a set for every band; with one row, all sets are the same."""
        sets = self.weights_of(self.point)
        return schedule_of(np.broadcast_to(sets, (len(CurvatureBands()), WEIGHTS)), provenance)


class CmaSearch(Search):
    """CMA-ES on the mean score of a round of drives, with a new round for every generation.

    With one of the `rows` it searches the best fixed set, with one for each band a table. The
    result is the mean of the distribution, since the best candidate of a noisy round owes much to
    luck.
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
        """Give CMA-ES, which draws from NumPy's global generator, a random state of its own.

        Otherwise searches side by side would disturb each other and could not be replayed.
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
        """Largest number of solves of a generation."""
        return int(self._es.popsize) * self.drives.most

    def ask(self) -> list[Array]:
        """Draw candidates."""
        with self._own_random():
            self._candidates = self._es.ask()
        return [np.asarray(point) for point in self._candidates]

    def tell(self, scores: Sequence[float]) -> None:
        """Update the distribution."""
        with self._own_random():
            self._es.tell(self._candidates, list(scores))

    def evaluate(self, points: list[Array], number: int) -> list[float]:
        """Return mean scores, all on the same drives."""
        before = self.drives.solves
        scores = []
        for point in points:
            table = self.weights_of(point.reshape(self.rows, self.entries))
            count = len(self.drives.bands)
            tables = np.broadcast_to(table, (count, WEIGHTS))[None]
            scores.append(float(self.drives.scores(tables, number).mean()))
        self._solves += self.drives.solves - before
        return scores

    @property
    def point(self) -> Array:
        """Mean of the distribution."""
        mean: Array = np.asarray(self._es.result.xfavorite).reshape(self.rows, self.entries)
        return mean


class GradientSearch(Search):
    """Adam from the default weights on; the result is the mean over the later half of the steps."""

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath], rows: int) -> None:
        super().__init__(settings, paths)
        self.rows = rows
        self.pairs: int = settings.hyperparameters["pairs"]
        self.drives = TuningDrives(settings, paths, 2 * self.pairs)
        self._random = np.random.default_rng(settings.seed)
        size = rows * self.entries
        self._now, self._mean, self._square = np.zeros(size), np.zeros(size), np.zeros(size)
        self._past: list[Array] = []
        self._directions: Array = np.zeros((0, size))

    @property
    def cost(self) -> int:
        """Largest number of solves of a step."""
        return self.drives.most

    def ask(self) -> list[Array]:
        """Return the points on either side of the present one, pair after pair."""
        self._directions = self._random.standard_normal((self.pairs, len(self._now)))
        sigma = self.settings.hyperparameters["sigma"]
        return [self._now + sign * sigma * d for d in self._directions for sign in (1.0, -1.0)]

    def evaluate(self, points: list[Array], number: int) -> list[float]:
        """Return scores of one drive each; the two of a pair differ in their weights alone."""
        count = len(self.drives.bands)
        tables = self.weights_of(np.array(points).reshape(len(points), self.rows, self.entries))
        before = self.drives.solves
        seeds = self.drives.seeds(number)
        scores = self.drives.scores(
            np.broadcast_to(tables, (len(points), count, WEIGHTS)),
            number,
            [seeds[k // 2] for k in range(len(points))],
        )
        self._solves += self.drives.solves - before
        return [float(score) for score in scores]

    def gradient(self, scores: Sequence[float]) -> Array:
        """Return the gradient (rows * entries,) from the scores of the last candidates."""
        values = np.asarray(scores).reshape(self.pairs, 2)
        slopes = (values[:, 0] - values[:, 1]) / (2.0 * self.settings.hyperparameters["sigma"])
        # A failed drive shows that a side is bad, but not how steep the score is.
        gradient: Array = np.clip(slopes, -2.0, 2.0) @ self._directions / self.pairs
        return gradient

    def tell(self, scores: Sequence[float]) -> None:
        """Take a step down the gradient."""
        hyper = self.settings.hyperparameters
        gradient = self.gradient(scores)
        steps = len(self._past) + 1
        self._mean += 0.1 * (gradient - self._mean)
        self._square += 0.01 * (gradient**2 - self._square)
        mean = self._mean / (1.0 - 0.9**steps)
        square = self._square / (1.0 - 0.99**steps)
        move = hyper["learning_rate"] * mean / (np.sqrt(square) + 1e-8)
        self._now = np.clip(self._now - move, -self.limit, self.limit)
        self._past.append(self._now.copy())

    @property
    def point(self) -> Array:
        """Mean of the later half of the points so far."""
        half = self._past[len(self._past) // 2 :]
        mean: Array = np.mean(half, axis=0) if half else self._now
        return mean.reshape(self.rows, self.entries)


class PathClassSearch(ReplayedTuner):
    """A search for each class of path; the schedule is for the selection "path".

    A class without paths, or whose share of the budget allows no generation, takes the set of the
    nearest class that is searched.
    """

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath]) -> None:
        super().__init__(settings)
        self.bands = CurvatureBands()
        classes = [self.bands.select(path.curvature) for path in paths]
        self.searches = {
            band: CmaSearch(
                settings, [p for p, of in zip(paths, classes, strict=True) if of == band], 1
            )
            for band in sorted(set(classes))
        }
        self._share_out()
        # The smallest class goes first: its share may be what another one lacks.
        while len(self.searches) > 1 and any(search.done for search in self.searches.values()):
            del self.searches[min(self.searches, key=lambda b: len(self.searches[b].paths))]
            self._share_out()

    def _share_out(self) -> None:
        """Share the budget out among the searches."""
        count = sum(len(search.paths) for search in self.searches.values())
        for search in self.searches.values():
            share = self.settings.solves * len(search.paths) // count
            search.settings = replace(self.settings, solves=max(share, 1))

    @property
    def solves(self) -> int:
        """NMPC solves so far."""
        return sum(search.solves for search in self.searches.values())

    @property
    def cost(self) -> int:
        """Largest number of solves of the cheapest next generation."""
        return min(search.cost for search in self.searches.values())

    @property
    def done(self) -> bool:
        """True when every class has used its share."""
        return all(search.done for search in self.searches.values())

    def step(self) -> dict[str, float]:
        """Run one generation of every class that has solves left."""
        figures = [search.step() for search in self.searches.values() if not search.done]
        return {key: float(np.mean([each[key] for each in figures])) for key in figures[0]}

    @property
    def state(self) -> dict[str, Any]:
        """Scores and solves of every class so far, in plain JSON."""
        return {self.bands.names[band]: search.state for band, search in self.searches.items()}

    def replay(self, state: Mapping[str, Any]) -> None:
        """Repeat the searches with the scores of a state."""
        for band, search in self.searches.items():
            search.replay(state[self.bands.names[band]])

    def result(self, provenance: Mapping[str, Any]) -> WeightSchedule:
        """Return a schedule with a set for each class."""
        found = {
            band: weights_at(search.point[0], self.settings.directions, self.settings.span)
            for band, search in self.searches.items()
        }
        rows = [found[min(found, key=lambda b: abs(b - band))] for band in range(len(self.bands))]
        return schedule_of(np.array(rows), provenance)


def evolution(settings: TuningSettings, size: int, seed: int) -> Any:
    """Make a CMA-ES of `size` variables that starts from the default weights, within the span."""
    limit = math.log(settings.span)
    return cma.CMAEvolutionStrategy(
        np.zeros(size), settings.hyperparameters["sigma"],
        {
            # With seed 0, `cma` takes the time.
            "seed": seed + 1, "verbose": -9, "bounds": [-limit, limit], "verb_log": 0,
            "tolfun": 0.0, "tolfunhist": 0.0, "tolx": 0.0,
        },
    )  # fmt: skip
