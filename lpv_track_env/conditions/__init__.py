"""Conditions of a drive: imperfections of sensors, actuators, vehicle, air and computer.

`SIMULATION` is ideal. `REALTIME` is this project's model of runs with the paper's vehicle
(kumar2025lpv drives a minibus with GPS, IMU and wheel speed, and states no figures for them); the
table of `Conditions` gives the reason for each number. The modules of this package are the compiled
kernels that simulate the conditions.
"""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.estimation.estimator import EstimatorSettings
from lpv_track_env.tyres import FRICTION
from trajectories.arguments import Number, check_fields, flag, instance_of, numbers, shown
from trajectories.naming import choose

Array = NDArray[np.float64]
Range = float | tuple[float, float]
"""A number, or both ends of the range from which every episode draws it uniformly."""

ESTIMATORS = ("ekf", "raw", "truth")


class Actuation(NamedTuple):
    """Delays and lags between a command and its effect, as known from the vehicle's design; s."""

    computing_delay: float = 0.0
    steering_dead_time: float = 0.0
    steering_lag: float = 0.0
    drive_dead_time: float = 0.0
    drive_lag: float = 0.0


@dataclass(frozen=True)
class Conditions:
    """Conditions of a drive; every field is ideal by default.

    A field that is a `Range` may be a number, or (low, high), from which every episode draws
    uniformly with the environment's generator: domain randomisation. The third column is
    `REALTIME`.

    ======================  ======  =============  ================================================
    field                   unit    realtime       meaning, and why that number
    ======================  ======  =============  ================================================
    gnss_period             s       0.1            time between fixes: 10 Hz, common for vehicles
    gnss_latency            s       0.1            from a fix's stamp to its arrival: navigation
                                                   engine and serial line, one period of the fixes
    gnss_noise              m       0.03           white error of each axis: RTK receiver (10 mm +
                                                   1 ppm stated for open sky), three times that for
                                                   a moving vehicle between trees and buildings
    gnss_wander             m       0.03           standard deviation of an error that lasts:
                                                   multipath and corrections, Gauss-Markov of
    gnss_wander_time        s       20             this time constant
    gnss_dropout_rate       1/s     1/60           one outage a minute, under a bridge or trees
    gnss_dropout_duration   s       0.3 to 1.5     its length
    gnss_outlier_rate       1       0.005          share of fixes that are wrong altogether
    gnss_outlier_size       m       3              by this distance in any direction: a float or
                                                   single-point solution among the fixed ones
    heading_noise           rad     0.005          0.3 degrees: two antennas 1 to 2 m apart, or AHRS
    heading_bias            rad     -0.01 to 0.01  0.6 degrees: mounting of antennas or IMU
    yaw_rate_noise          rad/s   0.003          MEMS gyroscope on a vehicle with its vibrations
    yaw_rate_bias           rad/s   -3e-3 to 3e-3  0.17 degrees/s left after standstill calibration
    yaw_rate_drift          *       1e-4           the bias's random walk, rad/s per sqrt(s)
    speed_noise             m/s     0.05           wheel pulses over one period
    speed_scale             1       -0.01 to 0.01  relative error: tyre radius by wear and pressure
    steering_lag            s       0.06 to 0.12   time constant of the steering servo (first
                                                   order): bandwidths of 1.3 to 2.7 Hz
    steering_dead_time      s       0.02 to 0.05   from command to first motion: bus, servo cycle
    steering_offset         rad     -0.01 to 0.01  wheels against reported angle, 0.6 degrees
    drive_lag               s       0.15 to 0.3    time constant of drive and brakes
    drive_dead_time         s       0.05 to 0.1    of the drive's control unit
    mass_factor             1       0.9 to 1.25    true mass by the model's: empty to full bus. The
                                                   drive meters a force by the model's mass
    inertia_factor          1       0.9 to 1.25    true yaw inertia by the model's
    front_stiffness_factor  1       0.85 to 1.15   true cornering stiffness by the model's: tyres
    rear_stiffness_factor   1       0.85 to 1.15   differ so between makes, loads and pressures
    rolling_factor          1       0.7 to 1.5     true rolling resistance by the model's
    friction                1       0.6 to 1.0     of tyre and road: damp to dry asphalt; inf by
                                                   default, a tyre that stays linear (see below)
    wind_speed              m/s     0 to 8         mean wind, its direction drawn: fresh breeze
    gust_speed              m/s     0 to 2         standard deviation of gusts along it, of
    gust_time               s       3              this time constant
    side_area               m^2     12             area times side force coefficient, of the body of
                                                   a minibus; its centre lies `WIND_LEVER` ahead
    computing_delay         s       5e-3 to 0.02   from reading to command: messages and scheduling,
                                                   and the controller's own time
    ======================  ======  =============  ================================================

    Further settings:

    estimator
        Source of the observations: "ekf", the extended Kalman filter; "raw", the last fix, the
        heading, yaw rate and speed as measured, and no lateral speed; "truth", the true state,
        whatever the sensors' noise.
    estimator_settings
        Noise that the filter assumes (`lpv_track_env.estimation.estimator.EstimatorSettings`); by
        default that of the sensors, see `filter_settings`.
    calibrate_steering
        True subtracts the filter's estimate of the steering offset from every command.
    max_fix_age
        Time without a usable fix, s, after which the vehicle brakes to a stop until there is one.
    max_command_age
        Time without a new command, s, after which it brakes, too; by default three control periods.
    slippery_stretch, slippery_factor
        Arc lengths (start, end), m, between which the friction is the drawn one times this factor:
        a wet or icy place, of which neither agents nor filter know. It has no effect where tyres
        are linear: with friction inf, except on `drift` and `multi-body`.

    Friction limits what the tyres' side forces and the drive or brakes can do together, with the
    load that braking shifts between the axles: the model of `lpv_track_env.tyres`.

    A plant other than the bicycle (`lpv_track_env.plants`) has its own mass, inertia, stiffness,
    rolling resistance and wind: the fields for these have no effect. Friction multiplies the grip
    of `drift` and `multi-body`, 1.05 on their own road; on plants without such a limit
    (`single-track`) it has no effect, and the environment warns.

    A computation that takes longer than a control period makes the controller miss the next
    deadline: its action is dropped, the command in force is held, and `deadline_misses` counts it.

    Raises
    ------
    ValueError
        For a number that is not finite or out of its range, or an unknown estimator.
    """

    name: str = "custom"
    gnss_period: float = 0.1
    gnss_latency: Range = 0.0
    gnss_noise: Range = 0.0
    gnss_wander: Range = 0.0
    gnss_wander_time: Range = 20.0
    gnss_dropout_rate: Range = 0.0
    gnss_dropout_duration: Range = 1.0
    gnss_outlier_rate: Range = 0.0
    gnss_outlier_size: Range = 3.0
    heading_noise: Range = 0.0
    heading_bias: Range = 0.0
    yaw_rate_noise: Range = 0.0
    yaw_rate_bias: Range = 0.0
    yaw_rate_drift: Range = 0.0
    speed_noise: Range = 0.0
    speed_scale: Range = 0.0
    steering_lag: Range = 0.0
    steering_dead_time: Range = 0.0
    steering_offset: Range = 0.0
    drive_lag: Range = 0.0
    drive_dead_time: Range = 0.0
    mass_factor: Range = 1.0
    inertia_factor: Range = 1.0
    front_stiffness_factor: Range = 1.0
    rear_stiffness_factor: Range = 1.0
    rolling_factor: Range = 1.0
    friction: Range = math.inf
    wind_speed: Range = 0.0
    gust_speed: Range = 0.0
    gust_time: Range = 3.0
    side_area: Range = 12.0
    computing_delay: Range = 0.0
    estimator: str = "ekf"
    estimator_settings: EstimatorSettings | None = None
    calibrate_steering: bool = True
    max_fix_age: float = 2.0
    max_command_age: float | None = None
    slippery_stretch: tuple[float, float] = (0.0, 0.0)
    slippery_factor: float = 1.0

    def __post_init__(self) -> None:
        instance_of("conditions: name", self.name, str, "a text")
        choose("estimator", self.estimator, ESTIMATORS)
        settings = self.estimator_settings
        if settings is not None:
            instance_of(
                "conditions: estimator_settings", settings, EstimatorSettings, "EstimatorSettings"
            )
        for name in DRAWN:
            object.__setattr__(self, name, _checked(name, getattr(self, name)))
        calibrate = flag("conditions: calibrate_steering", self.calibrate_steering)
        object.__setattr__(self, "calibrate_steering", calibrate)
        stretch = numbers("conditions: slippery_stretch", self.slippery_stretch, STRETCH, 2)
        object.__setattr__(self, "slippery_stretch", stretch)
        ages = {"max_fix_age": AGE, "slippery_factor": FRICTION_FACTOR}
        if self.max_command_age is not None:
            ages["max_command_age"] = AGE
        check_fields(self, {"gnss_period": GNSS_PERIOD, **ages}, prefix="conditions: ")

    def replace(self, **changes: object) -> "Conditions":
        """Return a copy with some fields changed, named "custom" unless a name is given."""
        changed = {"name": "custom", **changes}
        return dataclasses.replace(self, **changed)  # type: ignore[arg-type]

    def ends(self, name: str) -> tuple[float, float]:
        """Both ends of a field that may be a range."""
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    def middle(self, name: str) -> float:
        """Middle of a field's range."""
        low, high = self.ends(name)
        return 0.5 * (low + high)

    @property
    def actuation(self) -> Actuation:
        """Delays and lags as known beforehand: the middles of their ranges."""
        return Actuation(*(self.middle(name) for name in Actuation._fields))

    @property
    def filter_settings(self) -> EstimatorSettings:
        """Settings of the filter: those given, or noise at the middles of the sensors' ranges.

        The wander of the fixes counts as noise, and so does the scale error of the wheel speed, at
        `USUAL_SPEED`. The deviations of the biases are their largest values. Every deviation has a
        lower bound.
        """
        if self.estimator_settings is not None:
            return self.estimator_settings

        def most(name: str) -> float:
            return max(map(abs, self.ends(name)))

        return EstimatorSettings(
            position_deviation=math.hypot(
                self.middle("gnss_noise"), self.middle("gnss_wander"), 0.01
            ),
            heading_deviation=math.hypot(self.middle("heading_noise"), 0.001),
            yaw_rate_deviation=math.hypot(self.middle("yaw_rate_noise"), 0.001),
            speed_deviation=math.hypot(
                self.middle("speed_noise"), most("speed_scale") * USUAL_SPEED, 0.01
            ),
            initial_gyro_bias=max(most("yaw_rate_bias"), 1e-4),
            initial_heading_bias=max(most("heading_bias"), 1e-4),
            initial_steering_offset=max(most("steering_offset"), 1e-4),
        )

    def ranges(self) -> Array:
        """Both ends of every field that is drawn, shape (len(DRAWN), 2), in the order of DRAWN."""
        return np.array([self.ends(name) for name in DRAWN])

    def departures(self) -> Iterator[tuple[str, object]]:
        """Yield the fields that are not ideal, with their values."""
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if item.name not in {"name", "estimator_settings"} and value != getattr(
                IDEAL, item.name
            ):
                yield item.name, value

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return dataclasses.asdict(self)


