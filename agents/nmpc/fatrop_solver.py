"""The problem solved by fatrop: CasADi symbols, stage by stage, structure exploited.

A second exact solver with a transcription of its own, to check IPOPT's against. fatrop (Vanroye,
Sathya, De Schutter, Decre, IROS 2023) is an interior-point method whose linear algebra is a Riccati
recursion, so neighbouring stages may be coupled by the dynamics alone. The bound on the input's
change couples u_i with u_{i-1}: the input last applied joins the state::

    stage 0     controls u_0, s_0                 (x_0 and the input in force are parameters)
    stage i     states x_i, u_{i-1}               controls sigma_i, u_i, s_i       0 < i < N
    stage N     states x_N, u_{N-1}               controls sigma_N

s_i is the slack on vx'(x_i, u_i), sigma_i (2) that on vx_i and vy_i: each stands in the stage whose
variables it frees. Flat, the variables are N equal groups (u_i, s_i, x_{i+1}, u_i, sigma_{i+1}).
"""

import time
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from agents.nmpc.casadi_solver import discrete_model, lpv_field
from agents.nmpc.problem import INPUTS, OUTPUTS, SOFT, STATES, NmpcProblem, Solution, Status
from lpv_track_env import lpv

Array = NDArray[np.float64]

MAX_ITERATIONS = 200
RELAXATION = 1e-8
"""fatrop widens every bound b by RELAXATION max(1, |b|), which none of its options turns off."""
GROUP = INPUTS + SOFT + STATES + INPUTS
INPUT, RATE_SLACK = slice(0, INPUTS), INPUTS
STATE = slice(INPUTS + 1, INPUTS + 1 + STATES)
APPLIED = slice(STATE.stop, STATE.stop + INPUTS)
VELOCITY_SLACK = slice(APPLIED.stop, GROUP)


class FatropSolver:
    """fatrop on the NMPC's problem.

    Parameters
    ----------
    problem
        The problem.
    tolerance
        fatrop's tolerance on the scaled optimality conditions.

    Raises
    ------
    ValueError
        If the installed CasADi was built without fatrop.

    fatrop has no time limit of its own; `MAX_ITERATIONS` bounds a solve. Asked for less than 1e-6,
    it regularises Hessians near some optima and then gives up (QP_FAILURE from its line search, or
    MAXITER; one in ten at 1e-8), with a plan that IPOPT agrees with all the same.
    """

    def __init__(self, problem: NmpcProblem, *, tolerance: float = 1e-6) -> None:
        if not ca.has_nlpsol("fatrop"):
            raise ValueError(
                "this CasADi was built without fatrop: say solver='ipopt', or install its wheel "
                "from PyPI"
            )
        self.problem = problem
        self._model = discrete_model(problem)
        stages = _Stages()
        parameters = self._transcribe(stages)
        options: dict[str, Any] = {
            "structure_detection": "manual",
            "N": problem.horizon,
            "nx": stages.states,
            "nu": stages.controls,
            "ng": stages.rows,
            "expand": True,
            "print_time": False,
            "error_on_fail": False,
            "fatrop": {"print_level": 0, "tolerance": tolerance, "max_iter": MAX_ITERATIONS},
        }
        nlp = {
            "x": ca.vertcat(*stages.variables),
            "f": stages.cost,
            "g": ca.vertcat(*stages.constraints),
            "p": parameters,
        }
        self._bounds = {
            "lbx": _inwards(stages.lower, 1.0),
            "ubx": _inwards(stages.upper, -1.0),
            "lbg": _inwards(stages.lower_rows, 1.0, equal=stages.equal),
            "ubg": _inwards(stages.upper_rows, -1.0, equal=stages.equal),
        }
        self._solver = ca.nlpsol("nmpc", "fatrop", nlp, options)

    def _transcribe(self, stages: "_Stages") -> Any:
        """Fill `stages` in with the whole problem; return its parameters."""
        problem = self.problem
        n, car = problem.horizon, problem.vehicle
        initial, last = ca.SX.sym("x0", STATES), ca.SX.sym("u_last", INPUTS)
        reference = ca.SX.sym("reference", OUTPUTS, n + 1)
        weights = ca.SX.sym("weights", 2 * OUTPUTS + INPUTS)
        q, s, r = ca.vertsplit(weights, [0, OUTPUTS, 2 * OUTPUTS, 2 * OUTPUTS + INPUTS])
        low_u, high_u = problem.input_bounds
        low_v, high_v = car.speed_range
        low_dv, high_dv = car.longitudinal_acceleration_range
        ratio, infinity = car.max_lateral_velocity_ratio, np.inf

        def penalty(slack: Any, entry: int) -> Any:
            linear, quadratic = problem.linear_penalty[entry], problem.quadratic_penalty[entry]
            return linear * slack + 0.5 * quadratic * slack**2

        x, applied = initial, last
        for i in range(n + 1):
            stages.begin(0 if i == 0 else STATES + INPUTS)
            error = reference[:, i] - ca.mtimes(ca.DM(lpv.C), x)
            stages.cost += 0.5 * ca.dot(q if i < n else s, error**2)
            if i > 0:
                sigma = stages.control(f"sigma{i}", np.zeros(2), np.full(2, infinity))
                stages.cost += penalty(sigma[0], 0) + penalty(sigma[1], 1)
            if i < n:
                u = stages.control(f"u{i}", low_u, high_u)
                rate_slack = stages.control(f"s{i}", np.zeros(1), np.full(1, infinity))
                stages.cost += 0.5 * ca.dot(r, u**2) + penalty(rate_slack, 2)
                following = ca.SX.sym(f"x{i + 1}", STATES + INPUTS)
                # fatrop wants the gap as x_{i+1} - F, and before the stage's other rows.
                stages.gap(following - ca.vertcat(self._model(x, u), u))
                stages.constrain(u - applied, -problem.input_steps[i], problem.input_steps[i])
                rate = lpv_field(x, u, problem)[0]
                stages.constrain(rate + rate_slack, low_dv, infinity)
                stages.constrain(rate - rate_slack, -infinity, high_dv)
            if i > 0:
                stages.constrain(x[0] + sigma[0], low_v, infinity)
                stages.constrain(x[0] - sigma[0], -infinity, high_v)
                stages.constrain(x[1] - ratio * x[0] - sigma[1], -infinity, 0.0)
                stages.constrain(-x[1] - ratio * x[0] - sigma[1], -infinity, 0.0)
            if i < n:
                stages.state(following)
                x, applied = following[:STATES], following[STATES:]
        return ca.vertcat(initial, last, ca.vec(reference), weights)

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: Array | None = None,
    ) -> tuple[Solution, Array | None]:
        """Solve from `state` (6,), with the input in force (2,) and the weights (10,).

        `reference` is (N + 1, 4). `warm` is what the last solve returned, the plan (N, 13); it is
        shifted by one period here. Never raises: what goes wrong is in the status.
        """
        began = time.perf_counter()
        parameters = np.concatenate([state, last_input, reference.ravel(), weights])
        if not np.isfinite(parameters).all():
            return Solution(Status.NAN, None, None, None, np.nan, 0, 0.0), None
        guess = self._cold(state, last_input) if warm is None else np.vstack([warm[1:], warm[-1:]])
        try:
            result = self._solver(p=parameters, x0=guess.ravel(), **self._bounds)
            statistics = self._solver.stats()
        except RuntimeError:
            seconds = time.perf_counter() - began
            return Solution(Status.QP_FAILURE, None, None, None, np.nan, 0, seconds), None
        seconds = time.perf_counter() - began
        iterations, cost = int(statistics["iter_count"]), float(result["f"])
        groups = np.asarray(result["x"]).reshape(-1, GROUP)
        if not (np.isfinite(groups).all() and np.isfinite(cost)):
            return Solution(Status.NAN, None, None, None, np.nan, iterations, seconds), None
        status = Status.QP_FAILURE
        if statistics["success"]:
            status = Status.SUCCESS
        elif iterations >= MAX_ITERATIONS:
            status = Status.MAXITER
        slack = np.column_stack([groups[:, VELOCITY_SLACK], groups[:, RATE_SLACK]])
        states = np.vstack([state, groups[:, STATE]])
        plan = Solution(
            status, groups[:, INPUT].copy(), states, slack, cost, iterations, seconds
        )  # fmt: skip
        return plan, groups

    def _cold(self, state: Array, last_input: Array) -> Array:
        """Guess without a plan, (N, 13): where the model goes with the input in force, held."""
        low, high = self.problem.input_bounds
        guess = np.zeros((self.problem.horizon, GROUP))
        guess[:, INPUT] = guess[:, APPLIED] = held = last_input.clip(low, high)
        for row in guess:
            row[STATE] = state = np.asarray(self._model(state, held)).ravel()
        return guess if np.isfinite(guess).all() else np.zeros_like(guess)


