"""What counts as an action: two finite numbers, in whatever holds them."""

from math import isfinite
from typing import Any

import numpy as np

NUMBERS = (float, int)


def two_numbers(action: Any) -> tuple[float, float]:
    """Two real numbers out of anything that holds no more and no less than these.

    Raises
    ------
    ValueError
        If it does not.
    """
    try:
        # Through plain Python values: a number is then told from text, bool or complex.
        values = np.asarray(action).tolist()
        a, delta = values
        if not (type(values) is list and type(a) in NUMBERS and type(delta) in NUMBERS):
            raise TypeError
        return float(a), float(delta)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"action must be two numbers [acceleration m/s^2, steering angle rad], not {action!r}"
        ) from None


def check_finite(a: float, delta: float, action: Any) -> None:
    """Raise a ValueError that names the entry of an action that is not finite, if one is not."""
    if not (isfinite(a) and isfinite(delta)):
        entry = "1 (steering angle)" if isfinite(a) else "0 (acceleration)"
        raise ValueError(f"action entry {entry} is not finite: {action!r}")


def check_action(action: Any) -> None:
    """Raise the ValueError that `step` raises, if it refuses an action."""
    a, delta = two_numbers(action)
    check_finite(a, delta, action)
