"""Estimator of a vehicle's state from its sensors: an extended Kalman filter, usable alone.

The environments run the same compiled filter (`estimation.filter`) to make observations.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import tyres
from lpv_track_env.bicycle import PSI, longest_substep
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.vehicle import VehicleParameters
from trajectories.arguments import Number, check_fields

Array = NDArray[np.float64]

NOT_NEGATIVE, POSITIVE = Number(0.0, 1e9), Number(1e-9, 1e9)
"""Rules of the settings; those of sensors are positive. Their squares are finite and above 0."""


@dataclass(frozen=True)
class EstimatorSettings:
    """Standard deviations that the filter assumes for its sensors and its model.

    The defaults fit the sensors of the conditions `realtime` (`lpv_track_env.conditions`).

    Parameters
    ----------
    position_deviation
        Noise of a fix on each axis, m.
    heading_deviation
        Noise of a heading reading, rad, without the bias.
    yaw_rate_deviation
        Noise of a yaw-rate reading, rad/s, without the bias.
    speed_deviation
        Noise of a wheel-speed reading, m/s.
    speed_noise, lateral_speed_noise
        Process noise of vx and vy, accumulated over one second, m/s.
    yaw_rate_noise
        Process noise of the yaw rate, over one second, rad/s.
    heading_noise
        Process noise of psi, over one second, rad.
    position_noise
        Process noise of X and Y, over one second, m; it includes errors of the fixes that last
        longer than a second.
    gyro_bias_noise, heading_bias_noise, steering_offset_noise
        Random walks of the biases over one second: rad/s, rad, rad.
    initial_gyro_bias, initial_heading_bias, initial_steering_offset
        Initial deviations of the biases: rad/s, rad, rad.
    fix_gate
        Largest NIS of a fix that is used: chi-square of 2 degrees of freedom, 0.9999 by default.
    reading_gate
        Largest NIS of any other reading: chi-square of 1 degree of freedom, 0.99994 by default.
    most_rejected
        Rejections of one sensor in a row after which its readings are used nevertheless.

    Raises
    ------
    ValueError
        If a value is negative or above 1e9, or a deviation of a sensor is below 1e-9.
    """

    position_deviation: float = 0.045
    heading_deviation: float = 0.005
    yaw_rate_deviation: float = 0.004
    speed_deviation: float = 0.08
    speed_noise: float = 0.4
    lateral_speed_noise: float = 0.1
    yaw_rate_noise: float = 0.05
    heading_noise: float = 0.001
    position_noise: float = 0.03
    gyro_bias_noise: float = 1e-4
    heading_bias_noise: float = 5e-4
    steering_offset_noise: float = 1e-3
    initial_gyro_bias: float = 0.003
    initial_heading_bias: float = 0.01
    initial_steering_offset: float = 0.01
    fix_gate: float = 18.4
    reading_gate: float = 16.0
    most_rejected: float = 20

    def __post_init__(self) -> None:
        rules = {
            field.name: POSITIVE if field.name.endswith(("_deviation", "_gate")) else NOT_NEGATIVE
            for field in fields(self)
        }
        check_fields(self, rules, prefix="estimator: ")

    def as_array(self, vehicle: VehicleParameters, friction: float = math.inf) -> Array:
        """Return the settings of the kernels, shape (`filter.SETTINGS`,), for a vehicle's model.

        `friction` is the coefficient of its tyres; inf makes them linear.
        """
        return np.array(
            [
                self.position_deviation**2,
                self.heading_deviation**2,
                self.yaw_rate_deviation**2,
                self.speed_deviation**2,
                self.speed_noise**2,
                self.lateral_speed_noise**2,
                self.heading_noise**2,
                self.yaw_rate_noise**2,
                self.position_noise**2,
                self.gyro_bias_noise**2,
                self.heading_bias_noise**2,
                self.steering_offset_noise**2,
                self.fix_gate,
                self.reading_gate,
                self.most_rejected,
                longest_substep(vehicle),
                *vehicle.as_array(),
                vehicle.lowest_speed,
                *tyres.of(vehicle, friction),
            ]
        )

    @property
    def initial_variances(self) -> Array:
        """Variances of the nine states after the first readings, shape (9,)."""
        deviations = [
            self.speed_deviation,
            self.lateral_speed_noise,
            # The first heading is a reading: its error consists of bias and noise.
            math.hypot(self.heading_deviation, self.initial_heading_bias),
            math.hypot(self.yaw_rate_deviation, self.initial_gyro_bias),
            self.position_deviation,
            self.position_deviation,
            self.initial_gyro_bias,
            self.initial_heading_bias,
            self.initial_steering_offset,
        ]
        return np.square(deviations)


class Estimator:
    """Extended Kalman filter of one vehicle, for logs and for the computer of a vehicle.

    Parameters
    ----------
    vehicle
        Parameters of the model.
    settings
        Noise, gates.
    memory
        Largest delay of a fix that is still used, s.
    period
        Expected time between calls of `advance`, s, which sizes the filter's past; calls may come
        at any time.
    friction
        Coefficient of friction of the model's tyres (`lpv_track_env.tyres`); inf makes them linear.

    Raises
    ------
    ValueError
        If a number is out of its range.

    Examples
    --------
    >>> estimator = Estimator(VEHICLES["m2-minibus"], period=0.02)
    >>> estimator.begin(0.0, x=0.0, y=0.0, heading=0.0, speed=5.0)
    >>> estimator.advance(0.02, 0.2, 0.0, heading=0.001, yaw_rate=0.0, speed=5.01)
    >>> estimator.take_fix(0.0, 0.01, -0.02)
    'used'
    """

    def __init__(
        self,
        vehicle: VehicleParameters,
        settings: EstimatorSettings | None = None,
        *,
        period: float = 0.02,
        memory: float = 0.3,
        friction: float = math.inf,
    ) -> None:
        if not (0.0 < period <= memory < math.inf):
            raise ValueError(f"period and memory must be 0 < {period} <= {memory} s")
        self.vehicle, self.settings = vehicle, settings or EstimatorSettings()
        self._settings = self.settings.as_array(vehicle, tyres.FRICTION.of("friction", friction))
        nodes = math.ceil(memory / period - 1e-9) + 1
        self._filter = np.zeros(filtering.FILTER + nodes * filtering.NODE)
        self._work = np.zeros(filtering.WORK)
        self._begun = False

    def begin(self, time: float, x: float, y: float, heading: float, speed: float) -> None:
        """Begin at `time` (s) from first readings in m, m, rad, m/s, driving straight.

        Raises
        ------
        ValueError
            For a reading that is not finite.
        """
        if not all(map(math.isfinite, (time, x, y, heading, speed))):
            raise ValueError("the estimator must begin from finite readings")
        m, states = self._filter, filtering.STATES
        m[:states] = [speed, 0.0, heading, 0.0, x, y, 0.0, 0.0, 0.0]
        covariance = np.diag(self.settings.initial_variances)
        # The heading was measured: its error is minus that of the bias.
        covariance[PSI, filtering.HEADING_BIAS] -= self.settings.initial_heading_bias**2
        covariance[filtering.HEADING_BIAS, PSI] -= self.settings.initial_heading_bias**2
        m[states : states + states**2] = covariance.ravel()
        filtering.begin_filter(m, float(time))
        self._begun = True

    def advance(
        self,
        time: float,
        acceleration: float,
        steering_angle: float,
        *,
        heading: float = math.nan,
        yaw_rate: float = math.nan,
        speed: float = math.nan,
    ) -> None:
        """Predict to `time`, then update with the readings there; NaN for a missing one.

        Parameters
        ----------
        time
            s, not before the time of the last call. A call for the same time adds readings.
        acceleration, steering_angle
            Mean inputs in force since the last call, as the actuators report them: m/s^2, rad.
        heading, yaw_rate, speed
            IMU and wheels: rad, rad/s, m/s. A reading beyond its gate is rejected and counted.

        Raises
        ------
        ValueError
            Before `begin`, for a time that goes back, or for inputs that are not finite.
        """
        self._check_begun()
        if not all(map(math.isfinite, (time, acceleration, steering_angle))):
            raise ValueError("time and inputs must be finite")
        if time < self.time:
            raise ValueError(f"time goes back: from {self.time} to {time} s")
        filtering.advance_filter(
            self._filter, float(time), float(acceleration), float(steering_angle), float(speed),
            float(yaw_rate), float(heading), self._settings, self._work,
        )  # fmt: skip

    def take_fix(self, stamp: float, x: float, y: float) -> str:
        """Update with a fix of the position (m) at `stamp` (s), however late it comes.

        Returns
        -------
        str
            "used"; "gated", beyond its gate; "late", older than `memory` or than an earlier fix, or
            the second one for a step; "duplicate"; or "not finite".
        """
        self._check_begun()
        code = filtering.take_fix(
            self._filter, float(stamp), float(x), float(y), self._settings, self._work
        )
        return filtering.FIX_RESULTS[code]

    def _check_begun(self) -> None:
        if not self._begun:
            raise ValueError("the estimator has not begun: call begin() first")

    @property
    def time(self) -> float:
        """Time of the estimate, s."""
        return float(self._filter[filtering.TIME])

    @property
    def state(self) -> Array:
        """Estimate of [vx, vy, psi, r, X, Y], (6,), a copy."""
        return self._filter[:6].copy()

    @property
    def biases(self) -> Array:
        """Estimates of yaw-rate bias (rad/s), heading bias and steering offset (rad), (3,)."""
        return self._filter[6:9].copy()

    @property
    def covariance(self) -> Array:
        """Covariance of state and biases, (9, 9), a copy."""
        first = filtering.COVARIANCE
        return self._filter[first : first + filtering.ENTRIES].reshape(9, 9).copy()

    @property
    def position_deviation(self) -> float:
        """Standard deviation of the position in its worst direction, m."""
        return float(filtering.deviation_of(self._filter))

    @property
    def fix_age(self) -> float:
        """Time since the last fix that was used, s."""
        return float(self._filter[filtering.FIX_AGE])

    @property
    def fix_nis(self) -> float:
        """Normalised innovation squared of the last fix (2 degrees of freedom); NaN if none."""
        return float(self._filter[filtering.FIX_NIS])

    @property
    def reading_nis(self) -> tuple[float, int]:
        """NIS of the last call's other readings, summed, and their number."""
        m = self._filter
        return float(m[filtering.READING_NIS]), int(m[filtering.READINGS])

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of fixes and readings since `begin`, by outcome."""
        f = filtering
        rows = {
            "fixes_used": f.FIXES_USED,
            "fixes_gated": f.FIXES_GATED,
            "fixes_late": f.FIXES_LATE,
            "fixes_duplicate": f.FIXES_DUPLICATE,
            "fixes_not_finite": f.FIXES_NOT_FINITE,
            "speeds_gated": f.SPEED_GATED,
            "yaw_rates_gated": f.YAW_RATE_GATED,
            "headings_gated": f.HEADING_GATED,
        }
        return {name: int(self._filter[row]) for name, row in rows.items()}
