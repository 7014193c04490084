"""The NMPC's problem to convergence, by sequential quadratic programming: not for real time.

The real-time iteration's map from a plan to its program's solution is iterated. Full Gauss-Newton
steps are known to cycle, and shortened ones crawl where the residual is large; so steps are mixed
by Anderson's method (Walker and Ni, "Anderson acceleration for fixed-point iterations", SIAM J.
Numer. Anal. 49, 2011), taken only where the exact cost falls, and else shortened until it does.
"""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.nmpc.layout import (
    HIGH_RATE,
    HIGH_SPEED,
    LOW_RATE,
    LOW_SPEED,
    PLAN_A,
    POINT,
    RATIO,
    SLACKS,
    STEP_A,
    STEP_DELTA,
    STEP_R,
    STEP_VX,
    STEP_VY,
)
from agents.nmpc.linearisation import advance
from agents.nmpc.problem import Status
from agents.nmpc.qp import clamp
from agents.nmpc.rti import cost_of
from agents.nmpc.vectors import taken
from lpv_track_env.bicycle import compiled_field, compiled_inverse_speed
from trajectories.compilation import compiled

Array = NDArray[Any]
Float = Any

STEP_TOLERANCE = 1e-11
"""Largest change of an input at which the plan has converged."""
SHORTEST = 1e-6
"""Least length of a step."""
DEPTH = 10
"""Steps that Anderson's method mixes."""
PATIENCE = 8
"""Steps in a row that may save nothing beyond rounding."""


@compiled
def evaluate(stages: Array, lanes: Array, weights: Array, constants: Array) -> Float:
    """Exact cost of the inputs in the stages' STEP: rolls them out there and fills the slacks."""
    p = constants
    for k in range(2, POINT):
        stages[0, STEP_A + k] = stages[0, PLAN_A + k]
    for i in range(lanes.shape[1]):
        e, end = stages[i], stages[i + 1]
        a, delta = e[STEP_A], e[STEP_DELTA]
        following = advance(taken(e, STEP_VX), a, delta, p)
        for k in range(6):
            end[STEP_VX + k] = following[k]
        rate = compiled_field(
            e[STEP_VX], e[STEP_VY], e[STEP_R], 1.0, 0.0, a, delta, math.cos(delta), math.sin(delta),
            compiled_inverse_speed(e[STEP_VX]), p[0], p[1], p[2], p[3], p[4], p[5], p[6],
        )[0]  # fmt: skip
        vx, vy = end[STEP_VX], end[STEP_VY]
        lanes[SLACKS[0], i] = max(p[LOW_SPEED] - vx, vx - p[HIGH_SPEED], 0.0)
        lanes[SLACKS[1], i] = max(p[LOW_RATE] - rate, rate - p[HIGH_RATE], 0.0)
        lanes[SLACKS[2], i] = max(abs(vy) - p[RATIO] * vx, 0.0)
    return cost_of(stages, lanes, STEP_A, weights, constants)


@compiled
def bound(stages: Array, last_a: Float, last_delta: Float, constants: Array) -> None:
    """Bring the inputs in the stages' STEP within their bounds and rates."""
    clamp(stages, STEP_A, last_a, last_delta, constants)


def converge(
    plan: Array,
    program: Callable[[Array], tuple[Status, Array]],
    cost: Callable[[Array], float],
    bound: Callable[[Array], Array],
    iterations: int,
) -> tuple[Status, Array, int]:
    """Iterate a plan, inputs (N, 2) within their limits, until it no longer changes.

    Parameters
    ----------
    plan
        Where to begin.
    program
        Solution of the quadratic program about a plan, and its status.
    cost
        Exact cost of a plan.
    bound
        A plan brought within the limits of its inputs.
    iterations
        Programs at most.

    Returns
    -------
    status
        SUCCESS, or that of a program that failed.
    plan
        The best one found.
    iterations
        Programs solved.
    """
    price = cost(plan)
    plans: list[Array] = []
    steps: list[Array] = []
    idle = 0
    for count in range(1, iterations + 1):
        status, solution = program(plan)
        if status is not Status.SUCCESS:
            return status, plan, count
        step = solution - plan
        if np.abs(step).max() <= STEP_TOLERANCE:
            return Status.SUCCESS, plan, count
        plans, steps = [*plans, plan][-DEPTH:], [*steps, step][-DEPTH:]
        before = price
        if len(plans) > 1:
            mixed = bound(_mixed(plans, steps))
            found = cost(mixed)
            if found < price:
                plan, price = mixed, found
        length = 1.0
        while price >= before and length > SHORTEST:
            shortened = bound(plan + length * step)
            found = cost(shortened)
            if found < price:
                plan, price = shortened, found
            length *= 0.5
        if price >= before:
            if len(plans) == 1:
                return Status.SUCCESS, plan, count
            plans, steps = [], []
        idle = idle + 1 if before - price <= 1e-15 * abs(before) else 0
        if idle > PATIENCE:
            return Status.SUCCESS, plan, count
    return Status.SUCCESS, plan, iterations


def _mixed(plans: list[Array], steps: list[Array]) -> Array:
    """Anderson's next plan: the step that is least, to first order, among mixtures."""
    changes = np.array([b - a for a, b in pairwise(steps)])
    moves = np.array([b - a for a, b in pairwise(plans)])
    shares = np.linalg.lstsq(changes.reshape(len(changes), -1).T, steps[-1].ravel(), rcond=1e-10)[0]
    return plans[-1] + steps[-1] - np.tensordot(shares, moves + changes, axes=1)
