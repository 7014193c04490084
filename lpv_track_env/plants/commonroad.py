"""CommonRoad's vehicle models as plants, from `commonroad-vehicle-models` (the extra `plants`).

M. Althoff, G. Würsching, "CommonRoad: Vehicle Models", 2020. The models are the package's own
functions f(x, u, p), compiled unchanged, with the package's parameters for the vehicle's name.
Their state is [X, Y, delta, speed, psi, r, ...], their inputs are the steering rate and an
acceleration. They are connected to the environment as follows:

Reference point
    The centre of gravity; of the multi-body, the one of its sprung mass, to which its axle
    distances refer, too. It sways with the body's roll.
Steering
    The rate that turns the front wheels to the steering actuator's angle within the period. So the
    angle is reached at the period's end. On the way it lags, by half a period on average, behind
    the angle of `bicycle`, which the kernels hold from the period's start. The actuator's rate
    limit guarantees that the rate is feasible. Limits of angle and rate are the environment's.
Acceleration
    a - mu g (in the direction of travel): the models have no rolling resistance. For the
    single-track it is the rate of change of the speed, without the tyres' drag in a turn. For the
    other two it is a torque m R_w a on the wheels, reduced by slip, by the front tyres' drag and by
    the wheels' inertia (2.6 % of the BMW's mass in `drift`, 5.3 % in `multi-body`). All three limit
    it to the engine's power, a_max v_switch / v.
Speed
    Forwards only: brakes hold at standstill (v_min is 0), because in reverse the tyres of the
    single-track push where they should damp, and the multi-body divides by zero. Below 0.1 m/s
    (drift: 0.2 m/s) the models switch to a kinematic one, abruptly except for the drift model.
Left and right
    The data of the Pacejka tyre are not symmetric: r_vy1, r_by3, r_hx1 push to one side. Camber,
    however small, shifts a tyre's curve by p_hy1 and p_vy1 with its sign. In the multi-body, whose
    wheels lean with its roll, side forces jump by 2 % of the load each way when a wheel's camber
    passes zero; there the integration converges with first order only.
Friction
    The Pacejka tyre's own road has peaks of 1.05 sideways (p_dy1) and 1.17 along (p_dx1) by load.
    The friction of the environment's conditions multiplies both; slopes at zero slip stay. The
    single-track's tyre is linear and has no limit.
"""

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y, inverse_speed
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import (
    BMW_320I,
    FORD_ESCORT,
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
"""CommonRoad's numbers of the vehicles for which all three models have parameters."""

POSITION_X, POSITION_Y, STEERING, SPEED, HEADING, RATE, SIDESLIP = range(7)
"""Entries of every model's state; in the multi-body, SPEED is vx and SIDESLIP the roll angle."""
LATERAL_SPEED = 10
"""Entry of the multi-body's state, vy."""

MODELS = Path(vehiclemodels.__file__).parent
"""Folder of the package's sources."""

POLE_STEP = 1.0
"""Largest product of an integration step and a model's fastest pole; RK4 is stable up to 2.78."""
SLOWEST = 0.1
"""m/s; below it, slips are relative to this speed (drift) or not computed at all."""


def recompiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of another package, and the functions of that package that it calls.

    numba compiles a call only if the called function is compiled itself. So each function is bound
    anew, its code unchanged, to globals that contain the compiled functions. All of them must be
    plain functions of numbers, arrays and lists of floats, called by their names or as attributes
    of modules.
    """
    compiled: Callable[..., Any] = _Recompiler(_package(function.__module__)).function(function)
    return compiled


def _package(module: str) -> str:
    return module.partition(".")[0]


class _Recompiler:
    """Bind each function and each module of a package once."""

    def __init__(self, package: str) -> None:
        self.package = package
        self.known: dict[Any, Any] = {}

    def function(self, function: Any) -> Any:
        if function not in self.known:
            code = function.__code__
            bound = FunctionType(code, self.bindings(function.__globals__, code.co_names))
            self.known[function] = compiled_with_lists()(bound)
        return self.known[function]

    def module(self, module: ModuleType) -> ModuleType:
        if module not in self.known:
            bound = ModuleType(module.__name__)
            bound.__dict__.update(self.bindings(vars(module), tuple(vars(module))))
            self.known[module] = bound
        return self.known[module]  # type: ignore[no-any-return]

    def bindings(self, names: dict[str, Any], used: tuple[str, ...]) -> dict[str, Any]:
        """Copy global names; replace used functions and modules of the package by compiled ones."""
        bound = dict(names)
        for name in used:
            value = names.get(name)
            if inspect.isfunction(value) and _package(value.__module__) == self.package:
                bound[name] = self.function(value)
            elif inspect.ismodule(value) and _package(value.__name__) == self.package:
                bound[name] = self.module(value)
        return bound


single_track_field = recompiled(vehicle_dynamics_st)
drift_field = recompiled(vehicle_dynamics_std)
multi_body_field = recompiled(vehicle_dynamics_mb)


@compiled_with_lists(MODELS)
def ahead(x: Array, rate: list[float], h: float) -> Array:
    """State after h seconds at a constant rate of change."""
    y = x.copy()
    for k in range(x.size):
        y[k] += h * rate[k]
    return y


@compiled_with_lists(MODELS)
def combine(x: Array, h: float, k1: Any, k2: Any, k3: Any, k4: Any) -> None:
    """Complete a classic Runge-Kutta step (order 4) of h seconds, in place."""
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
    """Common base of the three plants.

    Parameters
    ----------
    vehicle
        One of `VEHICLE_IDS`, with the physical parameters of its preset (limits of the actuators
        and rolling resistance may differ).

    Raises
    ------
    ValueError
        For any other vehicle.
    """

    integrate: Callable[..., None]
    """Take Runge-Kutta steps (x, inputs, parameters, h, steps) in place."""
    longest_step: float
    """Longest integration step, s, where the fastest pole does not require a shorter one."""

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
        """Upper bound of the model's fastest pole, 1/s, at a speed (m/s) of at least SLOWEST."""

    def advance(self, acceleration: float, steering_angle: float, period: float) -> Array:
        """Drive one control period; see `Plant`."""
        vx, _ = self.body_velocity()
        rolling = self.rolling_deceleration * vx * float(inverse_speed(vx))
        inputs = ((steering_angle - self.x[STEERING]) / period, acceleration - rolling)
        steps = self.steps(inputs[1], period)
        self.integrate(self.x, inputs, self.parameters, period / steps, steps)
        return self.state()

    def steps(self, acceleration: float, period: float) -> int:
        """Number of integration steps of a control period, from the lowest speed in it."""
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
    """Base of the two single-track models: their state holds total speed and sideslip."""

    def core(self, state: Array, steering_angle: float) -> list[float]:
        """Return the first seven entries of the model's state."""
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
        """Sum of the damping rates of the lateral dynamics, 1/s: at least its fastest pole."""
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
        """Upper bound of the fastest pole, which the tyres cause, 1/s."""
        return self.tyre_pole(speed)


class _Pacejka(CommonRoadPlant):
    """Base of the plants with a Pacejka tyre, whose peaks are the friction of its road."""

    def __init__(self, vehicle: VehicleParameters) -> None:
        super().__init__(vehicle)
        tyre = self.parameters.tire
        self._peaks = float(tyre.p_dx1), float(tyre.p_dy1)

    @property
    def friction(self) -> float:
        """Largest side force by load on the tyre's own road."""
        return self._peaks[1]

    def set_friction(self, factor: float) -> None:
        """Multiply the road's own friction; see `RoadPlant`."""
        tyre = self.parameters.tire
        tyre.p_dx1, tyre.p_dy1 = factor * self._peaks[0], factor * self._peaks[1]


class Drift(_Pacejka, _OneTrack):
    """CommonRoad's drift single-track model (std), 9 states: Pacejka tyres, one wheel an axle."""

    integrate = staticmethod(drive_drift)
    longest_step = 0.002

    def begin(self, state: Array, steering_angle: float) -> None:
        """Start an episode, wheels rolling without slip; see `Plant`."""
        self.x = np.array(init_std(self.core(state, steering_angle), self.parameters))

    def fastest_pole(self, speed: float) -> float:
        """Upper bound of the fastest pole, mostly of a wheel's spin, 1/s."""
        p = self.parameters
        load = p.m * GRAVITY * max(p.a, p.b) / (p.a + p.b)
        spin = float(p.R_w**2 * p.tire.p_kx1 * load / (p.I_y_w * speed))
        return max(spin, self.tyre_pole(speed))


class MultiBody(_Pacejka):
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
        """Upper bound of the fastest pole, a wheel's spin or an axle's roll on its tyres, 1/s."""
        p = self.parameters
        load = p.m * GRAVITY * max(p.a, p.b) / (p.a + p.b)
        spin = p.R_w**2 * p.tire.p_kx1 * 0.5 * load / (p.I_y_w * speed)
        roll = -(p.R_w**2) * p.tire.p_ky1 * load / (min(p.I_uf, p.I_ur) * speed)
        return float(max(spin, roll))


def parameters_of(vehicle: VehicleParameters) -> Any:
    """Return the package's parameters of a vehicle as a `numpy.record`, for compiled code.

    The steering limits are those of `vehicle`, which its actuator has already applied.

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
        # In plain Python `min` and `max` of a record would be its methods.
        return given
    layout, values = _as_record(given)
    return np.array([values], dtype=layout)[0]


def _as_record(given: Any) -> tuple[np.dtype[Any], tuple[Any, ...]]:
    """Layout and values of the numbers in a nested dataclass; None is left out."""
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
