"""Vehicle parameters, limits and presets, each number with its source."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.plausibility import GRAVITY, check_computable, check_plausible
from trajectories.arguments import Number, instance_of, shortened, shown
from trajectories.fileio import read_json
from trajectories.naming import suggestion

Array = NDArray[np.float64]

PARAMETER_ORDER = (
    "mass",
    "yaw_inertia",
    "front_axle_distance",
    "rear_axle_distance",
    "front_cornering_stiffness",
    "rear_cornering_stiffness",
    "rolling_deceleration",
)
"""Order of `VehicleParameters.as_array` and of the last arguments of `bicycle.field`."""

NEWER_FIELDS = ("implausible", "max_lateral_acceleration")
"""Fields that files leave out at their default, so that digests of older vehicles stay."""

HEIGHT_SHARE = 0.23
"""Height of the centre of gravity by the wheelbase, where it is not given: that of CommonRoad's two
cars (0.233 and 0.223); its van has 0.303."""


def _finite(value: Any) -> bool:
    """Return whether a value is a number in double precision."""
    try:
        Number().of("", value)
    except ValueError:
        return False
    return True


def _wanted(name: str, value: Any) -> str | None:
    """Return what a field must be, or None if its value is that."""
    if name in {"name", "source"}:
        return None if isinstance(value, str) and value.isprintable() else "a text line"
    if name == "implausible":
        return None if isinstance(value, bool) else "true or false"
    if name.endswith("_range"):
        ends = tuple(value) if isinstance(value, tuple | list) else ()
        ordered = len(ends) == 2 and all(map(_finite, ends)) and ends[0] < ends[1]
        return None if ordered else "two finite numbers, the lower first"
    if name == "rolling_resistance":
        return None if _finite(value) and value >= 0 else ">= 0"
    return None if _finite(value) and value > 0 else "positive"


@dataclass(frozen=True)
class VehicleParameters:
    """A single-track (bicycle) vehicle: physics, actuators, and constraints for controllers.

    Parameters
    ----------
    name
        Name of the vehicle, for reports.
    source
        Source of the numbers.
    mass
        Mass m, kg.
    yaw_inertia
        Yaw inertia Iz about the centre of gravity, kg m^2.
    front_axle_distance, rear_axle_distance
        Distances lf, lr of the axles from the centre of gravity, m.
    front_cornering_stiffness, rear_cornering_stiffness
        Cornering stiffnesses Caf, Car: lateral force of an axle per slip angle, N/rad.
    rolling_resistance
        Coefficient mu of rolling resistance (not of tyre friction): `a = mu g` holds the speed.
    max_steering_angle
        Bound of |delta|, rad; by default pi/6 (kumar2025lpv, constraint table).
    max_steering_rate
        Bound of the steering rate, rad/s; by default the paper's pi/300 per step of Ts = 0.02 s.
    acceleration_range
        Range of the actuator's command a, m/s^2. It is wider than
        `longitudinal_acceleration_range`, because a must also overcome rolling resistance and the
        front tyre's drag.
    max_jerk
        Bound of |da/dt|, m/s^3; by default the paper's 0.1 m/s^2 per step of Ts = 0.02 s.
    longitudinal_acceleration_range
        Bounds of dvx/dt, m/s^2; by default -4 and 2 (the paper's text says 2, its table implies 1).
    speed_range
        Bounds of vx for controllers, m/s. A vehicle whose lower bound is not negative does not
        reverse: its brakes hold it at standstill.
    max_lateral_velocity_ratio
        Bound of |vy| / vx. In a steady turn at low speed it limits curvature to about ratio / lr.
    length, width
        Size of the body, m, for drawing, and for gaps and collisions in traffic.
    centre_of_gravity_height
        Height h of the centre of gravity above the road, m, by which acceleration and braking shift
        load between the axles where friction is limited (`tyres`); by default `HEIGHT_SHARE` of the
        wheelbase.
    implausible
        Takes values outside of `plausibility.PLAUSIBLE` as they are; they suggest other units.
    max_lateral_acceleration
        Bound of |ay| in planned speed profiles, m/s^2: a limit of comfort, not of the tyres; by
        default 2, the largest lateral acceleration of kumar2025lpv's table of trajectories.

    Raises
    ------
    ValueError
        If a parameter is not positive although it must be, a range is empty or not finite, a value
        is implausible, or the dynamics are too fast to be integrated.
    """

    name: str
    source: str
    mass: float
    yaw_inertia: float
    front_axle_distance: float
    rear_axle_distance: float
    front_cornering_stiffness: float
    rear_cornering_stiffness: float
    rolling_resistance: float
    max_steering_angle: float = math.pi / 6
    max_steering_rate: float = math.pi / 300 / 0.02
    acceleration_range: tuple[float, float] = (-5.0, 3.5)
    max_jerk: float = 0.1 / 0.02
    longitudinal_acceleration_range: tuple[float, float] = (-4.0, 2.0)
    speed_range: tuple[float, float] = (1.0, 30.0)
    max_lateral_velocity_ratio: float = 0.17
    length: float = 4.5
    width: float = 1.8
    centre_of_gravity_height: float = None  # type: ignore[assignment]  # by the wheelbase
    implausible: bool = False
    max_lateral_acceleration: float = 2.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name == "source" and isinstance(value, str):
                value = " ".join(value.split())  # may be written on several lines
            elif field.name == "centre_of_gravity_height" and value is None:
                value = HEIGHT_SHARE * self.wheelbase  # its fields come before this one
            wanted = _wanted(field.name, value)
            if wanted is not None:
                raise ValueError(
                    f"vehicle {shown(self.name)}: {field.name} must be {wanted}, not {shown(value)}"
                )
            if field.name.endswith("_range"):
                value = (float(value[0]), float(value[1]))
            elif not isinstance(value, str | int | float):  # of NumPy or PyTorch
                value = float(value)
            object.__setattr__(self, field.name, value)
        check_plausible(vars(self))
        check_computable(vars(self))

    @property
    def wheelbase(self) -> float:
        """Distance lf + lr between the axles, m."""
        return self.front_axle_distance + self.rear_axle_distance

    @property
    def lowest_speed(self) -> float:
        """Speed at which brakes hold the vehicle, m/s: 0, or -inf for one that reverses."""
        return 0.0 if self.speed_range[0] >= 0.0 else -math.inf

    @property
    def lowest_start(self) -> float:
        """Lowest speed of a start, m/s: standstill, or that of a vehicle that reverses."""
        return min(self.speed_range[0], 0.0)

    @property
    def rolling_deceleration(self) -> float:
        """Deceleration mu g caused by rolling resistance, m/s^2."""
        return self.rolling_resistance * GRAVITY

    @property
    def understeer_gradient(self) -> float:
        """Steering angle beyond L kappa in a steady turn, per lateral acceleration, rad s^2/m.

        K = m (lr Car - lf Caf) / (L Caf Car) (Rajamani, Vehicle Dynamics and Control, section 3.3).
        """
        caf, car = self.front_cornering_stiffness, self.rear_cornering_stiffness
        lf, lr = self.front_axle_distance, self.rear_axle_distance
        return self.mass * (lr * car - lf * caf) / (self.wheelbase * caf * car)

    def sharpest_turns(self, speed: Array) -> tuple[Array, Array]:
        """Return the largest curvatures of steady turns at speeds vx (n,), 1/m, shape (n,).

        The first is limited by `max_steering_angle`, the second by `max_lateral_velocity_ratio`: in
        a steady turn vy = b r with b = lr - m vx^2 lf/(L Car), and the steering angle is
        (L + K vx^2) r/vx with the understeer gradient K; the curvature is r/sqrt(vx^2 + vy^2).
        """
        squared = speed * speed
        lever = self.rear_axle_distance - squared * (
            self.mass * self.front_axle_distance / self.wheelbase / self.rear_cornering_stiffness
        )
        steered = np.maximum(self.wheelbase + self.understeer_gradient * squared, 1e-9)
        by_steering = self.max_steering_angle / steered
        by_sideslip = self.max_lateral_velocity_ratio / np.maximum(np.abs(lever), 1e-9)
        return (
            by_steering / np.hypot(1.0, by_steering * lever),
            by_sideslip / np.hypot(1.0, by_sideslip * lever),
        )

    def as_array(self) -> NDArray[np.float64]:
        """Physical parameters in `PARAMETER_ORDER`, shape (7,), for compiled kernels."""
        return np.array([getattr(self, name) for name in PARAMETER_ORDER])

    def replace(self, **changes: object) -> "VehicleParameters":
        """Return a copy with some parameters changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]

    def as_dict(self) -> dict[str, object]:
        """Parameters as plain values for JSON."""
        values = dataclasses.asdict(self)
        for field in dataclasses.fields(self):  # as in files of before there were these fields
            if field.name in NEWER_FIELDS and values[field.name] == field.default:
                del values[field.name]
        return values


