"""Stanley, pure pursuit, LQR and PID: contract, analytic answers, closed loops."""

import functools
import math

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import agents
import lpv_track_env  # noqa: F401  registers the environments
import trajectories
from agents.base import DrivingTask
from agents.classical.geometric import PurePursuit, Stanley
from agents.classical.lqr import LpvLqr, lateral_model
from agents.steady_turn import steady_turn
from lpv_track_env import bicycle
from lpv_track_env.vehicle import VEHICLES

NAMES = ("stanley", "pure-pursuit", "lqr", "pid")
each_agent = pytest.mark.parametrize("name", NAMES)


def environment(trajectory="T2", vehicle="m2-minibus", **arguments):
    return gymnasium.make(
        "lpv_track_env/PathTracking-v0", trajectory=trajectory, vehicle=vehicle, **arguments
    )


@functools.cache
def cached_agent(name):
    return agents.make(name, environment())


def blank(task: DrivingTask, **entries) -> np.ndarray:
    """A flat observation with the given entries; the others are 0."""
    row = np.zeros(task.layout.size, dtype=np.float32)
    for entry, value in entries.items():
        row[task.layout.slices[entry]] = value
    return row


def drive(agent, env, **options):
    """(n,) lateral errors, speed errors and steering angles, and how the episode ended."""
    observation, info = env.reset(seed=0, options=options)
    agent.reset()
    lateral, speed, steering = [], [], []
    while True:
        action, _ = agent.predict(observation)
        observation, _, terminated, truncated, info = env.step(action)
        lateral.append(info["lateral_error"])
        speed.append(info["speed_error"])
        steering.append(observation[4])
        if terminated or truncated:
            return np.array(lateral), np.array(speed), np.array(steering), info["end"]


def observations_along(env, agent, steps):
    """(steps, size): what the agent is given over the first steps of a drive, off the path."""
    observation, _ = env.reset(seed=0, options={"lateral_error": 0.3, "heading_error": -0.1})
    agent.reset()
    rows = []
    for _ in range(steps):
        rows.append(observation)
        observation = env.step(agent.predict(observation)[0])[0]
    return np.array(rows)


@each_agent
def test_actions_are_in_the_action_space_and_deterministic(name):
    env = environment()
    agent = agents.make(name, env)
    rows = observations_along(env, agent, 120)
    agent.reset()
    first = [agent.predict(row)[0] for row in rows]
    agent.reset()
    second = [agent.predict(row)[0] for row in rows]
    for one, other in zip(first, second, strict=True):
        assert one.dtype == np.float32
        assert env.action_space.contains(one)
        np.testing.assert_array_equal(one, other)


@each_agent
def test_a_batch_acts_as_its_rows(name):
    env = environment()
    agent = agents.make(name, env)
    rows = observations_along(env, agent, 40)
    order = np.array([3, 17, 8])  # three vehicles, each with its own history
    batch_state, states = None, [None] * 3
    agent.reset()
    begin = np.ones(3, dtype=bool)
    for k in range(20):
        batch, batch_state = agent.predict(rows[order + k], batch_state, begin)
        for j in range(3):
            alone, states[j] = agent.predict(rows[order[j] + k], states[j], begin[:1])
            np.testing.assert_array_equal(batch[j], alone)
        begin = np.zeros(3, dtype=bool)


@each_agent
def test_an_episode_start_clears_its_own_row_only(name):
    agent = agents.make(name, environment())
    row = blank(
        agent.task, longitudinal_speed=5.0, reference_speed=5.1, preview_speed=5.1,
        acceleration=0.3, lateral_error=0.1,
    )  # fmt: skip
    fresh, _ = agent.predict(row, None, np.array([True]))
    state = None
    for _ in range(30):
        _, state = agent.predict(np.stack([row, row]), state)
    actions, state = agent.predict(np.stack([row, row]), state, np.array([True, False]))
    np.testing.assert_array_equal(actions[0], fresh)
    assert not np.array_equal(actions[0], actions[1])


