"""Names that users choose from."""

import difflib


def choose(kind: str, value: str, known: tuple[str, ...]) -> str:
    """Return `value` if known, else raise a ValueError listing the known ones and the nearest."""
    if value in known:
        return value
    nearest = difflib.get_close_matches(str(value), known, n=1, cutoff=0.0)[0]
    raise ValueError(f"unknown {kind} {value!r}; known: {', '.join(known)} (nearest: {nearest})")
