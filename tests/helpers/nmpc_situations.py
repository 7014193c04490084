"""Random situations for the tests of the real-time NMPC: the arguments of one solve."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.nmpc.problem import NmpcProblem
from agents.weights import TrackingWeights

Array = NDArray[np.float64]
WEIGHTS = TrackingWeights().as_array()
MIRROR_STATE = np.array([1.0, -1.0, -1.0, -1.0, 1.0, -1.0])
MIRROR_INPUT = np.array([1.0, -1.0])
MIRROR_OUTPUT = np.array([1.0, -1.0, 1.0, -1.0])


class Situation(NamedTuple):
    """Arguments of `solve`, in its order, and inputs within the hard limits to linearise along."""

    state: Array
    last_input: Array
    reference: Array
    weights: Array
    inputs: Array

    @property
    def parameters(self) -> tuple[Array, Array, Array, Array]:
        """State (6,), last input (2,), reference (N + 1, 4), weights (12,)."""
        return self.state, self.last_input, self.reference, self.weights

    @property
    def mirrored(self) -> "Situation":
        """The situation mirrored, left to right."""
        return Situation(
            self.state * MIRROR_STATE,
            self.last_input * MIRROR_INPUT,
            self.reference * MIRROR_OUTPUT,
            self.weights,
            self.inputs * MIRROR_INPUT,
        )


def arc(curvature: float, speeds: Array, period: float | Array) -> Array:
    """Reference (N + 1, 4) [vx, psi, X, Y] along an arc from the origin, at speeds (N + 1,).

    `period` (s) is the time from node to node, one for all or (N,).
    """
    lengths = 0.5 * (speeds[1:] + speeds[:-1]) * period
    s = np.concatenate([[0.0], np.cumsum(lengths)])
    half = 0.5 * curvature * s
    chord = s * np.sinc(half / np.pi)
    return np.column_stack([speeds, 2.0 * half, chord * np.cos(half), chord * np.sin(half)])


def hard(
    rng: np.random.Generator, problem: NmpcProblem, decades: float = 1.0, errors: float = 1.0
) -> Situation:
    """A vehicle that turns beside an arc, mostly so that it must reach for its limits.

    Weights are drawn log-uniformly within `decades` to both sides of the defaults; `errors` scales
    what is wrong at the start, and with less than one the limits matter less. No input brakes
    to below 1 m/s within the horizon, where the model's Runge-Kutta steps are no longer stable.
    """
    car, n = problem.vehicle, problem.horizon
    vx = rng.uniform(1.5, 15.0)
    sharpest = min(0.12, 4.0 / vx**2)
    curvature = rng.uniform(-sharpest, sharpest)
    state = np.array(
        [
            vx,
            vx * curvature * car.rear_axle_distance + errors * rng.normal(0.0, 0.1),
            errors * rng.normal(0.0, 0.15),
            vx * curvature + errors * rng.normal(0.0, 0.1),
            0.0,
            errors * rng.normal(0.0, 0.5),
        ]
    )
    low, high = problem.input_bounds
    low[0] = max(low[0], (1.0 - vx) / problem.times[-1] + car.rolling_deceleration)
    last = np.array([errors * rng.uniform(low[0], high[0]), car.wheelbase * curvature]).clip(
        low, high
    )
    if vx < 5.0 and errors >= 1.0:
        last[1] = rng.uniform(low[1], high[1])
    speeds = vx + errors * rng.normal(0.0, 1.0) + rng.uniform(-1.5, 1.5) * problem.times
    inputs, before = np.empty((n, 2)), last
    for i, step in enumerate(problem.input_steps):
        inputs[i] = before = (before + rng.uniform(-1.0, 1.0, 2) * step).clip(low, high)
    return Situation(
        state,
        last,
        arc(curvature, np.maximum(speeds, 0.5), problem.periods),
        WEIGHTS * 10.0 ** rng.uniform(-decades, decades, len(WEIGHTS)),
        inputs,
    )
