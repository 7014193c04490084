"""Read ROS 1 and ROS 2 bags of any origin into plain arrays."""

import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from experiments.ros.messages import (
    CODECS,
    ROS1,
    ROS2,
    digest_of,
    require_rosbags,
    stamp_of,
    typestore,
)
from experiments.ros.topics import Topic
from trajectories.arguments import shortened

T = TypeVar("T", bound=Topic)
Array = NDArray[np.float64]

MAGIC = {
    b"#ROSBAG V": (ROS1, "bag"),
    b"\x89MCAP0\r\n": (ROS2, "mcap"),
    b"SQLite format 3\0": (ROS2, "sqlite3"),
}
"""ROS version and storage by the first bytes of a file."""
SUFFIXES = {"mcap": ".mcap", "sqlite3": ".db3"}


class BagError(ValueError):
    """Bag that cannot be used for the purpose, with the reason in one line.

    Text that is quoted from a file may be anything; unprintable characters become spaces.
    """

    def __init__(self, message: str) -> None:
        super().__init__(shortened(printable(message), 400))


def printable(text: str) -> str:
    """Replace line ends and control characters by spaces."""
    return "".join(character if character.isprintable() else " " for character in text)


@dataclass(frozen=True)
class TopicInfo:
    """Topic in a bag's index."""

    name: str
    message_type: str
    messages: int


@dataclass(frozen=True)
class BagInfo:
    """Index of a bag."""

    file: Path
    ros: int
    """1 or 2."""
    storage: str
    """bag, sqlite3 or mcap."""
    start: int
    end: int
    """Times of receipt of the first and last message, ns; both 0 if there are none."""
    topics: tuple[TopicInfo, ...]

    def of_kind(self, kind: type[Topic]) -> list[str]:
        """Return the names of the topics with messages of a kind."""
        types = CODECS[kind].message_types
        return [
            topic.name for topic in self.topics if topic.message_type in types and topic.messages
        ]


@dataclass(frozen=True)
class Reading(Generic[T]):
    """Arrays of a topic in the order of their stamps, and counts of its faulty messages."""

    topic: str
    data: T
    messages: int
    out_of_order: int
    """Messages with an earlier stamp than a message logged before them; sorted."""
    duplicates: int
    """Messages with the same stamp as a message logged before them; dropped."""
    unusable: int
    """Messages without a stamp (0), without a fix, or with a value that is not finite; dropped."""


def info(file: Path) -> BagInfo:
    """Read a bag's index.

    Raises
    ------
    BagError
        If the file is not a bag, or truncated.
    ModuleNotFoundError
        If `rosbags` is not installed.
    """
    with _opened(file) as (reader, ros, storage):
        return _info(file, reader, ros, storage)


def read(file: Path, kind: type[T], topic: str | None = None) -> Reading[T]:
    """Read one topic of a bag.

    Parameters
    ----------
    file
        NAME.bag, a ROS 2 bag's folder, or a .db3 or .mcap file of one.
    kind
        `Odometry`, `Imu`, `WheelSpeed`, `Fixes`, `Commands` or `Datum`.
    topic
        Its name; by default the only topic with messages of that kind.

    Raises
    ------
    BagError
        If the file is not a bag, or truncated; if there is no such topic, or several, which are
        listed; if a message type has another layout, no message is usable, or the frame changes.
    ModuleNotFoundError
        If `rosbags` is not installed.
    """
    with _opened(file) as (reader, ros, storage):
        name = _choose(_info(file, reader, ros, storage), kind, topic)
        codec, store = CODECS[kind], typestore(ros)
        types = codec.message_types
        connections = [c for c in reader.connections if c.topic == name and c.msgtype in types]
        for connection in connections:
            _check_layout(file, connection, ros)
        from_bytes = store.deserialize_ros1 if ros == ROS1 else store.deserialize_cdr
        stamps: list[int] = []
        rows: list[tuple[float, ...]] = []
        frames: set[str] = set()
        for connection, _, data in reader.messages(connections=connections):
            message: Any = from_bytes(data, connection.msgtype)
            stamps.append(stamp_of(message))
            rows.append(tuple(codec.row(message)))
            frames.add(message.header.frame_id)
    if len(frames) > 1:
        raise BagError(f"{file}: {name} changes its frame: {', '.join(sorted(frames))[:200]}")
    return _tidied(file, name, kind, np.array(stamps, dtype=np.int64), np.array(rows), frames)


def _tidied(
    file: Path,
    name: str,
    kind: type[T],
    stamps: NDArray[np.int64],
    rows: Array,
    frames: set[str],
) -> Reading[T]:
    """Return messages in the order of logging as arrays: sorted, usable, without duplicates."""
    columns, codec = kind.columns(), CODECS[kind]
    messages = len(stamps)
    rows = rows.reshape(messages, len(columns) + len(codec.deviations))
    needed = [k for k, column in enumerate(columns) if column not in kind.MAY_BE_NAN]
    optional = [k for k, column in enumerate(columns) if column in kind.MAY_BE_NAN]
    usable = (stamps > 0) & np.isfinite(rows[:, needed]).all(axis=1)
    usable &= ~np.isinf(rows[:, optional]).any(axis=1)
    stamps, rows = stamps[usable], rows[usable]
    if not len(stamps):
        raise BagError(
            f"{file}: none of the {messages} messages of {name} is usable: header stamps are 0, "
            "or values are not numbers"
        )
    late = int((stamps < np.maximum.accumulate(stamps)).sum())
    order = np.argsort(stamps, kind="stable")
    stamps, rows = stamps[order], rows[order]
    first = np.append(True, np.diff(stamps) > 0)
    duplicates = int((~first).sum())
    stamps, rows = stamps[first], rows[first]
    values = dict(zip(columns, rows.T, strict=False))
    if "heading" in values:
        values["heading"] = _unwrapped(values["heading"])
    variances = rows[:, len(columns) :]
    try:
        data = kind(
            stamps, **values, frame=next(iter(frames)),
            **{key: _deviation(variances[:, k]) for k, key in enumerate(codec.deviations)},
        )  # fmt: skip
    except ValueError as error:
        raise BagError(f"{file}: {name}: {error}") from error
    return Reading(name, data, messages, late, duplicates, int((~usable).sum()))