DRAWN = tuple(item.name for item in dataclasses.fields(Conditions) if item.type in {Range, "Range"})
"""Fields that may be ranges, in the order in which they are drawn."""

GNSS_PERIOD, AGE = Number(0.001, 1e6, "s"), Number(0.0, math.inf, "s", above=True)
"""Rules of the time between fixes, and of the ages after which the vehicle brakes."""
STRETCH, FRICTION_FACTOR = Number(0.0, 1e9, "m"), Number(0.001, 1000.0)
"""Rules of the ends of a slippery stretch, and of the factor of friction there."""
DELAYS = ("gnss_latency", "steering_dead_time", "drive_dead_time", "computing_delay")
"""Fields that are at most `LONGEST_DELAY`."""
LONGEST_DELAY = 2.0
"""Largest delay, s: it bounds the sizes of the arrays."""
DELAY = Number(0.0, LONGEST_DELAY, "s")
RULES: dict[str, Number] = {
    **dict.fromkeys(DRAWN, Number(0.0, 1e6)),
    **dict.fromkeys(DELAYS, DELAY),
    **dict.fromkeys(
        ("mass_factor", "inertia_factor", "front_stiffness_factor", "rear_stiffness_factor"),
        Number(0.01, 100.0),
    ),
    **dict.fromkeys(("gnss_wander_time", "gust_time"), Number(1e-3, 1e9, "s")),
    **dict.fromkeys(
        ("heading_bias", "yaw_rate_bias", "speed_scale", "steering_offset"), Number(-1e6, 1e6)
    ),
    "rolling_factor": Number(0.0, 1000.0),
    "friction": FRICTION,
}
"""Rule of every field that may be a range."""
USUAL_SPEED = 8.0
"""Speed at which the filter's settings convert the scale error of the wheels to noise, m/s."""
WIND_LEVER = 0.3
"""Distance from the centre of gravity forward to the point of the side wind, m: bluff fronts."""


