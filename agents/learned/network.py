"""Features and network of a policy in compiled code: rows of observations to actions.

Every row is evaluated alone and in the same order, so its action does not depend on the batch.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learned.files import Layer
from agents.learned.policy import ORIGINS, Policy
from lpv_track_env.observation import ACCELERATION, STEERING_ANGLE
from trajectories.compilation import compiled, compiled_inline

Array = NDArray[Any]

FROM_ACTUATORS, FROM_BASE = ORIGINS.index("actuators"), ORIGINS.index("lpv-nmpc")

# Columns of a layer in `table`: index in `weights` of its transposed weights (inputs, outputs),
# which its bias follows; numbers of inputs and outputs; activation of the outputs.
START, INPUTS, OUTPUTS, ACTIVATION = range(4)

ACTIVATIONS = ("tanh", "relu", "clip")
"""Names of the activations by their codes."""
TANH, RELU = ACTIVATIONS.index("tanh"), ACTIVATIONS.index("relu")

# Indices in `numbers` (9,): limit of the features; a, then delta, of each of the others.
LIMIT, CENTRE, HALF, LOW, HIGH = 0, 1, 3, 5, 7


@compiled_inline
def dense(x: Array, layer: Array, weights: Array, y: Array) -> None:
    """Fill y = W x + b; the inner loops run over outputs, which are adjacent in memory."""
    inputs, outputs = layer[INPUTS], layer[OUTPUTS]
    at = layer[START]
    bias = weights[at + inputs * outputs : at + inputs * outputs + outputs]
    for j in range(outputs):
        y[j] = bias[j]
    blocks = inputs // 4
    # Four inputs at a time: y is loaded and stored a quarter as often.
    for block in range(blocks):
        i = 4 * block
        x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
        w0 = weights[at + i * outputs : at + (i + 1) * outputs]
        w1 = weights[at + (i + 1) * outputs : at + (i + 2) * outputs]
        w2 = weights[at + (i + 2) * outputs : at + (i + 3) * outputs]
        w3 = weights[at + (i + 3) * outputs : at + (i + 4) * outputs]
        for j in range(outputs):
            y[j] = (((y[j] + x0 * w0[j]) + x1 * w1[j]) + x2 * w2[j]) + x3 * w3[j]
    for i in range(4 * blocks, inputs):
        x0 = x[i]
        w0 = weights[at + i * outputs : at + (i + 1) * outputs]
        for j in range(outputs):
            y[j] += x0 * w0[j]


@compiled_inline
def activate(y: Array, outputs: int, kind: int, limit: Any) -> None:
    """Apply tanh, relu, or a clip to [-limit, limit]; NaN stays NaN."""
    zero = np.float32(0.0)
    if kind == TANH:
        for j in range(outputs):
            y[j] = math.tanh(y[j])
    elif kind == RELU:
        for j in range(outputs):
            y[j] = zero if y[j] < zero else y[j]  # noqa: FURB136  max() may drop a NaN
    else:
        for j in range(outputs):
            low = -limit if y[j] < -limit else y[j]  # noqa: FURB136
            y[j] = limit if low > limit else low  # noqa: FURB136


@compiled
def act(
    rows: Array, weights: Array, table: Array, numbers: Array, mirrors: Array, origin: int,
    scratch: Array, actions: Array,
) -> int:  # fmt: skip
    """Replace the base action of each row by the policy's action; return how many rows have none.

    Parameters
    ----------
    rows
        (n, size) float64 observations.
    weights, table
        All weights and biases, float32; (1 + layers, 4) int64, the features first.
    numbers
        Limit, centre, half, low and high, float64.
    mirrors
        (passes, inputs) float32: factors of the inputs in each pass through the network, 1 in the
        first; a second pass, if there is one, is mirrored.
    origin
        Index in `ORIGINS`.
    scratch
        (2, widest) float32.
    actions
        (n, 2) float64: base actions for origin "lpv-nmpc", replaced by actions; NaN where the row
        or the network's output is not finite.
    """
    size, passes, lost = rows.shape[1], mirrors.shape[0], 0
    share = 1.0 / passes
    for row in range(rows.shape[0]):
        finite = True
        for i in range(size):
            finite = finite and math.isfinite(np.float32(rows[row, i]))
        base_a, base_delta = 0.0, 0.0
        if origin == FROM_ACTUATORS:
            base_a, base_delta = rows[row, ACCELERATION], rows[row, STEERING_ANGLE]
        elif origin == FROM_BASE:
            base_a, base_delta = actions[row, 0], actions[row, 1]
        u_a = u_delta = 0.0
        for mirrored in range(passes):
            x, y = scratch[0], scratch[1]
            for i in range(size):
                x[i] = np.float32(rows[row, i]) * mirrors[mirrored, i]
            if origin == FROM_BASE:
                x[size] = np.float32(base_a) * mirrors[mirrored, size]
                x[size + 1] = np.float32(base_delta) * mirrors[mirrored, size + 1]
            limit = np.float32(numbers[LIMIT])
            for k in range(table.shape[0]):
                layer = table[k]
                dense(x, layer, weights, y)
                activate(y, layer[OUTPUTS], layer[ACTIVATION], limit)
                limit = np.float32(1.0)
                x, y = y, x
            u_a += share * x[0]
            u_delta += share * x[1] * (1.0 - 2.0 * mirrored)
        a = base_a + numbers[CENTRE] + numbers[HALF] * u_a
        delta = base_delta + numbers[CENTRE + 1] + numbers[HALF + 1] * u_delta
        if finite and not (math.isnan(a) or math.isnan(delta)):
            actions[row, 0] = min(max(a, numbers[LOW]), numbers[HIGH])
            actions[row, 1] = min(max(delta, numbers[LOW + 1]), numbers[HIGH + 1])
        else:
            actions[row, 0] = actions[row, 1] = math.nan
            lost += 1
    return lost


def pack_layers(
    layers: Sequence[Layer], activations: Sequence[str]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Pack layers and their activations into `weights` and `table` (layers, 4) for `act`."""
    table, packed, start = [], [np.zeros(0, dtype=np.float32)], 0
    for (weight, bias), kind in zip(layers, activations, strict=True):
        table.append([start, weight.shape[1], weight.shape[0], ACTIVATIONS.index(kind)])
        packed += [weight.T.ravel(), bias]
        start += weight.size + bias.size
    return np.concatenate(packed), np.array(table, dtype=np.int64).reshape(-1, 4)


