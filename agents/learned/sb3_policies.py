"""Networks of SB3's PPO, SAC and TD3 models with an MLP on flat observations, as `Policy` has them.

torch and SB3 are imported when they are needed.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.learned.files import Layer
from agents.learned.policy import Activation, Squash
from trajectories.naming import choose

ALGORITHMS = ("ppo", "sac", "td3")
ACTIVATIONS: dict[str, Activation] = {"Tanh": "tanh", "ReLU": "relu"}
"""Names of torch's classes -> names of activations."""


class Sb3Network(NamedTuple):
    """Network from features to u in [-1, 1]; the fields of `Policy` with these names."""

    layers: tuple[Layer, ...]
    activation: Activation
    squash: Squash


def network_of(model: Any) -> Sb3Network:
    """Extract the network of a model's deterministic policy.

    The model maps features to its own action space. The range of that space becomes u in [-1, 1],
    so `Policy.centre` and `Policy.half` give the ends of that range in SI units.

    Parameters
    ----------
    model
        PPO, SAC or TD3 (or another algorithm with the same policy class), "MlpPolicy".

    Raises
    ------
    ValueError
        For a policy that is not such a network, with the reason.
    """
    modules, squash = _modules(model.policy)
    layers, activation = _layers(modules)
    low, high = _range(model.action_space)
    if squash == "clip":
        # PPO is trained on the action itself, which is clipped to the space afterwards.
        middle, reach = 0.5 * (low + high), 0.5 * (high - low)
        weight, bias = layers[-1]
        layers[-1] = (
            (weight / reach[:, None]).astype(np.float32),
            ((bias - middle) / reach).astype(np.float32),
        )
    return Sb3Network(tuple(layers), activation, squash)


def load_trusted(file: Path, algorithm: str) -> Any:
    """Load an SB3 model, on the CPU. This runs whatever code the file contains.

    Raises
    ------
    ValueError
        If it is not a model of that algorithm.
    ModuleNotFoundError
        If SB3 is not installed.
    """
    choose("algorithm", algorithm, ALGORITHMS)
    if not file.is_file():
        raise ValueError(f"there is no file {file}: give the .zip that model.save() has written")
    try:
        import stable_baselines3
    except ModuleNotFoundError as error:
        if error.name not in {"stable_baselines3", "torch"}:
            raise
        raise ModuleNotFoundError(
            "Stable-Baselines3 is not installed: pip install 'lpv-track-env[rl]'", name=error.name
        ) from error
    kind = getattr(stable_baselines3, algorithm.upper())
    try:
        return kind.load(file, device="cpu")
    except Exception as error:  # a file that is something else may raise anything
        raise ValueError(
            f"{file} is not a model that {algorithm.upper()} of Stable-Baselines3 loads: "
            f"{type(error).__name__}: {error}"
        ) from error


def _modules(policy: Any) -> tuple[list[Any], Squash]:
    """Return the modules from features to the mean action, and the squashing after them."""
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    kind = type(policy)
    squash: Squash = "tanh"
    if kind is ActorCriticPolicy:
        extractor = policy.pi_features_extractor
        modules = [*policy.mlp_extractor.policy_net, policy.action_net]
        squash = "clip"
    elif kind is SACPolicy:
        extractor = policy.actor.features_extractor
        modules = [*policy.actor.latent_pi, policy.actor.mu]
    elif kind is TD3Policy:
        extractor = policy.actor.features_extractor
        # Its last module is the tanh.
        modules = list(policy.actor.mu)[:-1]
    else:
        raise ValueError(f"{kind.__name__} cannot be taken: only MlpPolicy of PPO, SAC and TD3 can")
    if type(extractor) is not FlattenExtractor:
        raise ValueError(f"{type(extractor).__name__} cannot be taken: train with FlattenExtractor")
    if getattr(policy, "use_sde", False) or getattr(policy, "actor_kwargs", {}).get("use_sde"):
        raise ValueError("generalised exploration cannot be taken: train with use_sde=False")
    return modules, squash


def _layers(modules: list[Any]) -> tuple[list[Layer], Activation]:
    """Return weights and biases of linear modules, and the one activation between them."""
    from torch import nn

    linear, between = modules[::2], modules[1::2]
    kinds = {type(module).__name__ for module in between}
    if not all(type(module) is nn.Linear for module in linear) or not kinds <= ACTIVATIONS.keys():
        given = ", ".join(type(module).__name__ for module in modules)
        raise ValueError(f"{given} cannot be taken: only linear layers with Tanh or ReLU between")
    if len(kinds) > 1:
        raise ValueError("layers with different activations cannot be taken")
    layers: list[Layer] = [
        (
            module.weight.detach().cpu().numpy().copy(),
            module.bias.detach().cpu().numpy().copy(),
        )
        for module in linear
    ]
    return layers, ACTIVATIONS[kinds.pop()] if kinds else "tanh"


def _range(space: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = getattr(space, "low", None), getattr(space, "high", None)
    if low is None or high is None or not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"action space {space} cannot be taken: it must be a bounded Box")
    return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