def _checked(name: str, value: object) -> Range:
    """Return a field's number or ordered pair of numbers as floats.

    Raises
    ------
    ValueError
        Naming the field.
    """
    rule = RULES[name]
    try:
        if not isinstance(value, tuple | list):
            return rule.of(name, value)
        low, high = (rule.of(name, end) for end in value)
        if low <= high < math.inf:
            return low, high
    except ValueError:
        pass
    raise ValueError(
        f"conditions: {name} must be {rule}, or (low, high) of such, not {shown(value)}"
    )


IDEAL = Conditions("ideal", estimator="truth")
"""Perfect in every respect, as `simulation`, but computed by the kernels of conditions."""

REALTIME = Conditions(
    "realtime",
    gnss_latency=0.1,
    gnss_noise=0.03,
    gnss_wander=0.03,
    gnss_dropout_rate=1.0 / 60.0,
    gnss_dropout_duration=(0.3, 1.5),
    gnss_outlier_rate=0.005,
    heading_noise=0.005,
    heading_bias=(-0.01, 0.01),
    yaw_rate_noise=0.003,
    yaw_rate_bias=(-0.003, 0.003),
    yaw_rate_drift=1e-4,
    speed_noise=0.05,
    speed_scale=(-0.01, 0.01),
    steering_lag=(0.06, 0.12),
    steering_dead_time=(0.02, 0.05),
    steering_offset=(-0.01, 0.01),
    drive_lag=(0.15, 0.3),
    drive_dead_time=(0.05, 0.1),
    mass_factor=(0.9, 1.25),
    inertia_factor=(0.9, 1.25),
    front_stiffness_factor=(0.85, 1.15),
    rear_stiffness_factor=(0.85, 1.15),
    rolling_factor=(0.7, 1.5),
    friction=(0.6, 1.0),
    wind_speed=(0.0, 8.0),
    gust_speed=(0.0, 2.0),
    computing_delay=(0.005, 0.02),
)

