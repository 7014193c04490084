"""A weight policy from drives in pairs: reinforcement learning without a critic.

The two drives of a pair meet the same path, start, vehicle and disturbances. Both follow the
policy, each with an offset of its own on its actions, drawn anew every few windows. The difference
of their costs comes from the offsets alone: the noise that a critic would have to explain is the
same in both (common random numbers; Ng and Jordan 2000). `PairedQuadratic` learns from all pairs so
far how the cost depends on actions and features; the policy, one linear layer, moves towards the
action that minimises it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import agents
from agents.weight_tuning import features
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.decision import Decider
from agents.weight_tuning.features import subset_mask
from agents.weight_tuning.policy import WeightPolicy
from agents.weight_tuning.score import FAILED, SCALES, failed, rms_so_far, scores_of, squares_of
from experiments.jobs.job import episode_seed
from experiments.run.store import read_arrays, write_arrays
from experiments.tuning.settings import TuningSettings
from experiments.tuning.tuner import Array, Tuner, choice_of, environments, threads, unusable
from trajectories import ReferencePath

STATE = "paired.npz"
LARGEST = 4.0
"""Limit of a difference of costs, in standard deviations of the noise: failed drives exceed it."""
AVERAGED = 0.3
"""Last share of the budget, whose policies are averaged (Polyak and Juditsky 1992)."""
NOISE = 0.2
"""Standard deviation of the noise of a difference of costs before the first fit."""
BIAS = 1.2
"""Largest constant part of an action; above 1, features can lower a clipped action."""


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


class PairedQuadratic:
    """Quadratic model of the cost over actions and features, fitted to pairs of stretches.

    With u the action (entries,) and x the features of a stretch of driving, the first of them 1::

        cost(u, x) = u' P u / 2 - u' M x + terms without u

    In the difference of two drives that are alike but for u, the terms without u cancel, above all
    the disturbances. The stretch before adds a term in the difference of its actions::

        cost(u, x) - cost(v, x)
            = (u' P u - v' P v) / 2 - (u - v)' M x + c' (u - v of before) + noise

    This is linear in P, M and c: Bayesian linear regression (Bishop 2006, section 3.3) finds them,
    with normal priors around a bowl over the base weights. The best action is linear in the
    features: the cost of an action in its own stretch and in the next one is least at
    P^-1 (M x - c).

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


