"""Write bags atomically: ROS 1 (one file) or ROS 2 (a folder; sqlite3 or mcap)."""

import heapq
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from experiments.ros.messages import CODECS, ROS1, ROS2, require_rosbags, serialise, typestore
from experiments.ros.topics import SECOND, Datum, Topic
from trajectories.naming import choose

FORMATS = {"ros1": ROS1, "ros2": ROS2}
STORAGES = ("sqlite3", "mcap")
METADATA_VERSION: Literal[8] = 8
"""Version of rosbag2's metadata: all distributions in use read 8, while 9 needs ROS 2 Jazzy."""
LAST_SECOND = {ROS1: 2**32, ROS2: 2**31}
"""Upper limit of header stamps by ROS version, s."""


def write(
    file: Path,
    topics: Mapping[str, Topic],
    *,
    bag_format: str | None = None,
    storage: str = "sqlite3",
) -> None:
    """Write topics to a new bag, messages in the order of their stamps.

    The time of receipt is set to the header stamp.

    Parameters
    ----------
    file
        NAME.bag for ROS 1, another name for the folder of a ROS 2 bag.
    topics
        Arrays by topic name, e.g. {"/odom": Odometry(...)}.
    bag_format
        "ros1" or "ros2"; by default according to the name of the file.
    storage
        Storage of a ROS 2 bag, "sqlite3" or "mcap".

    Raises
    ------
    ValueError
        For a name that does not fit its format, no messages, stamps that ROS cannot represent, or
        an existing bag, since recordings are not replaced.
    ModuleNotFoundError
        If `rosbags` is not installed.
    OSError
        If it cannot be written. Nothing is left behind then, nor after Ctrl-C.
    """
    ros = ros_version(file, bag_format)
    choose("storage", storage, STORAGES)
    require_rosbags()
    if not any(len(topic) for topic in topics.values()):
        raise ValueError("there is no message to write")
    for name, topic in topics.items():
        _check_stamps(name, topic, ros)
    refuse_existing(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    # In a temporary folder, so that the bag has its final name, which rosbag2 writes into it.
    temporary = file.parent / f".{file.name}.{secrets.token_hex(4)}.tmp"
    try:
        temporary.mkdir()
        unfinished = temporary / file.name
        if ros == ROS1:
            _write_ros1(unfinished, topics)
        else:
            _write_ros2(unfinished, topics, storage)
        for written in [unfinished] if unfinished.is_file() else sorted(unfinished.iterdir()):
            _flush(written)
        refuse_existing(file)
        unfinished.rename(file)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def ros_version(file: Path, bag_format: str | None) -> int:
    """Return 1 or 2 according to a format, by default according to a bag's name.

    Raises
    ------
    ValueError
        If the name does not fit the format.
    """
    if not file.name:
        raise ValueError(f"{file} is not a name for a bag")
    by_name = "ros1" if file.suffix == ".bag" else "ros2"
    chosen = choose("format", by_name if bag_format is None else bag_format, tuple(FORMATS))
    if chosen == "ros1" != by_name:
        raise ValueError(f"{file}: a ROS 1 bag is a file named NAME.bag")
    if chosen == "ros2" and file.suffix in {".bag", ".db3", ".mcap"}:
        raise ValueError(f"{file}: a ROS 2 bag is a folder, name it without {file.suffix}")
    return FORMATS[chosen]


def refuse_existing(file: Path) -> None:
    """Raise a ValueError if a file or folder of a bag's name exists."""
    if file.exists() or file.is_symlink():
        raise ValueError(f"{file} exists already and is not replaced: give another name")


def _check_stamps(name: str, topic: Topic, ros: int) -> None:
    """Raise a ValueError unless a ROS version can represent a topic's stamps."""
    if not len(topic):
        return
    first, last = int(topic.stamp[0]), int(topic.stamp[-1])
    if first <= 0 or last >= LAST_SECOND[ros] * SECOND:
        raise ValueError(
            f"{name}: stamps must be above 0, which ROS takes for not set, and below "
            f"{LAST_SECOND[ros]} s; they go from {first} to {last} ns"
        )


def _messages(ros: int, topics: Mapping[str, Topic]) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic name, stamp and bytes of all messages, ordered by stamp."""

    def named(name: str, topic: Topic) -> Iterator[tuple[int, str, bytes]]:
        return ((stamp, name, data) for stamp, data in serialise(ros, topic))

    for stamp, name, data in heapq.merge(*(named(*item) for item in topics.items())):
        yield name, stamp, data


def _write_ros1(file: Path, topics: Mapping[str, Topic]) -> None:
    from rosbags.rosbag1 import Writer

    with Writer(file) as writer:
        connections: dict[str, Any] = {
            name: writer.add_connection(
                name, CODECS[type(topic)].message_types[0], typestore=typestore(ROS1),
                callerid="/lpv_track", latching=int(isinstance(topic, Datum)),
            )
            for name, topic in topics.items()
        }  # fmt: skip
        for name, stamp, data in _messages(ROS1, topics):
            writer.write(connections[name], stamp, data)


def _write_ros2(folder: Path, topics: Mapping[str, Topic], storage: str) -> None:
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )
    from rosbags.rosbag2 import StoragePlugin, Writer

    forever = QosTime(2147483647, 4294967295)

    def offered(topic: Topic) -> Qos:
        """Return the quality of service: reliable, and latched for a datum, which is sent once."""
        kept = isinstance(topic, Datum)
        return Qos(
            QosHistory.KEEP_LAST, 1 if kept else 10, QosReliability.RELIABLE,
            QosDurability.TRANSIENT_LOCAL if kept else QosDurability.VOLATILE,
            forever, forever, QosLiveliness.AUTOMATIC, forever,
            avoid_ros_namespace_conventions=False,
        )  # fmt: skip

    plugin = StoragePlugin[storage.upper()]
    with Writer(folder, version=METADATA_VERSION, storage_plugin=plugin) as writer:
        connections = {
            name: writer.add_connection(
                name, CODECS[type(topic)].message_types[0], typestore=typestore(ROS2),
                offered_qos_profiles=[offered(topic)],
            )
            for name, topic in topics.items()
        }  # fmt: skip
        for name, stamp, data in _messages(ROS2, topics):
            writer.write(connections[name], stamp, data)


def _flush(file: Path) -> None:
    """Force a file's content to the disk."""
    with file.open("rb") as handle:
        os.fsync(handle.fileno())
