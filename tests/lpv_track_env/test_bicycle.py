"""The vector field, its LPV form and its integration, against formulas and other software."""

import dataclasses
import math

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from lpv_track_env import bicycle, kernels, lpv
from lpv_track_env.bicycle import (
    LONGEST_SUBSTEP,
    LOW_SPEED,
    POLE_STEP,
    compiled_field,
    compiled_inverse_speed,
    derivative,
)
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import COURSE_CAR, M2_MINIBUS, VEHICLES, VehicleParameters

Array = NDArray[np.float64]

PRESETS = pytest.mark.parametrize("car", VEHICLES.values(), ids=VEHICLES.keys())
COUNT = 10_000
MIRROR_STATE = np.array([1.0, -1.0, -1.0, -1.0, 1.0, -1.0])
MIRROR_ACTION = np.array([1.0, -1.0])


def random_inputs(speed: tuple[float, float], count: int = COUNT) -> tuple[Array, Array]:
    """States (6, count) and actions (2, count) far beyond what a task visits."""
    rng = np.random.default_rng(7)
    low = np.array([speed[0], -5.0, -10.0, -3.0, -1e3, -1e3])
    high = np.array([speed[1], 5.0, 10.0, 3.0, 1e3, 1e3])
    states = rng.uniform(low, high, (count, 6)).T
    actions = rng.uniform([-5.0, -1.2], [3.5, 1.2], (count, 2)).T
    return states, actions


def paper_field(x: Array, u: Array, p: VehicleParameters) -> tuple[Array, Array]:
    """kumar2025lpv's equations as printed, and the size of the terms that each row adds up."""
    m, iz, lf, lr = p.mass, p.yaw_inertia, p.front_axle_distance, p.rear_axle_distance
    caf, car, mu, g = (
        p.front_cornering_stiffness, p.rear_cornering_stiffness, p.rolling_resistance, GRAVITY,
    )  # fmt: skip
    vx, vy, psi, r, _, _ = x
    a, delta = u
    slips_front = (delta, -vy / vx, -lf * r / vx)
    slips_rear = (-vy / vx, lr * r / vx)
    fyf, fyr = caf * sum(slips_front), car * sum(slips_rear)
    sum_front = caf * sum(map(np.abs, slips_front))
    sum_rear = car * sum(map(np.abs, slips_rear))
    sin_d, cos_d, sin_p, cos_p = np.sin(delta), np.cos(delta), np.sin(psi), np.cos(psi)
    values = np.array(
        [
            a - mu * g - fyf * sin_d / m + r * vy,
            fyr / m + fyf * cos_d / m - r * vx,
            r,
            (fyf * cos_d * lf - fyr * lr) / iz,
            vx * cos_p - vy * sin_p,
            vx * sin_p + vy * cos_p,
        ]
    )
    sizes = np.array(
        [
            np.abs(a) + mu * g + sum_front * np.abs(sin_d) / m + np.abs(r * vy),
            (sum_rear + sum_front * cos_d) / m + np.abs(r * vx),
            np.abs(r),
            (sum_front * cos_d * lf + sum_rear * lr) / iz,
            np.hypot(vx, vy),
            np.hypot(vx, vy),
        ]
    )
    return values, sizes


def assert_close(actual: Array, wanted: Array, sizes: Array) -> None:
    """Equal to 1e-9 of the summed terms: where they cancel, floats cannot be more accurate."""
    excess = np.abs(actual - wanted) / np.maximum(sizes, np.finfo(float).tiny)
    assert excess.max() <= 1e-9


@PRESETS
def test_field_is_the_papers(car: VehicleParameters) -> None:
    states, actions = random_inputs((1.0, 40.0))
    wanted, sizes = paper_field(states, actions, car)
    assert_close(derivative(states, actions, car), wanted, sizes)


