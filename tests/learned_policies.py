"""Policies with random weights, for tests of their files and of the agents that run them."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learned import Policy
from lpv_track_env.observation import ObservationLayout

TRAINING: dict[str, Any] = {
    "command": "lpv-track train ppo", "seed": 3, "steps": 1000, "conditions": {"gnss_noise": 0.05},
    "versions": ["torch 2", None, True, 1e-9],
}  # fmt: skip


def random_policy(seed: int = 0, hidden: tuple[int, ...] = (16, 8), **changes: Any) -> Policy:
    """A policy with 48 or 50 inputs, 12 features, and such hidden layers."""
    rng = np.random.default_rng(seed)
    layout = changes.get("layout", ObservationLayout())
    inputs = layout.size + (2 if changes.get("origin") == "lpv-nmpc" else 0)
    sizes = [12, *hidden, 2]
    fields: dict[str, Any] = {
        "algorithm": "ppo",
        "layout": layout,
        "control_period": 0.05,
        "feature_weight": rng.normal(size=(12, inputs)) / 4.0,
        "feature_bias": rng.normal(size=12),
        "feature_limit": 3.0,
        "layers": tuple(
            (rng.normal(size=(b, a)) / np.sqrt(a), 0.3 * rng.normal(size=b))
            for a, b in itertools.pairwise(sizes)
        ),
        "activation": "tanh",
        "squash": "tanh",
        "origin": "zero",
        "centre": np.array([0.1, -0.01]),
        "half": np.array([2.0, 0.3]),
        "training": TRAINING,
    }
    return Policy(**{**fields, **changes})


def written(folder: Path, policy: Policy | None = None, name: str = "mine.json") -> Path:
    from agents.learned import write

    file = folder / name
    write(policy or random_policy(), file)
    return file


def same(one: Policy, other: Policy) -> bool:
    """Whether every field is the same, to the bit."""
    return all(
        _same(getattr(one, field.name), getattr(other, field.name))
        for field in dataclasses.fields(Policy)
    )


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return (
            one.dtype == other.dtype
            and one.shape == other.shape
            and one.tobytes() == (other.tobytes())
        )
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return type(one) is type(other) and bool(one == other)


def plain_act(policy: Policy, rows: NDArray[Any], base: NDArray[Any]) -> NDArray[np.float64]:
    """Actions (n, 2) of rows (n, inputs) as the policy's formula says, in float64, not clipped."""
    x = rows.astype(np.float64)
    x = x @ policy.feature_weight.T.astype(np.float64) + policy.feature_bias
    x = np.clip(x, -policy.feature_limit, policy.feature_limit)
    between = np.tanh if policy.activation == "tanh" else (lambda z: np.maximum(z, 0.0))
    for weight, bias in policy.layers[:-1]:
        x = between(x @ weight.T.astype(np.float64) + bias)
    weight, bias = policy.layers[-1]
    x = x @ weight.T.astype(np.float64) + bias
    u = np.tanh(x) if policy.squash == "tanh" else np.clip(x, -1.0, 1.0)
    return base + policy.centre + policy.half * u
