"""The LPV-NMPC in real time: the agent `lpv-nmpc`."""

import copy
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Action, DrivingTask
from agents.inputs import memory_of, observation_rows, started_rows
from agents.nmpc import friction, layout, qp, rti
from agents.nmpc.base import Fallback, NmpcAgent, NmpcSettings
from agents.nmpc.problem import INPUTS, STATES, Status
from agents.nmpc.rti_solver import DAMPING, STATUS, RtiSolver
from agents.nmpc.schedule import NO_BAND
from agents.weights import WEIGHTS
from lpv_track_env.observation import TrackingObservation
from lpv_track_env.validation import checked_threads, forwards_arguments
from lpv_track_env.vector_kernels import shares, using_threads

Array = NDArray[np.float64]


class RtiMemory:
    """Memory of n vehicles of the real-time NMPC: arrays for compiled code, a row a vehicle.

    `plans` to `frictions` are those of `rti.NmpcArrays`; with a schedule, `bands` (n,) and
    `weights` (n, 12) are the bands and weights in use.
    """

    def __init__(self, rows: int, horizon: int) -> None:
        self.shape = (horizon,)
        self.plans = np.zeros((rows, horizon, INPUTS))
        self.flags = np.zeros((rows, rti.FLAGS), dtype=np.int64)
        self.stats = np.zeros((rows, qp.STATS))
        self.states = np.zeros((rows, horizon + 1, STATES))
        self.actions = np.zeros((rows, INPUTS))
        self.frictions = np.zeros((rows, friction.RECORD))
        self.bands = np.full(rows, NO_BAND)
        self.weights = np.zeros((rows, WEIGHTS))
        self.fallbacks: dict[int, Fallback] = {}
        """Fallbacks of the rows in which a solve has failed in this episode."""
        self.seconds = 0.0
        """Time of the last step's solves, s, of all rows together."""

    def __len__(self) -> int:
        return len(self.plans)

    def __getitem__(self, row: int) -> "RtiRow":
        if not -len(self) <= row < len(self):
            raise IndexError(f"row {row} of {len(self)}")
        return RtiRow(self, row % len(self))

    @property
    def arrays(self) -> tuple[Any, Any, Any, Any, Any, Any]:
        """Arrays from the plans to the frictions, as in `rti.NmpcArrays`; not copies."""
        return self.plans, self.flags, self.stats, self.states, self.actions, self.frictions

    def take(self, row: int) -> "RtiMemory":
        """Return the memory of one row, as views of the same arrays; `put` puts it back."""
        alone = copy.copy(self)
        for name in (
            "plans", "flags", "stats", "states", "actions", "frictions", "bands", "weights",
        ):  # fmt: skip
            setattr(alone, name, getattr(self, name)[row : row + 1])
        alone.fallbacks = {0: self.fallbacks[row]} if row in self.fallbacks else {}
        return alone

    def put(self, row: int, alone: "RtiMemory") -> None:
        """Put a row that `take` returned back."""
        if 0 in alone.fallbacks:
            self.fallbacks[row] = alone.fallbacks[0]
        self.seconds = alone.seconds * len(self)

    def clear(self, row: int) -> None:
        """Clear a row: a new episode begins there."""
        self.flags[row] = 0
        self.frictions[row] = 0.0
        self.bands[row] = NO_BAND
        self.weights[row] = 0.0
        self.fallbacks.pop(row, None)


@dataclass(frozen=True)
class RtiRow:
    """One vehicle's row of an `RtiMemory`."""

    memory: RtiMemory
    row: int


