"""Beginnings of episodes, with the random draws for them, and infos made from their records.

An environment holds one random 64-bit key and counts its episodes. An episode does not depend on
the number of environments, on which of them were reset before, or on other draws.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import PSI, VX, X, Y
from lpv_track_env.draws import uniform
from lpv_track_env.reward import TERMS
from lpv_track_env.steady_turn import turn_steadily
from trajectories.compilation import compiled, compiled_internal
from trajectories.table import SPEED, cell, curvature_at, heading_at, position_at, speed_at

Array = NDArray[Any]
Infos = dict[str, Any]

TRAJECTORY_DRAW, VEHICLE_DRAW, START_DRAW, LATERAL_DRAW, HEADING_DRAW, SPEED_DRAW = range(6)
"""Number of each draw within an episode."""

GIVEN = ("arc_length", "lateral_error", "heading_error", "speed_error", "speed")
"""Starting values that reset options may give, in the order of `given` in `begin`."""

INFO: Infos = dict.fromkeys(
    (
        "lateral_error", "heading_error", "speed_error", "arc_length", "state", "reward_terms",
        "clipped",
    )
)  # fmt: skip
REWARD_TERMS = dict.fromkeys(TERMS, 0.0)
"""Infos and reward terms to be copied and filled, which is faster than to make them."""

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

    The vehicle starts in the steady turn of the path's curvature, moving along the path but for the
    errors, and on a closed path with the reference's acceleration: as it would come round. One that
    does not reverse starts at standstill rather than below it.

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
    a = p[ROLLING_DECELERATION] + slowing
    if closed:
        cells = table.shape[0] - 1
        index, _ = cell(s, length, closed, cells + 1)
        before, after = table[index, SPEED], table[index + 1, SPEED]
        a += 0.5 * (after * after - before * before) * cells / length
    record[kernels.ACCELERATION] = kernels.clip(
        a, p[kernels.LOWEST_ACCELERATION], p[kernels.HIGHEST_ACCELERATION]
    )
    record[kernels.ARC_LENGTH] = s
    kernels.start(record, p, table, observation)


END_NAMES = np.array(kernels.END_NAMES, dtype=object)


def episode_infos(records: Array, mask: Array | None = None) -> Infos:
    """Return infos of the episodes that `mask` (n,) marks, or of all; zeros for the others.

    They are in the form in which Gymnasium's `SyncVectorEnv` gathers infos. `records` are
    (n, RECORD_SIZE).
    """
    # One copy with a contiguous row for every entry.
    if mask is None:
        mask = np.ones(len(records), dtype=np.bool_)
        values = records.T.copy()
    else:
        values = np.zeros(records.T.shape)
        values[:, mask] = records[mask].T
    terms: Infos = {}
    for k, name in enumerate(TERMS):
        terms[name], terms[f"_{name}"] = values[kernels.TERMS + k], mask
    infos: Infos = {
        "lateral_error": values[kernels.LATERAL_ERROR],
        "heading_error": values[kernels.HEADING_ERROR],
        "speed_error": values[kernels.SPEED_ERROR],
        "arc_length": values[kernels.ARC_LENGTH],
        "state": np.ascontiguousarray(values[:6].T),
        "reward_terms": terms,
        "clipped": values[kernels.CLIPPED].astype(np.int64),
    }
    infos.update({f"_{name}": mask for name in list(infos)})
    ends = values[kernels.END]
    ended = ends != kernels.RUNNING
    if ended.any():
        infos["end"] = np.where(ended, END_NAMES[ends.astype(np.int64)], None)
        infos["_end"] = ended
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
    """Return the info of one episode, without its end, as `PathTrackingEnv` gives it."""
    values = record.tolist()
    return {
        "lateral_error": values[kernels.LATERAL_ERROR],
        "heading_error": values[kernels.HEADING_ERROR],
        "speed_error": values[kernels.SPEED_ERROR],
        "arc_length": values[kernels.ARC_LENGTH],
        "state": record[:6].copy(),
        "reward_terms": dict(zip(TERMS, values[kernels.TERMS :], strict=True)),
        "clipped": int(values[kernels.CLIPPED]),
    }
