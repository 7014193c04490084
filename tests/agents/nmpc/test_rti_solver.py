"""The real-time solver as a solver: statuses, warm starts, and the optimum it iterates towards."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from agents.nmpc.casadi_solvers import IpoptSolver
from agents.nmpc.problem import LARGEST, NmpcProblem, Solution, Status
from agents.nmpc.rti_solver import RtiSolver
from experiments.verify.bench import scaled_error
from experiments.verify.oracles import plan_cost, rolled_out, turns
from lpv_track_env.bicycle import PSI, VX, X, Y
from lpv_track_env.vehicle import BMW_320I, COURSE_CAR, M2_MINIBUS, VEHICLES, VehicleParameters
from tests.helpers.condensed_qp import excess
from tests.helpers.nmpc_situations import WEIGHTS, Situation, arc, hard

Array = NDArray[np.float64]

each_vehicle = pytest.mark.parametrize("car", VEHICLES.values(), ids=list(VEHICLES))


CONVERGED = 1000
"""Iterations: Gauss-Newton steps gain slowly where the cost is flat; after 100, 1e-5 is left."""


def cases(
    count: int, problem: NmpcProblem, decades: float = 1.0, errors: float = 1.0
) -> list[Situation]:
    rng = np.random.default_rng(0)
    return [hard(rng, problem, decades, errors) for _ in range(count)]


def solved(solution: Solution) -> tuple[Array, Array, Array]:
    """Inputs, states, slack of a solution that must be one."""
    assert solution.status is Status.SUCCESS
    assert solution.inputs is not None
    assert solution.states is not None
    assert solution.slack is not None
    return solution.inputs, solution.states, solution.slack


# Convergence ---------------------------------------------------------------------------------


@each_vehicle
def test_iterated_it_converges_to_ipopts_optimum(car: VehicleParameters) -> None:
    """Costs agree to 1e-6 where both find the same of several optima; and IPOPT keeps our plan."""
    stages = tuple(np.linspace(0.04, 0.11, 15))
    problem = NmpcProblem(car, horizon=15, stages=stages, first_period=0.03)
    ours, ipopt = RtiSolver(problem, iterations=CONVERGED), IpoptSolver(problem, tolerance=1e-9)
    same = 0
    for case in [*cases(5, problem), *cases(5, problem, decades=0.0, errors=0.3)]:
        mine, _ = ours.solve(*case.parameters)
        inputs, states, slack = solved(mine)
        price = plan_cost(problem, *case.parameters, inputs)
        assert price.excess <= 1e-9
        assert mine.cost == pytest.approx(price.cost, rel=1e-9)
        np.testing.assert_allclose(slack, price.slack, atol=1e-9)
        assert scaled_error(states, rolled_out(problem, case.state, inputs)) <= 1e-9
        theirs, _ = ipopt.solve(*case.parameters)
        best = plan_cost(problem, *case.parameters, solved(theirs)[0])
        if abs(price.cost - best.cost) <= 1e-6 * best.cost:
            same += 1
            continue
        polished = ipopt.solve_from(mine, *case.parameters)
        kept = plan_cost(problem, *case.parameters, solved(polished)[0])
        assert price.cost <= kept.cost * (1.0 + 1e-6)
    assert same >= 8


@pytest.mark.parametrize("friction", [0.5, 0.8])
@pytest.mark.parametrize("car", [M2_MINIBUS, BMW_320I], ids=lambda car: car.name)
def test_iterated_with_limited_friction_it_converges_to_ipopts_optimum(
    car: VehicleParameters, friction: float
) -> None:
    """To 1e-6 of the cost in at least eight of ten; others are other optima, or steps end early.

    Where tyres slide altogether a plan does not change the forces: Gauss-Newton steps stall there.
    """
    problem = NmpcProblem(car, horizon=15, first_period=0.03, friction=friction)
    ours, ipopt = RtiSolver(problem, iterations=CONVERGED), IpoptSolver(problem, tolerance=1e-8)
    same = 0
    for case in [*cases(5, problem), *cases(5, problem, decades=0.0, errors=0.3)]:
        mine, _ = ours.solve(*case.parameters)
        price = plan_cost(problem, *case.parameters, solved(mine)[0])
        assert price.excess <= 1e-9
        assert mine.cost == pytest.approx(price.cost, rel=1e-9)
        theirs, _ = ipopt.solve(*case.parameters)
        if theirs.status is not Status.SUCCESS:  # IPOPT has not converged: nothing to compare
            continue
        best = plan_cost(problem, *case.parameters, solved(theirs)[0])
        same += price.cost <= best.cost * (1.0 + 1e-6)
    assert same >= 8


def test_a_warm_start_is_nearer_to_the_same_optimum() -> None:
    problem = NmpcProblem(M2_MINIBUS, horizon=15)
    converged, few = RtiSolver(problem, iterations=CONVERGED), RtiSolver(problem, iterations=2)
    for case in cases(5, problem, decades=0.0, errors=0.3):
        best, plan = converged.solve(*case.parameters)
        assert plan is not None
        # Back by one period: the shift then brings it where it was.
        before = np.vstack([plan[:1], plan[:-1]])
        again, _ = converged.solve(*case.parameters, before)
        assert again.cost == pytest.approx(best.cost, rel=1e-6)
        warm, _ = few.solve(*case.parameters, before)
        cold, _ = few.solve(*case.parameters)
        assert best.cost * (1.0 - 1e-9) <= warm.cost <= cold.cost * (1.0 + 1e-9)


# One iteration -------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 5, 20, 50])
def test_one_iteration_is_one_program_along_the_shifted_plan(n: int) -> None:
    stages = tuple(0.05 + 0.03 * np.sin(5.0 * np.arange(n)))
    problem = NmpcProblem(COURSE_CAR, horizon=n, stages=stages, first_period=0.03)
    solver = RtiSolver(problem)
    for case in cases(5, problem):
        state, last, reference, weights = case.parameters
        cold, plan = solver.solve(*case.parameters)
        assert plan is not None
        held = np.tile(last, (n, 1))
        np.testing.assert_array_equal(
            solved(cold)[0], solver.solve_qp(state, last, reference, weights, held)[1]
        )
        handed = plan.copy()
        warm, _ = solver.solve(*case.parameters, handed)
        np.testing.assert_array_equal(handed, plan)
        # 0.03 s on of stages of 0.02 to 0.08 s; the last input is held.
        moved = plan.copy()
        moved[:-1] += np.minimum(0.03 / problem.periods[:-1, None], 1.0) * np.diff(plan, axis=0)
        # It starts from the input in force, not from where the plan thought to be.
        low, high = problem.input_bounds
        before = last
        for i, step in enumerate(problem.input_steps):
            moved[i] = before = moved[i].clip(before - step, before + step).clip(low, high)
        status, wanted = solver.solve_qp(state, last, reference, weights, moved)
        assert status is Status.SUCCESS
        np.testing.assert_allclose(solved(warm)[0], wanted, atol=1e-6)


@pytest.mark.parametrize("car", [M2_MINIBUS, BMW_320I], ids=lambda car: car.name)
def test_with_limited_friction_no_step_raises_the_exact_cost(
    car: VehicleParameters,
) -> None:
    """The QP's own step would; the plan's cost and states are those of CasADi's roll-out."""
    problem = NmpcProblem(car, horizon=15, friction=0.3)
    solver, raised = RtiSolver(problem), 0
    for case in cases(60, problem, decades=0.0, errors=3.0):
        state, last, reference, weights = case.parameters
        start = np.tile(last, (problem.horizon, 1))
        solution, _ = solver.solve(*case.parameters)
        if solution.status is Status.MAXITER:
            continue
        inputs, states, slack = solved(solution)
        price = plan_cost(problem, *case.parameters, inputs)
        before = plan_cost(problem, *case.parameters, start).cost
        assert price.excess <= 1e-9
        assert price.cost <= before * (1.0 + 1e-9)
        assert solution.cost == pytest.approx(price.cost, rel=1e-9)
        np.testing.assert_allclose(slack.max(axis=0), price.slack.max(axis=0), atol=1e-9)
        assert scaled_error(states, rolled_out(problem, state, inputs)) <= 1e-9
        whole = solver.solve_qp(state, last, reference, weights, start)[1]
        raised += plan_cost(problem, *case.parameters, whole).cost > before
    assert raised > 3


