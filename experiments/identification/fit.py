"""Least squares over windows: Gauss-Newton steps, noise from the residuals, honest covariances.

The windows' initial states are eliminated: each window's residuals and sensitivities are projected
onto what its own initial state cannot explain. The deviations that are reported are the larger of
two: of Gauss-Newton's covariance, right for white noise and a true model, and of the one that
takes each window's score as one draw (cluster-robust, Liang and Zeger, 1986), right for residuals
that are coloured within a window, too.
"""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiments.identification.log import CHANNELS
from experiments.identification.model import (
    BIAS,
    COUNT,
    FRONT,
    LOWER,
    RATIO,
    REAR,
    SCALED,
    SIDESLIP,
    UPPER,
    Predictor,
)
from lpv_track_env.bicycle import STATE_SIZE, VX

Array = NDArray[np.float64]

ROUNDS = 40
"""Largest number of Gauss-Newton steps."""
SETTLED = 1e-3
"""Change of every parameter, by its deviation, at which the steps end."""
SHORTEST_SHARE = 1e-4
"""Smallest share of a Gauss-Newton step that is tried."""
NEGLIGIBLE = 0.02
"""Decrease of the cost that is worth no further step."""
LARGEST_STEP = 0.5
"""Largest change of a logarithm in a step, and of another parameter in its unit."""
HUBER = 4.0
"""Residuals beyond this many deviations count with this many: outliers pull no harder."""
LEAST_NOISE = 1e-9
"""Smallest noise, by the spread of a channel's readings: keeps exact logs computable."""
RANK = 1e-9
"""Singular values of a window's initial state below this share of the largest count as none."""
GUESSED: Mapping[int, float] = {FRONT: 0.5, REAR: 0.5, RATIO: 0.5}
"""Parameters that the nominal vehicle guesses, and the guess's relative deviation: those that the
logs do not tell stay near it, and a change that they tell in combination alone is shared evenly."""
READ_WITH: Mapping[str, tuple[int, float, int | None]] = {
    "yaw_rate": (BIAS, 1.0, None), "vy": (SIDESLIP, 1.0, VX), "heading": (SIDESLIP, -1.0, None),
}  # fmt: skip
"""Offsets of the sensors by channel: the parameter, its sign, and the state that multiplies it."""


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    Parameters
    ----------
    parameters, deviations
        (COUNT,), by `model.PARAMETERS`; the deviation of one that was not fitted is NaN, and those
        of stiffnesses, inertia ratio and gain are relative.
    noise
        Standard deviation of the residuals by channel.
    rows
        Number of readings that were used.
    settled
        True if the steps ended by themselves.
    """

    parameters: Array
    deviations: Array
    noise: dict[str, float]
    rows: int
    settled: bool


class WindowFit:
    """Fits the parameters to the windows of a predictor."""

    def __init__(self, predictor: Predictor, initial: Array, nominal: Array) -> None:
        self.predictor, self.initial, self.nominal = predictor, initial, nominal
        self.channels = tuple(
            name for name in CHANNELS if any(name in one for one in predictor.windows)
        )
        self.rows = sum(len(v) for one in predictor.windows for _, v in one.values())
        spread = {
            name: np.concatenate([one[name][1] for one in predictor.windows if name in one])
            for name in self.channels
        }
        self._least = {
            name: LEAST_NOISE * max(float(np.std(values)), 1e-3) for name, values in spread.items()
        }

    def residuals(self, initial: Array, parameters: Array) -> list[dict[str, tuple[Array, Array]]]:
        """Return, for each window and channel, residuals and their derivatives (n, `BLOCK`)."""
        states, sensitivities = self.predictor.predict(initial, parameters)
        # A trial step that is too long may not stay finite; the cost is inf then.
        sensitivities = np.nan_to_num(sensitivities, nan=0.0, posinf=0.0, neginf=0.0, copy=False)
        found = []
        for k, window in enumerate(self.predictor.windows):
            rows = {}
            for name, (at, values) in window.items():
                column = CHANNELS.index(name)
                expected = states[k, at, column]
                slope = sensitivities[k, at, :, column]
                if name in READ_WITH:
                    place, sign, other = READ_WITH[name]
                    factor = np.full(len(at), sign) if other is None else states[k, at, other]
                    expected = expected + parameters[place] * factor
                    slope = slope.copy()
                    slope[:, STATE_SIZE + place] += factor
                    if other is not None and parameters[place] != 0.0:
                        slope += parameters[place] * sensitivities[k, at, :, other]
                rows[name] = values - expected, -slope
            found.append(rows)
        return found

    def noise_of(self, residuals: list[dict[str, tuple[Array, Array]]]) -> dict[str, float]:
        """Return the residuals' standard deviations by channel; outliers count less."""
        noise = {}
        for name in self.channels:
            errors = np.concatenate([one[name][0] for one in residuals if name in one])
            middle = 1.4826 * float(np.median(np.abs(errors)))
            bounded = np.clip(errors, -HUBER * middle, HUBER * middle) if middle > 0.0 else errors
            lost = STATE_SIZE * len(residuals) / max(self.rows, 1)
            rms = math.sqrt(float(np.mean(bounded**2)) / max(1.0 - lost, 0.1))
            noise[name] = max(rms, self._least[name])
        return noise

    def fit(
        self,
        start: Array,
        free: Collection[int],
        on_round: Callable[[int], None] = lambda _round: None,
    ) -> Fit:
        """Fit the parameters `free` (places in `PARAMETERS`), the others held at `start`."""
        places = np.array(sorted(free), dtype=np.int64)
        parameters, initial = start.copy(), self.initial
        residuals = self.residuals(initial, parameters)
        if not math.isfinite(_cost(residuals, dict.fromkeys(self.channels, 1.0))):
            raise ValueError(
                "the vehicle that the fit starts from does not stay finite over a window: its "
                "axles, its stiffnesses or the log's units are wrong, or windows are too long"
            )
        noise = self.noise_of(residuals)
        share, settled = 1.0, False
        step = _Step(residuals, noise, places, parameters, self.nominal)
        for number in range(ROUNDS):
            on_round(number)
            change, moves = step.solve(parameters)
            tried, states = _moved(parameters, places, share * change), initial + share * moves
            again = self.residuals(states, tried)
            cost = _cost(again, noise) + _distance(places, tried, self.nominal)[0]
            if not cost <= step.cost * (1.0 + 1e-9):  # or not finite
                share *= 0.3
                if share < SHORTEST_SHARE:
                    settled = step.gain(change) <= NEGLIGIBLE
                    break
                continue
            small = np.abs(change) <= SETTLED * np.maximum(step.deviations(), 1e-12)
            gained, whole = step.cost - cost, share == 1.0
            parameters, initial, residuals = tried, states, again
            before, noise = noise, self.noise_of(residuals)
            share = min(3.0 * share, 1.0)
            step = _Step(residuals, noise, places, parameters, self.nominal)
            same = all(abs(noise[k] - before[k]) <= 1e-3 * before[k] for k in noise)
            floor = all(noise[k] <= 10.0 * self._least[k] for k in noise)
            if whole and ((small.all() and (same or floor)) or (same and gained <= NEGLIGIBLE)):
                settled = True
                break
        self.initial = initial
        deviations = np.full(COUNT, np.nan)
        deviations[places] = step.honest_deviations()
        return Fit(parameters, deviations, noise, self.rows, settled)

    def predicted(self, parameters: Array) -> list[dict[str, Array]]:
        """Fit the initial states alone; return the predictions by window and channel."""
        self.fit(parameters, ())
        residuals = self.residuals(self.initial, parameters)
        values = []
        for k, window in enumerate(self.predictor.windows):
            rows = residuals[k]
            values.append({name: read - rows[name][0] for name, (_, read) in window.items()})
        return values


