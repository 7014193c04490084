"""Oracles independent of the real-time solver: cost of a plan, exact derivatives, QP by PIQP."""

from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from agents.nmpc.casadi_solvers import lpv_field, stage_models
from agents.nmpc.linearisation import Linearisation
from agents.nmpc.problem import INPUTS, NOMINAL_PERIOD, SOFT, STATES, NmpcProblem
from lpv_track_env import lpv
from lpv_track_env.bicycle import PSI, VX, VY, X, Y, derivative

Array = NDArray[np.float64]

STAGE = INPUTS + SOFT + STATES
"""Variables per stage of the QP: u_i (2), slack_i (3), x_{i+1} (6)."""
TOLERANCE, GAP = 1e-10, 3e-11
"""Absolute tolerances of PIQP's residuals and duality gap. Relative ones do not suffice: at a cost
in the thousands, a relative gap of 1e-10 leaves the first input 1e-4 from its optimum. A gap of
1e-11 is not reached in one problem of fifteen, for rounding."""


class PlanCost(NamedTuple):
    """Cost of a plan and its constraint violations."""

    cost: float
    """Objective of `agents.nmpc.problem` with the least slack that the soft constraints need."""
    slack: Array
    """(N, 3): violations of the bounds on vx_{i+1} (m/s), vy_{i+1} (m/s), vx'(x_i, u_i) (m/s^2)."""
    excess: float
    """Largest violation of the hard bounds on u and its change, m/s^2 or rad; 0 if none."""


def rolled_out(problem: NmpcProblem, state: Array, inputs: Array) -> Array:
    """Return the states (N + 1, 6) of inputs (N, 2) from a state (6,), by classic Runge-Kutta."""
    car = problem.vehicle
    states = np.empty((len(inputs) + 1, len(state)))
    states[0] = x = np.asarray(state, dtype=np.float64)
    for i, u in enumerate(inputs):
        h = problem.periods[i] / problem.substeps[i]
        for _ in range(problem.substeps[i]):
            k1 = derivative(x, u, car, problem.friction)
            k2 = derivative(x + 0.5 * h * k1, u, car, problem.friction)
            k3 = derivative(x + 0.5 * h * k2, u, car, problem.friction)
            k4 = derivative(x + h * k3, u, car, problem.friction)
            x = x + h * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
        states[i + 1] = x
    return states


def plan_cost(
    problem: NmpcProblem,
    state: Array,
    last_input: Array,
    reference: Array,
    weights: Array,
    inputs: Array,
) -> PlanCost:
    """Compute the cost of inputs (N, 2) in NumPy; other arguments as in a solver's `solve`.

    The penalties grow with the slack, so the least feasible slack is optimal, and the cost of an
    optimal plan equals the solver's objective.
    """
    x, car = rolled_out(problem, state, inputs), problem.vehicle
    q, s, r, r_rate = np.split(weights, (4, 8, 10))
    share = problem.periods[:, None] / NOMINAL_PERIOD
    error = np.einsum("nij,nj->ni", turns(reference), reference - x[:, [VX, PSI, X, Y]])
    tracking = 0.5 * np.sum(share * error[:-1] ** 2 * q) + 0.5 * np.sum(error[-1] ** 2 * s)
    effort = 0.5 * np.sum(share * inputs**2 * r)
    steps = np.diff(np.vstack([last_input, inputs]), axis=0)
    spacing = problem.spacings[:, None]
    effort += 0.5 * np.sum(spacing / NOMINAL_PERIOD * (steps / spacing) ** 2 * r_rate)

    slow, fast = car.speed_range
    braking, driving = car.longitudinal_acceleration_range
    vx, vy = x[1:, VX], x[1:, VY]
    rate = derivative(x[:-1].T, inputs.T, car, problem.friction)[VX]
    beyond = [
        np.maximum(slow - vx, vx - fast),
        np.abs(vy) - car.max_lateral_velocity_ratio * vx,
        np.maximum(braking - rate, rate - driving),
    ]
    slack = np.maximum(np.column_stack(beyond), 0.0)
    penalty = np.sum(share * slack * problem.linear_penalty)
    penalty += 0.5 * np.sum(share * slack**2 * problem.quadratic_penalty)

    low, high = problem.input_bounds
    over = [low - inputs, inputs - high, np.abs(steps) - problem.input_steps]
    excess = max(0.0, *(float(values.max()) for values in over))
    return PlanCost(float(tracking + effort + penalty), slack, excess)


def turns(reference: Array) -> Array:
    """Return the matrices (N + 1, 4, 4) that turn errors of position along and across the path."""
    matrices = np.tile(np.eye(4), (len(reference), 1, 1))
    c, s = np.cos(reference[:, 1]), np.sin(reference[:, 1])
    matrices[:, 2, 2], matrices[:, 2, 3], matrices[:, 3, 2], matrices[:, 3, 3] = c, s, -s, c
    return matrices


