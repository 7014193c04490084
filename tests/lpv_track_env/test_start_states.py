"""Episodes that start in a bend start in its steady turn: nothing has to settle."""

import math
from typing import Any

import numpy as np
import pytest

from lpv_track_env.bicycle import derivative
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.vehicle import VEHICLES, VehicleParameters
from trajectories import ReferencePath, load

CIRCLE = load("circle")


def held(env: PathTrackingEnv, steps: int) -> np.ndarray[Any, Any]:
    """Lateral errors (m) while the starting command is held."""
    env.reset(seed=0)
    action = np.array(env.actuators, dtype=np.float32)
    return np.array([env.step(action)[4]["lateral_error"] for _ in range(steps)])


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("side", [1, -1])
def test_state_is_steady_and_moves_along_the_path(name: str, side: int) -> None:
    path = CIRCLE if side == 1 else CIRCLE.mirrored()
    env = PathTrackingEnv(path, name)
    _, info = env.reset(seed=0)
    vx, vy, _, r, _, _ = info["state"]
    rates = derivative(info["state"], np.array(env.actuators), env.vehicle)
    # vx', vy', r': three steps of the fixed point leave some delta^6 of a = 3 m/s^2.
    assert np.abs(rates[[0, 1, 3]]).max() < 1e-4
    assert r / math.hypot(vx, vy) == pytest.approx(side / 30.0, rel=1e-9)
    assert info["heading_error"] == pytest.approx(-math.atan(vy / vx), abs=1e-9)
    assert info["speed_error"] == 0.0
    assert np.abs(held(env, 40)).max() < 1e-4


def test_a_straight_start_is_as_ever() -> None:
    env = PathTrackingEnv("T1")
    _, info = env.reset(seed=0)
    vx, vy, psi, r, _, _ = info["state"]
    assert (vx, vy, psi, r) == (1.5, 0.0, 0.0, 0.0)
    assert env.actuators == (env.vehicle.rolling_deceleration, 0.0)


def test_a_given_heading_error_is_that_of_the_vehicles_axis() -> None:
    env = PathTrackingEnv("circle")
    assert env.reset(options={"heading_error": 0.1})[1]["heading_error"] == pytest.approx(0.1)


@pytest.mark.parametrize("plant", ["bicycle", "drift"])
def test_limited_tyres_start_with_the_slip_that_they_need(plant: str) -> None:
    """At 0.7 g the slip is far beyond the linear one; the held command keeps to the circle."""
    fast = CIRCLE.with_speed(math.sqrt(0.7 * 9.81 * 30.0))
    settings: dict[str, Any] = {"plant": plant, "vehicle": "bmw-320i"}
    if plant == "bicycle":
        settings["conditions"] = {"name": "simulation", "friction": 1.0}
    else:
        pytest.importorskip("vehiclemodels", reason="the extra plants is not installed")
    env = PathTrackingEnv(fast, **settings)
    rates = held(env, 20)
    assert np.abs(rates).max() < 0.1


def test_a_standing_start_in_a_bend_has_the_wheels_turned() -> None:
    env = PathTrackingEnv("circle")
    _, info = env.reset(options={"speed": 0.0})
    assert not info["state"][[0, 1, 3]].any()
    car: VehicleParameters = env.vehicle
    ackermann = math.sin(math.atan(car.wheelbase / 30.0))
    assert env.actuators[1] == pytest.approx(ackermann, rel=0.02)


def test_a_turn_beyond_the_grip_is_limited() -> None:
    fast: ReferencePath = CIRCLE.with_speed(29.0)
    env = PathTrackingEnv(fast, "bmw-320i", conditions={"name": "simulation", "friction": 0.5})
    _, info = env.reset(seed=0)
    vx, _, _, r, _, _ = info["state"]
    assert r * vx <= 0.5 * 9.81
    assert np.isfinite(info["state"]).all()
