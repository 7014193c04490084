"""Adaptive cruise control against hand calculation and highway-env's IDM; no collisions."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("highway_env")

from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

import trajectories
from lpv_track_env.highway import traffic
from lpv_track_env.highway.cruise import STANDSTILL, CruiseControl, Leader, lower_speed
from trajectories.table import SPEED, TIME

CRUISE = CruiseControl()
FRONT, HALF_WIDTH = 2.5, 1.0


def straight_road(lanes: int = 2) -> Road:
    network = RoadNetwork()
    for lane in range(lanes):
        network.add_lane("a", "b", StraightLane([0.0, 4.0 * lane], [200.0, 4.0 * lane]))
    return Road(network, np_random=np.random.default_rng(0))


def seen(others: Sequence[Any], s: float = 20.0) -> list[Leader]:
    path = trajectories.load("straight")
    return traffic.leaders(path, s, FRONT, HALF_WIDTH, others, CRUISE)


def test_at_its_own_gap_nothing_is_asked_for() -> None:
    for speed in (0.0, 3.0, 12.0):
        gap = CRUISE.standstill_gap + CRUISE.time_gap * speed
        assert CRUISE.response(speed, Leader(gap, speed)) == pytest.approx(0.0, abs=1e-12)
        assert CRUISE.response(speed, Leader(gap + 1.0, speed)) > 0.0
        assert CRUISE.response(speed, Leader(gap - 0.5, speed)) < 0.0


@pytest.mark.parametrize("speed", [2.0, 6.0, 9.5])
@pytest.mark.parametrize("ahead", [14.0, 25.0, 60.0])
@pytest.mark.parametrize("leads", [3.0, 6.0])
def test_the_response_is_that_of_highway_envs_idm(speed: float, ahead: float, leads: float) -> None:
    """highway-env's acceleration without its free-road term; it measures gaps between centres."""
    road = straight_road()
    own = IDMVehicle(road, [10.0, 0.0], 0.0, speed, target_speed=10.0)
    other = Vehicle(road, [10.0 + ahead, 0.0], 0.0, leads)
    cruise = CruiseControl(
        time_gap=own.TIME_WANTED, standstill_gap=own.DISTANCE_WANTED,
        acceleration=own.COMFORT_ACC_MAX, deceleration=-own.COMFORT_ACC_MIN, max_deceleration=1e3,
    )  # fmt: skip
    free = own.acceleration(own) - own.COMFORT_ACC_MAX
    expected = own.acceleration(own, front_vehicle=other) - free
    assert cruise.response(speed, Leader(ahead, leads)) == pytest.approx(expected, rel=1e-9)


@given(speed=st.floats(0.0, 15.0), leads=st.floats(0.0, 15.0), spare=st.floats(0.5, 60.0))
@settings(max_examples=150, deadline=None)
def test_nobody_is_hit_who_could_be_braked_for(speed: float, leads: float, spare: float) -> None:
    """No collision in 20 s of the profile, from any gap that allows braking at the bound."""
    approach = max(speed - leads, 0.0)
    gap = approach**2 / (2.0 * CRUISE.max_deceleration) + 0.05 * approach + spare
    places, speeds = CRUISE.profile(0.0, speed, [Leader(gap, leads)], 0.05, 400)
    gaps = gap + 0.05 * leads * np.arange(401) - places
    assert gaps.min() > 0.0
    assert speeds.min() >= 0.0
    assert (np.diff(places) >= 0.0).all()


def test_of_several_leaders_the_one_counts_that_asks_for_most() -> None:
    near, far = Leader(12.0, 8.0), Leader(40.0, 0.0)
    alone = CRUISE.profile(0.0, 8.0, [near], 0.05, 40)[1]
    both = CRUISE.profile(0.0, 8.0, [near, far], 0.05, 40)[1]
    assert (both <= alone + 1e-12).all()
    assert both[-1] < alone[-1]


