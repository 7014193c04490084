"""Tyres of limited friction: their law, the backends, the LPV form, limits, integration."""

import math

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from lpv_track_env import bicycle, lpv, tyres
from lpv_track_env.bicycle import (
    VX,
    VY,
    YAW_RATE,
    derivative,
    inverse_speed,
    longest_substep,
)  # fmt: skip
from lpv_track_env.integration import integrate, integrate_sliding, integrate_with
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import BMW_320I, M2_MINIBUS, VEHICLES, VehicleParameters

Array = NDArray[np.float64]

PRESETS = pytest.mark.parametrize("car", VEHICLES.values(), ids=list(VEHICLES))
FRICTIONS = (0.05, 0.3, 0.8, 1.05, 3.0, math.inf)
MIRROR_STATE, MIRROR_INPUT = np.array([1, -1, -1, -1, 1, -1]), np.array([1, -1])


def drawn(count: int, seed: int = 0) -> tuple[Array, Array]:
    """States (6, count) and inputs (2, count): rolling, sliding, braking, standing, in reverse."""
    rng = np.random.default_rng(seed)
    states = rng.uniform([-10, -5, -4, -2, -50, -50], [40, 5, 4, 2, 50, 50], (count, 6)).T
    inputs = rng.uniform([-12.0, -0.6], [12.0, 0.6], (count, 2)).T
    states[VX, : count // 4] = rng.uniform(-1.2, 1.2, count // 4)
    states[VX, :3] = 0.0, 1.0, -1.0
    states[VY : VY + 1, ::2] *= 0.02
    inputs[:, ::3] *= 0.05
    return states, inputs


def forces(
    states: Array, inputs: Array, car: VehicleParameters, friction: float
) -> tuple[Array, Array, Array]:
    """Acceleration followed (m/s^2) and side force of both axles (N)."""
    vx, vy, _, r, _, _ = states
    a, delta = inputs
    q = inverse_speed(vx)
    share, numbers = tyres.scheduled(
        (vx, vy, r), (a, delta), q, car, friction, np.minimum, np.maximum
    )
    _, _, lf, lr, caf, car_, _ = numbers
    front, rear = tyres.slips(vx, vy, r, delta, q, lf, lr)
    return np.broadcast_arrays(a * share, caf * front, car_ * rear)


def test_side_force_is_the_brush_models() -> None:
    """Against the integral over a contact patch with parabolic pressure."""
    stiffness, limit = 80000.0, 9000.0
    for slip in (-0.4, -0.1, 1e-4, 0.05, 0.2, 0.33, 0.35, 1.0):
        # Bristles along the patch, s from 0 to 1: deflection slip * s sticks up to the friction.
        s = (np.arange(200000) + 0.5) / 200000
        sticking = 2.0 * stiffness * abs(slip) * s
        friction = limit * 6.0 * s * (1.0 - s)
        # From the leading edge on (s = 0) they stick until friction is used up, then all slide.
        slides = np.cumsum(sticking > friction) > 0
        force = np.where(slides, friction, sticking).mean()
        found = tyres.secant(stiffness, stiffness / (3.0 * limit), slip) * abs(slip)
        assert found == pytest.approx(force, rel=2e-4)


@PRESETS
@pytest.mark.parametrize("friction", FRICTIONS)
def test_lpv_form_equals_the_field(car: VehicleParameters, friction: float) -> None:
    states, inputs = drawn(400)
    for x, u in zip(states.T, inputs.T, strict=True):
        wanted = derivative(x, u, car, friction)
        a_matrix, b_matrix = lpv.matrices(x, u, car, friction)
        size = np.abs(a_matrix) @ np.abs(x) + np.abs(b_matrix) @ np.abs(u)
        assert (np.abs(a_matrix @ x + b_matrix @ u - wanted) <= 1e-12 * size + 1e-300).all()


@PRESETS
@pytest.mark.parametrize("friction", FRICTIONS)
def test_arrays_and_symbols_agree(car: VehicleParameters, friction: float) -> None:
    states, inputs = drawn(1000)
    wanted = derivative(states, inputs, car, friction)
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    a_matrix, b_matrix = lpv.casadi_matrices(x, u, car, friction)
    for field in (
        bicycle.casadi_derivative(x, u, car, friction),
        ca.mtimes(a_matrix, x) + ca.mtimes(b_matrix, u),
    ):
        found = np.array(ca.Function("f", [x, u], [field]).map(1000)(states, inputs))
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-9)


