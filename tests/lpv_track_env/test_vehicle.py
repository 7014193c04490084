"""Vehicle parameters: every preset's contract, files, errors, the understeer gradient."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import fsolve

from lpv_track_env import vehicle
from lpv_track_env.bicycle import derivative, fastest_pole
from lpv_track_env.plausibility import FASTEST_POLE, INVERSE_SPEED_AT_STANDSTILL
from lpv_track_env.vehicle import (
    COURSE_CAR,
    HEIGHT_SHARE,
    M2_MINIBUS,
    PARAMETER_ORDER,
    VEHICLES,
    VehicleParameters,
)

SHARED = Path(__file__).parents[3] / "shared" / "cases"
PRESETS = pytest.mark.parametrize(("name", "car"), VEHICLES.items(), ids=VEHICLES.keys())
POSITIVE = (
    "mass", "yaw_inertia", "front_axle_distance", "rear_axle_distance",
    "front_cornering_stiffness", "rear_cornering_stiffness", "max_steering_angle",
    "max_steering_rate", "max_jerk", "max_lateral_velocity_ratio", "length", "width",
    "centre_of_gravity_height", "max_lateral_acceleration",
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


def test_f1tenth_is_that_of_its_simulator() -> None:
    """f1tenth_gym's default parameters and the lateral rows of its single-track model.

    It has beta' and r' with the factors mu C_S g l / L of slip angles; unaccelerated and straight
    ahead they are, times m v and Iz, those of this project's field.
    """
    mu, c_sf, c_sr, lf, lr, m, inertia = 1.0489, 4.718, 5.4562, 0.15875, 0.17145, 3.74, 0.04712
    car, speed, vy, r, delta = VEHICLES["f1tenth"], 4.0, 0.02, 0.1, 1e-4
    beta = vy / speed
    scale = mu * 9.81 / (lr + lf)
    beta_rate = -r + scale / speed * (
        lr * c_sf * (delta - beta - lf * r / speed) + lf * c_sr * (lr * r / speed - beta)
    )
    yaw_acceleration = (
        m
        * scale
        / inertia
        * (
            lf * lr * c_sf * (delta - beta - lf * r / speed)
            - lr * lf * c_sr * (lr * r / speed - beta)
        )
    )
    rate = derivative([speed, vy, 0.0, r, 0.0, 0.0], [0.0, delta], car)
    assert rate[1] == pytest.approx(speed * beta_rate, rel=1e-6)
    assert rate[3] == pytest.approx(yaw_acceleration, rel=1e-6)
    assert (car.mass, car.wheelbase) == (m, lf + lr)


def test_kart_tyres_are_the_slopes_of_the_magic_formula() -> None:
    """Lateral force D sin(C atan(B a - E(B a - atan(B a)))) of Lot and Dal Bianco's tyres."""
    car = VEHICLES["kart"]
    slip = 1e-6
    for stiffness, load, c, e, slope in (
        (car.front_cornering_stiffness, 165 * 9.81 * 0.4 / 1.045, 2.13, 0.8, 34.1),
        (car.rear_cornering_stiffness, 165 * 9.81 * 0.645 / 1.045, 2.3, 0.9, 37.6),
    ):
        wheel, nominal = 0.5 * load, 1.6 * 560.0
        d = 1.5 * wheel
        b = slope * nominal * math.sin(2.0 * math.atan(wheel / (1.6 * nominal))) / (c * d)
        x = b * slip
        force = d * math.sin(c * math.atan(x - e * (x - math.atan(x))))
        assert stiffness == pytest.approx(2.0 * force / slip, rel=1e-6)


@pytest.mark.parametrize("name", ["f1tenth", "kart"])
def test_small_cars_turn_as_sharply_as_they_steer(name: str) -> None:
    """At low speed the steering limits the curvature, not the lateral velocity."""
    by_steering, by_sideslip = VEHICLES[name].sharpest_turns(np.array([1.0]))
    assert by_steering[0] < by_sideslip[0]


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


def test_height_of_the_centre_of_gravity_is_by_default_a_share_of_the_wheelbase(
    tmp_path: Path,
) -> None:
    """As in files of before there was this field."""
    values = M2_MINIBUS.as_dict()
    del values["centre_of_gravity_height"]
    for given in (values, {**values, "centre_of_gravity_height": None}):
        car = vehicle.load(written(tmp_path, given))
        assert car.centre_of_gravity_height == HEIGHT_SHARE * 3.3
    assert M2_MINIBUS.centre_of_gravity_height == 0.9
    with pytest.raises(ValueError, match="front_axle_distance must be positive, not 'far'"):
        vehicle.load(written(tmp_path, {**values, "front_axle_distance": "far"}))


