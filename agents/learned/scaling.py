"""What a learner makes of observations and actions: inputs and outputs of about one."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.base import DrivingTask
from agents.learned.policy import ORIGINS, Origin
from lpv_track_env.observation import PREVIEW_BOUNDS, SCALARS
from lpv_track_env.vehicle import VehicleParameters
from trajectories.naming import choose

Array = NDArray[np.float64]

LIMIT = 10.0
"""Features saturate here: the finer of two scales of one error is for small ones."""
FINE = 10.0
"""The finer scale of an error by the coarser."""
RESIDUAL_SHARE = 0.25
"""Half width of a correction on top of the NMPC, as a share of the whole range of actions."""


@dataclass(frozen=True)
class Scaling:
    """How observations become features x, and outputs u in [-1, 1] actions.

    x = clip(W o + b, -limit, limit) of the observation o in SI units, followed by the NMPC's action
    where it is the origin; action = origin + centre + half u.
    """

    feature_weight: NDArray[np.float32]
    """W, (features, inputs)."""
    feature_bias: NDArray[np.float32]
    """b, (features,)."""
    feature_limit: float
    origin: Origin
    """What an action is an addition to: nothing, the actuators' values, the NMPC's action."""
    centre: Array
    """(2,) [m/s^2, rad]."""
    half: Array
    """(2,) [m/s^2, rad]."""

    @property
    def features(self) -> int:
        """Number of features."""
        return len(self.feature_bias)

    def of(self, inputs: NDArray[np.floating]) -> NDArray[np.float32]:
        """Features (n, features) of inputs (n, inputs)."""
        x = inputs.astype(np.float32) @ self.feature_weight.T + self.feature_bias
        return np.clip(x, -self.feature_limit, self.feature_limit, out=x)


def usual_scaling(task: DrivingTask, origin: Origin = "actuators") -> Scaling:
    """Return the scaling that training uses, from the vehicle's ranges and the layout.

    Speeds of the preview are given by their difference from the reference's, the vehicle's by that
    and as it is; lateral and heading error twice, coarse and fine. An action is an increment of
    what the actuators have in force, at most what their rates allow in a control period; or, on top
    of the NMPC, a correction of a part of the whole range.
    """
    choose("origin", origin, ORIGINS)
    car, layout = task.vehicle, task.layout
    sharpest = math.tan(car.max_steering_angle) / car.wheelbase
    accelerations = max(map(abs, car.acceleration_range))
    rows: list[dict[str, float]] = [
        {"longitudinal_speed": 0.1},
        {"lateral_speed": 1.0},
        {"yaw_rate": 1.0},
        {"acceleration": 1.0 / accelerations},
        {"steering_angle": 1.5 / car.max_steering_angle},
        {"lateral_error": 2.0},
        {"lateral_error": 2.0 * FINE},
        {"heading_error": 4.0},
        {"heading_error": 4.0 * FINE},
        {"longitudinal_speed": 1.0, "reference_speed": -1.0},
    ]
    places = {name: k for k, (name, _, _) in enumerate(SCALARS)}
    inputs = layout.size + (2 if origin == "lpv-nmpc" else 0)
    weight = np.zeros((len(rows) + layout.preview_steps * len(PREVIEW_BOUNDS), inputs))
    for row, entries in zip(weight, rows, strict=False):
        for name, scale in entries.items():
            row[places[name]] = scale
    slices, first, k = layout.slices, len(rows), layout.preview_steps
    weight[first : first + k, slices["preview_curvature"]] = np.eye(k) * (1.5 / sharpest)
    weight[first + k :, slices["preview_speed"]] = np.eye(k)
    weight[first + k :, places["reference_speed"]] = -1.0
    if origin == "lpv-nmpc":
        base = np.zeros((2, inputs))
        base[0, -2], base[1, -1] = 1.0 / accelerations, 1.5 / car.max_steering_angle
        weight = np.vstack([weight, base])
    return Scaling(
        weight.astype(np.float32), np.zeros(len(weight), dtype=np.float32), LIMIT, origin,
        *_outputs(car, task.control_period, origin),
    )  # fmt: skip


def _outputs(car: VehicleParameters, period: float, origin: str) -> tuple[Array, Array]:
    """Centre and half width of the outputs' range."""
    low, high = car.acceleration_range
    whole = np.array([0.5 * (high - low), car.max_steering_angle])
    if origin == "zero":
        return np.array([0.5 * (low + high), 0.0]), whole
    if origin == "actuators":
        return np.zeros(2), np.array([car.max_jerk, car.max_steering_rate]) * period
    return np.zeros(2), RESIDUAL_SHARE * whole
