"""What of the features a learner may see: to tell what curvature is worth, and conditions alone."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.features import QUARTERS, names
from agents.weight_tuning.watching import STATISTICS

PATH = (*(f"curvature_{k}" for k in range(1, QUARTERS + 1)), "speed_middle", "speed_end",
        "longitudinal_speed")  # fmt: skip
"""Of the path and its speed."""
DRIVE = (
    *(f"{time}_{name}" for time in ("quick", "slow") for name in STATISTICS), "iterations",
    "failures",
)  # fmt: skip
"""Of how the vehicle drives: noise, lag, weave."""
VIEWS: dict[str, tuple[str, ...]] = {"all": (), "path": PATH, "drive": DRIVE}
"""Names of what is seen; bands belong to the path. None: everything."""


def seen_in(view: str, bands: tuple[str, ...]) -> NDArray[Any]:
    """Factor of each feature in a view, (size,) float32 of 0 and 1."""
    every = names(bands)
    kept = VIEWS[view]
    if not kept:
        return np.ones(len(every), dtype=np.float32)
    of_path = kept is PATH
    return np.array(
        [float(name in kept or (of_path and name.startswith("band_"))) for name in every],
        dtype=np.float32,
    )
