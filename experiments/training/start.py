"""Policies to start a training from."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from agents.learned.learner import LearnerVecEnv
from agents.learned.policy import Policy
from experiments.training.settings import TrainingSettings

Layers = Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]


def check_start(
    policy: Policy, settings: TrainingSettings, env: LearnerVecEnv, *, squash: str
) -> None:
    """Refuse a policy that the training could not go on from.

    Raises
    ------
    ValueError
        Naming what differs.
    """
    scaling, layout = env.scaling, env.task.layout
    hidden = [len(bias) for _, bias in policy.layers[:-1]]
    same_scaling = all(
        np.array_equal(getattr(policy, name), getattr(scaling, name))
        for name in ("feature_weight", "feature_bias", "feature_limit", "centre", "half")
    )
    wanted = settings.hyperparameters
    for name, own, other in (
        ("control period", settings.control_period, policy.control_period),
        ("preview period", layout.preview_period, policy.layout.preview_period),
        ("preview steps", layout.preview_steps, policy.layout.preview_steps),
        ("hidden layers", list(wanted["hidden"]), hidden),
        ("activation", wanted["activation"], policy.activation),
        ("squashing of outputs", squash, policy.squash),
        ("origin of actions", scaling.origin, policy.origin),
        ("features or range of actions", True, same_scaling),
    ):
        if own != other:
            told = "" if isinstance(own, bool) else f" ({other!r}, this training has {own!r})"
            raise ValueError(f"the policy to start from differs in its {name}{told}")


def put_layers(layers: Layers, network: Sequence[torch.nn.Linear]) -> None:
    """Copy a policy's layers into a network."""
    for (weight, bias), layer in zip(layers, network, strict=True):
        layer.weight.data.copy_(torch.from_numpy(np.array(weight)))
        layer.bias.data.copy_(torch.from_numpy(np.array(bias)))
