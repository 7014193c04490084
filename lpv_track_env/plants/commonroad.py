"""CommonRoad's vehicle models as plants: the package `commonroad-vehicle-models`, extra `plants`.

M. Althoff, G. Würsching, "CommonRoad: Vehicle Models", 2020. The models are the package's own
functions f(x, u, p), compiled as they stand; parameters are the package's for the vehicle's name.
Their state order is [X, Y, delta, speed, psi, r, ...], their inputs are the steering rate and an
acceleration. What lies between them and the environment:

Reference point
    Centre of gravity; of the multi-body, that of its sprung mass, as its axle distances are. It
    sways with the body's roll.
Steering
    The rate that brings the front wheels within the period to where the steering actuator is: so
    the angle arrives at the period's end, and on the way lags behind that of `bicycle`, which the
    kernels hold from the period's start, by half a period on average. The actuator's limit of rate
    guarantees that the rate can be had. Limits of the angle and its rate are the environment's.
Acceleration
    a - mu g (in the direction of travel): the models have no rolling resistance of their own. To
    the single-track it is the rate of change of the speed, without the tyres' drag in a turn; to
    the other two it is a torque m R_w a on the wheels, so that slip, the front tyres' drag and the
    wheels' own inertia (2.6 % of the BMW's mass in `drift`, 5.3 % in `multi-body`) come off it. All
    of them limit it to the engine's power, a_max v_switch / v.
Speed
    Forwards only: brakes hold at standstill (v_min is 0), for in reverse the single-track's tyres
    push where they should damp, and the multi-body divides by zero. Below 0.1 m/s (drift: 0.2 m/s)
    the models pass to a kinematic one, abruptly but for the drift model.
Left and right
    The Pacejka tyre's data are not symmetric: r_vy1, r_by3, r_hx1 push to one side. Camber shifts a
    tyre's curve by p_hy1 and p_vy1 with its sign, however small it is: in the multi-body, whose
    wheels lean with its roll, side forces jump by 2 % of the load each way as a wheel's camber goes
    through zero. There integration converges at first order only.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y, inverse_speed
from lpv_track_env.plants.recompiled import recompiled
from lpv_track_env.vehicle import (
    BMW_320I,
    FORD_ESCORT,
    GRAVITY,
    PARAMETER_ORDER,
    VEHICLES,
    VW_VANAGON,
    VehicleParameters,
)
from trajectories.compilation import compiled_with_lists

try:
    import vehiclemodels
    from vehiclemodels.init_mb import init_mb
    from vehiclemodels.init_std import init_std
    from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
    from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st
    from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std
    from vehiclemodels.vehicle_parameters import setup_vehicle_parameters
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "this plant needs the package commonroad-vehicle-models: "
        'pip install "lpv-track-env[plants]"'
    ) from error

Array = NDArray[np.float64]

VEHICLE_IDS = {FORD_ESCORT.name: 1, BMW_320I.name: 2, VW_VANAGON.name: 3}
"""CommonRoad's number of each vehicle that all three models have parameters for."""

POSITION_X, POSITION_Y, STEERING, SPEED, HEADING, RATE, SIDESLIP = range(7)
"""Entries of every model's state; of the multi-body, SPEED is vx, SIDESLIP is its roll angle."""
LATERAL_SPEED = 10
"""Entry of the multi-body's state."""

MODELS = Path(vehiclemodels.__file__).parent

POLE_STEP = 1.0
"""Largest product of an integration step and a model's fastest pole; RK4 is stable up to 2.78."""
SLOWEST = 0.1
"""m/s; below, slips are taken relative to this speed (drift) or not at all."""

single_track_field = recompiled(vehicle_dynamics_st)
drift_field = recompiled(vehicle_dynamics_std)
multi_body_field = recompiled(vehicle_dynamics_mb)


@compiled_with_lists(MODELS)
def ahead(x: Array, rate: list[float], h: float) -> Array:
    """State h seconds on, at a constant rate of change."""
    y = x.copy()
    for k in range(x.size):
        y[k] += h * rate[k]
    return y


@compiled_with_lists(MODELS)
def combine(x: Array, h: float, k1: Any, k2: Any, k3: Any, k4: Any) -> None:
    """End a Runge-Kutta step (classic, order 4) of h seconds, in place."""
    for k in range(x.size):
        x[k] += h / 6.0 * (k1[k] + 2.0 * (k2[k] + k3[k]) + k4[k])


@compiled_with_lists(MODELS)
def drive_single_track(x: Array, u: tuple[float, float], p: Any, h: float, steps: int) -> None:
    """Take `steps` Runge-Kutta steps of h seconds, in place."""
    for _ in range(steps):
        k1 = single_track_field(x, u, p)
        k2 = single_track_field(ahead(x, k1, 0.5 * h), u, p)
        k3 = single_track_field(ahead(x, k2, 0.5 * h), u, p)
        k4 = single_track_field(ahead(x, k3, h), u, p)
        combine(x, h, k1, k2, k3, k4)


