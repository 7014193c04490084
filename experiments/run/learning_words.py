"""What learning cost, in words."""

from collections.abc import Mapping
from typing import Any

UNKNOWN = "not recorded"


def words(training: Mapping[str, Any]) -> str:
    """In short, such as "18.4 M steps, 6 min, 0 solves"; what is not known is left out."""
    parts = []
    if "steps" in training:
        parts.append(f"{count(training['steps'])} steps")
    if "seconds" in training:
        parts.append(duration(training["seconds"]))
    if "solves" in training:
        parts.append(f"{count(training['solves'])} solves")
    return ", ".join(parts) or UNKNOWN


def count(number: int) -> str:
    """A number to three digits: 980, 12.3 k, 1.21 M."""
    for size, unit in ((10**6, " M"), (10**3, " k")):
        if number >= 0.9995 * size:
            value = number / size
            decimals = 2 if value < 9.995 else 1 if value < 99.95 else 0
            return f"{value:.{decimals}f}{unit}"
    return str(number)


def duration(seconds: float) -> str:
    """Time in s below 2 min, in min below 2 h, in h beyond."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    if seconds < 7200.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"
