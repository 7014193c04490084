"""Base classes of the classical agents: speed control, and the nominal motion along the path."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from agents.base import DrivingTask, TrackingAgent
from agents.reference import LocalReference, local_reference, mean_curvature
from agents.steady_turn import Turn, early_turn, lagged_sideslip, steady_turn, transient_turn
from lpv_track_env import bicycle
from lpv_track_env.observation import TrackingObservation
from trajectories.arguments import Number

PROPORTIONAL_GAIN = 1.5
"""kp, 1/s; decay rate of a speed error."""
INTEGRAL_GAIN = 0.4
"""ki, 1/s^2; kp^2/4 is critically damped."""

# Rules of settings: none lets the arithmetic overflow or divide by zero.
GAIN = Number(-1e6, 1e6)
DURATION = Number(0.0, 1e6, "s")
LOOKAHEAD = Number(1e-3, 1e6, "wheelbases")
WINDOW = Number(0.0, 1e6, "m")
ANGLE = Number(0.0, math.pi, "rad")
SHARE = Number(1e-3, 1e3)


@dataclass
class SpeedMemory:
    """Memory of the speed control for one vehicle."""

    speed_integral: float = 0.0
    """Integral part of the demanded acceleration, m/s^2."""


@dataclass
class MotionMemory(SpeedMemory):
    """Memory of the nominal motion for one vehicle."""

    sideslip: float = 0.0
    """Nominal sideslip, rad."""


class Motion(NamedTuple):
    """Nominal motion, and the vehicle's errors from it."""

    nominal: Turn
    lateral_error: float
    """e_y, m, positive to the left."""
    heading_error: float
    """e_psi, rad, counter-clockwise."""


SpeedM = TypeVar("SpeedM", bound=SpeedMemory)
MotionM = TypeVar("MotionM", bound=MotionMemory)


class ClassicalAgent(TrackingAgent[SpeedM]):
    """Agent that controls the speed; a subclass adds the steering.

    Preview feedforward, model inversion and a PI controller track the reference speed. The demanded
    vx' is the reference's acceleration over the control period plus kp e + ki int e with
    e = reference speed - vx, limited to the vehicle's range. The command a inverts the bicycle's
    longitudinal equation: rolling resistance, the front tyre's drag and r vy come from
    `bicycle.derivative`, so they are compensated at every speed.

    Parameters
    ----------
    task
        Task to drive.
    curvature_window
        Distance ahead of the foot point over which the curvature is averaged, m.
    """

    def __init__(self, task: DrivingTask, curvature_window: float) -> None:
        super().__init__(task)
        self.curvature_window = curvature_window

    @abstractmethod
    def steering(
        self, observation: TrackingObservation, reference: LocalReference, memory: SpeedM
    ) -> float:
        """Return the steering angle (rad) for one observation and its `local_reference`."""

    def control(self, observation: TrackingObservation, memory: SpeedM) -> tuple[float, float]:
        """Return acceleration (m/s^2) and steering angle (rad) for one observation."""
        reference = local_reference(observation, self.task.layout.preview_period)
        steering = self.steering(observation, reference, memory)
        return self._acceleration(observation, reference, steering, memory), steering

    def _acceleration(
        self,
        observation: TrackingObservation,
        reference: LocalReference,
        steering_angle: float,
        memory: SpeedM,
    ) -> float:
        """Return the acceleration command, m/s^2, that goes with a steering angle (rad)."""
        vehicle, period = self.task.vehicle, self.task.control_period
        vx, in_force = float(observation.longitudinal_speed), float(observation.acceleration)
        error = float(observation.reference_speed) - vx
        nodes = self.task.layout.preview_period * np.arange(len(reference.speed))
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
        wanted = feedforward + PROPORTIONAL_GAIN * error + memory.speed_integral
        demand = min(max(wanted, lowest), highest)
        command = demand - coasting
        # The actuator limits the command's range and rate.
        low, high = vehicle.acceleration_range
        change = vehicle.max_jerk * period
        actual = min(max(min(max(command, low), high), in_force - change), in_force + change)
        # Anti-windup by conditional integration: never further into a limit.
        excess = wanted - (actual + coasting)
        if excess * error <= 0.0 or abs(excess) < 1e-3:
            memory.speed_integral += INTEGRAL_GAIN * error * period
            memory.speed_integral = min(max(memory.speed_integral, lowest), highest)
        return command


class NominalMotionAgent(ClassicalAgent[MotionM]):
    """Agent that steers along the nominal motion and corrects the errors from it.

    The nominal motion keeps the centre of gravity on the path (`steady_turn.transient_turn`); a
    corner too sharp for any vehicle is begun early (`early_turn`).

    Parameters
    ----------
    task, curvature_window
        As in `ClassicalAgent`.
    early_turn_share
        Curvature with which undrivable corners are rounded, as a share of that at full lock.
    """

    def __init__(self, task: DrivingTask, curvature_window: float, early_turn_share: float) -> None:
        super().__init__(task, curvature_window)
        self.rounding = early_turn_share * task.vehicle.max_steering_angle / task.vehicle.wheelbase

    def motion(
        self, observation: TrackingObservation, reference: LocalReference, memory: MotionM
    ) -> Motion:
        """Return the nominal motion and the errors from it; the nominal sideslip is updated."""
        vehicle, period = self.task.vehicle, self.task.control_period
        vx = float(observation.longitudinal_speed)
        early = early_turn(reference, self.rounding)
        curvature = early.curvature or mean_curvature(reference, 0.0, self.curvature_window)
        turn = steady_turn(curvature, vx, vehicle)
        nominal = transient_turn(turn, memory.sideslip, vx, vehicle)
        memory.sideslip = lagged_sideslip(turn, memory.sideslip, vx * period, vehicle)
        return Motion(
            nominal,
            float(observation.lateral_error) - early.lateral_offset,
            float(observation.heading_error) - early.heading,
        )
