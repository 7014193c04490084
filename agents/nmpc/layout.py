"""Where the compiled NMPC keeps its numbers: few arrays, for each costs time to compile.

`constants` (CONSTANTS_SIZE,) are those of a solver: model, discretisation, limits and prices.
`stages` (N + 1, STAGE) has everything about a stage side by side, for the recursions: a record of
the model's derivatives (`linearisation`), gains (`riccati`), three points in the order a, delta,
vx, vy, psi, r, X, Y, the reference, and one more point. The last stage has a state only.
`lanes` (LANES, N) has one quantity of all stages side by side, for loops over the inequalities, of
which a processor takes several stages at a time. Every inequality is a pair (t, lam) with
t lam -> 0, PAIRS to a stage; with "gap" for the distance to a bound::

     0.. 7   high, low of a, delta, a - a_before, delta - delta_before        t = gap
     8.. 9   high, low of vx at the period's end,         10  its slack       t = gap + slack
    11..12   high, low of vx' at the period's start,      13  its slack
    14..15   ratio vx - vy, ratio vx + vy at the end,     16  their slack     t = slack
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of `constants`: 7 of the model, then
(
    SUBSTEP, SUBSTEPS, PERIOD, SHIFT, TOLERANCE,
    SPACE_LOW_A, SPACE_LOW_DELTA, SPACE_HIGH_A, SPACE_HIGH_DELTA,
    LOW_A, HIGH_A, MAX_DELTA, CHANGE_A, CHANGE_DELTA, FIRST_CHANGE_A, FIRST_CHANGE_DELTA,
    LOW_SPEED, HIGH_SPEED, LOW_RATE, HIGH_RATE, RATIO,
    LINEAR, LINEAR_RATE, LINEAR_RATIO, QUADRATIC, QUADRATIC_RATE, QUADRATIC_RATIO,
    DAMPING_A, DAMPING_DELTA,
) = range(7, 36)  # fmt: skip
"""Seconds and number of Runge-Kutta steps, the period, the share of it by which plans move on, the
program's tolerance; bounds of the action space, of inputs, of their changes, and of the soft
constraints on vx, vx' and |vy| / vx; their linear and quadratic prices; Levenberg terms."""
CONSTANTS_SIZE = 36
SLACK_OF = (0, 2, 1)
"""Index in the problem's penalties (vx, vy, vx') of the soft constraints in their order here."""

# Of a stage: the record of `RECORD` numbers, then gains of its feedback,
RECORD = 37
GAIN_A, GAIN_DELTA, CARRY, INVERSE_AA, INVERSE_AD, INVERSE_DD, HOLD_A, HOLD_DELTA = (
    37, 43, 49, 53, 54, 55, 56, 57,
)  # fmt: skip
"""K (2, 6); M^-1 W (2, 2); M^-1 (3); W (2)."""
# the Newton step, the solution so far, what the program is linearised along: 8 numbers each,
STEP_A, STEP_DELTA, STEP_VX, STEP_VY, STEP_PSI, STEP_R, STEP_X, STEP_Y = range(58, 66)
NOW_A, NOW_DELTA, NOW_VX, NOW_VY, NOW_PSI, NOW_R, NOW_X, NOW_Y = range(66, 74)
PLAN_A, PLAN_DELTA, PLAN_VX, PLAN_VY, PLAN_PSI, PLAN_R, PLAN_X, PLAN_Y = range(74, 82)
POINT = 8
# the reference: a node of `agents.reference`, of which the first four are read;
REFERENCE, REFERENCE_HEADING, REFERENCE_X, REFERENCE_Y = range(82, 86)
# and a solution kept while another is tried.
KEPT = 87
STAGE = 96
"""Rounded up to whole cache lines."""
SENSITIVITY = RECORD
"""Scratch of `linearisation`, 30 numbers, where gains and step come later."""

# Of the lanes: PAIRS rows each, the gaps first,
PAIRS = 17
GAP, T, LAM, RESIDUAL, INVERSE, WEIGHT, FORCE, DT, DLAM, MODE = range(0, 10 * PAIRS, PAIRS)
"""Gap; t; lam; t - gap; 1 / t; lam / t; the multiplier that a step of no length would give; steps
of t and lam; the guess about a constraint."""
SLACKS = (T + 10, T + 13, T + 16)
"""Slack of the soft constraints on vx, vx' and vy."""
# then of eliminated slacks the numerators and 1 / denominators,
TOP, TOP_RATE, TOP_RATIO, BOTTOM, BOTTOM_RATE, BOTTOM_RATIO = range(170, 176)
LONGEST = 176
"""Scratch of reductions over the pairs."""
# and what the inequalities add to a stage's Hessian and gradient.
(
    BARRIER_A, BARRIER_DELTA, BARRIER_CHANGE_A, BARRIER_CHANGE_DELTA, BARRIER_RATE,
    BARRIER_VX, BARRIER_CROSS, BARRIER_VY,
) = range(177, 185)  # fmt: skip
(
    SLOPE_A, SLOPE_DELTA, SLOPE_CHANGE_A, SLOPE_CHANGE_DELTA, SLOPE_RATE, SLOPE_VX, SLOPE_VY,
) = range(185, 192)  # fmt: skip
LANES = 192


def working_space(horizon: int, solvers: int) -> tuple[Array, Array]:
    """`stages` and `lanes` of as many solvers as work at a time, (solvers, ...)."""
    return np.zeros((solvers, horizon + 1, STAGE)), np.zeros((solvers, LANES, horizon))
