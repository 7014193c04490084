"""Score that weights are tuned for: tracking and comfort of a drive, lower is better.

Each part is a root mean square over the drive, divided by its scale::

    tracking = rms(lateral error) / 0.05 m + rms(heading error) / 0.1 rad
               + rms(speed error) / 0.5 m/s
    comfort  = rms(steering rate) / 0.2 rad/s + rms(jerk) / 4 m/s^3
    score    = tracking + comfort

It is computed from the true motion of the vehicle, not from measurements or commands. A drive that
leaves the road, turns around or breaks down scores `FAILED`. The scales were chosen before anything
was tuned. Lateral error: 3.5 cm of error in the fixes with 3.5 cm of control error; heading error:
the sideslip lr kappa of the default vehicle in a bend of 17 m, which no weights can avoid; speed
error: the effect of the jerk limit at a start; steering rate: two fifths of its limit; jerk: four
fifths of its limit.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.closed_loop import Tally
from lpv_track_env import kernels as k

Array = NDArray[Any]

PARTS = ("lateral", "heading", "speed", "steering_rate", "jerk")
SCALES = np.array([0.05, 0.1, 0.5, 0.2, 4.0])
"""Scales of the parts, m, rad, m/s, rad/s, m/s^3."""
TRACKING, COMFORT = slice(0, 3), slice(3, 5)
FAILED = 25.0
"""Score of a failed drive."""
FAILURES = (k.LEFT_CORRIDOR, k.WRONG_HEADING, k.NON_FINITE)
"""Codes of the ends with which a drive has failed."""

USUAL = np.array([0.05, 0.03, 0.1, 0.08, 0.8])
"""Root mean squares of a typical drive, m, rad, m/s, rad/s, m/s^3."""
USUAL_WINDOWS = 5
"""Number of windows of typical driving with which the statistics of every drive begin."""


def squares_of(tally: Tally) -> Array:
    """Stack the sums of squares of the five parts, (n, 5), in their own units."""
    return np.stack(
        [
            tally.lateral_square,
            tally.heading_square,
            tally.speed_square,
            tally.steering_rate_square,
            tally.jerk_square,
        ],
        axis=1,
    )


def parts_of(tally: Tally) -> Array:
    """Compute the five parts of the score, (n, 5); 0 before the first control period."""
    steps = np.maximum(tally.steps, 1.0)[:, None]
    parts: Array = np.sqrt(squares_of(tally) / steps) / SCALES
    return parts


def rms_so_far(squares: Array, steps: Array, periods: int) -> Array:
    """Compute root mean squares of drives, (n, 5), preceded by `USUAL_WINDOWS` of typical driving.

    Parameters
    ----------
    squares, steps
        Sums of squares (n, 5) over control periods (n,).
    periods
        Number of control periods in a whole window.
    """
    before = float(USUAL_WINDOWS * periods)
    rms: Array = np.sqrt((before * USUAL**2 + squares) / (before + steps[:, None]))
    return rms


def marginal_parts(window: Tally, drive: Tally, periods: int) -> Array:
    """Compute the contribution of a window to the parts of its drive's score, (n, 5).

    A root mean square is not a sum over windows. To first order around the drive's rms rho,

        rms = mean over windows of (mean square / rho + rho) / 2

    so the mean over many windows approaches the drive's part and has the same minimiser. rho is the
    rms of the drive up to the end of this window, preceded by `USUAL_WINDOWS` of typical driving.

    Parameters
    ----------
    window, drive
        Sums over the window, and over the drive up to its end.
    periods
        Number of control periods in a whole window.
    """
    steps = np.maximum(window.steps, 1.0)[:, None]
    rho = rms_so_far(squares_of(drive), drive.steps, periods)
    parts: Array = 0.5 * (squares_of(window) / steps / rho + rho) / SCALES
    return parts


def failed(ends: Array) -> Array:
    """Return which drives have failed, given the codes of their ends, (n,) bool."""
    return np.isin(ends, FAILURES)


def scores_of(tally: Tally, ends: Array) -> Array:
    """Compute the scores of whole drives, (n,)."""
    scores: Array = np.where(failed(ends), FAILED, parts_of(tally).sum(axis=1))
    return scores