@each_agent
@pytest.mark.parametrize("trajectory", ["T3", "T1-raw"])
def test_a_mirrored_path_gives_mirrored_actions(name, trajectory):
    path = trajectories.load(trajectory)
    env, mirror = environment(path), environment(path.mirrored())
    agent, image = agents.make(name, env), agents.make(name, mirror)
    options = {"arc_length": 55.0, "lateral_error": 0.4, "heading_error": 0.1}
    observation, _ = env.reset(options=options)
    reflected, _ = mirror.reset(options={**options, "lateral_error": -0.4, "heading_error": -0.1})
    for _ in range(200):
        action, opposite = agent.predict(observation)[0], image.predict(reflected)[0]
        np.testing.assert_array_equal(action, opposite * np.array([1, -1], dtype=np.float32))
        observation, reflected = env.step(action)[0], mirror.step(opposite)[0]


@each_agent
@pytest.mark.parametrize("vehicle", list(VEHICLES))
def test_a_circle_leaves_no_steady_error(name, vehicle):
    env = environment("circle", vehicle)
    # The kart takes up a yaw rate within one control period: Stanley's damping of 0.1 s, times a
    # yaw rate of 7 1/s by steering angle at 7.7 m/s, would swing from period to period.
    settings = {"yaw_damping": 0.05} if (name, vehicle) == ("stanley", "kart") else {}
    lateral, speed, _, end = drive(agents.make(name, env, **settings), env)
    assert end == "finished"
    assert np.abs(lateral[-40:]).max() < 0.02
    assert np.abs(speed[-40:]).max() < 0.01


BOUNDS = {"stanley": 0.05, "pure-pursuit": 0.4, "lqr": 0.1, "pid": 0.05}


@each_agent
def test_t2_is_followed_closely_and_quietly(name):
    env = environment("T2")
    lateral, speed, steering, end = drive(agents.make(name, env), env)
    path, car = env.unwrapped.path, env.unwrapped.vehicle
    assert end == "finished"
    assert np.abs(lateral).max() < BOUNDS[name]
    # The profile begins with an acceleration that the actuator has to build up.
    assert np.abs(speed[60:-1]).max() < 0.05
    needed = path.curvature * (car.wheelbase + car.understeer_gradient * path.speed**2)
    assert np.abs(np.diff(steering)).sum() < 1.3 * np.abs(np.diff(needed)).sum()


@each_agent
def test_large_initial_errors_are_driven_off(name):
    env = environment("straight", "course-car")
    lateral, _, _, end = drive(
        agents.make(name, env), env, lateral_error=3.0, heading_error=0.5, speed_error=-3.0
    )
    assert end == "finished"
    assert np.abs(lateral[-20:]).max() < 0.05


@each_agent
@pytest.mark.parametrize("speed", [0.0, -2.0])
def test_a_vehicle_that_stands_or_rolls_back_sets_off(name, speed):
    reverses = VEHICLES["m2-minibus"].replace(speed_range=(-3.0, 30.0))
    env = environment("straight", "m2-minibus" if speed >= 0.0 else reverses, preview_steps=5)
    speed_error = speed - float(env.unwrapped.path.speed[0])
    lateral, speed_errors, _, end = drive(
        agents.make(name, env), env, speed_error=speed_error, lateral_error=0.5
    )
    assert end == "finished"
    assert np.abs(lateral[-10:]).max() < 0.05
    assert np.abs(speed_errors[-10:]).max() < 0.1


@each_agent
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_any_observation_gives_a_finite_action_in_bounds(name, data):
    agent = cached_agent(name)
    bound = agent.task.layout.bound
    shares = data.draw(
        hnp.arrays(
            np.float32,
            (3, bound.size),
            elements=st.sampled_from([-1.0, -0.01, 0.0, 0.01, 0.3, 1.0]),
        )
    )
    agent.reset()
    for row in shares * bound:
        action, state = agent.predict(row)
        assert np.isfinite(action).all()
        assert np.abs(action[1]) <= np.float32(agent.task.vehicle.max_steering_angle)
        fields = agent.task.layout.unpack(row)
        assert np.isfinite(agent.control(fields, state[0])).all()


@each_agent
@pytest.mark.parametrize("speed", [-5.0, -0.3, 0.0, 1e-6, 0.3])
def test_low_speeds_are_unexceptional(name, speed):
    agent = cached_agent(name)
    row = blank(
        agent.task, longitudinal_speed=speed, lateral_error=0.2, reference_speed=3.0,
        preview_speed=3.0, acceleration=0.2,
    )  # fmt: skip
    agent.reset()
    acceleration, steering = agent.predict(row)[0]
    assert acceleration > 0.5
    assert abs(steering) < 0.5


