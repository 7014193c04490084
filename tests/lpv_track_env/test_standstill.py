"""A vehicle that does not reverse: it brakes to standstill, stands, and drives off again."""

from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.integration import integrate
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import BMW_320I, M2_MINIBUS
from tests.helpers.vector_equality import assert_equal, step_both

Array = NDArray[Any]

RAW = {"name": "realtime", "estimator": "raw"}
WINDY = {"name": "realtime", "wind_speed": [15.0, 15.0]}
CONDITIONS = ("simulation", "realtime", RAW, WINDY)


def braked(start: Array, a: float, delta: float, h: float, steps: int, lowest: float) -> Array:
    parameters = BMW_320I.as_array().tolist()
    return np.array(integrate(*start.tolist(), a, delta, *parameters, h, steps, lowest))


@pytest.mark.parametrize("speed", [0.003, 0.4, 3.0, 7.77])
def test_braking_ends_where_constant_deceleration_ends(speed: float) -> None:
    start = np.array([speed, 0.0, 0.3, 0.0, 1.0, 2.0])
    end = braked(start, -4.0, 0.0, 0.005, 2000, 0.0)
    way = speed**2 / 8.0
    wanted = [0.0, 0.0, 0.3, 0.0, 1.0 + way * np.cos(0.3), 2.0 + way * np.sin(0.3)]
    np.testing.assert_allclose(end, wanted, rtol=0.0, atol=1e-9)
    assert (end[[VX, VY, YAW_RATE]] == 0.0).all()
    # It stands to the last bit, and leaves as any vehicle does that starts there.
    np.testing.assert_array_equal(braked(end, -4.0, 0.2, 0.005, 100, 0.0), end)
    np.testing.assert_array_equal(braked(end, 0.0, 0.2, 0.005, 100, 0.0), end)
    np.testing.assert_array_equal(
        braked(end, 1.0, 0.2, 0.005, 100, 0.0), braked(end, 1.0, 0.2, 0.005, 100, -np.inf)
    )
    assert braked(end, 1.0, 0.2, 0.005, 100, 0.0)[VX] > 0.4


def test_a_stop_in_a_bend_converges_with_the_step() -> None:
    """The last step's straight line errs with the square of its length."""
    start = np.array([4.0, 0.1, 0.0, 0.3, 0.0, 0.0])
    fine = braked(start, -3.0, 0.2, 1e-5, 150_000, 0.0)
    for h, bound in ((0.005, 1e-5), (0.0025, 2.5e-6)):
        end = braked(start, -3.0, 0.2, h, round(1.5 / h), 0.0)
        assert np.abs(end - fine).max() < bound
        assert (end[[VX, VY, YAW_RATE]] == 0.0).all()


@pytest.mark.parametrize("conditions", CONDITIONS, ids=str)
def test_full_braking_stands_until_the_drive_pulls(conditions: Any) -> None:
    env = PathTrackingEnv("u-turn", conditions=conditions, time_limit=60.0)
    _, info = env.reset(seed=0, options={"arc_length": 30.0})
    states, estimates = [], []
    for k in range(300):
        *_, info = env.step(np.array([-5.0 if k < 200 else 1.0, 0.1], np.float32))
        states.append(info["state"])
        estimates.append(info.get("estimate", info["state"]))
    driven = np.array(states)
    assert driven[:, VX].min() == 0.0
    standing = driven[80:200]
    assert (standing[:, VX] == 0.0).all()
    for entry in (PSI, X, Y):
        assert np.ptp(standing[:, entry]) == 0.0
    assert driven[-1, VX] > 1.5
    # The estimate stands, too, but for the noise of the measured speed.
    assert np.array(estimates)[80:200, VX].min() > -0.2


