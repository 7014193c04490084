"""Decisions of a weight policy, compiled: one vehicle's period at a time."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.learned.files import Layer
from agents.learned.network import ACTIVATION, OUTPUTS, TANH, activate, dense, pack_layers
from agents.weight_tuning.choice import WeightChoice, weights_for, weights_for_all
from agents.weight_tuning.features import (
    CLOCK,
    DECIDED,
    FAILURES,
    ITERATIONS,
    REJECTED,
    SCALES,
    fill_all,
    fill_features,
    size,
)
from agents.weight_tuning.loop_memory import LoopMemory
from agents.weights import WEIGHTS
from trajectories.compilation import compiled_internal

Array = NDArray[Any]
Layers = tuple[Layer, ...]


class PolicyArrays(NamedTuple):
    """A weight policy for compiled code: its network, and what the outputs mean."""

    network: NDArray[np.float32]
    """Weights and biases of all layers, one after another."""
    layers: NDArray[np.int64]
    """Start in `network`, inputs, outputs, activation of each layer; (0, 4) without a policy."""
    sets: Array
    """Base weights of each band, (bands, 12)."""
    matrix: Array
    """Directions in which an action moves Q and S, (8, entries)."""
    log_span: float
    """Logarithm of the factor that an action of 1 multiplies by."""
    catalogue: Array
    """Sets to choose from, (entries, 12); (0, 12) where an action multiplies."""
    scales: Array
    """Scales of the history's statistics, (STATISTICS,)."""
    window: int
    """Control periods between decisions."""


NO_POLICY = PolicyArrays(
    np.zeros(0, dtype=np.float32), np.zeros((0, 4), dtype=np.int64), np.ones((1, WEIGHTS)),
    np.zeros((8, 1)), 1.0, np.zeros((0, WEIGHTS)), SCALES, 1,
)  # fmt: skip
"""Stands in where no policy decides."""


class Decider:
    """A choice of weights, and the network that makes it.

    Parameters
    ----------
    choice
        Meaning of an action.
    layers
        Layers of the network, (W (out, in), b (out,)) float32, with tanh between them; none where
        the caller makes the decisions.
    period
        Control period, s.
    """

    def __init__(self, choice: WeightChoice, layers: Layers, period: float) -> None:
        self.choice = choice
        self.rules = choice.rules(period)
        self.window = max(round(choice.window / period), 1)
        """Control periods between decisions."""
        activations = [*["tanh"] * (len(layers) - 1), "clip"] if layers else []
        self.arrays = PolicyArrays(
            *pack_layers(layers, activations), choice.sets, choice.matrix, choice.log_span,
            choice.catalogue_sets, SCALES, self.window,
        )  # fmt: skip
        sizes = [size(len(choice.bands)), choice.entries, *(len(bias) for _, bias in layers)]
        self.widest = max(sizes)
        """Size of the largest layer, its inputs included."""

    def observe(self, observations: Array, memory: LoopMemory) -> NDArray[np.float32]:
        """Compute features (n, size) of vehicles after their observations (n, entries)."""
        p = self.arrays
        features = np.zeros((len(observations), size(len(self.choice.bands))), dtype=np.float32)
        fill_all(
            observations, memory.history, memory.nmpc.weights, p.sets, memory.nmpc.bands, p.scales,
            p.log_span, features,
        )  # fmt: skip
        return features

    def choose(self, actions: Array, mask: Array, bands: Array, memory: LoopMemory) -> Array:
        """Write the weights that actions (n, entries) choose for bands (n,) into the tables.

        Only vehicles that `mask` (n,) marks are changed; their clocks start anew. Returns a mask
        (n,) of the actions that were rejected because they are not finite.
        """
        p = self.arrays
        rejected = np.zeros(len(actions), dtype=np.bool_)
        weights_for_all(
            actions, mask, bands, p.sets, p.matrix, p.log_span, p.catalogue, memory.tables, rejected
        )
        memory.history[np.ix_(mask, np.array([CLOCK, FAILURES, ITERATIONS]))] = 0.0
        return rejected


@compiled_internal
def decide_if_due(
    o: Array, h: Array, in_use: Array, band: int, policy: PolicyArrays, table: Array, work: Array
) -> None:
    """Let a policy choose the weights of the present band, a row of `table` (bands, 12), if due.

    A decision is due in an episode's first period, after a whole window, and in another band. An
    output that is not finite leaves the weights as they are and is counted. `work` (2, widest)
    float32 is working space.
    """
    if h[DECIDED] >= 0.0 and h[CLOCK] < policy.window and h[DECIDED] == band:
        return
    x, y = work[0], work[1]
    fill_features(o, h, in_use, policy.sets, band, policy.scales, policy.log_span, x)
    layers = policy.layers
    for k in range(layers.shape[0]):
        layer = layers[k]
        dense(x, layer, policy.network, y)
        # The last layer is clipped where its outputs are used: a catalogue compares them.
        if layer[ACTIVATION] == TANH:
            activate(y, layer[OUTPUTS], TANH, np.float32(1.0))
        x, y = y, x
    outputs = layers[layers.shape[0] - 1, OUTPUTS]
    if not weights_for(
        x[:outputs], band, policy.sets, policy.matrix, policy.log_span, policy.catalogue,
        table[max(band, 0)],
    ):  # fmt: skip
        h[REJECTED] += 1.0
    h[CLOCK], h[DECIDED] = 0.0, float(max(band, 0))
    h[FAILURES] = h[ITERATIONS] = 0.0
