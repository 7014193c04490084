"""LPV linear-quadratic steering with preview, gain-scheduled over the speed."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from agents.base import DrivingTask
from agents.classical.base import ANGLE, WINDOW, ClassicalAgent, SpeedMemory
from agents.reference import LocalReference, mean_curvature
from agents.steady_turn import steady_turn
from lpv_track_env import lpv
from lpv_track_env.bicycle import VY, YAW_RATE
from lpv_track_env.observation import TrackingObservation
from lpv_track_env.vehicle import VehicleParameters
from trajectories.arguments import Number, checks_arguments

Array = NDArray[np.float64]

STATES = 5


class LateralModel(NamedTuple):
    """Lateral error dynamics over one control period: z+ = A z + B u + D kappa."""

    A: Array
    """(5, 5); z = [e_y, vy, e_psi, r, delta] in m, m/s, rad, rad/s, rad."""
    B: Array
    """(5, 1); u is the change of the steering angle at the start of the period, rad."""
    D: Array
    """(5,); kappa is the path's mean curvature over the period, 1/m."""


def lateral_model(speed: float, period: float, vehicle: VehicleParameters) -> LateralModel:
    """Discretise the lateral error dynamics exactly, with inputs held over the period.

    (vy, r) and the steering come from `lpv.matrices` at [vx, 0, 0, 0, 0, 0], delta = 0; the errors
    follow e_y' = vy + vx e_psi and e_psi' = r - vx kappa (Rajamani, Vehicle Dynamics and Control,
    section 2.5, with e_y' replaced by vy).
    """
    straight = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
    a_matrix, b_matrix = lpv.matrices(straight, np.zeros(2), vehicle)
    continuous = np.zeros(
        (STATES + 1, STATES + 1)
    )  # rows and columns e_y, vy, e_psi, r, delta, kappa
    continuous[0, 1], continuous[0, 2] = 1.0, speed
    continuous[2, 3], continuous[2, 5] = 1.0, -speed
    for row, source in ((1, VY), (3, YAW_RATE)):
        continuous[row, 1] = a_matrix[source, VY]
        continuous[row, 3] = a_matrix[source, YAW_RATE]
        continuous[row, 4] = b_matrix[source, 1]
    held = expm(continuous * period)
    A = held[:STATES, :STATES]
    # The steering angle changes at once and is then held, so u enters like delta.
    return LateralModel(A, A[:, 4:5], held[:STATES, STATES])


class Gains(NamedTuple):
    """Gains for one speed: u = -feedback z - preview kappa."""

    feedback: Array
    """(5,), for the state z."""
    preview: Array
    """(n + 1,), for the mean curvature over each of the next n control periods, and for the
    constant curvature after them."""


def preview_gains(model: LateralModel, cost: Array, effort: float, count: int) -> Gains:
    """Compute the gains that minimise sum z' cost z + effort u^2 with the curvature known ahead.

    This is the linear-quadratic problem with preview (Tomizuka 1975; Peng and Tomizuka, Journal of
    Dynamic Systems, Measurement, and Control, 1993). With P from the Riccati equation and
    Acl = A - B K, the curvature i periods ahead has the gain (effort + B'PB)^-1 B' (Acl')^i P D.

    Parameters
    ----------
    model
        Lateral error dynamics.
    cost
        (5, 5), positive semidefinite.
    effort
        Positive weight of u^2.
    count
        n, number of periods of preview; the curvature is constant after them.
    """
    A, B, D = model
    P = solve_discrete_are(A, B, cost, np.array([[effort]]))
    scaled_input = np.linalg.solve(effort + B.T @ P @ B, B.T)[0]
    feedback = scaled_input @ P @ A
    closed = A - B @ feedback[np.newaxis, :]
    preview = np.empty(count + 1)
    effect = P @ D
    for k in range(count):
        preview[k] = scaled_input @ effect
        effect = closed.T @ effect
    # Geometric series over all later periods.
    preview[count] = scaled_input @ np.linalg.solve(np.eye(STATES) - closed.T, effect)
    return Gains(feedback, preview)


