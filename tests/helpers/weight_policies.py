"""Weight policies with random numbers, for tests of their files and of what drives with them."""

import dataclasses
import itertools
from typing import Any

import numpy as np

from agents.weight_tuning.choice import DIRECTIONS, WeightChoice
from agents.weight_tuning.features import size
from agents.weight_tuning.policy import WeightPolicy
from agents.weights import WEIGHTS, TrackingWeights, WeightSchedule
from lpv_track_env.observation import ObservationLayout
from trajectories import CurvatureBands

TRAINING: dict[str, Any] = {
    "command": "lpv-track tune rl", "seed": 3, "solves": 300_000, "nothing": None,
    "scores": [1e-9, True, {"é": "\ud800"}],
}  # fmt: skip


def random_weights(rng: np.random.Generator) -> TrackingWeights:
    """Weights within their bounds, over six decades."""
    return TrackingWeights.from_array(10.0 ** rng.uniform(-3.0, 3.0, WEIGHTS))


def random_weight_choice(seed: int = 0, catalogue: bool = False) -> WeightChoice:
    """A choice with four bands; with a catalogue, of five sets."""
    rng = np.random.default_rng(seed)
    base = WeightSchedule(
        CurvatureBands(thresholds=tuple(np.cumsum(rng.uniform(0.01, 0.02, 3)).tolist())),
        tuple(random_weights(rng) for _ in range(4)),
        slew=float(rng.uniform(1.0, 10.0)),
        provenance={"tuner": "random search", "seed": seed},
    )
    return WeightChoice(
        base,
        directions=str(rng.choice(tuple(DIRECTIONS))),
        span=float(rng.uniform(2.0, 20.0)),
        catalogue=tuple(random_weights(rng) for _ in range(5)) if catalogue else (),
        window=float(rng.uniform(0.1, 1.0)),
    )


def random_weight_policy(
    seed: int = 0, catalogue: bool = False, hidden: tuple[int, ...] = (7, 5), **changes: Any
) -> WeightPolicy:
    """A policy with such hidden layers, of a `random_weight_choice`."""
    rng = np.random.default_rng(seed)
    choice = changes.get("choice", random_weight_choice(seed, catalogue))
    sizes = [size(len(choice.bands)), *hidden, choice.entries]
    fields: dict[str, Any] = {
        "choice": choice,
        "layers": tuple(
            (rng.normal(size=(b, a)) / np.sqrt(a), 0.3 * rng.normal(size=b))
            for a, b in itertools.pairwise(sizes)
        ),
        "layout": ObservationLayout(),
        "control_period": 0.05,
        "algorithm": "rl",
        "training": TRAINING,
    }
    return WeightPolicy(**{**fields, **changes})


def same(one: WeightPolicy, other: WeightPolicy) -> bool:
    """Whether every field is the same, arrays to the bit."""
    arrays, others = ([a for layer in p.layers for a in layer] for p in (one, other))
    return (
        [(a.dtype, a.shape, a.tobytes()) for a in arrays]
        == [(a.dtype, a.shape, a.tobytes()) for a in others]
        and all(
            repr(getattr(one, field.name)) == repr(getattr(other, field.name))
            for field in dataclasses.fields(WeightPolicy)
            if field.name != "layers"
        )
        and one.choice == other.choice
    )
