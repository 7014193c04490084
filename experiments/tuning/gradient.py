"""A table of weights by stochastic gradients of the closed loop's score.

Drives come in pairs that meet the same path, place, vehicle and disturbances, under weights moved
to either side in a random direction; the difference of their scores is the derivative along it, up
to third order. The mean over the pairs, each with its own direction, is the gradient of the
Gaussian-smoothed score (Nesterov and Spokoiny 2017, antithetic), for the price of two drives a
pair, however many weights there are. Adam (Kingma and Ba 2015) descends.
"""

from collections.abc import Sequence

import numpy as np

from experiments.tuning.drives import Array, TuningDrives
from experiments.tuning.search import Search
from experiments.tuning.settings import TuningSettings
from trajectories import ReferencePath


class GradientSearch(Search):
    """Descends from the default weights; the point is the mean of the path's second half."""

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
        """Solves of a step."""
        return self.drives.most

    def ask(self) -> list[Array]:
        """Points to either side of the present one, a pair after another."""
        self._directions = self._random.standard_normal((self.pairs, len(self._now)))
        sigma = self.settings.hyperparameters["sigma"]
        return [self._now + sign * sigma * d for d in self._directions for sign in (1.0, -1.0)]

    def judge(self, points: list[Array], number: int) -> list[float]:
        """Scores of one drive each; the two of a pair are alike but for their weights."""
        count = len(self.drives.bands)
        tables = self.weights_of(np.array(points).reshape(len(points), self.rows, self.entries))
        before = self.drives.solves
        seeds = self.drives.seeds(number)
        scores = self.drives.scores(
            np.broadcast_to(tables, (len(points), count, 10)),
            number,
            [seeds[k // 2] for k in range(len(points))],
        )
        self._solves += self.drives.solves - before
        return [float(score) for score in scores]

    def gradient(self, scores: Sequence[float]) -> Array:
        """Gradient by log-multipliers, (rows * entries,), from the scores of what `ask` gave."""
        values = np.asarray(scores).reshape(self.pairs, 2)
        slopes = (values[:, 0] - values[:, 1]) / (2.0 * self.settings.hyperparameters["sigma"])
        # A drive that fails says that a side is bad, not how steep it is.
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
        """Mean of the second half of where it has been."""
        half = self._past[len(self._past) // 2 :]
        mean: Array = np.mean(half, axis=0) if half else self._now
        return mean.reshape(self.rows, self.entries)
