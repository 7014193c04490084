"""What a plan costs, from its inputs alone: NumPy, written apart from every solver."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.nmpc.problem import NmpcProblem
from lpv_track_env.bicycle import PSI, VX, VY, X, Y, derivative

Array = NDArray[np.float64]


class PlanCost(NamedTuple):
    """Price of a plan."""

    cost: float
    """Objective of `agents.nmpc.problem` with the least slack that the soft constraints need."""
    slack: Array
    """(N, 3): by how much vx_{i+1} (m/s), vy_{i+1} (m/s) and vx'(x_i, u_i) (m/s^2) break theirs."""
    excess: float
    """Largest excess over the hard bounds on u and its change; m/s^2 or rad, 0 if all are kept."""


def rolled_out(problem: NmpcProblem, state: Array, inputs: Array) -> Array:
    """States (N + 1, 6) of the inputs (N, 2) from a state (6,): classic Runge-Kutta steps."""
    h, car = problem.period / problem.substeps, problem.vehicle
    states = np.empty((len(inputs) + 1, len(state)))
    states[0] = x = np.asarray(state, dtype=np.float64)
    for i, u in enumerate(inputs):
        for _ in range(problem.substeps):
            k1 = derivative(x, u, car)
            k2 = derivative(x + 0.5 * h * k1, u, car)
            k3 = derivative(x + 0.5 * h * k2, u, car)
            k4 = derivative(x + h * k3, u, car)
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
    """Price of inputs (N, 2) from a state (6,); other arguments as a solver's `solve` takes them.

    Since the penalties grow with the slack, the least slack is the best: the cost of an optimal
    plan is the solver's own objective.
    """
    x, car = rolled_out(problem, state, inputs), problem.vehicle
    q, s, r = weights[:4], weights[4:8], weights[8:]
    error = reference - x[:, [VX, PSI, X, Y]]
    tracking = 0.5 * np.sum(error[:-1] ** 2 * q) + 0.5 * np.sum(error[-1] ** 2 * s)
    effort = 0.5 * np.sum(inputs**2 * r)

    slow, fast = car.speed_range
    braking, driving = car.longitudinal_acceleration_range
    vx, vy = x[1:, VX], x[1:, VY]
    rate = derivative(x[:-1].T, inputs.T, car)[VX]
    beyond = [
        np.maximum(slow - vx, vx - fast),
        np.abs(vy) - car.max_lateral_velocity_ratio * vx,
        np.maximum(braking - rate, rate - driving),
    ]
    slack = np.maximum(np.column_stack(beyond), 0.0)
    penalty = np.sum(slack * problem.linear_penalty)
    penalty += 0.5 * np.sum(slack**2 * problem.quadratic_penalty)

    low, high = problem.input_bounds
    steps = np.diff(np.vstack([last_input, inputs]), axis=0)
    over = [low - inputs, inputs - high, np.abs(steps) - problem.input_steps]
    excess = max(0.0, *(float(values.max()) for values in over))
    return PlanCost(float(tracking + effort + penalty), slack, excess)
