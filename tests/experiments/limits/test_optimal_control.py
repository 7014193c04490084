"""Optimal control of the brush bicycle against figures that can be had without it."""

import math

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

from experiments.limits import laps
from experiments.limits.optimal_control import (
    ControlProblem,
    Motion,
    Outcome,
    replay,
    replay_steps,
    steadied_replay,
)
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y, derivative, longest_substep
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import load
from trajectories import load as load_path

CAR = load("bmw-320i")


def sprint(friction: float, distance: float = 40.0, count: int = 160) -> Outcome:
    """Least time of a straight from 10 m/s, after an environment's start."""
    state = np.zeros((count + 1, 6))
    state[:, VX], state[:, X] = 10.0, np.linspace(0.0, distance, count + 1)
    guess = Motion(np.full(count, distance / count / 10.0), state, np.zeros((count, 2)))
    problem = ControlProblem(CAR, friction, guess, periodic=False)
    problem.lower[:, X] = problem.upper[:, X] = state[:, X]
    problem.lower[0] = np.where(np.arange(9) < 6, [*state[0], 0, 0, 0], problem.lower[0])
    problem.upper[0] = np.where(np.arange(9) < 6, [*state[0], 0, 0, 0], problem.upper[0])
    return problem.solve(ca.sum2(problem.steps))


def test_a_sprint_has_the_actuators_jerk_then_their_acceleration() -> None:
    outcome = sprint(0.9)
    assert outcome.solved
    motion = outcome.motion
    most = np.minimum(CAR.max_jerk * motion.time[1:], CAR.acceleration_range[1])
    np.testing.assert_allclose(motion.inputs[:, 0], most, atol=1e-3)
    np.testing.assert_allclose(motion.inputs[:, 1], 0.0, atol=1e-4)
    # 0.7 s of jerk 5 from 10 m/s: 7.286 m, 11.225 m/s; then 3.5 m/s^2 up to 40 m.
    ramp = 10.0 * 0.7 + 5.0 * 0.7**3 / 6.0
    then = (math.sqrt(11.225**2 + 2.0 * 3.5 * (40.0 - ramp)) - 11.225) / 3.5
    # Inputs are held over 20 ms: they lead the ramp by half of that.
    assert outcome.value == pytest.approx(0.7 + then, rel=3e-3)
    assert outcome.value < 0.7 + then


def test_traction_ends_at_its_share_of_the_friction() -> None:
    motion = sprint(0.2).motion
    gained = np.diff(motion.state[:, VX]) / motion.steps
    assert gained[-1] == pytest.approx(0.95 * 0.2 * GRAVITY, rel=1e-4)
    assert gained.max() <= 0.95 * 0.2 * GRAVITY * (1.0 + 1e-6)


def steady_turn(radius: float, friction: float) -> np.ndarray:
    """Fastest steady turn of the centre of gravity, by another solver: vx, vy, a, delta."""

    def speed(z: np.ndarray) -> float:
        return float(np.hypot(z[0], z[1]))

    def rates(z: np.ndarray) -> np.ndarray:
        state = np.array([z[0], z[1], 0.0, speed(z) / radius, 0.0, 0.0])
        return derivative(state, z[2:], CAR, friction)[[VX, VY, YAW_RATE]]

    best = minimize(
        lambda z: -speed(z),
        [0.9 * math.sqrt(friction * GRAVITY * radius), 0.0, CAR.wheelbase / radius, 0.1],
        method="SLSQP", constraints={"type": "eq", "fun": rates},
        options={"ftol": 1e-12, "maxiter": 500},
    )  # fmt: skip
    assert best.success, best.message
    return best.x


def test_a_lap_of_a_circle_is_the_fastest_steady_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(laps, "PERIOD", 0.2)
    path = load_path("circle")
    guess = laps.quasi_static(path, CAR, 0.9)
    outcome = laps.least_lap_time(path, CAR, 0.9, laps.INSIDE, guess)
    assert outcome.solved
    speed = path.length / outcome.value
    vx, vy, a, delta = steady_turn(30.0, 0.9)
    assert speed == pytest.approx(math.hypot(vx, vy), rel=1e-3)
    # The front axle slides: friction's mu g R by its load under the drive force that holds the
    # speed, by what that force leaves of the friction circle, and by the angle of its wheels.
    grip = 0.9 * GRAVITY
    load_share = 1.0 - CAR.centre_of_gravity_height * a / (GRAVITY * CAR.rear_axle_distance)
    share = load_share * math.sqrt(1.0 - (a / grip) ** 2) * math.cos(delta)
    along = vx / math.hypot(vx, vy)
    assert speed**2 * along == pytest.approx(share * grip * 30.0, rel=2e-3)


def test_a_replay_takes_the_environments_steps() -> None:
    outcome = sprint(0.9)
    motion = outcome.motion
    for again in (replay(motion, CAR, 0.9), steadied_replay(motion, CAR, 0.9)):
        steps = replay_steps(motion, CAR)
        assert again.steps.max() <= longest_substep(CAR) + 1e-9
        np.testing.assert_allclose(again.state[::steps], motion.state, atol=1e-5)
        np.testing.assert_allclose(again.inputs[::steps], motion.inputs, atol=1e-5)
        assert again.time[-1] == pytest.approx(outcome.value, abs=1e-9)
        assert again.state[-1, [VY, PSI, Y]] == pytest.approx(np.zeros(3), abs=1e-6)


def test_the_feedback_of_a_replay_leads_back() -> None:
    """From 1 cm beside the start, a sprint in open loop stays beside; steadied it comes back."""
    motion = sprint(0.9, distance=80.0).motion
    state = motion.state.copy()
    state[0, Y] = 0.01
    beside = Motion(motion.steps, state, motion.inputs)
    assert replay(beside, CAR, 0.9).state[-1, Y] == pytest.approx(0.01, abs=1e-6)
    # All nodes but the first are those of the sprint.
    assert abs(steadied_replay(beside, CAR, 0.9).state[-1, Y]) < 2e-3
