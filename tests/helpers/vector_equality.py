"""Vector environments beside one another: what they give must be equal bit for bit."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

Array = NDArray[Any]


def assert_equal(one: Any, other: Any, where: str = "") -> None:
    """Equal bit for bit, dtype for dtype, through dictionaries and arrays of objects."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_equal(one[key], other[key], f"{where}/{key}")
    elif isinstance(one, np.ndarray) and one.dtype == object:
        for k, pair in enumerate(zip(one, other, strict=True)):
            assert_equal(*pair, f"{where}[{k}]")
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype, where
        np.testing.assert_array_equal(one, other, err_msg=where, strict=True)
    else:
        assert type(one) is type(other), where
        assert one == other, where


def step_both(one: Any, other: Any, action: Array, mode: AutoresetMode) -> tuple[Any, Any]:
    """A step of both, and in mode DISABLED a reset of what has ended."""
    results = one.step(action), other.step(action)
    for ours, theirs in zip(*results, strict=True):
        assert_equal(ours, theirs)
    ended = results[0][2] | results[0][3]
    if mode is AutoresetMode.DISABLED and ended.any():
        # Each takes a dictionary of its own: SyncVectorEnv takes the mask out of it.
        resets = [env.reset(options={"reset_mask": ended.copy()}) for env in (one, other)]
        assert_equal(resets[0][0], resets[1][0])
        assert_equal(resets[0][1], resets[1][1])
    return results[0]
