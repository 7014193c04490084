"""References planned by grip: analytic answers, the axles' limits, vehicles and friction."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

import lpv_track_env  # noqa: F401  registers the environments
from lpv_track_env import tyres, vehicle
from lpv_track_env.bicycle import field
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.reference import grip_limits
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath, SpeedLimits, load, shapes
from trajectories.speed import GRAVITY, replanned

CAR = vehicle.load("bmw-320i")


def planned(trajectory: str | ReferencePath = "circle", **arguments: Any) -> ReferencePath:
    given = {"vehicle": CAR, "speed_mode": "grip", **arguments}
    return PathTrackingEnv(trajectory, **given).path


STIFF = CAR.replace(front_cornering_stiffness=1e6, rear_cornering_stiffness=1e6, implausible=True)
"""A car whose tyres hardly slip, so that turning does not brake it."""


def share_used(path: ReferencePath, car: VehicleParameters, friction: float) -> np.ndarray:
    """Return the share of its friction that the weaker axle uses in each cell, without drag."""
    ax = np.diff(path.speed**2) / (2.0 * path.spacing)
    ay = 0.5 * np.abs((path.curvature * path.speed**2)[1:] + (path.curvature * path.speed**2)[:-1])
    transfer = car.centre_of_gravity_height / GRAVITY
    front = 1.0 - transfer / car.rear_axle_distance * ax
    rear = 1.0 + transfer / car.front_axle_distance * ax
    side = ay / np.minimum(front, rear)
    return np.hypot(ax, side) / (friction * GRAVITY)


@pytest.mark.parametrize("grip", [0.3, 0.8, 1.2])
@pytest.mark.parametrize("friction", [None, 0.6])
def test_a_circle_is_driven_at_this_share_of_its_limit(grip: float, friction: float | None) -> None:
    """Without drag v = sqrt(grip mu g R); a turn that brakes is taken a little slower."""
    given = {} if friction is None else {"conditions": {"name": "ideal", "friction": friction}}
    path = planned(load("circle"), grip=grip, **given)
    expected = math.sqrt(grip * (friction or 1.0) * GRAVITY * 30.0)
    assert path.speed.min() == pytest.approx(path.speed.max(), rel=1e-9)
    assert 0.95 * expected < path.speed[0] < expected
    assert path.metadata["grip"] == grip
    assert path.metadata["speed_mode"] == "grip"
    limits = grip_limits(path, STIFF, friction or math.inf, grip)
    assert replanned(path, limits).speed[0] == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("name", ["bmw-320i", "m2-minibus"])
@pytest.mark.parametrize(("friction", "radius"), [(0.6, 30.0), (1.0, 60.0)])
def test_a_steady_turn_at_full_grip_is_the_fastest(
    name: str, friction: float, radius: float
) -> None:
    """The vector field has a steady turn a few percent below the limit, and none as far above."""
    car = vehicle.load(name)
    highest = grip_limits(load("circle"), car, friction, 1.0).max_lateral_acceleration

    def residual(unknown: np.ndarray, speed: float) -> np.ndarray:
        sideslip, a, delta = unknown
        vx, vy, r = speed * math.cos(sideslip), speed * math.sin(sideslip), speed / radius
        share, parameters = tyres.scheduled(
            (vx, vy, r), (a, delta), 1.0 / vx, car, friction, min, max
        )
        turn = math.cos(delta), math.sin(delta)
        rates = field(vx, vy, r, 1.0, 0.0, a * share, delta, *turn, 1.0 / vx, *parameters)
        return np.array([rates[0], rates[1], rates[3]])

    def exists(share: float) -> bool:
        speed = math.sqrt(share * highest * radius)
        starts = [(s, a, d) for s in (0.0, -0.1) for a in (0.4, 1.2, 2.0) for d in (0.1, 0.2)]
        found = [least_squares(residual, one, args=(speed,), xtol=1e-13) for one in starts]
        return min(one.cost for one in found) < 1e-10

    assert exists(0.96)
    assert not exists(1.05)


def test_the_middle_of_a_range_of_friction_counts() -> None:
    drawn, known = (
        planned(grip=0.5, conditions={"name": "ideal", "friction": given})
        for given in ([0.4, 0.8], 0.6)
    )
    np.testing.assert_allclose(drawn.speed, known.speed, rtol=1e-12)


def test_a_plant_counts_with_its_own_road() -> None:
    pytest.importorskip("vehiclemodels", reason="needs the extra plants")
    env = PathTrackingEnv("circle", CAR, "grip", grip=0.5, plant="drift")
    assert env.friction != 1.0
    limits = grip_limits(env.path, CAR, env.friction, 0.5)
    np.testing.assert_array_equal(env.path.speed, replanned(load("circle"), limits).speed)


@pytest.mark.parametrize("grip", [0.5, 0.9])
@pytest.mark.parametrize("friction", [0.5, 1.0])
def test_no_axle_uses_more_than_its_share(grip: float, friction: float) -> None:
    strong = CAR.replace(
        longitudinal_acceleration_range=(-8.0, 6.0), acceleration_range=(-9.0, 7.0), max_jerk=40.0
    )
    path = load("hairpins")
    given = {"name": "ideal", "friction": friction}
    fast = planned(path, vehicle=strong, grip=grip, conditions=given)
    used = share_used(fast, strong, friction)
    assert 0.95 * grip < used.max() <= 1.005 * grip
    acceleration = fast.acceleration[:-1]
    a_max = tyres.of(strong, friction)[0]
    assert acceleration.max() <= min(6.0, a_max) + 1e-6
    assert acceleration.min() >= -min(8.0, a_max) - 1e-6
    # Both bounds are reached, so the profile is not slower than it must be.
    assert acceleration.max() > 0.97 * min(6.0, grip * friction * GRAVITY, a_max)
    assert acceleration.min() < -0.97 * min(8.0, grip * friction * GRAVITY, a_max)


def test_a_straight_is_driven_at_the_vehicles_limits() -> None:
    path = planned(load("straight"), grip=0.9)
    low, high = CAR.longitudinal_acceleration_range
    assert path.acceleration.max() == pytest.approx(high, abs=1e-6)
    assert path.acceleration.min() == pytest.approx(low, abs=1e-6)
    jerk = path.speed[1:-1] * np.diff(path.acceleration[:-1]) / path.spacing
    assert 0.9 * CAR.max_jerk < np.abs(jerk).max() <= CAR.max_jerk
    slow = planned(load("straight"), grip=0.9, vehicle=CAR.replace(speed_range=(0.0, 12.0)))
    assert slow.speed.max() == 12.0


def test_vehicles_of_one_environment_have_their_own_speeds() -> None:
    cars = ["bmw-320i", "m2-minibus"]
    env = PathTrackingVectorEnv(
        num_envs=2, trajectory=["T2", "T4"], vehicle=cars, speed_mode="grip", grip=0.7
    )
    for task in env.tasks:
        alone = PathTrackingEnv(task.path.name, task.vehicle, "grip", grip=0.7)
        np.testing.assert_array_equal(task.path.speed, alone.path.speed)
    assert not np.array_equal(env.tasks[0].path.speed, env.tasks[1].path.speed)
    single = PathTrackingEnv("T4", cars[0], "grip", grip=0.7)
    single.reset(options={"vehicle": cars[1]})
    np.testing.assert_array_equal(single.path.speed, env.tasks[3].path.speed)
    single.reset(options={"trajectory": "T2"})
    np.testing.assert_array_equal(single.path.speed, env.tasks[0].path.speed)


def test_an_open_path_begins_and_ends_at_its_own_speed() -> None:
    path = planned(load("hairpins"), grip=0.8)
    assert path.speed[[0, -1]] == pytest.approx([28.0, 28.0])


@pytest.mark.parametrize("friction", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("grip", [0.1, 0.6])
@pytest.mark.parametrize("name", ["random-limit-9", "iso-3888-1-1.61", "hairpins", "T1-raw"])
def test_ends_are_left_as_slowly_as_the_first_bend_needs(
    name: str, grip: float, friction: float
) -> None:
    path = planned(load(name), grip=grip, conditions={"name": "ideal", "friction": friction})
    assert path.speed[[0, -1]].max() <= load(name).metadata["limits"]["end_speed"] + 1e-9
    limits = path.metadata["limits"]
    slow = path.speed < 1.05 * limits["min_speed"]  # a kink does not stop the reference
    lateral = np.abs(path.curvature) * path.speed**2
    assert lateral[~slow].max() <= 1.01 * limits["max_lateral_acceleration"]


def test_a_grip_below_the_rolling_resistance_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"overcome the rolling resistance of vehicle .*least 0.2 "
    ):
        planned(grip=0.1, vehicle="m2-minibus", conditions={"name": "ideal", "friction": 0.1})


def test_a_bend_of_a_known_curvature_is_the_bottleneck() -> None:
    limits = SpeedLimits(10.0, 2.0, 1.5)
    bend = shapes.fit(shapes.parse("S 200 | L 180 r25 | S 200"), limits)
    path = shapes.from_geometry(shapes.build(bend), limits, "bend")
    fast = planned(path, grip=0.6)
    lateral = fast.metadata["limits"]["max_lateral_acceleration"]
    assert 0.98 * 0.6 * GRAVITY < lateral < 0.6 * GRAVITY
    expected = math.sqrt(lateral / np.abs(path.curvature).max())
    assert fast.speed[len(fast.speed) // 2] == pytest.approx(expected, rel=0.005)


def test_more_grip_is_faster_and_soft_tyres_are_slower() -> None:
    durations = [planned(load("T3"), grip=grip).duration for grip in (0.3, 0.5, 0.8, 1.0)]
    assert durations == sorted(durations, reverse=True)
    limits = [
        grip_limits(load("T3"), car, math.inf, 1.0).max_lateral_acceleration
        for car in (STIFF, CAR, vehicle.load("m2-minibus"))
    ]
    assert limits == sorted(limits, reverse=True)
    assert limits[0] == pytest.approx(GRAVITY, rel=1e-2)


class TestFiles:
    """A file's speed: its own up to what the vehicle can drive, or planned for the vehicle."""

    @pytest.fixture
    def raceline(self, tmp_path: Path) -> Path:
        s = np.arange(0.0, 200.0, 1.0)
        speed = np.where(s < 100.0, 6.0, 12.0)
        file = tmp_path / "line.csv"
        rows = [f"{x},0.0,{v}" for x, v in zip(s, speed, strict=True)]
        file.write_text("\n".join(["x_m,y_m,vx_mps", *rows]))
        return file

    def test_own_speeds_are_driven_up_to_the_vehicles_acceleration(self, raceline: Path) -> None:
        path = PathTrackingEnv(raceline, "m2-minibus").path
        assert path.speed[0] == pytest.approx(6.0)
        assert path.speed.max() == pytest.approx(12.0)
        assert path.acceleration.max() == pytest.approx(2.0)
        exact = np.sqrt(36.0 + 4.0 * (path.arc_length - 99.0).clip(0.0)).clip(max=12.0)
        assert np.abs(path.speed - exact).max() < 0.5  # the nodes of the step from 6 to 12 m/s

    def test_a_path_that_was_loaded_without_a_vehicle_is_lowered_too(self, raceline: Path) -> None:
        whole = load(raceline)
        assert whole.acceleration.max() > 20.0
        with pytest.warns(UserWarning, match="lowered to what vehicle 'm2-minibus' can drive on"):
            path = PathTrackingEnv(whole, "m2-minibus").path
        assert np.array_equal(path.speed, PathTrackingEnv(raceline, "m2-minibus").path.speed)

    def test_a_planned_speed_keeps_to_the_vehicle(self, tmp_path: Path) -> None:
        file = tmp_path / "circle.csv"
        angle = np.linspace(0.0, 2.0 * np.pi, 150)
        np.savetxt(file, 40.0 * np.column_stack([np.cos(angle), np.sin(angle)]), delimiter=",")
        sporty = CAR.replace(max_lateral_acceleration=0.5)
        for car, lateral in ((CAR, 2.0), (sporty, 0.5)):
            path = PathTrackingEnv(file, car).path
            assert path.speed.max() == pytest.approx(math.sqrt(lateral * 40.0), rel=0.01)
            assert path.metadata["limits"]["wheelbase"] == car.wheelbase
