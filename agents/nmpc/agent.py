"""The LPV-NMPC as an agent: observation to problem, weights, warm start, what to do on failure."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.base import DrivingTask, TrackingAgent
from agents.geometric import Stanley
from agents.nmpc.casadi_solver import CasadiSolver
from agents.nmpc.fatrop_solver import FatropSolver
from agents.nmpc.problem import NmpcProblem, Solution, Status
from agents.reference import local_reference
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.observation import TrackingObservation
from lpv_track_env.task import choose
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]

SOLVERS = ("ipopt", "fatrop")


@dataclass
class NmpcMemory:
    """What the NMPC remembers of one vehicle."""

    warm: Any = None
    """What the solver's last call returned for its next."""
    plan: Array | None = None
    """Inputs (N, 2) of the last plan that was solved."""
    age: int = 0
    """Periods since that plan was made."""
    failures: int = 0
    """Failed solves in a row."""
    band: int | None = None
    solution: Solution | None = None
    fallback: str = ""
    """What replaced a failed solve in the last step: "", "plan", "stanley" or "stop"."""
    counts: Counter[str] = field(default_factory=Counter)
    """Failed solves by status, and fallbacks by name, in this episode."""
    fallback_memory: Any = None


class IpoptNmpc(TrackingAgent[NmpcMemory]):
    """The LPV-NMPC of kumar2025lpv, solved to convergence by IPOPT through CasADi.

    Parameters
    ----------
    task
        What is driven.
    horizon
        N, at most the observation's preview steps (the default).
    weights
        Fixed weights, or a schedule.
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

    A failed solve is replaced by, in this order: the last plan's next input; once that plan is
    used up, Stanley's controller on the same observation; after `max_failures` in a row, braking
    with Stanley's steering. Each is counted in `diagnostics`.

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
        weights: TrackingWeights | WeightSchedule | None = None,
        selection: str = "band",
        model: VehicleParameters | None = None,
        linear_penalty: tuple[float, float, float] = (20.0, 20.0, 20.0),
        quadratic_penalty: tuple[float, float, float] = (100.0, 100.0, 100.0),
        tolerance: float = 1e-6,
        max_seconds: float = 20.0,
        max_failures: int = 10,
        solver: str = "ipopt",
    ) -> None:
        super().__init__(task)
        steps = task.layout.preview_steps
        horizon = steps if horizon is None else horizon
        if horizon > steps:
            raise ValueError(
                f"horizon {horizon} is longer than the preview of {steps} steps: "
                f"make the environment with preview_steps={horizon}"
            )
        if selection not in {"band", "path"}:
            raise ValueError(f"selection must be 'band' or 'path', not {selection!r}")
        self.problem = NmpcProblem(
            vehicle=model or task.vehicle,
            horizon=horizon,
            period=task.layout.preview_period,
            first_period=task.control_period,
            linear_penalty=linear_penalty,
            quadratic_penalty=quadratic_penalty,
        )
        self.solver: CasadiSolver | FatropSolver
        if choose("solver", solver, SOLVERS) == "fatrop":
            self.solver = FatropSolver(self.problem, tolerance=tolerance)
        else:
            self.solver = CasadiSolver(self.problem, tolerance=tolerance, max_seconds=max_seconds)
        self.max_failures = max_failures
        self._fallback = Stanley(task)
        self._schedule: WeightSchedule | None = None
        self._weights = TrackingWeights().as_array()
        self.rejected_weights = 0
        if isinstance(weights, WeightSchedule):
            if selection == "path":
                self.set_weights(weights.for_path(task.path).as_array())
            else:
                self._schedule = weights
        elif weights is not None:
            self.set_weights(weights.as_array())

    def new_memory(self) -> NmpcMemory:
        """Nothing solved yet."""
        return NmpcMemory(fallback_memory=self._fallback.new_memory())

    def set_weights(self, weights: TrackingWeights | ArrayLike) -> bool:
        """Take new weights, (10,) as Q, S, R, from the next step on; the warm start is kept.

        Values out of bounds are clipped to them; a vector that is not finite, negative or of the
        wrong size is refused: the weights stay, `rejected_weights` counts it, False is returned.
        """
        try:
            values = (
                weights
                if isinstance(weights, TrackingWeights)
                else TrackingWeights.from_array(weights)
            )
        except (ValueError, TypeError):
            self.rejected_weights += 1
            return False
        self._weights = values.clipped().as_array()
        return True

    def control(self, observation: TrackingObservation, memory: NmpcMemory) -> tuple[float, float]:
        """First input of the plan, or what replaces it."""
        state, last, reference = self.situation(observation)
        weights = self._weights
        if self._schedule is not None:
            chosen, memory.band = self._schedule.select(
                observation.preview_curvature[: self.problem.horizon], memory.band
            )
            weights = chosen.clipped().as_array()
        solution, warm = self.solver.solve(state, last, reference, weights, memory.warm)
        memory.solution = solution
        if solution.status is Status.SUCCESS and solution.inputs is not None:
            memory.warm, memory.plan, memory.age, memory.failures = warm, solution.inputs, 0, 0
            memory.fallback = ""
            return float(solution.inputs[0, 0]), float(solution.inputs[0, 1])
        memory.counts[solution.status.value] += 1
        return self._replace(observation, memory)

    def control_blind(
        self, observation: TrackingObservation, memory: NmpcMemory
    ) -> tuple[float, float]:
        """An observation that is not finite counts as a failed solve, its status NAN."""
        memory.solution = Solution(Status.NAN, None, None, None, np.nan, 0, 0.0)
        memory.counts[Status.NAN.value] += 1
        return self._replace(observation, memory)

    def situation(self, observation: TrackingObservation) -> tuple[Array, Array, Array]:
        """The problem's parameters from an observation, in the frame of the path's foot point.

        Returns
        -------
        state
            (6,) [vx, vy, psi, r, X, Y]: X is 0 and Y the lateral error.
        last_input
            (2,) [a, delta] in force, within their bounds.
        reference
            (N + 1, 4) [vx, psi, X, Y] at the horizon's nodes.
        """
        low, high = self.problem.input_bounds
        o = observation
        state = np.array(
            [
                o.longitudinal_speed,
                o.lateral_speed,
                o.heading_error,
                o.yaw_rate,
                0.0,
                o.lateral_error,
            ]
        )
        last = np.array([o.acceleration, o.steering_angle]).clip(low, high)
        nodes = local_reference(o, self.problem.period)
        stacked = np.stack([nodes.speed, nodes.heading, nodes.x, nodes.y], axis=-1)
        return state, last, stacked[: self.problem.horizon + 1]

    def _replace(self, observation: TrackingObservation, memory: NmpcMemory) -> tuple[float, float]:
        """Next rung of the ladder after a failed solve; the warm start is dropped."""
        memory.warm = None
        memory.failures += 1
        memory.age += 1
        # Kept up to date on every rung, since Stanley's own memory belongs to a driven episode.
        seen = all(np.isfinite(entry).all() for entry in observation)
        fallback = self._fallback.control if seen else self._fallback.control_blind
        a, delta = fallback(observation, memory.fallback_memory)
        if memory.failures > self.max_failures:
            memory.fallback = "stop"
            a, _ = super().control_blind(observation, memory)
        elif memory.plan is not None and memory.age < len(memory.plan):
            memory.fallback = "plan"
            a, delta = (float(value) for value in memory.plan[memory.age])
        else:
            memory.fallback = "stanley"
        memory.counts[memory.fallback] += 1
        return a, delta

    def diagnostics(self, memory: NmpcMemory) -> dict[str, Any]:
        """Last solve of one vehicle: status, seconds, iterations, cost, slack (3,), plan.

        `plan` (N + 1, 2) holds the predicted positions in the frame of the path's foot point.
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
            "fallback": memory.fallback,
            "plan": None if solution.states is None else solution.states[:, 4:],
        }
