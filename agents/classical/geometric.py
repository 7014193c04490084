"""Geometric steering: Stanley (front axle) and pure pursuit (rear axle).

Both laws were designed to keep an axle on the path. Here the centre of gravity shall stay on the
path, so each axle follows the track that it describes in that case (`agents.reference`); a curve of
constant curvature then leaves no error.
"""

import math
from dataclasses import dataclass

from agents.base import DrivingTask
from agents.classical.base import (
    DURATION,
    GAIN,
    LOOKAHEAD,
    SHARE,
    WINDOW,
    ClassicalAgent,
    MotionMemory,
    NominalMotionAgent,
    SpeedMemory,
)
from agents.reference import LocalReference, mean_curvature, point_at
from agents.steady_turn import steady_turn
from lpv_track_env.observation import TrackingObservation
from trajectories.arguments import Number, checks_arguments


@dataclass
class StanleyMemory(MotionMemory):
    """Memory of `Stanley` for one vehicle."""

    steering_angle: float | None = None
    """Actual steering angle one period ago, rad."""


class Stanley(NominalMotionAgent[StanleyMemory]):
    """Stanley's steering law in its full form, for a centre of gravity on the path.

    With errors positive to the left and angles counter-clockwise::

        delta = delta_n - (e_psi + beta_n) - atan(k e_f / (k_soft + |vx|))
                - k_yaw (r - r_n) - k_steer (delta_in_force - the one a period before)
        e_f   = e_y + lf (sin(e_psi) + sin(beta_n))

    Hoffmann, Tomlin, Montemerlo and Thrun, "Autonomous automobile trajectory tracking for off-road
    driving", American Control Conference 2007. There the front axle is on the path: the path's
    heading below it carries the curvature, and psi_ss, the front tyre's slip in a steady turn, the
    understeer. Here delta_n, the steering with the centre of gravity on the path, contains both;
    beta_n and r_n are the corresponding sideslip and yaw rate, e_f is the front axle's distance
    from its own track. A corner too sharp for any vehicle is begun early (`early_turn`).

    Parameters
    ----------
    task
        Task to drive.
    gain
        k, 1/s.
    softening_speed
        k_soft, m/s; limits the reaction to lateral errors at low speed.
    yaw_damping
        k_yaw, s.
    steering_damping
        k_steer, dimensionless, below 1; acts on the last change of the steering angle.
    curvature_window
        Distance ahead of the foot point over which the curvature is averaged, m.
    early_turn_share
        Curvature with which undrivable corners are rounded, as a share of that at full lock.
    """

    @checks_arguments(
        gain=GAIN,
        softening_speed=Number(0.0, 1e6, "m/s", above=True),
        yaw_damping=GAIN,
        steering_damping=GAIN,
        curvature_window=WINDOW,
        early_turn_share=SHARE,
    )
    def __init__(
        self,
        task: DrivingTask,
        *,
        gain: float = 1.5,
        softening_speed: float = 1.0,
        yaw_damping: float = 0.1,
        steering_damping: float = 0.1,
        curvature_window: float = 1.0,
        early_turn_share: float = 0.6,
    ) -> None:
        super().__init__(task, curvature_window, early_turn_share)
        self.gain = gain
        self.softening_speed = softening_speed
        self.yaw_damping = yaw_damping
        self.steering_damping = steering_damping

    def new_memory(self) -> StanleyMemory:
        """Return the memory of a vehicle that begins without sideslip."""
        return StanleyMemory()

    def steering(
        self, observation: TrackingObservation, reference: LocalReference, memory: StanleyMemory
    ) -> float:
        """Return the steering angle (rad) for one observation."""
        vx, in_force = float(observation.longitudinal_speed), float(observation.steering_angle)
        nominal, lateral_error, heading_error = self.motion(observation, reference, memory)
        last = in_force if memory.steering_angle is None else memory.steering_angle
        memory.steering_angle = in_force
        front_error = lateral_error + self.task.vehicle.front_axle_distance * (
            math.sin(heading_error) + math.sin(nominal.sideslip)
        )
        return (
            nominal.steering_angle
            - (heading_error + nominal.sideslip)
            - math.atan(self.gain * front_error / (self.softening_speed + abs(vx)))
            - self.yaw_damping * (float(observation.yaw_rate) - nominal.yaw_rate)
            - self.steering_damping * (in_force - last)
        )


