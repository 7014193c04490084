"""Arrays of a vehicle under conditions, and how conditions are written into them.

A vehicle (`m` in the kernels) is one float64 array: the values drawn from its conditions, the true
parameters, actuators, wind and sensors, the estimate as a record of its own (see `kernels`), the
commands that have not landed, the fixes that have not arrived, and the filter (see
`estimation.filter`). The conditions of an environment are one array, too, its spec: the ranges to
draw from, settings, capacities.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.conditions import DELAY, DRAWN, ESTIMATORS, Conditions
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.vehicle import PARAMETER_ORDER, VehicleParameters
from trajectories.compilation import compiled_internal

Array = NDArray[np.float64]

COUNT = len(DRAWN)
(
    GNSS_LATENCY, GNSS_NOISE, GNSS_WANDER, GNSS_WANDER_TIME, GNSS_DROPOUT_RATE,
    GNSS_DROPOUT_DURATION, GNSS_OUTLIER_RATE, GNSS_OUTLIER_SIZE, HEADING_NOISE, HEADING_BIAS,
    YAW_RATE_NOISE, YAW_RATE_BIAS, YAW_RATE_DRIFT, SPEED_NOISE, SPEED_SCALE, STEERING_LAG,
    STEERING_DEAD_TIME, STEERING_OFFSET, DRIVE_LAG, DRIVE_DEAD_TIME, MASS_FACTOR, INERTIA_FACTOR,
    FRONT_STIFFNESS_FACTOR, REAR_STIFFNESS_FACTOR, ROLLING_FACTOR, FRICTION, WIND_SPEED,
    GUST_SPEED, GUST_TIME, SIDE_AREA, COMPUTING_DELAY,
) = range(COUNT)  # fmt: skip
# A vehicle begins with the drawn values, in the order of `conditions.DRAWN`, then
PLANT = COUNT
"""The true vehicle's parameters, 7 in `PARAMETER_ORDER`."""
(
    SERVO_A, SERVO_DELTA,  # acceleration (m/s^2) and steering angle (rad) as the actuators report
    COMMAND_A, COMMAND_DELTA,  # last accepted command
    NEWEST, QUEUED,  # place of the newest command in the queue, number of commands in it
    FREE_AT,  # time at which the controller is free again, s
    LATENCY, OCCUPIED,  # measured times of the next computation, s; -1: as the conditions say
    DEVIATION,  # standard deviation of the estimated position, m
    STOPPING,  # 1 while the vehicle brakes to a stop
    MISSES, MISSED_IN_A_ROW,  # deadline misses of the episode, and in a row
    MEAN_A, MEAN_DELTA,  # mean reported inputs over the last period
    WIND_X, WIND_Y, GUST,  # the wind's direction, and the gust along it, m/s
    WANDER_X, WANDER_Y, OUTAGE_END, NEXT_FIX,  # GNSS: m, m, s, s
    WAITING,  # number of fixes that have not arrived
    DRIFT,  # drift of the yaw-rate bias, rad/s
    FIX_X, FIX_Y, READ_SPEED, READ_YAW_RATE, READ_HEADING,  # readings of this period
) = range(PLANT + len(PARAMETER_ORDER), PLANT + len(PARAMETER_ORDER) + 29)  # fmt: skip
ESTIMATE = PLANT + len(PARAMETER_ORDER) + 29
"""The estimate, a record as `kernels` lays it out."""
TAIL = ESTIMATE + kernels.RECORD_SIZE
"""The commands that have not landed, then the fixes that have not arrived, then the filter."""
COMMAND = 3
"""Numbers of a queued command: landing time (s), a, delta."""
FIX = 4
"""Numbers of a queued fix: arrival (s), stamp (s), x, y."""

# A spec holds the ranges to draw from, (COUNT, 2), then
GNSS_PERIOD = 2 * COUNT
MAX_FIX_AGE, MAX_COMMAND_AGE, ESTIMATOR, CALIBRATE = (
    GNSS_PERIOD + 1, GNSS_PERIOD + 2, GNSS_PERIOD + 3, GNSS_PERIOD + 4,
)  # fmt: skip
COMMAND_CAPACITY, FIX_CAPACITY = GNSS_PERIOD + 5, GNSS_PERIOD + 6
STRETCH_START, STRETCH_END, STRETCH_FACTOR = GNSS_PERIOD + 7, GNSS_PERIOD + 8, GNSS_PERIOD + 9
INITIAL = GNSS_PERIOD + 10
"""Initial variances of the filter, (9,)."""
SETTINGS = INITIAL + filtering.STATES
"""Settings of the filter."""
SPEC = SETTINGS + filtering.SETTINGS

EKF, RAW, TRUTH = range(len(ESTIMATORS))
TIME_TOLERANCE = 1e-9
"""Tolerance for rounding in sums of periods, s."""
MAX_STEERING_OFFSET = 0.1
"""Bound of the estimated steering offset that is subtracted from commands, rad."""


