"""How episodes begin: what is drawn for them (`draws`) and the record it leads to.

An environment holds one random 64-bit key and counts its episodes. An episode does not depend on
how many environments there are, on which of them reset before, or on what else was drawn.
"""

import math
from typing import Any

from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import PSI, VX, X, Y
from lpv_track_env.draws import uniform
from trajectories.compilation import compiled, compiled_internal
from trajectories.table import heading_at, position_at, speed_at

Array = NDArray[Any]

TRAJECTORY_DRAW, VEHICLE_DRAW, START_DRAW, LATERAL_DRAW, HEADING_DRAW, SPEED_DRAW = range(6)
"""Number of each draw within an episode."""

GIVEN = ("arc_length", "lateral_error", "heading_error", "speed_error")
"""What `begin` takes instead of drawing it, in this order; NaN is drawn."""

ROLLING_DECELERATION = 6
"""Index of mu g in the constants."""


@compiled_internal
def error(given: Any, half: Any, key: Any, episode: Any, draw: int) -> Any:
    """Initial error: as given, or uniform within +-half."""
    if not math.isnan(given):
        return given
    return half * (2.0 * uniform(key, episode, draw) - 1.0)


@compiled
def begin(
    record: Array, constants: Array, table: Array, observation: Array,
    key: Any, episode: Any, given: Array,
) -> None:  # fmt: skip
    """Begin an episode: draw what is not given, set the state, write record and observation.

    `given`, shape (4,), as `GIVEN` lists it: m, m, rad, m/s.
    """
    p = constants
    s = given[0]
    if math.isnan(s):
        s = p[kernels.START_RANGE] * uniform(key, episode, START_DRAW)
    lateral_error = error(given[1], p[kernels.LATERAL_RANGE], key, episode, LATERAL_DRAW)
    heading_error = error(given[2], p[kernels.HEADING_RANGE], key, episode, HEADING_DRAW)
    speed_error = error(given[3], p[kernels.SPEED_RANGE], key, episode, SPEED_DRAW)
    length, closed = p[kernels.LENGTH], p[kernels.CLOSED] > 0.5
    heading = heading_at(table, length, closed, s)
    x, y = position_at(table, length, closed, s)
    record[:] = 0.0
    record[VX] = speed_at(table, length, closed, s) + speed_error
    record[PSI] = heading + heading_error
    record[X] = x - lateral_error * math.sin(heading)
    record[Y] = y + lateral_error * math.cos(heading)
    record[kernels.ACCELERATION] = p[ROLLING_DECELERATION]
    record[kernels.ARC_LENGTH] = s
    kernels.start(record, p, table, observation)
