"""The fast solver of the NMPC's problem: a structured real-time iteration in compiled code."""

import time

import numpy as np
from numpy.typing import NDArray

from agents.nmpc import layout, linearisation, rti, sqp
from agents.nmpc import qp as program
from agents.nmpc.linearisation import Linearisation
from agents.nmpc.problem import STATES, NmpcProblem, Solution, Status

Array = NDArray[np.float64]

STATUS = {
    program.SUCCESS: Status.SUCCESS,
    program.MAXITER: Status.MAXITER,
    program.NOT_FINITE: Status.NAN,
    program.QP_FAILURE: Status.QP_FAILURE,
}
DAMPING = (0.0, 0.0)
"""Levenberg term on (a, delta), by default."""


def limits(problem: NmpcProblem, damping: tuple[float, float]) -> Array:
    """The last of a solver's constants (`layout`): bounds, prices and damping."""
    car = problem.vehicle
    first, steps = problem.input_steps[0], problem.input_steps[-1]
    if problem.horizon == 1:
        steps = first
    order = np.array(layout.SLACK_OF)
    return np.array(
        [
            *car.acceleration_range,
            car.max_steering_angle,
            *steps,
            *first,
            *car.speed_range,
            *car.longitudinal_acceleration_range,
            car.max_lateral_velocity_ratio,
            *np.array(problem.linear_penalty)[order],
            *np.array(problem.quadratic_penalty)[order],
            *damping,
        ]
    )


