"""Situations to solve: states beside the six trajectories, seen as an agent sees them."""

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from agents.base import DrivingTask
from agents.nmpc.casadi_solver import CasadiSolver
from agents.nmpc.ipopt_agent import IpoptNmpc
from agents.reference import steady_turn
from agents.weights import TrackingWeights
from experiments.run.suites import PAPER_VEHICLES, SIX
from lpv_track_env.registration import PATH_TRACKING
from trajectories import load

Array = NDArray[np.float64]

IPOPT_TOLERANCE = 1e-8
ERRORS = {"lateral_error": 0.5, "heading_error": 0.1, "speed_error": 1.0}
"""Half widths of the uniform errors: m, rad, m/s."""
WEIGHT_DECADES = 1.0
"""Half of the situations have weights drawn log-uniformly within this of the defaults."""


@dataclass(frozen=True)
class Situation:
    """What one solve is given.

    `state` (6,), `last_input` (2,), `reference` (N + 1, 4), `weights` (10,) as a solver's `solve`
    takes them; `inputs` (N, 2) within all hard bounds, to linearise along.
    """

    index: int
    trajectory: str
    vehicle: str
    state: Array
    last_input: Array
    reference: Array
    weights: Array
    inputs: Array

    @property
    def parameters(self) -> tuple[Array, Array, Array, Array]:
        """State, last input, reference, weights."""
        return self.state, self.last_input, self.reference, self.weights


def kind(index: int) -> tuple[str, str]:
    """Trajectory and vehicle of a situation: all pairs in turn."""
    count = len(PAPER_VEHICLES)
    return SIX[index // count % len(SIX)], PAPER_VEHICLES[index % count]


class Sampler:
    """Draws situations of one vehicle; situation `index` of a seed is the same in any order.

    Parameters
    ----------
    vehicle
        A preset's name.

    Its `agent`, IPOPT's, turns observations into the solvers' parameters; `ipopt` is its solver.
    """

    def __init__(self, vehicle: str) -> None:
        self.vehicle = vehicle
        self.env = gymnasium.make(PATH_TRACKING, trajectory=SIX[0], vehicle=vehicle)
        self.agent = IpoptNmpc(DrivingTask.of(self.env), tolerance=IPOPT_TOLERANCE)
        assert isinstance(self.agent.solver, CasadiSolver)
        self.ipopt = self.agent.solver

    def draw(self, index: int, seed: int) -> Situation:
        """Situation number `index`."""
        trajectory, vehicle = kind(index)
        assert vehicle == self.vehicle
        rng = np.random.default_rng([seed, index])
        problem, layout = self.agent.problem, self.agent.task.layout
        options: dict[str, Any] = {
            "trajectory": trajectory,
            **{name: rng.uniform(-half, half) for name, half in ERRORS.items()},
        }
        options["arc_length"] = rng.uniform(0.0, load(trajectory).length)
        observation, _ = self.env.reset(options=options)
        self._move(layout.slices, observation, rng)
        state, last, reference = self.agent.situation(layout.unpack(observation))
        weights = TrackingWeights().as_array()
        if rng.random() < 0.5:
            decades = rng.uniform(-WEIGHT_DECADES, WEIGHT_DECADES, len(weights))
            weights = weights * 10.0**decades
        low, high = problem.input_bounds
        inputs, before = np.empty((problem.horizon, 2)), last
        for i, step in enumerate(problem.input_steps):
            inputs[i] = before = (before + rng.uniform(-1.0, 1.0, 2) * step).clip(low, high)
        return Situation(index, trajectory, vehicle, state, last, reference, weights, inputs)

    def _move(self, entries: dict[str, slice], observation: Any, rng: np.random.Generator) -> None:
        """Let the vehicle turn: a reset leaves it going straight, steering straight.

        Half of the time it turns about as the path does, else it steers anywhere in its range.
        """
        car = self.agent.problem.vehicle
        slowest = car.speed_range[0]
        speed = max(float(observation[entries["longitudinal_speed"]][0]), slowest)
        curvature = float(observation[entries["preview_curvature"]][0])
        turn = steady_turn(curvature, speed, car)
        steering = turn.steering_angle + rng.normal(0.0, 0.02)
        if rng.random() < 0.5:
            steering = rng.uniform(-car.max_steering_angle, car.max_steering_angle)
        new = {
            "longitudinal_speed": speed,
            "lateral_speed": speed * turn.sideslip + rng.normal(0.0, 0.1),
            "yaw_rate": turn.yaw_rate + rng.normal(0.0, 0.1),
            "acceleration": rng.uniform(*car.longitudinal_acceleration_range),
            "steering_angle": np.clip(steering, -car.max_steering_angle, car.max_steering_angle),
        }
        for name, value in new.items():
            observation[entries[name]] = value
