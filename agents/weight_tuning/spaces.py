"""Spaces of `WeightTuning-v0`, and actions checked before anything is moved."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.weight_tuning import features
from agents.weight_tuning.choice import WeightChoice

Array = NDArray[Any]


def observation_space(choice: WeightChoice) -> spaces.Box:
    """Space of the features that a choice is made on."""
    shape = (features.size(len(choice.bands)),)
    return spaces.Box(-features.LIMIT, features.LIMIT, shape, dtype=np.float32)


def action_space(choice: WeightChoice) -> spaces.Box | spaces.Discrete[np.int64]:
    """Space of the actions of a choice."""
    if choice.catalogue:
        return spaces.Discrete(len(choice.catalogue))
    return spaces.Box(-1.0, 1.0, (choice.entries,), dtype=np.float32)


def checked_choices(actions: Any, choice: WeightChoice, num_envs: int) -> Array:
    """Actions as float64 (n, entries); of a catalogue, 1 for the set that is chosen.

    Numbers that are not finite are let through: no set is chosen then.

    Raises
    ------
    ValueError
        For a wrong shape or type, or an index that is not in the catalogue.
    """
    try:
        given = np.asarray(actions)
    except ValueError:
        given = np.empty(0)
    count = choice.entries
    if not choice.catalogue:
        if given.shape != (num_envs, count) or given.dtype.kind not in "fiu":
            raise ValueError(
                f"actions must be an array {(num_envs, count)} of numbers in [-1, 1], "
                f"{choice.directions!r} log-multipliers, not {given.shape} of {given.dtype}"
            )
        return np.ascontiguousarray(given, dtype=np.float64)
    if given.shape != (num_envs,) or given.dtype.kind not in "iu":
        raise ValueError(
            f"actions must be {num_envs} indices of a catalogue, not {given.shape} of {given.dtype}"
        )
    if not ((given >= 0) & (given < count)).all():
        wrong = given[(given < 0) | (given >= count)][0]
        raise ValueError(f"the catalogue has sets 0 to {count - 1}, not {wrong}")
    chosen: Array = np.eye(count)[given]
    return chosen
