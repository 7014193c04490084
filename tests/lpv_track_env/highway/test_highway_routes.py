"""Paths from highway-env's lanes, compared with the lanes themselves."""

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("highway_env")

from highway_env.road.lane import CircularLane, StraightLane
from highway_env.road.road import RoadNetwork

from lpv_track_env.highway import routes, scenes
from trajectories import ReferencePath
from trajectories.speed import SpeedLimits

LIMITS = SpeedLimits(max_speed=10.0, max_lateral_acceleration=2.0, max_acceleration=1.5)


def network_of(name: str) -> RoadNetwork:
    return scenes.SCENES[name].make(None, {"type": "LidarObservation"}).road.network


def from_lanes(path: ReferencePath, network: RoadNetwork) -> np.ndarray[Any, Any]:
    """Distance of every node to the nearest of the route's centre lines, by highway-env."""
    lanes = [network.get_lane(tuple(index)) for index in path.metadata["route"]]
    found = []
    for x, y in zip(path.x, path.y, strict=True):
        apart = []
        for lane in lanes:
            s, r = lane.local_coordinates(np.array([x, y]))
            if -1.0 <= s <= lane.length + 1.0:
                apart.append(abs(r))
        # In the gap between two lanes there is none.
        found.append(min(apart, default=0.0))
    return np.array(found)


@pytest.mark.parametrize(("name", "lanes"), [("racetrack", 2), ("racetrack-oval", 3)])
def test_laps_pass_along_the_lanes_centres(name: str, lanes: int) -> None:
    network = network_of(name)
    for lane in range(lanes):
        path = scenes.path_of(scenes.SCENES[name], lane, LIMITS)
        assert path.closed
        assert path.speed.max() <= 10.0
        apart = from_lanes(path, network)
        # The lanes overlap by up to 2.6 m and turn by 5 degrees where they meet.
        assert np.sqrt(np.mean(apart**2)) < 0.06
        assert apart.max() < 0.3
        jumps = np.abs(np.diff(path.curvature)) / path.spacing
        assert jumps.max() < 0.03  # 1/m per m; the lanes' own curvature jumps by 0.07 at once


def test_the_middle_of_an_arc_has_its_radius() -> None:
    network = network_of("racetrack")
    path = scenes.path_of(scenes.SCENES["racetrack"], 1, LIMITS)
    for index in path.metadata["route"]:
        lane = network.get_lane(tuple(index))
        if not isinstance(lane, CircularLane) or lane.length < 30.0:
            continue
        s = path.project(*lane.position(0.5 * lane.length, 0.0)).arc_length
        curvature = lane.direction / lane.radius
        assert path.sample(s).curvature == pytest.approx(curvature, rel=0.06)


def test_a_roundabouts_route_takes_the_lanes_that_lead_on() -> None:
    scene = scenes.SCENES["roundabout"]
    path = scenes.path_of(scene, 0, LIMITS)
    assert not path.closed
    assert [index[2] for index in path.metadata["route"]] == [0, 0, 1, 1, 1, 0, 0]
    network = network_of("roundabout")
    for index in path.metadata["route"]:
        lane = network.get_lane(tuple(index))
        foot = path.project(*lane.position(0.5 * lane.length, 0.0))
        assert abs(foot.lateral_error) < 0.15


def test_the_road_ahead_ends_closes_or_must_be_chosen() -> None:
    assert routes.road_ahead(network_of("racetrack"), "a", "b") == tuple("abcdefghia")
    network = RoadNetwork()
    for begin, end, x in (("a", "b", 0.0), ("b", "c", 50.0)):
        network.add_lane(begin, end, StraightLane([x, 0.0], [x + 50.0, 0.0]))
    assert routes.road_ahead(network, "a", "b") == ("a", "b", "c")
    network.add_lane("b", "d", StraightLane([50.0, 0.0], [80.0, 30.0]))
    with pytest.raises(ValueError, match="branches at 'b' to c, d: give a route"):
        routes.road_ahead(network, "a", "b")
    network = RoadNetwork()
    for begin, end in (("a", "b"), ("b", "c"), ("c", "b")):
        network.add_lane(begin, end, StraightLane([0.0, 0.0], [50.0, 0.0]))
    with pytest.raises(ValueError, match="leads back to 'b'"):
        routes.road_ahead(network, "a", "b")


def test_routes_that_are_none() -> None:
    network = network_of("racetrack")
    with pytest.raises(ValueError, match="two nodes"):
        routes.lane_route(network, ("a",), 0)
    with pytest.raises(ValueError, match="no road from 'a' to 'c'; from 'a' leads: b"):
        routes.lane_route(network, ("a", "c"), 0)
    with pytest.raises(ValueError, match="lane must be 0 to 1 there, not 2"):
        routes.lane_route(network, ("a", "b"), 2)


def test_a_lanes_speed_limit_counts() -> None:
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0.0, 0.0], [100.0, 0.0], speed_limit=12.0))
    network.add_lane("b", "c", StraightLane([100.0, 0.0], [300.0, 0.0], speed_limit=6.0))
    limits = SpeedLimits(max_speed=20.0, max_lateral_acceleration=2.0, max_acceleration=1.5)
    path = routes.reference_path(
        network, routes.lane_route(network, ("a", "b", "c"), 0), limits, closed=False, name="x"
    )
    assert path.speed.max() == pytest.approx(6.0, abs=0.02)
    assert path.length == pytest.approx(300.0, abs=0.01)
    assert math.hypot(path.y.max(), path.y.min()) < 1e-6
