"""Settings and hyperparameters of a training, with the defaults of each algorithm.

The hyperparameters are explained in `sb3_trainer` and `cloning`, which use them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from agents.learned.policy import ACTIVATIONS, ORIGINS
from experiments.jobs.job import (
    MOST_PATHS,
    TRAINING_PATHS,
    VALIDATION_PATHS,
    check_paths,
    plain_values,
)
from experiments.training import ALGORITHMS
from experiments.training.situations import SITUATIONS, USUAL, Situation
from lpv_track_env import conditions, vehicle
from lpv_track_env.observation import PREVIEW_PERIOD, PREVIEW_STEPS
from lpv_track_env.reward import RewardWeights
from trajectories.arguments import shown
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
"""Defaults of `--set` by algorithm."""
BASE = "lpv-nmpc"
"""Origin of a residual's actions."""
NAMED = {"activation": ACTIVATIONS, "origin": ORIGINS}
"""Values of the hyperparameters that are names."""
# Ranges of the other hyperparameters: by default counts are at least 1, numbers at least 0.
LEAST = {"batch": 2, "deviation": 1e-6, "clip_range": 1e-6, "target_rate": 1e-6}
MOST = {"discount": 1.0, "gae_lambda": 1.0, "target_rate": 1.0, "expert_share": 1.0}

ENVS = {"ppo": 512, "residual": 256, "sac": 64, "td3": 64, "bc": 256}
STEPS = {
    "ppo": 20_000_000, "residual": 3_000_000, "sac": 600_000, "td3": 600_000, "bc": 300_000,
}  # fmt: skip
SEGMENTS = {
    "ppo": 1_000_000, "residual": 250_000, "sac": 100_000, "td3": 100_000, "bc": 100_000,
}  # fmt: skip

REWARD = {
    "lateral_scale": 0.02, "heading": 0.1, "speed_scale": 0.5, "input_rate": 0.2,
}  # fmt: skip
"""Weights of the training's reward, which the environment's own scale of 0.5 m would make blind to
centimetres.

With 0.05 m, PPO ends at twice the error in simulation; with 0.02 m it takes longer to stay on the
road at first.
"""

LIMITS_REWARD = {**REWARD, "lateral": 0.4, "lateral_scale": 0.05, "end": 100.0}
"""The same for situations far beside the path, from where it must pay to come back: seconds with an
error of some metres cost less than to leave the corridor."""

FAST: dict[str, Any] = {
    "conditions": ("simulation",), "steps": 5_000_000, "reward": {**REWARD, "lateral_scale": 0.05},
    "hyperparameters": {"batch": 2048, "epochs": 2},
}  # fmt: skip
"""`--fast` of PPO: no disturbances, half as many updates, and a reward that is easier to begin
with."""


VEHICLE, CONDITIONS = "m2-minibus", ("simulation", "realtime")


