"""What sensors with errors would have told of a run: the truth's topics, measured."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from experiments.ros.topics import Datum, Fixes, Imu, Topic, WheelSpeed
from lpv_track_env.conditions import Conditions
from lpv_track_env.sensors import Sensors
from trajectories.geodesy import geodetic

T = TypeVar("T", bound=Topic)


def measured(
    topics: Mapping[str, Topic], conditions: Conditions, seed: int = 0
) -> dict[str, Topic]:
    """Topics with the sensors' errors of some conditions in /imu, /wheel_speed and /fix.

    Noise, biases, the gyroscope's drift, a relative error of speed, fixes that wander, drop out and
    are wrong altogether: `lpv_track_env.sensors` reads them, the draws are of `seed`. Other
    topics are as given; fixes keep their stamps, since a bag is not read as it comes but by stamps.
    Deviations that a sensor knows of itself go into its covariance: white noise, not biases.

    Parameters
    ----------
    topics
        As `runs.topics_of` makes them.
    conditions
        Ranges are drawn from once.
    seed
        The same seed gives the same readings.
    """

    def of_kind(kind: type[T]) -> list[tuple[str, T]]:
        return [(name, topic) for name, topic in topics.items() if isinstance(topic, kind)]

    sensors = Sensors(conditions, seed)
    drawn = sensors.drawn
    read: dict[str, Topic] = dict(topics)
    for name, imu in of_kind(Imu):
        told = [
            sensors.inertial(*reading)
            for reading in zip(imu.time, imu.heading, imu.yaw_rate, strict=True)
        ]
        heading, yaw_rate = np.array(told).reshape(-1, 2).T
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


def _measured_fixes(fixes: Fixes, datum: tuple[float, float, float], sensors: Sensors) -> Fixes:
    """Fixes with errors, without those that drop out."""
    told = [
        sensors.fix(time, x, y)
        for time, (x, y) in zip(fixes.time, fixes.positions(datum), strict=True)
    ]
    there = np.array([fix is not None for fix in told], dtype=np.bool_)
    positions = np.array([fix for fix in told if fix is not None]).reshape(-1, 2)
    points = np.column_stack([positions, np.zeros(len(positions))])
    latitude, longitude, height = geodetic(points, datum)
    return Fixes(
        fixes.stamp[there], latitude, longitude, height, frame=fixes.frame,
        position_deviation=sensors.drawn["gnss_noise"] or None,
    )  # fmt: skip
