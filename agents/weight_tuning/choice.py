"""What a choice of weights means: how an action becomes Q and S of a band, within safe bounds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learned.policy import checked_number
from agents.nmpc.schedule import rules_of
from agents.weight_tuning.features import TUNED
from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule
from trajectories import CurvatureBands
from trajectories.compilation import compiled
from trajectories.naming import choose

Array = NDArray[Any]

SPEED, HEADING, POSITION = (0, 4), (1, 5), (2, 3, 6, 7)
"""Indices of Q and S, (vx, psi, X, Y) each, that a joint action multiplies."""


def _joint(*groups: tuple[int, ...]) -> Array:
    directions = np.zeros((TUNED, len(groups)))
    for column, group in enumerate(groups):
        directions[list(group), column] = 1.0
    return directions


DIRECTIONS: Mapping[str, Array] = {
    "joint": _joint(SPEED, HEADING, POSITION),
    "stages": _joint((0,), (1,), (2, 3), (4,), (5,), (6, 7)),
    "all": np.eye(TUNED),
}
"""What the entries of an action multiply: speed, heading and position in Q and S alike; the three
in Q, then the three in S; or each of the eight weights."""

LONGEST_WINDOW = 1e9
"""s: its control periods are counted in 64 bits."""


@dataclass(frozen=True)
class WeightChoice:
    """What may be chosen, from what, and how often.

    Parameters
    ----------
    base
        Weights that are multiplied, a set a band; its slew limit holds for every change, its
        blending for none. One set stands for all bands, with `SLEW` for a limit.
    directions
        "joint", "stages" or "all", see `DIRECTIONS`.
    span
        An action of 1 multiplies by it, one of -1 divides.
    catalogue
        Sets to choose one of instead, R too; an action is an index then.
    window
        s between decisions, in whole control periods, at most `LONGEST_WINDOW`; a change of band
        calls for one at once.

    Raises
    ------
    ValueError
        For a setting that is out of range or unknown.
    """

    base: WeightSchedule | TrackingWeights = field(default_factory=TrackingWeights)
    directions: str = "joint"
    span: float = 10.0
    catalogue: tuple[TrackingWeights, ...] = ()
    window: float = 0.4

    def __post_init__(self) -> None:
        choose("directions", self.directions, tuple(DIRECTIONS))
        span, window = (checked_number(name, getattr(self, name)) for name in ("span", "window"))
        if not 1.0 < span <= 1e4:
            raise ValueError(f"span must be above 1 and at most 10000, not {span}")
        if not 0.0 < window <= LONGEST_WINDOW:
            raise ValueError(f"window must be in (0, {LONGEST_WINDOW:g}] s, not {window}")
        if isinstance(self.base, TrackingWeights):
            bands = CurvatureBands()
            base = WeightSchedule(bands, (self.base,) * len(bands), slew=SLEW)
            object.__setattr__(self, "base", base)
        normal = {"span": span, "window": window, "catalogue": tuple(self.catalogue)}
        for name, value in normal.items():
            object.__setattr__(self, name, value)

    @property
    def schedule(self) -> WeightSchedule:
        """The base."""
        assert isinstance(self.base, WeightSchedule)
        return self.base

    @property
    def bands(self) -> CurvatureBands:
        """Bands of curvature."""
        return self.schedule.bands

    @property
    def slew(self) -> float:
        """Largest change of a weight's logarithm, 1/s."""
        return math.inf if self.schedule.slew is None else self.schedule.slew

    @property
    def sets(self) -> Array:
        """Base sets, (bands, 10)."""
        return np.array([one.clipped().as_array() for one in self.schedule.weights])

    @property
    def matrix(self) -> Array:
        """Directions, (8, entries of an action)."""
        return DIRECTIONS[self.directions]

    @property
    def entries(self) -> int:
        """Numbers of an action, or sets of the catalogue."""
        return len(self.catalogue) or int(self.matrix.shape[1])

    def rules(self, period: float) -> Array:
        """Rules of switching at a control period (s)."""
        return rules_of(self.bands, 0.0, self.slew, period)

    def as_packed(self) -> "PackedChoice":
        """Arrays as `weights_for` takes them."""
        sets = [one.clipped().as_array() for one in self.catalogue]
        return PackedChoice(
            self.sets,
            np.ascontiguousarray(self.matrix),
            math.log(self.span),
            np.array(sets).reshape(-1, 10),
        )


SLEW = 6.0
"""Of choices, 1/s: within a window of 0.4 s a weight changes by a factor of 11 at most."""


@dataclass(frozen=True, eq=False)
class PackedChoice:
    """A `WeightChoice` for compiled code."""

    sets: Array
    matrix: Array
    log_span: float
    catalogue: Array


@compiled
def weights_for(
    action: Array, band: int, sets: Array, matrix: Array, log_span: Any, catalogue: Array,
    chosen: Array,
) -> bool:  # fmt: skip
    """Fill `chosen` (10,) with what an action means in a band; False, and nothing, if it is bad.

    `action` holds numbers, clipped to [-1, 1], or for a catalogue one for each of its sets, of
    which the largest chooses. Bad is one with an entry that is not finite.
    """
    for j in range(action.shape[0]):
        if not math.isfinite(action[j]):
            return False
    if catalogue.shape[0] > 0:
        best = 0
        for j in range(1, action.shape[0]):
            if action[j] > action[best]:
                best = j
        for j in range(chosen.shape[0]):
            chosen[j] = catalogue[best, j]
        return True
    own = max(band, 0)
    for j in range(chosen.shape[0]):
        chosen[j] = sets[own, j]
    for j in range(matrix.shape[0]):
        exponent = 0.0
        for column in range(matrix.shape[1]):
            exponent += matrix[j, column] * min(max(action[column], -1.0), 1.0)
        chosen[j] = min(max(chosen[j] * math.exp(log_span * exponent), LOWEST), HIGHEST)
    return True


@compiled
def weights_for_all(
    actions: Array, mask: Array, bands: Array, sets: Array, matrix: Array, log_span: Any,
    catalogue: Array, tables: Array, refused: Array,
) -> None:  # fmt: skip
    """`weights_for` for every row that `mask` marks, in its band's row of `tables` (n, bands, 10).

    `refused` (n,) tells of which actions nothing could be made.
    """
    for row in range(actions.shape[0]):
        refused[row] = mask[row] and not weights_for(
            actions[row], bands[row], sets, matrix, log_span, catalogue,
            tables[row, max(bands[row], 0)],
        )  # fmt: skip
