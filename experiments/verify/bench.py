"""One situation, measured: the real-time solver's linearisation, QP and optimum against oracles."""

from collections.abc import Mapping
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents.nmpc.fatrop_solver import FatropSolver
from agents.nmpc.problem import NmpcProblem, Solution, Status
from agents.registry import agent_class
from experiments.verify.cost import PlanCost, plan_cost
from experiments.verify.derivatives import CasadiDerivatives, Derivatives
from experiments.verify.qp import PiqpOracle
from experiments.verify.situations import Sampler, Situation
from experiments.verify.verdict import SAME

Array = NDArray[np.float64]
Measures = dict[str, float | None]

FATROP_TOLERANCE = 1e-7
ITERATIONS = 200
"""Bound on the iterations after which the solver must have converged."""
FATROP_EVERY = 5
"""Of each vehicle's situations, those that fatrop solves too."""


class RealTimeSolver(Protocol):
    """The solver under test, made by `cls(problem, iterations=...)`."""

    problem: NmpcProblem
    damping: tuple[float, float]

    def solve(
        self,
        state: Array,
        last_input: Array,
        reference: Array,
        weights: Array,
        warm: Any = None,
    ) -> tuple[Solution, Any]:
        """Up to `iterations` iterations; as `CasadiSolver.solve`."""
        ...

    def linearise(self, state: Array, inputs: Array) -> Any:
        """Roll the inputs (N, 2) out from a state (6,): a tuple with the fields of Derivatives."""
        ...

    def solve_qp(
        self, state: Array, last_input: Array, reference: Array, weights: Array, inputs: Array
    ) -> tuple[Status, Array]:
        """One QP, linearised along `inputs` (N, 2): its optimal inputs (N, 2)."""
        ...


class Bench:
    """Solvers and oracles for one vehicle.

    Parameters
    ----------
    vehicle
        A preset's name.
    solver
        "module:Class" (or "file.py:Class") of the solver under test.

    Raises
    ------
    ValueError
        If the solver, or an oracle, is not there.
    """

    def __init__(self, vehicle: str, solver: str) -> None:
        cls = agent_class(solver)
        self.sampler = Sampler(vehicle)
        self.problem = problem = self.sampler.agent.problem
        self.one_step: RealTimeSolver = cls(problem, iterations=1)
        self.converged: RealTimeSolver = cls(problem, iterations=ITERATIONS)
        self.derivatives = CasadiDerivatives(problem)
        self.piqp = PiqpOracle(problem, self.one_step.damping)
        self.ipopt = self.sampler.ipopt
        self.fatrop = FatropSolver(problem, tolerance=FATROP_TOLERANCE)

    def measure(self, situation: Situation, *, fatrop: bool) -> Measures:
        """All measures of one situation; None where an oracle gave no answer.

        A solver under test that fails is infinitely wrong.
        """
        along = self.derivatives.along(situation.state, situation.inputs)
        return {
            **self._linearisation(situation, along),
            **self._qp(situation, along),
            **self._optimum(situation, fatrop=fatrop),
        }

    def _linearisation(self, situation: Situation, along: Derivatives) -> Measures:
        ours = self.one_step.linearise(situation.state, situation.inputs)
        return {
            name: scaled_error(getattr(ours, name), getattr(along, name)) for name in along._fields
        }

    def _qp(self, situation: Situation, along: Derivatives) -> Measures:
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
        ours, _ = self.converged.solve(*situation.parameters)
        step, _ = self.one_step.solve(*situation.parameters)
        ipopt, _ = self.ipopt.solve(*situation.parameters)
        plan = self._price(ours, situation)
        best = self._price(ipopt, situation)
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
            third = self._price(other, situation)
            measures["fatrop_cost_error"] = relative(plan, third)
            measures["oracles_cost_error"] = None if third is None else relative(third, best)
            measures["fatrop_iterations"] = float(other.iterations)
            measures["fatrop_seconds"] = other.seconds
        return measures

    def _price(self, solution: Solution, situation: Situation) -> PlanCost | None:
        """Price of a solution's plan; None unless it was solved."""
        if solution.status is not Status.SUCCESS or solution.inputs is None:
            return None
        return plan_cost(self.problem, *situation.parameters, solution.inputs)

    def _suboptimality(
        self, ours: Solution, plan: PlanCost | None, best: PlanCost | None, situation: Situation
    ) -> float | None:
        """By how much of its cost IPOPT betters our plan when it starts there; >= 0.

        The problem is not convex: a plan that costs more than IPOPT's may be an optimum of its own,
        and then IPOPT keeps it. Where both cost the same already, it is not asked.
        """
        if plan is None:
            return np.inf
        error = relative(plan, best)
        if error is not None and abs(error) <= SAME:
            return max(error, 0.0)
        polished = self._price(self.ipopt.solve_from(ours, *situation.parameters), situation)
        gain = relative(plan, polished)
        return None if gain is None else max(gain, 0.0)


def largest(difference: Array) -> float:
    """Largest magnitude; infinite if any entry is not finite."""
    value = float(np.abs(difference).max())
    return value if np.isfinite(value) else np.inf


def scaled_error(ours: Array, theirs: Array) -> float:
    """Largest difference, relative to entries above 1 and absolute below."""
    if np.shape(ours) != np.shape(theirs):
        raise ValueError(f"shape {np.shape(ours)} where {np.shape(theirs)} is due")
    return largest((ours - theirs) / np.maximum(1.0, np.abs(theirs)))


def relative(ours: PlanCost | None, theirs: PlanCost | None) -> float | None:
    """(ours - theirs) / theirs; None without theirs, infinite without ours."""
    if theirs is None:
        return None
    return np.inf if ours is None else (ours.cost - theirs.cost) / theirs.cost


@cache
def bench(vehicle: str, solver: str) -> Bench:
    """A vehicle's bench, made once a process."""
    return Bench(vehicle, solver)


def run_situation(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Measure the situation of a spec (index, seed, vehicle, trajectory, solver, fatrop)."""
    on = bench(spec["vehicle"], spec["solver"])
    situation = on.sampler.draw(spec["index"], spec["seed"])
    return {**spec, "error": "", "measures": on.measure(situation, fatrop=spec["fatrop"])}


def situation_death(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Result of a situation that killed its worker twice."""
    return {**spec, "error": "the worker process died, twice", "measures": {}}
