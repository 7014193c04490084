"""Speed control of all classical agents; they differ in steering only."""

from dataclasses import dataclass

import numpy as np

from agents.base import DrivingTask
from agents.reference import LocalReference
from lpv_track_env import bicycle
from lpv_track_env.observation import TrackingObservation


@dataclass
class SpeedMemory:
    """Memory of the speed control for one vehicle."""

    integral: float = 0.0
    """Integral part of the demanded acceleration, m/s^2."""


class SpeedControl:
    """Tracking of the reference speed: preview feedforward, model inversion and a PI controller.

    The demanded vx' is the reference's acceleration over the control period plus kp e + ki int e
    with e = reference speed - vx, limited to the vehicle's range. The command a is found by
    inverting the bicycle's longitudinal equation: rolling resistance, the front tyre's drag and
    r vy come from `bicycle.derivative`, so they are compensated at every speed.

    Parameters
    ----------
    task
        Vehicle and control period.
    proportional_gain
        kp, 1/s; decay rate of a speed error.
    integral_gain
        ki, 1/s^2; kp^2/4 is critically damped.
    """

    def __init__(
        self, task: DrivingTask, *, proportional_gain: float = 1.5, integral_gain: float = 0.4
    ) -> None:
        self.vehicle = task.vehicle
        self.control_period = task.control_period
        self.preview_period = task.layout.preview_period
        self.proportional_gain = proportional_gain
        self.integral_gain = integral_gain

    def acceleration(
        self,
        observation: TrackingObservation,
        reference: LocalReference,
        steering_angle: float,
        memory: SpeedMemory,
    ) -> float:
        """Return the acceleration command, m/s^2.

        Parameters
        ----------
        observation
            Observation of one vehicle.
        reference
            Its `local_reference`, fields (K + 1,).
        steering_angle
            Steering angle of the same command, rad.
        memory
            Memory of this vehicle; the integral is updated.
        """
        vehicle, period = self.vehicle, self.control_period
        vx, in_force = float(observation.longitudinal_speed), float(observation.acceleration)
        error = float(observation.reference_speed) - vx
        nodes = self.preview_period * np.arange(len(reference.speed))
        ahead = float(np.interp(period, nodes, reference.speed))
        feedforward = (ahead - float(observation.reference_speed)) / min(period, float(nodes[-1]))

        reach = vehicle.max_steering_rate * period
        angle = float(observation.steering_angle)
        delta = min(max(steering_angle, angle - reach), angle + reach)
        delta = min(max(delta, -vehicle.max_steering_angle), vehicle.max_steering_angle)
        state = np.array(
            [vx, float(observation.lateral_speed), 0.0, float(observation.yaw_rate), 0.0, 0.0]
        )
        coasting = float(bicycle.derivative(state, np.array([0.0, delta]), vehicle)[bicycle.VX])

        lowest, highest = vehicle.longitudinal_acceleration_range
        wanted = feedforward + self.proportional_gain * error + memory.integral
        demand = min(max(wanted, lowest), highest)
        command = demand - coasting
        # The actuator limits the command's range and rate.
        low, high = vehicle.acceleration_range
        change = vehicle.max_jerk * period
        actual = min(max(min(max(command, low), high), in_force - change), in_force + change)
        # Anti-windup by conditional integration: never further into a limit.
        excess = wanted - (actual + coasting)
        if excess * error <= 0.0 or abs(excess) < 1e-3:
            memory.integral += self.integral_gain * error * period
            memory.integral = min(max(memory.integral, lowest), highest)
        return command
