"""Agents that drive highway-env's own vehicle."""

from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("highway_env")

import agents
from lpv_track_env.highway.wrapper import HighwayTracking

CONTINUOUS = {"action": {"type": "ContinuousAction"}, "simulation_frequency": 30, "duration": 25}


def make(**config: Any) -> HighwayTracking:
    return HighwayTracking(gymnasium.make("racetrack-v1", config={**CONTINUOUS, **config}))


def drive(env: HighwayTracking, name: str, seed: int) -> list[dict[str, Any]]:
    agent = agents.make(name, env)
    observation, _ = env.reset(seed=seed)
    memory, start, infos = None, np.array([True]), []
    while True:
        assert env.observation_space.contains(observation)
        action, memory = agent.predict(observation, memory, episode_start=start)
        assert env.action_space.contains(action)
        start = np.array([False])
        observation, _, terminated, truncated, info = env.step(action)
        infos.append(info)
        if terminated or truncated:
            return infos


@pytest.mark.parametrize(
    ("name", "frequency", "bound"), [("lpv-nmpc", 5, 0.1), ("lpv-nmpc", 15, 0.03),
                                     ("stanley", 15, 0.2)]
)  # fmt: skip
def test_it_keeps_the_lane_of_highway_envs_vehicle(name: str, frequency: int, bound: float) -> None:
    env = make(policy_frequency=frequency, other_vehicles=4)
    infos = drive(env, name, seed=2)
    # Its clock adds up periods: one more, at times.
    assert len(infos) in (25 * frequency, 25 * frequency + 1)
    assert not infos[-1]["crashed"]
    assert env.highway.vehicle.on_road
    assert np.sqrt(np.mean([info["lateral_error"] ** 2 for info in infos])) < bound
    lane = env.highway.vehicle.lane.local_coordinates(env.highway.vehicle.position)[1]
    assert abs(lane) < 0.3


def test_where_there_is_no_throttle_it_steers_at_the_speed_it_has() -> None:
    action = {"type": "ContinuousAction", "longitudinal": False}
    env = make(action=action, policy_frequency=15, other_vehicles=0)
    infos = drive(env, "lpv-nmpc", seed=0)
    assert len(infos) in (25 * 15, 25 * 15 + 1)
    assert env.path.speed.min() == env.path.speed.max() == 10.0
    assert max(abs(info["lateral_error"]) for info in infos) < 0.3


def test_the_state_is_the_vehicles_and_moves_as_it_says() -> None:
    """A step of highway-env's vehicle agrees with the rates in the state."""
    env = make(policy_frequency=30, other_vehicles=0)
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.array([0.5, 0.08], dtype=np.float32))
    before = env.step(np.array([0.5, 0.08], dtype=np.float32))[4]["state"]
    after = env.step(np.array([0.5, 0.08], dtype=np.float32))[4]["state"]
    vx, vy, psi, r = before[:4]
    moved = np.array(
        [vx * np.cos(psi) - vy * np.sin(psi), vx * np.sin(psi) + vy * np.cos(psi), r]
    ) / 30.0  # fmt: skip
    np.testing.assert_allclose(after[[4, 5, 2]] - before[[4, 5, 2]], moved, rtol=1e-9, atol=1e-12)
    speed = env.highway.vehicle.speed
    assert np.hypot(after[0], after[1]) == pytest.approx(speed, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("racetrack-v1", {"action": {"type": "DiscreteAction"}}, "config={'action':"),
        ("roundabout-v1", {"action": {"type": "DiscreteMetaAction"}}, "must be continuous"),
    ],
)
def test_what_it_cannot_drive_is_told(name: str, config: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HighwayTracking(gymnasium.make(name, config=config))


def test_only_highway_envs_environments_can_be_wrapped() -> None:
    with pytest.raises(ValueError, match="CartPoleEnv is not an environment of highway-env"):
        HighwayTracking(gymnasium.make("CartPole-v1"))


def test_a_route_begins_where_the_vehicle_is() -> None:
    made = gymnasium.make("racetrack-v1", config=CONTINUOUS)
    assert not HighwayTracking(made, route=tuple("abcde")).path.closed
    with pytest.raises(ValueError, match="starts from 'a' to 'b': begin the route there"):
        HighwayTracking(made, route=tuple("bcde"))
