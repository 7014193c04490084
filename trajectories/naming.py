"""Look up a name in a list, and name the nearest one if it is unknown."""

import difflib
from collections.abc import Iterable

from trajectories.arguments import shown

LONGEST_NAME = 100
"""Characters of a name that is compared with the known ones."""


def choose(kind: str, value: str, known: tuple[str, ...]) -> str:
    """Return `value` if it is known.

    Raises
    ------
    ValueError
        If it is not, listing the known names of this `kind` and the nearest.
    """
    if isinstance(value, str) and value in known:
        return value
    raise ValueError(f"unknown {kind} {shown(value)}; {suggestion(value, known)}")


def suggestion(value: object, known: Iterable[str], more: str = "") -> str:
    """Second half of an error message: the known names, `more` after them, and the nearest."""
    names = tuple(known)
    # A long name has no near one, and to look for it takes the product of the lengths.
    given = value if isinstance(value, str) else shown(value)
    nearest = difflib.get_close_matches(given[:LONGEST_NAME], names, n=1, cutoff=0.0)[0]
    return f"known: {', '.join(names)}{more} (nearest: {nearest})"
