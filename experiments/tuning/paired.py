"""A weight policy from drives in pairs: reinforcement learning without a critic.

The two of a pair meet the same path, place, vehicle and disturbances; both follow the policy, each
with an offset of its own on its actions, drawn anew every few windows. What their costs differ by
is the offsets' doing: the noise that a critic would have to explain is the same in both (common
random numbers; Ng and Jordan 2000). `PairedQuadratic` learns from all pairs so far how cost depends
on actions and features; the policy, one linear layer, moves towards the best action of that.
"""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import agents
from agents.weight_tuning import features
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.deciding import Decider
from agents.weight_tuning.features import subset_mask
from agents.weight_tuning.policy import WeightPolicy
from agents.weight_tuning.score import FAILED, SCALES, failed, rms_so_far, scores_of, squares_of
from experiments.tuning.choices import choice_of
from experiments.tuning.drives import Array, environments, first_seed, threads
from experiments.tuning.quadratic import PairedQuadratic, Prior
from experiments.tuning.settings import TuningSettings
from experiments.tuning.tuner import Tuner, unusable
from trajectories import ReferencePath
from trajectories.fileio import write_atomically

STATE = "paired.npz"
LARGEST = 4.0
"""Standard deviations of the noise that a difference counts as, at most: failures, breakdowns."""
AVERAGED = 0.3
"""Share of the budget, the last one, whose policies are averaged (Polyak and Juditsky 1992)."""
BIAS = 1.2
"""Largest constant part of an action: the rest is for features to take back."""


class PairedLearning(Tuner):
    """Rounds of `settings.drives` / 2 pairs, from the base weights on."""

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
        # The weights in use are what was chosen: to be told them would be to be told u twice.
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
        """Solves of a round at most."""
        return self.settings.drives * self.stretches * self.hold * self._decider.window

    def step(self) -> dict[str, float]:
        """One round: drives of all pairs, then a fit."""
        hyper, before = self.settings.hyperparameters, self._solves
        random = np.random.default_rng((self.settings.seed, self._rounds))
        tally = self._drive_round(random)
        # What counts half when the budget is spent once more `half_life`.
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
        """Drive all pairs once and add what they tell; sums over the drives."""
        first = first_seed(self.settings, self._rounds)
        self.loop.reset(seed=[first + k for k in range(self.pairs)] * 2)
        self.loop.attend(np.ones(self.settings.drives, dtype=np.bool_))
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
        """Drive `hold` windows: mean actions, mean features with a leading 1, and the tally."""
        actions, seen = np.zeros_like(offsets), np.zeros((len(offsets), self.policy.shape[1]))
        driven = np.zeros((len(Tally._fields), len(offsets)))
        for _ in range(self.hold):
            x = self._observe()
            action = np.clip(np.clip(x @ self.policy.T, -1.0, 1.0) + offsets, -1.0, 1.0)
            self._choose(action)
            tally = self.loop.drive(self._decider.window, self.loop.memory.tables)
            self.loop.attend(np.ones(len(offsets), dtype=np.bool_))
            self._solves += int(tally.solves.sum())
            driven += np.array(tally)
            actions += action / self.hold
            seen += x / self.hold
        return actions, seen, driven

    def _observe(self) -> Array:
        """Features that are seen, a leading 1, (drives, 1 + features)."""
        x = self._decider.observe(self.envs.arrays.observations, self.loop.memory)
        return np.concatenate([np.ones((len(x), 1)), x * self.seen], axis=1)

    def _choose(self, actions: Array) -> None:
        """Write what actions mean into the tables, for all bands: none ends a window here."""
        for band in range(len(self.choice.bands)):
            bands = np.full(len(actions), band)
            self._decider.choose(actions, self.loop.running, bands, self.loop.memory)

    def _costs(self, stretch: Tally, drive: Tally, running: Array) -> Array:
        """What a stretch adds to the score of its drive, to first order, (drives,).

        The drive's root mean squares are those of both of a pair: a bad one is not forgiven.
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
        """The mean of the last policies."""
        final = self._mean if self._averaged else self.policy
        layer = ((final[:, 1:] * self.seen).astype(np.float32), final[:, 0].astype(np.float32))
        return WeightPolicy(
            choice=self.choice, layers=(layer,), layout=self.envs.single.layout,
            control_period=self.settings.control_period, algorithm=self.settings.method,
            training=provenance,
        )  # fmt: skip

    def save(self, folder: Path) -> None:
        """Write sums, policies and counters."""
        buffer, model = io.BytesIO(), self.model
        np.savez(
            buffer, policy=self.policy, mean=self._mean, squares=model.squares,
            products=model.products,
            numbers=[self._averaged, self._rounds, self._solves, model.count, model.total,
                     model.noise],
        )  # fmt: skip
        write_atomically(folder / STATE, buffer.getvalue())

    def restore(self, folder: Path) -> bool:
        """Take up what `save` wrote; False where there is nothing of it."""
        file = folder / STATE
        if not file.exists():
            return False
        model = self.model
        wanted = {
            "policy": self.policy, "mean": self._mean, "squares": model.squares,
            "products": model.products, "numbers": np.zeros(6),
        }  # fmt: skip
        try:
            with np.load(file, allow_pickle=False) as content:
                kept = {name: content[name] for name in wanted}
            for name, like in wanted.items():
                given = kept[name]
                if given.shape != like.shape or given.dtype != np.float64:
                    raise ValueError(f"its {name} is {given.dtype} {given.shape}")
                if not np.isfinite(given).all():
                    raise ValueError(f"its {name} is not finite")
        except KeyError as error:
            raise ValueError(unusable(file, str(error))) from None
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(unusable(file, str(error))) from None
        self.policy, self._mean = kept["policy"], kept["mean"]
        model.squares, model.products = kept["squares"], kept["products"]
        averaged, rounds, solves, model.count, model.total, model.noise = kept["numbers"].tolist()
        self._averaged, self._rounds, self._solves = int(averaged), int(rounds), int(solves)
        return True
