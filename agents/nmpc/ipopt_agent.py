"""The LPV-NMPC solved to convergence: the reference for the real-time agent."""

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents.base import DrivingTask
from agents.nmpc.base import Fallback, NmpcAgent, NmpcSettings
from agents.nmpc.casadi_solvers import IpoptSolver
from agents.nmpc.fatrop import FatropSolver
from agents.nmpc.problem import Solution, Status
from agents.nmpc.schedule import NO_BAND
from agents.weights import WEIGHTS
from lpv_track_env.observation import TrackingObservation
from lpv_track_env.validation import forwards_arguments
from trajectories.naming import choose

Array = NDArray[np.float64]

SOLVERS = ("ipopt", "fatrop")


@dataclass
class NmpcMemory:
    """Memory of one vehicle."""

    fallback: Fallback
    warm: Any = None
    """Warm start that the solver's last call returned."""
    plan: Array | None = None
    """Inputs (N, 2) of the last plan."""
    age: int = 0
    """Control periods since that plan was made."""
    failures: int = 0
    """Failed solves in a row."""
    band: NDArray[np.int64] = field(default_factory=lambda: np.full(1, NO_BAND))
    weights: Array = field(default_factory=lambda: np.zeros((1, WEIGHTS)))
    """Weights in use, zeros before the first step."""
    solution: Solution | None = None


class Solver(Protocol):
    """Solver of the problem for one vehicle."""

    def solve(
        self, state: Array, last_input: Array, reference: Array, weights: Array, warm: Any = None
    ) -> tuple[Solution, Any]:
        """Return the solution, and the warm start for the next call."""
        ...


class SolvedNmpc(NmpcAgent[NmpcMemory]):
    """An NMPC on any solver of its problem, one vehicle at a time."""

    solver: Solver

    def new_memory(self) -> NmpcMemory:
        """Create the memory of one vehicle, without a plan."""
        return NmpcMemory(self.new_fallback())

    def control(self, observation: TrackingObservation, memory: NmpcMemory) -> tuple[float, float]:
        """Return the first input of the plan, or of the fallback if the solve fails."""
        state, last, reference = self.situation(observation)
        flat = np.concatenate([np.ravel(entry) for entry in observation]).astype(np.float64)
        self.switching.choose(flat[None], self.preview_steps, memory.band, memory.weights)
        weights = self.problem.weights_at(memory.weights[0], float(state[0]))
        solution, warm = self.solver.solve(state, last, reference, weights, memory.warm)
        memory.solution = solution
        if solution.status is Status.SUCCESS and solution.inputs is not None:
            memory.warm, memory.plan, memory.age, memory.failures = warm, solution.inputs, 0, 0
            memory.fallback.used = ""
            return float(solution.inputs[0, 0]), float(solution.inputs[0, 1])
        return self._fail(observation, memory, solution.status)

    def control_blind(
        self, observation: TrackingObservation, memory: NmpcMemory
    ) -> tuple[float, float]:
        """Treat an observation that is not finite as a failed solve with status NAN."""
        memory.solution = Solution(Status.NAN)
        return self._fail(observation, memory, Status.NAN)

    def _fail(
        self, observation: TrackingObservation, memory: NmpcMemory, status: Status
    ) -> tuple[float, float]:
        memory.warm = None
        memory.failures += 1
        memory.age += 1
        return self.replace(
            observation, memory.fallback, status.value, memory.plan, memory.age, memory.failures
        )

    def diagnostics(self, memory: NmpcMemory) -> dict[str, Any]:
        """Describe the last solve of one vehicle, see `TrackingAgent.diagnostics`."""
        solution = memory.solution
        if solution is None:
            return {}
        return {
            "status": solution.status.value,
            "seconds": solution.seconds,
            "iterations": solution.iterations,
            "cost": solution.cost,
            "slack": None if solution.slack is None else solution.slack.max(axis=0),
            "fallback": memory.fallback.used,
            "plan": None if solution.states is None else solution.states[:, 4:],
            "weights": memory.weights[0].copy(),
        }


class IpoptNmpc(SolvedNmpc):
    """The LPV-NMPC of kumar2025lpv, solved to convergence by IPOPT through CasADi.

    Parameters
    ----------
    task
        Task of the agent.
    solver
        "ipopt", or "fatrop" where CasADi was built with it: the same problem, solved exactly too,
        by exploiting its stages.
    tolerance, max_seconds
        Tolerance of the solver, and IPOPT's time limit of a solve, s. The default is far above any
        solve, which 100 iterations bound, so that results do not depend on the machine's load;
        lower it to drive in real time. fatrop has no time limit, but at most 500 iterations.
    settings
        Keyword arguments of `NmpcSettings`, one by one.

    Raises
    ------
    ValueError
        If the horizon is longer than the preview, or a setting is out of range.
    """

    @forwards_arguments(NmpcSettings)
    def __init__(
        self,
        settings: dict[str, Any],
        task: DrivingTask,
        *,
        solver: str = "ipopt",
        tolerance: float = 1e-6,
        max_seconds: float = 20.0,
    ) -> None:
        super().__init__(task, NmpcSettings(**settings))
        if choose("solver", solver, SOLVERS) == "fatrop":
            self.solver = FatropSolver(self.problem, tolerance=tolerance)
        else:
            self.solver = IpoptSolver(self.problem, tolerance=tolerance, max_seconds=max_seconds)