@PRESETS
@pytest.mark.parametrize("friction", [0.05, 0.8, 1.05, 3.0])
def test_compiled_steps_are_runge_kuttas_of_the_field(
    car: VehicleParameters, friction: float
) -> None:
    states, inputs = drawn(200)
    # (The rotation over one step is a Taylor series for small angles.)
    h = 0.002
    tyre = tyre_of(car, friction)
    k1 = derivative(states, inputs, car, friction)
    k2 = derivative(states + 0.5 * h * k1, inputs, car, friction)
    k3 = derivative(states + 0.5 * h * k2, inputs, car, friction)
    k4 = derivative(states + h * k3, inputs, car, friction)
    wanted = states + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    found = np.array(
        [
            integrate_sliding(*x.tolist(), *u.tolist(), *car.as_array().tolist(), tyre, h, 1)
            for x, u in zip(states.T, inputs.T, strict=True)
        ]
    ).T
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


def tyre_of(car: VehicleParameters, friction: float) -> tuple[float, ...]:
    mass, _, lf, lr, caf, rear, _ = car.as_array().tolist()
    height = car.centre_of_gravity_height
    found: tuple[float, ...] = tyres.compiled_constants(friction, height, mass, lf, lr, caf, rear)
    return found


@PRESETS
@pytest.mark.parametrize("friction", FRICTIONS)
def test_mirrored_motion_has_mirrored_forces(car: VehicleParameters, friction: float) -> None:
    states, inputs = drawn(1000)
    states[[2, 4, 5]] = 0.0
    left = derivative(states, inputs, car, friction)
    right = derivative(
        MIRROR_STATE[:, None] * states, MIRROR_INPUT[:, None] * inputs, car, friction
    )
    np.testing.assert_array_equal(right, MIRROR_STATE[:, None] * left)


@PRESETS
@pytest.mark.parametrize("friction", FRICTIONS[:-1])
def test_forces_stay_within_the_ellipse(car: VehicleParameters, friction: float) -> None:
    """For each axle, under its load; in all at most mu m g; and the limits are reached."""
    states, inputs = drawn(20_000)
    states[VY, 100:1000] *= 1e3
    inputs[0, 1000:2000] *= 1e6
    ax, front, rear = forces(states, inputs, car, friction)
    lf, lr, h = car.front_axle_distance, car.rear_axle_distance, car.centre_of_gravity_height
    weight = car.mass / car.wheelbase
    loads = weight * (GRAVITY * lr - h * ax), weight * (GRAVITY * lf + h * ax)
    used = []
    for load, force in zip(loads, (front, rear), strict=True):
        assert (load >= 0.099 * weight * GRAVITY * min(lf, lr)).all()
        along = load / GRAVITY * ax
        used.append(np.hypot(along, force) / (friction * load))
        assert used[-1].max() <= 1.0 + 1e-12
    assert max(part.max() for part in used) == pytest.approx(1.0, abs=1e-9)
    total = np.hypot(ax, (np.abs(front) + np.abs(rear)) / car.mass)
    assert total.max() <= friction * GRAVITY * (1.0 + 1e-12)
    assert np.abs(ax).max() <= tyres.LONGITUDINAL_SHARE * friction * GRAVITY * (1.0 + 1e-12)


def test_loads_decide_which_axle_slides_first() -> None:
    """At equal slip, braking gives force to the front axle and takes it from the rear."""
    states, steer = np.array([[15.0, -0.9, 0.0, 0.0, 0.0, 0.0]]).T, 0.0
    for a, heavier in ((-4.0, True), (3.0, False)):
        _, front, rear = forces(states, np.array([[a, steer]]).T, BMW_320I, 0.8)
        per_load = [
            force[0] * BMW_320I.wheelbase / (BMW_320I.mass * GRAVITY * arm)
            for force, arm in (
                (front, BMW_320I.rear_axle_distance), (rear, BMW_320I.front_axle_distance)
            )
        ]  # fmt: skip
        assert bool(per_load[0] > 1.1 * per_load[1]) is heavier
        assert bool(per_load[1] > 1.1 * per_load[0]) is not heavier


