"""The NMPC's discrete model and its derivatives, compiled, against CasADi's and by hand."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from agents.nmpc.linearisation import RESOLVED, Linearisation, substeps
from agents.nmpc.problem import NmpcProblem
from agents.nmpc.rti_solver import RtiSolver
from experiments.run.suites import PAPER_VEHICLES
from experiments.verify.bench import scaled_error
from experiments.verify.oracles import CasadiDerivatives, rolled_out
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y, derivative, fastest_pole
from lpv_track_env.vehicle import COURSE_CAR, M2_MINIBUS, VEHICLES, VehicleParameters
from tests.helpers.nmpc_situations import MIRROR_INPUT, MIRROR_STATE

Array = NDArray[np.float64]

each_vehicle = pytest.mark.parametrize("car", VEHICLES.values(), ids=list(VEHICLES))
each_period = pytest.mark.parametrize("period", [0.02, 0.05, 0.1])


def random_states(rng: np.random.Generator, count: int, speed: tuple[float, float]) -> Array:
    """States (count, 6), anywhere and headed anywhere; what hardly moves hardly turns.

    (The rotation over one Runge-Kutta step is a Taylor series, to 1e-9 up to 0.25 rad.)
    """
    states = rng.uniform([0, -1, -4, -1, -50, -50], [0, 1, 4, 1, 50, 50], (count, 6))
    states[:, VX] = rng.uniform(*speed, count)
    states[:, VY] *= 0.2 * np.abs(states[:, VX])
    states[:, YAW_RATE] *= np.minimum(np.abs(states[:, VX]), 1.0)
    return states


def random_inputs(rng: np.random.Generator, n: int, car: VehicleParameters) -> Array:
    """Steering up to pi/6: at 30 m/s a lock of 1 rad would turn a car by more, see above."""
    low, high = NmpcProblem(car.replace(max_steering_angle=np.pi / 6)).input_bounds
    return rng.uniform(low, high, (n, 2))


def assert_right(along: Linearisation, inputs: Array, exact: CasadiDerivatives) -> None:
    """Every period's map and derivatives are CasADi's at the state where that period begins."""
    for i, u in enumerate(inputs):
        wanted = exact.along(along.states[i], u[None])
        assert scaled_error(along.states[i + 1], wanted.states[1]) <= 1e-9
        for name in ("A", "B", "rate", "rate_x", "rate_u"):
            error = scaled_error(getattr(along, name)[i : i + 1], getattr(wanted, name))
            assert error <= 1e-9, (name, along.states[i], u)


@each_period
@each_vehicle
def test_derivatives_are_casadis(car: VehicleParameters, period: float) -> None:
    problem = NmpcProblem(car, horizon=3, period=period)
    solver, exact = RtiSolver(problem), CasadiDerivatives(problem)
    rng = np.random.default_rng(0)
    # One period where three might brake to below 1 m/s: Runge-Kutta is stable down to there.
    for n, speed, count in ((3, (3.0, 30.0), 60), (1, (1.6, 3.0), 60)):
        for state in random_states(rng, count, speed):
            inputs = random_inputs(rng, n, car)
            assert_right(solver.linearise(state, inputs), inputs, exact)


# Runge-Kutta is to be stable from 1 m/s upwards. With tyres as stiff as those of CommonRoad's cars
# it magnifies rounding below.
@pytest.mark.parametrize("period", [0.005, 0.02, 0.05])
@pytest.mark.parametrize("car", [M2_MINIBUS, COURSE_CAR], ids=PAPER_VEHICLES)
def test_derivatives_are_casadis_about_standstill_and_in_reverse(
    car: VehicleParameters, period: float
) -> None:
    problem = NmpcProblem(car, horizon=1, period=period)
    solver, exact = RtiSolver(problem), CasadiDerivatives(problem)
    rng = np.random.default_rng(1)
    states = random_states(rng, 120, (-8.0, 1.0))
    states[20:100, VX] *= 0.1
    states[100:107, VX] = -1.0, -0.3, -1e-9, 0.0, 1e-9, 0.3, 0.999
    states[20:107, [VY, YAW_RATE]] *= 0.1
    for state in states:
        inputs = random_inputs(rng, 1, car)
        assert_right(solver.linearise(state, inputs), inputs, exact)


@pytest.mark.parametrize("friction", [0.05, 0.3, 0.8, 1.05, 3.0])
@each_vehicle
def test_derivatives_with_limited_friction_are_casadis(
    car: VehicleParameters, friction: float
) -> None:
    """Rolling, sliding, braking beyond what the tyres follow; also those by the acceleration."""
    problem = NmpcProblem(car.replace(acceleration_range=(-12.0, 12.0)), 1, friction=friction)
    solver, exact = RtiSolver(problem), CasadiDerivatives(problem)
    rng = np.random.default_rng(4)
    states = random_states(rng, 200, (2.0, 30.0))
    states[::2, [VY, YAW_RATE]] *= 0.1
    found = []
    for state in states:
        inputs = rng.uniform([-12.0, -0.5], [12.0, 0.5], (1, 2))
        inputs[:, 0] = np.maximum(inputs[:, 0], (1.0 - state[VX]) / problem.period)
        along = solver.linearise(state, inputs)
        assert_right(along, inputs, exact)
        found.append(along.B[0, :, 0])
    # It matters: commands that are not followed, and those that cost side force.
    gains, sideways = np.array(found)[:, VX] / problem.period, np.array(found)[:, VY]
    assert gains.max() > 0.9
    assert np.abs(sideways).max() > 1e-4


@pytest.mark.parametrize("friction", [0.05, 0.8])
@pytest.mark.parametrize("car", [M2_MINIBUS, COURSE_CAR], ids=PAPER_VEHICLES)
def test_derivatives_with_limited_friction_at_standstill_and_in_reverse(
    car: VehicleParameters, friction: float
) -> None:
    problem = NmpcProblem(car, horizon=1, friction=friction)
    solver, exact = RtiSolver(problem), CasadiDerivatives(problem)
    rng = np.random.default_rng(5)
    states = random_states(rng, 120, (-8.0, 1.0))
    states[20:100, VX] *= 0.1
    states[100:107, VX] = -1.0, -0.3, -1e-9, 0.0, 1e-9, 0.3, 0.999
    states[20:107, [VY, YAW_RATE]] *= 0.1
    for state in states:
        inputs = random_inputs(rng, 1, car)
        assert_right(solver.linearise(state, inputs), inputs, exact)


@each_period
@each_vehicle
def test_roll_out_is_runge_kuttas_in_numpy(car: VehicleParameters, period: float) -> None:
    problem = NmpcProblem(car, period=period)
    solver, rng = RtiSolver(problem), np.random.default_rng(2)
    for state in random_states(rng, 10, (1.0, 30.0)):
        # No braking: below 1 m/s Runge-Kutta's steps are too long to be stable, and no two
        # orders of summation agree for long.
        inputs = random_inputs(rng, problem.horizon, car)
        inputs[:, 0] = np.abs(inputs[:, 0]) + 0.5
        inputs[:, 1] *= 0.2
        ours, theirs = solver.linearise(state, inputs).states, rolled_out(problem, state, inputs)
        np.testing.assert_array_equal(ours[0], state)
        assert scaled_error(ours, theirs) <= 1e-9


SPEEDS = (0.0, 0.05, 0.3, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0)


@pytest.mark.parametrize("length", [0.02, 0.1, 0.3])
@each_vehicle
def test_steps_by_speed_resolve_the_lateral_poles(car: VehicleParameters, length: float) -> None:
    """At any speed from standstill on, by at most one step more than that takes."""
    constants = RtiSolver(NmpcProblem(car, 1, length), steps_by_speed=True).constants
    for speed in (one for one in SPEEDS if one <= car.speed_range[1]):
        n = substeps(speed, 0.0, length, 1.0, constants)
        # Poles fall as 1 / vx only nearly: at 30 m/s they are up to 30 % faster than that.
        product = length * fastest_pole(speed, car)
        assert product / n <= (1.3 if speed > 15.0 else 1.01) * RESOLVED
        assert n <= math.ceil(product / RESOLVED) + 1
        # Braking: those of the lowest speed, at least standstill.
        for a in (-2.0, 2.0):
            slowest = max(speed - 2.0 * length, 0.0)
            assert substeps(speed, a, length, 1.0, constants) == substeps(
                slowest, 0.0, length, 1.0, constants
            )


@each_vehicle
def test_steps_by_speed_are_near_the_exact_flow(car: VehicleParameters) -> None:
    """After a stage of 0.1 s, from standstill to 30 m/s, in turns of up to 1 g."""
    length = 0.1
    solver = RtiSolver(NmpcProblem(car, 1, length), steps_by_speed=True)
    rng = np.random.default_rng(4)
    for speed in SPEEDS:
        for state in random_states(rng, 10, (speed, speed)):
            inputs, sharpest = random_inputs(rng, 1, car), 9.81 / max(speed, 0.1) ** 2
            inputs[:, 1] *= min(car.wheelbase * sharpest / (np.pi / 6), 1.0)
            state[YAW_RATE] *= min(speed * sharpest, 1.0)
            # A vehicle does not brake into reverse.
            inputs[0, 0] = max(inputs[0, 0], -0.9 * speed / length)
            exact = solve_ivp(
                lambda _, z, u=inputs[0]: derivative(z, u, car), (0.0, length), state,
                method="DOP853", rtol=1e-10, atol=1e-12,
            ).y[:, -1]  # fmt: skip
            error = np.abs(solver.linearise(state, inputs).states[1] - exact)
            # A centimetre, a hundredth of a radian of heading and of direction of travel (0.1 m/s
            # at 10 m/s and below), 0.1 m/s, 0.1 rad/s.
            limits = np.array([0.1, 0.01 * max(speed, 10.0), 0.01, 0.1, 0.01, 0.01])
            assert (error <= limits).all(), (state, inputs, error)


def test_straight_ahead_by_hand() -> None:
    """Without steering v' = a - mu g, which Runge-Kutta integrates exactly."""
    problem = NmpcProblem(M2_MINIBUS, horizon=2, period=0.1)
    state, inputs = np.array([8.0, 0.0, 0.0, 0.0, 3.0, -2.0]), np.array([[1.0, 0.0], [-2.0, 0.0]])
    along = RtiSolver(problem).linearise(state, inputs)
    for i, a in enumerate(inputs[:, 0]):
        rate = a - M2_MINIBUS.rolling_deceleration
        before, after = along.states[i], along.states[i + 1]
        distance = 0.1 * before[VX] + 0.005 * rate
        moved = [before[VX] + 0.1 * rate, 0.0, 0.0, 0.0, before[X] + distance, -2.0]
        np.testing.assert_allclose(after, moved, atol=1e-14)
        assert along.rate[i] == pytest.approx(rate)
        # Column by column: the speed, the heading, the position, the acceleration.
        np.testing.assert_allclose(along.A[i][:, VX], [1, 0, 0, 0, 0.1, 0], atol=1e-14)
        np.testing.assert_allclose(along.A[i][:, PSI], [0, 0, 1, 0, 0, distance], atol=1e-14)
        np.testing.assert_array_equal(along.A[i][:, [X, Y]], np.eye(6)[:, [X, Y]])
        np.testing.assert_allclose(along.B[i][:, 0], [0.1, 0, 0, 0, 0.005, 0], atol=1e-14)
        # What turns the vehicle to the left leaves its speed alone.
        np.testing.assert_array_equal(along.A[i][VX, [VY, PSI, YAW_RATE]], 0.0)
        assert along.B[i][YAW_RATE, 1] > 0.0
        np.testing.assert_array_equal(along.rate_u[i], [1.0, 0.0])


@each_vehicle
def test_mirrored_plans_have_mirrored_derivatives(car: VehicleParameters) -> None:
    solver, rng = RtiSolver(NmpcProblem(car, horizon=4)), np.random.default_rng(3)
    for state in random_states(rng, 10, (-5.0, 30.0)):
        inputs = random_inputs(rng, 4, car)
        left = solver.linearise(state, inputs)
        right = solver.linearise(state * MIRROR_STATE, inputs * MIRROR_INPUT)
        flip, turn = np.diag(MIRROR_STATE), np.diag(MIRROR_INPUT)
        for mirrored, wanted in (
            (right.states, left.states * MIRROR_STATE),
            (right.A, flip @ left.A @ flip),
            (right.B, flip @ left.B @ turn),
            (right.rate, left.rate),
            (right.rate_x, left.rate_x * MIRROR_STATE),
            (right.rate_u, left.rate_u * MIRROR_INPUT),
        ):
            assert scaled_error(mirrored, wanted) <= 1e-12
