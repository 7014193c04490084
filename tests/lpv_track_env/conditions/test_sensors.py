"""Sensors outside of an environment: the errors that the conditions say, whatever the clock."""

import math

import numpy as np
import pytest

from lpv_track_env.conditions import IDEAL, REALTIME, Conditions
from lpv_track_env.conditions.sensors import Sensors


def test_perfect_sensors_tell_the_truth() -> None:
    sensors = Sensors(IDEAL)
    assert sensors.inertial(0.1, 0.4, -0.2) == (0.4, -0.2)
    assert sensors.wheel_speed(7.5) == 7.5
    assert sensors.first_fix(3.0, -4.0) == (3.0, -4.0)
    assert sensors.fix(0.1, 3.0, -4.0) == (3.0, -4.0)


def test_noise_and_biases() -> None:
    sensors = Sensors(
        Conditions(heading_noise=0.02, heading_bias=0.1, yaw_rate_noise=0.03, yaw_rate_bias=-0.2,
                   speed_noise=0.4, speed_scale=0.05, gnss_noise=0.5)
    )  # fmt: skip
    n = 4000
    inertial = np.array([sensors.inertial(0.01 * k, 1.0, 0.5) for k in range(n)])
    speed = np.array([sensors.wheel_speed(10.0) for _ in range(n)])
    fixes = np.array([sensors.fix(0.1 * k, 2.0, 3.0) for k in range(n)])
    for values, mean, deviation in (
        (inertial[:, 0], 1.1, 0.02),
        (inertial[:, 1], 0.3, 0.03),
        (speed, 10.5, 0.4),
        (fixes[:, 0], 2.0, 0.5),
        (fixes[:, 1], 3.0, 0.5),
    ):
        assert values.mean() == pytest.approx(mean, abs=4.0 * deviation / math.sqrt(n))
        assert values.std() == pytest.approx(deviation, rel=4.0 / math.sqrt(2 * n))
    assert abs(np.corrcoef(fixes.T)[0, 1]) < 4.0 / math.sqrt(n)


def test_drift_grows_with_time_and_not_with_readings() -> None:
    """After 4 s the gyroscope's random walk has the deviation sqrt(4 s) times its rate."""
    for step in (0.01, 0.1):
        ends = []
        for seed in range(300):
            sensors = Sensors(Conditions(yaw_rate_drift=0.01), seed)
            for k in range(1, round(4.0 / step) + 1):
                _, yaw_rate = sensors.inertial(k * step, 0.0, 0.0)
            ends.append(yaw_rate)
        assert np.std(ends) == pytest.approx(0.02, rel=4.0 / math.sqrt(600))


def test_errors_that_last_and_outages() -> None:
    wandering = Conditions(gnss_wander=0.5, gnss_wander_time=10.0)
    errors = np.array(
        [[s.fix(0.2 * k, 0.0, 0.0)[0] for k in range(11)]  # type: ignore[index]
         for s in (Sensors(wandering, seed) for seed in range(500))]
    )  # fmt: skip
    assert errors.std() == pytest.approx(0.5, rel=0.1)
    kept = (errors[:, 0] * errors[:, 10]).mean() / errors.var()
    assert kept == pytest.approx(math.exp(-0.2), abs=0.15)
    failing = Sensors(Conditions(gnss_dropout_rate=0.5, gnss_dropout_duration=0.95), 3)
    there = [failing.fix(0.1 * k, 0.0, 0.0) is not None for k in range(600)]
    gaps = [len(gap) for gap in "".join("x" if one else "." for one in there).split("x") if gap]
    assert set(gaps[:-1]) == {10}
    # One chance in twenty at each fix that could be, and every outage costs ten.
    assert np.mean(there) == pytest.approx(1.0 / 1.5, abs=0.12)


def test_before_the_drive_there_is_a_sound_fix() -> None:
    bad = Conditions(gnss_outlier_rate=1.0, gnss_dropout_rate=10.0, gnss_noise=0.1)
    for seed in range(50):
        x, y = Sensors(bad, seed).first_fix(1.0, 2.0)
        assert math.hypot(x - 1.0, y - 2.0) < 0.6


def test_the_same_seed_reads_the_same() -> None:
    one, other, third = (Sensors(REALTIME, seed) for seed in (4, 4, 5))
    assert one.drawn == other.drawn != third.drawn
    for k in range(20):
        first = one.inertial(0.01 * k, 0.0, 0.0), one.wheel_speed(5.0), one.fix(0.1 * k, 0.0, 0.0)
        again = (
            other.inertial(0.01 * k, 0.0, 0.0), other.wheel_speed(5.0), other.fix(0.1 * k, 0.0, 0.0)
        )  # fmt: skip
        assert first == again
    for name, value in one.drawn.items():
        low, high = REALTIME.ends(name)
        assert low <= value <= high
