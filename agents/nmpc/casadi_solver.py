"""The problem solved the paper's way: CasADi symbols, multiple shooting, IPOPT.

The reference for correctness. The NLP is built once; weights, reference, state and last input are
parameters. Decision variables, stage by stage: u_i (2), slack_i (3), x_{i+1} (6); the initial state
is a parameter. Bounds on u, vx slack signs and rates are simple or linear.
"""

import time
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from agents.nmpc.problem import INPUTS, OUTPUTS, SOFT, STATES, NmpcProblem, Solution, Status
from lpv_track_env import lpv

Array = NDArray[np.float64]

STAGE = INPUTS + SOFT + STATES
IPOPT_STATUS = {
    "Solve_Succeeded": Status.SUCCESS,
    "Solved_To_Acceptable_Level": Status.SUCCESS,
    "Maximum_Iterations_Exceeded": Status.MAXITER,
    "Maximum_CpuTime_Exceeded": Status.TIMEOUT,
    "Maximum_WallTime_Exceeded": Status.TIMEOUT,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Restoration_Failed": Status.INFEASIBLE,
    "Invalid_Number_Detected": Status.NAN,
}
COLD_OPTIONS: dict[str, Any] = {
    "print_level": 0,
    "sb": "yes",
    "bound_relax_factor": 0.0,  # the default moves the optimum
    "mumps_scaling": 0,
    "mumps_permuting_scaling": 0,
    "max_iter": 100,
}
WARM_OPTIONS: dict[str, Any] = {
    **COLD_OPTIONS,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-6,
    "warm_start_bound_frac": 1e-6,
    "warm_start_slack_bound_push": 1e-6,
    "warm_start_slack_bound_frac": 1e-6,
    "warm_start_mult_bound_push": 1e-6,
    "mu_init": 1e-3,
    "mu_strategy": "adaptive",  # 5 iterations a solve where the monotone strategy takes 13
}


def lpv_field(state: Any, action: Any, problem: NmpcProblem) -> Any:
    """The field x' = A(x, u) x + B(x, u) u on CasADi symbols."""
    a_matrix, b_matrix = lpv.casadi_matrices(state, action, problem.vehicle)
    return ca.mtimes(a_matrix, state) + ca.mtimes(b_matrix, action)


def discrete_model(problem: NmpcProblem) -> ca.Function:
    """F(x, u): the state one period on, by Runge-Kutta steps of the LPV form."""
    x, u = ca.SX.sym("x", STATES), ca.SX.sym("u", INPUTS)
    field = ca.Function("field", [x, u], [lpv_field(x, u, problem)])
    h, state = problem.period / problem.substeps, x
    for _ in range(problem.substeps):
        k1 = field(state, u)
        k2 = field(state + 0.5 * h * k1, u)
        k3 = field(state + 0.5 * h * k2, u)
        k4 = field(state + h * k3, u)
        state = state + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return ca.Function("F", [x, u], [state])


