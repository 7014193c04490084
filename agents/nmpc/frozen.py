"""LPV-MPC with A and B frozen along the last plan: a demonstration, not a controller to use.

The quasi-LPV form x' = A(x, u) x + B(u) u equals the vehicle's field exactly, so it is tempting to
freeze its matrices along the last plan and to solve one QP per period. That drops the derivatives
of A and B, one of which is essential for steering: A as printed in kumar2025lpv has no column of
psi in the rows of X and Y, so in the QP turning does not move the car sideways. Writing
sin(psi_ref + e) by means of sinc(e) e, with e the deviation from the plan's direction of travel,
adds this column to the same field, and the QP steers.
"""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from agents.base import DrivingTask
from agents.nmpc.base import NmpcSettings
from agents.nmpc.ipopt_agent import SolvedNmpc
from agents.nmpc.linearisation import Linearisation
from agents.nmpc.problem import NmpcProblem, Solution, Status
from agents.nmpc.rti_solver import RtiSolver
from lpv_track_env.bicycle import PSI, VX, VY, X, Y
from lpv_track_env.lpv import matrices
from lpv_track_env.validation import forwards_arguments
from trajectories.naming import choose

Array = NDArray[np.float64]

FORMS = ("literal", "sinc")


class FrozenLpvSolver:
    """Solver of one QP per period, with the model A(x, u) x + B(u) u frozen along a plan.

    The frozen system is discretised exactly (zero-order hold by a matrix exponential).

    Parameters
    ----------
    problem
        The problem.
    form
        "literal": the matrices as printed. "sinc": the same field with a column of psi.

    Raises
    ------
    ValueError
        For an unknown form.
    """

    def __init__(self, problem: NmpcProblem, *, form: str = "literal") -> None:
        self.problem, self.form = problem, choose("form", form, FORMS)
        self._rti = RtiSolver(problem)

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: Array | None = None,
    ) -> tuple[Solution, Array | None]:
        """Solve as `RtiSolver.solve` does, with the frozen model."""
        began = time.perf_counter()
        if self.problem.parameters(state, last_input, reference, weights) is None:
            return Solution(Status.NAN), None
        low, high = self.problem.input_bounds
        last = np.clip(last_input, low, high)
        plan = np.tile(last, (self.problem.horizon, 1))
        if warm is not None:
            plan = self._rti.shifted(warm)
        model = self.freeze(state, plan, reference[:, 1])
        solution = self._rti.solve_model(model, last, reference, weights, plan)
        return solution._replace(seconds=time.perf_counter() - began), solution.inputs

    def freeze(self, state: Array, inputs: Array, heading: Array) -> Linearisation:
        """Freeze the model along the roll-out of `inputs` (N, 2) from `state` (6,); discretise it.

        `heading` (N + 1,) is the reference's, rad. The returned states follow the frozen model, not
        the field.
        """
        along = self._rti.linearise(state, inputs).states
        n = len(inputs)
        a_all, b_all = np.tile(np.eye(6), (n, 1, 1)), np.zeros((n, 6, 2))
        states = np.zeros((n + 1, 6))
        rate, rate_x, rate_u = np.zeros(n), np.zeros((n, 6)), np.ones((n, 2))
        states[0] = state
        for i, period in enumerate(self.problem.periods):
            a, b, constant = self._continuous(along[i], inputs[i], heading[i])
            a_all[i], b_all[i], offset = _held(a, b, constant, period)
            states[i + 1] = a_all[i] @ states[i] + b_all[i] @ inputs[i] + offset
            rate[i] = a[VX] @ states[i] + b[VX] @ inputs[i]
            rate_x[i], rate_u[i] = a[VX], b[VX]
        return Linearisation(states, a_all, b_all, rate, rate_x, rate_u)

    def _continuous(self, x: Array, u: Array, heading: float) -> tuple[Array, Array, Array]:
        """Return A (6, 6), B (6, 2) and c (6,) such that A x + B u + c is the field."""
        a, b = matrices(x, u, self.problem.vehicle, self.problem.friction)
        constant = np.zeros(6)
        if self.form == "sinc":
            e = x[PSI] - heading
            sinc = float(np.sinc(e / np.pi))
            c, s = np.cos(heading), np.sin(heading)
            a[X, VX] = a[Y, VY] = c * np.cos(e)
            a[Y, VX] = s * np.cos(e)
            a[X, VY] = -a[Y, VX]
            a[X, PSI] = -(s * x[VX] + c * x[VY]) * sinc
            a[Y, PSI] = (c * x[VX] - s * x[VY]) * sinc
            constant[X], constant[Y] = -a[X, PSI] * heading, -a[Y, PSI] * heading
        return a, b, constant


def _held(a: Array, b: Array, constant: Array, period: float) -> tuple[Array, Array, Array]:
    """Discretise x' = A x + B u + c with u held for a period (s): A, B and c."""
    block = np.zeros((9, 9))
    block[:6, :6], block[:6, 6:8], block[:6, 8] = a, b, constant
    held: Array = expm(block * period)
    return held[:6, :6], held[:6, 6:8], held[:6, 8]


class FrozenLpvMpc(SolvedNmpc):
    """LPV-MPC with frozen matrices, to show what they leave out. Use `lpv-nmpc` to drive.

    Parameters
    ----------
    task
        Task of the agent.
    form
        "literal" or "sinc", see `FrozenLpvSolver`.
    settings
        Keyword arguments of `NmpcSettings`, one by one.

    Raises
    ------
    ValueError
        If a setting is out of range, or the form unknown.
    """

    @forwards_arguments(NmpcSettings)
    def __init__(
        self, settings: dict[str, Any], task: DrivingTask, *, form: str = "literal"
    ) -> None:
        super().__init__(task, NmpcSettings(**settings))
        self.solver = FrozenLpvSolver(self.problem, form=form)