COURSE_CAR = VehicleParameters(
    name="course-car",
    source=(
        "public course material on LPV-MPC with the equations and limits of kumar2025lpv: "
        "m, Iz, lf, lr, Caf, Car, mu; height of the centre of gravity: a car's (bmw-320i, "
        "ford-escort), not the share of a wheelbase of 5 m"
    ),
    mass=1500.0,
    yaw_inertia=3000.0,
    front_axle_distance=2.0,
    rear_axle_distance=3.0,
    front_cornering_stiffness=19000.0,
    rear_cornering_stiffness=33000.0,
    rolling_resistance=0.02,
    length=5.8,
    width=1.9,
    centre_of_gravity_height=0.56,
)

M2_MINIBUS = VehicleParameters(
    name="m2-minibus",
    source=(
        "this project's estimate of the M2 minibus (up to 5 t) of kumar2025lpv, "
        "whose parameters were not published; height of the centre of gravity: 0.27 of the "
        "wheelbase, between CommonRoad's cars (0.23) and its smaller, higher van (0.30)"
    ),
    mass=3500.0,
    yaw_inertia=8000.0,
    front_axle_distance=1.6,
    rear_axle_distance=1.7,
    front_cornering_stiffness=90000.0,
    rear_cornering_stiffness=110000.0,
    rolling_resistance=0.02,
    length=5.5,
    width=2.0,
    centre_of_gravity_height=0.9,
)

