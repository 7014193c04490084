"""Solver of the NMPC's quadratic program, compiled: active-set guesses, then an interior point.

All arrays are carved out of one workspace.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc import riccati
from agents.nmpc.active_set import HELD, guess, hold, revise
from agents.nmpc.interior_point import (
    FUNCTIONALS,
    START_BARRIER,
    centre_of,
    condense,
    expand,
    start,
    update,
)
from agents.nmpc.program import (
    DAMPING_A,
    DAMPING_DELTA,
    PAIRS,
    clamp,
    follow,
    measure_gaps,
)
from agents.nmpc.riccati import BARRIER, GAIN, SLOPE
from lpv_track_env.bicycle import X
from trajectories.compilation import compiled, compiled_in_place

Array = NDArray[Any]
Float = Any

OPTIMAL, OUT_OF_ITERATIONS, BROKEN = 0, 1, 2
GUESSING, PREDICTING, CORRECTING = 0, 1, 2
"""Phases: the active-set method, then predictor and corrector in turns."""
MAX_GUESSES = 6
MAX_ITERATIONS = 40
"""Of both methods together."""
CAUTION, LEAST_CAUTION = 0.995, 0.9999
"""Share of the way to the nearest bound, at first and near the solution."""
ACCEPTABLE = 1e-6
"""Mean product at which rounding may end the iterations."""


@compiled
def workspace_size(n: int) -> int:
    """Length of the workspace of `solve_qp` for N = n."""
    return 6 * (n + 1) + (2 + GAIN + BARRIER + SLOPE + 10 * PAIRS + FUNCTIONALS + 6 + 1) * n


@compiled_in_place
def solve_qp(
    records: Array, base_states: Array, plan: Array, last: Array, reference: Array, weights: Array,
    limits: Array, tolerance: Float, states: Array, inputs: Array, slack: Array, work: Array,
) -> tuple[int, int]:  # fmt: skip
    """Solve the program linearised along (base_states, plan); returns a code and iterations.

    Fills states (N + 1, 6), inputs (N, 2) and slack (3, N) [vx, vx', vy] with the solution. `last`
    is the input in force, `weights` (10,) are Q, S, R, `limits` (LIMITS_SIZE,) the problem's
    numbers, `work` (workspace_size(N),).
    """
    n = plan.shape[0]
    damping_a, damping_delta = limits[DAMPING_A], limits[DAMPING_DELTA]
    at = 0
    dx = work[at : at + 6 * (n + 1)].reshape(n + 1, 6)
    at += 6 * (n + 1)
    du = work[at : at + 2 * n].reshape(n, 2)
    at += 2 * n
    gains = work[at : at + GAIN * n].reshape(n, GAIN)
    at += GAIN * n
    barrier = work[at : at + BARRIER * n].reshape(BARRIER, n)
    at += BARRIER * n
    slope = work[at : at + SLOPE * n].reshape(SLOPE, n)
    at += SLOPE * n
    pairs = work[at : at + 10 * PAIRS * n].reshape(10, PAIRS, n)
    gaps, t, lam, residual = pairs[0], pairs[1], pairs[2], pairs[3]
    inverse, weight, base, dt, dlam = pairs[4], pairs[5], pairs[6], pairs[7], pairs[8]
    mode = pairs[9]
    at += 10 * PAIRS * n
    functionals = work[at : at + FUNCTIONALS * n].reshape(FUNCTIONALS, n)
    at += FUNCTIONALS * n
    eliminated = work[at : at + 6 * n].reshape(6, n)
    at += 6 * n
    longest = work[at : at + n]

    for i in range(n):
        inputs[i, 0], inputs[i, 1] = plan[i, 0], plan[i, 1]
    for i in range(n + 1):
        for k in range(6):
            states[i, k] = base_states[i, k]
    mu, centre, worst, share = START_BARRIER, 0.0, 0.0, 1.0
    phase, tries, iterations = GUESSING, 0, 0
    changed = True
    # All methods take turns through one loop: each part is called from one place only, which
    # halves the time that compiling takes.
    while True:
        if phase == GUESSING:
            if tries == 0:
                measure_gaps(records, base_states, plan, states, inputs, last, limits, gaps)
                guess(gaps, mode, lam)
            hold(gaps, mode, lam, limits, weight, base, barrier, slope)
        else:
            condense(
                t, lam, residual, share, centre, dt, phase == PREDICTING, limits, inverse, weight,
                base, eliminated, barrier, slope,
            )  # fmt: skip
        if phase == PREDICTING or (phase == GUESSING and changed):
            riccati.factor(records, weights, damping_a, damping_delta, barrier, gains)
        riccati.solve(
            records, gains, weights, damping_a, damping_delta, states, inputs, plan, reference,
            slope, dx, du,
        )  # fmt: skip
        length = 1.0
        if phase != GUESSING:
            length = expand(
                records, dx, du, t, lam, residual, share, limits, inverse, weight, base,
                eliminated, functionals, dt, dlam, longest,
            )  # fmt: skip
        if phase == PREDICTING:
            centre = centre_of(t, lam, dt, dlam, min(1.0, length), mu, longest)
            phase = CORRECTING
            continue
        total = 0.0
        for i in range(n):
            total += du[i, 0] + du[i, 1] + dx[i + 1, X]
        if not math.isfinite(total):
            good = phase != GUESSING and mu <= ACCEPTABLE and share * worst <= ACCEPTABLE
            code = OPTIMAL if good else BROKEN
            return _finish(t, inputs, last, limits, slack, code), iterations
        if phase == CORRECTING:
            length = min(1.0, max(CAUTION, min(1.0 - mu, LEAST_CAUTION)) * length)
            mu = update(t, lam, dt, dlam, length, longest)
            share *= 1.0 - length
        for i in range(n):
            inputs[i, 0] += length * du[i, 0]
            inputs[i, 1] += length * du[i, 1]
        for i in range(n + 1):
            for k in range(6):
                states[i, k] += length * dx[i, k]
        iterations += 1
        if phase == CORRECTING:
            if mu <= tolerance and share * worst <= tolerance:
                return _finish(t, inputs, last, limits, slack, OPTIMAL), iterations
            if iterations >= MAX_ITERATIONS:
                good = mu <= ACCEPTABLE and share * worst <= ACCEPTABLE
                code = OPTIMAL if good else OUT_OF_ITERATIONS
                return _finish(t, inputs, last, limits, slack, code), iterations
            phase = PREDICTING
            continue
        tries += 1
        measure_gaps(records, base_states, plan, states, inputs, last, limits, gaps)
        changed, off = revise(gaps, mode, lam, limits)
        if not changed and off <= HELD:
            for soft in range(3):
                for i in range(n):
                    least = min(gaps[8 + 3 * soft, i], gaps[9 + 3 * soft, i])
                    t[10 + 3 * soft, i] = max(-least, 0.0)
            return _finish(t, inputs, last, limits, slack, OPTIMAL), iterations
        if tries == MAX_GUESSES:
            # Start the interior-point method where all inputs keep their limits.
            clamp(inputs, last, limits)
            follow(records, base_states, plan, inputs, states)
            measure_gaps(records, base_states, plan, states, inputs, last, limits, gaps)
            worst = start(gaps, limits, t, lam, residual)
            phase = PREDICTING


@compiled
def _finish(t: Array, inputs: Array, last: Array, limits: Array, slack: Array, code: int) -> int:
    for soft in range(3):
        for i in range(slack.shape[1]):
            slack[soft, i] = t[10 + 3 * soft, i]
    clamp(inputs, last, limits)
    return code
