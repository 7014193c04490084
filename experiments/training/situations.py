"""Situations that a training mixes: vehicles, conditions, kinds of paths and first errors."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from experiments.jobs.job import random_names
from lpv_track_env import vehicle
from lpv_track_env.vehicle import VehicleParameters

USUAL = "usual"
"""Name of the situations that a training's vehicle and conditions make."""
NEAR = (0.5, 0.1, 1.0)
"""Range of the first errors of an episode: lateral m, heading rad, speed m/s."""
FAR = (4.0, 1.2, 6.0)
"""The same far beside the path; many of these episodes start at standstill."""


@dataclass(frozen=True)
class Situation:
    """Vehicle, conditions and roads of a part of the environments of a training.

    Parameters
    ----------
    vehicle
        Name or file of the vehicle.
    conditions
        Conditions, as `lpv_track_env.conditions.load` takes them.
    share
        Share of the environments, relative to the other situations.
    changes
        Fields of the vehicle that are changed.
    paths
        Kind of random paths, named KIND-SEED; "random" ones are slow and fast in turn.
    grip
        Share of the grip that the speed is planned for; by default the paths' own speeds.
    errors
        Range of the first errors of an episode, as `initial_error_range`.
    """

    vehicle: str
    conditions: Any = "simulation"
    share: int = 1
    changes: Mapping[str, Any] = field(default_factory=dict)
    paths: str = "random"
    grip: float | None = None
    errors: tuple[float, float, float] = NEAR

    def car(self) -> VehicleParameters:
        """Return the vehicle."""
        return vehicle.load(self.vehicle).replace(**self.changes)

    def path_names(self, first: int, count: int) -> list[str]:
        """Return names of random paths of its kind, with seeds from `first` on."""
        if self.paths == "random":
            return random_names(first, count)
        return [f"{self.paths}-{first + k}" for k in range(count)]

    @property
    def speed(self) -> dict[str, Any]:
        """Return the arguments of an environment, or fields of a case, that choose the speed."""
        return {} if self.grip is None else {"speed_mode": "grip", "grip": self.grip}


_UNKNOWN = {"name": "realtime", "friction": [0.5, 1.0]}
_SLIPPERY = {"name": "realtime", "friction": [0.5, 0.65]}
_MINIBUS, _BMW, _LIMIT = "m2-minibus", "bmw-320i", "random-limit"
SITUATIONS: dict[str, tuple[Situation, ...]] = {
    "limits": (
        Situation(_MINIBUS, share=3),
        Situation(_MINIBUS, "realtime", share=3),
        Situation(_MINIBUS, share=4, errors=FAR),
        Situation(_MINIBUS, "realtime", share=3, paths=_LIMIT),
        Situation(_MINIBUS, "realtime", share=4, paths="random-fast", grip=0.55),
        Situation(_MINIBUS, {"name": "ideal", "friction": 0.9}, paths=_LIMIT),
        Situation(
            _MINIBUS, "realtime", share=2, changes={"max_steering_rate": 0.15, "max_jerk": 1.5}
        ),
        Situation(_BMW),
        Situation(_BMW, {"name": "ideal", "friction": 1.05}, share=3, paths=_LIMIT),
        Situation(_BMW, {"name": "ideal", "friction": 0.8}, share=2, paths=_LIMIT),
        Situation(_BMW, {"name": "ideal", "friction": 0.9}, share=2, paths="circuit", grip=0.95),
        Situation(_BMW, _UNKNOWN, share=3, paths=_LIMIT),
        Situation(_BMW, _SLIPPERY, share=3, paths=_LIMIT),
        Situation(_BMW, {**_SLIPPERY, "estimator": "truth"}, share=2, paths=_LIMIT),
        Situation("course-car"),
        Situation("ford-escort"),
        Situation("vw-vanagon"),
    ),
}  # fmt: skip
"""Named sets of situations. `limits`: vehicles, friction known and unknown, up to 0.95 g of lateral
acceleration, slow actuators, standing starts and starts far beside the path."""
