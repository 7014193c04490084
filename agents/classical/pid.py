"""PID steering on the lateral error at a point ahead, with curvature feedforward."""

import math
from dataclasses import dataclass

from agents.base import DrivingTask
from agents.classical.base import (
    ANGLE,
    DURATION,
    GAIN,
    LOOKAHEAD,
    SHARE,
    WINDOW,
    MotionMemory,
    NominalMotionAgent,
)
from agents.reference import LocalReference
from lpv_track_env.observation import TrackingObservation
from trajectories.arguments import Number, checks_arguments


@dataclass
class PidMemory(MotionMemory):
    """Memory of `Pid` for one vehicle."""

    integral: float = 0.0
    """Integral part, m (the unit of the error)."""
    error: float | None = None
    """Error one period ago, m."""
    error_rate: float = 0.0
    """Low-pass filtered rate of the error, m/s."""


class Pid(NominalMotionAgent[PidMemory]):
    """PID steering with gains scheduled on the vehicle and its speed.

    ::

        e     = e_y + l sin(e_psi + beta_n),    l = lookahead_wheelbases L + lookahead_time |vx|
        delta = delta_n - (L + K vx^2) (2 zeta/l)^2 (e + int e dt / T_i + T_d e')

    e is the lateral error at a point l ahead of the centre of gravity; it is zero for a vehicle on
    the path, in curves as well. delta_n and beta_n are the steering and sideslip that keep the
    centre of gravity on the path (`steady_turn.transient_turn`). (L + K vx^2) is the steering
    angle per curvature, so over the distance driven e_y'' + (2 zeta/l)^2 (e_y + l e_y') = 0, which
    is critically damped for zeta = 1 at every speed and for every vehicle. The integral is held
    while the steering is at a range or rate limit and the error would drive it further.

    Parameters
    ----------
    task
        Task to drive.
    lookahead_time
        Increase of the lookahead l with speed, s.
    lookahead_wheelbases
        Lookahead at standstill, in wheelbases.
    damping
        zeta, dimensionless.
    integral_time, derivative_time
        T_i and T_d, s.
    filter_time
        Time constant of the derivative's low-pass filter, s.
    approach_angle
        Largest angle at which the vehicle approaches the path from far away, rad: e_y is limited to
        approach_angle l.
    curvature_window
        Distance ahead of the foot point over which the curvature is averaged, m.
    early_turn_share
        Curvature with which undrivable corners are rounded, as a share of that at full lock.
    """

    @checks_arguments(
        lookahead_time=DURATION,
        lookahead_wheelbases=LOOKAHEAD,
        damping=GAIN,
        integral_time=Number(1e-3, math.inf, "s"),
        derivative_time=DURATION,
        filter_time=DURATION,
        approach_angle=ANGLE,
        curvature_window=WINDOW,
        early_turn_share=SHARE,
    )
    def __init__(
        self,
        task: DrivingTask,
        *,
        lookahead_time: float = 0.8,
        lookahead_wheelbases: float = 1.0,
        damping: float = 0.9,
        integral_time: float = 4.0,
        derivative_time: float = 0.1,
        filter_time: float = 0.05,
        approach_angle: float = 0.5,
        curvature_window: float = 1.0,
        early_turn_share: float = 0.6,
    ) -> None:
        super().__init__(task, curvature_window, early_turn_share)
        self.lookahead_time = lookahead_time
        self.shortest_lookahead = lookahead_wheelbases * task.vehicle.wheelbase
        self.damping = damping
        self.integral_time = integral_time
        self.derivative_time = derivative_time
        self.filter_time = filter_time
        self.approach_angle = approach_angle

    def new_memory(self) -> PidMemory:
        """Return the memory of a vehicle without sideslip, its integrators empty."""
        return PidMemory()

    def steering(
        self, observation: TrackingObservation, reference: LocalReference, memory: PidMemory
    ) -> float:
        """Return the steering angle (rad) for one observation."""
        vehicle, period = self.task.vehicle, self.task.control_period
        vx = float(observation.longitudinal_speed)
        nominal, lateral_error, heading_error = self.motion(observation, reference, memory)

        lookahead = self.shortest_lookahead + self.lookahead_time * abs(vx)
        farthest = self.approach_angle * lookahead
        error = min(max(lateral_error, -farthest), farthest)
        error += lookahead * math.sin(heading_error + nominal.sideslip)
        if memory.error is not None:
            share = period / (self.filter_time + period)
            rate = (error - memory.error) / period
            memory.error_rate += share * (rate - memory.error_rate)
        memory.error = error

        per_curvature = vehicle.wheelbase + vehicle.understeer_gradient * vx * vx
        gain = per_curvature * (2.0 * self.damping / lookahead) ** 2
        steering = nominal.steering_angle - gain * (
            error + memory.integral + self.derivative_time * memory.error_rate
        )
        self._integrate(observation, steering, error, memory)
        return steering

    def _integrate(
        self, observation: TrackingObservation, steering: float, error: float, memory: PidMemory
    ) -> None:
        """Integrate the error, unless it would drive the steering further into a limit."""
        vehicle, period = self.task.vehicle, self.task.control_period
        in_force, reach = float(observation.steering_angle), vehicle.max_steering_rate * period
        actual = min(max(steering, in_force - reach), in_force + reach)
        actual = min(max(actual, -vehicle.max_steering_angle), vehicle.max_steering_angle)
        # A positive error leads to a negative angle.
        if (actual - steering) * error <= 0.0:
            memory.integral += error * period / self.integral_time
