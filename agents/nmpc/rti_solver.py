"""The fast solver of the NMPC's problem: a structured real-time iteration in compiled code."""

import time

import numpy as np
from numpy.typing import NDArray

from agents.nmpc import linearisation, program, qp, rti, sqp
from agents.nmpc.linearisation import Linearisation
from agents.nmpc.problem import INPUTS, STATES, NmpcProblem, Solution, Status

Array = NDArray[np.float64]

STATUS = {
    rti.SUCCESS: Status.SUCCESS,
    rti.MAXITER: Status.MAXITER,
    rti.NOT_FINITE: Status.NAN,
    rti.QP_FAILURE: Status.QP_FAILURE,
}
DAMPING = (0.0, 0.0)
"""Levenberg term on (a, delta), by default."""


def limits(problem: NmpcProblem, damping: tuple[float, float]) -> Array:
    """Numbers of the quadratic program as `program` takes them, (LIMITS_SIZE,)."""
    car = problem.vehicle
    first, steps = problem.input_steps[0], problem.input_steps[-1]
    if problem.horizon == 1:
        steps = first
    order = np.array(program.SLACK_OF)
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
        self._work = np.zeros(rti.space(n))
        self._told = np.zeros(rti.TOLD)
        self._states, self._slack = np.zeros((n + 1, STATES)), np.zeros((3, n))
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
            rti.shift(plan, self.constants[rti.SHIFT])
        given = (
            np.ascontiguousarray(state, dtype=np.float64), last,
            np.ascontiguousarray(reference, dtype=np.float64),
            np.ascontiguousarray(weights, dtype=np.float64),
        )  # fmt: skip
        if self._iterations == 1:
            code = rti.solve(
                *given, self.constants, plan, self._states, self._slack, self._told, self._work
            )
            status, cost = STATUS[code], float(self._told[rti.COST])
            iterations = int(self._told[rti.OUTER])
        else:
            status, plan, iterations = sqp.converge(
                self._bounded(plan, last),
                lambda about: self.solve_qp(*given, about),
                lambda inputs: self._price(inputs, given),
                lambda inputs: self._bounded(inputs, last),
                self._iterations,
            )
            cost = self._price(plan, given)
        seconds = time.perf_counter() - began
        if status is not Status.SUCCESS:
            return Solution(status, None, None, None, np.nan, iterations, seconds), None
        solution = Solution(
            status,
            plan,
            self._states.copy(),
            self._slack[list(program.SLACK_OF)].T.copy(),
            cost,
            iterations,
            seconds,
        )
        return solution, plan

    def _bounded(self, inputs: Array, last: Array) -> Array:
        bounded = np.ascontiguousarray(inputs, dtype=np.float64)
        program.clamp(bounded, last, self.constants[rti.LIMITS :])
        return bounded

    def _price(self, inputs: Array, given: tuple[Array, Array, Array, Array]) -> float:
        """Exact cost of a plan; its roll-out and slack are left in this solver's arrays."""
        state, _, reference, weights = given
        self._states[0] = state
        constants = self.constants
        linearisation.roll_out(
            inputs, constants, constants[rti.STEP], int(constants[rti.SUBSTEPS]), self._states
        )
        return float(sqp.evaluate(self._states, inputs, self._slack, reference, weights, constants))

    def linearise(self, state: Array, inputs: Array) -> Linearisation:
        """Roll `inputs` (N, 2) out from `state` (6,) and differentiate along the way."""
        states, records = self._records(state, inputs)
        return linearisation.unpacked(states, records)

    def solve_qp(
        self, state: Array, last_input: Array, reference: Array, weights: Array, inputs: Array
    ) -> tuple[Status, Array]:
        """Solve the program linearised along the roll-out of `inputs` (N, 2); its inputs."""
        plan = np.ascontiguousarray(inputs, dtype=np.float64)
        base, records = self._records(state, plan)
        n = self.problem.horizon
        found, states, slack = np.zeros((n, INPUTS)), np.zeros((n + 1, STATES)), np.zeros((3, n))
        code, _ = qp.solve_qp(
            records, base, plan, np.asarray(last_input, dtype=np.float64),
            np.ascontiguousarray(reference, dtype=np.float64),
            np.asarray(weights, dtype=np.float64), self.constants[rti.LIMITS :],
            self.constants[rti.TOLERANCE], states, found, slack, self._work,
        )  # fmt: skip
        status = {
            qp.OPTIMAL: Status.SUCCESS,
            qp.OUT_OF_ITERATIONS: Status.MAXITER,
            qp.BROKEN: Status.QP_FAILURE,
        }[code]
        return status, found

    def _records(self, state: Array, inputs: Array) -> tuple[Array, Array]:
        n = len(inputs)
        states, records = np.zeros((n + 1, STATES)), np.zeros((n, linearisation.RECORD))
        states[0] = state
        linearisation.differentiate_along(
            np.ascontiguousarray(inputs, dtype=np.float64), self.constants,
            self.constants[rti.STEP], int(self.constants[rti.SUBSTEPS]), states, records,
            np.zeros(linearisation.SCRATCH),
        )  # fmt: skip
        return states, records