@dataclass(eq=False)
class Network:
    """A policy in the arrays that `act` takes."""

    weights: NDArray[np.float32]
    table: NDArray[np.int64]
    numbers: NDArray[np.float64]
    mirrors: NDArray[np.float32]
    origin: int
    scratch: NDArray[np.float32]

    @classmethod
    def of(cls, policy: Policy, low: Array, high: Array) -> "Network":
        """Pack a policy without context and the bounds (2,) of its actions, in SI units."""
        stages = [(policy.feature_weight, policy.feature_bias), *policy.layers]
        activations = ["clip", *[policy.activation] * (len(policy.layers) - 1), policy.squash]
        weights, table = pack_layers(stages, activations)
        numbers = np.concatenate([[policy.feature_limit], policy.centre, policy.half, low, high])
        return cls(
            weights,
            table,
            numbers,
            np.stack([np.ones_like(policy.mirror), policy.mirror][: 1 + policy.symmetric]),
            ORIGINS.index(policy.origin),
            np.zeros((2, max(policy.sizes)), dtype=np.float32),
        )

    def act(self, rows: Array, actions: Array) -> int:
        """Fill actions (n, 2) for rows (n, size), see `act`; return how many rows have none."""
        return act(
            rows, self.weights, self.table, self.numbers, self.mirrors, self.origin, self.scratch,
            actions,
        )  # fmt: skip
