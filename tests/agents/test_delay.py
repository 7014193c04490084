"""Delay compensation: the near future that is shown is the one that comes."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import agents
from agents.base import DrivingTask
from agents.delay import DelayCompensated, NearFuture
from lpv_track_env.conditions import Actuation, Conditions
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.vector_env import PathTrackingVectorEnv

Array = NDArray[np.float64]

PERIOD = 0.05
NAMES = [name for name in agents.names() if name not in {"lpv-nmpc-ipopt", "lpv-mpc-frozen"}]


class Listener:
    """An agent that keeps what it was shown and drives by a script."""

    def __init__(self, task: DrivingTask, actions: Array) -> None:
        self.task, self.actions, self.shown = task, actions, []

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Array, Any]:  # fmt: skip
        del episode_start, deterministic
        self.shown.append(np.array(observation))
        action = self.actions[len(self.shown) - 1].astype(np.float32)
        return action, state

    def diagnostics(self, memory: Any) -> dict[str, Any]:  # noqa: ARG002
        return {"plan": np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])}


def gentle(steps: int) -> Array:
    k = np.arange(steps)
    return np.column_stack([0.2 + 0.3 * np.sin(0.15 * k), 0.05 * np.sin(0.1 * k)])


@pytest.mark.parametrize(
    ("trajectory", "given"),
    [
        # Commands that land after three periods, at once.
        ("T3", {"steering_dead_time": 0.15, "drive_dead_time": 0.15}),
        ("T2", {"computing_delay": 0.04, "steering_dead_time": 0.11, "drive_dead_time": 0.11}),
        # A lag counts like a dead time of its length for when, and as itself for how.
        ("T3", {"steering_dead_time": 0.05, "steering_lag": 0.1,
                "drive_dead_time": 0.1, "drive_lag": 0.05}),
    ],
)  # fmt: skip
def test_what_is_shown_is_what_comes(trajectory: str, given: dict[str, float]) -> None:
    """The same commands drive on: 0.15 s later the vehicle sees what its agent was shown."""
    env = PathTrackingEnv(
        trajectory, conditions=Conditions(estimator="truth", **given), preview_period=PERIOD
    )
    steps, later = 60, 3
    listener = Listener(DrivingTask.of(env), gentle(steps))
    agent = DelayCompensated(listener, listener.task, env.actuation)
    observation, _ = env.reset(seed=0, options={"arc_length": 40.0})
    seen, memory, start = [observation], None, np.array([True])
    for _ in range(steps):
        action, memory = agent.predict(observation, memory, start)
        start = np.array([False])
        observation, *_ = env.step(action)
        seen.append(observation)
    layout, k = env.layout, env.layout.preview_steps
    for step in range(10, steps - later):
        shown, came = layout.unpack(listener.shown[step]), layout.unpack(seen[step + later])
        # Until then the last command was in force on its way; what is sent now is not, with a lag.
        # Between two nodes the preview is an arc, and the path's curvature changes.
        tolerance = 2e-4 if "steering_lag" not in given else 5e-3
        for name in ("longitudinal_speed", "lateral_speed", "lateral_error", "heading_error"):
            wanted = float(getattr(came, name))
            assert float(getattr(shown, name)) == pytest.approx(wanted, abs=tolerance), name
        assert float(shown.reference_speed) == pytest.approx(float(came.reference_speed), abs=2e-3)
        # The last nodes lie beyond what was seen.
        inner = slice(0, k - 5)
        turned = PERIOD * np.cumsum(
            (shown.preview_curvature * shown.preview_speed)[inner]
            - (came.preview_curvature * came.preview_speed)[inner]
        )
        assert np.abs(turned).max() < 2e-3
        np.testing.assert_allclose(shown.preview_speed[inner], came.preview_speed[inner], atol=5e-3)
        # Rates are limited from the last command on.
        sent = listener.actions[step - 1]
        assert float(shown.acceleration) == pytest.approx(sent[0], abs=1e-6)
        assert float(shown.steering_angle) == pytest.approx(sent[1], abs=1e-6)


def test_it_slides_as_the_vehicle_does() -> None:
    """On a slippery road the vehicle ends where it was shown, not where linear tyres lead."""
    later, friction = 4, 0.2
    env = PathTrackingEnv(
        "circle", vehicle="bmw-320i", speed_mode="fixed", fixed_speed=12.0,
        conditions=Conditions(
            estimator="truth", friction=friction, steering_dead_time=0.2, drive_dead_time=0.2
        ),
    )  # fmt: skip
    task = DrivingTask.of(env)
    linear = NearFuture(dataclasses.replace(task, friction_range=(math.inf,) * 2), env.actuation)
    listener = Listener(task, np.zeros((0, 2)))
    agent = DelayCompensated(listener, task, env.actuation)
    observation, _ = env.reset(seed=0)
    first, k = np.array(env.actuators), np.arange(30)
    listener.actions = first + np.column_stack(
        [np.maximum(-0.1 * k, -1.0), np.minimum(0.004 * k, 0.08)]
    )
    states, gripping = [env.state], []
    memory, start = None, np.array([True])
    for step in range(30):
        if step:
            rows = observation[None].astype(np.float64)
            linear.predict(rows, np.array([False]), memory)
            gripping.append(rows[0])
        action, memory = agent.predict(observation, memory, start)
        start = np.array([False])
        observation, *_ = env.step(action)
        states.append(env.state)
    for step in range(1, 30 - later):
        came = states[step + later]
        shown = env.layout.unpack(listener.shown[step])
        # The prediction's 54 steps of 0.2 s are not the vehicle's 56, so that a command comes into
        # force up to half of one early or late: 0.1 m/s^2 or 0.004 rad for 2 ms.
        assert float(shown.longitudinal_speed) == pytest.approx(came[0], abs=5e-4)
        assert float(shown.lateral_speed) == pytest.approx(came[1], abs=5e-4)
        assert float(shown.yaw_rate) == pytest.approx(came[3], abs=5e-4)
    apart = env.layout.unpack(gripping[20]).yaw_rate - states[21 + later][3]
    assert abs(float(apart)) > 0.05


def test_without_delays_only_the_actuators_become_the_last_command() -> None:
    env = PathTrackingEnv("T2")
    listener = Listener(DrivingTask.of(env), gentle(20))
    agent = DelayCompensated(listener, listener.task, Actuation())
    observation, _ = env.reset(seed=0)
    memory, start = None, np.array([True])
    for _ in range(20):
        action, memory = agent.predict(observation, memory, start)
        start = np.array([False])
        np.testing.assert_allclose(listener.shown[-1], observation, atol=2e-6)
        observation, *_ = env.step(action)


def test_a_slower_drive_shows_as_an_error_of_speed() -> None:
    """Half a second of drive: what it has on its way is added to the speed at once."""
    env = PathTrackingEnv("straight", speed_mode="fixed", fixed_speed=10.0)
    hold = env.vehicle.rolling_deceleration
    actions = np.tile([hold + 0.3, 0.0], (12, 1))
    listener = Listener(DrivingTask.of(env), actions)
    agent = DelayCompensated(listener, listener.task, Actuation(drive_dead_time=0.5))
    observation, _ = env.reset(seed=0)
    shown = []
    memory, start = None, np.array([True])
    for _ in range(8):
        # The vehicle's own drive has not moved yet: the same observation every time.
        _, memory = agent.predict(observation, memory, start)
        start = np.array([False])
        shown.append(float(listener.shown[-1][0]))
    # Each command sent adds a period of 0.3 m/s^2 within the half second.
    gained = np.array(shown) - shown[0]
    assert shown[0] == pytest.approx(10.0, abs=1e-6)
    np.testing.assert_allclose(gained, 0.3 * PERIOD * np.arange(8), atol=1e-5)


def test_the_plan_is_moved_to_the_foot_point_that_is_seen() -> None:
    env = PathTrackingEnv("circle", conditions=Conditions(estimator="truth", computing_delay=0.1))
    listener = Listener(DrivingTask.of(env), gentle(3))
    agent = DelayCompensated(listener, listener.task, env.actuation)
    observation, _ = env.reset(seed=0)
    _, memory = agent.predict(observation, None, np.array([True]))
    plan = agent.diagnostics(memory[0])["plan"]
    foot = env.path.sample(float(env.state[0]) * 0.1)
    first = env.path.sample(0.0)
    dx, dy, c, s = foot.x - first.x, foot.y - first.y, np.cos(first.heading), np.sin(first.heading)
    assert plan[0] == pytest.approx([c * dx + s * dy, c * dy - s * dx], abs=5e-4)
    turn = float(foot.heading - first.heading)
    assert plan[1] - plan[0] == pytest.approx([np.cos(turn), np.sin(turn)], abs=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_batches_are_rows(name: str) -> None:
    """Three vehicles at once, one of them begun anew, as each by itself."""
    envs = PathTrackingVectorEnv(3, "T2", conditions="realtime", random_start=True)
    together = agents.make(name, envs.single)
    alone = [agents.make(name, envs.single) for _ in range(3)]
    observations, _ = envs.reset(seed=0)
    memory, memories = None, [None] * 3
    starts = np.ones(3, dtype=bool)
    for step in range(12):
        actions, memory = together.predict(observations, memory, starts)
        for row, agent in enumerate(alone):
            action, memories[row] = agent.predict(
                observations[row], memories[row], starts[row : row + 1]
            )
            np.testing.assert_array_equal(action, actions[row])
        starts = np.array([False, step == 5, False])
        observations, *_ = envs.step(actions)


@pytest.mark.parametrize("name", NAMES)
def test_made_where_there_are_delays(name: str) -> None:
    """Around an agent, or by one that does it itself."""

    def compensates(env: PathTrackingEnv, **settings: Any) -> bool:
        agent = agents.make(name, env, **settings)
        return getattr(agent, "future", None) is not None

    late, prompt = PathTrackingEnv("T2", conditions="realtime"), PathTrackingEnv("T2")
    assert compensates(late)
    assert not compensates(late, delay_compensation=False)
    assert not compensates(prompt)
    assert compensates(prompt, delay_compensation=True)


def test_what_is_not_finite_passes_through() -> None:
    env = PathTrackingEnv("T2", conditions="realtime")
    agent = agents.make("lpv-nmpc", env)
    observation, _ = env.reset(seed=0)
    action, memory = agent.predict(observation, None, np.array([True]))
    broken = observation.copy()
    broken[5] = np.nan
    action, memory = agent.predict(broken, memory, np.array([False]))
    assert np.isfinite(action).all()
    action, memory = agent.predict(observation, memory, np.array([False]))
    assert np.isfinite(action).all()
    assert agent.diagnostics(memory[0])["status"] == "SUCCESS"


def test_another_layout_is_refused() -> None:
    agent = agents.make("lpv-nmpc", PathTrackingEnv("T2", conditions="realtime"))
    other = PathTrackingEnv("T2", preview_steps=10)
    with pytest.raises(ValueError, match="make the agent for this environment"):
        agent.predict(other.reset(seed=0)[0])


def drive(seed: int, **settings: Any) -> tuple[str, float]:
    env = PathTrackingEnv("T2", conditions="realtime", time_limit=25.0)
    agent = agents.make("lpv-nmpc", env, **settings)
    observation, info = env.reset(seed=seed)
    memory, start, worst = None, np.array([True]), 0.0
    while not info["end"]:
        action, memory = agent.predict(observation, memory, start)
        start = np.array([False])
        observation, *_, info = env.step(action)
        worst = max(worst, abs(info["lateral_error"]))
    return info["end"], worst


def test_it_matters_and_it_helps() -> None:
    """The NMPC in real-time conditions: with it a decimetre, without it off the road."""
    for seed in range(3):
        end, worst = drive(seed)
        assert end == "time_limit"
        assert worst < 0.2
        assert drive(seed, delay_compensation=False)[0] == "left_corridor"
