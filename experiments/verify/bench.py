"""Draw situations and measure the real-time solver in each of them against the oracles."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from agents.base import DrivingTask
from agents.nmpc.casadi_solvers import IpoptSolver
from agents.nmpc.fatrop import FatropSolver
from agents.nmpc.ipopt_agent import IpoptNmpc
from agents.nmpc.linearisation import Linearisation
from agents.nmpc.problem import Solution, Status
from agents.nmpc.rti_solver import RtiSolver
from agents.registry import agent_class
from agents.steady_turn import steady_turn
from agents.weights import TrackingWeights
from experiments.run.suites import PAPER_VEHICLES, SIX
from experiments.verify.oracles import (
    CasadiDerivatives,
    PiqpOracle,
    PlanCost,
    plan_cost,
)
from lpv_track_env import PATH_TRACKING
from lpv_track_env.bicycle import VX
from trajectories import load

Array = NDArray[np.float64]
Measures = dict[str, float | None]

IPOPT_TOLERANCE, FATROP_TOLERANCE = 1e-8, 1e-7
ITERATIONS = 200
"""Iterations after which the solver must have converged."""
FATROP_EVERY = 5
"""fatrop solves one in this many of each vehicle's situations."""
SAME = 1e-6
"""Relative difference of cost up to which two plans count as the same optimum."""
ERRORS = {"lateral_error": 0.5, "heading_error": 0.1, "speed_error": 1.0}
"""Half widths of the uniform initial errors, m, rad, m/s."""
WEIGHT_DECADES = 1.0
"""Half width in decades of the log-uniform factors on the weights, in half of the situations."""


@dataclass(frozen=True)
class Situation:
    """Arguments of one solve, as `solve` takes them, and inputs to linearise along."""

    index: int
    trajectory: str
    vehicle: str
    state: Array
    """(6,)."""
    last_input: Array
    """(2,)."""
    reference: Array
    """(N + 1, 4)."""
    weights: Array
    """(12,)."""
    inputs: Array
    """(N, 2), within all hard bounds."""

    @property
    def parameters(self) -> tuple[Array, Array, Array, Array]:
        """State, last input, reference, weights."""
        return self.state, self.last_input, self.reference, self.weights


