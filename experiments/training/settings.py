"""Everything that determines a training, and the defaults of each algorithm."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from experiments.run.suites import HELD_OUT, SIX
from experiments.training.hyperparameters import ALGORITHMS, complete
from lpv_track_env import conditions, vehicle
from lpv_track_env.reward import RewardWeights
from trajectories.naming import choose

ENVS = {"ppo": 512, "residual": 256, "sac": 64, "td3": 64, "bc": 256}
STEPS = {
    "ppo": 20_000_000, "residual": 3_000_000, "sac": 600_000, "td3": 600_000, "bc": 300_000,
}  # fmt: skip
SEGMENTS = {
    "ppo": 1_000_000, "residual": 250_000, "sac": 100_000, "td3": 100_000, "bc": 100_000,
}  # fmt: skip
MOST_PATHS = 1000
"""Random paths of one seed: the next seed's begin there."""

REWARD = {
    "lateral_scale": 0.02, "heading": 0.1, "speed_scale": 0.5, "input_rate": 0.2,
}  # fmt: skip
"""Of `RewardWeights`, in training: centimetres count, which the environment's own 0.5 m hides.

With 0.05 m, PPO ends at twice the error in simulation; with 0.02 m it takes longer to stay on the
road at first.
"""

FAST: dict[str, Any] = {
    "conditions": ("simulation",), "steps": 5_000_000, "reward": {**REWARD, "lateral_scale": 0.05},
    "hyperparameters": {"batch": 2048, "epochs": 2},
}  # fmt: skip
"""`--fast` of PPO: perfect knowledge only, half as many updates, and a reward to begin with."""


@dataclass(frozen=True)
class TrainingSettings:
    """A training: the same settings give the same weights, bit for bit, on the same machine.

    `steps` are environment steps of all environments together; every `segment` of them a
    checkpoint is written, seeds are set anew from (seed, segment) and all episodes begin anew, so
    that a training that goes on from a checkpoint is the one that was not interrupted. `conditions`
    share the environments evenly. `trajectories` are files or names; by default `paths` random
    ones that only this seed trains on. `validation` paths are driven after every segment under
    each kind of conditions. `start` is a policy file whose network is the first one.

    Raises
    ------
    ValueError
        For an unknown name, a number out of its range, segments in which nothing would be learned,
        or a path that the benchmark drives.
    """

    algorithm: str
    steps: int
    envs: int
    segment: int
    seed: int = 0
    vehicle: str = "m2-minibus"
    conditions: tuple[Any, ...] = ("simulation", "realtime")
    control_period: float = 0.05
    preview_steps: int = 20
    preview_period: float | None = None
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
        if self.paths > MOST_PATHS:
            raise ValueError(f"paths must be at most {MOST_PATHS}, not {self.paths}")
        if not 0 <= self.seed < 1000:
            raise ValueError(f"seed must be in [0, 999], not {self.seed}")
        if not self.conditions:
            raise ValueError("a training needs at least one kind of conditions")
        if self.envs < len(self.conditions):
            raise ValueError(f"{len(self.conditions)} conditions need as many environments")
        for given_conditions in self.conditions:
            conditions.load(given_conditions)
        for name in self.trajectories:
            if name.removesuffix("-raw") in (*SIX, *HELD_OUT):
                raise ValueError(f"{name} is for evaluation: train on other paths")
        vehicle.load(self.vehicle)
        self.reward_weights()
        self._check_segments()

    def _check_segments(self) -> None:
        """Refuse segments in which nothing is learned."""
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

    def reward_weights(self) -> RewardWeights:
        """Reward that the training maximises."""
        for key, value in self.reward.items():
            choose("reward weight", key, tuple(item.name for item in fields(RewardWeights)))
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ValueError(f"reward weight {key} must be a number, not {value!r}")  # noqa: TRY004
        return RewardWeights(**self.reward)

    @property
    def segments(self) -> int:
        """Number of segments."""
        return math.ceil(self.steps / self.segment)

    def of_segment(self, number: int) -> int:
        """Steps that a segment is to end at."""
        return min((number + 1) * self.segment, self.steps)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as JSON gives them back, and digests of the files that are named."""
        named = [self.vehicle, *self.trajectories, *([self.start] if self.start else [])]
        files = {
            name: hashlib.sha256(Path(name).read_bytes()).hexdigest()
            for name in named
            if Path(name).is_file()
        }
        plain: dict[str, Any] = json.loads(json.dumps({**asdict(self), "files": files}))
        return plain


def usual(algorithm: str, **changes: Any) -> TrainingSettings:
    """Settings of an algorithm with some changed; None changes nothing.

    Raises
    ------
    ValueError
        For an unknown algorithm, or as `TrainingSettings`.
    """
    choose("algorithm", algorithm, ALGORITHMS)
    given = {key: value for key, value in changes.items() if value is not None}
    steps = given.get("steps", STEPS[algorithm])
    usual_values = {
        "steps": steps, "envs": ENVS[algorithm], "segment": min(SEGMENTS[algorithm], max(steps, 1)),
    }  # fmt: skip
    return TrainingSettings(algorithm, **{**usual_values, **given})


def with_steps(settings: TrainingSettings, steps: int) -> TrainingSettings:
    """Return the same training over so many steps."""
    return replace(settings, steps=steps, segment=min(settings.segment, steps))


def difference(settings: TrainingSettings, stored: Mapping[str, Any]) -> str | None:
    """What differs between settings and stored ones, in words; None: nothing."""
    for key, value in settings.as_dict().items():
        if stored.get(key) != value:
            return f"{key} is {value!r}, there {stored.get(key)!r}"
    return None
