"""Fast solver of the NMPC's problem, compiled: real-time iteration, or SQP to convergence."""

import math
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.nmpc import layout as L
from agents.nmpc import linearisation, qp, rti
from agents.nmpc.linearisation import Linearisation
from agents.nmpc.problem import INPUTS, NOMINAL_PERIOD, STATES, NmpcProblem, Solution, Status
from lpv_track_env import tyres
from lpv_track_env.bicycle import LOW_SPEED, fastest_pole
from trajectories.arguments import Number, Whole, checks_arguments, instance_of, numbers
from trajectories.compilation import compiled

Array = NDArray[np.float64]
Float = Any

STATUS = {
    qp.SUCCESS: Status.SUCCESS,
    qp.MAXITER: Status.MAXITER,
    qp.NOT_FINITE: Status.NAN,
    qp.QP_FAILURE: Status.QP_FAILURE,
}
DAMPING = (0.0, 0.0)
"""Default Levenberg term on (a, delta)."""
STEP_TOLERANCE = 1e-11
"""Change of the inputs below which the plan has converged."""
SHORTEST = 1e-6
"""Shortest step length that is tried."""
DEPTH = 10
"""Steps that Anderson acceleration combines."""
PATIENCE = 8
"""Steps in a row without progress beyond rounding, after which the iteration stops."""


@compiled
def roll_out_cost(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array, constants: Array
) -> Float:
    """Roll the inputs in the stages' STEP out, fill the slacks, and return the exact cost."""
    rti.roll_out(stages, constants)
    return rti.exact_cost(stages, lanes, L.STEP_A, last_a, last_delta, weights, constants)


@compiled
def cost_of_plan(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, weights: Array, constants: Array
) -> Float:
    """Cost of the stages' NOW and of the slacks, after the input (last_a, last_delta) in force."""
    return rti.cost_of(stages, lanes, L.NOW_A, last_a, last_delta, weights, constants)


@compiled
def clamp_step(stages: Array, last_a: Float, last_delta: Float, constants: Array) -> None:
    """Clip the inputs in the stages' STEP to their bounds and rates."""
    qp.clamp(stages, L.STEP_A, last_a, last_delta, constants)


def converge(
    plan: Array,
    solve_qp: Callable[[Array], tuple[Status, Array]],
    cost: Callable[[Array], float],
    bound: Callable[[Array], Array],
    iterations: int,
) -> tuple[Status, Array, int]:
    """Iterate a plan, inputs (N, 2) within their limits, until it no longer changes.

    Iterates the map from a plan to the solution of its QP. Full Gauss-Newton steps can cycle, and
    damped ones converge slowly where the residual is large. Steps are therefore combined by
    Anderson acceleration (Walker and Ni, "Anderson acceleration for fixed-point iterations", SIAM
    J. Numer. Anal. 49, 2011), accepted only if the exact cost decreases, and otherwise shortened
    until it does.

    Parameters
    ----------
    plan
        Start.
    solve_qp
        Returns status and solution of the QP linearised along a plan.
    cost
        Returns the exact cost of a plan.
    bound
        Clips a plan to the limits of its inputs.
    iterations
        Largest number of QPs.

    Returns
    -------
    status
        SUCCESS, or the status of a QP that failed.
    plan
        The best plan found.
    iterations
        Number of QPs solved.
    """
    best = cost(plan)
    plans: list[Array] = []
    steps: list[Array] = []
    idle = 0
    for count in range(1, iterations + 1):
        status, solution = solve_qp(plan)
        if status is not Status.SUCCESS:
            return status, plan, count
        step = solution - plan
        if np.abs(step).max() <= STEP_TOLERANCE:
            return Status.SUCCESS, plan, count
        plans, steps = [*plans, plan][-DEPTH:], [*steps, step][-DEPTH:]
        before = best
        if len(plans) > 1:
            mixed = bound(_mixed(plans, steps))
            found = cost(mixed)
            if found < best:
                plan, best = mixed, found
        length = 1.0
        while best >= before and length > SHORTEST:
            shortened = bound(plan + length * step)
            found = cost(shortened)
            if found < best:
                plan, best = shortened, found
            length *= 0.5
        if best >= before:
            if len(plans) == 1:
                return Status.SUCCESS, plan, count
            plans, steps = [], []
        idle = idle + 1 if before - best <= 1e-15 * abs(before) else 0
        if idle > PATIENCE:
            return Status.SUCCESS, plan, count
    return Status.SUCCESS, plan, iterations