@PRESETS
def test_fields_of_all_backends_agree(car: VehicleParameters) -> None:
    states, actions = random_inputs((-10.0, 40.0))
    wanted = derivative(states, actions, car)
    _, sizes = paper_field(states, actions, car)
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    symbolic = ca.Function("f", [x, u], [bicycle.casadi_derivative(x, u, car)])
    assert_close(np.array(symbolic.map(COUNT)(states, actions)), wanted, np.maximum(sizes, 1.0))
    parameters = car.as_array().tolist()
    compiled, plain = np.empty((6, COUNT)), np.empty((6, COUNT))
    for k, (state, action) in enumerate(zip(states.T.tolist(), actions.T.tolist(), strict=True)):
        vx, vy, psi, r = state[:4]
        a, delta = action
        speed = abs(vx)
        arguments = (vx, vy, r, math.cos(psi), math.sin(psi), a, delta, math.cos(delta))
        arguments += (math.sin(delta),)
        compiled[:, k] = compiled_field(*arguments, compiled_inverse_speed(vx), *parameters)
        q = bicycle.inverse_speed_polynomial(min(speed / LOW_SPEED, 1.0), max(speed, LOW_SPEED))
        plain[:, k] = bicycle.field(*arguments, q, *parameters)
    assert_close(compiled, wanted, np.maximum(sizes, 1.0))
    assert_close(plain, wanted, np.maximum(sizes, 1.0))


@PRESETS
@pytest.mark.parametrize("speed", [(1.0, 40.0), (-1.0, 1.0), (-40.0, -1.0)])
def test_lpv_form_equals_the_field_on_floats(
    car: VehicleParameters, speed: tuple[float, float]
) -> None:
    """A x + B u against the compiled field, entry by entry in plain floats."""
    states, actions = random_inputs(speed)
    parameters = car.as_array().tolist()
    worst = 0.0
    for state, (a, delta) in zip(states.T.tolist(), actions.T.tolist(), strict=True):
        vx, vy, psi, r = state[:4]
        cp, sp, cd, sd = math.cos(psi), math.sin(psi), math.cos(delta), math.sin(delta)
        q = compiled_inverse_speed(vx)
        wanted = compiled_field(vx, vy, r, cp, sp, a, delta, cd, sd, q, *parameters)
        a_entries, b_entries = lpv.entries(vx, vy, cp, sp, cd, sd, q, *parameters)
        product, size = [0.0] * 6, [1e-300] * 6
        for (row, column), value in a_entries.items():
            product[row] += value * state[column]
            size[row] += abs(value * state[column])
        for (row, column), value in b_entries.items():
            product[row] += value * (a, delta)[column]
            size[row] += abs(value * (a, delta)[column])
        # vy r stands in A[vx, r] with a second term: its size counts too.
        size[0] += abs(vy * r)
        worst = max(worst, *(abs(p - w) / s for p, w, s in zip(product, wanted, size, strict=True)))
    assert worst <= 1e-9


@PRESETS
@pytest.mark.parametrize("speed", [(1.0, 40.0), (-1.0, 1.0), (-40.0, -1.0)])
def test_lpv_form_equals_the_field_on_numpy_and_casadi(
    car: VehicleParameters, speed: tuple[float, float]
) -> None:
    states, actions = random_inputs(speed)
    wanted = derivative(states, actions, car)
    numeric, sizes = np.empty((6, COUNT)), np.empty((6, COUNT))
    for k in range(COUNT):
        x, u = states[:, k], actions[:, k]
        a_matrix, b_matrix = lpv.matrices(x, u, car)
        numeric[:, k] = a_matrix @ x + b_matrix @ u
        sizes[:, k] = np.abs(a_matrix) @ np.abs(x) + np.abs(b_matrix) @ np.abs(u)
    sizes[0] += np.abs(states[1] * states[3])
    assert_close(numeric, wanted, sizes)
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    a_symbolic, b_symbolic = lpv.casadi_matrices(x, u, car)
    assert a_symbolic.shape == (6, 6)
    assert b_symbolic.shape == (6, 2)
    product = ca.Function("product", [x, u], [a_symbolic @ x + b_symbolic @ u])
    assert_close(np.array(product.map(COUNT)(states, actions)), wanted, sizes)


