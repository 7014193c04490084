"""A controller of one's own beside the NMPC; print a table of both on some paths."""

import argparse

from agents import TrackingAgent
from experiments.run.case import run_case
from lpv_track_env.observation import TrackingObservation


class Proportional(TrackingAgent[None]):
    """Steers as the bend needs, and back to the path, twice as hard for heading as for offset."""

    def new_memory(self) -> None:
        """Nothing is remembered."""

    def control(self, observation: TrackingObservation, memory: None) -> tuple[float, float]:
        """Acceleration (m/s^2) and steering angle (rad)."""
        del memory
        # What a bend needs at low speed, and feedback on what that leaves.
        bend = self.task.vehicle.wheelbase * float(observation.preview_curvature[0])
        back = -0.2 * float(observation.lateral_error) - 0.4 * float(observation.heading_error)
        slower = float(observation.reference_speed - observation.longitudinal_speed)
        return self.task.vehicle.rolling_deceleration + slower, bend + back


def main() -> None:
    """Run it; `--help` lists the arguments."""
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
