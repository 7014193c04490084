"""Memory of n vehicles in compiled code, each driven by an NMPC with its own weights."""

import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.delay import FOOT, NearFuture
from agents.nmpc.rti_agent import RtiMemory
from agents.weight_tuning.features import AGE, CLOCK, HISTORY, TAKEN_IN
from lpv_track_env.observation import ACCELERATION, STEERING_ANGLE

Array = NDArray[Any]


class MemoryArrays(NamedTuple):
    """Memory of n vehicles beside their NMPCs', for compiled code."""

    nmpc_observations: Array
    """Last observations as the NMPC was shown them, after delay compensation: (n, size)."""
    commands: Array
    """Commands sent, the last one first, (n, rows, 2)."""
    foot_points: Array
    """Pose of the predicted foot point in the frame of the observed one, (n, FOOT)."""
    history: Array
    """Driving history, (n, HISTORY), see `agents.weight_tuning.features`."""
    delays: Array
    """Settings of the delay compensation (`agents.delay`), of size 0 without it."""


class WeightArrays(NamedTuple):
    """Weights of n vehicles and the rules that choose them, for compiled code."""

    tables: Array
    """Weights of each band, (n, bands, 12), or (1, bands, 12) for all vehicles."""
    rules: Array
    """Rules of switching, see `agents.nmpc.schedule`."""
    bands: Array
    """Present band of each vehicle, (n,)."""
    in_use: Array
    """Weights of the last solve, (n, 12), zeros before the first."""


class LoopMemory:
    """Memory of n vehicles, a row each.

    Parameters
    ----------
    rows
        Number of vehicles, n.
    horizon
        Horizon of the NMPC.
    size
        Size of an observation.
    future
        Delay compensation, if any.
    sets
        Weights of each band that a weight policy starts from, (bands, 12).
    """

    def __init__(
        self, rows: int, horizon: int, size: int, future: NearFuture | None, sets: Array
    ) -> None:
        self.nmpc = RtiMemory(rows, horizon)
        self.nmpc_observations = np.zeros((rows, size))
        self.commands = np.zeros((rows, 1 if future is None else future.kept, 2))
        self.foot_points = np.zeros((rows, FOOT))
        self.history = np.zeros((rows, HISTORY))
        self.tables = np.tile(sets, (rows, 1, 1))
        """Weights of each band that a weight policy has chosen, (n, bands, 12)."""
        self.shape = (horizon, size, self.commands.shape[1], *self.tables.shape[1:])
        self._delays = np.zeros(0) if future is None else future.settings
        self._sets = sets

    def __len__(self) -> int:
        return len(self.nmpc)

    def __getitem__(self, row: int) -> "LoopRow":
        if not -len(self) <= row < len(self):
            raise IndexError(f"row {row} of {len(self)}")
        return LoopRow(self, row % len(self))

    @property
    def arrays(self) -> MemoryArrays:
        """Arrays for compiled code, not copies."""
        return MemoryArrays(
            self.nmpc_observations, self.commands, self.foot_points, self.history, self._delays
        )

    def weights(self, tables: Array, rules: Array) -> WeightArrays:
        """Weights for compiled code: tables and rules, with the bands and weights in use here."""
        return WeightArrays(tables, rules, self.nmpc.bands, self.nmpc.weights)

    def clear(self, row: int, observation: Array) -> None:
        """Reset a row: an episode begins there with an observation."""
        self.nmpc.clear(row)
        # Before the first command the actuators have held their positions.
        actuators = observation[[ACCELERATION, STEERING_ANGLE]]
        self.commands[row] = np.nan_to_num(actuators, posinf=0.0, neginf=0.0)
        self.history[row] = 0.0
        self.tables[row] = self._sets

    def hold(self) -> None:
        """Let a control period pass without an action: every row keeps its last command."""
        self.commands[:, 1:] = self.commands[:, :-1].copy()
        self.history[:, TAKEN_IN] = 0.0
        self.history[:, [CLOCK, AGE]] += 1.0

    def copy(self, rows: Array, onto: Array) -> None:
        """Copy rows `rows` (m,) onto rows `onto` (m,)."""
        nmpc = self.nmpc
        for array in (
            *nmpc.arrays, nmpc.bands, nmpc.weights, self.nmpc_observations, self.commands,
            self.foot_points, self.history, self.tables,
        ):  # fmt: skip
            array[onto] = array[rows]
        # All at once, as the arrays: a row may be both source and target.
        pairs = list(zip(rows.tolist(), onto.tolist(), strict=True))
        copied = {
            other: copy.deepcopy(nmpc.fallbacks[row])
            for row, other in pairs
            if row in nmpc.fallbacks
        }
        for _, other in pairs:
            nmpc.fallbacks.pop(other, None)
        nmpc.fallbacks.update(copied)


@dataclass(frozen=True)
class LoopRow:
    """One vehicle's row of a `LoopMemory`."""

    memory: LoopMemory
    row: int
