"""`HighwayTrack-v0`: Gymnasium's and SB3's checks, agents that drive it, effects of traffic."""

import copy
import pickle
import subprocess
import sys
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

pytest.importorskip("highway_env")

from highway_env.road.lane import StraightLane
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

import agents
from lpv_track_env import HIGHWAY_TRACK
from lpv_track_env.bicycle import derivative
from lpv_track_env.highway.cruise import CruiseControl
from lpv_track_env.highway.env import HighwayTrackEnv
from lpv_track_env.highway.scenes import SCENES

FORMS = {
    "dictionary": {},
    "flat": {"flat": True},
    "kinematics": {"surroundings": "kinematics"},
    "configured": {"surroundings": {"type": "LidarObservation", "cells": 8}},
    "tracking": {"surroundings": None},
}


def make(**settings: Any) -> HighwayTrackEnv:
    env = gymnasium.make(HIGHWAY_TRACK, **settings).unwrapped
    assert isinstance(env, HighwayTrackEnv)
    return env


def straight_network(length: float = 300.0) -> RoadNetwork:
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0.0, 0.0], [length, 0.0], speed_limit=10.0))
    return network


def alone(**settings: Any) -> HighwayTrackEnv:
    """On a straight road without others."""
    return make(
        scene=straight_network(), route=("a", "b"), other_vehicles=0, surroundings=None, **settings
    )


def drive(env: HighwayTrackEnv, name: str = "lpv-nmpc", seed: int = 0) -> list[dict[str, Any]]:
    """Infos of a whole episode."""
    agent = agents.make(name, env)
    observation, _ = env.reset(seed=seed)
    return go_on(env, agent, observation)


def go_on(env: HighwayTrackEnv, agent: Any, observation: Any) -> list[dict[str, Any]]:
    memory, start, infos = None, np.array([True]), []
    while True:
        action, memory = agent.predict(observation, memory, episode_start=start)
        start = np.array([False])
        observation, _, terminated, truncated, info = env.step(action)
        infos.append(info)
        if terminated or truncated:
            return infos


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value.*")
@pytest.mark.filterwarnings("ignore:no display found")
def test_gymnasiums_and_sb3s_checks_pass(form: str) -> None:
    # Of one form with its pictures, a window without a display among them.
    check_env(make(**FORMS[form], render_mode="rgb_array"), skip_render_check=form != "dictionary")
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    # It would like actions within [-1, 1]; here they are SI units.
    sb3.check_env(make(**FORMS[form]), warn=False, skip_render_check=True)


@pytest.mark.parametrize("name", [name for name in SCENES if name != "racetrack-large"])
def test_every_scene_drives(name: str) -> None:
    env = make(scene=name)
    agent = agents.make("stanley", env)
    observation, _ = env.reset(seed=3)
    for _ in range(20):
        action, _ = agent.predict(observation)
        observation, _, terminated, _, info = env.step(action)
        assert not terminated
        assert abs(info["lateral_error"]) < 0.1
        assert env.observation_space.contains(observation)


@pytest.mark.parametrize("form", ["dictionary", "flat", "tracking"])
def test_what_surrounds_is_highway_envs_and_the_rest_path_trackings(form: str) -> None:
    env = make(**FORMS[form])
    observation, _ = env.reset(seed=5)
    tracking = env.layout.tracking_part(observation)
    assert tracking.shape == (env.layout.size,)
    view = env.layout.unpack(tracking)
    assert view.longitudinal_speed == pytest.approx(env.state[0], rel=1e-6)
    around = env.highway.observation_type.observe().astype(np.float32)
    if form == "dictionary":
        np.testing.assert_array_equal(observation["surroundings"], around)
    elif form == "flat":
        np.testing.assert_array_equal(observation[env.layout.size :], around.ravel())


@pytest.mark.parametrize("name", agents.names())
@pytest.mark.parametrize("form", ["dictionary", "flat"])
def test_every_agent_drives_it_unchanged(name: str, form: str) -> None:
    env = make(**FORMS[form])
    agent = agents.make(name, env)
    observation, _ = env.reset(seed=1)
    for _ in range(8):
        action, _ = agent.predict(observation)
        assert env.action_space.contains(action)
        observation, _, terminated, _, info = env.step(action)
        assert not terminated
    assert abs(info["lateral_error"]) < 0.2


def test_equal_seeds_give_equal_episodes_also_pickled() -> None:
    env = make(other_vehicles=5)

    def run(env: HighwayTrackEnv, first: int, last: int) -> list[Any]:
        seen = []
        for k in range(first, last):
            action = np.array([0.3, 0.02 * np.sin(0.2 * k)], dtype=np.float32)
            observation, reward, *_, info = env.step(action)
            places = [tuple(one.position) for one in env.others]
            around = tuple(observation["surroundings"].ravel())
            seen.append((around, reward, tuple(info["state"]), places))
        return seen

    env.reset(seed=11)
    whole = run(env, 0, 60)
    env.reset(seed=11)
    half = run(env, 0, 30)
    copies = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]  # noqa: S301  our own
    assert half + run(env, 30, 60) == whole
    for other in copies:
        assert run(other, 30, 60) == whole[30:]
    env.reset()
    assert run(env, 0, 10) != whole[:10]