class LpvLqr(ClassicalAgent[SpeedMemory]):
    """Linear-quadratic steering with preview, its gains scheduled over the speed.

    For every speed of a grid the gains minimise, over an infinite horizon with known curvature,

        sum_k  T (q_y e_y^2 + q_v (vy + vx e_psi)^2) + R/T u_k^2

    with u the change of the steering angle in one control period T, so that R weights the steering
    rate and the gains hardly depend on T. On a circle all three terms vanish: the steering angle,
    sideslip and heading error of a steady turn cost nothing, so a constant curvature leaves no
    error. The model is linear in the steering angle; its difference from the bicycle's steady turn
    (`agents.steady_turn`) is subtracted from the state. Gains are interpolated between
    speeds. The grid omits standstill, where lateral errors cannot be controlled.

    Parameters
    ----------
    task
        Task to drive.
    lateral_error_weight
        q_y, 1/m^2.
    lateral_rate_weight
        q_v, s^2/m^2.
    steering_rate_weight
        R, s^2/rad^2.
    approach_angle
        Largest heading error to which e_y may lead, rad.
    speed_step
        Step of the speed grid, m/s; it reaches from 5 m/s in reverse to the vehicle's top speed.
    curvature_window
        Distance ahead of the foot point over which the steady turn's curvature is averaged, m.
    """

    @checks_arguments(
        lateral_error_weight=Number(1e-6, 1e6),
        lateral_rate_weight=Number(0.0, 1e6),
        steering_rate_weight=Number(1e-6, 1e6),
        approach_angle=ANGLE,
        curvature_window=WINDOW,
    )
    def __init__(
        self,
        task: DrivingTask,
        *,
        lateral_error_weight: float = 1.0,
        lateral_rate_weight: float = 1.0,
        steering_rate_weight: float = 1.0,
        approach_angle: float = 0.35,
        speed_step: float = 0.5,
        curvature_window: float = 1.0,
    ) -> None:
        super().__init__(task, curvature_window)
        self.approach_angle = approach_angle
        fastest = task.vehicle.speed_range[1]
        # At least two speeds, and not so many that their gains take minutes.
        speed_step = Number(0.05, 0.5 * fastest, "m/s").of("speed_step", speed_step)
        self.slowest = speed_step
        layout, period = task.layout, task.control_period
        self.count = max(round(layout.preview_steps * layout.preview_period / period), 1)
        forward = speed_step * np.arange(1, round(fastest / speed_step) + 1)
        self.speeds = np.concatenate([-forward[forward <= 5.0][::-1], forward])
        """Speed grid, (m,) m/s."""
        rows = []
        for speed in self.speeds:
            lateral_rate = np.array([0.0, 1.0, speed, 0.0, 0.0])
            cost = lateral_rate_weight * np.outer(lateral_rate, lateral_rate)
            cost[0, 0] += lateral_error_weight
            model = lateral_model(float(speed), period, task.vehicle)
            gains = preview_gains(model, period * cost, steering_rate_weight / period, self.count)
            rows.append(np.concatenate(gains))
        self.table = np.array(rows)
        """Gains at the speeds of the grid, (m, 5 + n + 1)."""

    def new_memory(self) -> SpeedMemory:
        """Return the memory of the speed control; the steering has none."""
        return SpeedMemory()

    def gains(self, speed: float) -> Gains:
        """Interpolate the gains at a speed (m/s); beyond the grid, take those at its ends."""
        grid = self.speeds
        speed = min(max(speed, float(grid[0])), float(grid[-1]))
        k = min(max(int(np.searchsorted(grid, speed)), 1), len(grid) - 1)
        share = (speed - grid[k - 1]) / (grid[k] - grid[k - 1])
        row = (1.0 - share) * self.table[k - 1] + share * self.table[k]
        return Gains(row[:STATES], row[STATES:])

    def steering(
        self,
        observation: TrackingObservation,
        reference: LocalReference,
        memory: SpeedMemory,  # noqa: ARG002
    ) -> float:
        """Return the steering angle (rad) for one observation."""
        vx, in_force = float(observation.longitudinal_speed), float(observation.steering_angle)
        # Mean curvature over the stretch of path driven in each of the next periods.
        stretch = max(vx, self.slowest) * self.task.control_period
        places = stretch * np.arange(self.count + 1)
        curvature = np.diff(np.interp(places, reference.arc_length, reference.heading)) / stretch
        ahead = np.append(curvature, curvature[-1])

        state = np.array(
            [
                float(observation.lateral_error),
                float(observation.lateral_speed),
                float(observation.heading_error),
                float(observation.yaw_rate),
                in_force,
            ]
        )
        state -= self._nonlinearity(mean_curvature(reference, 0.0, self.curvature_window), vx)
        gains = self.gains(vx)
        farthest = self.approach_angle * abs(float(gains.feedback[2] / gains.feedback[0]))
        state[0] = min(max(float(state[0]), -farthest), farthest)
        change = -float(gains.feedback @ state) - float(gains.preview @ ahead)
        return in_force + change

    def _nonlinearity(self, curvature: float, speed: float) -> Array:
        """Return the steady state z (5,) on a circle, the bicycle's minus the linear model's."""
        vehicle = self.task.vehicle
        limit = vehicle.max_steering_angle / vehicle.wheelbase
        curvature = min(max(curvature, -limit), limit)
        turn = steady_turn(curvature, speed, vehicle)
        # Linear model: steady_turn to first order in the curvature.
        share = vehicle.front_axle_distance / (vehicle.wheelbase * vehicle.rear_cornering_stiffness)
        sideslip = curvature * (vehicle.rear_axle_distance - vehicle.mass * speed**2 * share)
        per_curvature = vehicle.wheelbase + vehicle.understeer_gradient * speed**2
        return np.array(
            [
                0.0,
                speed * (math.tan(turn.sideslip) - sideslip),
                sideslip - turn.sideslip,
                turn.yaw_rate - curvature * speed,
                turn.steering_angle - curvature * per_curvature,
            ]
        )
