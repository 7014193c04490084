"""A run of an environment as the topics of a bag."""

import numpy as np
from numpy.typing import NDArray

from experiments.ros.topics import SECOND, Commands, Datum, Fixes, Imu, Odometry, Topic, WheelSpeed
from experiments.run.rollout import Trace
from trajectories.geodesy import geodetic

Array = NDArray[np.float64]

DATUM = (45.0, 10.0, 0.0)
"""deg, deg, m: where x = y = 0 lies unless told. A round place; nothing there matters."""
START = SECOND
"""ns: stamp of a run's start, as simulation time has it; 0 would be "not set" to ROS."""
FIX_PERIOD = 0.1
"""s: receivers give 10 positions a second."""
STANDARD_GRAVITY = 9.80665


def topics_of(
    trace: Trace,
    *,
    datum: tuple[float, float, float] = DATUM,
    start: int = START,
    fix_period: float = FIX_PERIOD,
) -> dict[str, Topic]:
    """The truth of a run as topics by name: what perfect sensors would have seen.

    Parameters
    ----------
    trace
        The run, n control periods. An IMU's acceleration is made of the differences of its
        velocities: the mean over the periods before and after, whatever moved the vehicle.
    datum
        Latitude, longitude (deg) and height (m) of x = y = 0; x points east there, y north.
    start
        Stamp of the trace's time 0, ns.
    fix_period
        s between fixes; rounded to whole control periods, at least one.

    Returns
    -------
    dict
        /odom, /imu, /wheel_speed (n + 1 messages), /fix, /command (n: stamped when it comes into
        force, so a period before the trace's own) and /datum.

    Raises
    ------
    ValueError
        For a datum that is not on Earth, or a period that is not positive.
    """
    check_datum(datum)
    if not fix_period > 0.0:
        raise ValueError(f"the fixes' period must be positive, not {fix_period} s")
    stamp = start + np.rint(trace.time * SECOND).astype(np.int64)
    vx, vy, heading, yaw_rate, x, y = trace.state.T
    forward, leftward = np.gradient(vx, trace.time), np.gradient(vy, trace.time)
    stride = max(round(fix_period / float(np.median(np.diff(trace.time)))), 1)
    level = np.column_stack([x, y, np.zeros_like(x)])[::stride]
    latitude, longitude, height = geodetic(level, datum)
    topics: tuple[Topic, ...] = (
        Odometry(stamp, x, y, heading, vx, vy, yaw_rate),
        Imu(
            stamp, heading, yaw_rate,
            # Velocity changes in a frame that turns: a = v' + r x v.
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


def check_datum(datum: tuple[float, float, float]) -> None:
    """Raise a ValueError unless latitude, longitude (deg) and height (m) are on Earth."""
    if not (abs(datum[0]) <= 90.0 and abs(datum[1]) <= 180.0 and abs(datum[2]) <= 1e5):
        raise ValueError(
            f"a datum is latitude and longitude in degrees and height in m, not {datum}"
        )