class PurePursuit(ClassicalAgent[SpeedMemory]):
    """Pure pursuit: steer the rear axle on an arc to a point ahead.

    ::

        delta = (L + K vx^2) 2 sin(alpha) / d

    with d the distance of the goal from the rear axle and alpha its bearing from the rear axle's
    direction of travel. This is the curvature of the arc (Coulter, CMU-RI-TR-92-01, 1992) times the
    bicycle's steering angle per curvature: L without slip, plus the understeer gradient K times
    vx^2. The goal is where the rear axle will be when the centre of gravity is on the path, one
    lookahead farther on: lr behind that point of the path, turned by the sideslip there. The
    direction of travel is the heading plus the rear axle's slip in a steady turn.

    Parameters
    ----------
    task
        Task to drive.
    lookahead_time
        Lookahead along the path, in s of driving at the current speed.
    lookahead_wheelbases
        Smallest lookahead along the path, in wheelbases.
    curvature_window
        Distance ahead of the foot point over which the curvature for the rear slip is averaged, m.
    """

    @checks_arguments(
        lookahead_time=DURATION,
        lookahead_wheelbases=LOOKAHEAD,
        curvature_window=WINDOW,
    )
    def __init__(
        self,
        task: DrivingTask,
        *,
        lookahead_time: float = 0.8,
        lookahead_wheelbases: float = 1.5,
        curvature_window: float = 1.0,
    ) -> None:
        super().__init__(task, curvature_window)
        self.lookahead_time = lookahead_time
        self.minimum_lookahead = lookahead_wheelbases * task.vehicle.wheelbase

    def new_memory(self) -> SpeedMemory:
        """Return the memory of the speed control; the steering has none."""
        return SpeedMemory()

    def steering(
        self,
        observation: TrackingObservation,
        reference: LocalReference,
        memory: SpeedMemory,  # noqa: ARG002
    ) -> float:
        """Return the steering angle (rad) for one observation."""
        vehicle = self.task.vehicle
        vx, heading_error = float(observation.longitudinal_speed), float(observation.heading_error)
        lr = vehicle.rear_axle_distance
        lookahead = max(self.minimum_lookahead, self.lookahead_time * abs(vx))

        # Beyond the preview, continue with the curvature of its last metres, as far as drivable.
        end = float(reference.arc_length[-1])
        limit = vehicle.max_steering_angle / vehicle.wheelbase
        beyond = min(max(mean_curvature(reference, end - 2.0 * lr, end), -limit), limit)
        point = point_at(reference, lookahead, beyond)
        # The rear axle follows within about lr, so use the curvature just before the goal.
        before = mean_curvature(reference, lookahead - 2.0 * lr, lookahead)
        goal_heading = point.heading - steady_turn(before, vx, vehicle).sideslip

        goal_x = point.x - lr * math.cos(goal_heading)
        goal_y = point.y - lr * math.sin(goal_heading)
        ahead = goal_x + lr * math.cos(heading_error)
        left = goal_y - (float(observation.lateral_error) - lr * math.sin(heading_error))
        # A goal nearer than half the lookahead is not ahead of the vehicle.
        distance = max(math.hypot(ahead, left), 0.5 * lookahead)
        # With slip, the rear axle does not travel in the direction of the heading.
        here = steady_turn(mean_curvature(reference, 0.0, self.curvature_window), vx, vehicle)
        travel = heading_error + here.rear_slip
        across = left * math.cos(travel) - ahead * math.sin(travel)  # d sin(alpha)
        curvature = 2.0 * across / distance**2
        return curvature * (vehicle.wheelbase + vehicle.understeer_gradient * vx * vx)
