"""The real-time NMPC's quadratic program against PIQP, a dense solve and calculation by hand."""

import numpy as np
import pytest
from numpy.typing import NDArray

from agents.nmpc.problem import NmpcProblem, Status
from agents.nmpc.rti_solver import RtiSolver
from experiments.verify.oracles import CasadiDerivatives, PiqpOracle
from lpv_track_env.vehicle import COURSE_CAR, M2_MINIBUS, VEHICLES, VehicleParameters
from tests.helpers.condensed_qp import CondensedQp, excess, within
from tests.helpers.nmpc_situations import MIRROR_INPUT, WEIGHTS, Situation, arc, hard

Array = NDArray[np.float64]

PAIRS = 8 + 3 * 3
"""Inequalities a stage: two each on a, delta and their changes; three for each soft constraint."""
TOLERANCE, ACCEPTABLE = 1e-9, 1e-6
"""The solver's mean product of multiplier and gap, and where rounding may end it."""

each_vehicle = pytest.mark.parametrize("car", VEHICLES.values(), ids=list(VEHICLES))


def problem_of(car: VehicleParameters, n: int) -> NmpcProblem:
    # Unequal periods and penalties: no entry can stand in for another.
    return NmpcProblem(
        car, horizon=n, stages=tuple(0.05 + 0.02 * np.sin(np.arange(n))), first_period=0.03,
        linear_penalty=(20.0, 15.0, 25.0), quadratic_penalty=(100.0, 80.0, 120.0),
    )  # fmt: skip


def limits_in_use(problem: NmpcProblem, case: Situation, inputs: Array) -> dict[str, bool]:
    low, high = problem.input_bounds
    steps = np.abs(np.diff(np.vstack([case.last_input, inputs]), axis=0))
    near = np.minimum(inputs - low, high - inputs) < 1e-7
    rate = problem.input_steps - steps < 1e-7
    names = ("acceleration", "steering", "jerk", "steering rate")
    return dict(zip(names, [*near.any(axis=0), *rate.any(axis=0)], strict=True))


@pytest.mark.parametrize("decades", [1.0, 3.0])
@pytest.mark.parametrize("damping", [(0.0, 0.0), (0.3, 0.2)], ids=["undamped", "damped"])
@pytest.mark.parametrize("n", [1, 5, 20, 50])
def test_optimum_is_piqps(n: int, damping: tuple[float, float], decades: float) -> None:
    """As cheap as PIQP's up to the duality gap that was asked for, and as near as that implies.

    Long programs, and weights over six decades, may run out of iterations; then it says so.
    """
    rng, compared, solved = np.random.default_rng(n), 0, 0
    difficult = n == 50 or decades > 1.0
    used: dict[str, bool] = {}
    broken = np.zeros(3, dtype=bool)
    for car in VEHICLES.values():
        problem = problem_of(car, n)
        solver, exact = RtiSolver(problem, damping=damping), CasadiDerivatives(problem)
        oracle = PiqpOracle(problem, damping)
        for _ in range(12):
            case = hard(rng, problem, decades)
            status, ours = solver.solve_qp(*case.parameters, case.inputs)
            assert excess(problem, case.last_input, ours) <= 1e-9
            if status is not Status.SUCCESS:
                assert status is Status.MAXITER
                assert difficult
                continue
            solved += 1
            along = exact.along(case.state, case.inputs)
            _, last, reference, weights = case.parameters
            theirs = oracle.solve(last, reference, weights, case.inputs, along)
            if theirs is None:
                continue
            compared += 1
            qp = CondensedQp(problem, damping, case, along)
            kept = within(problem, last, theirs)
            gap = qp.error_of(ours, PAIRS, ACCEPTABLE if difficult else TOLERANCE)
            # The second half is `lpv-track verify`'s: of what the optimum saves on the plan.
            gap = min(gap, 1e-6 * max(1.0, abs(qp.cost(kept) - qp.cost(case.inputs))))
            assert abs(qp.cost(ours) - qp.cost(kept)) <= gap
            assert np.abs(ours - theirs).max() <= 2.0 * qp.reach(gap)
            broken |= qp.slack(ours).max(axis=0) > 1e-3
            for name, uses in limits_in_use(problem, case, ours).items():
                used[name] = used.get(name, False) or uses
    assert solved >= 18
    assert compared >= 12
    assert used["jerk"]
    assert used["steering rate"]
    if n >= 20:
        assert used["steering"]
        assert broken[1:].all()


def test_first_input_is_piqps_in_ordinary_situations() -> None:
    """What `lpv-track verify` asks of a thousand of them: 1e-6."""
    for car in (M2_MINIBUS, COURSE_CAR):
        problem = NmpcProblem(car)
        solver, exact = RtiSolver(problem), CasadiDerivatives(problem)
        oracle, rng = PiqpOracle(problem, solver.damping), np.random.default_rng(1)
        for _ in range(10):
            case = hard(rng, problem, decades=0.0)
            status, ours = solver.solve_qp(*case.parameters, case.inputs)
            assert status is Status.SUCCESS
            along = exact.along(case.state, case.inputs)
            theirs = oracle.solve(*case.parameters[1:], case.inputs, along)
            assert theirs is not None
            np.testing.assert_allclose(ours[0], theirs[0], atol=1e-6)


