"""Guesses about which inequalities of the NMPC's quadratic program bind, compiled.

A guess calls every inequality FREE, BINDING or BROKEN_SOFT. With it the program is one with
equations, solved by an augmented Lagrangian; what that solution breaks or holds by a multiplier of
the wrong sign mends the guess. Where the guess stands it is the solution, to rounding. Arrays are
those of `layout`.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import layout as L
from agents.nmpc.linearisation import RATE, RATE_DELTA, RATE_R, RATE_VX, RATE_VY
from trajectories.compilation import compiled_internal

Array = NDArray[Any]
Float = Any

FREE, BINDING, BROKEN_SOFT = 0.0, 1.0, 2.0
"""What a guess makes of a constraint: it is kept by itself, holds as an equation, is broken."""
NEAR = 1e-4
"""Gap below which a constraint of the plan is guessed to bind."""
HELD = 1e-9
"""Largest gap of a constraint that binds."""
SLIGHT = 1e-9
"""Multiplier below zero at which a constraint is freed."""
STIFFNESS = 1e6
"""Of the augmented Lagrangian. Stiffer, rounding in the recursion drowns small multipliers and the
guesses go round in circles; softer, it takes more turns to hold what binds."""


@compiled_internal
def measure_gaps(
    stages: Array, lanes: Array, last_a: Float, last_delta: Float, constants: Array
) -> None:
    """Fill the gaps of linearised constraints; the rows of slacks are left alone."""
    low_a, high_a, max_delta = constants[L.LOW_A], constants[L.HIGH_A], constants[L.MAX_DELTA]
    ratio = constants[L.RATIO]
    before_a, before_delta = last_a, last_delta
    most_a, most_delta = constants[L.FIRST_CHANGE_A], constants[L.FIRST_CHANGE_DELTA]
    gap = lanes[L.GAP : L.GAP + L.PAIRS]
    for i in range(gap.shape[1]):
        e, end = stages[i], stages[i + 1]
        a, delta = e[L.NOW_A], e[L.NOW_DELTA]
        gap[0, i], gap[1, i] = high_a - a, a - low_a
        gap[2, i], gap[3, i] = max_delta - delta, delta + max_delta
        change_a, change_delta = a - before_a, delta - before_delta
        gap[4, i], gap[5, i] = most_a - change_a, change_a + most_a
        gap[6, i], gap[7, i] = most_delta - change_delta, change_delta + most_delta
        vx, vy = end[L.NOW_VX], end[L.NOW_VY]
        gap[8, i], gap[9, i] = constants[L.HIGH_SPEED] - vx, vx - constants[L.LOW_SPEED]
        rate = e[RATE] + e[RATE_VX] * (e[L.NOW_VX] - e[L.PLAN_VX])
        rate += e[RATE_VY] * (e[L.NOW_VY] - e[L.PLAN_VY])
        rate += e[RATE_R] * (e[L.NOW_R] - e[L.PLAN_R])
        rate += a - e[L.PLAN_A] + e[RATE_DELTA] * (delta - e[L.PLAN_DELTA])
        gap[11, i], gap[12, i] = constants[L.HIGH_RATE] - rate, rate - constants[L.LOW_RATE]
        gap[14, i], gap[15, i] = ratio * vx - vy, ratio * vx + vy
        before_a, before_delta = a, delta
        most_a, most_delta = constants[L.CHANGE_A], constants[L.CHANGE_DELTA]


@compiled_internal
def is_slack(pair: int) -> bool:
    """Whether a pair is a slack's own bound."""
    return pair >= 8 and (pair - 8) % 3 == 2


@compiled_internal
def guess(lanes: Array) -> None:
    """Guess which constraints hold as equations, or are broken, from a plan's gaps."""
    for k in range(L.PAIRS):
        gap, mode, lam = lanes[L.GAP + k], lanes[L.MODE + k], lanes[L.LAM + k]
        near = -math.inf if is_slack(k) else NEAR
        broken = -NEAR if k >= 8 else -math.inf
        for i in range(lanes.shape[1]):
            lam[i] = 0.0
            found = BINDING if gap[i] < near else FREE
            mode[i] = BROKEN_SOFT if gap[i] < min(near, broken) else found


