"""The plant as a vehicle on a road of highway-env."""

import math

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, VX, VY, X, Y
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]


def body_centre(state: Array, vehicle: VehicleParameters) -> Array:
    """Centre of the body (2,), m: midway between the axles, where highway-env has a vehicle."""
    ahead = 0.5 * (vehicle.front_axle_distance - vehicle.rear_axle_distance)
    heading = float(state[PSI])
    return np.array([state[X] + ahead * math.cos(heading), state[Y] + ahead * math.sin(heading)])


class EgoVehicle(Vehicle):
    """What the traffic sees of the vehicle that the environment drives.

    Its motion is the environment's: `place` puts it where the plant is, `act` and `step` do
    nothing.
    """

    def __init__(self, road: Road, vehicle: VehicleParameters) -> None:
        self.parameters = vehicle
        self.LENGTH, self.WIDTH = vehicle.length, vehicle.width
        self.target_speed = 0.0
        self._velocity = np.zeros(2)
        super().__init__(road, (0.0, 0.0))

    def place(self, state: Array, reference_speed: float) -> None:
        """Put it where the plant is.

        Parameters
        ----------
        state
            [vx, vy, psi, r, X, Y], shape (6,).
        reference_speed
            m/s, what the traffic takes for the speed that it would like to have.
        """
        heading = float(state[PSI])
        c, s = math.cos(heading), math.sin(heading)
        vx, vy = float(state[VX]), float(state[VY])
        self.position = body_centre(state, self.parameters)
        # highway-env compares headings of lanes and vehicles, whole turns apart or not.
        self.heading, self.speed = heading, vx
        self._velocity = np.array([c * vx - s * vy, s * vx + c * vy])
        self.target_speed = reference_speed
        self.on_state_update()

    @property
    def velocity(self) -> Array:
        """Velocity in the world (2,), m/s; unlike highway-env's own it has sideslip."""
        return self._velocity

    def act(self, action: object = None) -> None:
        """Nothing: the environment's action is the plant's."""

    def step(self, dt: float) -> None:
        """Nothing: the environment moves it."""