class _Step:
    """Linearised problem at one point: its windows projected, its normal equations."""

    def __init__(
        self,
        residuals: list[dict[str, tuple[Array, Array]]],
        noise: dict[str, float],
        places: NDArray[np.int64],
        parameters: Array,
        nominal: Array,
    ) -> None:
        self._places = places
        scale = np.ones(COUNT)
        scale[list(SCALED)] = parameters[list(SCALED)]
        distance, slope, self._guess = _distance(places, parameters, nominal)
        self.cost = _cost(residuals, noise) + distance
        self._windows = []
        count = len(places)
        self.hessian, self.gradient = np.zeros((count, count)), np.zeros(count)
        scores = np.zeros((len(residuals), count))
        for k, one in enumerate(residuals):
            error = np.concatenate([e / noise[name] for name, (e, _) in one.items()])
            rows = np.concatenate([s / noise[name] for name, (_, s) in one.items()])
            weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.abs(error), 1e-300)))
            error, rows = weight * error, weight[:, None] * rows
            own = rows[:, :STATE_SIZE]
            shared = rows[:, STATE_SIZE + places] * scale[places]
            u, s, vt = np.linalg.svd(own, full_matrices=False)
            kept = s > RANK * max(float(s[0]), 1e-300)
            u, back = u[:, kept], vt[kept].T / s[kept]
            projected = shared - u @ (u.T @ shared)
            rest = error - u @ (u.T @ error)
            self.hessian += projected.T @ projected
            scores[k] = projected.T @ rest
            self._windows.append((back, u.T @ error, u.T @ shared))
        self.gradient = scores.sum(axis=0) + slope
        self.hessian += np.diag(self._guess)
        self._scores = scores

    def gain(self, change: Array) -> float:
        """Return the decrease of the cost that a change of the parameters promises."""
        return -float(self.gradient @ change) / 2.0

    def solve(self, parameters: Array) -> tuple[Array, Array]:
        """Return the changes of the free parameters and of the initial states (W, 6)."""
        held = np.zeros(len(self._places), dtype=bool)
        change = np.zeros(len(self._places))
        for _ in range(len(self._places) + 1):
            change[:] = 0.0
            go = ~held
            if go.any():
                h = self.hessian[np.ix_(go, go)]
                scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
                scaled = h / np.outer(scale, scale)
                change[go] = -np.linalg.lstsq(scaled, self.gradient[go] / scale, 1e-12)[0] / scale
            change = np.clip(change, -LARGEST_STEP, LARGEST_STEP)
            place = self._places
            beyond = ((parameters[place] <= LOWER[place]) & (change < 0.0)) | (
                (parameters[place] >= UPPER[place]) & (change > 0.0)
            )
            if not (beyond & ~held).any():
                break
            held |= beyond
        moves = [-back @ (error + shared @ change) for back, error, shared in self._windows]
        return change, np.array(moves)

    def _covariance(self) -> Array:
        scale = np.sqrt(np.maximum(np.diag(self.hessian), 1e-300))
        inverse = np.linalg.pinv(self.hessian / np.outer(scale, scale), 1e-14, hermitian=True)
        return np.asarray(inverse / np.outer(scale, scale))

    def deviations(self) -> Array:
        """Return the deviations for white noise."""
        return np.sqrt(np.maximum(np.diag(self._covariance()), 0.0))

    def honest_deviations(self) -> Array:
        """Return the larger deviations of white noise and of noise coloured within windows."""
        bread, count = self._covariance(), len(self._scores)
        meat = self._scores.T @ self._scores * (count / max(count - 1, 1)) + np.diag(self._guess)
        robust = np.diag(bread @ meat @ bread)
        unseen = np.diag(self.hessian) <= 1e-20
        worst = np.sqrt(np.maximum(np.maximum(np.diag(bread), robust), 0.0))
        worst[unseen] = math.inf
        return np.asarray(worst)


