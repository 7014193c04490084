"""Conversion of topics to ROS messages and back.

The layouts of messages come from the definitions in this file and in `rosbags`, never from those
that a bag carries, so that nothing in a file is turned into code. A bag whose definition of a type
differs (by its hash) is refused.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.ros.topics import (
    BASE_LINK,
    SECOND,
    Commands,
    Datum,
    Fixes,
    Imu,
    Odometry,
    Topic,
    WheelSpeed,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Array = NDArray[np.float64]

ROS1, ROS2 = 1, 2
NAN = math.nan

_SEPARATOR = "=" * 80 + "\n"
DEFINITIONS = {
    # Their ROS 1 checksums, 1fd5d7f5... and ea50d268..., are those of the packages in ROS.
    "ackermann_msgs/msg/AckermannDriveStamped": (
        "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
        f"{_SEPARATOR}MSG: ackermann_msgs/AckermannDrive\n"
        "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n"
        "float32 acceleration\nfloat32 jerk\n"
    ),
    "geographic_msgs/msg/GeoPointStamped": (
        "std_msgs/Header header\ngeographic_msgs/GeoPoint position\n"
        f"{_SEPARATOR}MSG: geographic_msgs/GeoPoint\n"
        "float64 latitude\nfloat64 longitude\nfloat64 altitude\n"
    ),
}
"""Definitions of the message types that `rosbags` lacks."""


def require_rosbags() -> None:
    """Check that bags can be read and written.

    Raises
    ------
    ModuleNotFoundError
        If `rosbags` is not installed, with the command that installs it.
    """
    try:
        import rosbags.typesys  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "ROS bags are read and written by rosbags: pip install 'lpv-track-env[bags]'"
        ) from error


@cache
def typestore(ros: int) -> "Typestore":
    """Return the types of ROS 1 (Noetic) or ROS 2; its distributions agree on those used here."""
    require_rosbags()
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == ROS1 else Stores.LATEST)
    for name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    return store


class Maker:
    """Makes messages of one ROS version."""

    def __init__(self, ros: int) -> None:
        self.ros = ros
        self.types: Any = typestore(ros).types

    def __call__(self, name: str, *values: Any) -> Any:
        """Make a message `package/Type` from its fields in order."""
        package, _, kind = name.partition("/")
        return self.types[f"{package}/msg/{kind}"](*values)

    def header(self, stamp: int, frame: str, number: int) -> Any:
        """Make a std_msgs/Header; in ROS 1 it carries the message's number."""
        time = self("builtin_interfaces/Time", stamp // SECOND, stamp % SECOND)
        count = (number,) if self.ros == ROS1 else ()
        return self("std_msgs/Header", *count, time, frame)

    def vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
        """Make a geometry_msgs/Vector3."""
        return self("geometry_msgs/Vector3", x, y, z)

    def turned(self, heading: float) -> Any:
        """Make the geometry_msgs/Quaternion of a heading on level ground."""
        half = 0.5 * heading
        return self("geometry_msgs/Quaternion", 0.0, 0.0, math.sin(half), math.cos(half))


def stamp_of(message: Any) -> int:
    """Return the header stamp, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def heading_of(quaternion: Any) -> float:
    """Return the yaw, rad in (-pi, pi], of a quaternion of any length; NaN if all zeros (unset)."""
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    if not x * x + y * y + z * z + w * w > 0.0:
        return NAN
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def covariance(size: int, *entries: tuple[int, float | None]) -> Array:
    """Return a covariance (size^2,) from (index on the diagonal, deviation); None gives 0."""
    values = np.zeros(size * size)
    for index, deviation in entries:
        values[index * (size + 1)] = 0.0 if deviation is None else deviation**2
    return values


def unmeasured(value: float, known: Array) -> Array:
    """Return the covariance (9,) of a part of an Imu message; element 0 is -1 if value is NaN."""
    if not math.isnan(value):
        return known
    values = np.zeros(9)
    values[0] = -1.0
    return values


def _zeros(value: float) -> float:
    """Replace NaN by 0."""
    return 0.0 if math.isnan(value) else value


def _odometry(make: Maker, topic: Odometry) -> Iterator[Sequence[Any]]:
    place = topic.position_deviation
    # On the plane z, roll and pitch are 0, and so are their covariances.
    pose_known = covariance(6, (0, place), (1, place), (5, topic.heading_deviation))
    speed = topic.speed_deviation
    twist_known = covariance(6, (0, speed), (1, speed), (5, topic.yaw_rate_deviation))
    for x, y, heading, vx, vy, yaw_rate in topic.rows():
        position = make("geometry_msgs/Point", x, y, 0.0)
        pose = make("geometry_msgs/Pose", position, make.turned(heading))
        twist = make("geometry_msgs/Twist", make.vector(vx, vy), make.vector(z=yaw_rate))
        yield (
            BASE_LINK,
            make("geometry_msgs/PoseWithCovariance", pose, pose_known),
            make("geometry_msgs/TwistWithCovariance", twist, twist_known),
        )


def _odometry_row(message: Any) -> tuple[float, ...]:
    pose, twist = message.pose.pose, message.twist.twist
    return (
        pose.position.x, pose.position.y, heading_of(pose.orientation),
        twist.linear.x, twist.linear.y, twist.angular.z,
        *(message.pose.covariance[k] for k in (0, 35)),
        *(message.twist.covariance[k] for k in (0, 35)),
    )  # fmt: skip


def _imu(make: Maker, topic: Imu) -> Iterator[Sequence[Any]]:
    heading_known = covariance(3, (2, topic.heading_deviation))
    rate_known = covariance(3, (2, topic.yaw_rate_deviation))
    deviation = topic.acceleration_deviation
    force_known = covariance(3, (0, deviation), (1, deviation), (2, deviation))
    for heading, rate, *force in topic.rows():
        yield (
            make.turned(_zeros(heading)), unmeasured(heading, heading_known),
            make.vector(z=_zeros(rate)), unmeasured(rate, rate_known),
            make.vector(*map(_zeros, force)), unmeasured(sum(force), force_known),
        )  # fmt: skip


def _imu_row(message: Any) -> tuple[float, ...]:
    of_heading = message.orientation_covariance
    of_rate = message.angular_velocity_covariance
    of_force = message.linear_acceleration_covariance
    force = message.linear_acceleration
    no_force = of_force[0] == -1.0
    return (
        NAN if of_heading[0] == -1.0 else heading_of(message.orientation),
        NAN if of_rate[0] == -1.0 else message.angular_velocity.z,
        *(NAN if no_force else value for value in (force.x, force.y, force.z)),
        of_heading[8], of_rate[8], of_force[0],
    )  # fmt: skip


def _wheel_speed(make: Maker, topic: WheelSpeed) -> Iterator[Sequence[Any]]:
    known = covariance(6, (0, topic.speed_deviation))
    for (speed,) in topic.rows():
        twist = make("geometry_msgs/Twist", make.vector(speed), make.vector())
        yield (make("geometry_msgs/TwistWithCovariance", twist, known),)


def _wheel_speed_row(message: Any) -> tuple[float, ...]:
    with_covariance = hasattr(message.twist, "twist")
    twist = message.twist.twist if with_covariance else message.twist
    return twist.linear.x, message.twist.covariance[0] if with_covariance else 0.0


def _fixes(make: Maker, topic: Fixes) -> Iterator[Sequence[Any]]:
    status = make("sensor_msgs/NavSatStatus", 0, 1)  # STATUS_FIX, SERVICE_GPS
    place = topic.position_deviation
    known = covariance(3, (0, place), (1, place), (2, place))
    kind = 0 if place is None else 1  # COVARIANCE_TYPE_UNKNOWN or _APPROXIMATED: height is a guess
    for position in topic.rows():
        yield (status, *position, known, kind)


def _fixes_row(message: Any) -> tuple[float, ...]:
    no_fix = message.status.status < 0
    known = message.position_covariance
    return (
        NAN if no_fix else message.latitude,
        message.longitude,
        message.altitude,
        0.5 * (known[0] + known[4]) if message.position_covariance_type > 0 else 0.0,
    )


def _commands(make: Maker, topic: Commands) -> Iterator[Sequence[Any]]:
    for acceleration, angle, speed in topic.rows():
        # Rates of 0 mean: as quickly as possible.
        yield (make("ackermann_msgs/AckermannDrive", angle, 0.0, speed, acceleration, 0.0),)


def _commands_row(message: Any) -> tuple[float, ...]:
    return message.drive.acceleration, message.drive.steering_angle, message.drive.speed


def _datum(make: Maker, topic: Datum) -> Iterator[Sequence[Any]]:
    for position in topic.rows():
        yield (make("geographic_msgs/GeoPoint", *position),)


def _datum_row(message: Any) -> tuple[float, ...]:
    return message.position.latitude, message.position.longitude, message.position.altitude


class Codec(NamedTuple):
    """Conversion of one kind of topic to messages and back."""

    message_types: tuple[str, ...]
    """Types that can be read; the first is the one to write."""
    fields: Callable[[Maker, Any], Iterator[Sequence[Any]]]
    """Yields each message's fields after the header."""
    row: Callable[[Any], Sequence[float]]
    """Returns a message's values: the topic's columns, then the variances of `deviations`."""
    deviations: tuple[str, ...] = ()


CODECS: dict[type[Topic], Codec] = {
    Odometry: Codec(
        ("nav_msgs/msg/Odometry",), _odometry, _odometry_row,
        ("position_deviation", "heading_deviation", "speed_deviation", "yaw_rate_deviation"),
    ),
    Imu: Codec(
        ("sensor_msgs/msg/Imu",), _imu, _imu_row,
        ("heading_deviation", "yaw_rate_deviation", "acceleration_deviation"),
    ),
    WheelSpeed: Codec(
        ("geometry_msgs/msg/TwistWithCovarianceStamped", "geometry_msgs/msg/TwistStamped"),
        _wheel_speed, _wheel_speed_row, ("speed_deviation",),
    ),
    Fixes: Codec(("sensor_msgs/msg/NavSatFix",), _fixes, _fixes_row, ("position_deviation",)),
    Commands: Codec(("ackermann_msgs/msg/AckermannDriveStamped",), _commands, _commands_row),
    Datum: Codec(("geographic_msgs/msg/GeoPointStamped",), _datum, _datum_row),
}  # fmt: skip


def serialise(ros: int, topic: Topic) -> Iterator[tuple[int, bytes]]:
    """Yield stamp (ns) and bytes of each of a topic's messages, in order."""
    store, codec, make = typestore(ros), CODECS[type(topic)], Maker(ros)
    to_bytes = store.serialize_ros1 if ros == ROS1 else store.serialize_cdr
    name = codec.message_types[0]
    messages = zip(topic.stamp.tolist(), codec.fields(make, topic), strict=True)
    for number, (stamp, fields) in enumerate(messages):
        message = make.types[name](make.header(stamp, topic.frame, number), *fields)
        yield stamp, bytes(to_bytes(message, name))


def digest_of(ros: int, message_type: str) -> str:
    """Return the hash of a type's layout: MD5 in ROS 1, RIHS01 in ROS 2."""
    store = typestore(ros)
    if ros == ROS1:
        return store.generate_msgdef(message_type)[1]
    return store.hash_rihs01(message_type)
