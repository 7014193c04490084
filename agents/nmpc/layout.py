"""Layout of the compiled NMPC's arrays. They are few, since each costs compile time.

`constants` are those of a solver: model, discretisation, limits and penalties (CONSTANTS_SIZE),
then the rows of `grid`, N entries each.
`stages` (N + 1, STAGE) has a row for each stage, for the recursions: derivatives of the model
(`linearisation`), gains (`riccati`), three points in the order a, delta, vx, vy, psi, r, X, Y, the
reference, and one more point. The last stage only has a state.
`lanes` (LANES, N) has a row for each quantity, for loops over the inequalities: the processor works
on several stages at a time. Every inequality is a pair (t, lam) with t lam -> 0, PAIRS per stage;
"gap" is the distance to a bound::

     0.. 7   high, low of a, delta, a - a_before, delta - delta_before        t = gap
     8.. 9   high, low of vx at the stage's end,          10  its slack       t = gap + slack
    11..12   high, low of vx' at the stage's start,       13  its slack
    14..15   ratio vx - vy, ratio vx + vy at the end,     16  their slack     t = slack
"""

import numpy as np
from numpy.typing import NDArray

from trajectories.compilation import compiled_in_place

Array = NDArray[np.float64]

# Entries of `constants` after the 7 parameters of the model: fastest lateral pole at 1 m/s by which
# Runge-Kutta steps are chosen (0: the grid's), spacing of the preview and number of its steps
# within the stages, the QP's tolerance; bounds of the action space; of inputs, and of the soft
# constraints on vx, vx' and |vy| / vx; their linear and quadratic penalties; Levenberg terms.
(
    POLE, PREVIEW_PERIOD, PREVIEW_STEPS, TOLERANCE,
    SPACE_LOW_A, SPACE_LOW_DELTA, SPACE_HIGH_A, SPACE_HIGH_DELTA,
    LOW_A, HIGH_A, MAX_DELTA,
    LOW_SPEED, HIGH_SPEED, LOW_RATE, HIGH_RATE, RATIO,
    LINEAR, LINEAR_RATE, LINEAR_RATIO, QUADRATIC, QUADRATIC_RATE, QUADRATIC_RATIO,
    DAMPING_A, DAMPING_DELTA, TYRE,
) = range(7, 32)  # fmt: skip
"""From `TYRE` on the 6 constants of the tyres, see `tyres.constants`."""
GRIP, CONTROL_PERIOD, LEAST_FRICTION, MOST_FRICTION = range(TYRE + 6, TYRE + 10)
"""Largest total acceleration of the reference, m/s^2; the control period, s; and the range in which
friction is estimated, which is empty if it is not."""
CONSTANTS_SIZE = MOST_FRICTION + 1
# Rows of `grid`, an entry a stage: its length (s), Runge-Kutta steps, length by the nominal period,
# weight of a squared change of input by that of a squared rate, largest changes of a and delta,
# share of the way to the next stage's input by which a plan is shifted.
LENGTH, SUBSTEPS, SHARE, SMOOTH, CHANGE_A, CHANGE_DELTA, SHIFT = range(7)
GRID = 7
SLACK_OF = (0, 2, 1)
"""Index of each soft constraint, in the order of this module, among the problem's (vx, vy, vx')."""

# Entries of a stage: derivatives; feedback K (2, 6), M^-1 W (2, 2), M^-1 (3), W (2);
DERIVATIVES = 38
GAIN_A, GAIN_DELTA, CARRY, INVERSE_AA, INVERSE_AD, INVERSE_DD, HOLD_A, HOLD_DELTA = (
    38, 44, 50, 54, 55, 56, 57, 58,
)  # fmt: skip
# the Newton step, the solution so far, the plan of the linearisation, POINT entries each;
STEP_A, STEP_DELTA, STEP_VX, STEP_VY, STEP_PSI, STEP_R, STEP_X, STEP_Y = range(59, 67)
NOW_A, NOW_DELTA, NOW_VX, NOW_VY, NOW_PSI, NOW_R, NOW_X, NOW_Y = range(67, 75)
PLAN_A, PLAN_DELTA, PLAN_VX, PLAN_VY, PLAN_PSI, PLAN_R, PLAN_X, PLAN_Y = range(75, 83)
POINT = 8
# the reference, a node of `agents.reference`, whose first four entries are used;
REFERENCE, REFERENCE_HEADING, REFERENCE_X, REFERENCE_Y = range(83, 87)
# a solution that is kept while another is tried.
KEPT = 88
STAGE = 96
"""A whole number of cache lines."""
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
# Hessian of the cost by the position at the end of each stage.
PRICE_X, PRICE_CROSS, PRICE_Y = range(192, 195)
LANES = 195


@compiled_in_place
def grid(constants: Array, row: int, horizon: int) -> Array:
    """Return a row of the stages' grid, (N,)."""
    first = CONSTANTS_SIZE + row * horizon
    values: Array = constants[first : first + horizon]
    return values


def working_space(horizon: int, solvers: int) -> tuple[Array, Array]:
    """Create `stages` and `lanes` of solvers that work at the same time, (solvers, ...)."""
    return np.zeros((solvers, horizon + 1, STAGE)), np.zeros((solvers, LANES, horizon))
