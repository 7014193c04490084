"""The NMPC's problem to convergence, by sequential quadratic programming: not for real time.

Gauss-Newton steps of the real-time iteration, each shortened or lengthened until the exact cost of
the rolled-out plan falls. Full steps are known to cycle.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc.interior_point import (
    HIGH_RATE,
    HIGH_SPEED,
    LOW_RATE,
    LOW_SPEED,
    RATIO,
    clamp,
)
from agents.nmpc.linearisation import roll_out
from agents.nmpc.rti import COST, LIMITS, STEP, SUBSTEPS, SUCCESS, cost_of, iterate
from lpv_track_env.bicycle import VX, VY, YAW_RATE, compiled_field, compiled_inverse_speed
from trajectories.compilation import compiled

Array = NDArray[Any]
Float = Any

STEP_TOLERANCE = 1e-11
"""Largest change of an input at which the plan has converged."""
SHORTEST, LONGEST = 2.0**-20, 2.0**8
"""Bounds of a step's length."""
PATIENCE = 5
"""Steps in a row that may save next to nothing."""


@compiled
def evaluate(
    states: Array, inputs: Array, slack: Array, reference: Array, weights: Array, constants: Array
) -> Float:
    """Exact cost of a plan: states (N + 1, 6) are its roll-out; fills slack (3, N)."""
    p, limits = constants, constants[LIMITS:]
    for i in range(inputs.shape[0]):
        a, delta, x = inputs[i, 0], inputs[i, 1], states[i]
        rate = compiled_field(
            x[VX], x[VY], x[YAW_RATE], 1.0, 0.0, a, delta, math.cos(delta), math.sin(delta),
            compiled_inverse_speed(x[VX]), p[0], p[1], p[2], p[3], p[4], p[5], p[6],
        )[0]  # fmt: skip
        vx, vy = states[i + 1, VX], states[i + 1, VY]
        slack[0, i] = max(limits[LOW_SPEED] - vx, vx - limits[HIGH_SPEED], 0.0)
        slack[1, i] = max(limits[LOW_RATE] - rate, rate - limits[HIGH_RATE], 0.0)
        slack[2, i] = max(abs(vy) - limits[RATIO] * vx, 0.0)
    return cost_of(states, inputs, slack, reference, weights, limits)


@compiled
def converge(
    state: Array, last: Array, reference: Array, weights: Array, constants: Array, plan: Array,
    states: Array, inputs: Array, slack: Array, trial: Array, best: Array, told: Array,
    iterations: int, work: Array,
) -> int:  # fmt: skip
    """Improve `plan` (N, 2) in place by at most `iterations` programs; returns the last code.

    Fills states (N + 1, 6) with the plan's roll-out, slack (3, N) and the cost in `told`. `inputs`,
    `trial` and `best` (N, 2) are scratch.
    """
    h, substeps, limits = constants[STEP], int(constants[SUBSTEPS]), constants[LIMITS:]
    clamp(plan, last, limits)
    for k in range(6):
        states[0, k] = state[k]
    cost, idle, first, code = math.inf, 0, 1.0, SUCCESS
    for _ in range(iterations):
        code = iterate(
            state, last, reference, weights, constants, plan, states, inputs, slack, told, work
        )
        if code != SUCCESS:
            return code
        if math.isinf(cost):
            roll_out(plan, constants, h, substeps, states)
            cost = evaluate(states, plan, slack, reference, weights, constants)
        largest = 0.0
        for i in range(plan.shape[0]):
            for k in range(2):
                largest = max(largest, abs(inputs[i, k] - plan[i, k]))
        # Double the step while that helps; else halve it until it helps.
        before, length, growing = cost, first, True
        while SHORTEST <= length <= LONGEST:
            for i in range(plan.shape[0]):
                for k in range(2):
                    trial[i, k] = plan[i, k] + length * (inputs[i, k] - plan[i, k])
            clamp(trial, last, limits)
            roll_out(trial, constants, h, substeps, states)
            found = evaluate(states, trial, slack, reference, weights, constants)
            if found < cost:
                cost, first = found, length
                best[:] = trial
                if not growing:
                    break
                length *= 2.0
            elif cost < before:
                break
            else:
                growing = False
                length *= 0.5
        if cost < before:
            plan[:] = best
        idle = idle + 1 if before - cost <= 1e-14 * abs(before) else 0
        if largest <= STEP_TOLERANCE or idle >= PATIENCE:
            break
        if cost >= before:
            first = 1.0
    roll_out(plan, constants, h, substeps, states)
    told[COST] = evaluate(states, plan, slack, reference, weights, constants)
    return code