def test_the_traffic_of_a_seed_is_highway_envs() -> None:
    config = {"other_vehicles": 6}
    own = gymnasium.make("racetrack-v1", config=config).unwrapped
    env = make(other_vehicles=6)
    for seed in range(4):
        own.reset(seed=seed)
        env.reset(seed=seed)
        theirs = [tuple(one.position) for one in own.road.vehicles if one is not own.vehicle]
        assert [tuple(one.position) for one in env.others] == theirs
        # The ego vehicle starts abreast of where theirs does, on its lane.
        assert np.hypot(*(env._ego.position - own.vehicle.position)) < 0.3


def test_the_traffic_sees_the_plant() -> None:
    env = make()
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.array([0.5, 0.05], dtype=np.float32))
    state, car, ego = env.state, env.vehicle, env._ego
    rates = derivative(state, np.zeros(2), car)
    np.testing.assert_allclose(ego.velocity, rates[4:], rtol=1e-12)
    ahead = 0.5 * (car.front_axle_distance - car.rear_axle_distance)
    heading = np.array([np.cos(state[2]), np.sin(state[2])])
    np.testing.assert_allclose(ego.position - ahead * heading, state[4:], rtol=1e-12)
    assert (car.length, car.width) == (ego.LENGTH, ego.WIDTH)


@pytest.mark.parametrize("seed", [0, 4])
def test_a_lap_among_traffic(seed: int) -> None:
    infos = drive(make(other_vehicles=8, surroundings=None), seed=seed)
    assert infos[-1]["end"] == "finished"
    assert not any(info["collision"] for info in infos)
    assert np.sqrt(np.mean([info["lateral_error"] ** 2 for info in infos])) < 0.02
    # Against highway-env's own lane, whose pieces do not join.
    assert np.sqrt(np.mean([info["lane_error"] ** 2 for info in infos])) < 0.1
    assert min(info["gap"] for info in infos) > 2.0


def test_laps_are_counted_from_the_start() -> None:
    env = make(scene="racetrack-oval", other_vehicles=0, surroundings=None, laps=2)
    assert env.reset(seed=2)[1]["gap"] == np.inf
    begin = env.reset(seed=2)[1]["arc_length"]
    infos = drive(env, "stanley", seed=2)
    assert infos[-1]["end"] == "finished"
    assert infos[-1]["arc_length"] - begin == pytest.approx(2.0 * env.path.length, abs=0.6)


@pytest.mark.parametrize("name", ["lpv-nmpc", "stanley", "pure-pursuit"])
@pytest.mark.parametrize("body", [Vehicle, Obstacle])
def test_it_stops_behind_what_stands(name: str, body: type) -> None:
    env = alone(time_limit=30.0)
    agent = agents.make(name, env)
    observation, _ = env.reset(seed=0, options={"arc_length": 40.0})
    road = env.highway.road
    (road.vehicles if body is Vehicle else road.objects).append(body(road, [130.0, 0.0]))
    infos = go_on(env, agent, observation)
    assert infos[-1]["end"] == "time_limit"
    assert not infos[-1]["collision"]
    assert abs(infos[-1]["state"][0]) < 0.05
    assert 2.0 < infos[-1]["gap"] < CruiseControl().standstill_gap + 1.0
    assert infos[-1]["leader_speed"] == 0.0
    # Comfortably, as far as its jerk lets it: never harder than the reference may.
    assert np.diff([info["state"][0] for info in infos]).min() / 0.05 > -4.2


def test_a_collision_ends_the_episode_and_is_paid_for() -> None:
    env = alone(cruise=None)
    agent = agents.make("stanley", env)
    observation, _ = env.reset(seed=0, options={"arc_length": 40.0})
    env.highway.road.vehicles.append(Vehicle(env.highway.road, [80.0, 0.0]))
    info = go_on(env, agent, observation)[-1]
    assert info["end"] == "collision"
    assert info["collision"]
    assert info["reward_end"] == -env.task.reward_weights.end
    # Bumper to bumper, to the way of a period.
    assert -0.6 < info["gap"] < 0.1
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, dtype=np.float32))
    assert not env.reset(seed=0)[1]["collision"]


def test_it_keeps_its_gap_to_who_drives() -> None:
    env = alone(time_limit=25.0)
    agent = agents.make("lpv-nmpc", env)
    observation, _ = env.reset(seed=0, options={"arc_length": 20.0})
    road = env.highway.road
    road.vehicles.append(Vehicle(road, [60.0, 0.0], 0.0, 6.0))
    infos = go_on(env, agent, observation)
    settled = infos[-20:]
    cruise = CruiseControl()
    for info in settled:
        assert info["state"][0] == pytest.approx(6.0, abs=0.15)
        assert info["gap"] == pytest.approx(cruise.standstill_gap + 6.0 * cruise.time_gap, abs=0.8)


