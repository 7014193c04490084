"""Exact solvers of the NMPC's problem with CasADi, and IPOPT, the paper's way.

The problem is solved by multiple shooting. The NLP is built once; weights, reference, state and
last input are its parameters. `fatrop` has the other solver: each orders the problem's stages in
its own way, so that the two check one another.
"""

import time
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from agents.nmpc.problem import (
    INPUTS,
    NOMINAL_PERIOD,
    OUTPUTS,
    SOFT,
    STATES,
    NmpcProblem,
    Solution,
    Status,
)
from agents.weights import WEIGHTS
from lpv_track_env import lpv
from trajectories.arguments import Number, checks_arguments

Array = NDArray[np.float64]

INFINITY = np.inf
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
SHARED_OPTIONS: dict[str, Any] = {"expand": True, "print_time": False, "error_on_fail": False}
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
ASIDE = 0.01
"""Steering angle added to a cold start's, rad."""
TOLERANCE = Number(0.0, 1.0, above=True)


def lpv_field(state: Any, action: Any, problem: NmpcProblem) -> Any:
    """Vector field x' = A(x, u) x + B(x, u) u on CasADi symbols."""
    a_matrix, b_matrix = lpv.casadi_matrices(state, action, problem.vehicle, problem.friction)
    return ca.mtimes(a_matrix, state) + ca.mtimes(b_matrix, action)


def discrete_model(problem: NmpcProblem, stage: int = 0) -> ca.Function:
    """Build F(x, u), the state after a stage, by Runge-Kutta steps of the LPV form."""
    x, u = ca.SX.sym("x", STATES), ca.SX.sym("u", INPUTS)
    field = ca.Function("field", [x, u], [lpv_field(x, u, problem)])
    substeps = int(problem.substeps[stage])
    h, state = problem.periods[stage] / substeps, x
    for _ in range(substeps):
        k1 = field(state, u)
        k2 = field(state + 0.5 * h * k1, u)
        k3 = field(state + 0.5 * h * k2, u)
        k4 = field(state + h * k3, u)
        state = state + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return ca.Function("F", [x, u], [state])


def stage_models(problem: NmpcProblem) -> list[ca.Function]:
    """Build `discrete_model` of every stage; stages of the same length share theirs."""
    lengths = problem.periods.tolist()
    models = {length: discrete_model(problem, i) for i, length in enumerate(lengths)}
    return [models[length] for length in lengths]