TYRE_STIFFNESS_PER_LOAD = 21.92
"""1/rad: -p_ky1 of the tyre in CommonRoad's manual (Tab. 7), the slope of its Pacejka curve."""


def _commonroad(
    name: str,
    car: str,
    *,
    mass: float,
    yaw_inertia: float,
    front_axle_distance: float,
    rear_axle_distance: float,
    max_steering_angle: float,
    length: float,
    width: float,
    centre_of_gravity_height: float,
) -> VehicleParameters:
    """Make a vehicle of CommonRoad's manual, with tyres linearised at zero slip and static load.

    At small slip an axle's lateral force is C_S mu Fz = -p_ky1 Fz per rad, both in the single-track
    model (C_S = -p_ky1 / p_dy1, mu = p_dy1) and as the slope of the Pacejka curve. The loads are
    Fzf = m g lr / L and Fzr = m g lf / L, so Caf lf = Car lr: these vehicles steer neutrally. The
    models have no rolling resistance.
    """
    stiffness = TYRE_STIFFNESS_PER_LOAD * mass * GRAVITY
    wheelbase = front_axle_distance + rear_axle_distance
    return VehicleParameters(
        name=name,
        source=(
            f"{car} of M. Althoff, G. Würsching, 'CommonRoad: Vehicle Models', 2020, Tab. 6 "
            "(m, a, b, I_z, l, w, steering limits) and h_cg, as in commonroad-vehicle-models "
            "3.0.2; Caf, Car: its tyre's slope -p_ky1 (Tab. 7) at the axles' static loads"
        ),
        mass=mass,
        yaw_inertia=yaw_inertia,
        front_axle_distance=front_axle_distance,
        rear_axle_distance=rear_axle_distance,
        front_cornering_stiffness=stiffness * rear_axle_distance / wheelbase,
        rear_cornering_stiffness=stiffness * front_axle_distance / wheelbase,
        rolling_resistance=0.0,
        max_steering_angle=max_steering_angle,
        max_steering_rate=0.4,
        length=length,
        width=width,
        centre_of_gravity_height=centre_of_gravity_height,
    )


FORD_ESCORT = _commonroad(
    "ford-escort",
    "Ford Escort (vehicle 1)",
    mass=1225.8878467253344,
    yaw_inertia=1538.8533713561394,
    front_axle_distance=0.88392,
    rear_axle_distance=1.50876,
    max_steering_angle=0.91,
    length=4.298,
    width=1.674,
    centre_of_gravity_height=0.5577840000000001,
)

BMW_320I = _commonroad(
    "bmw-320i",
    "BMW 320i (vehicle 2)",
    mass=1093.2952334674046,
    yaw_inertia=1791.5995300122856,
    front_axle_distance=1.1561957064,
    rear_axle_distance=1.4227170936,
    max_steering_angle=1.066,
    length=4.508,
    width=1.61,
    centre_of_gravity_height=0.5748689544000001,
)

VW_VANAGON = _commonroad(
    "vw-vanagon",
    "VW Vanagon (vehicle 3)",
    mass=1478.8979637767998,
    yaw_inertia=2473.1176915564442,
    front_axle_distance=1.1507916024,
    rear_axle_distance=1.3211363976000001,
    max_steering_angle=1.023,
    length=4.569,
    width=1.844,
    centre_of_gravity_height=0.7478167416,
)