RANDOMISED = REALTIME.replace(
    name="randomised",
    gnss_noise=(0.01, 0.15),
    steering_lag=(0.05, 0.2),
    steering_dead_time=(0.0, 0.1),
)
"""`REALTIME` for less well-known vehicles: receivers from RTK to metre class, fast to slow servos,
dead times up to two periods of 0.05 s. Weights are tuned under these conditions."""

SIMULATION = "simulation"
PRESETS: dict[str, Conditions | None] = {
    SIMULATION: None,
    "realtime": REALTIME,
    "randomised": RANDOMISED,
    "ideal": IDEAL,
}
"""Conditions by name; None stands for the kernels without conditions."""


def load(value: "str | Conditions | dict[str, Any]") -> Conditions | None:
    """Resolve a preset's name, a dictionary of fields, or conditions; None is `simulation`.

    A dictionary may name the preset that it changes as `name`: {"name": "realtime",
    "estimator": "raw"}.

    Raises
    ------
    ValueError
        For an unknown name or field; the message lists the known ones and the nearest.
    """
    if isinstance(value, Conditions):
        return value
    if isinstance(value, dict):
        known = tuple(item.name for item in dataclasses.fields(Conditions))
        changes = dict(value)
        for key in changes:
            choose("field of conditions", key, known)
        preset = PRESETS[choose("conditions", changes.pop("name", "ideal"), tuple(PRESETS))]
        settings: Any = changes.pop("estimator_settings", None)
        if isinstance(settings, EstimatorSettings):
            settings = dataclasses.asdict(settings)
        if settings is not None:
            instance_of(
                "conditions: estimator_settings", settings, dict, "a dictionary of settings"
            )
        for key in settings or {}:
            choose("estimator setting", key, tuple(EstimatorSettings.__dataclass_fields__))
        if not (changes or settings):
            return preset
        changed = (preset or IDEAL).replace(**changes)
        if settings:
            filtered = dataclasses.replace(changed.filter_settings, **settings)
            changed = changed.replace(estimator_settings=filtered)
        return changed
    return PRESETS[choose("conditions", value, tuple(PRESETS))]
