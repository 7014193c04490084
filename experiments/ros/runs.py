"""Topics of a simulated run, as perfect sensors see it or with sensor errors."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from experiments.ros.topics import (
    SECOND,
    Commands,
    Datum,
    Fixes,
    GeoPoint,
    Imu,
    Odometry,
    Topic,
    WheelSpeed,
)
from experiments.run.rollout import Trace
from lpv_track_env.conditions import Conditions
from lpv_track_env.conditions.sensors import Sensors
from trajectories.geodesy import geodetic

T = TypeVar("T", bound=Topic)

DATUM = (45.0, 10.0, 0.0)
"""Default position of x = y = 0, deg, deg, m; arbitrary round numbers."""
START = SECOND
"""Stamp of a run's start, ns, in simulation time; ROS takes 0 for "not set"."""
FIX_PERIOD = 0.1
"""Time between fixes, s, rounded to whole control periods; receivers give 10 positions a second."""
STANDARD_GRAVITY = 9.80665


def topics_of(trace: Trace, *, datum: GeoPoint = DATUM) -> dict[str, Topic]:
    """Return the true values of a run as topics by name, as perfect sensors would measure them.

    Parameters
    ----------
    trace
        The run, n control periods. The IMU's acceleration is the difference quotient of velocity,
        averaged over the periods before and after.
    datum
        Position of x = y = 0; x points east there, y north.

    Returns
    -------
    dict
        /odom, /imu, /wheel_speed (n + 1 messages), /fix, /command (n, stamped when it takes effect,
        a period before its entry in the trace) and /datum.

    Raises
    ------
    ValueError
        For a datum that is not on Earth.
    """
    check_datum(datum)
    stamp = START + np.rint(trace.time * SECOND).astype(np.int64)
    vx, vy, heading, yaw_rate, x, y = trace.state.T
    forward, leftward = np.gradient(vx, trace.time), np.gradient(vy, trace.time)
    stride = max(round(FIX_PERIOD / float(np.median(np.diff(trace.time)))), 1)
    level = np.column_stack([x, y, np.zeros_like(x)])[::stride]
    latitude, longitude, height = geodetic(level, datum)
    topics: tuple[Topic, ...] = (
        Odometry(stamp, x, y, heading, vx, vy, yaw_rate),
        Imu(
            stamp, heading, yaw_rate,
            # Change of velocity in a rotating frame: a = v' + r x v.
            forward_acceleration=forward - yaw_rate * vy,
            leftward_acceleration=leftward + yaw_rate * vx,
            upward_acceleration=np.full_like(vx, STANDARD_GRAVITY),
        ),
        WheelSpeed(stamp, vx),
        Fixes(stamp[::stride], latitude, longitude, height),
        Commands(stamp[:-1], trace.acceleration[1:], trace.steering_angle[1:], vx[1:]),
        Datum(stamp[:1], *(np.array([value]) for value in datum)),
    )  # fmt: skip
    return {topic.TOPIC: topic for topic in topics}


def check_datum(datum: GeoPoint) -> None:
    """Raise a ValueError unless latitude, longitude (deg) and height (m) are on Earth."""
    if not (abs(datum[0]) <= 90.0 and abs(datum[1]) <= 180.0 and abs(datum[2]) <= 1e5):
        raise ValueError(
            f"a datum is latitude and longitude in degrees and height in m, not {datum}"
        )


def measured(
    topics: Mapping[str, Topic], conditions: Conditions, seed: int = 0
) -> dict[str, Topic]:
    """Return topics with the sensor errors of some conditions in /imu, /wheel_speed and /fix.

    The errors are those of `conditions.sensors`: noise, biases, gyroscope drift, a scale error
    of speed, and fixes that wander, drop out or are outliers. Other topics stay as they are. Fixes
    keep their stamps, since bags are read by stamp. Covariances cover white noise, not biases.

    Parameters
    ----------
    topics
        As returned by `topics_of`.
    conditions
        Ranges of the errors, which are drawn once.
    seed
        Seed of the draws.
    """

    def of_kind(kind: type[T]) -> list[tuple[str, T]]:
        return [(name, topic) for name, topic in topics.items() if isinstance(topic, kind)]

    sensors = Sensors(conditions, seed)
    drawn = sensors.drawn
    read: dict[str, Topic] = dict(topics)
    for name, imu in of_kind(Imu):
        readings = [
            sensors.inertial(*reading)
            for reading in zip(imu.time, imu.heading, imu.yaw_rate, strict=True)
        ]
        heading, yaw_rate = np.array(readings).reshape(-1, 2).T
        read[name] = replace(
            imu,
            heading=heading,
            yaw_rate=yaw_rate,
            heading_deviation=drawn["heading_noise"] or None,
            yaw_rate_deviation=drawn["yaw_rate_noise"] or None,
        )
    for name, wheel in of_kind(WheelSpeed):
        speed = np.array([sensors.wheel_speed(value) for value in wheel.speed])
        read[name] = replace(wheel, speed=speed, speed_deviation=drawn["speed_noise"] or None)
    for name, fixes in of_kind(Fixes):
        datum = next(topic.last for _, topic in of_kind(Datum))
        read[name] = _measured_fixes(fixes, datum, sensors)
    return read


def _measured_fixes(fixes: Fixes, datum: GeoPoint, sensors: Sensors) -> Fixes:
    """Return fixes with errors, without those that drop out."""
    readings = [
        sensors.fix(time, x, y)
        for time, (x, y) in zip(fixes.time, fixes.positions(datum), strict=True)
    ]
    received = np.array([fix is not None for fix in readings], dtype=np.bool_)
    positions = np.array([fix for fix in readings if fix is not None]).reshape(-1, 2)
    points = np.column_stack([positions, np.zeros(len(positions))])
    latitude, longitude, height = geodetic(points, datum)
    return Fixes(
        fixes.stamp[received], latitude, longitude, height, frame=fixes.frame,
        position_deviation=sensors.drawn["gnss_noise"] or None,
    )  # fmt: skip
