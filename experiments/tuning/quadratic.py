"""Quadratic model of the weights' cost, fitted to pairs of drives; its minimum is led by features.

With u the action (entries,) and x the features of a stretch of driving, the first of them 1::

    cost(u, x) = u' P u / 2 - u' M x + terms without u

In the difference of two drives that are alike but for u, the terms without u cancel, above all the
disturbances. The stretch before adds a term in the difference of its actions::

    cost(u, x) - cost(v, x) = (u' P u - v' P v) / 2 - (u - v)' M x + c' (u - v of before) + noise

This is linear in P, M and c: Bayesian linear regression (Bishop 2006, section 3.3) finds them, with
normal priors around a bowl over the base weights. The best action is linear in the features: the
cost of an action in its own stretch and in the next one is least at P^-1 (M x - c).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Prior:
    """Normal priors of P, M and c, in cost per unit of action."""

    curvature: float
    """Mean of P's diagonal, and standard deviation of P's entries."""
    response: float
    """Standard deviation of M's entries, except those of the constant feature."""
    constant: float = 0.5
    """Standard deviation of M's entries of the constant feature."""
    carried: float = 0.1
    """Standard deviation of c."""


NOISE = 0.2
"""Standard deviation of the noise before the first fit."""


class PairedQuadratic:
    """Regression of P, M and c on pairs of stretches.

    Parameters
    ----------
    entries
        Number of entries of an action.
    features
        Number of features of a stretch, including the leading 1.
    prior
        Priors of P, M and c.
    """

    def __init__(self, entries: int, features: int, prior: Prior) -> None:
        self.entries, self.features = entries, features
        self._upper = np.triu_indices(entries)
        diagonal = self._upper[0] == self._upper[1]
        self._half = np.where(diagonal, 0.5, 1.0)
        spread = np.full((entries, features), prior.response)
        spread[:, 0] = prior.constant
        self._mean: Array = np.concatenate(
            [prior.curvature * diagonal, np.zeros(entries * features + entries)]
        )
        upper = np.full(diagonal.size, prior.curvature)
        spreads = [upper, spread.ravel(), np.full(entries, prior.carried)]
        deviations: Array = np.concatenate(spreads)
        self._precision = 1.0 / deviations**2
        size = self._mean.size
        self.squares, self.products = np.zeros((size, size)), np.zeros(size)
        self.count = self.total = 0.0
        self.noise = NOISE

    def forget(self, share: float) -> None:
        """Multiply the influence of all pairs so far by `share`."""
        self.squares *= share
        self.products *= share
        self.count *= share
        self.total *= share

    def add(self, plus: Array, minus: Array, x: Array, before: Array, difference: Array) -> None:
        """Add n pairs.

        Actions u `plus` and v `minus`, and u - v of the stretch before, are (n, entries); features
        `x` (n, features); the differences of cost (n,).
        """
        apart = plus - minus
        rows = np.concatenate(
            [
                self._squares_of(plus) - self._squares_of(minus),
                -(apart[:, :, None] * x[:, None, :]).reshape(len(x), -1),
                before,
            ],
            axis=1,
        )
        self.squares += rows.T @ rows
        self.products += rows.T @ difference
        self.total += float(difference @ difference)
        self.count += len(difference)

    def _squares_of(self, u: Array) -> Array:
        """Return the factors of P's upper entries in u' P u / 2."""
        return u[:, self._upper[0]] * u[:, self._upper[1]] * self._half

    def fit(self) -> tuple[Array, Array, Array]:
        """Fit P (entries, entries), M (entries, features) and c (entries,), and update `noise`."""
        known = self.squares / self.noise**2 + np.diag(self._precision)
        found = np.linalg.solve(known, self.products / self.noise**2 + self._precision * self._mean)
        if self.count > 0.0:
            left = self.total - 2.0 * found @ self.products + found @ self.squares @ found
            self.noise = max(math.sqrt(max(float(left) / self.count, 0.0)), 0.01)
        ends = np.cumsum([self._half.size, self.entries * self.features])
        upper, moved, carried = np.split(found, ends)
        p = np.zeros((self.entries, self.entries))
        p[self._upper] = upper
        p = p + p.T - np.diag(np.diag(p))
        return p, moved.reshape(self.entries, self.features), carried

    def best(self, least: float) -> Array:
        """Return W (entries, features): W x is the best action, with P's eigenvalues >= `least`."""
        p, moved, carried = self.fit()
        moved = moved.copy()
        moved[:, 0] -= carried
        values, vectors = np.linalg.eigh(p)
        w: Array = vectors @ ((vectors.T @ moved) / np.maximum(values, least)[:, None])
        return w
