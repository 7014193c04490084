"""Beginnings of episodes, with the random draws for them, and infos made from their records.

An environment holds one random 64-bit key and counts its episodes. An episode does not depend on
the number of environments, on which of them were reset before, or on other draws.
"""

import math
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import PSI, VX, X, Y
from lpv_track_env.draws import uniform
from lpv_track_env.reward import TERMS
from lpv_track_env.steady_turn import turn_steadily
from trajectories.compilation import compiled, compiled_internal
from trajectories.table import curvature_at, heading_at, position_at, speed_at

Array = NDArray[Any]
Infos = dict[str, Any]

REWARD_KEYS = tuple(f"reward_{name}" for name in TERMS)
"""Keys of the reward's terms in infos."""

TRAJECTORY_DRAW, VEHICLE_DRAW, START_DRAW, LATERAL_DRAW, HEADING_DRAW, SPEED_DRAW = range(6)
"""Number of each draw within an episode."""

GIVEN = ("arc_length", "lateral_error", "heading_error", "speed_error", "speed")
"""Starting values that reset options may give, in the order of `given` in `begin`."""


class End(IntEnum):
    """End of an episode, in infos: a number that equals its name, `info["end"] == "finished"`.

    RL libraries gather infos in arrays of numbers and refuse texts. While the episode runs it is 0
    and equals "". Its text is its name, as its hash is: sets of names contain it.
    """

    RUNNING = kernels.RUNNING
    FINISHED = kernels.FINISHED
    LEFT_CORRIDOR = kernels.LEFT_CORRIDOR
    WRONG_HEADING = kernels.WRONG_HEADING
    NON_FINITE = kernels.NON_FINITE
    TIME_LIMIT = kernels.TIME_LIMIT
    COLLISION = kernels.COLLISION

    def __str__(self) -> str:
        return kernels.END_NAMES[self.value] if self.value else ""

    def __repr__(self) -> str:
        return repr(str(self))

    def __format__(self, spec: str) -> str:
        return format(str(self), spec)

    def __eq__(self, other: object) -> bool:
        return (str(self) if isinstance(other, str) else self.value) == other

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(str(self))


ENDS = np.array(list(End), dtype=object)
"""Ends by code."""
INFO: Infos = {
    **dict.fromkeys(
        ("lateral_error", "heading_error", "speed_error", "arc_length", "state", "clipped")
    ),
    **dict.fromkeys(REWARD_KEYS),
    "end": End.RUNNING,
}
"""Info to be copied and filled, which is faster than to make it.

Infos have the same keys, types and shapes at the reset and in every step, numbers and arrays only:
RL libraries preallocate arrays for them.
"""
MASKS = tuple(f"_{key}" for key in INFO)

ROLLING_DECELERATION = 6
"""Index of mu g in the constants."""


@compiled_internal
def error(given: Any, half: Any, key: Any, episode: Any, draw: int) -> Any:
    """Return an initial error: the given one, or drawn uniformly within +-half if that is NaN."""
    if not math.isnan(given):
        return given
    return half * (2.0 * uniform(key, episode, draw) - 1.0)


@compiled
def begin(
    record: Array, constants: Array, table: Array, observation: Array,
    key: Any, episode: Any, given: Array, friction: Any,
) -> None:  # fmt: skip
    """Begin an episode: draw its start, set the state, write record and observation.

    The vehicle starts in the steady turn of the path's curvature, at a constant speed and moving
    along the path but for the errors. One that does not reverse starts at standstill rather than
    below it.

    Parameters
    ----------
    given
        (5,) as `GIVEN` lists them in m, m, rad, m/s, m/s, in place of what would be drawn; NaN:
        drawn. A given heading error is that of the vehicle's axis, sideslip included.
    friction
        Coefficient of friction of tyres and road, inf for linear tyres.
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
    speed = given[4]
    if math.isnan(speed):
        speed = speed_at(table, length, closed, s) + speed_error
    record[VX] = max(speed, p[kernels.LOWEST_SPEED])
    record[PSI] = heading + heading_error
    record[X] = x - lateral_error * math.sin(heading)
    record[Y] = y + lateral_error * math.cos(heading)
    curvature = curvature_at(table, length, closed, s)
    steering, slowing = turn_steadily(record, p, curvature, friction, p[kernels.MAX_STEERING])
    if not math.isnan(given[2]):
        record[PSI] = heading + heading_error
    record[kernels.STEERING] = steering
    record[kernels.ACCELERATION] = kernels.clip(
        p[ROLLING_DECELERATION] + slowing,
        p[kernels.LOWEST_ACCELERATION], p[kernels.HIGHEST_ACCELERATION],
    )  # fmt: skip
    record[kernels.ARC_LENGTH] = s
    kernels.start(record, p, table, observation)


def episode_infos(records: Array, mask: Array | None = None) -> Infos:
    """Return infos of the episodes that `mask` (n,) marks, or of all; zeros for the others.

    They are in the form in which Gymnasium's `SyncVectorEnv` gathers infos. `records` are
    (n, RECORD_SIZE).
    """
    # One copy with a contiguous row for every entry.
    everywhere = mask is None
    if mask is None:
        mask = np.ones(len(records), dtype=np.bool_)
        values = records.T.copy()
    else:
        values = np.zeros(records.T.shape)
        values[:, mask] = records[mask].T
    ends = ENDS[values[kernels.END].astype(np.int64)]
    infos: Infos = {
        "lateral_error": values[kernels.LATERAL_ERROR],
        "heading_error": values[kernels.HEADING_ERROR],
        "speed_error": values[kernels.SPEED_ERROR],
        "arc_length": values[kernels.ARC_LENGTH],
        "state": np.ascontiguousarray(values[:6].T),
        "clipped": values[kernels.CLIPPED].astype(np.int64),
        **dict(zip(REWARD_KEYS, values[kernels.TERMS :], strict=True)),
        "end": ends if everywhere else np.where(mask, ends, None),
    }
    for masked in MASKS:
        infos[masked] = mask
    return infos


def final_infos(records: Array, observations: Array, ended: Array) -> Infos:
    """Return `final_obs` and `final_info` of the episodes that have `ended` (n,), with masks."""
    final = np.full(len(ended), None, dtype=object)
    for i in np.flatnonzero(ended).tolist():
        final[i] = observations[i].copy()
    return {
        "final_obs": final,
        "_final_obs": ended,
        "final_info": episode_infos(records, ended),
        "_final_info": ended,
    }


def single_info(record: Array) -> Infos:
    """Return the info of one episode, as `PathTrackingEnv` gives it."""
    values = record.tolist()
    return {
        "lateral_error": values[kernels.LATERAL_ERROR],
        "heading_error": values[kernels.HEADING_ERROR],
        "speed_error": values[kernels.SPEED_ERROR],
        "arc_length": values[kernels.ARC_LENGTH],
        "state": record[:6].copy(),
        "clipped": int(values[kernels.CLIPPED]),
        **dict(zip(REWARD_KEYS, values[kernels.TERMS :], strict=True)),
        "end": ENDS[int(values[kernels.END])],
    }
