"""Write a nonlinear MPC with do-mpc as an agent, and compare it with this project's.

It predicts with a kinematic bicycle in the coordinates of the path, from the observation alone.
Needs `lpv-track-env[libraries]`.
"""

import argparse
from typing import Any

import casadi as ca
import do_mpc
import numpy as np

from agents import DrivingTask, TrackingAgent
from experiments.run.case import run_case
from lpv_track_env.observation import TrackingObservation


class DoMpc(TrackingAgent[None]):
    """MPC with states lateral error (m), course error (rad) and speed (m/s), solved by IPOPT."""

    def __init__(self, task: DrivingTask, *, horizon: int = 15) -> None:
        super().__init__(task)
        car, h = task.vehicle, task.layout.preview_period
        self.horizon = min(horizon, task.layout.preview_steps - 1)
        model = do_mpc.model.Model("discrete")
        e, chi, v = (model.set_variable("_x", name) for name in ("e", "chi", "v"))
        a, delta = (model.set_variable("_u", name) for name in ("a", "delta"))
        curvature, speed = (model.set_variable("_tvp", name) for name in ("curvature", "speed"))
        along = v * ca.cos(chi) / (1 - curvature * e)
        model.set_rhs("e", e + h * v * ca.sin(chi))
        model.set_rhs("chi", chi + h * (v * ca.tan(delta) / car.wheelbase - curvature * along))
        model.set_rhs("v", v + h * a)
        model.setup()
        self.mpc: Any = do_mpc.controller.MPC(model)
        self.mpc.set_param(
            n_horizon=self.horizon, t_step=h, store_full_solution=False,
            nlpsol_opts={"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes"},
        )  # fmt: skip
        cost = 4 * e**2 + 2 * chi**2 + (v - speed) ** 2
        self.mpc.set_objective(mterm=cost, lterm=cost)
        self.mpc.set_rterm(a=2.0, delta=400.0)  # of squared changes from step to step
        limit, (low, high) = car.max_steering_angle, car.acceleration_range
        for name, bounds in (("delta", (-limit, limit)), ("a", (low, high))):
            self.mpc.bounds["lower", "_u", name], self.mpc.bounds["upper", "_u", name] = bounds
        self.preview = self.mpc.get_tvp_template()
        self.mpc.set_tvp_fun(lambda _: self.preview)
        self.mpc.setup()
        self.mpc.set_initial_guess()

    def new_memory(self) -> None:
        """Return no memory: the solver's warm start is do-mpc's own."""

    def control(self, observation: TrackingObservation, memory: None) -> tuple[float, float]:
        """Return acceleration (m/s^2) and steering angle (rad)."""
        del memory
        o, rolling = observation, self.task.vehicle.rolling_deceleration
        speeds = np.concatenate([[o.reference_speed], o.preview_speed])
        for k in range(self.horizon + 1):
            self.preview["_tvp", k] = np.array([o.preview_curvature[k], speeds[k]])
        self.mpc.u0 = np.array([o.acceleration - rolling, o.steering_angle])
        # The body slips: not its heading, but the course shows where the vehicle goes.
        course = o.heading_error + np.arctan2(o.lateral_speed, o.longitudinal_speed)
        start = np.array([o.lateral_error, course, o.longitudinal_speed])
        given = self.mpc.make_step(start.reshape(3, 1))
        return float(given[0, 0]) + rolling, float(given[1, 0])


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectories", nargs="+", default=["T2", "u-turn"])
    options = parser.parse_args()
    print(f"{'path':12}{'agent':14}{'end':14}{'MLE m':>8}{'ALE m':>8}")
    for trajectory in options.trajectories:
        for agent in (f"{__file__}:DoMpc", "lpv-nmpc"):
            result = run_case({"agent": agent, "trajectory": trajectory})
            if result["status"] != "ok":
                raise SystemExit(result["error"])
            values = "".join(f"{result['metrics'][key]:8.3f}" for key in ("mle", "ale"))
            print(f"{trajectory:12}{agent.rpartition(':')[2]:14}{result['end']:14}{values}")


if __name__ == "__main__":
    main()
