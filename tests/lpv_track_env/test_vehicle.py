"""Vehicle parameters: every preset's contract, files, errors, the understeer gradient."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import fsolve

from lpv_track_env import vehicle
from lpv_track_env.bicycle import derivative
from lpv_track_env.vehicle import (
    COURSE_CAR,
    M2_MINIBUS,
    PARAMETER_ORDER,
    VEHICLES,
    VehicleParameters,
)

PRESETS = pytest.mark.parametrize(("name", "car"), VEHICLES.items(), ids=VEHICLES.keys())
POSITIVE = (
    "mass", "yaw_inertia", "front_axle_distance", "rear_axle_distance",
    "front_cornering_stiffness", "rear_cornering_stiffness", "max_steering_angle",
    "max_steering_rate", "max_jerk", "max_lateral_velocity_ratio", "length", "width",
)  # fmt: skip


def test_names() -> None:
    assert {"m2-minibus", "course-car"} <= set(VEHICLES)


@PRESETS
def test_preset_keeps_the_contract(name: str, car: VehicleParameters) -> None:
    assert car.name == name
    assert len(car.source) > 20
    for field in POSITIVE:
        assert getattr(car, field) > 0, field
    assert car.rolling_resistance >= 0
    for field in ("acceleration_range", "longitudinal_acceleration_range", "speed_range"):
        low, high = getattr(car, field)
        assert low < high, field
    assert car.wheelbase == car.front_axle_distance + car.rear_axle_distance
    assert car.wheelbase < car.length
    array = car.as_array()
    assert array.shape == (len(PARAMETER_ORDER),)
    assert array.dtype == np.float64
    assert array[0] == car.mass
    assert array[-1] == pytest.approx(car.rolling_resistance * 9.81, rel=1e-15)
    assert vehicle.load(name) is car
    assert vehicle.load(car) is car


def test_constraints_are_the_papers() -> None:
    for car in (M2_MINIBUS, COURSE_CAR):
        assert car.max_steering_angle == pytest.approx(math.pi / 6)
        assert car.max_steering_rate * 0.02 == pytest.approx(math.pi / 300)
        assert car.max_jerk * 0.02 == pytest.approx(0.1)
        assert car.longitudinal_acceleration_range == (-4.0, 2.0)
        assert car.speed_range == (1.0, 30.0)
        assert car.max_lateral_velocity_ratio == 0.17


def test_course_car_is_the_course_materials() -> None:
    values = COURSE_CAR.as_array()
    np.testing.assert_array_equal(values, [1500.0, 3000.0, 2.0, 3.0, 19000.0, 33000.0, 0.02 * 9.81])


@PRESETS
@pytest.mark.parametrize("speed", [2.0, 8.0, 20.0])
def test_understeer_gradient_is_that_of_the_field(
    name: str, car: VehicleParameters, speed: float
) -> None:
    """Steering angle of a steady turn, solved on the field: delta = L kappa + K a_y.

    The field's cosines bend it at second order: relatively 1e-8 at a curvature of 1e-5 1/m, so
    that K a_y, up to some tenths of L kappa, is met to 1e-6.
    """
    curvature = 1e-5
    r = speed * curvature

    def unsteady(unknown: np.ndarray) -> np.ndarray:
        vy, delta = 1e-5 * unknown
        rate = derivative([speed, vy, 0.0, r, 0.0, 0.0], [0.0, delta], car)
        return 1e5 * rate[[1, 3]]

    # Finer by two orders of magnitude than what is asserted, and still coarser than rounding.
    (_, scaled), _, status, message = fsolve(unsteady, [0.0, 1.0], xtol=1e-9, full_output=True)
    assert status == 1, message
    geometry = car.wheelbase * curvature
    assert 1e-5 * scaled - geometry == pytest.approx(
        car.understeer_gradient * speed**2 * curvature, rel=1e-6, abs=1e-8 * geometry
    )
    # CommonRoad's cars are neutral, up to rounding; none oversteers.
    assert car.understeer_gradient > -1e-15


def test_gradient_of_a_neutral_vehicle_is_zero() -> None:
    neutral = M2_MINIBUS.replace(
        front_axle_distance=1.5, rear_axle_distance=1.5, front_cornering_stiffness=1e5,
        rear_cornering_stiffness=1e5,
    )  # fmt: skip
    assert neutral.understeer_gradient == 0.0


@pytest.mark.parametrize("field", POSITIVE)
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_parameter_must_be_positive_and_finite(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"'m2-minibus': {field} must be positive"):
        M2_MINIBUS.replace(**{field: value})


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_rolling_resistance_must_not_be_negative(value: float) -> None:
    with pytest.raises(ValueError, match="rolling_resistance must be >= 0"):
        M2_MINIBUS.replace(rolling_resistance=value)
    assert M2_MINIBUS.replace(rolling_resistance=0.0).rolling_deceleration == 0.0


@pytest.mark.parametrize("value", [(1.0, 1.0), (2.0, 1.0), (1.0,), (0.0, math.inf), (math.nan, 1)])
def test_a_range_must_be_two_numbers_the_lower_first(value: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="speed_range must be two finite numbers"):
        M2_MINIBUS.replace(speed_range=value)


@pytest.mark.parametrize("given", ["m2-minibuss", "minibus", "", "course_car", "xyz"])
def test_unknown_name_lists_the_known_and_the_nearest(given: str) -> None:
    with pytest.raises(ValueError, match="unknown vehicle") as caught:
        vehicle.load(given)
    message = str(caught.value)
    assert repr(given) in message
    assert "known: m2-minibus, course-car" in message
    nearest = "course-car" if given == "course_car" else None
    if given.startswith("m2"):
        nearest = "m2-minibus"
    assert f"nearest: {nearest or ''}" in message


def written(folder: Path, values: object) -> Path:
    file = folder / "van.json"
    file.write_text(json.dumps(values), encoding="utf-8")
    return file


def test_json_file_is_loaded(tmp_path: Path) -> None:
    file = written(tmp_path, {**M2_MINIBUS.as_dict(), "mass": 2800.0, "name": "van"})
    for given in (file, str(file)):
        car = vehicle.load(given)
        assert car == M2_MINIBUS.replace(mass=2800.0, name="van")
        assert car.acceleration_range == (-5.0, 3.5)


def test_json_file_takes_its_name_and_defaults(tmp_path: Path) -> None:
    values = {field: getattr(M2_MINIBUS, field) for field in PARAMETER_ORDER[:-1]}
    car = vehicle.load(written(tmp_path, {**values, "rolling_resistance": 0.015}))
    assert car.name == "van"
    assert car.source == "van.json"
    assert car.max_steering_angle == M2_MINIBUS.max_steering_angle


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": -3500.0}, "mass must be positive"),
        ({"mass": math.nan}, "mass must be positive"),
        ({"wheelbase": 3.3}, "unknown field 'wheelbase'; known:.*'front_axle_distance'"),
        ({"mass": "heavy"}, "van.json: vehicle 'm2-minibus': mass must be"),
        ({"mass": None}, "van.json: vehicle 'm2-minibus': mass must be"),
        ({"speed_range": 30.0}, "van.json: vehicle 'm2-minibus': speed_range must be"),
        ({"speed_range": ["slow", "fast"]}, "van.json: vehicle 'm2-minibus': speed_range must be"),
    ],
)
def test_bad_value_in_a_file_is_named(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        vehicle.load(written(tmp_path, {**M2_MINIBUS.as_dict(), **change}))


def test_missing_field_in_a_file_is_named(tmp_path: Path) -> None:
    values = M2_MINIBUS.as_dict()
    del values["mass"]
    with pytest.raises(ValueError, match=r"van\.json: .*mass"):
        vehicle.load(written(tmp_path, values))


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cannot read vehicle file .*none\.json: No such file"):
        vehicle.load(tmp_path / "none.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(ValueError, match=r"cannot read vehicle file .*folder\.json"):
        vehicle.load(tmp_path / "folder.json")
    file = tmp_path / "broken.json"
    for content in (b'{"mass": 1', b"\xff\xfe\xfa"):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"broken\.json is not JSON"):
            vehicle.load(file)
    for content in ("[1, 2]", "3", '"van"'):
        file.write_text(content)
        with pytest.raises(ValueError, match=r"broken\.json must hold one JSON object"):
            vehicle.load(file)