def test_lpv_entries_are_the_papers_with_its_misprints_mended() -> None:
    p = M2_MINIBUS
    vx, vy, psi, r, delta = 7.0, 0.3, 0.4, 0.2, 0.1
    m, iz, lf, lr = p.mass, p.yaw_inertia, p.front_axle_distance, p.rear_axle_distance
    caf, car = p.front_cornering_stiffness, p.rear_cornering_stiffness
    sd, cd = math.sin(delta), math.cos(delta)
    a_matrix, b_matrix = lpv.matrices([vx, vy, psi, r, 1.0, 2.0], [0.5, delta], p)
    wanted = np.zeros((6, 6))
    wanted[0, [0, 1, 3]] = (
        -p.rolling_deceleration / vx, caf * sd / (m * vx), caf * lf * sd / (m * vx) + vy,
    )  # fmt: skip
    wanted[1, 1] = -(car + caf * cd) / (m * vx)
    wanted[1, 3] = -(caf * lf * cd - car * lr) / (m * vx) - vx
    wanted[2, 3] = 1.0
    wanted[3, 1] = -(caf * lf * cd - car * lr) / (iz * vx)
    wanted[3, 3] = -(caf * lf**2 * cd + car * lr**2) / (iz * vx)
    wanted[4, :2] = math.cos(psi), -math.sin(psi)
    wanted[5, :2] = math.sin(psi), math.cos(psi)
    np.testing.assert_allclose(a_matrix, wanted, rtol=1e-12)
    wanted_b = np.zeros((6, 2))
    wanted_b[0] = 1.0, -caf * sd / m
    wanted_b[[1, 3], 1] = caf * cd / m, caf * lf * cd / iz
    np.testing.assert_allclose(b_matrix, wanted_b, rtol=1e-12)


def test_output_matrix_selects_the_outputs() -> None:
    state = np.arange(6.0)
    np.testing.assert_array_equal(lpv.C @ state, [0.0, 2.0, 4.0, 5.0])


@pytest.mark.parametrize(("state", "action"), [((5,), (2,)), ((6,), (3,)), ((), (2,)), ((6,), ())])
def test_wrong_shapes_are_refused(state: tuple[int, ...], action: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="state must be"):
        derivative(np.ones(state), np.ones(action), M2_MINIBUS)
    with pytest.raises(ValueError, match="state must be"):
        lpv.matrices(np.ones(state), np.ones(action), M2_MINIBUS)


def test_derivative_broadcasts_over_columns() -> None:
    states, actions = random_inputs((-2.0, 30.0), 5)
    many = derivative(states, actions, M2_MINIBUS)
    for k in range(5):
        np.testing.assert_array_equal(
            many[:, k], derivative(states[:, k], actions[:, k], M2_MINIBUS)
        )
    held = derivative(states, actions[:, 0], M2_MINIBUS)
    np.testing.assert_array_equal(held[:, 0], many[:, 0])


# Low speed -----------------------------------------------------------------------------------


def test_inverse_speed_is_exact_from_low_speed_on() -> None:
    speed = np.linspace(LOW_SPEED, 40.0, 1000)
    np.testing.assert_allclose(bicycle.inverse_speed(speed), 1.0 / speed, rtol=1e-15)
    np.testing.assert_array_equal(bicycle.inverse_speed(-speed), bicycle.inverse_speed(speed))


@pytest.mark.parametrize("at", [0.0, LOW_SPEED, -LOW_SPEED])
def test_inverse_speed_has_two_continuous_derivatives(at: float) -> None:
    """One-sided difference quotients from left and right agree, and approach at first order."""
    q = bicycle.inverse_speed

    def sided(h: float) -> tuple[float, float]:
        """First and second derivative from one side, each exact to O(h^2) and O(h)."""
        first = (-3.0 * q(at) + 4.0 * q(at + h) - q(at + 2.0 * h)) / (2.0 * h)
        second = (q(at) - 2.0 * q(at + h) + q(at + 2.0 * h)) / h**2
        return first, second

    step = 1e-4
    assert abs(q(at + 1e-12) - q(at - 1e-12)) < 1e-11
    right, left = sided(step), sided(-step)
    # |q'''| is at most 9 here, so each quotient errs by at most 9 h^2 / 3 and by 9 h.
    assert abs(right[0] - left[0]) < 6.0 * step**2 + 1e-10
    assert abs(right[1] - left[1]) < 18.0 * step + 1e-7
    if at == LOW_SPEED:
        assert right[0] == pytest.approx(-1.0, abs=3.0 * step**2)
        assert right[1] == pytest.approx(2.0, abs=9.0 * step)