@PRESETS
def test_without_bound_on_friction_the_tyre_is_linear(car: VehicleParameters) -> None:
    states, inputs = drawn(1000)
    inputs[0] *= 0.4  # below what lifts an axle
    linear = derivative(states, inputs, car)
    np.testing.assert_array_equal(derivative(states, inputs, car, math.inf), linear)
    errors = [np.abs(derivative(states, inputs, car, mu) - linear).max() for mu in (1e4, 1e5, 1e6)]
    assert errors[1] == pytest.approx(0.1 * errors[0], rel=0.05)
    assert errors[2] == pytest.approx(0.01 * errors[0], rel=0.05)


@PRESETS
@pytest.mark.parametrize("friction", [0.05, 0.8, 1.05])
def test_forces_are_continuously_differentiable(car: VehicleParameters, friction: float) -> None:
    """CasADi's Jacobian on both sides of each switch: knee, full command, full sliding, zero."""
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    rate = bicycle.casadi_derivative(x, u, car, friction)
    jacobian = ca.Function("j", [x, u], [ca.jacobian(rate, ca.vertcat(x, u))])
    a_max, grip, nf, nr, tf, tr = tyre_of(car, friction)
    state, tiny = np.array([10.0, 0.3, 0.0, 0.1, 0.0, 0.0]), 1e-9

    def jump(before: Array, after: Array) -> float:
        values = [np.array(jacobian(state * [1, v, 1, 1, 1, 1], [a, d])) for v, a, d in
                  (before, after)]  # fmt: skip
        scale = np.abs(values[0]).max()
        return float(np.abs(values[1] - values[0]).max() / scale)

    sharp, _ = tyres.sharpness(0.0, grip, nf, nr, tf, tr)
    rolling = (0.3 + car.front_axle_distance * 0.1) / 10.0
    for centre in (
        (1.0, tyres.KNEE * a_max, 0.05), (1.0, -tyres.FULL * a_max, 0.05), (1.0, 0.0, 0.05),
        (1.0, 0.0, rolling), (1.0, 0.0, rolling + 1.0 / sharp), (1.0, 0.0, rolling - 1.0 / sharp),
    ):  # fmt: skip
        step = np.array([0.0, tiny * a_max, tiny])
        assert jump(np.array(centre) - step, np.array(centre) + step) <= 1e-5


@PRESETS
@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_integration_converges(car: VehicleParameters, friction: float) -> None:
    """A swerve under braking that slides: at the environment's steps, 0.1 mm over a second.

    From 20 m/s, or what corresponds to that at the size of a small vehicle (Froude).
    """
    tyre, parameters = tyre_of(car, friction), car.as_array().tolist()
    state = [20.0 * math.sqrt(min(car.wheelbase / 2.0, 1.0)), 0.0, 0.0, 0.0, 0.0, 0.0]

    def swerve(steps: int) -> Array:
        now = state
        for k in range(10):
            now = integrate_sliding(
                *now, -2.0, 0.15 * math.sin(k), *parameters, tyre, 0.1 / steps, steps
            )
        return np.array(now)

    own = math.ceil(0.1 / longest_substep(car))
    exact = swerve(100 * own)
    errors = [float(np.abs(swerve(steps) - exact).max()) for steps in (own // 2, own, 2 * own)]
    assert errors[1] <= 1e-4
    assert errors[2] <= 0.35 * errors[0]
    slid = integrate(*state, -2.0, 0.15, *parameters, 0.005, 20)
    assert abs(slid[YAW_RATE]) > 0.0


@PRESETS
def test_integration_follows_the_friction_bit_for_bit(car: VehicleParameters) -> None:
    states, inputs = drawn(200, seed=3)
    parameters = car.as_array().tolist()
    for x, u in zip(states.T.tolist(), inputs.T.tolist(), strict=True):
        tyre = tyres.of(car, math.inf)
        found = integrate_with(*x, *u, *parameters, tyre, 0.005, 4, 0.0)
        assert found == integrate(*x, *u, *parameters, 0.005, 4, 0.0)
        tyre = tyres.of(car, 0.6)
        found = integrate_with(*x, *u, *parameters, tyre, 0.005, 4, 0.0)
        assert found == integrate_sliding(*x, *u, *parameters, tyre, 0.005, 4, 0.0)


def test_wild_states_and_any_friction_stay_finite() -> None:
    rng = np.random.default_rng(4)
    for friction in (0.001, 0.05, 1.0, 50.0, 1e6):
        for size in (1.0, 1e3, 1e9):
            states = rng.normal(0.0, size, (6, 500))
            inputs = rng.normal(0.0, size, (2, 500))
            assert np.isfinite(derivative(states, inputs, M2_MINIBUS, friction)).all()