F1TENTH = VehicleParameters(
    name="f1tenth",
    source=(
        "1:10 car of F1TENTH: default parameters of f1tenth_gym (m, I, lf, lr, h, limits, size); "
        "Caf = mu C_Sf m g lr/L and Car = mu C_Sr m g lf/L with mu = 1.0489, C_Sf = 4.718/rad and "
        "C_Sr = 5.4562/rad, as in its single-track model; the jerk, 100 m/s^3, is this project's; "
        "planned speeds turn with half of mu g"
    ),
    mass=3.74,
    yaw_inertia=0.04712,
    front_axle_distance=0.15875,
    rear_axle_distance=0.17145,
    front_cornering_stiffness=1.0489 * 4.718 * 3.74 * GRAVITY * 0.17145 / 0.3302,
    rear_cornering_stiffness=1.0489 * 5.4562 * 3.74 * GRAVITY * 0.15875 / 0.3302,
    rolling_resistance=0.0,
    max_steering_angle=0.4189,
    max_steering_rate=3.2,
    acceleration_range=(-9.51, 9.51),
    max_jerk=100.0,
    longitudinal_acceleration_range=(-9.0, 9.0),
    speed_range=(0.5, 20.0),
    # At full lock vy / vx is lr tan(0.4189) / L = 0.23, at the limit of grip -0.18.
    max_lateral_velocity_ratio=0.3,
    length=0.58,
    width=0.31,
    centre_of_gravity_height=0.074,
    max_lateral_acceleration=5.0,
)


def _kart_tyres(slope: float, load: float) -> float:
    """Return an axle's cornering stiffness by its load: two tyres of Lot and Dal Bianco's kart.

    Slope over slip of the Magic Formula: p_Ky1 Fz0 sin(p_Ky4 atan(Fz/(p_Ky2 Fz0))) with
    p_Ky2 = 1.6, p_Ky4 = 2 and Fz0 = 1.6 * 560 N.
    """
    nominal = 1.6 * 560.0
    return 2.0 * slope * nominal * math.sin(2.0 * math.atan(0.5 * load / (1.6 * nominal)))


KART = VehicleParameters(
    name="kart",
    source=(
        "racing kart with driver of R. Lot, N. Dal Bianco, 'Lap time optimisation of a racing "
        "go-kart', Vehicle System Dynamics 54(2), 2016, as in the database of fastest-lap (m, Izz, "
        "axles, height; Caf, Car: its tyres' slopes, p_Ky1 = 34.1 and 37.6, at static load); "
        "steering angle and size of AWSIM's kart of 160 kg; steering rate, jerk and "
        "accelerations are this project's: its rear brake locks at 4.5 m/s^2; planned speeds turn "
        "with 0.4 of its grip of 1.5 g"
    ),
    mass=165.0,
    yaw_inertia=25.0,
    front_axle_distance=0.645,
    rear_axle_distance=0.4,
    front_cornering_stiffness=_kart_tyres(34.1, 165.0 * GRAVITY * 0.4 / 1.045),
    rear_cornering_stiffness=_kart_tyres(37.6, 165.0 * GRAVITY * 0.645 / 1.045),
    rolling_resistance=0.01,
    max_steering_angle=0.64,
    max_steering_rate=2.0,
    acceleration_range=(-4.5, 4.5),
    max_jerk=20.0,
    longitudinal_acceleration_range=(-4.0, 3.5),
    # At full lock vy / vx is lr tan(0.64) / L = 0.285.
    max_lateral_velocity_ratio=0.35,
    length=2.0,
    width=1.45,
    centre_of_gravity_height=0.25,
    max_lateral_acceleration=6.0,
)

VEHICLES: dict[str, VehicleParameters] = {
    vehicle.name: vehicle
    for vehicle in (M2_MINIBUS, COURSE_CAR, FORD_ESCORT, BMW_320I, VW_VANAGON, F1TENTH, KART)
}
"""Vehicle presets by name."""


MOST_BYTES = 2**20
"""Largest vehicle file that is read, bytes."""


def load(vehicle: str | Path | VehicleParameters) -> VehicleParameters:
    """Return the vehicle of a preset's name or of a JSON file; parameters are returned as they are.

    Raises
    ------
    ValueError
        For an unknown name (the message lists the known ones and the nearest) or a bad file.
    """
    if isinstance(vehicle, VehicleParameters):
        return vehicle
    name = str(
        instance_of("vehicle", vehicle, str | Path, "a name, a .json file or VehicleParameters")
    )
    if name in VEHICLES:
        return VEHICLES[name]
    path = Path(name)
    if path.suffix == ".json":
        return _read(path)
    raise ValueError(
        f"unknown vehicle {shown(name)}; {suggestion(name, VEHICLES)}, "
        "or give a .json file with the fields of VehicleParameters"
    )


def _read(path: Path) -> VehicleParameters:
    values = read_json(path, MOST_BYTES)
    name = f"vehicle file {shortened(path)}"
    if not isinstance(values, dict):
        raise ValueError(f"{name} must hold one JSON object")  # noqa: TRY004
    values = {"name": path.stem, "source": str(path.name), **values}
    known = {field.name for field in dataclasses.fields(VehicleParameters)}
    if unknown := sorted(set(values) - known):
        raise ValueError(f"{name}: unknown field {shown(unknown[0])}; known: {sorted(known)}")
    try:
        return VehicleParameters(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from error
