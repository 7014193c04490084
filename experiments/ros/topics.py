"""Topics of a drive as plain arrays, with one class for each kind of topic.

SI units, radians. Frames are those of REP 103 and 105: x, y of `odom` point east and north of the
datum, heading is counter-clockwise from x; `base_link` is the vehicle, x forward, y left, at its
centre of gravity. Stamps are header stamps, nanoseconds since the epoch of the clock in use.

A deviation is one standard deviation for all messages of a topic, None if unknown; covariances are
then zero, as the messages' conventions have it.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from trajectories.geodesy import east_north_up

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
GeoPoint = tuple[float, float, float]
"""Latitude and longitude, deg, and height, m."""

SECOND = 1_000_000_000
"""1 s in ns."""
ODOM, BASE_LINK = "odom", "base_link"


@dataclass(frozen=True, eq=False)
class Topic:
    """Stamped arrays (n,) of one topic.

    Raises
    ------
    ValueError
        If arrays differ in length, stamps do not increase, or a value is not finite, naming field
        and index. Fields in `MAY_BE_NAN` may be NaN, which means not measured.
    """

    stamp: Stamps
    """(n,) ns, strictly increasing."""
    frame: str = field(default=BASE_LINK, kw_only=True)
    """Header frame."""

    KIND: ClassVar[str] = "topic"
    """Name of the kind in options and messages."""
    TOPIC: ClassVar[str] = ""
    """Default name of the topic."""
    MAY_BE_NAN: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        stamp = np.array(self.stamp, dtype=np.int64)
        if stamp.ndim != 1 or (np.diff(stamp) <= 0).any():
            raise ValueError(f"{self.KIND}: stamps (n,) must increase")
        object.__setattr__(self, "stamp", stamp)
        for name in self.columns():
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != stamp.shape:
                raise ValueError(f"{self.KIND}: {name} has shape {values.shape}, not {stamp.shape}")
            bad = ~np.isfinite(values)
            if name in self.MAY_BE_NAN:
                bad = np.isinf(values)
            if bad.any():
                index = int(np.flatnonzero(bad)[0])
                raise ValueError(f"{self.KIND}: {name}[{index}] is {values[index]}")
            object.__setattr__(self, name, values)
        names = [item.name for item in fields(self) if item.name.endswith("_deviation")]
        for name in names:
            deviation = getattr(self, name)
            if deviation is not None and not (math.isfinite(deviation) and deviation > 0.0):
                raise ValueError(f"{self.KIND}: {name} must be positive, not {deviation}")

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Return the names of the arrays other than `stamp`."""
        return tuple(item.name for item in fields(cls) if item.type is Array)

    def rows(self) -> Iterator[tuple[float, ...]]:
        """Yield the values of the columns, message by message."""
        return zip(*(getattr(self, name).tolist() for name in self.columns()), strict=True)

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def time(self) -> Array:
        """(n,) s since the first stamp."""
        return (self.stamp - self.stamp[:1]) / SECOND


@dataclass(frozen=True, eq=False)
class Odometry(Topic):
    """nav_msgs/Odometry: pose in `frame`, twist in the vehicle's frame `base_link`."""

    x: Array
    y: Array
    """(n,) m."""
    heading: Array
    """(n,) rad, unwrapped when read."""
    longitudinal_speed: Array
    lateral_speed: Array
    """(n,) m/s, body frame, left positive."""
    yaw_rate: Array
    """(n,) rad/s."""
    frame: str = field(default=ODOM, kw_only=True)
    position_deviation: float | None = None
    """m, of x and of y."""
    heading_deviation: float | None = None
    speed_deviation: float | None = None
    """m/s, of both components."""
    yaw_rate_deviation: float | None = None

    KIND: ClassVar[str] = "odometry"
    TOPIC: ClassVar[str] = "/odom"


@dataclass(frozen=True, eq=False)
class Imu(Topic):
    """sensor_msgs/Imu of a level vehicle; NaN means not measured."""

    heading: Array
    """(n,) rad, unwrapped when read."""
    yaw_rate: Array
    """(n,) rad/s."""
    forward_acceleration: Array
    leftward_acceleration: Array
    upward_acceleration: Array
    """(n,) m/s^2, specific force: 9.80665 upwards at rest (REP 145)."""
    heading_deviation: float | None = None
    yaw_rate_deviation: float | None = None
    acceleration_deviation: float | None = None

    KIND: ClassVar[str] = "imu"
    TOPIC: ClassVar[str] = "/imu"
    MAY_BE_NAN: ClassVar[tuple[str, ...]] = (
        "heading", "yaw_rate", "forward_acceleration", "leftward_acceleration",
        "upward_acceleration",
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class WheelSpeed(Topic):
    """geometry_msgs/TwistWithCovarianceStamped (or TwistStamped when read), linear.x alone."""

    speed: Array
    """(n,) m/s, forward."""
    speed_deviation: float | None = None

    KIND: ClassVar[str] = "wheel-speed"
    TOPIC: ClassVar[str] = "/wheel_speed"


@dataclass(frozen=True, eq=False)
class Fixes(Topic):
    """sensor_msgs/NavSatFix: WGS-84 positions of the vehicle's centre of gravity."""

    latitude: Array
    longitude: Array
    """(n,) degrees."""
    height: Array
    """(n,) m above the ellipsoid, NaN where unknown."""
    position_deviation: float | None = None
    """m, of east and of north."""

    KIND: ClassVar[str] = "fix"
    TOPIC: ClassVar[str] = "/fix"
    MAY_BE_NAN: ClassVar[tuple[str, ...]] = ("height",)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, bound in (("latitude", 90.0), ("longitude", 180.0)):
            beyond = np.flatnonzero(np.abs(getattr(self, name)) > bound)
            if beyond.size:
                value = getattr(self, name)[beyond[0]]
                raise ValueError(f"fix: {name}[{beyond[0]}] is {value:g}, beyond {bound:g} degrees")

    def positions(self, datum: GeoPoint) -> Array:
        """Return positions (n, 2), m east and north of a datum, whose height replaces NaN."""
        height = np.where(np.isnan(self.height), datum[2], self.height)
        return east_north_up(self.latitude, self.longitude, height, datum)[:, :2]


@dataclass(frozen=True, eq=False)
class Commands(Topic):
    """ackermann_msgs/AckermannDriveStamped: commands to the actuators, each from its stamp on."""

    acceleration: Array
    """(n,) m/s^2, negative when braking, on which the message's definition is silent."""
    steering_angle: Array
    """(n,) rad, left positive."""
    speed: Array
    """(n,) m/s, reached with this acceleration by the time of the next command."""

    KIND: ClassVar[str] = "command"
    TOPIC: ClassVar[str] = "/command"


@dataclass(frozen=True, eq=False)
class Datum(Topic):
    """geographic_msgs/GeoPointStamped: origin of `frame`, as mavros publishes it."""

    latitude: Array
    longitude: Array
    """(n,) degrees."""
    height: Array
    """(n,) m above the ellipsoid."""
    frame: str = field(default=ODOM, kw_only=True)

    KIND: ClassVar[str] = "datum"
    TOPIC: ClassVar[str] = "/datum"

    @property
    def last(self) -> GeoPoint:
        """The last origin."""
        return float(self.latitude[-1]), float(self.longitude[-1]), float(self.height[-1])


KINDS: tuple[type[Topic], ...] = (Odometry, Imu, WheelSpeed, Fixes, Commands, Datum)