@each_vehicle
def test_plans_keep_the_hard_limits_and_are_priced_as_predicted(car: VehicleParameters) -> None:
    problem = NmpcProblem(
        car, horizon=20, first_period=0.03, stages=tuple(np.linspace(0.04, 0.11, 20)),
        linear_penalty=(20.0, 15.0, 25.0), quadratic_penalty=(100.0, 80.0, 120.0),
    )  # fmt: skip
    solver = RtiSolver(problem)
    broken = np.zeros(3)
    for case in cases(60, problem, decades=2.0):
        solution, _ = solver.solve(*case.parameters)
        if solution.status is Status.MAXITER:
            continue
        inputs, states, slack = solved(solution)
        assert excess(problem, case.last_input, inputs) <= 1e-9
        np.testing.assert_array_equal(states[0], case.state)
        assert (slack >= -1e-9).all()
        broken = np.maximum(broken, slack.max(axis=0))
        error = case.reference - states[:, [VX, PSI, X, Y]]
        error = np.einsum("nij,nj->ni", turns(case.reference), error)
        q, s, r, r_rate = np.split(case.weights, (4, 8, 10))
        share, spacing = problem.periods[:, None] / 0.05, problem.spacings[:, None]
        rates = np.diff(np.vstack([case.last_input, inputs]), axis=0) / spacing
        cost = 0.5 * (np.sum(share * error[:-1] ** 2 * q) + s @ error[-1] ** 2)
        cost += 0.5 * (np.sum(share * inputs**2 * r) + np.sum(spacing / 0.05 * rates**2 * r_rate))
        cost += np.sum(share * slack * problem.linear_penalty)
        cost += 0.5 * np.sum(share * slack**2 * problem.quadratic_penalty)
        assert solution.cost == pytest.approx(cost, rel=1e-12)
        # The slack is what the predicted states need.
        vx, vy = states[1:, :2].T
        assert (np.abs(vy) <= car.max_lateral_velocity_ratio * vx + slack[:, 1] + 1e-6).all()
        assert (vx >= car.speed_range[0] - slack[:, 0] - 1e-6).all()
        assert (vx <= car.speed_range[1] + slack[:, 0] + 1e-6).all()
    assert (broken[1:] > 1e-2).all()