@dataclass(frozen=True)
class TrainingSettings:
    """A training: the same settings give the same weights, bit for bit, on the same machine.

    `steps` are environment steps of all environments together. After every `segment` of them a
    checkpoint is written, all seeds are drawn anew from (seed, segment) and all episodes restart,
    so that a resumed training equals an uninterrupted one. `conditions` share the environments
    evenly. `trajectories` are files or names; by default `paths` random ones that only this seed
    trains on. `situations` names a set of `SITUATIONS` in place of vehicle, conditions and paths.
    `validation` paths are driven after every segment in each situation.
    `start` is the file of a policy whose network the training starts from.

    Raises
    ------
    ValueError
        For an unknown name, a number out of its range, segments too short to learn in, or a path
        that the benchmark drives.
    """

    algorithm: str
    steps: int
    envs: int
    segment: int
    seed: int = 0
    vehicle: str = VEHICLE
    conditions: tuple[Any, ...] = CONDITIONS
    situations: str = USUAL
    control_period: float = 0.05
    preview_steps: int = PREVIEW_STEPS
    preview_period: float = PREVIEW_PERIOD
    trajectories: tuple[str, ...] = ()
    paths: int = 48
    validation: int = 6
    time_limit: float = 20.0
    start: str | None = None
    device: str = "auto"
    reward: Mapping[str, float] = field(default_factory=lambda: dict(REWARD))
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "hyperparameters", complete(self.algorithm, self.hyperparameters))
        object.__setattr__(self, "conditions", tuple(self.conditions))
        object.__setattr__(self, "trajectories", tuple(self.trajectories))
        for name in ("steps", "envs", "segment", "paths", "validation"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        check_paths(self.trajectories, self.paths, self.seed, verb="train")
        if not self.conditions:
            raise ValueError("a training needs at least one kind of conditions")
        for given_conditions in self.conditions:
            conditions.load(given_conditions)
        vehicle.load(self.vehicle)
        choose("situations", self.situations, (USUAL, *SITUATIONS))
        own = self.vehicle, self.conditions, self.trajectories
        if self.situations != USUAL and own != (VEHICLE, CONDITIONS, ()):
            raise ValueError(
                f"situations {self.situations!r} have vehicles, conditions and paths of their own: "
                "leave out vehicle, conditions and trajectories"
            )
        if self.envs < (needed := sum(part.share for part in self.parts)):
            raise ValueError(f"envs must be at least {needed} for these situations")
        self.reward_weights()
        self._check_segments()

    def _check_segments(self) -> None:
        """Refuse segments that end before the first update."""
        least = self.envs * self.hyperparameters.get(
            "rollout", self.hyperparameters.get("round", 1)
        )
        if self.segment < min(least, self.steps):
            raise ValueError(
                f"segment must be at least {least} steps, what {self.envs} environments drive "
                f"before they learn of it, not {self.segment}"
            )
        if self.start is not None and "rollout" in self.hyperparameters and self.segments < 2:
            raise ValueError(
                "from a policy, the first segment fits the value function alone: "
                f"segment must be less than steps, {self.steps}, not {self.segment}"
            )

    @property
    def parts(self) -> tuple[Situation, ...]:
        """Situations that share the environments."""
        if self.situations != USUAL:
            return SITUATIONS[self.situations]
        return tuple(Situation(self.vehicle, kind) for kind in self.conditions)

    def training_paths(self, part: Situation) -> list[str]:
        """Return the names of the paths that are trained on in a situation."""
        own = list(self.trajectories)
        return own or part.path_names(TRAINING_PATHS + MOST_PATHS * self.seed, self.paths)

    def validation_paths(self, part: Situation) -> list[str]:
        """Return the names of the paths of the validation in a situation."""
        own = list(self.trajectories[: self.validation])
        return own or part.path_names(VALIDATION_PATHS, self.validation)

    def reward_weights(self) -> RewardWeights:
        """Return the weights of the reward that the training maximises."""
        for key, value in self.reward.items():
            choose("reward weight", key, tuple(item.name for item in fields(RewardWeights)))
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ValueError(f"reward weight {key} must be a number, not {shown(value)}")  # noqa: TRY004
        return RewardWeights(**self.reward)

    @property
    def segments(self) -> int:
        """Number of segments."""
        return math.ceil(self.steps / self.segment)

    def end_of(self, segment: int) -> int:
        """Return the number of steps at which a segment ends."""
        return min((segment + 1) * self.segment, self.steps)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, equal to what JSON gives back, with digests of the named files."""
        return plain_values(
            self, [self.vehicle, *self.trajectories, *([self.start] if self.start else [])]
        )


def usual(algorithm: str, **changes: Any) -> TrainingSettings:
    """Return the default settings of an algorithm with some changed; None changes nothing.

    Raises
    ------
    ValueError
        For an unknown algorithm, or as `TrainingSettings`.
    """
    choose("algorithm", algorithm, ALGORITHMS)
    given = {key: value for key, value in changes.items() if value is not None}
    steps = given.get("steps", STEPS[algorithm])
    rewards = {} if given.get("situations", USUAL) == USUAL else {"reward": LIMITS_REWARD}
    usual_values = {
        "steps": steps, "envs": ENVS[algorithm],
        "segment": min(SEGMENTS[algorithm], max(steps, 1)), **rewards,
    }  # fmt: skip
    return TrainingSettings(algorithm, **{**usual_values, **given})


def with_steps(settings: TrainingSettings, steps: int) -> TrainingSettings:
    """Return the same training with another number of steps."""
    return replace(settings, steps=steps, segment=min(settings.segment, steps))


def complete(algorithm: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Check hyperparameters and add the defaults of all others.

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
    if key in NAMED:
        choose(key, value, NAMED[key])
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
        raise ValueError(f"hyperparameter {key} must be like {usual!r}, not {shown(value)}")