@PRESETS
@pytest.mark.parametrize("vx", [0.0, 1e-12, -1e-3, 0.5, -5.0, 40.0])
def test_field_is_finite_at_any_speed(car: VehicleParameters, vx: float) -> None:
    for vy, r, delta in [(0.0, 0.0, 0.0), (2.0, -1.0, 0.5), (-3.0, 2.0, -0.5)]:
        state, action = np.array([vx, vy, 0.3, r, 0.0, 0.0]), np.array([1.0, delta])
        assert np.isfinite(derivative(state, action, car)).all()
        assert all(np.isfinite(matrix).all() for matrix in lpv.matrices(state, action, car))


@PRESETS
def test_standstill_stays_and_lateral_motion_is_damped(car: VehicleParameters) -> None:
    rest = derivative(np.zeros(6), np.array([0.0, 0.4]), car)
    np.testing.assert_array_equal(rest, np.zeros(6))
    for vx in (-0.5, 0.0, 0.5):
        sliding = derivative(np.array([vx, 1.0, 0.0, 0.0, 0.0, 0.0]), np.zeros(2), car)
        turning = derivative(np.array([vx, 0.0, 0.0, 1.0, 0.0, 0.0]), np.zeros(2), car)
        assert sliding[1] < 0.0
        assert turning[3] < 0.0


# Derivatives ---------------------------------------------------------------------------------


@PRESETS
@pytest.mark.parametrize("vx", [-5.0, -1.0, -0.4, 0.0, 0.4, 1.0, 1.5, 20.0])
def test_casadi_jacobians_agree_with_differences(car: VehicleParameters, vx: float) -> None:
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    both = ca.vertcat(x, u)
    rate = bicycle.casadi_derivative(x, u, car)
    exact = np.array(ca.Function("j", [x, u], [ca.jacobian(rate, both)])(
        [vx, 0.4, 0.7, -0.3, 2.0, -1.0], [0.8, 0.25]
    ))  # fmt: skip
    point, step = np.array([vx, 0.4, 0.7, -0.3, 2.0, -1.0, 0.8, 0.25]), 1e-5
    differences = np.empty((6, 8))
    for k in range(8):
        high, low = point.copy(), point.copy()
        high[k] += step
        low[k] -= step
        rise = derivative(high[:6], high[6:], car) - derivative(low[:6], low[6:], car)
        differences[:, k] = rise / (2.0 * step)
    # Central differences err by h^2 f'''/6, f''' up to a few times the largest entry, and by
    # rounding eps |f| / h; across |vx| = 1, where f'' has a kink, by h f'''/4.
    largest = np.abs(exact).max()
    kink = step if abs(vx) == LOW_SPEED else 0.0
    np.testing.assert_allclose(differences, exact, rtol=0, atol=largest * (1e-9 + 5.0 * kink))


@PRESETS
def test_jacobian_is_casadis(car: VehicleParameters) -> None:
    """On arrays and compiled, also below 1 m/s, at standstill and in reverse."""
    states, actions = random_inputs((-10.0, 40.0), 2_000)
    states[0, :1000] = np.linspace(-1.2, 1.2, 1000)
    states[0, 1000:1003] = 0.0, LOW_SPEED, -LOW_SPEED
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    rate = bicycle.casadi_derivative(x, u, car)[[0, 1, 3]]
    by_state, by_action = ca.jacobian(rate, x), ca.jacobian(rate, u)
    wanted = ca.horzcat(by_state[:, [0, 1, 3]], by_action[:, 1])
    function = ca.Function("j", [x, u], [ca.vec(wanted.T), by_action[:, 0], by_state[:, [2, 4, 5]]])
    exact, by_acceleration, by_place = (
        np.array(value) for value in function.map(2_000)(states, actions)
    )
    # What the docstring leaves out as plain.
    np.testing.assert_array_equal(by_acceleration, np.outer([1.0, 0.0, 0.0], np.ones(2_000)))
    assert not by_place.any()
    vx, vy, _, r, _, _ = states
    delta, parameters = actions[1], car.as_array().tolist()
    ratio, bounded = np.minimum(np.abs(vx), LOW_SPEED), np.maximum(np.abs(vx), LOW_SPEED)
    slope = bicycle.inverse_speed_slope_polynomial(ratio / LOW_SPEED, bounded, vx)
    plain = bicycle.jacobian(
        vx, vy, r, delta, np.cos(delta), np.sin(delta), bicycle.inverse_speed(vx), slope,
        *parameters, parameters[4],
    )  # fmt: skip
    compiled = np.empty((12, 2_000))
    for k in range(2_000):
        one, angle = float(vx[k]), float(delta[k])
        compiled[:, k] = bicycle.compiled_jacobian(
            one, float(vy[k]), float(r[k]), angle, math.cos(angle), math.sin(angle),
            compiled_inverse_speed(one), bicycle.compiled_inverse_speed_slope(one), *parameters,
            parameters[4],
        )  # fmt: skip
    sizes = np.maximum(np.abs(exact), np.abs(exact).max(axis=1, keepdims=True) * 1e-3)
    assert_close(np.array(plain), exact, sizes)
    assert_close(compiled, exact, sizes)


