"""Long campaigns that try to break the project: `python -m tests.campaigns --help`.

Each module here has `run(count, seed, say) -> Counts`. The tests run each with a small count;
`make campaigns` runs them in full.
"""

from collections.abc import Callable
from typing import NamedTuple

Say = Callable[[str], None]
"""Receives a line of progress."""


class Counts(NamedTuple):
    """Outcome of a campaign.

    Parameters
    ----------
    tried
        Number of attempts.
    faults
        One line for each attempt that broke something: it raised, hung, or lost data. The line
        holds all that is needed to repeat it.
    seen
        Further counts by name, such as refusals of each kind.
    """

    tried: int
    faults: list[str]
    seen: dict[str, int]
