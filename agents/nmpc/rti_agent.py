"""The LPV-NMPC as an agent in real time: `lpv-nmpc`."""

import copy
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Action, DrivingTask, observation_rows
from agents.nmpc import layout, rti
from agents.nmpc import qp as program
from agents.nmpc.base import Ladder, NmpcAgent
from agents.nmpc.problem import INPUTS, STATES
from agents.nmpc.rti_solver import DAMPING, STATUS, RtiSolver
from agents.nmpc.schedule import NO_BAND, WEIGHTS
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.observation import TrackingObservation
from lpv_track_env.validation import checked_threads
from lpv_track_env.vector_kernels import shares, using_threads
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]


class RtiMemory:
    """What the real-time NMPC remembers of n vehicles: arrays for compiled code, a row a vehicle.

    `plans` (n, N, 2), `flags` (n, FLAGS), `told` (n, TOLD), `states` (n, N + 1, 6) as `rti` has
    them; `actions` (n, 2) of the last step; `bands` (n,) and `weights` (n, 10) in use where a
    schedule chooses, as `switching` has them.
    """

    def __init__(self, rows: int, horizon: int) -> None:
        self.plans = np.zeros((rows, horizon, INPUTS))
        self.flags = np.zeros((rows, rti.FLAGS), dtype=np.int64)
        self.told = np.zeros((rows, program.TOLD))
        self.states = np.zeros((rows, horizon + 1, STATES))
        self.actions = np.zeros((rows, INPUTS))
        self.bands = np.full(rows, NO_BAND)
        self.weights = np.zeros((rows, WEIGHTS))
        self.ladders: dict[int, Ladder] = {}
        """Of rows in which a solve has failed in this episode."""
        self.seconds = 0.0
        """Time of the last step's solves, s, all rows together."""

    def __len__(self) -> int:
        return len(self.plans)

    def __getitem__(self, row: int) -> "RtiRow":
        if not -len(self) <= row < len(self):
            raise IndexError(f"row {row} of {len(self)}")
        return RtiRow(self, row % len(self))

    def take(self, row: int) -> "RtiMemory":
        """Memory of one row alone, on the same arrays; `put` gives the rest of it back."""
        alone = copy.copy(self)
        for name in ("plans", "flags", "told", "states", "actions", "bands", "weights"):
            setattr(alone, name, getattr(self, name)[row : row + 1])
        alone.ladders = {0: self.ladders[row]} if row in self.ladders else {}
        return alone

    def put(self, row: int, alone: "RtiMemory") -> None:
        """Take back a row that was given out by `take`."""
        if 0 in alone.ladders:
            self.ladders[row] = alone.ladders[0]
        self.seconds = alone.seconds * len(self)

    def clear(self, row: int) -> None:
        """Forget a row: a new episode begins there."""
        self.flags[row] = 0
        self.bands[row] = NO_BAND
        self.weights[row] = 0.0
        self.ladders.pop(row, None)


@dataclass(frozen=True)
class RtiRow:
    """One vehicle's part of an `RtiMemory`."""

    memory: RtiMemory
    row: int


