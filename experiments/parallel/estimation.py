"""The estimator's process: samples in, one estimate out per control period."""

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from experiments.parallel.child_processes import READY, Link
from experiments.parallel.mailbox import Reader, Writer
from experiments.parallel.setup import ESTIMATE, MS_PER_SECOND, SAMPLE, Setup
from lpv_track_env import vehicle
from lpv_track_env.conditions.layout import MAX_STEERING_OFFSET
from lpv_track_env.estimation.estimator import Estimator

LINK_PERIOD = 0.02
"""Time between checks of the link while no sample arrives, s."""


class Filter(Protocol):
    """Computes estimates from samples."""

    def take(self, sample: Any) -> None:
        """Take in a SAMPLE record."""

    def write(self, record: Any) -> None:
        """Write state, deviation and counts into an ESTIMATE record."""


class Truth:
    """Passes on the true state."""

    def __init__(self, setup: Setup) -> None:
        del setup
        self._state = np.zeros(6)

    def take(self, sample: Any) -> None:
        """Take in a SAMPLE record."""
        self._state = sample["truth"]

    def write(self, record: Any) -> None:
        """Write the true state into an ESTIMATE record."""
        record["state"] = self._state


class Ekf:
    """Extended Kalman filter of the environment."""

    def __init__(self, setup: Setup) -> None:
        self._calibrate = setup.known_conditions.calibrate_steering
        self._estimator = Estimator(
            vehicle.load(setup.vehicle),
            setup.known_conditions.filter_settings,
            period=setup.tick_ms / MS_PER_SECOND,
            friction=setup.known_conditions.middle("friction"),
        )
        self._begun = False

    def take(self, sample: Any) -> None:
        """Take in a SAMPLE record; the first must have a fix, a heading and a speed."""
        time = float(sample["time"])
        heading, yaw_rate, speed, stamp, x, y = (
            float(sample[name])
            for name in ("heading", "yaw_rate", "speed", "fix_time", "fix_x", "fix_y")
        )
        if not self._begun:
            self._estimator.begin(time, x, y, heading, speed)
            self._begun = True
            return
        self._estimator.advance(
            time, float(sample["mean_acceleration"]), float(sample["mean_steering_angle"]),
            heading=heading, yaw_rate=yaw_rate, speed=speed,
        )  # fmt: skip
        if not math.isnan(stamp):
            self._estimator.take_fix(stamp, x, y)

    def write(self, record: Any) -> None:
        """Write state, deviation and counts into an ESTIMATE record."""
        estimator = self._estimator
        counts = estimator.counts
        record["state"] = estimator.state
        record["position_deviation"] = estimator.position_deviation
        record["fix_age"] = estimator.fix_age
        if self._calibrate:
            offset = float(estimator.biases[2])
            record["steering_offset"] = min(max(offset, -MAX_STEERING_OFFSET), MAX_STEERING_OFFSET)
        record["fixes_used"] = counts["fixes_used"]
        record["fixes_refused"] = sum(
            n for name, n in counts.items() if name.startswith("fixes_") and name != "fixes_used"
        )
        record["readings_refused"] = sum(
            n for name, n in counts.items() if not name.startswith("fixes_")
        )


FILTERS: dict[str, Callable[[Setup], Filter]] = {"ekf": Ekf, "truth": Truth}
"""Filters by their name in `--estimator`."""


def estimate(link: Link, setup: Setup, samples: Reader, estimates: Writer) -> None:
    """Send an estimate each control period until the supervisor stops the process."""
    with samples, estimates:
        make = FILTERS[setup.estimator]
        record = np.zeros((), ESTIMATE)
        warm_up(make(setup), record)
        chosen = make(setup)
        link.report(READY)
        with link.quiet():
            serve(link, chosen, samples, estimates, record)


def serve(link: Link, chosen: Filter, samples: Reader, estimates: Writer, record: Any) -> None:
    """Take in samples as they arrive, all waiting ones before the next estimate."""
    published, last, lost = -1, 0, 0
    while not link.stopped():
        for message in samples.wait_all(LINK_PERIOD):
            lost += message.sequence - last - 1
            last = message.sequence
            sample = message.value
            chosen.take(sample)
        if last == 0 or sample["period"] == published:
            continue
        published = int(sample["period"])
        for name in ("period", "due", "time", "acceleration", "steering_angle"):
            record[name] = sample[name]
        record["samples_lost"] = lost
        chosen.write(record)
        estimates.put(record)


def warm_up(chosen: Filter, record: Any) -> None:
    """Compile everything that a run needs."""
    sample = np.zeros((), SAMPLE)
    sample["speed"] = 5.0
    for k in range(20):
        sample["time"] = 0.01 * k
        sample["fix_time"] = sample["time"]
        sample["fix_x"] = 0.05 * k
        chosen.take(sample)
    chosen.write(record)
