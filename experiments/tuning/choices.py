"""What learned weight policies may choose."""

from itertools import product

import numpy as np

from agents.weight_tuning.choice import SLEW, WeightChoice
from agents.weights import TrackingWeights, WeightSchedule
from experiments.tuning.settings import TuningSettings
from trajectories import CurvatureBands

GRID = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Factors on the position weights of a catalogue's sets, for each of five on the heading's:"""
HEADING = (0.1, 0.3, 1.0, 3.0, 10.0)


def catalogue() -> tuple[TrackingWeights, ...]:
    """25 sets around the default one, which is the first: less position, more or less heading."""
    base = TrackingWeights().as_array()
    sets: list[TrackingWeights] = []
    for position, heading in product(GRID, sorted(HEADING, key=lambda x: abs(np.log(x)))):
        weights = base.copy()
        weights[[2, 3, 6, 7]] *= position
        weights[[1, 5]] *= heading
        # Speed matters to comfort only: a tenth, but in the default set.
        weights[[0, 4]] *= 1.0 if not sets else 0.1
        sets.append(TrackingWeights.from_array(weights))
    return tuple(sets)


def choice_of(settings: TuningSettings) -> WeightChoice:
    """What a policy may choose."""
    bands = CurvatureBands()
    base = WeightSchedule(bands, (TrackingWeights(),) * len(bands), slew=SLEW)
    sets = catalogue() if settings.method == "catalogue" else ()
    return WeightChoice(
        base, directions=settings.directions, span=settings.span, catalogue=sets,
        window=settings.window,
    )  # fmt: skip
