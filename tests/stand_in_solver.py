"""Solvers with the real-time solver's interface, for the tests of what verifies it.

`StandIn` is right by other means: finite differences, a condensed QP by qpOASES, fatrop for the
converged plan. The others are wrong in one thing each.
"""

from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from agents.nmpc.fatrop_solver import FatropSolver
from agents.nmpc.problem import NmpcProblem, Solution, Status
from lpv_track_env.bicycle import derivative

Array = NDArray[np.float64]
OUTPUTS = [0, 2, 4, 5]


class StandIn:
    def __init__(self, problem: NmpcProblem, *, iterations: int = 1) -> None:
        self.problem = problem
        self.damping = (0.3, 0.2)
        self.iterations = iterations
        self.exact = FatropSolver(problem, tolerance=1e-7)

    def step(self, states: Array, inputs: Array) -> Array:
        """One period from each of states (6, n) with inputs (2, n)."""
        h, car = self.problem.period / self.problem.substeps, self.problem.vehicle
        for _ in range(self.problem.substeps):
            k1 = derivative(states, inputs, car)
            k2 = derivative(states + h / 2 * k1, inputs, car)
            k3 = derivative(states + h / 2 * k2, inputs, car)
            k4 = derivative(states + h * k3, inputs, car)
            states = states + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return states

    def linearise(self, state: Array, inputs: Array) -> Any:
        """Central differences of fourth order."""
        states, h = [state], 1e-3
        jacobians, rates, rate_jacobians = [], [], []
        moves = np.hstack([k * h * np.eye(8) for k in (-2, -1, 1, 2)])
        stencil = np.array([1.0, -8.0, 8.0, -1.0]) / (12 * h)
        for u in inputs:
            z = np.concatenate([states[-1], u])[:, None] + moves
            values = self.step(z[:6], z[6:]).reshape(6, 4, 8)
            jacobians.append(np.einsum("ikj,k->ij", values, stencil))
            speeds = derivative(z[:6], z[6:], self.problem.vehicle)[0].reshape(4, 8)
            rate_jacobians.append(stencil @ speeds)
            rates.append(derivative(states[-1], u, self.problem.vehicle)[0])
            states.append(self.step(states[-1][:, None], u[:, None])[:, 0])
        jacobian, rate_jacobian = np.array(jacobians), np.array(rate_jacobians)
        return SimpleNamespace(
            states=np.array(states),
            A=jacobian[:, :, :6],
            B=jacobian[:, :, 6:],
            rate=np.array(rates),
            rate_x=rate_jacobian[:, :6],
            rate_u=rate_jacobian[:, 6:],
        )

    def solve_qp(
        self, state: Array, last_input: Array, reference: Array, weights: Array, inputs: Array
    ) -> tuple[Status, Array]:
        """Condensed: every x_i is an affine function of the inputs, which qpOASES then chooses."""
        problem, n = self.problem, self.problem.horizon
        along = self.linearise(state, inputs)
        q, s, r = weights[:4], weights[4:8], weights[8:]
        v = ca.SX.sym("v", 2 * n)
        slack = ca.SX.sym("slack", 3 * n)
        influence = np.zeros((n + 1, 6, 2 * n))  # dx_i / du
        for i in range(n):
            influence[i + 1] = along.A[i] @ influence[i]
            influence[i + 1][:, 2 * i : 2 * i + 2] = along.B[i]
        offset = v - inputs.ravel()
        x = [along.states[i] + ca.mtimes(ca.DM(influence[i]), offset) for i in range(n + 1)]
        car = problem.vehicle
        cost: Any = 0
        rows, low, high = [], [], []
        for i in range(n):
            u, moved = v[2 * i : 2 * i + 2], offset[2 * i : 2 * i + 2]
            si = slack[3 * i : 3 * i + 3]
            error = reference[i + 1] - x[i + 1][OUTPUTS]
            cost += 0.5 * ca.dot(s if i == n - 1 else q, error**2) + 0.5 * ca.dot(r, u**2)
            cost += 0.5 * ca.dot(ca.DM(self.damping), moved**2)
            cost += ca.dot(ca.DM(problem.linear_penalty), si)
            cost += 0.5 * ca.dot(ca.DM(problem.quadratic_penalty), si**2)
            rate = along.rate[i] + ca.dot(ca.DM(along.rate_u[i]), moved)
            rate += ca.dot(ca.DM(along.rate_x[i]), x[i] - along.states[i])
            vx, vy = x[i + 1][0], x[i + 1][1]
            ratio = car.max_lateral_velocity_ratio
            before = last_input if i == 0 else v[2 * i - 2 : 2 * i]
            for expression, least, most in (
                (u - before, -problem.input_steps[i], problem.input_steps[i]),
                (rate + si[2], car.longitudinal_acceleration_range[0], np.inf),
                (rate - si[2], -np.inf, car.longitudinal_acceleration_range[1]),
                (vx + si[0], car.speed_range[0], np.inf),
                (vx - si[0], -np.inf, car.speed_range[1]),
                (ratio * vx + si[1] - vy, 0.0, np.inf),
                (ratio * vx + si[1] + vy, 0.0, np.inf),
            ):
                rows.append(expression)
                low.extend(np.broadcast_to(least, expression.shape[0]))
                high.extend(np.broadcast_to(most, expression.shape[0]))
        qp = {"x": ca.vertcat(v, slack), "f": cost, "g": ca.vertcat(*rows)}
        options = {"printLevel": "none", "print_time": False, "error_on_fail": False}
        solver = ca.qpsol("qp", "qpoases", qp, options)
        low_u, high_u = problem.input_bounds
        result = solver(
            lbx=np.concatenate([np.tile(low_u, n), np.zeros(3 * n)]),
            ubx=np.concatenate([np.tile(high_u, n), np.full(3 * n, np.inf)]),
            lbg=low,
            ubg=high,
        )
        status = Status.SUCCESS if solver.stats()["success"] else Status.QP_FAILURE
        return status, np.asarray(result["x"]).ravel()[: 2 * n].reshape(n, 2)

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: Any = None,
    ) -> tuple[Solution, Any]:
        if self.iterations > 1:
            return self.exact.solve(state, last_input, reference, weights, warm)
        held = np.tile(last_input, (self.problem.horizon, 1))
        status, inputs = self.solve_qp(state, last_input, reference, weights, held)
        return Solution(status, inputs, None, None, np.nan, 1, 0.0), None


class WrongDerivative(StandIn):
    """A sign lost in one entry of B."""

    def linearise(self, state: Array, inputs: Array) -> Any:
        along = super().linearise(state, inputs)
        along.B[3, 1, 1] *= -1.0
        return along


class HeldInput(StandIn):
    """Converges to a plan that is no optimum: the input in force, held."""

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: Any = None,
    ) -> tuple[Solution, Any]:
        plan, warm = super().solve(state, last_input, reference, weights, warm)
        held = np.tile(last_input, (self.problem.horizon, 1))
        states = [state]
        for u in held:
            states.append(self.step(states[-1][:, None], u[:, None])[:, 0])
        slack = np.zeros((len(held), 3))
        return plan._replace(
            status=Status.SUCCESS, inputs=held, states=np.array(states), slack=slack
        ), warm


class Failing(StandIn):
    """Solves nothing."""

    def solve_qp(self, *parameters: Array) -> tuple[Status, Array]:
        return Status.MAXITER, np.full_like(parameters[-1], np.nan)

    def solve(self, *_: Any) -> tuple[Solution, Any]:
        return Solution(Status.NAN, None, None, None, np.nan, 0, 0.0), None