class Nlp:
    """Parameters, variables, constraints and cost of an NLP while it is built, stage by stage."""

    def __init__(self, problem: NmpcProblem) -> None:
        self.problem, n = problem, problem.horizon
        self.initial, self.last = ca.SX.sym("x0", STATES), ca.SX.sym("u_last", INPUTS)
        self.reference = ca.SX.sym("reference", OUTPUTS, n + 1)
        self.weights = ca.SX.sym("weights", WEIGHTS)
        q, s, r, rate = np.cumsum([OUTPUTS, OUTPUTS, INPUTS, INPUTS]).tolist()
        self.q, self.s, self.r, self.r_rate = ca.vertsplit(self.weights, [0, q, s, r, rate])
        self.shares = problem.periods / NOMINAL_PERIOD
        self.cost: Any = 0
        self.variables: list[Any] = []
        self.lower: list[float] = []
        self.upper: list[float] = []
        self.constraints: list[Any] = []
        self.lower_rows: list[float] = []
        self.upper_rows: list[float] = []
        self.equal: list[bool] = []
        # Sizes of each stage: states, controls, rows besides the dynamics.
        self.sizes: list[list[int]] = []

    def begin(self, states: int) -> None:
        """Begin a stage, whose states the stage before has added."""
        self.sizes.append([states, 0, 0])

    def control(self, name: str, size: int, low: Any, high: Any) -> Any:
        """Add bounded variables of this stage."""
        self.sizes[-1][1] += size
        return self._add(name, size, low, high)

    def state(self, name: str, size: int) -> Any:
        """Add free variables, the next stage's states."""
        return self._add(name, size, -INFINITY, INFINITY)

    def _add(self, name: str, size: int, low: Any, high: Any) -> Any:
        self.variables.append(ca.SX.sym(name, size))
        self.lower.extend(np.broadcast_to(low, size))
        self.upper.extend(np.broadcast_to(high, size))
        return self.variables[-1]

    def gap(self, expression: Any) -> None:
        """Add the dynamics that lead to the next stage, = 0."""
        self._constrain(expression, 0.0, 0.0, equal=True)

    def limit(self, expression: Any, low: Any, high: Any) -> None:
        """Add rows low <= expression <= high of this stage."""
        self._constrain(expression, low, high, equal=False)
        self.sizes[-1][2] += expression.shape[0]

    def _constrain(self, expression: Any, low: Any, high: Any, *, equal: bool) -> None:
        size = expression.shape[0]
        self.constraints.append(expression)
        self.lower_rows.extend(np.broadcast_to(low, size))
        self.upper_rows.extend(np.broadcast_to(high, size))
        self.equal.extend([equal] * size)

    def limit_rate(self, state: Any, u: Any, slack: Any) -> None:
        """Add the soft constraint on vx'."""
        low, high = self.problem.vehicle.longitudinal_acceleration_range
        rate = lpv_field(state, u, self.problem)[0]
        self.limit(rate + slack, low, INFINITY)
        self.limit(rate - slack, -INFINITY, high)

    def limit_velocity(self, state: Any, slack: Any) -> None:
        """Add the soft constraints on vx and vy, with a slack each."""
        low, high = self.problem.vehicle.speed_range
        ratio, vx, vy = self.problem.vehicle.max_lateral_velocity_ratio, state[0], state[1]
        self.limit(vx + slack[0], low, INFINITY)
        self.limit(vx - slack[0], -INFINITY, high)
        self.limit(vy - ratio * vx - slack[1], -INFINITY, 0.0)
        self.limit(-vy - ratio * vx - slack[1], -INFINITY, 0.0)

    def add_input_cost(self, i: int, u: Any, before: Any) -> None:
        """Add the cost of stage i's input u, and of its change from the input before."""
        spacing = self.problem.spacings[i]
        self.cost += 0.5 * self.shares[i] * ca.dot(self.r, u**2)
        self.cost += (
            0.5 * spacing / NOMINAL_PERIOD * ca.dot(self.r_rate, ((u - before) / spacing) ** 2)
        )

    def error(self, i: int, state: Any) -> Any:
        """Output error at node i, its position along and across the path."""
        e = self.reference[:, i] - ca.mtimes(ca.DM(lpv.C), state)
        c, s = ca.cos(self.reference[1, i]), ca.sin(self.reference[1, i])
        return ca.vertcat(e[:2], c * e[2] + s * e[3], c * e[3] - s * e[2])

    def as_dict(self) -> dict[str, Any]:
        """Return the NLP as `casadi.nlpsol` takes it."""
        return {
            "x": ca.vertcat(*self.variables),
            "f": self.cost,
            "g": ca.vertcat(*self.constraints),
            "p": ca.vertcat(self.initial, self.last, ca.vec(self.reference), self.weights),
        }