def test_damping_keeps_the_plan_nearer_to_the_last_one() -> None:
    problem = NmpcProblem(M2_MINIBUS)
    for case in cases(5, problem, decades=0.0):
        distances = []
        for damping in (0.0, 10.0, 1000.0):
            solver = RtiSolver(problem, damping=(damping, damping))
            inputs = solved(solver.solve(*case.parameters)[0])[0]
            distances.append(float(np.linalg.norm(inputs - case.last_input)))
        assert distances == sorted(distances, reverse=True)


def test_arguments_may_be_views_and_are_left_alone() -> None:
    problem = NmpcProblem(M2_MINIBUS)
    solver = RtiSolver(problem)
    (case,) = cases(1, problem)
    wanted = solved(solver.solve(*case.parameters)[0])
    wide = np.zeros((42, 9))
    wide[::2, 1:8:2] = case.reference
    views = (
        np.repeat(case.state, 2)[::2], np.repeat(case.last_input, 2)[::2], wide[::2, 1:8:2],
        np.repeat(case.weights, 3)[1::3],
    )  # fmt: skip
    copies = [value.copy() for value in views]
    for found, right in zip(solved(solver.solve(*views)[0]), wanted, strict=True):
        np.testing.assert_array_equal(found, right)
    for value, copy in zip(views, copies, strict=True):
        np.testing.assert_array_equal(value, copy)
    # What was handed out is the caller's.
    first, plan = solver.solve(*case.parameters)
    kept = [value.copy() for value in solved(first)]
    solver.solve(*case.mirrored.parameters, plan)
    for value, copy in zip(solved(first), kept, strict=True):
        np.testing.assert_array_equal(value, copy)


# Stages of any length and number ---------------------------------------------------------------


@pytest.mark.parametrize("car", [M2_MINIBUS, COURSE_CAR], ids=lambda car: car.name)
def test_weights_mean_the_same_at_twice_as_many_stages(car: VehicleParameters) -> None:
    """Stages, equal or not, are a grid on a plan over time: costs converge as they shrink."""
    state, last = np.array([6.3, 0.0, 0.05, 0.2, 0.0, 0.3]), np.array([0.2, 0.1])
    coarsest = np.linspace(0.06, 0.16, 20)
    plans, costs, ends = [], [], []
    for parts in (1, 2, 4):
        stages = np.repeat(coarsest, parts) / parts
        n = len(stages)
        problem = NmpcProblem(car, horizon=n, stages=tuple(stages), first_period=0.05)
        reference = arc(0.04, np.full(n + 1, 6.0), stages)
        solver = RtiSolver(problem, iterations=CONVERGED)
        solution, _ = solver.solve(state, last, reference, WEIGHTS)
        inputs, states, _ = solved(solution)
        plans.append(inputs.reshape(20, parts, 2).mean(axis=1))
        costs.append(solution.cost)
        ends.append(states[-1])
    # Sums over rectangles: of first order, so the error is halved with the stages.
    changes = np.abs(np.diff(costs))
    assert changes[1] == pytest.approx(0.5 * changes[0], rel=0.3)
    assert costs[2] == pytest.approx(costs[1], rel=0.05)
    np.testing.assert_allclose(ends[1:], ends[:2], atol=0.03)
    for fine, coarse in itertools.pairwise(reversed(plans)):
        np.testing.assert_allclose(coarse[:, 0], fine[:, 0], atol=0.15)
        np.testing.assert_allclose(coarse[:, 1], fine[:, 1], atol=0.02)