@pytest.mark.parametrize(("name", "s"), [("T2", 100.0), ("T2", 505.0), ("circle", 180.0)])
def test_a_lowered_table_is_that_of_a_lowered_path(name: str, s: float) -> None:
    """Speeds are at most the path's, and times agree with the speeds."""
    path = trajectories.load(name)
    table = path.table.copy()
    at, speed = CRUISE.profile(s, 5.0, [Leader(15.0, 2.0)], 0.05, 60)
    lower_speed(path, table, at, speed)
    assert (table[:, SPEED] <= path.speed + 1e-12).all()
    same = np.arange(table.shape[1])
    np.testing.assert_array_equal(
        table[:, (same != SPEED) & (same != TIME)], path.table[:, (same != SPEED) & (same != TIME)]
    )
    slower = path.with_speed(np.maximum(table[:, SPEED], 0.05))
    np.testing.assert_allclose(table[:, TIME], slower.time, rtol=1e-12)
    if path.closed:
        assert table[0, SPEED] == table[-1, SPEED]
    middle = at[len(at) // 2]
    lowered = np.interp(middle % path.length, path.arc_length, table[:, SPEED])
    assert lowered == pytest.approx(min(speed[len(at) // 2], path.sample(middle).speed), abs=0.05)


def test_a_stop_stays_one() -> None:
    path = trajectories.load("straight")
    table = path.table.copy()
    at, speed = CRUISE.profile(50.0, 0.1, [Leader(1.0, 0.0)], 0.05, 60)
    lower_speed(path, table, at, speed)
    ahead = (path.arc_length > 50.0) & (path.arc_length < 149.0)
    assert (table[ahead, SPEED] == STANDSTILL).all()


@pytest.mark.parametrize("name", ["time_gap", "standstill_gap", "acceleration", "range"])
def test_settings_must_be_positive(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive and at most .*, not -1.0"):
        CruiseControl(**{name: -1.0})


def test_gap_and_speed_of_who_is_ahead_by_hand() -> None:
    road = straight_road()
    other = Vehicle(road, [60.0, 0.3], 0.0, 5.0)
    (leader,) = seen([other])
    # Centre to centre 40 m, less half its 5 m, less our front.
    assert leader.gap == pytest.approx(40.0 - 2.5 - FRONT, abs=0.13)
    assert leader.speed == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("x", "y", "heading", "speed", "counts"),
    [
        (60.0, 4.0, 0.0, 5.0, False),  # in the lane beside
        (60.0, 4.0, -0.3, 6.0, True),  # coming over from there
        (60.0, 4.0, 0.3, 6.0, False),  # leaving
        (60.0, 4.0, 0.0, 0.0, False),
        (10.0, 0.0, 0.0, 5.0, False),  # behind
        (150.0, 0.0, 0.0, 0.0, False),  # further than is watched
        (60.0, 2.3, 0.0, 5.0, True),  # half in the way: 0.3 m between the bodies
    ],
)
def test_who_is_in_the_way(x: float, y: float, heading: float, speed: float, counts: bool) -> None:
    other = Vehicle(straight_road(), [x, y], heading, speed)
    assert len(seen([other])) == int(counts)


def test_who_merges_gives_a_gap_to_keep() -> None:
    """A lane joins the path at 80 m; a vehicle on it is 30 m before the merge, as the ego is."""
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0.0, 0.0], [80.0, 0.0]))
    network.add_lane("c", "b", StraightLane([58.8, 21.2], [80.0, 0.0]))
    network.add_lane("b", "d", StraightLane([80.0, 0.0], [200.0, 0.0]))
    road = Road(network, np_random=np.random.default_rng(0))
    lane = network.get_lane(("c", "b", 0))
    for before in (15.0, 20.0, 29.9):
        place = lane.position(lane.length - before, 0.0)
        other = IDMVehicle(road, place, lane.heading_at(0.0), 10.0)
        (leader,) = seen([other], s=50.0)
        # It comes to the junction, 30 m ahead of us, when it will.
        arrives = leader.gap + 0.5 * other.LENGTH + FRONT + leader.speed * before / other.speed
        assert arrives == pytest.approx(30.0, abs=2.5)


def test_vehicles_are_foreseen_as_highway_env_foresees_them() -> None:
    """Compare with highway-env's prediction where it works: on roads with one lane."""
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0.0, 0.0], [50.0, 0.0]))
    network.add_lane("b", "c", StraightLane([50.0, 0.0], [80.0, 40.0]))
    road = Road(network, np_random=np.random.default_rng(0))
    other = IDMVehicle(road, [42.0, 0.0], 0.0, 9.0).plan_route_to("c")
    for time in (0.2, 0.75, 2.0):
        (position,), (heading,) = other.predict_trajectory_constant_speed([time])
        found, direction = traffic._along_lanes(other, other.speed * time)
        np.testing.assert_allclose(found, position, atol=1e-9)
        assert direction == pytest.approx(heading)


def test_bodies_that_are_no_vehicles_are_seen_too() -> None:
    body = SimpleNamespace(
        position=np.array([60.0, 0.0]), heading=0.0, velocity=np.zeros(2), LENGTH=2.0, WIDTH=2.0
    )
    (leader,) = seen([body])
    assert leader.speed == 0.0