def kind(index: int) -> tuple[str, str]:
    """Return trajectory and vehicle of a situation; indices run through all pairs."""
    count = len(PAPER_VEHICLES)
    return SIX[index // count % len(SIX)], PAPER_VEHICLES[index % count]


class Sampler:
    """Draws situations of one vehicle, each determined by its index and the seed alone.

    Its `agent`, the NMPC by IPOPT, converts observations to the solvers' arguments; `ipopt` is that
    agent's solver.
    """

    def __init__(self, vehicle: str) -> None:
        self.vehicle = vehicle
        self.env = gymnasium.make(PATH_TRACKING, trajectory=SIX[0], vehicle=vehicle)
        self.agent = IpoptNmpc(DrivingTask.of(self.env), tolerance=IPOPT_TOLERANCE)
        assert isinstance(self.agent.solver, IpoptSolver)
        self.ipopt = self.agent.solver

    def draw(self, index: int, seed: int) -> Situation:
        """Draw the situation of an index."""
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
        low[0] = self._hardest_braking(float(state[VX]))
        inputs, before = np.empty((problem.horizon, 2)), last
        for i, step in enumerate(problem.input_steps):
            inputs[i] = before = (before + rng.uniform(-1.0, 1.0, 2) * step).clip(low, high)
        return Situation(index, trajectory, vehicle, state, last, reference, weights, inputs)

    def _hardest_braking(self, speed: float) -> float:
        """Lowest acceleration (m/s^2) by which no plan brakes to below the least permitted speed.

        Runge-Kutta steps are stable from there on; below, derivatives grow without bound.
        """
        problem = self.agent.problem
        car, duration = problem.vehicle, float(problem.times[-1])
        least = (car.speed_range[0] - speed) / duration + car.rolling_deceleration
        return max(least, car.longitudinal_acceleration_range[0])

    def _move(self, entries: dict[str, slice], observation: Any, rng: np.random.Generator) -> None:
        """Give the vehicle another motion than the steady turn in which a reset leaves it.

        In half of the cases it turns about as the path does, else its steering angle is anywhere
        within its range.
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
            "acceleration": rng.uniform(
                self._hardest_braking(speed), car.longitudinal_acceleration_range[1]
            ),
            "steering_angle": np.clip(steering, -car.max_steering_angle, car.max_steering_angle),
        }
        for name, value in new.items():
            observation[entries[name]] = value


class Bench:
    """Solver under test and oracles for one vehicle.

    Parameters
    ----------
    vehicle
        Name of a preset.
    solver
        "module:Class" (or "file.py:Class") of the solver under test: a class made by
        `cls(problem, iterations=...)` with the `problem`, `damping`, `solve`, `linearise` and
        `solve_qp` of `RtiSolver`.

    Raises
    ------
    ValueError
        If the solver cannot be loaded.
    ModuleNotFoundError
        If an oracle is not installed.
    """

    def __init__(self, vehicle: str, solver: str) -> None:
        cls = agent_class(solver)
        self.sampler = Sampler(vehicle)
        self.problem = problem = self.sampler.agent.problem
        self.one_step: RtiSolver = cls(problem, iterations=1)
        self.converged: RtiSolver = cls(problem, iterations=ITERATIONS)
        self.derivatives = CasadiDerivatives(problem)
        self.piqp = PiqpOracle(problem, self.one_step.damping)
        self.ipopt = self.sampler.ipopt
        self.fatrop = FatropSolver(problem, tolerance=FATROP_TOLERANCE)

    def measure(self, situation: Situation, *, fatrop: bool) -> Measures:
        """Return all measures of one situation.

        A measure is None if its oracle has no answer, and infinite if the solver under test failed.
        """
        along = self.derivatives.along(situation.state, situation.inputs)
        return {
            **self._linearisation(situation, along),
            **self._qp(situation, along),
            **self._optimum(situation, fatrop=fatrop),
        }

    def _linearisation(self, situation: Situation, along: Linearisation) -> Measures:
        """Compare the roll-out and its derivatives with CasADi's."""
        ours = self.one_step.linearise(situation.state, situation.inputs)
        return {
            name: scaled_error(getattr(ours, name), getattr(along, name)) for name in along._fields
        }

    def _qp(self, situation: Situation, along: Linearisation) -> Measures:
        """Compare the optimal inputs of one QP with PIQP's."""
        state, last, reference, weights = situation.parameters
        theirs = self.piqp.solve(last, reference, weights, situation.inputs, along)
        if theirs is None:
            return {"qp_first_input": None, "qp_plan": None}
        status, ours = self.one_step.solve_qp(state, last, reference, weights, situation.inputs)
        if status is not Status.SUCCESS:
            return {"qp_first_input": np.inf, "qp_plan": np.inf}
        return {
            "qp_first_input": largest(ours[0] - theirs[0]),
            "qp_plan": largest(ours - theirs),
        }

    def _optimum(self, situation: Situation, *, fatrop: bool) -> Measures:
        """Compare the converged plan with IPOPT's, and with fatrop's if it is to be run."""
        ours, _ = self.converged.solve(*situation.parameters)
        step, _ = self.one_step.solve(*situation.parameters)
        ipopt, _ = self.ipopt.solve(*situation.parameters)
        plan = self._cost(ours, situation)
        best = self._cost(ipopt, situation)
        measures: Measures = {
            "excess": None if plan is None else plan.excess,
            "cost_error": relative(plan, best),
            "suboptimality": self._suboptimality(ours, plan, best, situation),
            "first_input": None,
            "one_step_first_input": None,
            "iterations": float(ours.iterations),
            "seconds": ours.seconds,
            "one_step_seconds": step.seconds,
            "ipopt_iterations": float(ipopt.iterations),
            "ipopt_seconds": ipopt.seconds,
        }
        same = measures["cost_error"] is not None and abs(measures["cost_error"]) <= SAME
        if same and ours.inputs is not None and ipopt.inputs is not None:
            measures["first_input"] = largest(ours.inputs[0] - ipopt.inputs[0])
        if ours.inputs is not None and step.inputs is not None:
            measures["one_step_first_input"] = largest(step.inputs[0] - ours.inputs[0])
        if fatrop:
            other, _ = self.fatrop.solve(*situation.parameters)
            third = self._cost(other, situation)
            measures["fatrop_cost_error"] = relative(plan, third)
            measures["oracles_cost_error"] = None if third is None else relative(third, best)
            measures["fatrop_iterations"] = float(other.iterations)
            measures["fatrop_seconds"] = other.seconds
        return measures

    def _cost(self, solution: Solution, situation: Situation) -> PlanCost | None:
        """Return the cost of a solution's plan, or None if the solver failed."""
        if solution.status is not Status.SUCCESS or solution.inputs is None:
            return None
        return plan_cost(self.problem, *situation.parameters, solution.inputs)

    def _suboptimality(
        self, ours: Solution, plan: PlanCost | None, best: PlanCost | None, situation: Situation
    ) -> float | None:
        """Return the relative reduction of cost, >= 0, that IPOPT achieves from our plan.

        The problem is not convex: a plan that costs more than IPOPT's may be another local optimum,
        at which IPOPT then stays. IPOPT is not run again if both costs are the same.
        """
        if plan is None:
            return np.inf
        error = relative(plan, best)
        if error is not None and abs(error) <= SAME:
            return max(error, 0.0)
        polished = self._cost(self.ipopt.solve_from(ours, *situation.parameters), situation)
        gain = relative(plan, polished)
        return None if gain is None else max(gain, 0.0)


def largest(difference: Array) -> float:
    """Return the largest magnitude, infinite if any entry is not finite."""
    value = float(np.abs(difference).max())
    return value if np.isfinite(value) else np.inf


def scaled_error(ours: Array, theirs: Array) -> float:
    """Return the largest difference, relative for entries above 1 and absolute below."""
    if np.shape(ours) != np.shape(theirs):
        raise ValueError(f"shape {np.shape(ours)} where {np.shape(theirs)} is due")
    return largest((ours - theirs) / np.maximum(1.0, np.abs(theirs)))


def relative(ours: PlanCost | None, theirs: PlanCost | None) -> float | None:
    """Return (ours - theirs) / theirs; None without theirs, infinite without ours."""
    if theirs is None:
        return None
    return np.inf if ours is None else (ours.cost - theirs.cost) / theirs.cost


@cache
def bench(vehicle: str, solver: str) -> Bench:
    """Return a vehicle's bench, made once per process."""
    return Bench(vehicle, solver)


def run_situation(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Measure the situation of a spec (index, seed, vehicle, trajectory, solver, fatrop)."""
    on = bench(spec["vehicle"], spec["solver"])
    situation = on.sampler.draw(spec["index"], spec["seed"])
    return {**spec, "error": "", "measures": on.measure(situation, fatrop=spec["fatrop"])}


def situation_death(spec: Mapping[str, Any], error: str) -> dict[str, Any]:
    """Return the result of a situation that could not be measured, such as by a worker's death."""
    return {**spec, "error": error, "measures": {}}
