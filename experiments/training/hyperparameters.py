"""Hyperparameters of each algorithm: what `--set` may change, defaults, and what they may be.

They are explained where they are used: `sb3_trainer` and `cloning`.
"""

import math
from collections.abc import Mapping
from typing import Any

from agents.learned.policy import ACTIVATIONS, ORIGINS
from trajectories.naming import choose

PPO = {
    "learning_rate": 1e-3, "last_learning_rate": 2e-5, "rollout": 32, "batch": 4096, "epochs": 4,
    "discount": 0.97, "gae_lambda": 0.9, "clip_range": 0.2, "deviation": math.exp(-1.0),
    "hidden": [64, 64], "activation": "tanh", "origin": "actuators",
}  # fmt: skip
OFF_POLICY = {
    "learning_rate": 1e-3, "last_learning_rate": 2e-5, "buffer": 300_000, "batch": 256,
    "gradient_steps": 16, "learning_starts": 10_000, "discount": 0.97, "target_rate": 0.01,
    "hidden": [64, 64], "activation": "relu", "origin": "actuators",
}  # fmt: skip

HYPERPARAMETERS: dict[str, dict[str, Any]] = {
    "ppo": PPO,
    "residual": {**PPO, "deviation": math.exp(-2.0), "origin": "lpv-nmpc"},
    "sac": OFF_POLICY,
    "td3": {**OFF_POLICY, "noise": 0.2},
    "bc": {
        "learning_rate": 2e-3, "last_learning_rate": 1e-5, "round": 100, "batch": 4096,
        "updates": 600, "expert_share": 0.25, "noise": 0.3,
        "hidden": [64, 64], "activation": "tanh", "origin": "actuators",
    },
}  # fmt: skip
"""Defaults by algorithm."""

ALGORITHMS = tuple(HYPERPARAMETERS)
BASE = "lpv-nmpc"
"""Origin of a residual's actions."""
CHOICES = {"activation": ACTIVATIONS, "origin": ORIGINS}
"""Names that a hyperparameter may be."""
LEAST = {"batch": 2, "deviation": 1e-6, "clip_range": 1e-6, "target_rate": 1e-6}
MOST = {"discount": 1.0, "gae_lambda": 1.0, "target_rate": 1.0, "expert_share": 1.0}
"""Ends of those that may not be any number >= 0; counts are at least 1."""


def complete(algorithm: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Hyperparameters given, and the defaults of all others.

    Raises
    ------
    ValueError
        For an unknown name, or a value that is of another kind than its default or out of range.
    """
    known = HYPERPARAMETERS[choose("algorithm", algorithm, ALGORITHMS)]
    for key, value in given.items():
        choose(f"hyperparameter of {algorithm}", key, tuple(known))
        _check(key, value, known[key])
    hyper = {**known, **given}
    if hyper["origin"] == BASE != known["origin"]:
        raise ValueError(f"only residual is trained on top of {BASE}, not {algorithm}")
    return hyper


def _check(key: str, value: Any, usual: Any) -> None:
    """Refuse a hyperparameter of another kind than its default, or out of its range."""
    if key in CHOICES:
        choose(key, value, CHOICES[key])
        return
    if isinstance(usual, list):
        good = (
            isinstance(value, list)
            and bool(value)
            and all(type(width) is int and 0 < width <= 4096 for width in value)
        )
    else:
        whole = isinstance(usual, int)
        good = type(value) in ({int} if whole else {int, float}) and math.isfinite(value)
        least, most = LEAST.get(key, int(whole)), MOST.get(key, math.inf)
        if good and not least <= value <= most:
            raise ValueError(f"hyperparameter {key} must be in [{least}, {most}], not {value}")
    if not good:
        raise ValueError(f"hyperparameter {key} must be like {usual!r}, not {value!r}")