class RtiNmpc(NmpcAgent[RtiRow]):
    """The LPV-NMPC of kumar2025lpv by real-time iterations: microseconds a solve.

    It behaves like `lpv-nmpc-ipopt`, also after failed solves. A batch of observations (n, size) is
    solved in one compiled call.

    Parameters
    ----------
    task
        Task of the agent.
    damping
        Levenberg term on (a, delta), see `RtiSolver`.
    tolerance
        Tolerance of the QP.
    threads
        Threads that share a batch of observations, 1 by default. Results do not depend on it.
    settings
        Keyword arguments of `NmpcSettings`, one by one.

    Raises
    ------
    ValueError
        If the horizon is longer than the preview, or a setting is out of range.
    """

    estimating = True

    @forwards_arguments(NmpcSettings)
    def __init__(
        self,
        settings: dict[str, Any],
        task: DrivingTask,
        *,
        damping: tuple[float, float] = DAMPING,
        tolerance: float = 1e-12,
        threads: int = 1,
    ) -> None:
        super().__init__(task, NmpcSettings(**settings))
        self.solver = RtiSolver(
            self.problem, damping=damping, tolerance=tolerance,
            preview_period=task.layout.preview_period, steps_by_speed=True,
        )  # fmt: skip
        space = slice(layout.SPACE_LOW_A, layout.SPACE_HIGH_DELTA + 1)
        self.solver.constants[space] = [*self._low, *self._high]
        known = slice(layout.GRIP, layout.MOST_FRICTION + 1)
        self.solver.constants[known] = self.grip, task.control_period, *self.estimated_range
        self._threads = checked_threads(threads)
        self._work = layout.working_space(self.problem.horizon, shares(self._threads))
        self._memory: RtiMemory | None = None
        self._size = task.layout.size
        # Called with zero rows to trigger compilation here, not in the first control period.
        blank, none = self._new(0), np.zeros((0, self._size))
        self._blank = blank
        self.switching.choose(none, self.preview_steps, blank.bands, blank.weights)
        self.solve_rows(none, self.fixed_weights, blank)
        observation_rows(none, self._size)

    def control(self, observation: TrackingObservation, memory: RtiRow) -> tuple[float, float]:
        """Compute inputs for one observation as `predict` does, with the memory of its row."""
        flat = np.concatenate([np.ravel(entry) for entry in observation])
        alone = memory.memory.take(memory.row)
        action, _ = self.predict(flat, alone)
        memory.memory.put(memory.row, alone)
        return float(action[0]), float(action[1])

    def new_memory(self) -> RtiRow:
        """Create the memory of one vehicle, without a plan."""
        return RtiRow(self._new(1), 0)

    def _new(self, rows: int) -> RtiMemory:
        return RtiMemory(rows, self.problem.horizon)

    def reset(self) -> None:
        """Clear the memory: the next call begins new episodes."""
        self._memory = None

    def predict(  # type: ignore[override]
        self,
        observation: NDArray[Any],
        state: RtiMemory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002  part of the protocol
    ) -> tuple[Action, RtiMemory]:
        """Return the action (2,) for an observation (size,), or (n, 2) for a batch; and the memory.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout.
        TypeError
            If `state` is not the memory of such an agent.
        """
        rows = observation_rows(observation, self._size)
        memory = memory_of(state, self._memory, len(rows), self._blank, self._new)
        if state is None:
            self._memory = memory
        for row in started_rows(episode_start, len(rows)):
            memory.clear(row)
        if self.has_schedule:
            self.switching.choose(rows, self.preview_steps, memory.bands, memory.weights)
            weights = memory.weights
        else:
            weights = self.fixed_weights
        began = time.perf_counter()
        failed = self.solve_rows(rows, weights, memory)
        memory.seconds = time.perf_counter() - began
        if memory.fallbacks or failed:
            failures = np.flatnonzero(memory.stats[:, qp.CODE] != qp.SUCCESS)
            self.replace_failed(rows, memory, failures)
        actions = memory.actions.astype(np.float32)
        return (actions[0] if np.ndim(observation) == 1 else actions), memory

    def solve_rows(self, rows: Array, weights: Array, memory: RtiMemory) -> int:
        """Solve for every row of observations (n, size), with weights (n or 1, 12), into `memory`.

        Returns the number of failed solves; their rows keep the action of the last step.
        """
        stages, lanes = self._work
        arguments = (rows, weights, self.solver.constants, *memory.arrays)
        chunks = min(len(stages), len(rows))
        if chunks <= 1:
            return rti.control(0, *arguments, stages[0], lanes[0])
        failed = np.zeros(chunks, dtype=np.int64)
        with using_threads(self._threads):
            rti.control_in_threads(chunks, *arguments, stages, lanes, failed)
        return int(failed.sum())

    def replace_failed(self, rows: Array, memory: RtiMemory, failed: NDArray[np.intp]) -> None:
        """Replace the actions of the rows whose solves have `failed` (m,) by their fallbacks."""
        for fallback in memory.fallbacks.values():
            fallback.used = ""
        for row in failed.tolist():
            fallback = memory.fallbacks.setdefault(row, self.new_fallback())
            _, planned, age, failures = memory.flags[row].tolist()
            action = self.replace(
                self.task.layout.unpack(rows[row]),
                fallback,
                STATUS[int(memory.stats[row, qp.CODE])].value,
                memory.plans[row] if planned else None,
                age,
                failures,
            )
            rti.bound_action(*action, self.solver.constants, memory.actions[row])

    def diagnostics(self, memory: RtiRow) -> dict[str, Any]:
        """Describe the last solve of one vehicle, see `TrackingAgent.diagnostics`.

        `iterations` counts those of the QP solver; `seconds` is the batch's time divided by its
        rows.
        """
        batch, row = memory.memory, memory.row
        stats = batch.stats[row]
        status = STATUS[int(stats[qp.CODE])]
        solved = status is Status.SUCCESS
        order = np.array(layout.SLACK_OF)
        fallback = batch.fallbacks.get(row)
        return {
            "status": status.value,
            "seconds": batch.seconds / len(batch),
            "iterations": int(stats[qp.INNER]),
            "cost": float(stats[qp.COST]),
            "slack": stats[qp.SLACK : qp.SLACK + 3][order] if solved else None,
            "fallback": "" if solved or fallback is None else fallback.used,
            "plan": batch.states[row, :, 4:].copy() if solved else None,
            "weights": (batch.weights[row] if self.has_schedule else self.fixed_weights[0]).copy(),
            "friction": float(batch.frictions[row, friction.MEAN]) if self.estimated else None,
        }
