"""What every method of tuning has in common, for the loop that runs it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.weight_tuning.policy import WeightPolicy
from agents.weights import WeightSchedule
from experiments.tuning.settings import TuningSettings

Result = WeightSchedule | WeightPolicy


class Tuner(ABC):
    """A tuning that goes on step by step, each a function of the state it begins with."""

    def __init__(self, settings: TuningSettings) -> None:
        self.settings = settings

    @property
    @abstractmethod
    def solves(self) -> int:
        """NMPC solves so far."""

    @property
    @abstractmethod
    def cost(self) -> int:
        """Solves of the next step at most: one that the budget does not allow is not made."""

    @property
    def done(self) -> bool:
        """Whether nothing is left to do within the budget."""
        return self.solves + self.cost > self.settings.solves

    @abstractmethod
    def step(self) -> dict[str, float]:
        """One generation or segment; figures worth keeping, by name."""

    @abstractmethod
    def result(self, provenance: Mapping[str, Any]) -> Result:
        """The weights as they are."""

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write what `restore` goes on from, atomically."""

    @abstractmethod
    def restore(self, folder: Path) -> bool:
        """Take up what `save` wrote; False where there is nothing of it, as before the first step.

        Raises
        ------
        ValueError
            In one line, if the file cannot be used.
        """


def unusable(file: Path, reason: str) -> str:
    """What is said, in one line, of a file that a tuning cannot be resumed from."""
    reason = " ".join(reason.split())
    return f"{file} cannot be used ({reason}): remove it, and the tuning begins anew"