def test_lateral_acceleration_of_plans_is_by_default_the_papers(tmp_path: Path) -> None:
    """Files leave the default out, so that they and their digests are as before."""
    values = M2_MINIBUS.as_dict()
    assert "max_lateral_acceleration" not in values
    assert vehicle.load(written(tmp_path, values)).max_lateral_acceleration == 2.0
    sporty = M2_MINIBUS.replace(max_lateral_acceleration=5.0)
    assert sporty.as_dict() == {**values, "max_lateral_acceleration": 5.0}
    assert vehicle.load(written(tmp_path, sporty.as_dict())) == sporty
    assert M2_MINIBUS.replace(max_lateral_acceleration=2) == M2_MINIBUS


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
        ({"mass": math.nan}, "NaN is no number"),
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
    with pytest.raises(ValueError, match=r"none\.json: cannot be read: No such file"):
        vehicle.load(tmp_path / "none.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(ValueError, match=r"folder\.json: cannot be read: Is a directory"):
        vehicle.load(tmp_path / "folder.json")
    file = tmp_path / "broken.json"
    for content in (b'{"mass": 1', b"\xff\xfe\xfa"):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"broken\.json: is not (JSON|a text file)"):
            vehicle.load(file)
    for content in ("[1, 2]", "3", '"van"'):
        file.write_text(content)
        with pytest.raises(ValueError, match=r"broken\.json must hold one JSON object"):
            vehicle.load(file)


ORCA = VehicleParameters(
    "1:43 model car", "MPCC literature", 0.041, 27.8e-6, 0.029, 0.033, 0.594, 0.746, 0.01,
    length=0.12, width=0.05,
)  # fmt: skip
MODEL_CAR = VehicleParameters(
    "1:10 model car", "3 kg, wheelbase 0.33 m", 3.0, 0.04, 0.165, 0.165, 60.0, 60.0, 0.01,
    max_steering_angle=0.42, max_steering_rate=3.2, acceleration_range=(-9.5, 9.5), max_jerk=100.0,
    length=0.58, width=0.31,
)  # fmt: skip
TRUCK = VehicleParameters(
    "truck of 40 t", "a tractor and its trailer as one body", 4e4, 2.5e5, 3.5, 2.6, 4e5, 1.2e6,
    0.008, max_steering_angle=0.8, length=16.5, width=2.55,
)  # fmt: skip


@pytest.mark.parametrize("car", [ORCA, MODEL_CAR, TRUCK, *VEHICLES.values()], ids=lambda c: c.name)
def test_vehicles_of_every_size_are_plausible(car: VehicleParameters, tmp_path: Path) -> None:
    assert not car.implausible
    assert "implausible" not in car.as_dict()
    assert vehicle.load(written(tmp_path, car.as_dict())) == car
    # The bound on what can be computed really bounds the poles.
    p = car
    damping = INVERSE_SPEED_AT_STANDSTILL * (
        (p.front_cornering_stiffness + p.rear_cornering_stiffness) / p.mass
        + (p.front_cornering_stiffness * p.front_axle_distance**2
           + p.rear_cornering_stiffness * p.rear_axle_distance**2) / p.yaw_inertia
    )  # fmt: skip
    assert 0.4 * damping < fastest_pole(0.0, car) <= damping < 0.25 * FASTEST_POLE