def test_slope_of_the_inverse_speed_is_casadis() -> None:
    vx = np.concatenate([np.linspace(-3.0, 3.0, 401), [-40.0, -1e-12, 1e-12, 40.0]])
    symbol = ca.SX.sym("vx")
    value = bicycle.casadi_inverse_speed(symbol)
    function = ca.Function("slope", [symbol], [ca.jacobian(value, symbol)]).map(len(vx))
    compiled = [bicycle.compiled_inverse_speed_slope(one) for one in vx.tolist()]
    np.testing.assert_allclose(compiled, np.array(function(vx)).ravel(), rtol=1e-12, atol=1e-15)
    for one in (-7.0, -1.0, 1.0, 7.0):  # where q = 1/|vx|
        slope = bicycle.compiled_inverse_speed_slope(one)
        assert slope == pytest.approx(-math.copysign(1.0, one) / one**2, rel=1e-15)


# Independent physics -------------------------------------------------------------------------


def commonroad_parameters(car: VehicleParameters, front_share: float, height: float) -> object:
    """CommonRoad's single track with our masses and axles, and the sum of our stiffnesses.

    Its stiffness of an axle is proportional to the axle's load, so without load transfer only the
    neutral split Caf lf = Car lr exists; `height` and an acceleration shift load, and stiffness.
    """
    parameters_module = pytest.importorskip("vehiclemodels.parameters_vehicle2")
    theirs = parameters_module.parameters_vehicle2()
    total = car.front_cornering_stiffness + car.rear_cornering_stiffness
    theirs.m, theirs.I_z = car.mass, car.yaw_inertia
    theirs.a, theirs.b = car.front_axle_distance, car.rear_axle_distance
    theirs.h_s = height
    theirs.tire.p_dy1 = 1.0
    theirs.tire.p_ky1 = -total / (car.mass * GRAVITY)
    assert 0.0 < front_share < 1.0
    return theirs


def lateral_rates(
    car: VehicleParameters, speed: float, beta: float, r: float, delta: float
) -> tuple[float, float]:
    """Yaw acceleration and slip-angle rate of our field, the speed along the path held."""
    vx, vy = speed * math.cos(beta), speed * math.sin(beta)
    rate = derivative(np.array([vx, vy, 0.0, r, 0.0, 0.0]), np.array([0.0, delta]), car)
    return float(rate[3]), float((rate[1] * vx - rate[0] * vy) / speed**2)


