"""What compiled code remembers of n vehicles beside their NMPCs: what they were shown and sent."""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.delay import NearFuture
from agents.delay_kernels import FOOT
from agents.nmpc.rti_agent import RtiMemory
from agents.weight_tuning.watching import AGE, CLOCK, FRESH, WATCH

Array = NDArray[Any]


class LoopMemory:
    """Memories of n vehicles, a row each.

    Parameters
    ----------
    rows
        n.
    horizon
        Of the NMPC.
    size
        Of an observation.
    future
        Delay compensation, if there is any.
    sets
        Weights that a policy begins with, (bands, 10).
    """

    def __init__(
        self, rows: int, horizon: int, size: int, future: NearFuture | None, sets: Array
    ) -> None:
        self.nmpc = RtiMemory(rows, horizon)
        self.looked = np.zeros((rows, size))
        """Last observations as the NMPC was shown them."""
        self.commands = np.zeros((rows, 1 if future is None else future.kept, 2))
        """Those sent, the last one first."""
        self.feet = np.zeros((rows, FOOT))
        self.watched = np.zeros((rows, WATCH))
        """What is noted of each drive, see `agents.weight_tuning.watching`."""
        self._sets = sets
        self.tables = np.tile(sets, (rows, 1, 1))
        """Weights of each band that a policy has chosen, (n, bands, 10)."""

    def __len__(self) -> int:
        return len(self.nmpc)

    def __getitem__(self, row: int) -> "LoopRow":
        if not -len(self) <= row < len(self):
            raise IndexError(f"row {row} of {len(self)}")
        return LoopRow(self, row % len(self))

    def clear(self, row: int, observation: Array) -> None:
        """Forget a row: an episode begins there with an observation."""
        self.nmpc.clear(row)
        # Before the first command the actuators have stood where they are.
        self.commands[row] = np.nan_to_num(observation[3:5], posinf=0.0, neginf=0.0)
        self.watched[row] = 0.0
        self.tables[row] = self._sets

    def send(self, rows: Array) -> None:
        """Remember the actions of some rows as sent."""
        self.commands[rows, 1:] = self.commands[rows, :-1].copy()
        self.commands[rows, 0] = self.nmpc.actions[rows]

    def hold(self) -> None:
        """Let a control period pass without an action: of every row the last command stays."""
        self.commands[:, 1:] = self.commands[:, :-1].copy()
        self.watched[:, FRESH] = 0.0
        self.watched[:, [CLOCK, AGE]] += 1.0

    def copy(self, rows: Array, onto: Array) -> None:
        """Make rows `onto` (m,) those that `rows` (m,) are."""
        nmpc = self.nmpc
        for array in (
            nmpc.plans, nmpc.flags, nmpc.told, nmpc.states, nmpc.actions, nmpc.bands, nmpc.weights,
            self.looked, self.commands, self.feet, self.watched, self.tables,
        ):  # fmt: skip
            array[onto] = array[rows]
        # All at once, as the arrays: a row may be among those that it is copied onto.
        pairs = list(zip(rows.tolist(), onto.tolist(), strict=True))
        copied = {
            other: copy.deepcopy(nmpc.ladders[row]) for row, other in pairs if row in nmpc.ladders
        }
        for _, other in pairs:
            nmpc.ladders.pop(other, None)
        nmpc.ladders.update(copied)


@dataclass(frozen=True)
class LoopRow:
    """One vehicle's part of a `LoopMemory`."""

    memory: LoopMemory
    row: int
