"""fatrop on the NMPC's problem: the second exact solver, to check IPOPT."""

from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from agents.nmpc.casadi_solvers import (
    INFINITY,
    SHARED_OPTIONS,
    TOLERANCE,
    Nlp,
    NlpSolver,
    stage_models,
)
from agents.nmpc.problem import INPUTS, SOFT, STATES, NmpcProblem, Status
from trajectories.arguments import checks_arguments

Array = NDArray[np.float64]

FATROP_ITERATIONS = 500
RELAXATION = 1e-8
"""fatrop relaxes every bound b by RELAXATION max(1, |b|), which none of its options turns off."""


class FatropSolver(NlpSolver):
    """fatrop on the NMPC's problem: a second exact solver, to check IPOPT.

    fatrop (Vanroye, Sathya, De Schutter, Decre, IROS 2023) is an interior-point method whose linear
    algebra is a Riccati recursion, so neighbouring stages may be coupled by the dynamics alone. The
    bound on the input's change couples u_i with u_{i-1}: the last input joins the state::

        stage 0     controls u_0, s_0                 (x_0 and the input in force are parameters)
        stage i     states x_i, u_{i-1}               controls sigma_i, u_i, s_i       0 < i < N
        stage N     states x_N, u_{N-1}               controls sigma_N

    s_i is the slack on vx'(x_i, u_i), sigma_i (2) that on vx_i and vy_i: each belongs to the stage
    whose variables it relaxes. The variables are N groups (u_i, s_i, x_{i+1}, u_i, sigma_{i+1}).

    fatrop has no time limit; `FATROP_ITERATIONS` bounds a solve. With a tolerance below 1e-6 it
    regularises Hessians near some optima and then gives up (QP_FAILURE from its line search, or
    MAXITER; one in ten at 1e-8), although IPOPT agrees with its plan.

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
    """

    GROUP = INPUTS + SOFT + STATES + INPUTS
    STATE = slice(INPUTS + 1, INPUTS + 1 + STATES)
    SLACK: ClassVar[list[int]] = [GROUP - 2, GROUP - 1, INPUTS]
    INPUT = (slice(0, INPUTS), slice(STATE.stop, STATE.stop + INPUTS))
    WARM: ClassVar[dict[str, str]] = {"x0": "x"}

    @checks_arguments(tolerance=TOLERANCE)
    def __init__(self, problem: NmpcProblem, *, tolerance: float = 1e-6) -> None:
        if not ca.has_nlpsol("fatrop"):
            raise ValueError(
                "this CasADi was built without fatrop: say solver='ipopt', or install its wheel "
                "from PyPI"
            )
        self.problem, self._models = problem, stage_models(problem)
        nlp = self._transcribed()
        states, controls, rows = (list(sizes) for sizes in zip(*nlp.sizes, strict=True))
        options: dict[str, Any] = {
            **SHARED_OPTIONS, "structure_detection": "manual", "N": problem.horizon, "nx": states,
            "nu": controls, "ng": rows,
            "fatrop": {"print_level": 0, "tolerance": tolerance, "max_iter": FATROP_ITERATIONS},
        }  # fmt: skip
        self._bounds = {
            "lbx": _tightened(nlp.lower, 1.0),
            "ubx": _tightened(nlp.upper, -1.0),
            "lbg": _tightened(nlp.lower_rows, 1.0, equal=nlp.equal),
            "ubg": _tightened(nlp.upper_rows, -1.0, equal=nlp.equal),
        }
        self._cold_solver = ca.nlpsol("nmpc", "fatrop", nlp.as_dict(), options)
        self._warm_solver = self._cold_solver

    def _transcribed(self) -> Nlp:
        problem, n = self.problem, self.problem.horizon
        nlp = Nlp(problem)
        low_u, high_u = problem.input_bounds

        def penalty(slack: Any, entry: int) -> Any:
            linear, quadratic = problem.linear_penalty[entry], problem.quadratic_penalty[entry]
            return linear * slack + 0.5 * quadratic * slack**2

        x, applied = nlp.initial, nlp.last
        for i in range(n + 1):
            nlp.begin(0 if i == 0 else STATES + INPUTS)
            here = x
            squared = nlp.error(i, here) ** 2
            nlp.cost += 0.5 * ca.dot(nlp.shares[i] * nlp.q if i < n else nlp.s, squared)
            if i > 0:
                sigma = nlp.control(f"sigma{i}", 2, 0.0, INFINITY)
                nlp.cost += nlp.shares[i - 1] * (penalty(sigma[0], 0) + penalty(sigma[1], 1))
            if i < n:
                u = nlp.control(f"u{i}", INPUTS, low_u, high_u)
                rate_slack = nlp.control(f"s{i}", 1, 0.0, INFINITY)
                nlp.cost += nlp.shares[i] * penalty(rate_slack, 2)
                nlp.add_input_cost(i, u, applied)
                following = nlp.state(f"x{i + 1}", STATES + INPUTS)
                # fatrop needs the gap as x_{i+1} - F, and before the stage's other rows.
                nlp.gap(following - ca.vertcat(self._models[i](here, u), u))
                nlp.limit(u - applied, -problem.input_steps[i], problem.input_steps[i])
                nlp.limit_rate(here, u, rate_slack)
                x, applied = following[:STATES], following[STATES:]
            if i > 0:
                nlp.limit_velocity(here, sigma)
        return nlp

    def _status(self, statistics: dict[str, Any]) -> Status:
        if statistics["success"]:
            return Status.SUCCESS
        exhausted = int(statistics["iter_count"]) >= FATROP_ITERATIONS
        return Status.MAXITER if exhausted else Status.QP_FAILURE


def _tightened(bounds: list[float], sign: float, equal: list[bool] | None = None) -> Array:
    """Tighten bounds by what fatrop will relax them; equalities stay."""
    values = np.array(bounds, dtype=np.float64)
    moved = np.isfinite(values) & ~np.array(equal or [False] * len(bounds), dtype=np.bool_)
    values[moved] += sign * RELAXATION * np.maximum(1.0, np.abs(values[moved]))
    return values
