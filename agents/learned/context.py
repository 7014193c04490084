"""Context of a policy: constants of the task, for one network that drives many vehicles.

Its values follow the observation as further inputs of the features. They do not change while an
agent drives, so `with_context` adds what they contribute to the features' bias, once. Increments of
the actuators' values are then shares of what the vehicle's own rates allow, and the features see
the reference that the vehicle can follow (`Followed`), as the NMPC does.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from agents.base import DrivingTask
from agents.reference import NODE, replace_previews
from agents.speed_cap import GRIP_SHARE
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import VehicleParameters


def _front_compliance(car: VehicleParameters) -> float:
    return car.mass * car.rear_axle_distance / (car.wheelbase * car.front_cornering_stiffness)


def _rear_compliance(car: VehicleParameters) -> float:
    return car.mass * car.front_axle_distance / (car.wheelbase * car.rear_cornering_stiffness)


def _yaw_ratio(car: VehicleParameters) -> float:
    return car.yaw_inertia / (car.mass * car.front_axle_distance * car.rear_axle_distance)


CONTEXT: Mapping[str, Callable[[DrivingTask], float]] = {
    "wheelbase": lambda task: task.vehicle.wheelbase,
    "front_axle_share": lambda task: task.vehicle.front_axle_distance / task.vehicle.wheelbase,
    "front_compliance": lambda task: _front_compliance(task.vehicle),
    "rear_compliance": lambda task: _rear_compliance(task.vehicle),
    "yaw_ratio": lambda task: _yaw_ratio(task.vehicle),
    "max_steering_angle": lambda task: task.vehicle.max_steering_angle,
    "max_steering_rate": lambda task: task.vehicle.max_steering_rate,
    "max_jerk": lambda task: task.vehicle.max_jerk,
    "inverse_least_friction": lambda task: 1.0 / task.friction_range[0],
    "inverse_largest_friction": lambda task: 1.0 / task.friction_range[1],
}
"""Names of the values that a policy's context may have, and what they are, SI units.

Wheelbase L, m; lf/L; slip angle of the front and of the rear axle per lateral acceleration,
m lr/(L Caf) and m lf/(L Car), rad s^2/m, whose difference is the understeer gradient;
Iz/(m lf lr); limits of the steering angle (rad), its rate (rad/s) and the jerk (m/s^3); and
1/mu of the least and of the largest friction, 0 where friction has no limit.
"""


class Features(Protocol):
    """Dataclass with a scaling of inputs to features; the last inputs are those of `context`."""

    @property
    def feature_weight(self) -> NDArray[np.float32]:
        """(features, inputs)."""

    @property
    def feature_bias(self) -> NDArray[np.float32]:
        """(features,)."""

    @property
    def origin(self) -> str:
        """Origin of the actions."""

    @property
    def context(self) -> tuple[str, ...]:
        """Names in `CONTEXT`."""


Scaled = TypeVar("Scaled", bound=Features)


def context_of(names: tuple[str, ...], task: DrivingTask) -> NDArray[np.float64]:
    """Return the values of a task's context, shape (len(names),)."""
    return np.array([CONTEXT[name](task) for name in names])


class Followed:
    """References that the vehicle of a task can follow, in place of those of its observations.

    They take `GRIP_SHARE` of the least friction, and lead the vehicle where it is slow
    (`agents.reference.replace_previews`).
    """

    def __init__(self, task: DrivingTask) -> None:
        layout = task.layout
        slowest, fastest = task.vehicle.longitudinal_acceleration_range
        grip = GRIP_SHARE * task.friction_range[0] * GRAVITY
        self._arguments = (
            layout.preview_period, np.full(layout.preview_steps, layout.preview_period),
            min(fastest, grip), grip, -slowest, np.zeros(layout.preview_steps + 1),
            np.zeros((layout.preview_steps + 1, NODE)),
        )  # fmt: skip
        self.replace(np.zeros((0, layout.size)))  # compiles

    def replace(self, rows: NDArray[np.float64]) -> None:
        """Replace the references in observations (n, size), in place."""
        replace_previews(rows, *self._arguments)


def increments(task: DrivingTask) -> NDArray[np.float64]:
    """Return the largest changes of the actuators in a control period, (2,) [m/s^2, rad]."""
    car = task.vehicle
    return np.array([car.max_jerk, car.max_steering_rate]) * task.control_period


def with_context(scaled: Scaled, task: DrivingTask) -> Scaled:
    """Return the same scaling for a task: without context, but with its values in the bias.

    With origin "actuators", half the range of the actions becomes the vehicle's `increments`.
    """
    if not scaled.context:
        return scaled
    half = {"half": increments(task)} if scaled.origin == "actuators" else {}
    weight = scaled.feature_weight.astype(np.float64)
    inputs = weight.shape[1] - len(scaled.context)
    bias = scaled.feature_bias + weight[:, inputs:] @ context_of(scaled.context, task)
    return replace(  # type: ignore[type-var]
        scaled, feature_weight=scaled.feature_weight[:, :inputs],
        feature_bias=bias.astype(np.float32), context=(), **half,
    )  # fmt: skip