class RtiSolver:
    """Real-time iteration, or damped sequential programming to convergence, on the problem.

    Parameters
    ----------
    problem
        The problem.
    iterations
        Linearisations a solve: 1 is the real-time iteration, more iterate towards convergence
        (`sqp`) and stop there.
    damping
        Levenberg term on (a, delta), added to R about the last plan: it costs nothing at
        convergence and keeps full Gauss-Newton steps from cycling.
    tolerance
        Mean product t lam and infeasibility at which a quadratic program is solved.

    Raises
    ------
    ValueError
        For no iterations, a negative damping or a tolerance that is not positive.
    """

    def __init__(
        self,
        problem: NmpcProblem,
        *,
        iterations: int = 1,
        damping: tuple[float, float] = DAMPING,
        tolerance: float = 1e-12,
    ) -> None:
        if iterations < 1:
            raise ValueError(f"iterations must be at least 1, not {iterations}")
        if not all(value >= 0.0 for value in damping):
            raise ValueError(f"damping must not be negative, not {damping}")
        if not tolerance > 0.0:
            raise ValueError(f"tolerance must be positive, not {tolerance}")
        self.problem = problem
        self.damping = (float(damping[0]), float(damping[1]))
        first = problem.period if problem.first_period is None else problem.first_period
        self.constants = np.concatenate(
            [
                problem.vehicle.as_array(),
                [
                    problem.period / problem.substeps,
                    problem.substeps,
                    problem.period,
                    min(first / problem.period, 1.0),
                    tolerance,
                ],
                np.concatenate(problem.input_bounds).astype(np.float32),
                limits(problem, self.damping),
            ]
        )
        n = problem.horizon
        stages, lanes = layout.working_space(n, 1)
        self._stages, self._lanes = stages[0], lanes[0]
        self._told = np.zeros(program.TOLD)
        self._iterations = iterations

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: Array | None = None,
    ) -> tuple[Solution, Array | None]:
        """Solve from `state` (6,), with the input in force (2,) and the weights (10,).

        `reference` is (N + 1, 4). `warm` is what the last solve returned, shifted here by one
        control period; without it the input in force is held. Never raises: what goes wrong is in
        the status. The solution's cost is that of its predicted states.
        """
        began = time.perf_counter()
        parameters = np.concatenate([state, last_input, reference.ravel(), weights])
        if not np.isfinite(parameters).all():
            return Solution(Status.NAN, None, None, None, np.nan, 0, 0.0), None
        n = self.problem.horizon
        low, high = self.problem.input_bounds
        last = np.clip(last_input, low, high)
        if warm is None:
            plan = np.tile(last, (n, 1))
        else:
            plan = warm.copy()
            plan[:-1] += self.constants[layout.SHIFT] * (plan[1:] - plan[:-1])
        given = state, last, reference, np.ascontiguousarray(weights, dtype=np.float64)
        if self._iterations == 1:
            self._prepare(state, plan, reference)
            code = rti.solve(
                self._stages, self._lanes, float(last[0]), float(last[1]), given[-1],
                self.constants, self._told,
            )  # fmt: skip
            status, iterations = STATUS[code], int(self._told[program.OUTER])
            plan, cost = self._inputs(), float(self._told[program.COST])
            found = layout.NOW_VX
        else:
            status, plan, iterations = sqp.converge(
                self._bounded(plan, last),
                lambda about: self.solve_qp(*given, about),
                lambda inputs: self._price(inputs, given),
                lambda inputs: self._bounded(inputs, last),
                self._iterations,
            )
            cost = self._price(plan, given)
            found = layout.STEP_VX
        seconds = time.perf_counter() - began
        if status is not Status.SUCCESS:
            return Solution(status, None, None, None, np.nan, iterations, seconds), None
        solution = Solution(
            status,
            plan,
            self._stages[:, found : found + STATES].copy(),
            self._slack(),
            cost,
            iterations,
            seconds,
        )
        return solution, plan

    def _bounded(self, inputs: Array, last: Array) -> Array:
        """Inputs (N, 2) within their bounds and rates."""
        tried: Array = self._stages[:-1, layout.STEP_A : layout.STEP_DELTA + 1]
        tried[:] = inputs
        sqp.bound(self._stages, float(last[0]), float(last[1]), self.constants)
        return tried.copy()

    def _price(self, inputs: Array, given: tuple[Array, Array, Array, Array]) -> float:
        """Exact cost of a plan; its roll-out and slacks are left in the working space."""
        state, _, reference, weights = given
        self._prepare(state, inputs, reference)
        self._stages[:-1, layout.STEP_A : layout.STEP_DELTA + 1] = inputs
        return float(sqp.evaluate(self._stages, self._lanes, weights, self.constants))

    def linearise(self, state: Array, inputs: Array) -> Linearisation:
        """Roll `inputs` (N, 2) out from `state` (6,) and differentiate along the way."""
        self._prepare(state, inputs, None)
        linearisation.differentiate_along(self._stages, self.constants)
        return linearisation.unpacked(self._stages)

    def solve_qp(
        self, state: Array, last_input: Array, reference: Array, weights: Array, inputs: Array
    ) -> tuple[Status, Array]:
        """Solve the program linearised along the roll-out of `inputs` (N, 2); its inputs."""
        self._prepare(state, inputs, reference)
        linearisation.differentiate_along(self._stages, self.constants)
        status = self._solve_program(last_input, weights)
        return status, self._inputs()

    def solve_model(
        self, model: Linearisation, last_input: Array, reference: Array, weights: Array,
        inputs: Array,
    ) -> Solution:  # fmt: skip
        """Solve the program of a linear model along `inputs` (N, 2): x' = states + A dx + B du."""
        began = time.perf_counter()
        linearisation.pack(model, inputs, self._stages)
        self._stages[:, layout.REFERENCE : layout.REFERENCE_Y + 1] = reference
        self._told[:] = 0.0
        status = self._solve_program(last_input, weights)
        turns = int(self._told[program.INNER])
        seconds = time.perf_counter() - began
        if status is not Status.SUCCESS:
            return Solution(status, None, None, None, np.nan, turns, seconds)
        cost = rti.cost_of(self._stages, self._lanes, layout.NOW_A, weights, self.constants)
        return Solution(
            status, self._inputs(), self._stages[:, layout.NOW_VX : layout.NOW_Y + 1].copy(),
            self._slack(), float(cost), turns, seconds,
        )  # fmt: skip

    def _solve_program(self, last_input: Array, weights: Array) -> Status:
        code = program.solve_program(
            self._stages, self._lanes, float(last_input[0]), float(last_input[1]),
            np.ascontiguousarray(weights, dtype=np.float64), self.constants, self._told,
        )  # fmt: skip
        return STATUS[code]

    def _slack(self) -> Array:
        """Slacks of the solution, (N, 3) in the order of the problem's penalties."""
        rows = np.array(layout.SLACKS)[list(layout.SLACK_OF)]
        slack: Array = self._lanes[rows].T.copy()
        return slack

    def _prepare(self, state: Array, plan: Array, reference: Array | None) -> None:
        """Put a first state (6,), a plan (N, 2) and a reference (N + 1, 4) into the stages."""
        stages = self._stages
        stages[0, layout.PLAN_VX : layout.PLAN_Y + 1] = state
        stages[:-1, layout.PLAN_A : layout.PLAN_DELTA + 1] = plan
        if reference is not None:
            stages[:, layout.REFERENCE : layout.REFERENCE_Y + 1] = reference

    def _inputs(self) -> Array:
        """The solution's inputs, (N, 2)."""
        inputs: Array = self._stages[:-1, layout.NOW_A : layout.NOW_DELTA + 1].copy()
        return inputs
