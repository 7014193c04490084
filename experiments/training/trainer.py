"""Base of the ways to train, and what they start from: environments and, if given, a policy."""

import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import agents
from agents.learned.context import CONTEXT
from agents.learned.learner import LearnerVecEnv, usual_scaling
from agents.learned.policy import Policy
from experiments.jobs.job import episode_seed
from experiments.training.settings import TrainingSettings
from experiments.training.situations import USUAL
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import ReferencePath

Layers = Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]
Tick = Callable[[int, str], None]
"""Called with the steps done so far and a few words on them."""

MODULES: dict[str, type[torch.nn.Module]] = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}
"""PyTorch's modules of the activations that a policy may have."""


class Trainer(ABC):
    """Training in segments, each a function of the state that it begins with."""

    device: torch.device
    """Device that the networks are on."""

    def __init__(self, settings: TrainingSettings, env: LearnerVecEnv) -> None:
        self.settings, self.env = settings, env
        self.hyper: Mapping[str, Any] = settings.hyperparameters
        self.random = np.random.default_rng(settings.seed)

    @property
    @abstractmethod
    def steps(self) -> int:
        """Environment steps so far."""

    @property
    @abstractmethod
    def solves(self) -> int:
        """NMPC solves so far."""

    @abstractmethod
    def segment(self, number: int, tick: Tick) -> dict[str, float]:
        """Train to the end of a segment; return figures to keep, by name."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Return all that the next segment depends on: tensors and plain values."""

    @abstractmethod
    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a state."""

    @abstractmethod
    def policy(self, training: Mapping[str, Any]) -> Policy:
        """Return the present policy, with `training` as its provenance."""

    def begin_segment(self, number: int) -> None:
        """Seed all random generators from (seed, segment): a segment depends on no earlier draw."""
        seed = int(np.random.SeedSequence((self.settings.seed, number)).generate_state(1)[0])
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002  where SB3 draws from
        torch.manual_seed(seed)
        self.random = np.random.default_rng(seed)
        self.env.action_space.seed(seed)
        self.env.seed(episode_seed(self.settings.seed, number))

    def rate(self) -> float:
        """Return the present learning rate: from the first to the last, linear in the steps."""
        first, last = self.hyper["learning_rate"], self.hyper["last_learning_rate"]
        share = min(self.steps / self.settings.steps, 1.0)
        return float(first + share * (last - first))


def path_names(settings: TrainingSettings) -> list[str]:
    """Return the names of all paths of a training, each once."""
    names = [name for part in settings.parts for name in settings.training_paths(part)]
    return list(dict.fromkeys(names))


def shared_out(settings: TrainingSettings) -> list[int]:
    """Share the environments out among the situations; the first get those that are left over."""
    shares = [part.share for part in settings.parts]
    counts = [settings.envs * share // sum(shares) for share in shares]
    left = settings.envs - sum(counts)
    return [count + (k < left) for k, count in enumerate(counts)]


def make_learner_env(settings: TrainingSettings, paths: list[ReferencePath]) -> LearnerVecEnv:
    """Make the environments of a training, shared out among its situations.

    `paths` are those of `path_names`, in its order.
    """
    parts, loaded = settings.parts, dict(zip(path_names(settings), paths, strict=True))
    envs = [
        PathTrackingVectorEnv(
            count, [loaded[name] for name in settings.training_paths(part)], part.car(),
            conditions=part.conditions,
            control_period=settings.control_period, preview_steps=settings.preview_steps,
            preview_period=settings.preview_period, reward_weights=settings.reward_weights(),
            time_limit=settings.time_limit, initial_error_range=part.errors, random_start=True,
            autoreset_mode="SameStep", **part.speed,
        )
        for part, count in zip(parts, shared_out(settings), strict=True)
    ]  # fmt: skip
    scaling = usual_scaling(
        agents.DrivingTask.of(envs[0].single), settings.hyperparameters["origin"],
        context=() if settings.situations == USUAL else tuple(CONTEXT),
    )  # fmt: skip
    return LearnerVecEnv([agents.sb3_vec_env(env) for env in envs], scaling)


def check_start(
    policy: Policy, settings: TrainingSettings, env: LearnerVecEnv, *, squash: str
) -> None:
    """Refuse a policy that the training could not start from.

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
        ("context", list(scaling.context), list(policy.context)),
        ("features or range of actions", True, same_scaling),
    ):
        if own != other:
            values = "" if isinstance(own, bool) else f" ({other!r}, this training has {own!r})"
            raise ValueError(f"the policy to start from differs in its {name}{values}")


def put_layers(layers: Layers, network: Sequence[torch.nn.Linear]) -> None:
    """Copy the layers of a policy into a network."""
    for (weight, bias), layer in zip(layers, network, strict=True):
        layer.weight.data.copy_(torch.from_numpy(np.array(weight)))
        layer.bias.data.copy_(torch.from_numpy(np.array(bias)))