@compiled_internal
def identify(lanes: Array) -> None:
    """Guess which constraints bind, or are broken, from the interior-point method's pairs.

    Its multipliers are kept in the rows of their steps: see `recall`.
    """
    for k in range(L.PAIRS):
        # Hard ones have no slack; each soft constraint's is the third of its pairs.
        own = k + 2 - (k - 8) % 3 if k >= 8 else k
        for i in range(lanes.shape[1]):
            lam, found = lanes[L.LAM + k, i], FREE
            if lam > lanes[L.T + k, i] and not is_slack(k):
                found = BINDING
                if own > k and lanes[L.T + own, i] > lanes[L.LAM + own, i]:
                    found = BROKEN_SOFT
            lanes[L.DLAM + k, i], lanes[L.MODE + k, i] = lam, found
    for k in range(L.PAIRS):
        for i in range(lanes.shape[1]):
            if lanes[L.MODE + k, i] != BINDING:
                lanes[L.LAM + k, i] = 0.0


@compiled_internal
def recall(lanes: Array) -> None:
    """Give the interior-point method its multipliers back."""
    for k in range(L.PAIRS):
        for i in range(lanes.shape[1]):
            lanes[L.LAM + k, i] = lanes[L.DLAM + k, i]


@compiled_internal
def hold(lanes: Array, constants: Array) -> None:
    """Fill barrier and slope for an equality-constrained step.

    Binding constraints by an augmented Lagrangian, broken soft ones by their price.
    """
    for k in range(L.PAIRS):
        gap, mode, lam = lanes[L.GAP + k], lanes[L.MODE + k], lanes[L.LAM + k]
        weight, force = lanes[L.WEIGHT + k], lanes[L.FORCE + k]
        linear = quadratic = 0.0
        if k >= 8:
            kind = (k - 8) // 3
            linear, quadratic = constants[L.LINEAR + kind], constants[L.QUADRATIC + kind]
        for i in range(lanes.shape[1]):
            held, pull = 0.0, 0.0
            if mode[i] == BINDING:
                held, pull = STIFFNESS, lam[i] - STIFFNESS * gap[i]
            if mode[i] == BROKEN_SOFT:
                held, pull = quadratic, linear - quadratic * gap[i]
            weight[i], force[i] = held, pull
    ratio = constants[L.RATIO]
    w, b = lanes[L.WEIGHT : L.WEIGHT + L.PAIRS], lanes[L.FORCE : L.FORCE + L.PAIRS]
    for i in range(lanes.shape[1]):
        for f in range(4):
            lanes[L.SLOPE_A + f, i] = b[2 * f, i] - b[2 * f + 1, i]
            lanes[L.BARRIER_A + f, i] = w[2 * f, i] + w[2 * f + 1, i]
        lanes[L.SLOPE_RATE, i], lanes[L.BARRIER_RATE, i] = b[11, i] - b[12, i], w[11, i] + w[12, i]
        right, left, both = b[14, i], b[15, i], w[14, i] + w[15, i]
        lanes[L.SLOPE_VX, i] = b[8, i] - b[9, i] - ratio * (right + left)
        lanes[L.SLOPE_VY, i] = right - left
        lanes[L.BARRIER_VX, i] = w[8, i] + w[9, i] + ratio * ratio * both
        lanes[L.BARRIER_CROSS, i] = ratio * (w[15, i] - w[14, i])
        lanes[L.BARRIER_VY, i] = both


@compiled_internal
def revise(lanes: Array, constants: Array) -> tuple[int, Float]:
    """Mend the guess after a step; in how many places, and by how much what binds is missed."""
    changed, off = 0, 0.0
    for k in range(L.PAIRS):
        if is_slack(k):
            continue
        gaps, mode, lam = lanes[L.GAP + k], lanes[L.MODE + k], lanes[L.LAM + k]
        linear = constants[L.LINEAR + (k - 8) // 3] if k >= 8 else math.inf
        for i in range(lanes.shape[1]):
            gap, was = gaps[i], mode[i]
            if was == FREE:
                if gap < -HELD:
                    mode[i], lam[i] = BINDING, 0.0
                    changed += 1
            elif was == BINDING:
                force = lam[i] - STIFFNESS * gap
                if force < -SLIGHT:
                    mode[i], lam[i] = FREE, 0.0
                    changed += 1
                elif force > linear:
                    mode[i] = BROKEN_SOFT
                    changed += 1
                else:
                    lam[i] = force
                    off = max(off, abs(gap))
            elif gap > HELD:
                mode[i], lam[i] = BINDING, linear
                changed += 1
    return changed, off


@compiled_internal
def take_slacks(lanes: Array) -> None:
    """Fill the slacks with what the gaps of the soft constraints leave them no choice but to be."""
    for i in range(lanes.shape[1]):
        for first in (8, 11, 14):
            least = min(lanes[L.GAP + first, i], lanes[L.GAP + first + 1, i])
            lanes[L.T + first + 2, i] = max(-least, 0.0)
