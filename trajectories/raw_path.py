"""The points of a path as a file or an array holds them: what every reader returns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from trajectories.arguments import shortened

Array = NDArray[np.float64]

QUANTITIES = (
    "x", "y", "latitude", "longitude", "height", "time", "speed", "width_right", "width_left",
)  # fmt: skip
"""Columns that a `RawPath` may have: m, m, deg, deg, m, s, m/s, m, m."""


@dataclass(frozen=True)
class RawPath:
    """Points in the order of driving, with what else is known of each; nothing is checked yet.

    Parameters
    ----------
    kind
        Kind of the file in words, such as "GPX track", for messages and the path's source.
    origin
        The file as the user named it, or "array", which begins every message.
    name
        Name of the path, such as the file's stem.
    columns
        Arrays (n,) by `QUANTITIES`, finite: x and y, or latitude and longitude.
    places
        Name of each point for messages, such as "line 12", (n,).
    closed
        True or False where the format says so, None where the points have to tell.
    metadata
        Plain JSON values for the path's metadata.
    """

    kind: str
    origin: str
    name: str
    columns: Mapping[str, Array]
    places: Sequence[str]
    closed: bool | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def fail(self, message: str) -> NoReturn:
        """Raise a ValueError that begins with the file's name."""
        raise ValueError(f"{shortened(self.origin)}: {message}")