class NlpSolver(ABC):
    """A solver of the problem as an NLP, whose variables are N groups of `GROUP`."""

    GROUP: ClassVar[int]
    STATE: ClassVar[slice]
    INPUT: ClassVar[tuple[slice, ...]]
    """Places of the input in a group."""
    SLACK: ClassVar[list[int]]
    """Places of the slacks on vx, vy, vx' in a group."""
    WARM: ClassVar[dict[str, str]]
    """Results of a solve that start the next one, by the name of its argument."""

    problem: NmpcProblem
    _models: list[ca.Function]
    """Discrete model of each stage."""
    _bounds: dict[str, Array]
    _cold_solver: ca.Function
    _warm_solver: ca.Function

    def solve(
        self, state: Array, last_input: Array, reference: Array, weights: Array, warm: Any = None
    ) -> tuple[Solution, Any]:
        """Solve from `state` (6,), with the input in force (2,) and the weights (12,).

        `reference` is (N + 1, 4). `warm` is the warm start that the last solve returned, moved on
        by one control period here. Never raises: the status reports failures.
        """
        began = time.perf_counter()
        parameters = self.problem.parameters(state, last_input, reference, weights)
        if parameters is None:
            return Solution(Status.NAN), None
        if warm is None:
            guess = {"x0": self._cold_guess(state, last_input, reference)}
            solver = self._cold_solver
        else:
            guess, solver = self._moved_on(warm, state), self._warm_solver
        return self._run(solver, guess, parameters, began)

    def _run(
        self, solver: ca.Function, guess: dict[str, Array], parameters: Array, began: float
    ) -> tuple[Solution, Any]:
        try:
            result = solver(p=parameters, **self._bounds, **guess)
            statistics = solver.stats()
        except RuntimeError:
            seconds = time.perf_counter() - began
            return Solution(Status.QP_FAILURE, seconds=seconds), None
        seconds = time.perf_counter() - began
        iterations, cost = int(statistics["iter_count"]), float(result["f"])
        groups = np.asarray(result["x"]).reshape(self.problem.horizon, self.GROUP)
        status = self._status(statistics)
        if status is Status.NAN or not (np.isfinite(groups).all() and np.isfinite(cost)):
            return Solution(Status.NAN, iterations=iterations, seconds=seconds), None
        states = np.vstack([parameters[:STATES], groups[:, self.STATE]])
        inputs, slack = groups[:, self.INPUT[0]].copy(), groups[:, self.SLACK]
        plan = Solution(status, inputs, states, slack, cost, iterations, seconds)
        return plan, {name: np.asarray(result[of]).ravel() for name, of in self.WARM.items()}

    @abstractmethod
    def _status(self, statistics: dict[str, Any]) -> Status:
        """Status of a solve by CasADi's statistics."""

    def _cold_guess(self, state: Array, last_input: Array, reference: Array) -> Array:
        """Guess without a plan: the model driven towards the reference's speed, wheels held.

        They are turned by `ASIDE`: where a car that drives off straight could gain by either turn,
        the symmetric plan is stationary without being a minimum, and solvers end there.
        """
        problem, car = self.problem, self.problem.vehicle
        low, high = problem.input_bounds
        a, delta = last_input + np.array([0.0, ASIDE])
        speed, rolling = state[0], car.rolling_deceleration
        guess = np.zeros((problem.horizon, self.GROUP))
        for i, (length, most) in enumerate(zip(problem.periods, problem.input_steps, strict=True)):
            wanted = (reference[i + 1, 0] - speed) / length
            wanted = rolling + min(wanted, car.longitudinal_acceleration_range[1])
            a = min(max(wanted, a - most[0], low[0]), a + most[0], high[0])
            speed += length * (a - rolling)
            for columns in self.INPUT:
                guess[i, columns] = a, min(max(delta, low[1]), high[1])
        self._roll_out(guess, state)
        return (guess if np.isfinite(guess).all() else np.zeros_like(guess)).ravel()

    def _moved_on(self, warm: dict[str, Array], state: Array) -> dict[str, Array]:
        """Move a warm start on by one control period, its inputs rolled out from the new state.

        What belongs to a stage goes towards that of the next by the share of the stage that has
        passed; the last stage's is held. The roll-out replaces states in the frame of the old foot
        point.
        """
        moved = {}
        for name, values in warm.items():
            stages = values.reshape(self.problem.horizon, -1).copy()
            stages[:-1] += self.problem.passed[:-1, None] * (stages[1:] - stages[:-1])
            moved[name] = stages.ravel()
        rolled = moved["x0"].reshape(self.problem.horizon, self.GROUP).copy()
        self._roll_out(rolled, state)
        return {**moved, "x0": rolled.ravel()} if np.isfinite(rolled).all() else moved

    def _roll_out(self, groups: Array, state: Array) -> None:
        """Fill the states of groups (N, `GROUP`) with the motion under their inputs."""
        for row, model in zip(groups, self._models, strict=True):
            row[self.STATE] = state = np.asarray(model(state, row[self.INPUT[0]])).ravel()