def _cost(residuals: list[dict[str, tuple[Array, Array]]], noise: dict[str, float]) -> float:
    """Return the cost by Huber's loss; inf where a prediction is not finite."""
    total = 0.0
    for one in residuals:
        for name, (error, _) in one.items():
            size = np.abs(error) / noise[name]
            inside = np.minimum(size, HUBER)
            total += float(np.sum(inside * (size - 0.5 * inside)))
    return total if math.isfinite(total) else math.inf


def _distance(
    places: NDArray[np.int64], parameters: Array, nominal: Array
) -> tuple[float, Array, Array]:
    """Return half the squared distance from `GUESSED`, its gradient and its second derivatives."""
    weights = np.array([GUESSED.get(place, math.inf) for place in places.tolist()]) ** -2.0
    away = np.zeros(len(places))
    guessed = weights > 0.0
    away[guessed] = np.log(parameters[places[guessed]] / nominal[places[guessed]])
    return 0.5 * float(weights @ away**2), weights * away, weights


def _moved(parameters: Array, places: NDArray[np.int64], change: Array) -> Array:
    """Return parameters after a step, within their bounds."""
    moved = parameters.copy()
    for place, step in zip(places.tolist(), change.tolist(), strict=True):
        moved[place] = moved[place] * math.exp(step) if place in SCALED else moved[place] + step
    return np.clip(moved, LOWER, UPPER)
