"""What sensors with errors would have told of a run: the truth's topics, measured."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from experiments.bags.topics import Datum, Fixes, Imu, Topic, WheelSpeed
from lpv_track_env.conditions import Conditions
from trajectories.geodesy import geodetic

T = TypeVar("T", bound=Topic)
Array = NDArray[np.float64]


def measured(
    topics: Mapping[str, Topic], conditions: Conditions, seed: int = 0
) -> dict[str, Topic]:
    """Topics with the sensors' errors of some conditions in /imu, /wheel_speed and /fix.

    Noise, biases, the gyroscope's drift, a relative error of speed, fixes that wander, drop out and
    are wrong altogether: their distributions are the conditions', the draws are of `seed`. Other
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
    rng = np.random.default_rng(seed)

    def drawn(name: str) -> float:
        return float(rng.uniform(*conditions.ends(name)))

    def of_kind(kind: type[T]) -> list[tuple[str, T]]:
        return [(name, topic) for name, topic in topics.items() if isinstance(topic, kind)]

    read: dict[str, Topic] = dict(topics)
    for name, imu in of_kind(Imu):
        step = np.diff(imu.time, prepend=0.0)
        drift = np.cumsum(drawn("yaw_rate_drift") * np.sqrt(step) * rng.normal(size=len(imu)))
        heading_noise, rate_noise = drawn("heading_noise"), drawn("yaw_rate_noise")
        read[name] = replace(
            imu,
            heading=imu.heading + drawn("heading_bias") + heading_noise * rng.normal(size=len(imu)),
            yaw_rate=imu.yaw_rate
            + drawn("yaw_rate_bias")
            + drift
            + rate_noise * rng.normal(size=len(imu)),
            heading_deviation=heading_noise or None,
            yaw_rate_deviation=rate_noise or None,
        )
    for name, wheel in of_kind(WheelSpeed):
        scale, noise = drawn("speed_scale"), drawn("speed_noise")
        speed = wheel.speed * (1.0 + scale) + noise * rng.normal(size=len(wheel))
        read[name] = replace(wheel, speed=speed, speed_deviation=noise or None)
    for name, fixes in of_kind(Fixes):
        datum = next(topic.last for _, topic in of_kind(Datum))
        read[name] = _wandering(fixes, datum, conditions, rng)
    return read


def _wandering(
    fixes: Fixes,
    datum: tuple[float, float, float],
    conditions: Conditions,
    rng: np.random.Generator,
) -> Fixes:
    """Fixes with errors, without those that drop out."""
    n = len(fixes)

    def drawn(name: str) -> float:
        return float(rng.uniform(*conditions.ends(name)))

    noise, wander, lasting = drawn("gnss_noise"), drawn("gnss_wander"), drawn("gnss_wander_time")
    # Gauss-Markov: kept = exp(-dt / T), driven so that its deviation stays.
    kept = np.exp(-np.diff(fixes.time) / lasting)
    error = np.empty((n, 2))
    error[0] = wander * rng.normal(size=2)
    for k in range(1, n):
        driven = wander * math.sqrt(1.0 - kept[k - 1] ** 2)
        error[k] = kept[k - 1] * error[k - 1] + driven * rng.normal(size=2)
    error += noise * rng.normal(size=(n, 2))
    wrong = rng.uniform(size=n) < drawn("gnss_outlier_rate")
    angle = rng.uniform(0.0, 2.0 * math.pi, size=n)
    size = drawn("gnss_outlier_size")
    error[wrong] += size * np.column_stack([np.cos(angle), np.sin(angle)])[wrong]
    begins = rng.uniform(size=n) < drawn("gnss_dropout_rate") * np.diff(fixes.time, prepend=0.0)
    there = np.ones(n, dtype=np.bool_)
    for k in np.flatnonzero(begins).tolist():
        since = fixes.time - fixes.time[k]
        there &= ~((since >= 0.0) & (since <= drawn("gnss_dropout_duration")))
    points = np.column_stack([fixes.positions(datum) + error, np.zeros(n)])[there]
    latitude, longitude, height = geodetic(points, datum)
    return Fixes(
        fixes.stamp[there], latitude, longitude, height, frame=fixes.frame,
        position_deviation=noise or None,
    )  # fmt: skip