@compiled_with_lists(MODELS)
def drive_drift(x: Array, u: tuple[float, float], p: Any, h: float, steps: int) -> None:
    """Take `steps` Runge-Kutta steps of h seconds, in place."""
    for _ in range(steps):
        k1 = drift_field(x, u, p)
        k2 = drift_field(ahead(x, k1, 0.5 * h), u, p)
        k3 = drift_field(ahead(x, k2, 0.5 * h), u, p)
        k4 = drift_field(ahead(x, k3, h), u, p)
        combine(x, h, k1, k2, k3, k4)


@compiled_with_lists(MODELS)
def drive_multi_body(x: Array, u: tuple[float, float], p: Any, h: float, steps: int) -> None:
    """Take `steps` Runge-Kutta steps of h seconds, in place."""
    for _ in range(steps):
        k1 = multi_body_field(x, u, p)
        k2 = multi_body_field(ahead(x, k1, 0.5 * h), u, p)
        k3 = multi_body_field(ahead(x, k2, 0.5 * h), u, p)
        k4 = multi_body_field(ahead(x, k3, h), u, p)
        combine(x, h, k1, k2, k3, k4)


class CommonRoadPlant(ABC):
    """What the three have in common.

    Parameters
    ----------
    vehicle
        One of `VEHICLE_IDS`, with the physical parameters of its preset (actuators' limits and
        rolling resistance may differ).

    Raises
    ------
    ValueError
        For any other vehicle.
    """

    integrate: Callable[..., None]
    """Take Runge-Kutta steps (x, inputs, parameters, h, steps) in place."""
    longest_step: float
    """s; what the model's motion, beside its fastest pole, asks for."""

    def __init__(self, vehicle: VehicleParameters) -> None:
        self.rolling_deceleration = vehicle.rolling_deceleration
        self.parameters = parameters_of(vehicle)
        self.x = np.zeros(0)

    @abstractmethod
    def begin(self, state: Array, steering_angle: float) -> None:
        """Start an episode; see `Plant`."""

    @abstractmethod
    def body_velocity(self) -> tuple[float, float]:
        """Velocity (vx, vy) of the centre of gravity in the body's frame, m/s."""

    @abstractmethod
    def fastest_pole(self, speed: float) -> float:
        """Bound of the model's fastest pole at a speed in m/s (at least SLOWEST), 1/s."""

    def advance(self, acceleration: float, steering_angle: float, period: float) -> Array:
        """Drive one control period; see `Plant`."""
        vx, _ = self.body_velocity()
        rolling = self.rolling_deceleration * vx * float(inverse_speed(vx))
        inputs = ((steering_angle - self.x[STEERING]) / period, acceleration - rolling)
        steps = self.steps(inputs[1], period)
        self.integrate(self.x, inputs, self.parameters, period / steps, steps)
        return self.state()

    def steps(self, acceleration: float, period: float) -> int:
        """Integration steps of a control period, by the slowest speed that it comes to."""
        slowest = abs(float(self.x[SPEED])) - abs(acceleration) * period
        pole = self.fastest_pole(max(slowest, SLOWEST))
        return math.ceil(period / min(self.longest_step, POLE_STEP / pole))

    def state(self) -> Array:
        """[vx, vy, psi, r, X, Y], shape (6,)."""
        state = np.empty(6)
        state[VX], state[VY] = self.body_velocity()
        state[PSI], state[YAW_RATE] = self.x[HEADING], self.x[RATE]
        state[X], state[Y] = self.x[POSITION_X], self.x[POSITION_Y]
        return state


class _OneTrack(CommonRoadPlant):
    """State of the two single-track models: speed along the direction of travel, and sideslip."""

    def core(self, state: Array, steering_angle: float) -> list[float]:
        """First seven entries of the models' states."""
        vx, vy = float(state[VX]), float(state[VY])
        forwards = math.copysign(1.0, vx)
        return [
            float(state[X]),
            float(state[Y]),
            steering_angle,
            forwards * math.hypot(vx, vy),
            float(state[PSI]),
            float(state[YAW_RATE]),
            math.atan2(forwards * vy, forwards * vx),
        ]

    def body_velocity(self) -> tuple[float, float]:
        """Velocity (vx, vy) of the centre of gravity in the body's frame, m/s."""
        speed, sideslip = float(self.x[SPEED]), float(self.x[SIDESLIP])
        return speed * math.cos(sideslip), speed * math.sin(sideslip)

    def tyre_pole(self, speed: float) -> float:
        """Sum of the lateral dynamics' damping rates, 1/s: no smaller than its fastest pole."""
        p = self.parameters
        return float(-p.tire.p_ky1 * GRAVITY * (1.0 + p.m * p.a * p.b / p.I_z) / speed)


