"""Infos of the vector environment, as Gymnasium's `SyncVectorEnv` gathers them, from records."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.reward import TERMS

Array = NDArray[Any]
Infos = dict[str, Any]

NAMES = np.array(kernels.END_NAMES, dtype=object)


def episode_infos(records: Array, mask: Array | None = None) -> Infos:
    """Infos of the episodes that `mask` (n,) marks, of all without; zeros for the others.

    Parameters
    ----------
    records
        (n, RECORD_SIZE), as `kernels` lays them out.
    mask
        (n,) bool.
    """
    # One copy in which every entry is a row of its own.
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
        infos["end"] = np.where(ended, NAMES[ends.astype(np.int64)], None)
        infos["_end"] = ended
    return infos


def final_infos(records: Array, observations: Array, ended: Array) -> Infos:
    """`final_obs` and `final_info` of the episodes that have `ended` (n,), with their masks."""
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
    """Info of one episode without its end, as `PathTrackingEnv` gives it, from its record."""
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