def test_what_is_refused_leaves_the_traffic_where_it_is() -> None:
    env = make(other_vehicles=5)
    env.reset(seed=0)
    before = [tuple(one.position) for one in env.others]
    for action in (np.array([np.nan, 0.0], np.float32), np.zeros(3, np.float32), "x"):
        with pytest.raises(ValueError, match="action"):
            env.step(action)
    assert [tuple(one.position) for one in env.others] == before


def test_longer_control_periods_move_the_traffic_in_steps_of_highway_envs() -> None:
    env, fine = make(control_period=0.2), make(control_period=0.05)
    for each, steps in ((env, 10), (fine, 40)):
        each.reset(seed=0)
        for _ in range(steps):
            each.step(np.zeros(2, dtype=np.float32))
    for one, other in zip(env.others, fine.others, strict=True):
        assert np.hypot(*(one.position - other.position)) < 0.3


def test_conditions_and_plants_are_path_trackings() -> None:
    env = make(conditions="realtime", surroundings=None, other_vehicles=3)
    infos = drive(env, seed=1)
    assert infos[-1]["end"] == "finished"
    assert "estimate" in infos[0]
    assert max(abs(info["lateral_error"]) for info in infos) < 0.5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scene": "racetrak"}, "nearest: racetrack"),
        ({"surroundings": "radar"}, "unknown surroundings 'radar'"),
        ({"scene": "roundabout", "other_vehicles": 3}, "own number of other vehicles"),
        ({"other_vehicles": -1}, "other_vehicles must be a whole number"),
        (
            {"scene": "roundabout", "laps": 2},
            "laps must be exactly 1 on an open route",
        ),
        ({"scene": straight_network()}, "needs a route"),
        ({"scene": straight_network(), "route": ("a", "c")}, "no road from 'a' to 'c'"),
        ({"route": ("a", "c")}, "no road from 'a' to 'c'"),
    ],
)
def test_what_makes_no_sense_is_told_in_one_line(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        make(**settings)
    assert "\n" not in str(caught.value)


def test_a_path_is_no_option_of_reset() -> None:
    env = make()
    with pytest.raises(ValueError, match="unknown reset option 'trajectory'"):
        env.reset(options={"trajectory": "T1"})


def test_a_reset_that_is_refused_leaves_no_half_episode() -> None:
    env = make(other_vehicles=5)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="lateral_error must be in"):
        env.reset(seed=1, options={"lateral_error": np.nan})
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, dtype=np.float32))
    assert abs(env.reset(seed=1)[1]["lateral_error"]) < 1e-9


def test_frames_show_road_and_traffic() -> None:
    def frames(seed: int) -> list[np.ndarray[Any, Any]]:
        env = make(other_vehicles=8, render_mode="rgb_array")
        env.reset(seed=seed)
        shots = [env.render()]
        for _ in range(6):
            env.step(np.array([0.5, 0.02], dtype=np.float32))
            shots.append(env.render())
        for _ in range(2):  # the second without the others
            shots.append(env.render())
            env._renderer.others = None
        env.close()
        return shots

    shots = frames(1)
    assert all(shot.shape == (600, 900, 3) and shot.mean() > 0 for shot in shots)
    assert all((a != b).any() for a, b in pairwise(shots[:7]))
    assert all((a == b).all() for a, b in zip(shots, frames(1), strict=True))
    assert any((a != b).any() for a, b in zip(shots, frames(2), strict=True))
    assert (shots[-2] != shots[-1]).any()


def test_without_highway_env_one_line_names_the_extra() -> None:
    text = (
        "import sys; sys.modules['highway_env'] = None\n"
        "import gymnasium, lpv_track_env\n"
        f"gymnasium.make({HIGHWAY_TRACK!r})"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.endswith("highway-env is not installed: pip install 'lpv-track-env[highway]'")


@pytest.mark.parametrize("speed", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("name", ["lpv-nmpc", "lpv-nmpc-ipopt"])
def test_the_nmpc_creeps_where_its_vehicle_may_stop(name: str, speed: float) -> None:
    """The model must be stable at standstill: with longer steps the vehicle drove backwards."""
    car = alone().vehicle
    assert car.speed_range[0] == 0.0
    env = gymnasium.make(
        "lpv_track_env/PathTracking-v0", trajectory="straight", vehicle=car,
        speed_mode="fixed", fixed_speed=speed, time_limit=8.0,
    )  # fmt: skip
    agent = agents.make(name, env)
    observation, _ = env.reset(options={"speed_error": -speed, "lateral_error": 0.05})
    speeds, memory = [], None
    for _ in range(160):
        action, memory = agent.predict(observation, memory)
        observation, *_, info = env.step(action)
        speeds.append(info["state"][0])
    assert min(speeds) > -1e-3
    # The weight on a, which rolling resistance needs, costs about 1 cm/s of speed.
    assert speeds[-1] == pytest.approx(speed, abs=0.02)
    assert abs(speeds[-1] - speeds[-40]) < 1e-3
