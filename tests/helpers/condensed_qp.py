"""The NMPC's condensed QP, dense in the inputs alone: it gives the exact cost of a plan.

Every state is an affine function of the moves w = u - ubar from the plan of the linearisation, and
every slack is the least that its soft constraint needs::

    f(w) = 1/2 w' H w + g' w + sum penalty(max(rows w - gaps, 0))
"""

import numpy as np
from numpy.typing import NDArray

from agents.nmpc.linearisation import Linearisation
from agents.nmpc.problem import NOMINAL_PERIOD, NmpcProblem
from experiments.verify.oracles import turns
from lpv_track_env.bicycle import PSI, VX, VY, X, Y
from tests.helpers.nmpc_situations import Situation

Array = NDArray[np.float64]
OUTPUTS = [VX, PSI, X, Y]


class CondensedQp:
    """QP of one situation along its inputs, with CasADi's derivatives."""

    def __init__(
        self,
        problem: NmpcProblem,
        damping: tuple[float, float],
        situation: Situation,
        along: Linearisation,
    ) -> None:
        self.problem, self.situation = problem, situation
        n, car, plan = problem.horizon, problem.vehicle, situation.inputs.ravel()
        influence = np.zeros((n + 1, 6, 2 * n))
        rates = np.zeros((n, 2 * n))
        for i in range(n):
            rates[i] = along.rate_x[i] @ influence[i]
            rates[i, 2 * i : 2 * i + 2] += along.rate_u[i]
            influence[i + 1] = along.A[i] @ influence[i]
            influence[i + 1][:, 2 * i : 2 * i + 2] += along.B[i]
        weights = situation.weights
        share = problem.periods / NOMINAL_PERIOD
        prices = np.concatenate([np.outer(share, weights[:4]).ravel(), weights[4:8]])
        effort = np.outer(share, weights[8:10]).ravel()
        change = np.eye(2 * n) - np.eye(2 * n, k=-2)
        smooth = np.outer(1.0 / (problem.spacings * NOMINAL_PERIOD), weights[10:]).ravel()
        before = np.concatenate([situation.last_input, np.zeros(2 * n - 2)])
        turned = turns(situation.reference)
        outputs = (turned @ influence[:, OUTPUTS]).reshape(-1, 2 * n)
        error = along.states[:, OUTPUTS] - situation.reference
        error = np.einsum("nij,nj->ni", turned, error).ravel()
        self.hessian = outputs.T @ (prices[:, None] * outputs)
        self.hessian += np.diag(effort + np.tile(damping, n))
        self.hessian += change.T @ (smooth[:, None] * change)
        self.gradient = outputs.T @ (prices * error) + effort * plan
        self.gradient += change.T @ (smooth * (change @ plan - before))

        (slow, fast), ratio = car.speed_range, car.max_lateral_velocity_ratio
        braking, driving = car.longitudinal_acceleration_range
        vx, vy = influence[1:, VX], influence[1:, VY]
        vx0, vy0 = along.states[1:, VX], along.states[1:, VY]
        # Each pair shares one slack, of which the larger counts: never are both positive.
        self.rows = np.vstack([-vx, vx, vy - ratio * vx, -vy - ratio * vx, -rates, rates])
        self.gaps = np.concatenate(
            [
                vx0 - slow, fast - vx0,
                ratio * vx0 - vy0, ratio * vx0 + vy0,
                along.rate - braking, driving - along.rate,
            ]
        )  # fmt: skip
        self.linear = np.outer(problem.linear_penalty, np.tile(share, 2)).ravel()
        self.quadratic = np.outer(problem.quadratic_penalty, np.tile(share, 2)).ravel()

    def slack(self, inputs: Array) -> Array:
        """Least slack (N, 3) on (vx, vy, vx')."""
        over = np.maximum(self.rows @ self._moves(inputs) - self.gaps, 0.0)
        return over.reshape(3, 2, -1).max(axis=1).T

    def cost(self, inputs: Array) -> float:
        """f of inputs (N, 2), but for a constant."""
        w = self._moves(inputs)
        over = np.maximum(self.rows @ w - self.gaps, 0.0)
        smooth = 0.5 * w @ self.hessian @ w + self.gradient @ w
        return float(smooth + self.linear @ over + 0.5 * self.quadratic @ over**2)

    def error_of(self, inputs: Array, pairs: int, tolerance: float) -> float:
        """Excess of cost that an interior-point method may leave.

        Its gap is the sum of all products of multiplier and gap, and each multiplier (of a limit
        on a change: a sum of entries of the gradient) times the infeasibility that is left.
        """
        w = self._moves(inputs)
        over = self.rows @ w - self.gaps
        forces = np.where(over > 0.0, self.linear + self.quadratic * over, 0.0)
        gradient = self.hessian @ w + self.gradient + self.rows.T @ forces
        n = len(inputs)
        return float(tolerance * (pairs * n + n * np.abs(gradient).sum()))

    def unconstrained(self) -> Array:
        """Inputs (N, 2) of the least smooth cost: the linear-quadratic regulator's."""
        moves = np.linalg.solve(self.hessian, -self.gradient)
        return self.situation.inputs + moves.reshape(-1, 2)

    def reach(self, gap: float) -> float:
        """How far from the optimum's a plan can lie whose cost exceeds it by `gap`."""
        return float(np.sqrt(2.0 * gap / np.linalg.eigvalsh(self.hessian)[0]))

    def _moves(self, inputs: Array) -> Array:
        return (inputs - self.situation.inputs).ravel()


def excess(problem: NmpcProblem, last: Array, inputs: Array) -> float:
    """By how much inputs (N, 2) break a hard limit; negative where they keep all."""
    low, high = problem.input_bounds
    steps = np.abs(np.diff(np.vstack([last, inputs]), axis=0))
    return float(
        max((low - inputs).max(), (inputs - high).max(), (steps - problem.input_steps).max())
    )


def within(problem: NmpcProblem, last: Array, inputs: Array) -> Array:
    """The nearest inputs, one after another, that keep all hard limits."""
    low, high = problem.input_bounds
    kept, before = np.empty_like(inputs), last
    for i, step in enumerate(problem.input_steps):
        kept[i] = before = inputs[i].clip(before - step, before + step).clip(low, high)
    return kept
