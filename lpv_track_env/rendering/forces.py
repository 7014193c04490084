"""What the tyres do: lateral forces and slip angles of the axles, from the vector field itself."""

import math
from typing import NamedTuple

from lpv_track_env import bicycle
from lpv_track_env.vehicle import VehicleParameters


class AxleForces(NamedTuple):
    """Lateral forces of the axles, N, and their slip angles, rad; positive to the left."""

    front: float
    rear: float
    front_slip: float
    rear_slip: float


def axle_forces(
    vx: float, vy: float, yaw_rate: float, steering_angle: float, car: VehicleParameters
) -> AxleForces:
    """Forces of a vehicle's linear tyres: each axle's share of `bicycle.field`.

    Under a plant or conditions of its own a vehicle has other tyres; these are those of its
    nominal parameters.
    """
    caf, rear_stiffness = car.front_cornering_stiffness, car.rear_cornering_stiffness
    cosine = math.cos(steering_angle)

    def sideward(front_stiffness: float, other: float) -> float:
        """Force m (vy' + r vx), N, with these stiffnesses: of the axle whose is not 0."""
        parameters = car.as_array()
        parameters[4], parameters[5] = front_stiffness, other
        rates = bicycle.field(
            vx, vy, yaw_rate, 1.0, 0.0, 0.0, steering_angle, cosine, math.sin(steering_angle),
            float(bicycle.inverse_speed(vx)), *parameters.tolist(),
        )  # fmt: skip
        return car.mass * float(rates[1] + yaw_rate * vx)

    # The front force is square to its wheels, of which the field has the share across the body.
    front, rear = sideward(caf, 0.0) / cosine, sideward(0.0, rear_stiffness)
    return AxleForces(front, rear, front / caf, rear / rear_stiffness)
