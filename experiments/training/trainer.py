"""What every way of training has in common, for the loop that runs it."""

import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from agents.learned.learner import LearnerVecEnv
from agents.learned.policy import Policy
from experiments.training.seeds import episode_seed
from experiments.training.settings import TrainingSettings

MODULES: dict[str, type[torch.nn.Module]] = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}
"""Of the activations that a policy may have."""

Tick = Callable[[int, str], None]
"""Told how many steps are done, and what is worth saying."""


class Trainer(ABC):
    """A training that goes on segment by segment, each a function of the state it begins with."""

    device: torch.device
    """Where it learns."""

    def __init__(self, settings: TrainingSettings, env: LearnerVecEnv) -> None:
        self.settings, self.env = settings, env
        self.hyper: Mapping[str, Any] = settings.hyperparameters
        self.random = np.random.default_rng(settings.seed)

    @property
    @abstractmethod
    def steps(self) -> int:
        """Environment steps so far."""

    @property
    @abstractmethod
    def solves(self) -> int:
        """NMPC solves so far."""

    @abstractmethod
    def segment(self, number: int, tick: Tick) -> dict[str, float]:
        """Train to the end of a segment; figures worth keeping, by name."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """All that the next segment depends on: tensors and plain values."""

    @abstractmethod
    def restore(self, state: Mapping[str, Any]) -> None:
        """Take a state back."""

    @abstractmethod
    def policy(self, training: Mapping[str, Any]) -> Policy:
        """The policy as it is, with its provenance."""

    def begin_segment(self, number: int) -> None:
        """Seed everything from (seed, segment): a segment does not know what came before."""
        seed = int(np.random.SeedSequence((self.settings.seed, number)).generate_state(1)[0])
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002  where SB3 draws from
        torch.manual_seed(seed)
        self.random = np.random.default_rng(seed)
        self.env.action_space.seed(seed)
        self.env.seed(episode_seed(self.settings, number))

    def rate(self) -> float:
        """Learning rate now: from the first to the last, linear in the steps."""
        first, last = self.hyper["learning_rate"], self.hyper["last_learning_rate"]
        share = min(self.steps / self.settings.steps, 1.0)
        return float(first + share * (last - first))
