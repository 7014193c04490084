"""Policies with random weights, for tests of their files and of the agents that run them."""

import dataclasses
import functools
import itertools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learned import Policy, write
from agents.learned.network import Network
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.vehicle import VEHICLES

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


def act(policy: Policy, rows: NDArray[Any], base: NDArray[Any], bound: float = 1e6) -> Any:
    """What the compiled network does, its actions bounded to +- `bound`."""
    actions = np.array(base, dtype=np.float64)
    network = Network.of(policy, np.full(2, -bound), np.full(2, bound))
    assert network.act(rows, actions) == np.isnan(actions).any(axis=1).sum()
    return actions


def observations(n: int, seed: int = 0) -> NDArray[np.float64]:
    rows = np.random.default_rng(seed).normal(size=(n, 48)) * 3.0
    return rows.astype(np.float32).astype(np.float64)


# Policies that drive `m2-minibus`: feedback written down as a network.

DRIVING = ("linear", "increments", "residual")
"""Names that `driving_file` knows."""


@functools.cache
def driving_file(name: str) -> Path:
    """File of one of `DRIVING`, for this process."""
    return written(Path(_folder().name), driving_policy(name), f"{name}.json")


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="lpv-track-tests-")


def driving_policy(name: str) -> Policy:
    """Feedback on speed, lateral and heading error with the curvature ahead; mirror-symmetric.

    "linear" commands it, "increments" what it is from the actuators' values in force; "residual"
    adds a little of it to what the NMPC commands.
    """
    layout, car = ObservationLayout(), VEHICLES["m2-minibus"]
    at = {key: place.start for key, place in layout.slices.items()}
    inputs = layout.size + (2 if name == "residual" else 0)
    weight, bias = np.zeros((2, inputs)), np.zeros(2)
    ahead = at["preview_speed"] + 4
    weight[0, [ahead, at["longitudinal_speed"]]] = 1.5, -1.5
    weight[1, [at["lateral_error"], at["heading_error"], at["yaw_rate"]]] = -0.3, -1.0, -0.1
    scale = np.array([3.0, 0.5])
    if name == "residual":
        weight *= 0.02
        weight[1, -1] = 0.01  # a hundredth more than the NMPC steers
    else:
        bias[0] = car.rolling_deceleration
        weight[1, at["preview_curvature"] : at["preview_curvature"] + 8] = car.wheelbase / 8.0
    if name == "increments":
        weight[0, at["acceleration"]] = weight[1, at["steering_angle"]] = -1.0
    return Policy(
        algorithm=name,
        layout=layout,
        control_period=0.05,
        feature_weight=weight.astype(np.float32),
        feature_bias=bias.astype(np.float32),
        feature_limit=100.0,
        layers=((np.diag(1.0 / scale).astype(np.float32), np.zeros(2, dtype=np.float32)),),
        activation="tanh",
        squash="tanh" if name == "residual" else "clip",
        origin={"linear": "zero", "increments": "actuators", "residual": "lpv-nmpc"}[name],  # type: ignore[arg-type]
        centre=np.zeros(2),
        half=scale,
    )
