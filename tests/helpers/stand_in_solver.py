"""Stand-ins for the real-time solver, to test that `lpv-track verify` tells right from wrong.

`StandIn` is correct by other methods: finite differences, a condensed QP by qpOASES, fatrop for the
converged plan. Each of the others has one error.
"""

from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from agents.nmpc.fatrop import FatropSolver
from agents.nmpc.problem import NOMINAL_PERIOD, NmpcProblem, Solution, Status
from experiments.verify.oracles import turns
from lpv_track_env.bicycle import derivative

Array = NDArray[np.float64]
OUTPUTS = [0, 2, 4, 5]


class StandIn:
    def __init__(self, problem: NmpcProblem, *, iterations: int = 1) -> None:
        self.problem = problem
        self.damping = (0.3, 0.2)
        self.iterations = iterations

    def step(self, stage: int, states: Array, inputs: Array) -> Array:
        """Integrate states (6, n) with inputs (2, n) over a stage."""
        steps, car = self.problem.substeps[stage], self.problem.vehicle
        h = self.problem.periods[stage] / steps
        for _ in range(steps):
            k1 = derivative(states, inputs, car)
            k2 = derivative(states + h / 2 * k1, inputs, car)
            k3 = derivative(states + h / 2 * k2, inputs, car)
            k4 = derivative(states + h * k3, inputs, car)
            states = states + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return states

    def linearise(self, state: Array, inputs: Array) -> Any:
        """Differentiate by fourth-order central differences."""
        states, h = [state], 1e-3
        jacobians, rates, rate_jacobians = [], [], []
        moves = np.hstack([k * h * np.eye(8) for k in (-2, -1, 1, 2)])
        stencil = np.array([1.0, -8.0, 8.0, -1.0]) / (12 * h)
        for stage, u in enumerate(inputs):
            z = np.concatenate([states[-1], u])[:, None] + moves
            values = self.step(stage, z[:6], z[6:]).reshape(6, 4, 8)
            jacobians.append(np.einsum("ikj,k->ij", values, stencil))
            speeds = derivative(z[:6], z[6:], self.problem.vehicle)[0].reshape(4, 8)
            rate_jacobians.append(stencil @ speeds)
            rates.append(derivative(states[-1], u, self.problem.vehicle)[0])
            states.append(self.step(stage, states[-1][:, None], u[:, None])[:, 0])
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
        """Solve the condensed QP, in which every x_i is an affine function of the inputs.

        Variables: the moves w = u - inputs (2 N), the slacks (3 N).
        """
        problem, n = self.problem, self.problem.horizon
        car, along = problem.vehicle, self.linearise(state, inputs)
        influence = np.zeros((n + 1, 6, 2 * n))  # dx_i / dw
        for i in range(n):
            influence[i + 1] = along.A[i] @ influence[i]
            influence[i + 1][:, 2 * i : 2 * i + 2] = along.B[i]
        turned = turns(reference)[1:]
        outputs = (turned @ influence[1:][:, OUTPUTS]).reshape(4 * n, 2 * n)
        shares = problem.periods / NOMINAL_PERIOD
        prices = np.concatenate([np.outer(shares[1:], weights[:4]).ravel(), weights[4:8]])
        effort = np.outer(shares, weights[8:10]).ravel()
        smooth = np.outer(1.0 / (problem.spacings * NOMINAL_PERIOD), weights[10:]).ravel()
        unit = np.eye(2 * n)
        change = unit - np.vstack([np.zeros((2, 2 * n)), unit[:-2]])
        before = np.vstack([last_input, inputs[:-1]])
        error = reference[1:] - along.states[1:][:, OUTPUTS]
        error = np.einsum("nij,nj->ni", turned, error).ravel()
        moves = outputs.T @ (prices[:, None] * outputs)
        moves += np.diag(effort + np.tile(self.damping, n))
        moves += change.T @ (smooth[:, None] * change)
        hessian = np.zeros((5 * n, 5 * n))
        hessian[: 2 * n, : 2 * n] = moves
        hessian[2 * n :, 2 * n :] = np.diag(np.outer(shares, problem.quadratic_penalty).ravel())
        effort_slope = effort * inputs.ravel() + change.T @ (smooth * (inputs - before).ravel())
        gradient = np.concatenate(
            [
                effort_slope - outputs.T @ (prices * error),
                np.outer(shares, problem.linear_penalty).ravel(),
            ]
        )

        rates = np.einsum("ij,ijk->ik", along.rate_x, influence[:-1])
        for i in range(n):
            rates[i, 2 * i : 2 * i + 2] += along.rate_u[i]
        vx, vy = influence[1:, 0], influence[1:, 1]
        vx0, vy0 = along.states[1:, 0], along.states[1:, 1]
        ratio = car.max_lateral_velocity_ratio
        slacks = [np.eye(3 * n)[k::3] for k in range(3)]
        free = np.full(n, np.inf)
        nothing = np.zeros((2 * n, 3 * n))
        slow, fast = car.speed_range
        braking, driving = car.longitudinal_acceleration_range
        blocks = [
            (change, nothing, *(sign * problem.input_steps.ravel() - (inputs - before).ravel()
                                for sign in (-1, 1))),
            (rates, slacks[2], braking - along.rate, free),
            (rates, -slacks[2], -free, driving - along.rate),
            (vx, slacks[0], slow - vx0, free),
            (vx, -slacks[0], -free, fast - vx0),
            (ratio * vx - vy, slacks[1], vy0 - ratio * vx0, free),
            (ratio * vx + vy, slacks[1], -vy0 - ratio * vx0, free),
        ]  # fmt: skip
        rows = np.vstack([np.hstack(block[:2]) for block in blocks])
        low_u, high_u = (np.tile(bound, n) - inputs.ravel() for bound in problem.input_bounds)
        shapes = {"h": ca.Sparsity.dense(*hessian.shape), "a": ca.Sparsity.dense(*rows.shape)}
        solver = ca.conic("qp", "qpoases", shapes, {"printLevel": "none", "error_on_fail": False})
        result = solver(
            h=hessian,
            g=gradient,
            a=rows,
            lba=np.concatenate([block[2] for block in blocks]),
            uba=np.concatenate([block[3] for block in blocks]),
            lbx=np.concatenate([low_u, np.zeros(3 * n)]),
            ubx=np.concatenate([high_u, np.full(3 * n, np.inf)]),
        )
        status = Status.SUCCESS if solver.stats()["success"] else Status.QP_FAILURE
        return status, inputs + np.asarray(result["x"]).ravel()[: 2 * n].reshape(n, 2)

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: Any = None,
    ) -> tuple[Solution, Any]:
        if self.iterations > 1:
            exact = FatropSolver(self.problem, tolerance=1e-6)
            return exact.solve(state, last_input, reference, weights, warm)
        held = np.tile(last_input, (self.problem.horizon, 1))
        status, inputs = self.solve_qp(state, last_input, reference, weights, held)
        return Solution(status, inputs, None, None, np.nan, 1, 0.0), None


class WrongDerivative(StandIn):
    """Has the wrong sign in one entry of B."""

    def linearise(self, state: Array, inputs: Array) -> Any:
        along = super().linearise(state, inputs)
        along.B[3, 1, 1] *= -1.0
        return along


class HeldInput(StandIn):
    """Converges to a plan that is not optimal: it holds the last input."""

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
        for stage, u in enumerate(held):
            states.append(self.step(stage, states[-1][:, None], u[:, None])[:, 0])
        slack = np.zeros((len(held), 3))
        return plan._replace(
            status=Status.SUCCESS, inputs=held, states=np.array(states), slack=slack
        ), warm


class Failing(StandIn):
    """Fails in every solve."""

    def solve_qp(self, *parameters: Array) -> tuple[Status, Array]:
        return Status.MAXITER, np.full_like(parameters[-1], np.nan)

    def solve(self, *_: Any) -> tuple[Solution, Any]:
        return Solution(Status.NAN, None, None, None, np.nan, 0, 0.0), None
