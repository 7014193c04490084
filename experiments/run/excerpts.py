"""Excerpts of many paths, settings and cases: the first, the worst, and how many there are.

Folders that fit on a page are shown whole.
"""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.run.tables import Row

MOST_PATHS = 24
"""Most paths of a setting that tables show and reports draw."""
MOST_SETTINGS = 200
"""Most settings that tables are shown for."""
MOST_LISTED = 500
"""Most failed cases, warnings and the like that are listed."""

WHOLE = re.compile(r"(\d+ )?finished")
"""Text in the column of ends of a row whose drives all reached the end of the path."""


def first_and_worst(errors: Mapping[str, float]) -> list[str]:
    """Return at most `MOST_PATHS` paths in their order: half of them the first, half the worst.

    `errors` gives the largest error of each path, inf where a drive did not reach the end.
    """
    names = list(errors)
    if len(names) <= MOST_PATHS:
        return names
    first, rest = names[: MOST_PATHS // 2], names[MOST_PATHS // 2 :]
    worst = set(sorted(rest, key=lambda name: -errors[name])[: MOST_PATHS - len(first)])
    return [*first, *(name for name in rest if name in worst)]


def of_paths(rows: Sequence[Row]) -> tuple[list[Row], str]:
    """Return the rows of one setting's `first_and_worst` paths, and a sentence on those left out.

    The sentence is "" where all are there.
    """
    errors: dict[str, float] = {}
    for row in rows:
        if not row.published:
            whole = WHOLE.fullmatch(row.end) and "mle" in row.values
            found = row.values["mle"].mean if whole else np.inf
            errors[row.trajectory] = max(found, errors.get(row.trajectory, 0.0))
    kept = set(first_and_worst(errors))
    if len(kept) == len(errors):
        return list(rows), ""
    words = (
        f"{len(kept)} of {len(errors)} paths are shown: the first ones, and those with the largest "
        "errors or failures. Key figures are over all paths."
    )
    return [row for row in rows if row.trajectory in kept], words
