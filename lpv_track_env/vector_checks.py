"""What the vector environment is given, checked before anything is changed."""

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from lpv_track_env import vector_kernels
from trajectories.naming import choose

Array = NDArray[Any]

ENTRIES = ("0 (acceleration)", "1 (steering angle)")


def checked_actions(actions: Any, ends: Array, mode: int) -> Array:
    """Actions as float64 (n, 2), after a check of those that are not ignored.

    `ends` (n,) are the environments' end codes, `mode` is the autoreset mode's.

    Raises
    ------
    ValueError
        For a wrong shape or type, or naming environment and entry that is not finite.
    """
    shape = (len(ends), 2)
    try:
        given = np.asarray(actions)
    except ValueError:
        given = np.empty(0)
    if given.shape != shape or given.dtype.kind not in "fiu":
        raise ValueError(
            f"actions must be an array {shape} of numbers [acceleration m/s^2, steering angle "
            f"rad], not {given.shape} of {given.dtype}"
        )
    commands = np.ascontiguousarray(given, dtype=np.float64)
    bad = vector_kernels.first_bad(commands, ends, mode)
    if bad >= 0:
        index, entry = divmod(bad, 2)
        raise ValueError(
            f"action of environment {index}, entry {ENTRIES[entry]}, is not finite: "
            f"{given[index]!r}"
        )
    return commands


def checked_mask(mask: Any, num_envs: int) -> Array:
    """A mask of environments (n,), a copy; all where none is given.

    Raises
    ------
    TypeError, ValueError
        For another type, a wrong shape, or a mask that marks none.
    """
    if mask is None:
        return np.ones(num_envs, dtype=np.bool_)
    if not (isinstance(mask, np.ndarray) and mask.dtype == np.bool_):
        raise TypeError("options['reset_mask'] must be a NumPy array of dtype bool")
    if mask.shape != (num_envs,):
        raise ValueError(f"options['reset_mask'] must have shape ({num_envs},), not {mask.shape}")
    if not mask.any():
        raise ValueError("options['reset_mask'] must mark at least one environment")
    return mask.copy()


def checked_seeds(seed: Any, num_envs: int) -> Sequence[int | None]:
    """A seed for each environment, None where it has none.

    Raises
    ------
    ValueError
        For a list of another length.
    """
    if seed is None:
        return [None] * num_envs
    if not isinstance(seed, Sequence):
        return [operator.index(seed) + i for i in range(num_envs)]
    if len(seed) != num_envs:
        raise ValueError(f"{len(seed)} seeds for num_envs={num_envs}: give one for each")
    return list(seed)


def listed(kind: str, value: Any) -> list[Any]:
    """Items of a sequence, or the one item; a str is an item."""
    if not isinstance(value, list | tuple):
        return [value]
    if not value:
        raise ValueError(f"{kind}: an empty sequence")
    return list(value)


def checked_mode(value: AutoresetMode | str) -> AutoresetMode:
    """The autoreset mode, by itself or by its value."""
    if isinstance(value, AutoresetMode):
        return value
    known = tuple(mode.value for mode in AutoresetMode)
    return AutoresetMode(choose("autoreset_mode", value, known))