class IpoptSolver(NlpSolver):
    """IPOPT on the NMPC's problem: the reference for correctness.

    The variables of a group are u_i (2), slack_i (3) and x_{i+1} (6).

    Parameters
    ----------
    problem
        The problem.
    tolerance
        IPOPT's relative tolerance.
    max_seconds
        Time limit of a solve, s; beyond it the status is TIMEOUT.
    """

    GROUP = INPUTS + SOFT + STATES
    STATE = slice(INPUTS + SOFT, GROUP)
    INPUT = (slice(0, INPUTS),)
    SLACK: ClassVar[list[int]] = [2, 3, 4]
    WARM: ClassVar[dict[str, str]] = {"x0": "x", "lam_x0": "lam_x", "lam_g0": "lam_g"}

    @checks_arguments(tolerance=TOLERANCE, max_seconds=Number(0.0, 1e6, "s", above=True))
    def __init__(
        self, problem: NmpcProblem, *, tolerance: float = 1e-6, max_seconds: float = 20.0
    ) -> None:
        self.problem, self._models = problem, stage_models(problem)
        nlp = self._transcribed()
        given = nlp.as_dict()
        self._bounds = {
            "lbx": np.array(nlp.lower, dtype=np.float64),
            "ubx": np.array(nlp.upper, dtype=np.float64),
            "lbg": np.array(nlp.lower_rows, dtype=np.float64),
            "ubg": np.array(nlp.upper_rows, dtype=np.float64),
        }
        shared = dict(SHARED_OPTIONS)
        limits = {"tol": tolerance, "max_wall_time": max_seconds}
        cold = {**shared, "ipopt": {**COLD_OPTIONS, **limits}}
        self._cold_solver = ca.nlpsol("nmpc", "ipopt", given, cold)
        # The warm-started solver uses the same derivative functions, built once.
        for option, name in (
            ("grad_f", "nlp_grad_f"), ("jac_g", "nlp_jac_g"), ("hess_lag", "nlp_hess_l"),
        ):  # fmt: skip
            shared[option] = self._cold_solver.get_function(name)
        warm = {**shared, "ipopt": {**WARM_OPTIONS, **limits}}
        self._warm_solver = ca.nlpsol("nmpc", "ipopt", given, warm)

    def _transcribed(self) -> Nlp:
        problem = self.problem
        nlp = Nlp(problem)
        low_u, high_u = problem.input_bounds
        linear, quadratic = ca.DM(problem.linear_penalty), ca.DM(problem.quadratic_penalty)
        nlp.begin(0)
        state, previous = nlp.initial, nlp.last
        for i, steps in enumerate(problem.input_steps):
            u = nlp.control(f"u{i}", INPUTS, low_u, high_u)
            slack = nlp.control(f"s{i}", SOFT, 0.0, INFINITY)
            following = nlp.state(f"x{i + 1}", STATES)
            penalty = ca.dot(linear, slack) + 0.5 * ca.dot(quadratic, slack**2)
            nlp.cost += nlp.shares[i] * (0.5 * ca.dot(nlp.q, nlp.error(i, state) ** 2) + penalty)
            nlp.add_input_cost(i, u, previous)
            nlp.gap(self._models[i](state, u) - following)
            nlp.limit(u - previous, -steps, steps)
            nlp.limit_rate(state, u, slack[2])
            nlp.limit_velocity(following, slack)
            state, previous = following, u
        nlp.cost += 0.5 * ca.dot(nlp.s, nlp.error(problem.horizon, state) ** 2)
        return nlp

    def solve_from(
        self, plan: Solution, state: Array, last_input: Array, reference: Array, weights: Array
    ) -> Solution:
        """Solve as `solve` does, starting from another solver's plan for the same situation.

        An optimal plan is kept: this distinguishes another local optimum from a plan that is none.

        Raises
        ------
        ValueError
            If the solution holds no plan.
        """
        if plan.inputs is None or plan.states is None or plan.slack is None:
            raise ValueError(f"there is no plan to start from: status {plan.status.value}")
        began = time.perf_counter()
        guess = {"x0": np.column_stack([plan.inputs, plan.slack, plan.states[1:]]).ravel()}
        parameters = self.problem.parameters(state, last_input, reference, weights)
        if parameters is None:
            return Solution(Status.NAN)
        return self._run(self._warm_solver, guess, parameters, began)[0]

    def _status(self, statistics: dict[str, Any]) -> Status:
        return IPOPT_STATUS.get(statistics["return_status"], Status.QP_FAILURE)