@pytest.mark.parametrize("damping", [(0.0, 0.0), (0.3, 0.2)], ids=["undamped", "damped"])
@pytest.mark.parametrize("n", [1, 5, 20, 50])
def test_without_limits_it_is_the_linear_quadratic_regulators(
    n: int, damping: tuple[float, float]
) -> None:
    free = M2_MINIBUS.replace(
        acceleration_range=(-1e4, 1e4), longitudinal_acceleration_range=(-1e4, 1e4),
        max_jerk=1e6, max_steering_angle=1e3, max_steering_rate=1e6,
        max_lateral_velocity_ratio=1e3, speed_range=(1e-3, 1e4), implausible=True,
    )  # fmt: skip
    stages = tuple(np.linspace(0.03, 0.07, n))
    problem = NmpcProblem(free, horizon=n, stages=stages, first_period=0.03)
    narrow = NmpcProblem(M2_MINIBUS, horizon=n, stages=stages, first_period=0.03)
    rng = np.random.default_rng(2)
    solver, exact = RtiSolver(problem, damping=damping), CasadiDerivatives(problem)
    for _ in range(10):
        case = hard(rng, narrow)
        status, ours = solver.solve_qp(*case.parameters, case.inputs)
        assert status is Status.SUCCESS
        qp = CondensedQp(problem, damping, case, exact.along(case.state, case.inputs))
        wanted = qp.unconstrained()
        assert excess(problem, case.last_input, wanted) < 0.0, "no limit was to matter"
        # Rounding, as the Hessian's condition magnifies it.
        size = np.abs(wanted).max() * np.finfo(float).eps * np.linalg.cond(qp.hessian)
        np.testing.assert_allclose(ours, wanted, rtol=0.0, atol=1e-10 + 10.0 * size)


def test_one_straight_period_by_hand() -> None:
    """v' = a - mu g: the cost of the one acceleration is a parabola.

    A stage of 0.1 s counts twice, and the weight on the jerk for 2 / 0.1^2.
    """
    car = M2_MINIBUS.replace(max_jerk=1e3)
    period, v, drag = 0.1, 10.0, M2_MINIBUS.rolling_deceleration
    problem = NmpcProblem(car, horizon=1, period=period)
    weights = np.array([1.0, 1.0, 1.0, 1.0, 7.0, 1.0, 30.0, 1.0, 0.1, 1.0, 1e-3, 0.0])
    reference = np.array([[v, 0.0, 0.0, 0.0], [10.1, 0.0, 1.003, 0.0]])
    # v1 = v + T (a - drag), X1 = T v + T^2/2 (a - drag)
    by_v, by_x = period, 0.5 * period**2
    v0, x0 = v - period * drag, period * v - 0.5 * period**2 * drag
    pull = 7.0 * by_v * (10.1 - v0) + 30.0 * by_x * (1.003 - x0)
    pull += 0.2 * 0.3  # the acceleration in force
    wanted = pull / (7.0 * by_v**2 + 30.0 * by_x**2 + 0.2 + 0.2)
    state = np.array([v, 0.0, 0.0, 0.0, 0.0, 0.0])
    for plan in (0.0, wanted, -1.0):
        status, found = RtiSolver(problem).solve_qp(
            state, np.array([0.3, 0.0]), reference, weights, np.array([[plan, 0.0]])
        )
        assert status is Status.SUCCESS
        np.testing.assert_allclose(found, [[wanted, 0.0]], atol=1e-9)
    # Damping pulls towards the plan.
    _, damped = RtiSolver(problem, damping=(0.3, 0.1)).solve_qp(
        state, np.array([0.3, 0.0]), reference, weights, np.array([[-1.0, 0.0]])
    )
    curvature = 7.0 * by_v**2 + 30.0 * by_x**2 + 0.4
    assert damped[0, 0] == pytest.approx((pull - 0.3) / (curvature + 0.3), abs=1e-9)


@each_vehicle
def test_mirrored_program_has_the_mirrored_optimum(car: VehicleParameters) -> None:
    problem, rng = problem_of(car, 20), np.random.default_rng(3)
    solver, exact = RtiSolver(problem), CasadiDerivatives(problem)
    for _ in range(10):
        case = hard(rng, problem)
        image = case.mirrored
        status, left = solver.solve_qp(*case.parameters, case.inputs)
        other, right = solver.solve_qp(*image.parameters, image.inputs)
        assert status is other is Status.SUCCESS
        qp = CondensedQp(problem, (0.0, 0.0), case, exact.along(case.state, case.inputs))
        reach = 2.0 * qp.reach(qp.error_of(left, PAIRS, TOLERANCE))
        np.testing.assert_allclose(right * MIRROR_INPUT, left, rtol=0.0, atol=reach)


def test_first_period_bounds_the_first_change() -> None:
    """Far off the path with cheap steering, it turns as fast as it may, from the first step on."""
    for first_period in (0.02, 0.05, 0.08):
        problem = NmpcProblem(M2_MINIBUS, horizon=10, period=0.05, first_period=first_period)
        state = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 3.0])
        last = np.array([0.2, 0.0])
        reference = arc(0.0, np.full(11, 12.0), 0.05)
        _, found = RtiSolver(problem).solve_qp(
            state, last, reference, WEIGHTS, np.tile(last, (10, 1))
        )
        first, second = found[0] - last, found[1] - found[0]
        rates = np.array([M2_MINIBUS.max_jerk, -M2_MINIBUS.max_steering_rate])
        np.testing.assert_allclose(first, first_period * rates, rtol=1e-6)
        np.testing.assert_allclose(second, 0.05 * rates, rtol=1e-6)