class RtiNmpc(NmpcAgent[RtiRow]):
    """The LPV-NMPC of kumar2025lpv by real-time iterations: microseconds a solve.

    The public behaviour is that of `lpv-nmpc-ipopt`, its ladder after failed solves included. A
    batch of observations (n, size) is solved in one compiled call.

    Parameters
    ----------
    task
        What is driven.
    horizon
        N, at most the observation's preview steps (the default).
    weights
        Fixed weights, or a schedule, or the file of one.
    selection
        How a schedule chooses: "band" from the sharpest curvature in the preview at every step, or
        "path" once from the path's sharpest curvature, the paper's rule.
    model
        The prediction model and its constraints, by default the task's own vehicle.
    linear_penalty, quadratic_penalty
        Prices of slack on (vx, vy, vx'), see `NmpcProblem`.
    damping
        Levenberg term on (a, delta), see `RtiSolver`.
    tolerance
        Of the quadratic program.
    max_failures
        Failed solves in a row after which the vehicle is brought to a stop.
    threads
        Threads that share a batch of observations, 1 by default. Results do not depend on it.

    Raises
    ------
    ValueError
        If the horizon is longer than the preview, or a setting is out of range.
    """

    def __init__(
        self,
        task: DrivingTask,
        *,
        horizon: int | None = None,
        weights: TrackingWeights | WeightSchedule | str | Path | None = None,
        selection: str = "band",
        model: VehicleParameters | None = None,
        linear_penalty: tuple[float, float, float] = (20.0, 20.0, 20.0),
        quadratic_penalty: tuple[float, float, float] = (100.0, 100.0, 100.0),
        damping: tuple[float, float] = DAMPING,
        tolerance: float = 1e-12,
        max_failures: int = 10,
        threads: int = 1,
    ) -> None:
        super().__init__(
            task,
            horizon=horizon,
            weights=weights,
            selection=selection,
            model=model,
            linear_penalty=linear_penalty,
            quadratic_penalty=quadratic_penalty,
            max_failures=max_failures,
        )
        self.solver = RtiSolver(self.problem, damping=damping, tolerance=tolerance)
        space = slice(layout.SPACE_LOW_A, layout.SPACE_HIGH_DELTA + 1)
        self.solver.constants[space] = [*self._low, *self._high]
        self._threads = checked_threads(threads)
        self._work = layout.working_space(self.problem.horizon, shares(self._threads))
        self._memory: RtiMemory | None = None
        self._size = task.layout.size
        # Of no rows: so it compiles here, if need be, and not within the first control period.
        memory, none = self._new(0), np.zeros((0, self._size))
        self.switching.choose(none, self.problem.horizon, memory.bands, memory.weights)
        self.solve_rows(none, self.fixed_weights, memory)

    def control(self, observation: TrackingObservation, memory: RtiRow) -> tuple[float, float]:
        """Inputs for one observation, those of `predict`; what it remembers is that row's."""
        flat = np.concatenate([np.ravel(entry) for entry in observation])
        alone = memory.memory.take(memory.row)
        action, _ = self.predict(flat, alone)
        memory.memory.put(memory.row, alone)
        return float(action[0]), float(action[1])

    def new_memory(self) -> RtiRow:
        """Nothing solved yet, for one vehicle."""
        return RtiRow(self._new(1), 0)

    def _new(self, rows: int) -> RtiMemory:
        return RtiMemory(rows, self.problem.horizon)

    def reset(self) -> None:
        """Forget everything: the next call begins new episodes."""
        self._memory = None

    def predict(  # type: ignore[override]
        self,
        observation: NDArray[Any],
        state: RtiMemory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002  part of the protocol
    ) -> tuple[Action, RtiMemory]:
        """Action (2,) for one observation (size,), or (n, 2) for a batch; and the memory.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout.
        """
        rows = observation_rows(observation, self._size)
        n = rows.shape[0]
        memory = self._memory if state is None else state
        if memory is None or len(memory) != n:
            memory = self._new(n)
        if state is None:
            self._memory = memory
        if episode_start is not None and np.asarray(episode_start).any():
            for row in np.flatnonzero(np.broadcast_to(episode_start, (n,))).tolist():
                memory.clear(row)
        if self.has_schedule:
            self.switching.choose(rows, self.problem.horizon, memory.bands, memory.weights)
            weights = memory.weights
        else:
            weights = self.fixed_weights
        began = time.perf_counter()
        failed = self.solve_rows(rows, weights, memory)
        memory.seconds = time.perf_counter() - began
        if memory.ladders or failed:
            self.replace_failed(
                rows, memory, np.flatnonzero(memory.told[:, program.CODE] != program.SUCCESS)
            )
        actions = memory.actions.astype(np.float32)
        return (actions[0] if np.ndim(observation) == 1 else actions), memory

    def solve_rows(self, rows: Array, weights: Array, memory: RtiMemory) -> int:
        """Solve for every row of observations (n, size), `weights` (n or 1, 10), into `memory`.

        How many solves failed; their rows keep the action of the last step.
        """
        stages, lanes = self._work
        arguments = (
            rows, weights, self.solver.constants, memory.plans, memory.flags, memory.told,
            memory.states, memory.actions,
        )  # fmt: skip
        chunks = min(len(stages), len(rows))
        if chunks <= 1:
            return rti.control(0, *arguments, stages[0], lanes[0])
        failed = np.zeros(chunks, dtype=np.int64)
        with using_threads(self._threads):
            rti.control_in_threads(chunks, *arguments, stages, lanes, failed)
        return int(failed.sum())

    def replace_failed(self, rows: Array, memory: RtiMemory, failed: NDArray[np.intp]) -> None:
        """Put what the ladder says in place of the actions of `failed` rows' solves."""
        for ladder in memory.ladders.values():
            ladder.fallback = ""
        for row in failed.tolist():
            ladder = memory.ladders.setdefault(row, self.new_ladder())
            _, planned, age, failures = memory.flags[row].tolist()
            action = self.replace(
                self.task.layout.unpack(rows[row]),
                ladder,
                STATUS[int(memory.told[row, program.CODE])].value,
                memory.plans[row] if planned else None,
                age,
                failures,
            )
            a, delta = np.nan_to_num(action, nan=0.0).tolist()
            rti.bound_action(a, delta, self.solver.constants, memory.actions[row])

    def diagnostics(self, memory: RtiRow) -> dict[str, Any]:
        """Last solve of one vehicle: status, seconds, iterations, cost, slack (3,), plan, weights.

        `weights` (10,) are Q, S, R in use. `plan` (N + 1, 2) holds the predicted positions in the
        frame of the path's foot point; `iterations` are those of the interior-point method;
        `seconds` those of the whole batch, shared out evenly.
        """
        batch, row = memory.memory, memory.row
        told = batch.told[row]
        status = STATUS[int(told[program.CODE])]
        solved = int(told[program.CODE]) == program.SUCCESS
        order = np.array(layout.SLACK_OF)
        ladder = batch.ladders.get(row)
        return {
            "status": status.value,
            "seconds": batch.seconds / len(batch),
            "iterations": int(told[program.INNER]),
            "cost": float(told[program.COST]),
            "slack": told[program.SLACK : program.SLACK + 3][order] if solved else None,
            "fallback": "" if solved or ladder is None else ladder.fallback,
            "plan": batch.states[row, :, 4:].copy() if solved else None,
            "weights": (batch.weights[row] if self.has_schedule else self.fixed_weights[0]).copy(),
        }
