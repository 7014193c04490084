"""Everything that determines a tuning, and the defaults of each method."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from agents.weight_tuning.choice import DIRECTIONS
from agents.weight_tuning.features import SUBSETS
from experiments.run.suites import HELD_OUT, SIX
from experiments.training.hyperparameters import LEAST, MOST
from experiments.training.settings import MOST_PATHS
from lpv_track_env import conditions, vehicle
from trajectories.naming import choose

METHODS: dict[str, str] = {
    "fixed": "the default weights, nothing tuned",
    "paper": "a set for each class of path, by its sharpest curvature; CMA-ES",
    "search": "the best fixed set; CMA-ES",
    "bands": "a set for each band of the preview's curvature; CMA-ES",
    "gradient": "the same by gradients: differences of drives alike but for their weights",
    "catalogue": "PPO chooses a set of a catalogue, every window",
    "rl": "PPO multiplies the weights of the band at hand, every window",
    "paired": "a linear policy does, learned from drives alike but for their weights",
}
PPO_METHODS = ("catalogue", "rl")
LEARNED = (*PPO_METHODS, "paired")
"""Methods whose result is a weight policy; that of the others is a schedule."""

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
"""Defaults of `--set`. `sigma`: first standard deviation of candidates' log-multipliers; `pairs` of
drives a step; `segment` solves between checkpoints.
Of `paired`: `deviation` of an action's offsets, each held for `hold` windows; `curvature` and
`response` of the prior, `least_curvature` of the cost (`quadratic`); `half_life` of a pair, in
budgets; `step` towards the best policy of a fit."""


@dataclass(frozen=True)
class TuningSettings:
    """A tuning: the same settings give the same weights, bit for bit, on the same machine.

    The budget is in `solves` of the NMPC, never exceeded. Candidates are judged, and policies
    learn, on `drives` side by side, each `time_limit` s of a random path of `paths` that only this
    seed trains on, from a random place, under `conditions`; or of one's own `trajectories`.
    `directions` and `span` bound what is chosen, around the default weights. `view` is what a
    policy sees: "all", the "path" alone, or the "drive" alone.

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
    preview_steps: int = 20
    preview_period: float | None = None
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
        choose("method", self.method, tuple(METHODS))
        choose("directions", self.directions, tuple(DIRECTIONS))
        choose("view", self.view, SUBSETS)
        known = HYPERPARAMETERS[self.method]
        for key, value in self.hyperparameters.items():
            choose(f"hyperparameter of {self.method}", key, tuple(known))
            _check(key, value, known[key])
        object.__setattr__(self, "hyperparameters", {**known, **self.hyperparameters})
        object.__setattr__(self, "trajectories", tuple(self.trajectories))
        self._check_numbers()
        for name in self.trajectories:
            if name.removesuffix("-raw") in (*SIX, *HELD_OUT):
                raise ValueError(f"{name} is for evaluation: tune on other paths")
        conditions.load(self.conditions)
        vehicle.load(self.vehicle)

    def _check_numbers(self) -> None:
        for name in ("solves", "paths", "drives"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.paths > MOST_PATHS:
            raise ValueError(f"paths must be at most {MOST_PATHS}, not {self.paths}")
        if not 0 <= self.seed < 1000:
            raise ValueError(f"seed must be in [0, 999], not {self.seed}")
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
        """Plain values, as JSON gives them back, and digests of the files that are named."""
        files = {
            name: hashlib.sha256(Path(name).read_bytes()).hexdigest()
            for name in (self.vehicle, *self.trajectories)
            if Path(name).is_file()
        }
        plain: dict[str, Any] = json.loads(json.dumps({**asdict(self), "files": files}))
        return plain


def usual(method: str, **changes: Any) -> TuningSettings:
    """Settings of a method with some changed; None changes nothing.

    Raises
    ------
    ValueError
        As `TuningSettings`.
    """
    choose("method", method, tuple(METHODS))
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
        raise ValueError(f"hyperparameter {key} must be like {usual_value!r}, not {value!r}")