@pytest.mark.parametrize("name", ["f1tenth", "kart"])
def test_vehicles_that_others_have_sent_are_plausible(name: str) -> None:
    file = SHARED / f"{name}.json"
    if not file.exists():
        pytest.skip(f"{file} is not there")
    assert vehicle.load(file).name == name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_steering_angle": 35}, "35 rad .* 0.01 to 1.571; deg[?] 35 deg = 0.6109 rad"),
        ({"max_steering_angle": 1e4}, "10000 rad is implausible, expected 0.01 to 1.571 [(]"),
        ({"max_steering_rate": 30}, "deg/s[?] 30 deg/s = 0.5236 rad/s"),
        ({"front_cornering_stiffness": 1570.0}, "N/deg[?] 1570 N/deg = 8.995e[+]04 N/rad"),
        ({"rear_cornering_stiffness": 110.0}, "kN/rad[?] 110 kN/rad = 1.1e[+]05 N/rad"),
        ({"mass": 3.5}, "is implausible.* is the mass 3.5 kg[?]"),
        ({"mass": 1e-9}, "mass 1e-09 kg is implausible"),
        ({"yaw_inertia": 1e-9}, "yaw_inertia 1e-09 kg m.2 is implausible"),
        ({"front_axle_distance": 1600}, "front_axle_distance 1600 m .*mm[?] 1600 mm = 1.6 m"),
        ({"rear_axle_distance": 170}, "cm[?] 170 cm = 1.7 m"),
        ({"width": 2000}, "mm[?] 2000 mm = 2 m"),
        ({"centre_of_gravity_height": 57}, "57 m is implausible.* cm[?] 57 cm = 0.57 m"),
        ({"rolling_resistance": 2}, "%[?] 2 % = 0.02"),
        ({"speed_range": [1, 120]}, "km/h[?] 120 km/h = 33.33 m/s"),
        ({"max_lateral_acceleration": 200}, "200 m/s.2 is implausible, expected 0.01 to 60"),
        ({"acceleration_range": [-5000, 3500]}, "acceleration_range -5000 m/s.2 is implausible"),
    ],
)
def test_values_in_other_units_are_refused_unless_told(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    file = written(tmp_path, {**M2_MINIBUS.as_dict(), **change})
    with pytest.raises(ValueError, match=message) as caught:
        vehicle.load(file)
    assert '"implausible": true takes it as it is' in str(caught.value)
    with pytest.raises(ValueError, match=message):
        M2_MINIBUS.replace(**change)


def test_an_implausible_vehicle_says_so(tmp_path: Path) -> None:
    values = {**M2_MINIBUS.as_dict(), "max_steering_angle": 35, "implausible": True}
    car = vehicle.load(written(tmp_path, values))
    assert car.max_steering_angle == 35
    assert car.as_dict() == {**values, "speed_range": (1.0, 30.0), **{
        key: getattr(M2_MINIBUS, key)
        for key in ("acceleration_range", "longitudinal_acceleration_range")
    }}  # fmt: skip
    assert car.replace(mass=3000.0).implausible


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 1e-6}, "at a rate of 3.75e[+]11 1/s, at most 10000 1/s .* mass 1e-06 kg"),
        ({"yaw_inertia": 1e-6}, "at a rate of .* yaw_inertia 1e-06 kg"),
        ({"front_cornering_stiffness": 1e9}, "stiffnesses 1e[+]09 and 110000 N/rad"),
        ({"front_cornering_stiffness": 1e15}, "is 1e[+]15; 1e-09 to 1e[+]09 can be"),
        ({"mass": 1e-310}, "mass is 1e-310; 1e-09 to"),
        ({"max_jerk": 1e308}, "max_jerk is 1e[+]308"),
        ({"speed_range": (-1e300, 1.0)}, "speed_range is -1e[+]300"),
    ],
)
def test_what_cannot_be_integrated_is_refused_in_any_case(
    change: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        M2_MINIBUS.replace(implausible=True, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": True}, "mass must be positive, not True"),
        ({"mass": 10**400}, "mass must be positive, not an integer of 1329 bits"),
        ({"mass": "m" * 500_000}, "mass must be positive, not 'mmm"),
        ({"name": 3}, "name must be a text line, not 3"),
        ({"name": "a\nb"}, "name must be a text line"),
        ({"source": None}, "source must be a text line"),
        ({"implausible": 1}, "implausible must be true or false, not 1"),
    ],
)
def test_values_of_wrong_types_are_one_short_line(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        M2_MINIBUS.replace(**change)
    assert len(str(caught.value)) < 300


def test_a_source_may_be_written_on_several_lines() -> None:
    assert M2_MINIBUS.replace(source="A Car,\n  2nd\u00a0edition").source == "A Car, 2nd edition"


@pytest.mark.parametrize("mass", [np.float32(3000.0), np.int64(3000), np.array(3000.0)])
def test_numbers_of_other_packages_become_plain_ones(mass: Any) -> None:
    car = M2_MINIBUS.replace(mass=mass)
    assert json.dumps(car.as_dict()) == json.dumps(M2_MINIBUS.replace(mass=3000.0).as_dict())


def test_a_pipe_is_no_vehicle(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(ValueError, match="no regular file"):
        vehicle.load(tmp_path / "pipe.json")