def _mixed(plans: list[Array], steps: list[Array]) -> Array:
    """Next plan of Anderson acceleration: the combination whose step is least, to first order."""
    changes = np.array([b - a for a, b in pairwise(steps)])
    moves = np.array([b - a for a, b in pairwise(plans)])
    shares = np.linalg.lstsq(changes.reshape(len(changes), -1).T, steps[-1].ravel(), rcond=1e-10)[0]
    return plans[-1] + steps[-1] - np.tensordot(shares, moves + changes, axes=1)


class RtiSolver:
    """Solver of the problem by real-time iteration, or by damped SQP to convergence.

    Parameters
    ----------
    problem
        The problem.
    iterations
        Largest number of linearisations per solve: 1 is the real-time iteration, more iterate
        until convergence (`converge`).
    damping
        Levenberg term on (a, delta), added to R about the last plan: it does not change the
        converged plan and keeps full Gauss-Newton steps from cycling.
    tolerance
        Mean product t lam and infeasibility at which a QP counts as solved.
    preview_period
        Spacing of the observations' preview, s, for `rti.control`; by default the first stage's
        length.
    steps_by_speed
        Take as few Runge-Kutta steps a stage as resolve the lateral dynamics at its speed, instead
        of those that are stable at standstill. The model is then not smooth in the speed, so only
        single iterations make use of it.

    Raises
    ------
    ValueError
        For no iterations, a negative damping or a tolerance that is not positive.
    """

    @checks_arguments(
        iterations=Whole(1, 10_000),
        tolerance=Number(0.0, 1.0, above=True),
    )
    def __init__(
        self,
        problem: NmpcProblem,
        *,
        iterations: int = 1,
        damping: tuple[float, float] = DAMPING,
        tolerance: float = 1e-12,
        preview_period: float | None = None,
        steps_by_speed: bool = False,
    ) -> None:
        self.problem = instance_of("problem", problem, NmpcProblem, "an NmpcProblem")
        self.damping = numbers("damping", damping, Number(0.0, 1e9), INPUTS)
        car, order, periods = problem.vehicle, np.array(L.SLACK_OF), problem.periods
        first = periods[0] if problem.first_period is None else problem.first_period
        preview = periods[0] if preview_period is None else preview_period
        self.constants = np.array(
            [
                *car.as_array(),
                fastest_pole(LOW_SPEED, car) if steps_by_speed else 0.0,
                preview,
                problem.preview_steps(preview),
                tolerance,
                *np.concatenate(problem.input_bounds).astype(np.float32),
                problem.input_bounds[0][0],
                *problem.input_bounds[1],
                *car.speed_range,
                *car.longitudinal_acceleration_range,
                car.max_lateral_velocity_ratio,
                *np.array(problem.linear_penalty)[order],
                *np.array(problem.quadratic_penalty)[order],
                *self.damping,
                *tyres.of(car, problem.friction),
                *(math.inf, first, math.inf, math.inf),
                *periods,
                *problem.substeps,
                *(periods / NOMINAL_PERIOD),
                *(1.0 / (problem.spacings * NOMINAL_PERIOD)),
                *problem.input_steps.T.ravel(),
                *problem.passed,
            ],
            dtype=np.float64,
        )
        """As described in `layout`, (CONSTANTS_SIZE + GRID N,)."""
        self._shift = self.constants[-problem.horizon :]
        stages, lanes = L.working_space(problem.horizon, 1)
        self._stages, self._lanes = stages[0], lanes[0]
        self._stats = np.zeros(qp.STATS)
        self._iterations = iterations

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: Array | None = None,
    ) -> tuple[Solution, Array | None]:
        """Solve from `state` (6,), with the input in force (2,) and the weights (12,).

        `reference` is (N + 1, 4). `warm` is the plan that the last solve returned, shifted here by
        one control period; without it the start is the input in force, held. Never raises: the
        status reports failures. The solution's cost is that of its predicted states.
        """
        began = time.perf_counter()
        if self.problem.parameters(state, last_input, reference, weights) is None:
            return Solution(Status.NAN), None
        n = self.problem.horizon
        low, high = self.problem.input_bounds
        last = np.clip(last_input, low, high)
        if warm is None:
            plan = np.tile(last, (n, 1))
        else:
            plan = self.shifted(warm)
        given = state, last, reference, np.ascontiguousarray(weights, dtype=np.float64)
        if self._iterations == 1:
            self._prepare(state, plan, reference)
            code = rti.solve(
                self._stages, self._lanes, float(last[0]), float(last[1]), given[-1],
                self.constants, self._stats,
            )  # fmt: skip
            status, iterations = STATUS[code], int(self._stats[qp.OUTER])
            plan, cost = self._inputs(), float(self._stats[qp.COST])
            found = L.NOW_VX
        else:
            status, plan, iterations = converge(
                self._bounded(plan, last),
                lambda about: self.solve_qp(*given, about),
                lambda inputs: self._cost(inputs, given),
                lambda inputs: self._bounded(inputs, last),
                self._iterations,
            )
            cost = self._cost(plan, given)
            found = L.STEP_VX
        seconds = time.perf_counter() - began
        if status is not Status.SUCCESS:
            return Solution(status, iterations=iterations, seconds=seconds), None
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

    def shifted(self, plan: Array) -> Array:
        """Return a plan (N, 2) moved on by one control period; its end is held."""
        moved = plan.copy()
        moved[:-1] += self._shift[:-1, None] * (plan[1:] - plan[:-1])
        return moved

    def _bounded(self, inputs: Array, last: Array) -> Array:
        """Return inputs (N, 2) clipped to their bounds and rates."""
        tried: Array = self._stages[:-1, L.STEP_A : L.STEP_DELTA + 1]
        tried[:] = inputs
        clamp_step(self._stages, float(last[0]), float(last[1]), self.constants)
        return tried.copy()

    def _cost(self, inputs: Array, given: tuple[Array, Array, Array, Array]) -> float:
        """Exact cost of a plan; leaves its roll-out and slacks in the working space."""
        state, last, reference, weights = given
        self._prepare(state, inputs, reference)
        self._stages[:-1, L.STEP_A : L.STEP_DELTA + 1] = inputs
        before = float(last[0]), float(last[1])
        return float(roll_out_cost(self._stages, self._lanes, *before, weights, self.constants))

    def linearise(self, state: Array, inputs: Array) -> Linearisation:
        """Roll `inputs` (N, 2) out from `state` (6,) and linearise along the roll-out."""
        self._prepare(state, inputs, None)
        linearisation.differentiate_along(self._stages, self.constants)
        return linearisation.unpacked(self._stages)

    def solve_qp(
        self, state: Array, last_input: Array, reference: Array, weights: Array, inputs: Array
    ) -> tuple[Status, Array]:
        """Solve the QP linearised along the roll-out of `inputs` (N, 2): status and inputs."""
        self._prepare(state, inputs, reference)
        linearisation.differentiate_along(self._stages, self.constants)
        status = self._solve_qp(last_input, weights)
        return status, self._inputs()

    def solve_model(
        self, model: Linearisation, last_input: Array, reference: Array, weights: Array,
        inputs: Array,
    ) -> Solution:  # fmt: skip
        """Solve the QP of a linear model along `inputs` (N, 2): x' = states + A dx + B du."""
        began = time.perf_counter()
        linearisation.pack(model, inputs, self._stages)
        self._stages[:, L.REFERENCE : L.REFERENCE_Y + 1] = reference
        self._stats[:] = 0.0
        status = self._solve_qp(last_input, weights)
        turns = int(self._stats[qp.INNER])
        seconds = time.perf_counter() - began
        if status is not Status.SUCCESS:
            return Solution(status, iterations=turns, seconds=seconds)
        before = float(last_input[0]), float(last_input[1])
        cost = cost_of_plan(self._stages, self._lanes, *before, weights, self.constants)
        return Solution(
            status, self._inputs(), self._stages[:, L.NOW_VX : L.NOW_Y + 1].copy(),
            self._slack(), float(cost), turns, seconds,
        )  # fmt: skip

    def _solve_qp(self, last_input: Array, weights: Array) -> Status:
        code = qp.solve_qp(
            self._stages, self._lanes, float(last_input[0]), float(last_input[1]),
            np.ascontiguousarray(weights, dtype=np.float64), self.constants, self._stats,
        )  # fmt: skip
        return STATUS[code]

    def _slack(self) -> Array:
        """Slacks of the solution, (N, 3), in the order of the problem's penalties."""
        rows = np.array(L.SLACKS)[list(L.SLACK_OF)]
        slack: Array = self._lanes[rows].T.copy()
        return slack

    def _prepare(self, state: Array, plan: Array, reference: Array | None) -> None:
        """Write a first state (6,), a plan (N, 2) and a reference (N + 1, 4) to the stages."""
        stages = self._stages
        stages[0, L.PLAN_VX : L.PLAN_Y + 1] = state
        stages[:-1, L.PLAN_A : L.PLAN_DELTA + 1] = plan
        if reference is not None:
            stages[:, L.REFERENCE : L.REFERENCE_Y + 1] = reference

    def _inputs(self) -> Array:
        """Inputs of the solution, (N, 2)."""
        inputs: Array = self._stages[:-1, L.NOW_A : L.NOW_DELTA + 1].copy()
        return inputs