@compiled_internal
def fixes_start(spec: Array) -> int:
    """Return the index of the queued fixes in a vehicle's array; the queued commands end there."""
    return TAIL + COMMAND * int(spec[COMMAND_CAPACITY])


@compiled_internal
def filter_start(spec: Array) -> int:
    """Return the index of the filter in a vehicle's array."""
    return fixes_start(spec) + FIX * int(spec[FIX_CAPACITY])


def capacities(conditions: Conditions, period: float) -> tuple[int, int, int]:
    """Return the largest numbers of queued commands, of queued fixes, and of the filter's nodes."""
    slowest = conditions.ends("computing_delay")[1] + max(
        conditions.ends("steering_dead_time")[1], conditions.ends("drive_dead_time")[1]
    )
    latest = conditions.ends("gnss_latency")[1]
    # The margin holds the command in force, the next one, and late ones if the computing time is
    # measured and longer than the conditions say.
    return (
        math.ceil(slowest / period) + 8,
        math.ceil(latest / conditions.gnss_period) + 2,
        math.ceil(latest / period) + 2 if conditions.estimator == "ekf" else 1,
    )


def vehicle_size(conditions: Conditions, period: float) -> int:
    """Return the length of a vehicle's array under some conditions and a control period (s)."""
    commands, fixes, nodes = capacities(conditions, period)
    return TAIL + COMMAND * commands + FIX * fixes + filtering.FILTER + filtering.NODE * nodes


def spec_of(
    conditions: Conditions, vehicle: VehicleParameters, period: float, friction: float
) -> Array:
    """Return the spec of a vehicle under some conditions and a control period (s), (SPEC,).

    `friction` is the nominal one, that of the filter's model.
    """
    age = conditions.max_command_age
    commands, fixes, _ = capacities(conditions, period)
    return np.concatenate(
        [
            conditions.ranges().ravel(),
            [
                conditions.gnss_period,
                conditions.max_fix_age,
                3.0 * period if age is None else age,
                ESTIMATORS.index(conditions.estimator),
                float(conditions.calibrate_steering),
                commands,
                fixes,
                *conditions.slippery_stretch,
                conditions.slippery_factor,
            ],
            conditions.filter_settings.initial_variances,
            conditions.filter_settings.as_array(vehicle, friction),
        ]
    )


class ConditionedVehicle(NamedTuple):
    """Arrays of one vehicle under conditions."""

    vehicle: Array
    spec: Array
    work: Array
    """Scratch of the filter, (`filter.WORK`,)."""

    @classmethod
    def of(
        cls, conditions: Conditions, vehicle: VehicleParameters, period: float, friction: float
    ) -> "ConditionedVehicle":
        """Return new arrays; the arguments are those of `spec_of`."""
        return cls(
            np.zeros(vehicle_size(conditions, period)),
            spec_of(conditions, vehicle, period, friction),
            np.zeros(filtering.WORK),
        )

    def busy_at(self, now: float) -> bool:
        """Return whether the controller still computes an earlier command at `now` (s)."""
        return bool(self.vehicle[FREE_AT] > now + TIME_TOLERANCE)

    def set_computing_time(self, latency: float, occupied: float) -> None:
        """Set latency and occupation of the next computation, s.

        Raises
        ------
        ValueError
            If one is negative or longer than `conditions.LONGEST_DELAY`.
        """
        times = [DELAY.of("computing times", time) for time in (latency, occupied)]
        self.vehicle[LATENCY], self.vehicle[OCCUPIED] = times


def info_of(m: Array) -> dict[str, Any]:
    """Return the entries that conditions add to the info of a vehicle.

    `estimate` (6,), `position_deviation` (m), `stopping` and `deadline_misses`.
    """
    deviation, stopping, misses = m[DEVIATION : MISSES + 1].tolist()
    return {
        "estimate": m[ESTIMATE : ESTIMATE + 6].copy(),
        "position_deviation": deviation,
        "stopping": bool(stopping),
        "deadline_misses": int(misses),
    }


def infos_of(vehicles: Array, mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Return these entries for vehicles (n, size): zeros for those that `mask` (n,) excludes."""
    estimates, counts = vehicles[:, ESTIMATE : ESTIMATE + 6], vehicles[:, DEVIATION : MISSES + 1]
    deviation, stopping, misses = np.where(mask[:, None], counts, 0.0).T.copy()
    infos: dict[str, Any] = {
        "estimate": np.where(mask[:, None], estimates, 0.0),
        "position_deviation": deviation,
        "stopping": stopping > 0.5,
        "deadline_misses": misses.astype(np.int64),
    }
    infos.update({f"_{name}": mask for name in list(infos)})
    return infos