class CasadiSolver:
    """IPOPT on the NMPC's problem.

    Parameters
    ----------
    problem
        The problem.
    tolerance
        IPOPT's relative tolerance.
    max_seconds
        Limit on one solve, s; past it the status is TIMEOUT.
    """

    def __init__(
        self, problem: NmpcProblem, *, tolerance: float = 1e-6, max_seconds: float = 20.0
    ) -> None:
        self.problem = problem
        n = problem.horizon
        initial, last = ca.SX.sym("x0", STATES), ca.SX.sym("u_last", INPUTS)
        reference = ca.SX.sym("reference", OUTPUTS, n + 1)
        weights = ca.SX.sym("weights", 2 * OUTPUTS + INPUTS)
        q, s, r = ca.vertsplit(weights, [0, OUTPUTS, 2 * OUTPUTS, 2 * OUTPUTS + INPUTS])
        variables, constraints = [], []
        lower: list[float] = []
        upper: list[float] = []
        low_u, high_u = problem.input_bounds
        low_v, high_v = problem.vehicle.speed_range
        low_dv, high_dv = problem.vehicle.longitudinal_acceleration_range
        ratio = problem.vehicle.max_lateral_velocity_ratio
        linear, quadratic = ca.DM(problem.linear_penalty), ca.DM(problem.quadratic_penalty)
        steps, model = problem.input_steps, discrete_model(problem)
        self._model = model
        infinity = np.inf

        def constrain(expression: Any, low: Any, high: Any) -> None:
            constraints.append(expression)
            lower.extend(np.broadcast_to(low, expression.shape[0]))
            upper.extend(np.broadcast_to(high, expression.shape[0]))

        cost: Any = 0
        state, previous = initial, last
        for i in range(n):
            u, slack = ca.SX.sym(f"u{i}", INPUTS), ca.SX.sym(f"s{i}", SOFT)
            following = ca.SX.sym(f"x{i + 1}", STATES)
            variables += [u, slack, following]
            error = reference[:, i] - ca.mtimes(ca.DM(lpv.C), state)
            cost += 0.5 * (ca.dot(q, error**2) + ca.dot(r, u**2))
            cost += ca.dot(linear, slack) + 0.5 * ca.dot(quadratic, slack**2)
            constrain(model(state, u) - following, 0.0, 0.0)
            constrain(u - previous, -steps[i], steps[i])
            rate = lpv_field(state, u, problem)[0]
            constrain(rate + slack[2], low_dv, infinity)
            constrain(rate - slack[2], -infinity, high_dv)
            vx, vy = following[0], following[1]
            constrain(vx + slack[0], low_v, infinity)
            constrain(vx - slack[0], -infinity, high_v)
            constrain(vy - ratio * vx - slack[1], -infinity, 0.0)
            constrain(-vy - ratio * vx - slack[1], -infinity, 0.0)
            state, previous = following, u
        error = reference[:, n] - ca.mtimes(ca.DM(lpv.C), state)
        cost += 0.5 * ca.dot(s, error**2)

        free = np.full(STATES, infinity)
        none = np.zeros(SOFT)
        self._bounds = {
            "lbx": np.tile(np.concatenate([low_u, none, -free]), n),
            "ubx": np.tile(np.concatenate([high_u, np.full(SOFT, infinity), free]), n),
            "lbg": np.array(lower, dtype=np.float64),
            "ubg": np.array(upper, dtype=np.float64),
        }
        parameters = ca.vertcat(initial, last, ca.vec(reference), weights)
        nlp = {
            "x": ca.vertcat(*variables),
            "f": cost,
            "g": ca.vertcat(*constraints),
            "p": parameters,
        }
        self._cold_solver = self._build(nlp, {**COLD_OPTIONS, "tol": tolerance}, max_seconds)
        # The same derivative functions, built once, serve the warm-started solver.
        shared = {
            option: self._cold_solver.get_function(name)
            for option, name in (
                ("grad_f", "nlp_grad_f"),
                ("jac_g", "nlp_jac_g"),
                ("hess_lag", "nlp_hess_l"),
            )
        }
        self._warm_solver = self._build(
            nlp, {**WARM_OPTIONS, "tol": tolerance}, max_seconds, **shared
        )

    @staticmethod
    def _build(
        nlp: dict[str, Any], ipopt: dict[str, Any], max_seconds: float, **functions: ca.Function
    ) -> ca.Function:
        options: dict[str, Any] = {
            "ipopt": {**ipopt, "max_wall_time": max_seconds},
            "expand": True,
            "print_time": False,
            "error_on_fail": False,
            **functions,
        }
        return ca.nlpsol("nmpc", "ipopt", nlp, options)

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: "WarmStart | None" = None,
    ) -> tuple[Solution, "WarmStart | None"]:
        """Solve from `state` (6,), with the input in force (2,) and the weights (10,).

        `reference` is (N + 1, 4). `warm` is what the last solve returned; it is shifted by one
        period here. Never raises: what goes wrong is in the status.
        """
        began = time.perf_counter()
        if warm is None:
            guess, solver = self._cold(state, last_input), self._cold_solver
        else:
            guess, solver = self._shifted(warm), self._warm_solver
        parameters = np.concatenate([state, last_input, reference.ravel(), weights])
        return self._run(solver, guess, parameters, began)

    def solve_from(
        self, plan: Solution, state: Array, last_input: Array, reference: Array, weights: Array
    ) -> Solution:
        """Solve as `solve` does, from another solver's plan for the same situation.

        An optimum is kept: so it tells a second local optimum from a plan that is none.

        Raises
        ------
        ValueError
            If the solution holds no plan.
        """
        if plan.inputs is None or plan.states is None or plan.slack is None:
            raise ValueError(f"there is no plan to start from: status {plan.status.value}")
        began = time.perf_counter()
        guess = {"x0": np.column_stack([plan.inputs, plan.slack, plan.states[1:]]).ravel()}
        parameters = np.concatenate([state, last_input, reference.ravel(), weights])
        return self._run(self._warm_solver, guess, parameters, began)[0]

    def _run(
        self, solver: ca.Function, guess: dict[str, Array], parameters: Array, began: float
    ) -> tuple[Solution, "WarmStart | None"]:
        n = self.problem.horizon
        if not np.isfinite(parameters).all():
            return Solution(Status.NAN, None, None, None, np.nan, 0, 0.0), None
        try:
            result = solver(p=parameters, **self._bounds, **guess)
            statistics = solver.stats()
        except RuntimeError:
            seconds = time.perf_counter() - began
            return Solution(Status.QP_FAILURE, None, None, None, np.nan, 0, seconds), None
        seconds = time.perf_counter() - began
        status = IPOPT_STATUS.get(statistics["return_status"], Status.QP_FAILURE)
        values = np.asarray(result["x"]).ravel()
        if not np.isfinite(values).all():
            status = Status.NAN
        iterations = int(statistics["iter_count"])
        if status is Status.NAN:
            return Solution(status, None, None, None, np.nan, iterations, seconds), None
        stages = values.reshape(n, STAGE)
        plan = Solution(
            status,
            stages[:, :INPUTS].copy(),
            np.vstack([parameters[:STATES], stages[:, INPUTS + SOFT :]]),
            stages[:, INPUTS : INPUTS + SOFT].copy(),
            float(result["f"]),
            iterations,
            seconds,
        )
        duals = np.asarray(result["lam_x"]).ravel(), np.asarray(result["lam_g"]).ravel()
        return plan, WarmStart(values, *duals)

    def _cold(self, state: Array, last_input: Array) -> dict[str, Array]:
        """Guess without a plan: where the model goes with the input in force, held."""
        low, high = self.problem.input_bounds
        held, none = last_input.clip(low, high), np.zeros(SOFT)
        stages = []
        for _ in range(self.problem.horizon):
            state = np.asarray(self._model(state, held)).ravel()
            stages.append(np.concatenate([held, none, state]))
        guess = np.concatenate(stages)
        return {"x0": guess if np.isfinite(guess).all() else np.zeros_like(guess)}

    def _shifted(self, warm: "WarmStart") -> dict[str, Array]:
        n = self.problem.horizon

        def shift(values: Array) -> Array:
            stages = values.reshape(n, -1)
            return np.vstack([stages[1:], stages[-1:]]).ravel()

        return {
            "x0": shift(warm.variables),
            "lam_x0": shift(warm.bound_duals),
            "lam_g0": shift(warm.constraint_duals),
        }


class WarmStart:
    """Primal and dual variables of the last solve, stage by stage."""

    def __init__(self, variables: Array, bound_duals: Array, constraint_duals: Array) -> None:
        self.variables = variables
        self.bound_duals = bound_duals
        self.constraint_duals = constraint_duals