class SingleTrack(_OneTrack):
    """CommonRoad's single-track model (st), 7 states, tyres linear in slip and in load."""

    integrate = staticmethod(drive_single_track)
    longest_step = 0.005

    def begin(self, state: Array, steering_angle: float) -> None:
        """Start an episode; see `Plant`."""
        self.x = np.array(self.core(state, steering_angle))

    def fastest_pole(self, speed: float) -> float:
        """Bound of the fastest pole, the tyres', 1/s."""
        return self.tyre_pole(speed)


class Drift(_OneTrack):
    """CommonRoad's drift single-track model (std), 9 states: Pacejka tyres, one wheel an axle."""

    integrate = staticmethod(drive_drift)
    longest_step = 0.002

    def begin(self, state: Array, steering_angle: float) -> None:
        """Start an episode, wheels rolling without slip; see `Plant`."""
        self.x = np.array(init_std(self.core(state, steering_angle), self.parameters))

    def fastest_pole(self, speed: float) -> float:
        """Bound of the fastest pole, mostly that of a wheel's spin, 1/s."""
        p = self.parameters
        load = p.m * GRAVITY * max(p.a, p.b) / (p.a + p.b)
        spin = float(p.R_w**2 * p.tire.p_kx1 * load / (p.I_y_w * speed))
        return max(spin, self.tyre_pole(speed))


class MultiBody(CommonRoadPlant):
    """CommonRoad's multi-body model (mb), 29 states: suspension, compliance, four tyres."""

    integrate = staticmethod(drive_multi_body)
    longest_step = 0.001

    def begin(self, state: Array, steering_angle: float) -> None:
        """Start an episode, upright and at rest on its springs; see `Plant`."""
        vx, vy = float(state[VX]), float(state[VY])
        core = [float(state[X]), float(state[Y]), steering_angle, math.hypot(vx, vy)]
        core += [float(state[PSI]), float(state[YAW_RATE]), math.atan2(vy, vx)]
        self.x = np.array(init_mb(core, self.parameters), dtype=np.float64)

    def body_velocity(self) -> tuple[float, float]:
        """Velocity (vx, vy) of the sprung mass in the body's frame, m/s."""
        return float(self.x[SPEED]), float(self.x[LATERAL_SPEED])

    def fastest_pole(self, speed: float) -> float:
        """Bound of the fastest pole: a wheel's spin, or the roll of an axle on its tyres, 1/s."""
        p = self.parameters
        load = p.m * GRAVITY * max(p.a, p.b) / (p.a + p.b)
        spin = p.R_w**2 * p.tire.p_kx1 * 0.5 * load / (p.I_y_w * speed)
        roll = -(p.R_w**2) * p.tire.p_ky1 * load / (min(p.I_uf, p.I_ur) * speed)
        return float(max(spin, roll))


def parameters_of(vehicle: VehicleParameters) -> Any:
    """The package's parameters of a vehicle as a `numpy.record`, which compiled code reads too.

    Limits of the steering are the vehicle's own, for its actuator has kept to them.

    Raises
    ------
    ValueError
        If the package has no such vehicle, or physical parameters differ from its preset's.
    """
    known = ", ".join(VEHICLE_IDS)
    if vehicle.name not in VEHICLE_IDS:
        raise ValueError(
            f"CommonRoad's plants have no parameters for vehicle {vehicle.name!r}: take one of "
            f"{known}, or plant='bicycle'"
        )
    for name in PARAMETER_ORDER[:-1]:
        if getattr(vehicle, name) != getattr(VEHICLES[vehicle.name], name):
            raise ValueError(
                f"CommonRoad's plants have parameters of their own for {vehicle.name}: its {name} "
                "cannot be changed; take plant='bicycle'"
            )
    given = setup_vehicle_parameters(VEHICLE_IDS[vehicle.name])
    given.steering.max, given.steering.v_max = vehicle.max_steering_angle, vehicle.max_steering_rate
    given.steering.min, given.steering.v_min = -given.steering.max, -given.steering.v_max
    given.longitudinal.v_min = 0.0
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        # To plain Python `min` and `max` of a record are its methods.
        return given
    layout, values = _as_record(given)
    return np.array([values], dtype=layout)[0]


def _as_record(given: Any) -> tuple[np.dtype[Any], tuple[Any, ...]]:
    """Layout and values of a nested dataclass's numbers; what is None is left out."""
    layout: list[tuple[str, Any]] = []
    values: list[Any] = []
    for field in fields(given):
        value = getattr(given, field.name)
        kind: Any = np.float64
        if is_dataclass(value):
            kind, value = _as_record(value)
        if value not in (None, ()):
            layout.append((field.name, kind))
            values.append(value)
    return np.dtype((np.record, layout)), tuple(values)