@pytest.mark.parametrize("speed", [3.0, 10.0, 25.0])
@pytest.mark.parametrize("split", ["no load transfer", "preset's stiffnesses"])
@PRESETS
def test_lateral_dynamics_agree_with_commonroad(
    car: VehicleParameters, split: str, speed: float
) -> None:
    """CommonRoad's vehicle_dynamics_st: linear tyres, angles taken as small.

    Without load transfer (a = 0) our vehicle takes the neutral split that their model then has; at
    the preset's own stiffnesses a load shift (height times acceleration) brings theirs to ours.
    Both fields agree up to the sines and cosines that theirs drops, which are cubic in the angles:
    relatively (delta^2 + beta^2 + ...)/2 times the few terms added, 1e-5 at angles up to 1e-3, and
    a tenth of the angles must leave a thousandth of the difference.
    """
    dynamics = pytest.importorskip("vehiclemodels.vehicle_dynamics_st").vehicle_dynamics_st
    car = car.replace(rolling_resistance=0.0)
    wheelbase = car.wheelbase
    total = car.front_cornering_stiffness + car.rear_cornering_stiffness
    if split == "no load transfer":
        front = total * car.rear_axle_distance / wheelbase
        car = car.replace(front_cornering_stiffness=front, rear_cornering_stiffness=total - front)
    share = car.front_cornering_stiffness / total
    # Front load m (g lr - a h) / L is the share of the load, hence of the stiffness.
    shift = GRAVITY * (car.rear_axle_distance - share * wheelbase)
    acceleration = 0.0 if abs(shift) < 1e-12 else math.copysign(1.0, shift)
    theirs = commonroad_parameters(car, share, abs(shift))
    rng = np.random.default_rng(3)
    directions = rng.uniform(-1.0, 1.0, (200, 3))

    def differences(size: float) -> tuple[Array, Array]:
        ours, other = np.empty((200, 2)), np.empty((200, 2))
        for k, (beta, turn, delta) in enumerate(size * directions):
            r = turn * speed / wheelbase
            ours[k] = lateral_rates(car, speed, beta, r, delta)
            rates = dynamics([0.0, 0.0, delta, speed, 0.0, r, beta], [0.0, acceleration], theirs)
            other[k] = rates[5], rates[6]
        return np.abs(ours - other).max(axis=0), np.abs(other).max(axis=0)

    small, size = differences(1e-3)
    assert (small <= 1e-5 * size).all()
    large, _ = differences(1e-2)
    np.testing.assert_allclose(large / small, 1000.0, rtol=0.05)


# Integration ---------------------------------------------------------------------------------


def integrate(
    state: Array, action: tuple[float, float], car: VehicleParameters, h: float, steps: int
) -> Array:
    return np.array(kernels.integrate(*state.tolist(), *action, *car.as_array().tolist(), h, steps))


def exact(state: Array, action: tuple[float, float], car: VehicleParameters, time: float) -> Array:
    solution = solve_ivp(
        lambda _, x: derivative(x, np.array(action), car), (0.0, time), state,
        method="DOP853", rtol=1e-12, atol=1e-12,
    )  # fmt: skip
    assert solution.success
    return np.asarray(solution.y[:, -1])


@pytest.mark.parametrize(
    ("car", "state", "action"),
    [
        (M2_MINIBUS, [10.0, 0.3, 0.2, 0.3, 0.0, 0.0], (1.0, 0.1)),
        (COURSE_CAR, [6.0, -0.2, -1.0, 0.2, 5.0, 3.0], (-1.0, 0.2)),
        (M2_MINIBUS, [20.0, 0.5, 3.0, -0.2, 0.0, 0.0], (0.5, -0.03)),
    ],
)
def test_integration_is_of_order_four(
    car: VehicleParameters, state: list[float], action: tuple[float, float]
) -> None:
    start, time = np.array(state), 0.64
    wanted = exact(start, action, car, time)
    errors = [
        np.abs(integrate(start, action, car, time / n, n) - wanted).max() for n in (64, 128, 256)
    ]
    assert errors[-1] > 1e-11  # well above the reference's own error
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert ((slopes > 3.8) & (slopes < 4.2)).all(), slopes