class CasadiDerivatives:
    """Linearisation of a problem's discrete model by CasADi's automatic differentiation."""

    def __init__(self, problem: NmpcProblem) -> None:
        x, u = ca.SX.sym("x", STATES), ca.SX.sym("u", INPUTS)
        rate = lpv_field(x, u, problem)[0]
        made: dict[float, ca.Function] = {}
        for length, model in zip(problem.periods, stage_models(problem), strict=True):
            outputs = [
                expression
                for value in (model(x, u), rate)
                for expression in (value, ca.jacobian(value, x), ca.jacobian(value, u))
            ]
            made[length] = ca.Function("derivatives", [x, u], outputs)
        self._functions = [made[length] for length in problem.periods]

    def along(self, state: Array, inputs: Array) -> Linearisation:
        """Roll the inputs (N, 2) out from a state (6,) and differentiate at every step."""
        n = len(inputs)
        result = Linearisation(
            np.empty((n + 1, STATES)),
            np.empty((n, STATES, STATES)),
            np.empty((n, STATES, INPUTS)),
            np.empty(n),
            np.empty((n, STATES)),
            np.empty((n, INPUTS)),
        )
        result.states[0] = state
        for i, u in enumerate(inputs):
            values = [np.asarray(value) for value in self._functions[i](result.states[i], u)]
            result.states[i + 1] = values[0].ravel()
            result.A[i], result.B[i], result.rate[i] = values[1], values[2], values[3].item()
            result.rate_x[i], result.rate_u[i] = values[4].ravel(), values[5].ravel()
        return result


class PiqpOracle:
    """Quadratic program of one real-time iteration, solved by PIQP.

    At a roll-out xbar of inputs ubar, with its derivatives::

        min   cost of agents.nmpc.problem + 1/2 sum_i (u_i - ubar_i)' diag(damping) (u_i - ubar_i)
        x_{i+1} = xbar_{i+1} + A_i (x_i - xbar_i) + B_i (u_i - ubar_i),   x_0 = xbar_0
        vx'_i = rate_i + rate_x_i (x_i - xbar_i) + rate_u_i (u_i - ubar_i)

    and all constraints of the problem, which are then linear. PIQP (Schwan, Jiang, Kuhn, Jones, CDC
    2023) is a proximal interior-point method by other authors, in C++.

    Parameters
    ----------
    problem
        The NMPC's problem.
    damping
        Levenberg-Marquardt term on (a, delta), (2,).

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
                "quadratic programs are checked by PIQP: pip install 'lpv-track-env[oracles]'"
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
        along: Linearisation,
    ) -> Array | None:
        """Return the optimal inputs (N, 2) for the roll-out of `inputs` (N, 2).

        Returns None if PIQP does not reach `TOLERANCE` and `GAP`.
        """
        hessian, gradient = self._objective(last_input, reference, weights, inputs)
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

    def _objective(
        self, last_input: Array, reference: Array, weights: Array, inputs: Array
    ) -> tuple[Array, Array]:
        """Return Hessian (n, n) and gradient (n,)."""
        n, shares = self.problem.horizon, self.problem.periods / NOMINAL_PERIOD
        q, s, r, r_rate = np.split(weights, (4, 8, 10))
        turned = turns(reference)
        hessian, gradient = np.zeros((n * STAGE, n * STAGE)), np.zeros(n * STAGE)
        for i in range(n):
            u, slack, x = _stage(i)
            outputs = s if i == n - 1 else q * shares[i + 1]
            hessian[u, u] += np.diag(r * shares[i] + self.damping)
            hessian[slack, slack] = np.diag(self.problem.quadratic_penalty) * shares[i]
            price = turned[i + 1].T @ np.diag(outputs) @ turned[i + 1]
            hessian[x, x] = lpv.C.T @ price @ lpv.C
            gradient[u] += -self.damping * inputs[i]
            gradient[slack] = np.array(self.problem.linear_penalty) * shares[i]
            gradient[x] = -lpv.C.T @ price @ reference[i + 1]
            smooth = r_rate / (self.problem.spacings[i] * NOMINAL_PERIOD)
            hessian[u, u] += np.diag(smooth)
            if i == 0:
                gradient[u] -= smooth * last_input
            else:
                before = _stage(i - 1)[0]
                hessian[before, before] += np.diag(smooth)
                hessian[u, before] = hessian[before, u] = -np.diag(smooth)
        return hessian, gradient

    def _dynamics(self, inputs: Array, along: Linearisation) -> tuple[Array, Array]:
        """Return matrix (6 N, n) and right-hand side (6 N,) of the linearised model."""
        n = self.problem.horizon
        matrix, vector = np.zeros((n * STATES, n * STAGE)), np.zeros(n * STATES)
        for i in range(n):
            u, _, following = _stage(i)
            rows = slice(i * STATES, (i + 1) * STATES)
            matrix[rows, following] = np.eye(STATES)
            matrix[rows, u] = -along.B[i]
            vector[rows] = along.states[i + 1] - along.B[i] @ inputs[i]
            if i > 0:  # x_0 is fixed
                matrix[rows, _stage(i - 1)[2]] = -along.A[i]
                vector[rows] -= along.A[i] @ along.states[i]
        return matrix, vector

    def _constraints(
        self, last_input: Array, inputs: Array, along: Linearisation
    ) -> tuple[Array, Array, Array]:
        """Return rows (m, n), lower and upper bounds (m,) of the general inequalities."""
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
            # vx' = rest + rate_x x + rate_u u, with the slack on either side
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
        """Return lower and upper bounds (n,) of the variables."""
        low, high = self.problem.input_bounds
        free = np.full(STATES, np.inf)
        lower = np.concatenate([low, np.zeros(SOFT), -free])
        upper = np.concatenate([high, np.full(SOFT, np.inf), free])
        return np.tile(lower, self.problem.horizon), np.tile(upper, self.problem.horizon)


def _stage(i: int) -> tuple[slice, slice, slice]:
    """Return the places of u_i, slack_i and x_{i+1} among the variables."""
    start = i * STAGE
    u, slack = start + INPUTS, start + INPUTS + SOFT
    return slice(start, u), slice(u, slack), slice(slack, start + STAGE)