def test_a_vehicle_that_reverses_goes_on_backwards() -> None:
    car = M2_MINIBUS.replace(speed_range=(-5.0, 30.0))
    env = PathTrackingEnv("straight", car, conditions="simulation")
    _, info = env.reset(options={"speed": -1.0, "arc_length": 50.0})
    assert info["state"][VX] == -1.0
    for _ in range(20):
        *_, info = env.step(np.array([-1.0, 0.0], np.float32))
    assert info["state"][VX] < -1.5
    with pytest.raises(ValueError, match=r"start at -5.5 m/s, .* drives at -5 m/s or more"):
        env.reset(options={"speed": -5.5})


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
@pytest.mark.parametrize(
    "vehicles", [("m2-minibus",), ("bmw-320i", "course-car")], ids=["uniform", "mixed"]
)
def test_the_vector_environment_stands_alike(vehicles: tuple[str, ...], conditions: str) -> None:
    """Blocks of vehicles with equal and different numbers of substeps."""
    mode = AutoresetMode.SAME_STEP
    settings: dict[str, Any] = {
        "trajectory": "T2", "conditions": conditions, "time_limit": 8.0,
        "initial_error_range": (0.3, 0.2, 3.0), "random_start": True,
    }  # fmt: skip
    for name in vehicles:
        given = {**settings, "vehicle": name}
        ours = PathTrackingVectorEnv(40, **given, autoreset_mode=mode)
        theirs = SyncVectorEnv([lambda given=given: PathTrackingEnv(**given)] * 40,
                               autoreset_mode=mode)  # fmt: skip
        assert_equal(ours.reset(seed=1)[0], theirs.reset(seed=1)[0])
        stood = 0
        for k in range(120):
            a = np.where((k + np.arange(40)) // 40 % 2 == 0, -4.0, 2.0)
            action = np.stack([a, np.full(40, 0.05)], axis=1).astype(np.float32)
            step_both(ours, theirs, action, mode)
            stood += int((ours.state[:, VX] == 0.0).sum())
            assert ours.state[:, VX].min() >= 0.0
        assert stood > 100


def test_a_mixed_block_stands_alike() -> None:
    """Vehicles with different numbers of substeps in one block, each beside a block of its own."""
    light = M2_MINIBUS.replace(name="light", mass=600.0, yaw_inertia=1500.0)
    cars = [M2_MINIBUS, light]
    mixed = PathTrackingVectorEnv(64, "T2", cars, autoreset_mode=AutoresetMode.DISABLED)
    mixed.reset(seed=7)
    alone = {
        car.name: PathTrackingVectorEnv(64, "T2", car, autoreset_mode=AutoresetMode.DISABLED)
        for car in cars
    }
    names = [mixed.task_of(i).vehicle.name for i in range(64)]
    assert len({mixed.task_of(i).substeps for i in range(64)}) == 2
    for env in alone.values():
        env.reset(seed=7)
    for _ in range(30):
        action = np.tile([-5.0, 0.1], (64, 1))
        mixed.advance(action)
        for env in alone.values():
            env.advance(action)
    assert (mixed.state[:, VX] == 0.0).all()
    for i, name in enumerate(names):
        np.testing.assert_array_equal(mixed.state[i], alone[name].state[i])


@pytest.mark.parametrize("vectorised", [False, True])
def test_drawn_starts_are_no_slower_than_standstill(vectorised: bool) -> None:
    settings: dict[str, Any] = {"trajectory": "T2", "initial_error_range": (0.0, 0.0, 3.0)}
    if vectorised:
        env = PathTrackingVectorEnv(200, **settings)
        env.reset(seed=0)
        speeds = env.state[:, VX]
    else:
        one = PathTrackingEnv(**settings)
        speeds = np.array([one.reset(seed=seed)[1]["state"][VX] for seed in range(200)])
    assert speeds.min() == 0.0
    assert 0.1 < (speeds == 0.0).mean() < 0.4
    assert speeds.max() > 4.0


def test_a_start_at_standstill_is_reached_by_either_option() -> None:
    env = PathTrackingEnv("T5")
    for s in np.linspace(0.0, 2000.0, 60):
        _, by_speed = env.reset(options={"arc_length": s, "speed": 0.0})
        # The reference there as anybody computes it, rounded otherwise than by the environment.
        reference = float(env.path.sample(s).speed)
        _, by_error = env.reset(options={"arc_length": s, "speed_error": -reference})
        assert by_speed["state"][VX] == 0.0
        assert 0.0 <= by_error["state"][VX] < 1e-12


def test_the_vector_environment_refuses_a_start_in_reverse_for_any_path() -> None:
    env = PathTrackingVectorEnv(3, ["straight", "T2"])
    env.reset(seed=0, options={"speed_error": -1.4})
    before = env.state
    with pytest.raises(ValueError, match=r"start at -0.5 m/s, .* at least -1.5$"):
        env.reset(options={"speed_error": -2.0})
    np.testing.assert_array_equal(env.state, before)
