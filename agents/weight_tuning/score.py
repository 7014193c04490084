"""The score that weights are tuned for: tracking and comfort of a drive, of the truth.

Lower is better. Each part is a root mean square over the drive by its scale::

    tracking = rms(lateral error) / 0.05 m + rms(heading error) / 0.1 rad
               + rms(speed error) / 0.5 m/s
    comfort  = rms(steering rate) / 0.2 rad/s + rms(jerk) / 4 m/s^3
    score    = tracking + comfort

of what the vehicle does, not of what is measured or commanded; a drive that leaves the road, turns
around or breaks down scores `FAILED`. The scales are a choice, made before anything was tuned: an
error of fixes and one of control of some 3.5 cm each; the sideslip lr kappa of the default vehicle
in a bend of 17 m, which no weights can avoid; what the jerk limit costs at a start; two fifths of
the steering's rate limit and four fifths of that of jerk.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.closed_loop import Tally
from lpv_track_env import kernels as k

Array = NDArray[Any]

PARTS = ("lateral", "heading", "speed", "steering_rate", "jerk")
SCALES = np.array([0.05, 0.1, 0.5, 0.2, 4.0])
"""m, rad, m/s, rad/s, m/s^3."""
TRACKING, COMFORT = slice(0, 3), slice(3, 5)
FAILED = 25.0
FAILURES = (k.LEFT_CORRIDOR, k.WRONG_HEADING, k.NON_FINITE)
"""Codes of ends that fail a drive."""


USUAL = np.array([0.05, 0.03, 0.1, 0.08, 0.8])
"""Root mean squares of usual drives, m, rad, m/s, rad/s, m/s^3: what a drive's own begin from."""
USUAL_WINDOWS = 5
"""Windows of usual driving that a drive's own root mean squares are made with."""


def squares_of(tally: Tally) -> Array:
    """Sums of squares of the five, (n, 5), in their own units."""
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
    """The five parts of what was driven, (n, 5); 0 where nothing was."""
    steps = np.maximum(tally.steps, 1.0)[:, None]
    parts: Array = np.sqrt(squares_of(tally) / steps) / SCALES
    return parts


def rms_so_far(squares: Array, steps: Array, periods: int) -> Array:
    """Root mean squares of drives, (n, 5), after `USUAL_WINDOWS` of usual driving.

    Parameters
    ----------
    squares, steps
        Sums of squares (n, 5) over control periods (n,).
    periods
        Control periods of a whole window.
    """
    before = float(USUAL_WINDOWS * periods)
    rms: Array = np.sqrt((before * USUAL**2 + squares) / (before + steps[:, None]))
    return rms


def marginal_parts(window: Tally, drive: Tally, periods: int) -> Array:
    """What a window adds to the parts of its drive's score, (n, 5), a part to a usual window.

    A root mean square is no sum over windows; to first order around the drive's own rms rho,

        rms = mean over windows of (mean square / rho + rho) / 2

    so that many windows' mean is the drive's part, and what makes it least is the same. rho is the
    drive's so far, `drive` with this window, after `USUAL_WINDOWS` of usual driving.

    Parameters
    ----------
    window, drive
        What was driven in the window, and in the drive up to its end.
    periods
        Control periods of a whole window.
    """
    steps = np.maximum(window.steps, 1.0)[:, None]
    rho = rms_so_far(squares_of(drive), drive.steps, periods)
    parts: Array = 0.5 * (squares_of(window) / steps / rho + rho) / SCALES
    return parts


def failed(ends: Array) -> Array:
    """Which drives have failed, by the codes of their ends, (n,) bool."""
    return np.isin(ends, FAILURES)


def scores_of(tally: Tally, ends: Array) -> Array:
    """Scores of whole drives, (n,)."""
    scores: Array = np.where(failed(ends), FAILED, parts_of(tally).sum(axis=1))
    return scores
