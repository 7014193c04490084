"""Settings and hyperparameters of a tuning, with the defaults of each method."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from agents.weight_tuning.choice import DIRECTIONS
from agents.weight_tuning.features import SUBSETS
from experiments.jobs.job import check_paths, plain_values
from experiments.training.settings import LEAST, MOST
from experiments.tuning import METHODS
from lpv_track_env import conditions, vehicle
from lpv_track_env.observation import PREVIEW_PERIOD, PREVIEW_STEPS
from trajectories.arguments import shown
from trajectories.naming import choose

PPO_METHODS = ("catalogue", "rl")
LEARNED = (*PPO_METHODS, "paired")
"""Methods that find a weight policy; the others find a schedule."""

PPO: dict[str, Any] = {
    "learning_rate": 3e-3, "last_learning_rate": 3e-4, "rollout": 16, "batch": 256, "epochs": 10,
    "discount": 0.9, "gae_lambda": 0.9, "clip_range": 0.2, "deviation": 1.0, "hidden": [32, 32],
    "segment": 50_000,
}  # fmt: skip
HYPERPARAMETERS: dict[str, dict[str, Any]] = {
    "fixed": {},
    "paper": {"sigma": 1.0},
    "search": {"sigma": 1.0},
    "bands": {"sigma": 1.0},
    "gradient": {"sigma": 0.3, "learning_rate": 0.4, "pairs": 16},
    "catalogue": PPO,
    "rl": PPO,
    "paired": {
        "deviation": 0.15,
        "hold": 5,
        "curvature": 0.5,
        "response": 0.02,
        "least_curvature": 0.2,
        "half_life": 1.0,
        "step": 0.5,
    },
}
"""Defaults of `--set`.

`sigma` is the first standard deviation of the candidates' log-multipliers; `pairs` the pairs of
drives in a step; `segment` the solves between checkpoints.

Of `paired`: `deviation` of an action's offsets, each held for `hold` windows; `curvature` and
`response` of the prior and `least_curvature` of the cost, see `paired.PairedQuadratic`; `half_life`
of a pair's influence, in budgets; `step`, the share of the way to the best policy of a fit.
"""


@dataclass(frozen=True)
class TuningSettings:
    """A tuning: the same settings give the same weights, bit for bit, on the same machine.

    The budget is in `solves` of the NMPC and is never exceeded. Candidates are scored, and policies
    learn, on `drives` side by side. Each takes `time_limit` s from a random place of a path, under
    `conditions`. The paths are the user's `trajectories`, or else `paths` random ones that only
    this seed trains on. `directions` and `span` bound the weights around the default ones. `view`
    is the part of the features that a policy sees: "all", the "path" alone, or the "drive" alone.

    Raises
    ------
    ValueError
        For an unknown name, a number out of its range, or a path that is for evaluation.
    """

    method: str
    solves: int = 300_000
    seed: int = 0
    vehicle: str = "m2-minibus"
    conditions: Any = "randomised"
    control_period: float = 0.05
    preview_steps: int = PREVIEW_STEPS
    preview_period: float = PREVIEW_PERIOD
    trajectories: tuple[str, ...] = ()
    paths: int = 32
    drives: int = 16
    time_limit: float = 10.0
    directions: str = "stages"
    span: float = 100.0
    window: float = 0.4
    view: str = "all"
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        choose("method", self.method, METHODS)
        choose("directions", self.directions, tuple(DIRECTIONS))
        choose("view", self.view, SUBSETS)
        known = HYPERPARAMETERS[self.method]
        for key, value in self.hyperparameters.items():
            choose(f"hyperparameter of {self.method}", key, tuple(known))
            _check(key, value, known[key])
        object.__setattr__(self, "hyperparameters", {**known, **self.hyperparameters})
        object.__setattr__(self, "trajectories", tuple(self.trajectories))
        self._check_numbers()
        conditions.load(self.conditions)
        vehicle.load(self.vehicle)

    def _check_numbers(self) -> None:
        for name in ("solves", "paths", "drives"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        check_paths(self.trajectories, self.paths, self.seed, verb="tune")
        if not 1.0 < self.span <= 1e4:
            raise ValueError(f"span must be above 1 and at most 10000, not {self.span}")
        if not self.window > 0.0:
            raise ValueError(f"window must be positive, not {self.window} s")
        if not self.time_limit >= self.window:
            raise ValueError(f"time_limit must be at least the window, {self.window} s")

    @property
    def periods(self) -> int:
        """Control periods of a drive."""
        return max(math.ceil(self.time_limit / self.control_period - 1e-9), 1)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, equal to what JSON gives back, with digests of the named files."""
        return plain_values(self, [self.vehicle, *self.trajectories])


def usual(method: str, **changes: Any) -> TuningSettings:
    """Return the default settings of a method with some changed; None changes nothing.

    Raises
    ------
    ValueError
        As `TuningSettings`.
    """
    choose("method", method, METHODS)
    given = {key: value for key, value in changes.items() if value is not None}
    if method in PPO_METHODS:
        given = {"drives": 64, "time_limit": 20.0, **given}
    if method == "paired":
        given = {"drives": 32, **given}
    return TuningSettings(method, **given)


def _check(key: str, value: Any, usual_value: Any) -> None:
    """Refuse a hyperparameter of another kind than its default, or that is not positive."""
    if isinstance(usual_value, list):
        good = isinstance(value, list) and all(type(w) is int and 0 < w <= 512 for w in value)
    else:
        kinds = {int} if isinstance(usual_value, int) else {int, float}
        good = type(value) in kinds and math.isfinite(value) and value > 0
        least, most = LEAST.get(key, 0), MOST.get(key, math.inf)
        if good and not least <= value <= most:
            raise ValueError(f"hyperparameter {key} must be in [{least}, {most}], not {value}")
    if not good:
        raise ValueError(f"hyperparameter {key} must be like {usual_value!r}, not {shown(value)}")
