"""The score that weights are tuned for: tracking and comfort of a drive, of the truth.

Lower is better. Each part is a root mean square over the drive by its scale::

    tracking = rms(lateral error) / 0.05 m + rms(heading error) / 0.1 rad
               + rms(speed error) / 0.5 m/s
    comfort  = rms(steering rate) / 0.2 rad/s + rms(jerk) / 4 m/s^3
    score    = tracking + comfort

of what the vehicle does, not of what is measured or commanded; a drive that leaves the road, turns
around or breaks down scores `FAILED`. The scales: what fixes of 3 cm and a control error of 4 cm
come to together; the sideslip at the rear axle of a bend of 17 m, which no weights can avoid; what
the jerk limit costs at a start; steering by a wheel's quarter turn a second at a ratio of 1 : 8;
jerk at which standing passengers hold on.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.nmpc.closed_loop import Tally
from lpv_track_env import kernels as k

Array = NDArray[Any]

PARTS = ("lateral", "heading", "speed", "steering_rate", "jerk")
SCALES = np.array([0.05, 0.1, 0.5, 0.2, 4.0])
"""m, rad, m/s, rad/s, m/s^3."""
TRACKING, COMFORT = slice(0, 3), slice(3, 5)
FAILED = 25.0
FAILURES = (k.LEFT_CORRIDOR, k.WRONG_HEADING, k.NON_FINITE)
"""Codes of ends that fail a drive."""


def parts_of(tally: Tally) -> Array:
    """The five parts of what was driven, (n, 5); 0 where nothing was."""
    squares = np.stack(
        [
            tally.lateral_square,
            tally.heading_square,
            tally.speed_square,
            tally.steering_rate_square,
            tally.jerk_square,
        ],
        axis=1,
    )
    parts: Array = np.sqrt(squares / np.maximum(tally.steps, 1.0)[:, None]) / SCALES
    return parts


def failed(ends: Array) -> Array:
    """Which drives have failed, by the codes of their ends, (n,) bool."""
    return np.isin(ends, FAILURES)


def scores_of(tally: Tally, ends: Array) -> Array:
    """Scores of whole drives, (n,)."""
    scores: Array = np.where(failed(ends), FAILED, parts_of(tally).sum(axis=1))
    return scores
