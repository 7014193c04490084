"""The discrete model's derivatives by CasADi's automatic differentiation."""

from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from agents.nmpc.casadi_solver import discrete_model, lpv_field
from agents.nmpc.problem import INPUTS, STATES, NmpcProblem

Array = NDArray[np.float64]


class Derivatives(NamedTuple):
    """The model along a roll-out: x_{i+1} = F(x_i, u_i) and its derivatives."""

    states: Array
    """(N + 1, 6)."""
    A: Array
    """dF/dx, (N, 6, 6)."""
    B: Array
    """dF/du, (N, 6, 2)."""
    rate: Array
    """vx'(x_i, u_i), (N,), m/s^2."""
    rate_x: Array
    """dvx'/dx, (N, 6)."""
    rate_u: Array
    """dvx'/du, (N, 2)."""


class CasadiDerivatives:
    """Derivatives of one problem's model.

    Parameters
    ----------
    problem
        The problem.
    """

    def __init__(self, problem: NmpcProblem) -> None:
        x, u = ca.SX.sym("x", STATES), ca.SX.sym("u", INPUTS)
        following, rate = discrete_model(problem)(x, u), lpv_field(x, u, problem)[0]
        outputs = [
            expression
            for value in (following, rate)
            for expression in (value, ca.jacobian(value, x), ca.jacobian(value, u))
        ]
        self._function = ca.Function("derivatives", [x, u], outputs)

    def along(self, state: Array, inputs: Array) -> Derivatives:
        """Roll the inputs (N, 2) out from a state (6,) and differentiate on the way."""
        n = len(inputs)
        result = Derivatives(
            np.empty((n + 1, STATES)),
            np.empty((n, STATES, STATES)),
            np.empty((n, STATES, INPUTS)),
            np.empty(n),
            np.empty((n, STATES)),
            np.empty((n, INPUTS)),
        )
        result.states[0] = state
        for i, u in enumerate(inputs):
            values = [np.asarray(value) for value in self._function(result.states[i], u)]
            result.states[i + 1] = values[0].ravel()
            result.A[i], result.B[i], result.rate[i] = values[1], values[2], values[3].item()
            result.rate_x[i], result.rate_u[i] = values[4].ravel(), values[5].ravel()
        return result