def test_turning_the_heading_by_small_rotations_does_not_drift() -> None:
    """50 s on a circle in one call, against 1000 calls that take sine and cosine anew."""
    state = np.array([10.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    action = (0.7, 0.08)
    once = integrate(state, action, M2_MINIBUS, 0.005, 10_000)
    anew = state
    for _ in range(1000):
        anew = integrate(anew, action, M2_MINIBUS, 0.005, 10)
    assert abs(once[2]) > 4.0 * math.pi
    np.testing.assert_allclose(once, anew, rtol=0, atol=1e-10)
    np.testing.assert_allclose(anew, exact(state, action, M2_MINIBUS, 50.0), rtol=0, atol=1e-7)


@PRESETS
@pytest.mark.parametrize("vx", [0.0, 0.2, 0.5, 0.8, 1.0, 1.5, 3.0, 7.0, 15.0, 30.0])
def test_integration_is_stable_with_the_tasks_substep(car: VehicleParameters, vx: float) -> None:
    """A substep maps (vy, r) as Runge-Kutta's polynomial of the poles does, and contracts."""
    h = min(LONGEST_SUBSTEP, POLE_STEP / bicycle.fastest_pole(0.0, car))
    assert h * max(bicycle.fastest_pole(v, car) for v in np.linspace(0.0, 30.0, 301)) <= POLE_STEP
    hold = car.rolling_deceleration * vx * float(bicycle.inverse_speed(vx))
    tiny = 1e-6
    measured = np.empty((2, 2))
    for k, index in enumerate((1, 3)):
        state = np.array([vx, 0.0, 0.0, 0.0, 0.0, 0.0])
        state[index] = tiny
        measured[:, k] = integrate(state, (hold, 0.0), car, h, 1)[[1, 3]] / tiny
    block = lpv.matrices([vx, 0, 0, 0, 0, 0], [0.0, 0.0], car)[0][np.ix_((1, 3), (1, 3))]
    z = h * block
    eye = np.eye(2)
    polynomial = eye + z @ (eye + z @ (eye + z @ (eye + z / 4.0) / 3.0) / 2.0)
    # The field's quadratic terms, of relative size 1e-6, are all that the matrix leaves out.
    np.testing.assert_allclose(measured, polynomial, rtol=0, atol=1e-5)
    assert np.abs(np.linalg.eigvals(measured)).max() < 1.0
    kicked = integrate(np.array([vx, 0.2, 0.0, 0.2, 0.0, 0.0]), (hold, 0.0), car, h, round(5.0 / h))
    assert np.isfinite(kicked).all()
    assert np.abs(kicked[[1, 3]]).max() < 2e-3


@PRESETS
@pytest.mark.parametrize("vx", [0.0, 0.5, 1.0, 5.0, 30.0])
def test_integration_stays_bounded_at_full_lock(car: VehicleParameters, vx: float) -> None:
    h = min(LONGEST_SUBSTEP, POLE_STEP / bicycle.fastest_pole(0.0, car))
    state = np.array([vx, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(100):
        state = integrate(state, (0.5, car.max_steering_angle), car, h, 20)
        assert np.abs(state[:2]).max() < 60.0
        assert abs(state[3]) < 20.0


@PRESETS
def test_left_and_right_are_mirror_images_exactly(car: VehicleParameters) -> None:
    states, actions = random_inputs((-5.0, 30.0))
    there = derivative(states, actions, car)
    mirrored = derivative(MIRROR_STATE[:, None] * states, MIRROR_ACTION[:, None] * actions, car)
    np.testing.assert_array_equal(mirrored, MIRROR_STATE[:, None] * there)
    for state, (a, delta) in zip(states.T[:200], actions.T[:200], strict=True):
        left = integrate(state, (a, delta), car, 0.005, 10)
        right = integrate(MIRROR_STATE * state, (a, -delta), car, 0.005, 10)
        np.testing.assert_array_equal(right, MIRROR_STATE * left)


@PRESETS
def test_heading_and_position_do_not_enter_the_body_dynamics(car: VehicleParameters) -> None:
    states, actions = random_inputs((-5.0, 30.0), 100)
    moved = states.copy()
    moved[[2, 4, 5]] += 1.0
    np.testing.assert_array_equal(
        derivative(states, actions, car)[:4], derivative(moved, actions, car)[:4]
    )


def test_fastest_pole_is_that_of_the_lpv_block() -> None:
    for car in VEHICLES.values():
        for vx in (0.0, 1.0, 12.0):
            block = lpv.matrices([vx, 0, 0, 0, 0, 0], [0.0, 0.0], car)[0][np.ix_((1, 3), (1, 3))]
            wanted = np.abs(np.linalg.eigvals(block)).max()
            assert bicycle.fastest_pole(vx, car) == pytest.approx(wanted, rel=1e-12)
    # The figure that the design quotes for the course's car at 1 m/s.
    assert bicycle.fastest_pole(1.0, COURSE_CAR) == pytest.approx(133.0, abs=1.0)


def test_parameters_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        M2_MINIBUS.mass = 1.0  # type: ignore[misc]
