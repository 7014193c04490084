"""Write a nonlinear MPC with CasADi's Opti as an agent, and compare it with this project's.

It predicts with a kinematic bicycle in the coordinates of the path, from the observation alone.
"""

import argparse

import casadi as ca
import numpy as np

from agents import DrivingTask, TrackingAgent
from experiments.run.case import run_case
from lpv_track_env.observation import TrackingObservation


class OptiMpc(TrackingAgent[None]):
    """MPC with states lateral error (m), course error (rad) and speed (m/s), solved by IPOPT."""

    def __init__(self, task: DrivingTask, *, horizon: int = 15) -> None:
        super().__init__(task)
        car, h = task.vehicle, task.layout.preview_period
        self.horizon = min(horizon, task.layout.preview_steps)
        opti, cost = ca.Opti(), ca.MX(0)
        x, u = opti.variable(3, self.horizon + 1), opti.variable(2, self.horizon)
        start, now = opti.parameter(3), opti.parameter(2)
        curvature, speed = opti.parameter(self.horizon), opti.parameter(self.horizon)
        opti.subject_to(x[:, 0] == start)
        for k in range(self.horizon):
            e, chi, v, a, delta = *ca.vertsplit(x[:, k]), *ca.vertsplit(u[:, k])
            along = v * ca.cos(chi) / (1 - curvature[k] * e)
            rate = ca.vertcat(
                v * ca.sin(chi), v * ca.tan(delta) / car.wheelbase - curvature[k] * along, a
            )
            opti.subject_to(x[:, k + 1] == x[:, k] + h * rate)
            e, chi, v = ca.vertsplit(x[:, k + 1])
            change = (u[:, k] - (u[:, k - 1] if k else now)) / h
            cost += 4 * e**2 + 2 * chi**2 + (v - speed[k]) ** 2
            cost += 0.02 * change[0] ** 2 + 4.0 * change[1] ** 2
            opti.subject_to(opti.bounded(-car.max_steering_rate, change[1], car.max_steering_rate))
        limit, (low, high) = car.max_steering_angle, car.acceleration_range
        opti.subject_to(opti.bounded(-limit, u[1, :], limit))
        opti.subject_to(opti.bounded(low - car.rolling_deceleration, u[0, :], high))
        opti.minimize(cost)
        opti.solver("ipopt", {"print_time": 0, "ipopt": {"print_level": 0, "sb": "yes"}})
        given = [start, now, curvature, speed, x, u]
        self._solve = opti.to_function("solve", given, [u[:, 0], x, u])
        self._guess = np.zeros((3, self.horizon + 1)), np.zeros((2, self.horizon))

    def new_memory(self) -> None:
        """Return no memory: every solve starts afresh."""

    def control(self, observation: TrackingObservation, memory: None) -> tuple[float, float]:
        """Return acceleration (m/s^2) and steering angle (rad)."""
        del memory
        o, n, rolling = observation, self.horizon, self.task.vehicle.rolling_deceleration
        # The body slips: not its heading, but the course shows where the vehicle goes.
        course = o.heading_error + np.arctan2(o.lateral_speed, o.longitudinal_speed)
        start = np.array([o.lateral_error, course, o.longitudinal_speed])
        now = np.array([o.acceleration - rolling, o.steering_angle])
        x, u = self._guess
        x = x + start[:, None]
        first, *_ = self._solve(start, now, o.preview_curvature[:n], o.preview_speed[:n], x, u)
        return float(first[0]) + rolling, float(first[1])


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectories", nargs="+", default=["T2", "u-turn"])
    options = parser.parse_args()
    print(f"{'path':12}{'agent':14}{'end':14}{'MLE m':>8}{'ALE m':>8}")
    for trajectory in options.trajectories:
        for agent in (f"{__file__}:OptiMpc", "lpv-nmpc"):
            result = run_case({"agent": agent, "trajectory": trajectory})
            if result["status"] != "ok":
                raise SystemExit(result["error"])
            values = "".join(f"{result['metrics'][key]:8.3f}" for key in ("mle", "ale"))
            print(f"{trajectory:12}{agent.rpartition(':')[2]:14}{result['end']:14}{values}")


if __name__ == "__main__":
    main()
