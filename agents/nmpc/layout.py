"""Layout of the compiled NMPC's arrays. They are few, since each costs compile time.

`constants` (CONSTANTS_SIZE,) are those of a solver: model, discretisation, limits and penalties.
`stages` (N + 1, STAGE) has a row for each stage, for the recursions: derivatives of the model
(`linearisation`), gains (`riccati`), three points in the order a, delta, vx, vy, psi, r, X, Y, the
reference, and one more point. The last stage only has a state.
`lanes` (LANES, N) has a row for each quantity, for loops over the inequalities: the processor works
on several stages at a time. Every inequality is a pair (t, lam) with t lam -> 0, PAIRS per stage;
"gap" is the distance to a bound::

     0.. 7   high, low of a, delta, a - a_before, delta - delta_before        t = gap
     8.. 9   high, low of vx at the period's end,         10  its slack       t = gap + slack
    11..12   high, low of vx' at the period's start,      13  its slack
    14..15   ratio vx - vy, ratio vx + vy at the end,     16  their slack     t = slack
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Entries of `constants` after the 7 parameters of the model: length (s) and number of Runge-Kutta
# steps, period, share of a period by which plans are shifted, the QP's tolerance; bounds of the
# action space; of inputs, of their changes, and of the soft constraints on vx, vx' and |vy| / vx;
# their linear and quadratic penalties; Levenberg terms.
(
    SUBSTEP, SUBSTEPS, PERIOD, SHIFT, TOLERANCE,
    SPACE_LOW_A, SPACE_LOW_DELTA, SPACE_HIGH_A, SPACE_HIGH_DELTA,
    LOW_A, HIGH_A, MAX_DELTA, CHANGE_A, CHANGE_DELTA, FIRST_CHANGE_A, FIRST_CHANGE_DELTA,
    LOW_SPEED, HIGH_SPEED, LOW_RATE, HIGH_RATE, RATIO,
    LINEAR, LINEAR_RATE, LINEAR_RATIO, QUADRATIC, QUADRATIC_RATE, QUADRATIC_RATIO,
    DAMPING_A, DAMPING_DELTA,
) = range(7, 36)  # fmt: skip
CONSTANTS_SIZE = 36
SLACK_OF = (0, 2, 1)
"""Index of each soft constraint, in the order of this module, among the problem's (vx, vy, vx')."""

# Entries of a stage: derivatives; feedback K (2, 6), M^-1 W (2, 2), M^-1 (3), W (2);
DERIVATIVES = 37
GAIN_A, GAIN_DELTA, CARRY, INVERSE_AA, INVERSE_AD, INVERSE_DD, HOLD_A, HOLD_DELTA = (
    37, 43, 49, 53, 54, 55, 56, 57,
)  # fmt: skip
# the Newton step, the solution so far, the plan of the linearisation, POINT entries each;
STEP_A, STEP_DELTA, STEP_VX, STEP_VY, STEP_PSI, STEP_R, STEP_X, STEP_Y = range(58, 66)
NOW_A, NOW_DELTA, NOW_VX, NOW_VY, NOW_PSI, NOW_R, NOW_X, NOW_Y = range(66, 74)
PLAN_A, PLAN_DELTA, PLAN_VX, PLAN_VY, PLAN_PSI, PLAN_R, PLAN_X, PLAN_Y = range(74, 82)
POINT = 8
# the reference, a node of `agents.reference`, whose first four entries are used;
REFERENCE, REFERENCE_HEADING, REFERENCE_X, REFERENCE_Y = range(82, 86)
# a solution that is kept while another is tried.
KEPT = 87
STAGE = 96
"""Rounded up to whole cache lines."""
SENSITIVITY = DERIVATIVES
"""First of 30 working entries of `linearisation`; gains and step overwrite them later."""

# Rows of the lanes, PAIRS rows each: gap; t; lam; t - gap; 1 / t; lam / t; multiplier after a step
# of length zero; steps of t and lam; mode of the constraint in the active set.
PAIRS = 17
GAP, T, LAM, RESIDUAL, INVERSE, WEIGHT, FORCE, DT, DLAM, MODE = range(0, 10 * PAIRS, PAIRS)
SLACKS = (T + 10, T + 13, T + 16)
"""Rows of the slacks on vx, vx' and vy."""
# Numerators and inverse denominators of the eliminated slacks.
TOP, TOP_RATE, TOP_RATIO, BOTTOM, BOTTOM_RATE, BOTTOM_RATIO = range(170, 176)
LONGEST = 176
"""Working row of reductions over the pairs."""
# Terms of the inequalities in a stage's Hessian and gradient.
(
    BARRIER_A, BARRIER_DELTA, BARRIER_CHANGE_A, BARRIER_CHANGE_DELTA, BARRIER_RATE,
    BARRIER_VX, BARRIER_CROSS, BARRIER_VY,
) = range(177, 185)  # fmt: skip
(
    SLOPE_A, SLOPE_DELTA, SLOPE_CHANGE_A, SLOPE_CHANGE_DELTA, SLOPE_RATE, SLOPE_VX, SLOPE_VY,
) = range(185, 192)  # fmt: skip
LANES = 192


def working_space(horizon: int, solvers: int) -> tuple[Array, Array]:
    """Create `stages` and `lanes` of solvers that work at the same time, (solvers, ...)."""
    return np.zeros((solvers, horizon + 1, STAGE)), np.zeros((solvers, LANES, horizon))
