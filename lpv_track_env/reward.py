"""Reward of path tracking: a sum of named terms, each weighted and normalised by a scale.

With h the control period and rho(z) = sqrt(1 + z^2) - 1 (pseudo-Huber: quadratic near zero, linear
far from it, so that its slope never vanishes)::

    progress    =  w_progress ds / v_ref        seconds of the reference covered in this step
    lateral     = -w_lateral  h rho(e_y / lateral_scale)
    heading     = -w_heading  h rho(e_psi / heading_scale)
    speed       = -w_speed    h rho((vx - v_ref) / speed_scale)
    input_rate  = -w_input    h ((da/dt / jerk_scale)^2 + (ddelta/dt / steering_rate_scale)^2)
    end         = -w_end      once, if the episode ends other than by finishing or time

Perfect tracking gives 1 per second. The progress of a whole path sums to the reference's duration
at any speed, and that of a parked vehicle to 0, so that neither rushing nor parking pays.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajectories.arguments import Number, check_fields
from trajectories.compilation import compiled_internal

TERMS = ("progress", "lateral", "heading", "speed", "input_rate", "end")
"""Order of the reward's terms."""
WEIGHT, SCALE = Number(0.0, 1e9), Number(1e-6, 1e9)
"""Bounds of weights and scales: within them the reward of any state is finite."""


@dataclass(frozen=True)
class RewardWeights:
    """Weights and scales of the reward's terms, see `lpv_track_env.reward`."""

    progress: float = 1.0
    lateral: float = 1.0
    heading: float = 0.5
    speed: float = 0.5
    input_rate: float = 0.05
    end: float = 20.0
    lateral_scale: float = 0.5
    heading_scale: float = 0.2
    speed_scale: float = 1.0
    jerk_scale: float = 5.0
    steering_rate_scale: float = 0.5

    def __post_init__(self) -> None:
        rules = {
            field.name: SCALE if field.name.endswith("_scale") else WEIGHT for field in fields(self)
        }
        check_fields(self, rules, prefix="reward weight ")

    def as_array(self) -> NDArray[np.float64]:
        """Return weights and scales in field order, shape (11,), as `terms` takes them."""
        return np.array([getattr(self, field.name) for field in fields(self)], dtype=np.float64)


@compiled_internal
def pseudo_huber(z: Any) -> Any:
    """Return sqrt(1 + z^2) - 1."""
    return np.sqrt(1.0 + z * z) - 1.0


@compiled_internal
def terms(
    weights: Any,
    period: Any,
    progress: Any,
    lateral_error: Any,
    heading_error: Any,
    speed_error: Any,
    reference_speed: Any,
    jerk: Any,
    steering_rate: Any,
    failed: Any,
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Return the terms in the order of `TERMS`; `weights` are `RewardWeights.as_array`'s."""
    return (
        weights[0] * progress / max(reference_speed, 0.1),
        -weights[1] * period * pseudo_huber(lateral_error / weights[6]),
        -weights[2] * period * pseudo_huber(heading_error / weights[7]),
        -weights[3] * period * pseudo_huber(speed_error / weights[8]),
        -weights[4] * period * ((jerk / weights[9]) ** 2 + (steering_rate / weights[10]) ** 2),
        -weights[5] if failed else 0.0,
    )