# What goes wrong -----------------------------------------------------------------------------


@pytest.mark.parametrize("iterations", [1, 5])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", range(4))
def test_parameters_that_are_not_finite_have_a_status(
    place: int, bad: float, iterations: int
) -> None:
    problem = NmpcProblem(M2_MINIBUS, horizon=5)
    solver = RtiSolver(problem, iterations=iterations)
    (case,) = cases(1, problem)
    parameters = [value.copy() for value in case.parameters]
    parameters[place].flat[1] = bad
    solution, warm = solver.solve(*parameters)
    assert solution.status is Status.NAN
    assert solution[1:4] == (None, None, None)
    assert warm is None
    # And no trace of it in the next solve.
    assert solver.solve(*case.parameters)[0].status is Status.SUCCESS


@pytest.mark.parametrize("iterations", [1, 5])
@pytest.mark.parametrize("place", range(4))
def test_absurd_parameters_end_in_a_status(place: int, iterations: int) -> None:
    problem = NmpcProblem(M2_MINIBUS, horizon=5)
    solver = RtiSolver(problem, iterations=iterations)
    (case,) = cases(1, problem)
    for size in (1e6, 1e12, 1e100, 1e300):
        parameters = [value.copy() for value in case.parameters]
        parameters[place] *= size
        solution, warm = solver.solve(*parameters)
        if solution.status is Status.SUCCESS:
            low, high = problem.input_bounds
            assert (low <= solved(solution)[0]).all()
            assert (solved(solution)[0] <= high).all()
        else:
            failed = {Status.NAN} if size > LARGEST else {Status.MAXITER, Status.QP_FAILURE}
            assert solution.status in failed
            assert solution.inputs is None
            assert warm is None
    assert solver.solve(*case.parameters)[0].status is Status.SUCCESS


def test_a_failed_solve_leaves_no_trace() -> None:
    problem = NmpcProblem(COURSE_CAR)
    used, fresh = RtiSolver(problem), RtiSolver(problem)
    case, other = cases(2, problem)
    used.solve(other.state * 1e6, *other.parameters[1:])
    one, two = used.solve(*case.parameters)[0], fresh.solve(*case.parameters)[0]
    np.testing.assert_array_equal(solved(one)[0], solved(two)[0])
    assert one.cost == two.cost


def test_last_input_out_of_bounds_is_brought_within() -> None:
    problem = NmpcProblem(M2_MINIBUS)
    state = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    reference = arc(0.0, np.full(21, 8.0), problem.periods)
    low, high = problem.input_bounds
    solver = RtiSolver(problem)
    for over, at in ((high + 1.0, high), (low - 1.0, low)):
        found, wanted = (
            solved(solver.solve(state, last, reference, WEIGHTS)[0])[0] for last in (over, at)
        )
        np.testing.assert_array_equal(found, wanted)


def test_no_weight_on_anything_is_solved() -> None:
    """Any plan within the limits is optimal then; none may be NaN."""
    problem = NmpcProblem(M2_MINIBUS)
    (case,) = cases(1, problem)
    solution, _ = RtiSolver(problem).solve(*case.parameters[:3], np.zeros(12))
    if solution.status is Status.SUCCESS:
        assert excess(problem, case.last_input, solved(solution)[0]) <= 1e-9
    else:
        assert solution.status in {Status.MAXITER, Status.QP_FAILURE}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"iterations": 0}, "iterations must be a whole number from 1 to 10,000, not 0"),
        ({"damping": (-0.1, 0.0)}, r"damping\[0\] must be >= 0 and at most 1e\+09, not -0.1"),
        ({"damping": (0.0, float("nan"))}, r"damping\[1\] must be >= 0"),
        ({"damping": (float("nan"), 0.0)}, r"damping\[0\] must be >= 0"),
        ({"tolerance": 0.0}, "tolerance must be positive and at most 1, not 0.0"),
        ({"tolerance": float("nan")}, "tolerance must be positive"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RtiSolver(NmpcProblem(M2_MINIBUS), **settings)  # type: ignore[arg-type]
