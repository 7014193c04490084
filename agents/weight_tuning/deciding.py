"""Compiled: a weight policy at work, one vehicle's period at a time."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agents.learned.network import ACTIVATION, CLIP, OUTPUTS, TANH, activate, dense
from agents.weight_tuning.choice import (
    PackedChoice,
    WeightChoice,
    weights_for,
    weights_for_all,
)
from agents.weight_tuning.features import SCALES, fill_all, fill_features, size
from agents.weight_tuning.watching import CLOCK, DECIDED, FAILURES, ITERATIONS, REJECTED
from trajectories.compilation import compiled

if TYPE_CHECKING:
    from agents.weight_tuning.loop_memory import LoopMemory

Array = NDArray[Any]
Layers = tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]


class Decider:
    """A choice of weights and the network that chooses, as `reconsider` takes them.

    Parameters
    ----------
    choice
        What an action means.
    layers
        (W (out, in), b (out,)) float32, tanh between them; none: others decide.
    period
        Control period, s.
    """

    def __init__(self, choice: WeightChoice, layers: Layers, period: float) -> None:
        self.choice = choice
        self.packed: PackedChoice = choice.as_packed()
        self.rules = choice.rules(period)
        table, packed, start = [], [], 0
        for k, (weight, bias) in enumerate(layers):
            last = k == len(layers) - 1
            table.append([start, weight.shape[1], weight.shape[0], CLIP if last else TANH])
            packed += [weight.T.ravel(), bias]
            start += weight.size + bias.size
        self._network = (
            np.concatenate(packed) if packed else np.zeros(0, dtype=np.float32),
            np.array(table, dtype=np.int64).reshape(-1, 4),
        )
        sizes = [size(len(choice.bands)), choice.entries, *(len(bias) for _, bias in layers)]
        self.widest = max(sizes)
        self._window = max(round(choice.window / period), 1)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """What `reconsider` takes between the weights in use and the tables."""
        p = self.packed
        return (*self._network, p.sets, p.matrix, p.log_span, p.catalogue, SCALES, self._window)

    @property
    def window(self) -> int:
        """Control periods between decisions."""
        return self._window

    def observe(self, observations: Array, memory: "LoopMemory") -> NDArray[np.float32]:
        """Features (n, size) of vehicles, of observations (n, entries) that are taken in."""
        p = self.packed
        seen = np.zeros((len(observations), size(len(self.choice.bands))), dtype=np.float32)
        fill_all(
            observations, memory.watched, memory.nmpc.weights, p.sets, memory.nmpc.bands, SCALES,
            p.log_span, seen,
        )  # fmt: skip
        return seen

    def choose(self, actions: Array, mask: Array, bands: Array, memory: "LoopMemory") -> Array:
        """Write what actions (n, entries) mean into the tables, for bands (n,), where `mask` marks.

        Returns of which actions nothing could be made, (n,) bool. A new decision is counted from.
        """
        p = self.packed
        refused = np.zeros(len(actions), dtype=np.bool_)
        weights_for_all(
            actions, mask, bands, p.sets, p.matrix, p.log_span, p.catalogue, memory.tables, refused
        )
        decided = memory.watched[mask]
        decided[:, [CLOCK, FAILURES, ITERATIONS]] = 0.0
        memory.watched[mask] = decided
        return refused


NOBODY: tuple[Any, ...] = (
    np.zeros(0, dtype=np.float32), np.zeros((0, 4), dtype=np.int64), np.ones((1, 10)),
    np.zeros((8, 1)), 1.0, np.zeros((0, 10)), SCALES, 1,
)  # fmt: skip
"""`Decider.arguments` where no policy decides."""


@compiled
def reconsider(
    o: Array, w: Array, used: Array, band: int, network: Array, layers: Array, sets: Array,
    matrix: Array, log_span: Any, catalogue: Array, scales: Array, window: int, table: Array,
    scratch: Array,
) -> None:  # fmt: skip
    """Decide anew, if it is time, on the weights of a band: that row of `table` (bands, 10).

    It is time in an episode's first period, after `window` periods, and in another band. An output
    that is no number changes nothing and is counted. `scratch` is (2, widest) float32.
    """
    if w[DECIDED] >= 0.0 and w[CLOCK] < window and w[DECIDED] == band:
        return
    x, y = scratch[0], scratch[1]
    fill_features(o, w, used, sets, band, scales, log_span, x)
    for k in range(layers.shape[0]):
        layer = layers[k]
        dense(x, layer, network, y)
        # The last one's outputs are clipped where they are used: a catalogue compares them.
        if layer[ACTIVATION] == TANH:
            activate(y, layer[OUTPUTS], TANH, np.float32(1.0))
        x, y = y, x
    outputs = layers[layers.shape[0] - 1, OUTPUTS]
    if not weights_for(x[:outputs], band, sets, matrix, log_span, catalogue, table[max(band, 0)]):
        w[REJECTED] += 1.0
    w[CLOCK], w[DECIDED] = 0.0, float(max(band, 0))
    w[FAILURES] = w[ITERATIONS] = 0.0
