"""The quadratic programme of one real-time iteration, solved by PIQP.

At a roll-out xbar of inputs ubar, with its derivatives (`experiments.verify.derivatives`)::

    min   cost of agents.nmpc.problem + 1/2 sum_i (u_i - ubar_i)' diag(damping) (u_i - ubar_i)
    x_{i+1} = xbar_{i+1} + A_i (x_i - xbar_i) + B_i (u_i - ubar_i),   x_0 = xbar_0
    vx'_i = rate_i + rate_x_i (x_i - xbar_i) + rate_u_i (u_i - ubar_i)

and all constraints of the problem, linear as they are then. Variables, stage by stage: u_i (2),
slack_i (3), x_{i+1} (6). PIQP (Schwan, Jiang, Kuhn, Jones, CDC 2023) is a proximal interior-point
method by other authors, in C++.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from agents.nmpc.problem import INPUTS, SOFT, STATES, NmpcProblem
from experiments.verify.derivatives import Derivatives
from lpv_track_env import lpv

Array = NDArray[np.float64]

STAGE = INPUTS + SOFT + STATES
TOLERANCE, GAP = 1e-10, 1e-11
"""Absolute, on residuals and on the duality gap. Relative ones would not do: a gap of 1e-10 of a
cost in the thousands leaves the first input 1e-4 from its optimum."""


class PiqpOracle:
    """PIQP on the linearised problem.

    Parameters
    ----------
    problem
        The problem.
    damping
        Levenberg's term on (a, delta), (2,).

    Raises
    ------
    ModuleNotFoundError
        If PIQP is not installed.
    """

    def __init__(self, problem: NmpcProblem, damping: tuple[float, float]) -> None:
        try:
            import piqp
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "quadratic programmes are checked by PIQP: pip install 'lpv-track-env[oracles]'"
            ) from error
        self.problem = problem
        self.damping = np.array(damping, dtype=np.float64)
        self._piqp = piqp

    def solve(
        self,
        last_input: Array,
        reference: Array,
        weights: Array,
        inputs: Array,
        along: Derivatives,
    ) -> Array | None:
        """Inputs (N, 2) of the optimum at the roll-out of `inputs` (N, 2), or None.

        None where PIQP could not solve it to `TOLERANCE` and `GAP`.
        """
        hessian, gradient = self._objective(reference, weights, inputs)
        equal, equal_to = self._dynamics(inputs, along)
        rows, low, high = self._constraints(last_input, inputs, along)
        lower, upper = self._bounds()
        solver = self._piqp.SparseSolver()
        settings = solver.settings
        settings.eps_abs, settings.eps_rel = TOLERANCE, 0.0
        settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = GAP, 0.0
        solver.setup(
            sparse.csc_matrix(hessian), gradient, sparse.csc_matrix(equal), equal_to,
            sparse.csc_matrix(rows), low, high, lower, upper,
        )  # fmt: skip
        if solver.solve() != self._piqp.PIQP_SOLVED:
            return None
        plan: Array = solver.result.x.reshape(-1, STAGE)[:, :INPUTS]
        return plan.copy()

    def _objective(self, reference: Array, weights: Array, inputs: Array) -> tuple[Array, Array]:
        n = self.problem.horizon
        q, s, r = weights[:4], weights[4:8], weights[8:]
        hessian, gradient = np.zeros((n * STAGE, n * STAGE)), np.zeros(n * STAGE)
        for i in range(n):
            u, slack, x = _stage(i)
            outputs = s if i == n - 1 else q
            hessian[u, u] = np.diag(r + self.damping)
            hessian[slack, slack] = np.diag(self.problem.quadratic_penalty)
            hessian[x, x] = lpv.C.T @ np.diag(outputs) @ lpv.C
            gradient[u] = -self.damping * inputs[i]
            gradient[slack] = self.problem.linear_penalty
            gradient[x] = -lpv.C.T @ (outputs * reference[i + 1])
        return hessian, gradient

    def _dynamics(self, inputs: Array, along: Derivatives) -> tuple[Array, Array]:
        n = self.problem.horizon
        matrix, vector = np.zeros((n * STATES, n * STAGE)), np.zeros(n * STATES)
        for i in range(n):
            u, _, following = _stage(i)
            rows = slice(i * STATES, (i + 1) * STATES)
            matrix[rows, following] = np.eye(STATES)
            matrix[rows, u] = -along.B[i]
            vector[rows] = along.states[i + 1] - along.B[i] @ inputs[i]
            if i > 0:  # x_0 does not move
                matrix[rows, _stage(i - 1)[2]] = -along.A[i]
                vector[rows] -= along.A[i] @ along.states[i]
        return matrix, vector

    def _constraints(
        self, last_input: Array, inputs: Array, along: Derivatives
    ) -> tuple[Array, Array, Array]:
        """Rows (m, n), lower and upper bounds (m,) of all that is no bound on a variable."""
        problem, car = self.problem, self.problem.vehicle
        rows: list[Array] = []
        low: list[float] = []
        high: list[float] = []

        def row(lower: float, upper: float) -> Array:
            rows.append(np.zeros(problem.horizon * STAGE))
            low.append(lower)
            high.append(upper)
            return rows[-1]

        slow, fast = car.speed_range
        braking, driving = car.longitudinal_acceleration_range
        ratio, infinity = car.max_lateral_velocity_ratio, np.inf
        for i in range(problem.horizon):
            u, slack, x = _stage(i)
            for k in range(INPUTS):
                before = 0.0 if i > 0 else last_input[k]
                change = row(before - problem.input_steps[i, k], before + problem.input_steps[i, k])
                change[u.start + k] = 1.0
                if i > 0:
                    change[u.start - STAGE + k] = -1.0
            # vx' = rest + rate_x x + rate_u u, each side with its slack
            rest = along.rate[i] - along.rate_u[i] @ inputs[i]
            if i > 0:
                rest -= along.rate_x[i] @ along.states[i]
            for sign, bounds in (
                (1.0, (braking - rest, infinity)),
                (-1.0, (-infinity, driving - rest)),
            ):
                rate = row(*bounds)
                rate[u] = along.rate_u[i]
                rate[slack.start + 2] = sign
                if i > 0:
                    rate[_stage(i - 1)[2]] = along.rate_x[i]
            for sign, bounds in ((1.0, (slow, infinity)), (-1.0, (-infinity, fast))):
                speed = row(*bounds)
                speed[x.start], speed[slack.start] = 1.0, sign
            for side in (1.0, -1.0):
                sideslip = row(-infinity, 0.0)
                sideslip[x.start], sideslip[x.start + 1] = -ratio, side
                sideslip[slack.start + 1] = -1.0
        return np.array(rows), np.array(low), np.array(high)

    def _bounds(self) -> tuple[Array, Array]:
        low, high = self.problem.input_bounds
        free = np.full(STATES, np.inf)
        lower = np.concatenate([low, np.zeros(SOFT), -free])
        upper = np.concatenate([high, np.full(SOFT, np.inf), free])
        return np.tile(lower, self.problem.horizon), np.tile(upper, self.problem.horizon)


def _stage(i: int) -> tuple[slice, slice, slice]:
    """Where u_i, slack_i and x_{i+1} stand."""
    start = i * STAGE
    u, slack = start + INPUTS, start + INPUTS + SOFT
    return slice(start, u), slice(u, slack), slice(slack, start + STAGE)
