"""Write a controller and compare it with the NMPC on some paths."""

import argparse

from agents import TrackingAgent
from experiments.run.case import run_case
from lpv_track_env.observation import TrackingObservation


class Proportional(TrackingAgent[None]):
    """Feedforward of the path's curvature, and proportional feedback of the errors."""

    def new_memory(self) -> None:
        """Return no memory: the control law is static."""

    def control(self, observation: TrackingObservation, memory: None) -> tuple[float, float]:
        """Return acceleration (m/s^2) and steering angle (rad)."""
        del memory
        # At low speed, a curvature needs a steering angle of wheelbase times curvature.
        feedforward = self.task.vehicle.wheelbase * float(observation.preview_curvature[0])
        feedback = -0.2 * float(observation.lateral_error) - 0.4 * float(observation.heading_error)
        speed_error = float(observation.longitudinal_speed - observation.reference_speed)
        return self.task.vehicle.rolling_deceleration - speed_error, feedforward + feedback


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectories", nargs="+", default=["T2", "u-turn"])
    options = parser.parse_args()
    print(f"{'path':12}{'agent':14}{'end':14}{'MLE m':>8}{'ALE m':>8}")
    for trajectory in options.trajectories:
        for agent in (f"{__file__}:Proportional", "lpv-nmpc"):
            result = run_case({"agent": agent, "trajectory": trajectory})
            if result["status"] != "ok":
                raise SystemExit(result["error"])
            name = agent.rpartition(":")[2]
            values = "".join(f"{result['metrics'][key]:8.3f}" for key in ("mle", "ale"))
            print(f"{trajectory:12}{name:14}{result['end']:14}{values}")


if __name__ == "__main__":
    main()
