"""Choice of weights: how an action becomes the weights of a curvature band, within safe bounds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.learned.policy import checked_number
from agents.nmpc.schedule import rules_of
from agents.weight_tuning.features import LIMIT, TUNED, size
from agents.weights import HIGHEST, LOWEST, WEIGHTS, TrackingWeights, WeightSchedule
from trajectories import CurvatureBands
from trajectories.compilation import compiled
from trajectories.naming import choose

Array = NDArray[Any]

# Indices in [Q, S], (vx, psi, X, Y) each, of the weights that a joint action multiplies.
SPEED, HEADING, POSITION = (0, 4), (1, 5), (2, 3, 6, 7)


def _joint(*groups: tuple[int, ...]) -> Array:
    """Return a matrix (8, groups) whose columns mark the weights of a group with 1."""
    directions = np.zeros((TUNED, len(groups)))
    for column, group in enumerate(groups):
        directions[list(group), column] = 1.0
    return directions


DIRECTIONS: Mapping[str, Array] = {
    "joint": _joint(SPEED, HEADING, POSITION),
    "stages": _joint((0,), (1,), (2, 3), (4,), (5,), (6, 7)),
    "all": np.eye(TUNED),
}
"""Weights that the entries of an action multiply: speed, heading and position, in Q and S alike
("joint") or first in Q and then in S ("stages"); or each of the eight weights ("all")."""

LONGEST_WINDOW = 1e9
"""Longest window, s; its control periods are counted in 64 bits."""

SLEW = 6.0
"""Default slew limit of the weights, 1/s: a factor of at most 11 within a window of 0.4 s."""


@dataclass(frozen=True)
class WeightChoice:
    """Weights that may be chosen, the meaning of an action, and the time between decisions.

    Parameters
    ----------
    base
        Schedule whose weights an action multiplies. Its slew limit applies to every change; its
        blending is not used. A single set of weights applies to all bands, with the limit `SLEW`.
    directions
        "joint", "stages" or "all", see `DIRECTIONS`.
    span
        An entry of 1 multiplies weights by it, one of -1 divides them.
    catalogue
        Sets of weights, R included; if there are any, an action is the index of one.
    window
        Time between decisions, s, rounded to control periods; at most `LONGEST_WINDOW`. A change of
        band leads to a decision at once.

    Raises
    ------
    ValueError
        For an unknown setting, or one that is out of range.
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
        """The base as a schedule."""
        assert isinstance(self.base, WeightSchedule)
        return self.base

    @property
    def bands(self) -> CurvatureBands:
        """Bands of the base."""
        return self.schedule.bands

    @property
    def slew(self) -> float:
        """Largest rate of change of a weight's natural logarithm, 1/s."""
        return math.inf if self.schedule.slew is None else self.schedule.slew

    @property
    def sets(self) -> Array:
        """Weights of the base, (bands, 12)."""
        return np.array([one.clipped().as_array() for one in self.schedule.weights])

    @property
    def matrix(self) -> Array:
        """Matrix (8, entries of an action) from an action to logarithms of factors."""
        return DIRECTIONS[self.directions]

    @property
    def entries(self) -> int:
        """Number of entries of an action, or of sets in the catalogue."""
        return len(self.catalogue) or int(self.matrix.shape[1])

    def rules(self, period: float) -> Array:
        """Return the rules of switching for a control period (s), see `agents.nmpc.schedule`."""
        return rules_of(self.bands, 0.0, self.slew, period)

    @property
    def log_span(self) -> float:
        """Natural logarithm of the span."""
        return math.log(self.span)

    @property
    def catalogue_sets(self) -> Array:
        """Weights of the catalogue, (sets, 12)."""
        return np.array([one.clipped().as_array() for one in self.catalogue]).reshape(-1, WEIGHTS)


def observation_space(choice: WeightChoice) -> spaces.Box:
    """Return the space of the features that a choice depends on."""
    shape = (size(len(choice.bands)),)
    return spaces.Box(-LIMIT, LIMIT, shape, dtype=np.float32)


def action_space(choice: WeightChoice) -> "spaces.Box | spaces.Discrete[np.int64]":
    """Return the space of the actions of a choice."""
    if choice.catalogue:
        return spaces.Discrete(len(choice.catalogue))
    return spaces.Box(-1.0, 1.0, (choice.entries,), dtype=np.float32)


def checked_actions(actions: Any, choice: WeightChoice, num_envs: int) -> Array:
    """Convert actions to float64 (n, entries); an index of a catalogue to a row with a single 1.

    Entries that are not finite are accepted: `weights_for` refuses them.

    Raises
    ------
    ValueError
        For a wrong shape or type, or an index outside the catalogue.
    """
    try:
        given = np.asarray(actions)
    except ValueError:
        given = np.empty(0)
    count = choice.entries
    if not choice.catalogue:
        if given.shape != (num_envs, count) or given.dtype.kind not in "fiu":
            raise ValueError(
                f"actions must be an array {(num_envs, count)} of numbers in [-1, 1], "
                f"{choice.directions!r} log-multipliers, not {given.shape} of {given.dtype}"
            )
        return np.ascontiguousarray(given, dtype=np.float64)
    if given.shape != (num_envs,) or given.dtype.kind not in "iu":
        raise ValueError(
            f"actions must be {num_envs} indices of a catalogue, not {given.shape} of {given.dtype}"
        )
    if not ((given >= 0) & (given < count)).all():
        wrong = given[(given < 0) | (given >= count)][0]
        raise ValueError(f"the catalogue has sets 0 to {count - 1}, not {wrong}")
    chosen: Array = np.eye(count)[given]
    return chosen


@compiled
def weights_for(
    action: Array, band: int, sets: Array, matrix: Array, log_span: Any, catalogue: Array,
    chosen: Array,
) -> bool:  # fmt: skip
    """Fill `chosen` (12,) with the weights that an action means in a band.

    `action` has entries that are clipped to [-1, 1]; or, with a catalogue, one entry per set, of
    which the largest chooses. Returns False, and fills nothing, if an entry is not finite.
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
    """Apply `weights_for` to the rows where `mask` is True, in `tables` (n, bands, 12).

    `refused` (n,) becomes True for actions that are not finite.
    """
    for row in range(actions.shape[0]):
        refused[row] = mask[row] and not weights_for(
            actions[row], bands[row], sets, matrix, log_span, catalogue,
            tables[row, max(bands[row], 0)],
        )  # fmt: skip