def test_stanley_on_a_straight_line_is_its_formula():
    env = environment("straight")
    agent = Stanley(DrivingTask.of(env), gain=2.0, softening_speed=1.5, yaw_damping=0.2)
    row = blank(
        agent.task, longitudinal_speed=6.0, reference_speed=6.0, preview_speed=6.0,
        lateral_error=0.5, heading_error=0.1, yaw_rate=-0.05,
    )  # fmt: skip
    front = 0.5 + agent.task.vehicle.front_axle_distance * math.sin(0.1)
    expected = -0.1 - math.atan(2.0 * front / (1.5 + 6.0)) + 0.2 * 0.05
    assert agent.predict(row)[0][1] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("curvature", [0.02, -0.08])
@pytest.mark.parametrize("reference_speed", [2.0, 8.0])
def test_pure_pursuit_on_a_circle_steers_its_curvature(curvature, reference_speed):
    # Zero error: centre of gravity on the circle, the heading turned by the sideslip there. The
    # preview is shorter than the lookahead at 2 m/s.
    agent = PurePursuit(DrivingTask.of(environment("circle")))
    vehicle = agent.task.vehicle
    turn = steady_turn(curvature, reference_speed, vehicle)
    row = blank(
        agent.task, longitudinal_speed=reference_speed, reference_speed=reference_speed,
        preview_speed=reference_speed, preview_curvature=curvature, heading_error=-turn.sideslip,
        yaw_rate=turn.yaw_rate,
    )  # fmt: skip
    rear_curvature = turn.yaw_rate / reference_speed
    expected = rear_curvature * (
        vehicle.wheelbase + vehicle.understeer_gradient * reference_speed**2
    )
    assert agent.predict(row)[0][1] == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("vehicle", list(VEHICLES))
@pytest.mark.parametrize("period", [0.02, 0.05, 0.1])
def test_lqr_stabilises_every_speed(vehicle, period):
    task = DrivingTask.of(environment("straight", vehicle, control_period=period))
    agent = LpvLqr(task)
    fastest = task.vehicle.speed_range[1]  # gains beyond it are those of the top speed
    for speed in np.concatenate([np.arange(-5.0, -0.4, 0.2), np.arange(0.5, fastest, 0.1)]):
        model = lateral_model(float(speed), period, task.vehicle)
        closed = model.A - model.B @ agent.gains(float(speed)).feedback[np.newaxis, :]
        assert np.abs(np.linalg.eigvals(closed)).max() < 1.0


def test_lateral_model_is_the_bicycle_near_straight_driving():
    car, period, speed = VEHICLES["m2-minibus"], 0.05, 7.0
    model = lateral_model(speed, period, car)
    small = 1e-4
    z = small * np.array([1.0, 2.0, -1.0, 3.0, 2.0])
    steps = 200
    state = np.array([speed, z[1], z[2], z[3], 0.0, z[0]])
    h = period / steps
    action = np.array([car.rolling_deceleration, z[4]])
    for _ in range(steps):
        middle = state + 0.5 * h * bicycle.derivative(state, action, car)
        state = state + h * bicycle.derivative(middle, action, car)
    reached = np.array([state[5], state[1], state[2], state[3], z[4]])
    np.testing.assert_allclose(model.A @ z, reached, atol=1e-7)


def test_lqr_preview_on_an_endless_circle_is_the_steady_turn():
    # The linear model's steady turn has to be a fixed point of the closed loop: u = 0 there.
    agent = cached_agent("lqr")
    car, speed, kappa = agent.task.vehicle, 6.0, 0.01
    gains = agent.gains(speed)
    lever = car.rear_axle_distance - car.mass * speed**2 * car.front_axle_distance / (
        car.wheelbase * car.rear_cornering_stiffness
    )
    steering = car.wheelbase + car.understeer_gradient * speed**2
    z = kappa * np.array([0.0, speed * lever, -lever, speed, steering])
    assert gains.feedback @ z + kappa * gains.preview.sum() == pytest.approx(0.0, abs=1e-9)
