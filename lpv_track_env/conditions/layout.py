"""Layout of what the kernels know of a vehicle under conditions, and how conditions reach them.

A vehicle has one float64 array: what its `conditions` were drawn to, actuators, commands on their
way, wind, sensors, the estimate as a memory of its own (`kernels`), the filter (`filtering`). An
environment has one, its spec: the ranges to draw from, settings, sizes.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.conditions import DRAWN, ESTIMATORS, LONGEST_DELAY, Conditions
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.task import Task
from lpv_track_env.vehicle import PARAMETER_ORDER
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
"""The memory begins with what was drawn, in the order of `conditions.DRAWN`; then"""
PLANT = COUNT
"""the true vehicle's parameters, 7 in `PARAMETER_ORDER`;"""
(
    SERVO_A, SERVO_DELTA, COMMAND_A, COMMAND_DELTA, NEWEST, QUEUED, FREE_AT, LATENCY, OCCUPIED,
    DEVIATION, STOPPING, MISSES, MISSED_IN_A_ROW, MEAN_A, MEAN_DELTA, WIND_X, WIND_Y, GUST,
    WANDER_X, WANDER_Y, OUTAGE_END, NEXT_FIX, WAITING, DRIFT, FIX_X, FIX_Y, READ_SPEED,
    READ_YAW_RATE, READ_HEADING,
) = range(PLANT + len(PARAMETER_ORDER), PLANT + len(PARAMETER_ORDER) + 29)  # fmt: skip
"""actuators as they report (a, delta), last accepted command, places in the queue of commands, when
the controller is free again (s), latency and occupation of the next computation if somebody
measured them (s, else -1), standard deviation of the position (m), whether the vehicle brakes to a
stop, deadline misses in all and in a row, mean reported inputs over the last period, the wind's
direction and gust, GNSS, the readings of this period;"""
ESTIMATE = PLANT + len(PARAMETER_ORDER) + 29
"""the estimate, a memory as `kernels` has it;"""
TAIL = ESTIMATE + kernels.RECORD_SIZE
"""commands on their way (landing time s, a, delta), fixes on theirs (arrival s, stamp, x, y), and
the filter with its past."""
COMMAND, WAY = 3, 4
"""Numbers of a command and of a fix on its way."""

# A spec holds the ranges of what is drawn, (COUNT, 2), then
GNSS_PERIOD = 2 * COUNT
MAX_FIX_AGE, MAX_COMMAND_AGE, ESTIMATOR, CALIBRATE = (
    GNSS_PERIOD + 1, GNSS_PERIOD + 2, GNSS_PERIOD + 3, GNSS_PERIOD + 4,
)  # fmt: skip
QUEUE_ROOM, FIX_ROOM = GNSS_PERIOD + 5, GNSS_PERIOD + 6
INITIAL = GNSS_PERIOD + 7
"""the filter's initial variances, (9,), and its settings."""
SETTINGS = INITIAL + filtering.STATES
SPEC = SETTINGS + filtering.SETTINGS

EKF, RAW, TRUTH = range(len(ESTIMATORS))
INSTANT = 1e-9
"""s that are no time: rounding of sums of periods."""
WORST_OFFSET = 0.1
"""rad; a larger estimate of the steering offset is not believed."""


@compiled_internal
def ways_start(spec: Array) -> int:
    """Where the fixes on their way begin in a vehicle's memory, behind the commands on theirs."""
    return TAIL + COMMAND * int(spec[QUEUE_ROOM])


@compiled_internal
def filter_start(spec: Array) -> int:
    """Where the filter's memory begins in a vehicle's."""
    return ways_start(spec) + WAY * int(spec[FIX_ROOM])


def rooms(conditions: Conditions, period: float) -> tuple[int, int, int]:
    """Numbers of commands and of fixes on their way, and of the filter's nodes, that may be."""
    slowest = conditions.ends("computing_delay")[1] + max(
        conditions.ends("steering_dead_time")[1], conditions.ends("drive_dead_time")[1]
    )
    latest = conditions.ends("gnss_latency")[1]
    # Beside the commands on their way: the one in force, the next, and what is late if somebody
    # measured a time that the conditions do not know of.
    return (
        math.ceil(slowest / period) + 8,
        math.ceil(latest / conditions.gnss_period) + 2,
        math.ceil(latest / period) + 2 if conditions.estimator == "ekf" else 1,
    )


def vehicle_size(conditions: Conditions, period: float) -> int:
    """Length of a vehicle's array under some conditions and a control period (s)."""
    commands, fixes, nodes = rooms(conditions, period)
    return TAIL + COMMAND * commands + WAY * fixes + filtering.FILTER + filtering.NODE * nodes


def spec_of(task: Task) -> Array:
    """Numbers as the kernels take them, shape (SPEC,), for a task under conditions."""
    conditions, period = task.conditions, task.control_period
    assert conditions is not None
    age = conditions.max_command_age
    commands, fixes, _ = rooms(conditions, period)
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
            ],
            conditions.filter_settings.initial_variances,
            conditions.filter_settings.as_array(task.vehicle),
        ]
    )


class ConditionsArrays(NamedTuple):
    """What the kernels take of one vehicle under conditions."""

    vehicle: Array
    spec: Array
    work: Array
    """Working space of the filter."""

    @classmethod
    def of(cls, task: Task) -> "ConditionsArrays | None":
        """Arrays for a task; None under conditions `simulation`."""
        if task.conditions is None:
            return None
        return cls(
            np.zeros(vehicle_size(task.conditions, task.control_period)),
            spec_of(task),
            np.zeros(filtering.WORK),
        )

    def busy_at(self, now: float) -> bool:
        """Whether the controller still computes an earlier command at `now` (s)."""
        return bool(self.vehicle[FREE_AT] > now + INSTANT)

    def set_computing_time(self, latency: float, occupied: float) -> None:
        """Set latency and occupation of the next computation, s.

        Raises
        ------
        ValueError
            If one is negative or longer than the memory is made for.
        """
        if not (0.0 <= latency <= LONGEST_DELAY and 0.0 <= occupied <= LONGEST_DELAY):
            raise ValueError(f"computing times must be 0 to {LONGEST_DELAY:g} s")
        self.vehicle[LATENCY], self.vehicle[OCCUPIED] = latency, occupied

    def info(self) -> dict[str, Any]:
        """What infos have besides those of ideal conditions."""
        return single_report(self.vehicle[list(REPORTED)])


REPORTED = (*range(ESTIMATE, ESTIMATE + 6), DEVIATION, STOPPING, MISSES)
"""Entries of a memory that infos show: a report, (9,)."""


def single_report(report: Array) -> dict[str, Any]:
    """Infos of one vehicle: estimate (6,), position_deviation, stopping, deadline_misses."""
    deviation, stopping, misses = report[6:].tolist()
    return {
        "estimate": report[:6].copy(),
        "position_deviation": deviation,
        "stopping": bool(stopping),
        "deadline_misses": int(misses),
    }


def reports_infos(reports: Array, mask: NDArray[np.bool_]) -> dict[str, Any]:
    """The same of many vehicles, from reports (n, 9), for those that `mask` (n,) marks."""
    shown = np.where(mask[:, None], reports, 0.0)
    infos: dict[str, Any] = {
        "estimate": shown[:, :6].copy(),
        "position_deviation": shown[:, 6].copy(),
        "stopping": shown[:, 7] > 0.5,
        "deadline_misses": shown[:, 8].astype(np.int64),
    }
    infos.update({f"_{name}": mask for name in list(infos)})
    return infos