class PairedLearning(Tuner):
    """Rounds of `settings.drives` / 2 pairs, starting from the base weights."""

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath]) -> None:
        super().__init__(settings)
        if settings.drives % 2:
            raise ValueError(f"paired needs an even number of drives, not {settings.drives}")
        hyper = settings.hyperparameters
        self.choice = choice_of(settings)
        self.envs = environments(settings, paths, settings.drives)
        agent: Any = agents.make("lpv-nmpc", self.envs.single)
        self._decider = Decider(self.choice, (), settings.control_period)
        self.loop = ClosedLoop(self.envs, agent, decider=self._decider, threads=threads())
        names = features.names(self.choice.bands.names)
        # The weights in use follow from the actions u: as features they would count u twice.
        own = np.array([not name.startswith("weight_") for name in names])
        self.seen: Array = subset_mask(settings.view, self.choice.bands.names) * own
        self.pairs = settings.drives // 2
        windows = max(settings.periods // self._decider.window, 1)
        self.hold = min(int(hyper["hold"]), windows)
        self.stretches = windows // self.hold
        self.model = PairedQuadratic(
            self.choice.entries, 1 + len(names), Prior(hyper["curvature"], hyper["response"])
        )
        self.policy = np.zeros((self.choice.entries, 1 + len(names)))
        self._mean, self._averaged = np.zeros_like(self.policy), 0
        self._rounds = self._solves = 0

    @property
    def solves(self) -> int:
        """NMPC solves so far."""
        return self._solves

    @property
    def cost(self) -> int:
        """Largest number of solves of a round."""
        return self.settings.drives * self.stretches * self.hold * self._decider.window

    def step(self) -> dict[str, float]:
        """Run one round: drives of all pairs, then a fit."""
        hyper, before = self.settings.hyperparameters, self._solves
        random = np.random.default_rng((self.settings.seed, self._rounds))
        tally = self._drive_round(random)
        # A pair counts half after `half_life` budgets.
        spent = (self._solves - before) / (hyper["half_life"] * self.settings.solves)
        self.model.forget(0.5**spent)
        best = self.model.best(hyper["least_curvature"])
        self.policy += hyper["step"] * (best - self.policy)
        self.policy[:, 0] = np.clip(self.policy[:, 0], -BIAS, BIAS)
        if self._solves > (1.0 - AVERAGED) * self.settings.solves:
            self._averaged += 1
            self._mean += (self.policy - self._mean) / self._averaged
        self._rounds += 1
        scores = scores_of(tally, self.envs.arrays.ends)
        better = scores.reshape(2, self.pairs).min(axis=0)
        return {"score": float(scores.mean()), "best": float(better.mean())}

    def _drive_round(self, random: np.random.Generator) -> Tally:
        """Drive all pairs once and add them to the model; return the sums of the drives."""
        first = episode_seed(self.settings.seed, self._rounds)
        self.loop.reset(seed=[first + k for k in range(self.pairs)] * 2)
        self.loop.take_in(np.ones(self.settings.drives, dtype=np.bool_))
        sums = np.zeros((len(Tally._fields), self.settings.drives))
        shape = (self.settings.drives, self.choice.entries)
        before = np.zeros((self.pairs, self.choice.entries))
        deviation = self.settings.hyperparameters["deviation"]
        for _ in range(self.stretches):
            running = self.loop.running
            actions, x, driven = self._drive_stretch(deviation * random.standard_normal(shape))
            sums += driven
            costs = self._costs(Tally(*driven), Tally(*sums), running)
            plus, minus = np.split(actions, 2)
            both = running[: self.pairs] & running[self.pairs :]
            most = LARGEST * self.model.noise
            difference = np.clip(costs[: self.pairs] - costs[self.pairs :], -most, most)
            shared = 0.5 * (x[: self.pairs] + x[self.pairs :])
            self.model.add(plus[both], minus[both], shared[both], before[both], difference[both])
            before = plus - minus
        return Tally(*sums)

    def _drive_stretch(self, offsets: Array) -> tuple[Array, Array, Array]:
        """Drive `hold` windows; return mean actions, mean features after a leading 1, the tally."""
        actions, seen = np.zeros_like(offsets), np.zeros((len(offsets), self.policy.shape[1]))
        driven = np.zeros((len(Tally._fields), len(offsets)))
        for _ in range(self.hold):
            x = self._observe()
            action = np.clip(np.clip(x @ self.policy.T, -1.0, 1.0) + offsets, -1.0, 1.0)
            self._choose(action)
            tally = self.loop.drive(self._decider.window, self.loop.memory.tables)
            self.loop.take_in(np.ones(len(offsets), dtype=np.bool_))
            self._solves += int(tally.solves.sum())
            driven += np.array(tally)
            actions += action / self.hold
            seen += x / self.hold
        return actions, seen, driven

    def _observe(self) -> Array:
        """Return a leading 1 and the features that the policy sees, (drives, 1 + features)."""
        x = self._decider.observe(self.envs.arrays.observations, self.loop.memory)
        return np.concatenate([np.ones((len(x), 1)), x * self.seen], axis=1)

    def _choose(self, actions: Array) -> None:
        """Write the weights of the actions into the tables of all bands, for the whole window."""
        for band in range(len(self.choice.bands)):
            bands = np.full(len(actions), band)
            self._decider.choose(actions, self.loop.running, bands, self.loop.memory)

    def _costs(self, stretch: Tally, drive: Tally, running: Array) -> Array:
        """Return what a stretch adds to the score of its drive, to first order, (drives,).

        The score's slope is at the root mean squares of both drives of a pair together, so that an
        error costs the same in either.
        """
        squares = squares_of(drive)
        both = squares[: self.pairs] + squares[self.pairs :]
        steps = drive.steps[: self.pairs] + drive.steps[self.pairs :]
        rho = np.tile(rms_so_far(both, steps, self._decider.window), (2, 1))
        driven = np.maximum(stretch.steps, 1.0)[:, None]
        costs: Array = (0.5 * squares_of(stretch) / driven / rho / SCALES).sum(axis=1)
        costs[failed(self.envs.arrays.ends) & running] += FAILED
        return costs

    def result(self, provenance: Mapping[str, Any]) -> WeightPolicy:
        """Return the mean of the last policies."""
        final = self._mean if self._averaged else self.policy
        layer = ((final[:, 1:] * self.seen).astype(np.float32), final[:, 0].astype(np.float32))
        return WeightPolicy(
            choice=self.choice, layers=(layer,), layout=self.envs.single.layout,
            control_period=self.settings.control_period, algorithm=self.settings.method,
            training=provenance,
        )  # fmt: skip

    def save(self, folder: Path) -> None:
        """Write the model's sums, the policies and the counters."""
        model = self.model
        numbers = [
            self._averaged, self._rounds, self._solves, model.count, model.total, model.noise,
        ]  # fmt: skip
        arrays = {
            "policy": self.policy, "mean": self._mean, "squares": model.squares,
            "products": model.products, "numbers": numbers,
        }  # fmt: skip
        write_arrays(folder / STATE, arrays)

    def read_state(self, folder: Path) -> bool:
        """Read the state that `save` wrote; False if there is none."""
        file = folder / STATE
        if not file.exists():
            return False
        model = self.model
        wanted = {
            "policy": self.policy, "mean": self._mean, "squares": model.squares,
            "products": model.products, "numbers": np.zeros(6),
        }  # fmt: skip
        try:
            content = read_arrays(file)
            kept = {name: content[name] for name in wanted}
            for name, like in wanted.items():
                given = kept[name]
                if given.shape != like.shape or given.dtype != np.float64:
                    raise ValueError(f"its {name} is {given.dtype} {given.shape}")
                if not np.isfinite(given).all():
                    raise ValueError(f"its {name} is not finite")
        except (KeyError, ValueError) as error:
            raise ValueError(unusable(file, str(error))) from None
        self.policy, self._mean = kept["policy"], kept["mean"]
        model.squares, model.products = kept["squares"], kept["products"]
        averaged, rounds, solves, model.count, model.total, model.noise = kept["numbers"].tolist()
        self._averaged, self._rounds, self._solves = int(averaged), int(rounds), int(solves)
        return True