class _Stages:
    """Variables, bounds and constraints in fatrop's order, with the sizes it wants to be told."""

    def __init__(self) -> None:
        self.variables: list[Any] = []
        self.constraints: list[Any] = []
        self.cost: Any = 0
        self.lower: list[float] = []
        self.upper: list[float] = []
        self.lower_rows: list[float] = []
        self.upper_rows: list[float] = []
        self.equal: list[bool] = []
        self.states: list[int] = []
        self.controls: list[int] = []
        self.rows: list[int] = []

    def begin(self, states: int) -> None:
        """Begin a stage, whose states were declared by the stage before."""
        self.states.append(states)
        self.controls.append(0)
        self.rows.append(0)

    def control(self, name: str, low: Array, high: Array) -> Any:
        """Bounded variables of this stage."""
        symbol = ca.SX.sym(name, len(low))
        self.variables.append(symbol)
        self.lower.extend(low)
        self.upper.extend(high)
        self.controls[-1] += len(low)
        return symbol

    def state(self, symbol: Any) -> None:
        """Free variables: the next stage's states."""
        self.variables.append(symbol)
        self.lower.extend([-np.inf] * symbol.shape[0])
        self.upper.extend([np.inf] * symbol.shape[0])

    def gap(self, expression: Any) -> None:
        """Dynamics that lead to the next stage, = 0."""
        self._add(expression, 0.0, 0.0, equal=True)

    def constrain(self, expression: Any, low: Any, high: Any) -> None:
        """Rows low <= expression <= high of this stage."""
        self._add(expression, low, high, equal=False)
        self.rows[-1] += expression.shape[0]

    def _add(self, expression: Any, low: Any, high: Any, *, equal: bool) -> None:
        size = expression.shape[0]
        self.constraints.append(expression)
        self.lower_rows.extend(np.broadcast_to(low, size))
        self.upper_rows.extend(np.broadcast_to(high, size))
        self.equal.extend([equal] * size)


def _inwards(bounds: list[float], sign: float, equal: list[bool] | None = None) -> Array:
    """Bounds moved inwards by what fatrop will move them outwards; equalities stay."""
    values = np.array(bounds, dtype=np.float64)
    moved = np.isfinite(values) & ~np.array(equal or [False] * len(bounds), dtype=np.bool_)
    values[moved] += sign * RELAXATION * np.maximum(1.0, np.abs(values[moved]))
    return values
