"""What a weight policy is: a choice of weights and the network that chooses, numbers only."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learned.policy import (
    MOST_LAYERS,
    Layer,
    checked_layer,
    checked_number,
    plain_json,
)
from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.features import size
from agents.weights import WeightSchedule
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.task import checked_period

Weights = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class WeightPolicy:
    """A weight policy as a file holds it.

    With x the features (`agents.weight_tuning.features`)::

        x      = tanh(W_k x + b_k)        for every layer but the last
        action = W_L x + b_L

    and `choice` says what an action means.

    Parameters
    ----------
    choice
        What may be chosen; its base is copied as JSON gives it back.
    layers
        (W (out, in), b (out,)) of each layer, float32.
    layout
        Observations that it was made for.
    control_period
        s, that it was made for.
    algorithm
        What its maker calls it.
    training
        Where it comes from, in plain JSON.

    Raises
    ------
    ValueError
        For layers that do not fit one another, the features or the choice, or are not finite; a
        period that is none; a base or a training that JSON does not hold.
    """

    choice: WeightChoice
    layers: tuple[Layer, ...]
    layout: ObservationLayout
    control_period: float = 0.05
    algorithm: str = "rl"
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.algorithm, str) or not self.algorithm.strip():
            raise ValueError(f"algorithm must be a name, not {self.algorithm!r}")
        if not 1 <= len(self.layers) <= MOST_LAYERS:
            raise ValueError(f"layers must be 1 to {MOST_LAYERS}, not {len(self.layers)}")
        layers: list[Layer] = []
        for k, pair in enumerate(self.layers):
            if not isinstance(pair, tuple | list) or len(pair) != 2:
                raise ValueError(f"layers[{k}] must be a weight and a bias")
            inputs = len(layers[-1][1]) if layers else size(len(self.choice.bands))
            layers.append(checked_layer(f"layers[{k}]", *pair, inputs))
        if len(layers[-1][1]) != self.choice.entries:
            raise ValueError(
                f"the last layer must have {self.choice.entries} outputs, as the choice has "
                f"entries, not {len(layers[-1][1])}"
            )
        base = WeightSchedule.from_dict(plain_json("choice.base", self.choice.schedule.as_dict()))
        period = checked_number("control_period", self.control_period)
        normal = {
            "choice": replace(self.choice, base=base),
            "layers": tuple(layers),
            "control_period": checked_period(period),
            "training": plain_json("training", self.training),
        }
        for name, value in normal.items():
            object.__setattr__(self, name, value)
