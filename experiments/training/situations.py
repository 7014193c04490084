"""Situations that a training mixes: vehicles, conditions, kinds of paths and first errors."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from experiments.jobs.job import limit_names, random_names
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
    """What a part of the environments of a training drives.

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
    limit
        Drive paths at the limit of grip (`random-limit-SEED`) rather than usual random ones.
    errors
        Range of the first errors of an episode, as `initial_error_range`.
    """

    vehicle: str
    conditions: Any = "simulation"
    share: int = 1
    changes: Mapping[str, Any] = field(default_factory=dict)
    limit: bool = False
    errors: tuple[float, float, float] = NEAR

    def car(self) -> VehicleParameters:
        """Return the vehicle."""
        return vehicle.load(self.vehicle).replace(**self.changes)

    def path_names(self, first: int, count: int) -> list[str]:
        """Return names of random paths of its kind, with seeds from `first` on."""
        return (limit_names if self.limit else random_names)(first, count)


_UNKNOWN = {"name": "realtime", "friction": [0.5, 1.0]}
_SLIPPERY = {"name": "realtime", "friction": [0.5, 0.65]}
_MINIBUS, _BMW = "m2-minibus", "bmw-320i"
SITUATIONS: dict[str, tuple[Situation, ...]] = {
    "limits": (
        Situation(_MINIBUS, share=3),
        Situation(_MINIBUS, "realtime", share=3),
        Situation(_MINIBUS, share=4, errors=FAR),
        Situation(_MINIBUS, "realtime", share=4, limit=True),
        Situation(
            _MINIBUS, "realtime", share=2, changes={"max_steering_rate": 0.15, "max_jerk": 1.5}
        ),
        Situation(_BMW),
        Situation(_BMW, {"name": "ideal", "friction": 1.05}, share=3, limit=True),
        Situation(_BMW, {"name": "ideal", "friction": 0.8}, share=2, limit=True),
        Situation(_BMW, _UNKNOWN, share=3, limit=True),
        Situation(_BMW, _SLIPPERY, share=3, limit=True),
        Situation(_BMW, {**_SLIPPERY, "estimator": "truth"}, share=2, limit=True),
        Situation("course-car"),
        Situation("ford-escort"),
        Situation("vw-vanagon"),
    ),
}  # fmt: skip
"""Named sets of situations. `limits`: vehicles, friction known and unknown, up to 0.95 g of lateral
acceleration, slow actuators, standing starts and starts far beside the path."""