def _unwrapped(heading: Array) -> Array:
    """Return headings without jumps of whole turns; NaN stays NaN."""
    unwrapped = heading.copy()
    known = ~np.isnan(heading)
    unwrapped[known] = np.unwrap(heading[known])
    return unwrapped


def _deviation(variance: Array) -> float | None:
    """Return the square root of the median positive variance, or None if there is none."""
    known = variance[np.isfinite(variance) & (variance > 0.0)]
    return math.sqrt(float(np.median(known))) if len(known) else None


def _choose(bag: BagInfo, kind: type[Topic], topic: str | None) -> str:
    """Return the topic of a kind: the named one, else the only one."""
    found = bag.of_kind(kind)
    listed = ", ".join(found) if found else "none"
    types = " or ".join(CODECS[kind].message_types).replace("/msg/", "/")
    if topic is not None:
        if topic not in found:
            raise BagError(
                f"{bag.file}: no topic {topic} with messages {types}; there is: {listed}"
            )
        return topic
    if not found:
        there = ", ".join(f"{t.name} ({t.message_type})" for t in bag.topics)[:300]
        raise BagError(f"{bag.file}: no topic with messages {types}; there is: {there or 'none'}")
    if len(found) > 1:
        raise BagError(
            f"{bag.file}: several topics with messages {types}: {listed}; choose one with "
            f"--{kind.KIND}-topic"
        )
    return found[0]


def _check_layout(file: Path, connection: Any, ros: int) -> None:
    """Refuse messages whose layout differs from this project's definition."""
    expected = digest_of(ros, connection.msgtype)
    if connection.digest not in {"", "*", expected}:
        raise BagError(
            f"{file}: {connection.topic} has a {connection.msgtype} of another layout "
            f"({connection.digest[:24]}, not {expected[:24]})"
        )


def _info(file: Path, reader: Any, ros: int, storage: str) -> BagInfo:
    """Return the index of an opened bag."""
    counts: Counter[tuple[str, str]] = Counter()
    for name, topic in reader.topics.items():
        for connection in topic.connections:
            counts[str(name), str(connection.msgtype)] += int(connection.msgcount)
    empty = not counts.total()
    return BagInfo(
        file, ros, storage,
        0 if empty else int(reader.start_time), 0 if empty else int(reader.end_time) - 1,
        tuple(TopicInfo(*key, count) for key, count in sorted(counts.items())),
    )  # fmt: skip


@contextmanager
def _opened(file: Path) -> Iterator[tuple[Any, int, str]]:
    """Open a bag as (reader, ROS version, storage); any error inside becomes a BagError.

    A truncated or foreign file makes parsers fail in many ways (struct, sqlite, YAML, assertions,
    ...), all of which the file causes.
    """
    require_rosbags()
    ros, storage = _recognise(file)
    reader: Any
    try:
        if ros == ROS1:
            from rosbags.rosbag1 import Reader as Reader1

            reader = Reader1(file)
        else:
            from rosbags.rosbag2 import Reader as Reader2

            reader = Reader2(file)
        with reader:
            yield reader, ros, storage
    except BagError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BagError(f"{file}: cannot be read as a ROS {ros} bag: {reason}") from error


def _recognise(file: Path) -> tuple[int, str]:
    """Return ROS version and storage of a bag, by its content."""
    try:
        if file.is_dir():
            return ROS2, _storage_in(file)
        if file.exists() and not file.is_file():
            raise BagError(f"{file}: cannot be read: it is a pipe or device, no regular file")
        with file.open("rb") as handle:
            begin = handle.read(16)
    except OSError as error:
        raise BagError(f"{file}: cannot be read: {error.strerror or error}") from error
    if not begin:
        raise BagError(f"{file} is empty")
    for magic, (ros, storage) in MAGIC.items():
        if not begin.startswith(magic):
            continue
        suffix = SUFFIXES.get(storage)
        if suffix is not None and file.suffix != suffix:
            raise BagError(f"{file}: a ROS 2 file of {storage} must be named NAME{suffix}")
        return ros, storage
    raise BagError(f"{file} is no ROS bag (a .bag file, a ROS 2 bag's folder, .db3 or .mcap)")


def _storage_in(folder: Path) -> str:
    """Return the storage of a ROS 2 bag's folder, which must hold regular files."""
    entries = list(folder.iterdir())
    if not (folder / "metadata.yaml").is_file():
        raise BagError(f"{folder} is no ROS 2 bag: there is no metadata.yaml in the folder")
    if special := [entry for entry in entries if not entry.is_file() and not entry.is_dir()]:
        raise BagError(f"{special[0]}: cannot be read: it is a pipe or device, no regular file")
    return "mcap" if any(".mcap" in entry.name for entry in entries) else "sqlite3"
