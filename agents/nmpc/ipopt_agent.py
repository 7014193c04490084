"""The LPV-NMPC as an agent, solved to convergence: the reference for what is fast."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents.base import DrivingTask
from agents.nmpc.base import Ladder, NmpcAgent
from agents.nmpc.casadi_solver import CasadiSolver
from agents.nmpc.fatrop_solver import FatropSolver
from agents.nmpc.problem import Solution, Status
from agents.nmpc.schedule import NO_BAND, WEIGHTS
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.observation import TrackingObservation
from lpv_track_env.vehicle import VehicleParameters
from trajectories.naming import choose

Array = NDArray[np.float64]

SOLVERS = ("ipopt", "fatrop")


@dataclass
class NmpcMemory:
    """What the NMPC remembers of one vehicle."""

    ladder: Ladder
    warm: Any = None
    """What the solver's last call returned for its next."""
    plan: Array | None = None
    """Inputs (N, 2) of the last plan that was solved."""
    age: int = 0
    """Periods since that plan was made."""
    failures: int = 0
    """Failed solves in a row."""
    band: NDArray[np.int64] = field(default_factory=lambda: np.full(1, NO_BAND))
    weights: Array = field(default_factory=lambda: np.zeros((1, WEIGHTS)))
    """In use, of zeros before the first step."""
    solution: Solution | None = None


class Solver(Protocol):
    """What solves the problem for one vehicle."""

    def solve(
        self, state: Array, last_input: Array, reference: Array, weights: Array, warm: Any = None
    ) -> tuple[Solution, Any]:
        """Solve; what comes back beside the solution is handed to the next call as `warm`."""
        ...


class SolvedNmpc(NmpcAgent[NmpcMemory]):
    """An NMPC on any solver of its problem, one vehicle at a time.

    A failed solve is replaced by, in this order: the last plan's next input; once that plan is
    used up, Stanley's controller on the same observation; after `max_failures` in a row, braking
    with Stanley's steering. Each is counted in `diagnostics`.
    """

    solver: Solver

    def new_memory(self) -> NmpcMemory:
        """Nothing solved yet."""
        return NmpcMemory(self.new_ladder())

    def control(self, observation: TrackingObservation, memory: NmpcMemory) -> tuple[float, float]:
        """First input of the plan, or what replaces it."""
        state, last, reference = self.situation(observation)
        flat = np.concatenate([np.ravel(entry) for entry in observation]).astype(np.float64)
        self.switching.choose(flat[None], self.problem.horizon, memory.band, memory.weights)
        solution, warm = self.solver.solve(state, last, reference, memory.weights[0], memory.warm)
        memory.solution = solution
        if solution.status is Status.SUCCESS and solution.inputs is not None:
            memory.warm, memory.plan, memory.age, memory.failures = warm, solution.inputs, 0, 0
            memory.ladder.fallback = ""
            return float(solution.inputs[0, 0]), float(solution.inputs[0, 1])
        return self._fail(observation, memory, solution.status)

    def control_blind(
        self, observation: TrackingObservation, memory: NmpcMemory
    ) -> tuple[float, float]:
        """An observation that is not finite counts as a failed solve, its status NAN."""
        memory.solution = Solution(Status.NAN, None, None, None, np.nan, 0, 0.0)
        return self._fail(observation, memory, Status.NAN)

    def _fail(
        self, observation: TrackingObservation, memory: NmpcMemory, status: Status
    ) -> tuple[float, float]:
        memory.warm = None
        memory.failures += 1
        memory.age += 1
        return self.replace(
            observation, memory.ladder, status.value, memory.plan, memory.age, memory.failures
        )

    def diagnostics(self, memory: NmpcMemory) -> dict[str, Any]:
        """Last solve of one vehicle: status, seconds, iterations, cost, slack (3,), plan, weights.

        `weights` (10,) are Q, S, R in use. `plan` (N + 1, 2) holds the predicted positions in the
        frame of the path's foot point.
        """
        solution = memory.solution
        if solution is None:
            return {}
        return {
            "status": solution.status.value,
            "seconds": solution.seconds,
            "iterations": solution.iterations,
            "cost": solution.cost,
            "slack": None if solution.slack is None else solution.slack.max(axis=0),
            "fallback": memory.ladder.fallback,
            "plan": None if solution.states is None else solution.states[:, 4:],
            "weights": memory.weights[0].copy(),
        }


class IpoptNmpc(SolvedNmpc):
    """The LPV-NMPC of kumar2025lpv, solved to convergence by IPOPT through CasADi.

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
    tolerance, max_seconds
        The solver's tolerance, and IPOPT's limit on one solve, s. The default is far above any
        solve, which 100 iterations bound: results must not depend on how busy the machine is. Lower
        it to drive by the clock. fatrop has no limit but 200 iterations.
    solver
        "ipopt", or "fatrop" where CasADi was built with it: the same problem, exact as well, its
        stages exploited.
    max_failures
        Failed solves in a row after which the vehicle is brought to a stop.

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
        tolerance: float = 1e-6,
        max_seconds: float = 20.0,
        max_failures: int = 10,
        solver: str = "ipopt",
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
        if choose("solver", solver, SOLVERS) == "fatrop":
            self.solver = FatropSolver(self.problem, tolerance=tolerance)
        else:
            self.solver = CasadiSolver(self.problem, tolerance=tolerance, max_seconds=max_seconds)
