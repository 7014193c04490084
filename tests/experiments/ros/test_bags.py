"""Bags: written whole or not at all, read by others, and read from others whatever their state."""

import json
import math
import pickle
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.helpers.recorded_drives import driven

rosbags = pytest.importorskip("rosbags.rosbag1", reason="rosbags is not installed")

from rosbags.highlevel import AnyReader  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

from experiments.ros import write as writing  # noqa: E402
from experiments.ros.messages import ROS1, ROS2, serialise, typestore  # noqa: E402
from experiments.ros.read import BagError, info, read  # noqa: E402
from experiments.ros.runs import DATUM, START, topics_of  # noqa: E402
from experiments.ros.topics import (  # noqa: E402
    KINDS,
    SECOND,
    Commands,
    Fixes,
    Imu,
    Odometry,
    Topic,
    WheelSpeed,
)
from experiments.ros.write import write  # noqa: E402
from experiments.run.rollout import Trace  # noqa: E402
from trajectories.geodesy import east_north_up, geodetic  # noqa: E402

FORMATS = {"ros1": ("run.bag", "sqlite3"), "sqlite3": ("run", "sqlite3"), "mcap": ("run", "mcap")}
each_format = pytest.mark.parametrize("bag_format", FORMATS)


def written(folder: Path, bag_format: str, topics: dict[str, Topic]) -> Path:
    name, storage = FORMATS[bag_format]
    write(folder / name, topics, storage=storage)
    return folder / name


@pytest.fixture(scope="module", params=FORMATS)
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bag of a run in one of the formats, read-only."""
    return written(tmp_path_factory.mktemp("bags"), request.param, topics_of(driven()))


def odometry(stamp: Any, **changes: Any) -> Odometry:
    """Return the odometry of a standing vehicle at some stamps."""
    n = len(stamp)
    columns = {name: np.zeros(n) for name in Odometry.columns()}
    return Odometry(np.asarray(stamp), **{**columns, **changes})


def test_geodetic_inverts_east_north_up() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3)) * [2e4, 2e4, 1e3]
    for origin in ((45.0, 10.0, 0.0), (0.0, 0.0, 0.0), (89.9, 170.0, 50.0), (-33.0, -179.99, 8e3)):
        assert_allclose(east_north_up(*geodetic(points, origin), origin), points, atol=1e-8)


def test_a_run_comes_back(bag: Path) -> None:
    topics = topics_of(driven())
    assert {topic.name for topic in info(bag).topics} == set(topics)
    for kind in KINDS:
        reading = read(bag, kind)
        told = topics[reading.topic]
        assert (reading.out_of_order, reading.duplicates, reading.unusable) == (0, 0, 0)
        assert reading.messages == len(told)
        assert_array_equal(reading.data.stamp, told.stamp)
        assert reading.data.frame == told.frame
        # Headings go through quaternions; a command has 32 bits.
        tolerance = 1e-6 if kind is Commands else 1e-14
        for name in kind.columns():
            assert_allclose(getattr(reading.data, name), getattr(told, name), atol=tolerance)


def test_what_others_read(bag: Path) -> None:
    """Read with rosbags' own reader, which uses the definitions in the bag."""
    trace, k = driven(), 100
    found: dict[str, list[Any]] = {}
    with AnyReader([bag]) as reader:
        for connection, stamp, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            header = message.header.stamp
            assert stamp == header.sec * SECOND + header.nanosec
            found.setdefault(connection.topic, []).append(message)
    vx, vy, psi, r, x, y = trace.state[k]
    odom = found["/odom"][k]
    stamp = odom.header.stamp
    assert stamp.sec * SECOND + stamp.nanosec == START + round(trace.time[k] * SECOND)
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
    assert (odom.pose.pose.position.x, odom.pose.pose.position.y) == (x, y)
    turned = odom.pose.pose.orientation
    assert_allclose((turned.z, turned.w), (math.sin(psi / 2), math.cos(psi / 2)))
    twist = odom.twist.twist
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == (vx, vy, r)
    assert not odom.pose.covariance.any()
    imu = found["/imu"][k]
    assert imu.header.frame_id == "base_link"
    assert_allclose(imu.linear_acceleration.z, 9.80665)
    assert not imu.orientation_covariance.any()
    fix = found["/fix"][k // 2]  # 10 Hz, beside odometry's 20 Hz
    place = [np.array([v]) for v in (fix.latitude, fix.longitude, fix.altitude)]
    assert_allclose(east_north_up(*place, DATUM)[0], (x, y, 0.0), atol=1e-8)
    assert (fix.status.status, fix.position_covariance_type) == (0, 0)
    drive = found["/command"][k].drive
    assert_allclose(drive.acceleration, trace.acceleration[k + 1], rtol=1e-6)
    assert_allclose(drive.steering_angle, trace.steering_angle[k + 1], rtol=1e-6)
    datum = found["/datum"][0].position
    assert (datum.latitude, datum.longitude, datum.altitude) == DATUM


def test_an_imu_feels_what_turns_and_what_speeds_up() -> None:
    """Accelerate on a circle with sideslip: a = v' + r x v by hand."""
    time = np.arange(0.0, 5.0, 0.05)
    zero = np.zeros_like(time)
    speed, rate = 2.0 + 0.5 * time, 0.2 + zero
    state = np.column_stack([speed, 0.1 + zero, 0.2 * time, rate, zero, zero])
    others = {name: zero for name in driven().as_dict() if name not in {"time", "state"}}
    imu: Any = topics_of(Trace(time=time, state=state, **others))["/imu"]
    assert_allclose(imu.forward_acceleration, 0.5 - 0.2 * 0.1)
    assert_allclose(imu.leftward_acceleration, 0.2 * speed)
    assert_allclose(imu.upward_acceleration, 9.80665)


def test_covariances_say_what_is_known(tmp_path: Path) -> None:
    stamp = np.array([1, 2]) * SECOND
    nan, zero = np.full(2, np.nan), np.zeros(2)
    topics: dict[str, Topic] = {
        "/odom": odometry(stamp, position_deviation=0.2, heading_deviation=0.01),
        "/imu": Imu(stamp, nan, zero, zero, zero, nan, yaw_rate_deviation=0.003),
        "/wheel_speed": WheelSpeed(stamp, zero, speed_deviation=0.05),
        "/fix": Fixes(stamp, zero, zero, nan, position_deviation=0.02),
    }
    bag = written(tmp_path, "ros1", topics)
    with AnyReader([bag]) as reader:
        found: dict[str, Any] = {
            connection.topic: reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
        }
    pose = found["/odom"].pose.covariance
    assert_allclose((pose[0], pose[7], pose[35], pose.sum()), (0.04, 0.04, 1e-4, 0.0801))
    assert not found["/odom"].twist.covariance.any()
    imu = found["/imu"]
    assert imu.orientation_covariance[0] == -1.0
    assert imu.linear_acceleration_covariance[0] == -1.0
    assert_allclose(imu.angular_velocity_covariance, [0] * 8 + [9e-6])
    assert found["/fix"].position_covariance_type == 1
    assert_allclose(np.diag(found["/fix"].position_covariance.reshape(3, 3)), 4e-4)
    back = read(bag, Odometry).data
    assert_allclose((back.position_deviation, back.heading_deviation), (0.2, 0.01))
    assert back.speed_deviation is None
    assert np.isnan(read(bag, Imu).data.heading).all()
    assert np.isnan(read(bag, Fixes).data.height).all()
    assert_allclose(read(bag, WheelSpeed).data.speed_deviation, 0.05)


@each_format
def test_headings_come_back_unwrapped(tmp_path: Path, bag_format: str) -> None:
    heading = np.linspace(0.0, 25.0, 100)
    stamp = SECOND * np.arange(1, 101)
    bag = written(tmp_path, bag_format, {"/odom": odometry(stamp, heading=heading)})
    assert_allclose(read(bag, Odometry).data.heading, heading, atol=1e-12)


def logged(
    file: Path,
    stamps: list[int],
    change: Callable[[int, Any], None] = lambda _k, _m: None,
    topics: tuple[str, ...] = ("/odom",),
) -> Path:
    """Write odometry with any stamps in the given order, x their index, logged once a second."""
    store = get_typestore(Stores.ROS1_NOETIC)
    orderly = odometry(SECOND * np.arange(1, len(stamps) + 1), x=np.arange(float(len(stamps))))
    with rosbags.Writer(file) as writer:
        for topic in topics:
            connection = writer.add_connection(topic, "nav_msgs/msg/Odometry", typestore=store)
            for k, (received, data) in enumerate(serialise(ROS1, orderly)):
                message: Any = store.deserialize_ros1(data, "nav_msgs/msg/Odometry")
                sec, nanosec = divmod(stamps[k], SECOND)
                message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
                change(k, message)
                changed = store.serialize_ros1(message, "nav_msgs/msg/Odometry")
                writer.write(connection, received, changed)
    return file


def test_header_stamps_count_and_their_disorder_is_counted(tmp_path: Path) -> None:
    def spoil(k: int, message: Any) -> None:
        if k == 5:
            message.pose.pose.position.y = math.nan

    stamps = [10, 30, 20, 30, 40, 50, 0, 60]
    reading = read(logged(tmp_path / "a.bag", stamps, spoil), Odometry)
    assert_array_equal(reading.data.stamp, [10, 20, 30, 40, 60])
    assert_array_equal(reading.data.x, [0, 2, 1, 4, 7])
    assert (reading.messages, reading.out_of_order) == (8, 1)
    assert (reading.duplicates, reading.unusable) == (1, 2)


def test_messages_without_any_stamp_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"none of the 3 messages of /odom is usable: header stamps"):
        read(logged(tmp_path / "a.bag", [0, 0, 0]), Odometry)


def test_an_unset_orientation_is_no_heading(tmp_path: Path) -> None:
    def unset(_k: int, message: Any) -> None:
        message.pose.pose.orientation.w = 0.0

    with pytest.raises(BagError, match="none of the 2 messages"):
        read(logged(tmp_path / "a.bag", [1, 2], unset), Odometry)


def test_a_frame_that_changes_is_refused(tmp_path: Path) -> None:
    def change(k: int, message: Any) -> None:
        message.header.frame_id = ("map", "odom")[k > 1]

    with pytest.raises(BagError, match="/odom changes its frame: map, odom"):
        read(logged(tmp_path / "a.bag", [1, 2, 3], change), Odometry)


def test_several_candidates_are_listed(tmp_path: Path) -> None:
    bag = logged(tmp_path / "a.bag", [1, 2], topics=("/odom", "/slam/odom"))
    with pytest.raises(BagError, match=r"several topics .*: /odom, /slam/odom; choose one with "):
        read(bag, Odometry)
    assert read(bag, Odometry, "/slam/odom").topic == "/slam/odom"
    with pytest.raises(BagError, match=r"no topic /odo .* there is: /odom, /slam/odom"):
        read(bag, Odometry, "/odo")
    with pytest.raises(BagError, match=r"NavSatFix; there is: /odom \(nav_msgs/msg/Odometry\)"):
        read(bag, Fixes)


def test_another_layout_of_a_type_is_refused(tmp_path: Path) -> None:
    with rosbags.Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection(
            "/odom", "nav_msgs/msg/Odometry", msgdef="std_msgs/Header header\n", md5sum="0" * 32
        )
        writer.write(connection, 1, b"\0" * 16)
    with pytest.raises(BagError, match="Odometry of another layout"):
        read(tmp_path / "a.bag", Odometry)


def test_definitions_in_a_bag_are_not_run(tmp_path: Path) -> None:
    """Definitions of other topics are not even parsed."""
    stamp = SECOND * np.arange(1, 4)
    with rosbags.Writer(tmp_path / "a.bag") as writer:
        odd = writer.add_connection(
            "/odd", "odd_msgs/msg/Odd", msgdef="float64 x\n__import__('os')\n", md5sum="1" * 32
        )
        writer.write(odd, 1, b"")
        connection = writer.add_connection(
            "/odom", "nav_msgs/msg/Odometry", typestore=typestore(ROS1)
        )
        for when, data in serialise(ROS1, odometry(stamp)):
            writer.write(connection, when, data)
    assert_array_equal(read(tmp_path / "a.bag", Odometry).data.stamp, stamp)


@each_format
def test_ctrl_c_leaves_nothing(
    tmp_path: Path, bag_format: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(ros: int, topic: Topic) -> Iterator[tuple[int, bytes]]:
        for k, message in enumerate(serialise(ros, topic)):
            if k == 50:
                raise KeyboardInterrupt
            yield message

    monkeypatch.setattr(writing, "serialise", interrupted)
    with pytest.raises(KeyboardInterrupt):
        written(tmp_path, bag_format, topics_of(driven()))
    assert list(tmp_path.iterdir()) == []


@each_format
def test_a_bag_is_not_replaced(tmp_path: Path, bag_format: str) -> None:
    topics: dict[str, Topic] = {"/odom": odometry([SECOND])}
    bag = written(tmp_path, bag_format, topics)
    with pytest.raises(ValueError, match="exists already and is not replaced"):
        written(tmp_path, bag_format, topics)
    assert [entry.name for entry in tmp_path.iterdir()] == [bag.name]


@pytest.mark.parametrize(
    ("name", "bag_format", "message"),
    [
        ("run", "ros1", "a ROS 1 bag is a file named NAME.bag"),
        ("run.bag", "ros2", "a ROS 2 bag is a folder"),
        ("run.mcap", None, "a ROS 2 bag is a folder"),
        ("run", "ros3", "unknown format 'ros3'"),
    ],
)
def test_names_fit_their_format(
    tmp_path: Path, name: str, bag_format: str | None, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        write(tmp_path / name, {"/odom": odometry([SECOND])}, bag_format=bag_format)


def test_arrays_are_checked() -> None:
    with pytest.raises(ValueError, match="stamps \\(n,\\) must increase"):
        odometry([1, 1])
    with pytest.raises(ValueError, match=r"odometry: x\[1\] is nan"):
        odometry([1, 2], x=np.array([0.0, np.nan]))
    with pytest.raises(ValueError, match=r"y has shape \(3,\), not \(2,\)"):
        odometry([1, 2], y=np.zeros(3))
    with pytest.raises(ValueError, match=r"latitude\[0\] is 91, beyond 90 degrees"):
        Fixes(np.array([1]), np.array([91.0]), np.zeros(1), np.zeros(1))
    with pytest.raises(ValueError, match="position_deviation must be positive"):
        odometry([1], position_deviation=0.0)


def test_stamps_that_ros_cannot_hold(tmp_path: Path) -> None:
    for stamp in (0, 2**31 * SECOND):
        with pytest.raises(ValueError, match="/odom: stamps must be above 0"):
            write(tmp_path / "run", {"/odom": odometry([stamp])})
    with pytest.raises(ValueError, match="no message to write"):
        write(tmp_path / "run", {"/odom": odometry([])})


def test_foreign_files(tmp_path: Path) -> None:
    files: dict[str, bytes] = {
        "empty.bag": b"",
        "text.bag": b"s_m,x_m\n1,2\n",
        "pickle.bag": pickle.dumps({"a": 1}),
        "json.bag": json.dumps([1]).encode(),
        "old.bag": b"#ROSBAG V1.2\n" + b"\0" * 100,
        "a.mcap": b"\x89MCAP0\r\n",
        "b.db3": b"SQLite format 3\0" + b"\0" * 200,
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(BagError, match=name) as caught:
            info(tmp_path / name)
        assert "\n" not in str(caught.value)
    with sqlite3.connect(tmp_path / "other.db3") as base:
        base.execute("create table something (id integer)")
    for name in ("other.db3", "nothing.bag"):
        with pytest.raises(BagError, match=name):
            info(tmp_path / name)
    (tmp_path / "folder").mkdir()
    with pytest.raises(BagError, match=r"there is no metadata\.yaml in the folder"):
        info(tmp_path / "folder")
    (tmp_path / "folder" / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, {\n")
    with pytest.raises(BagError, match="folder: cannot be read as a ROS 2 bag"):
        info(tmp_path / "folder")


@each_format
def test_damaged_bags_fail_in_one_line(tmp_path: Path, bag_format: str) -> None:
    """Truncated or with random bit flips: one line of error, or the readable messages."""
    rng = np.random.default_rng(0)
    bag = written(tmp_path, bag_format, {"/odom": odometry(SECOND * np.arange(1, 61))})
    source = bag if bag.is_file() else next(f for f in bag.iterdir() if f.suffix != ".yaml")
    whole = source.read_bytes()
    messages: list[str] = []
    for trial in range(24):
        content = bytearray(whole)
        if trial % 2:
            content = content[: int(rng.integers(1, len(content)))]
        else:
            # Half of them where the structure is: the beginning and the index at the end.
            span = len(content) if trial % 4 else 4096
            for place in rng.integers(0, span, size=5):
                content[place - (trial % 8 == 0) * span] ^= int(rng.integers(1, 256))
        copy = tmp_path / f"{trial}"
        if bag.is_file():
            copy = copy.with_suffix(".bag")
            copy.write_bytes(content)
        else:
            shutil.copytree(bag, copy)
            (copy / source.name).write_bytes(content)
        try:
            info(copy)
            read(copy, Odometry)
        except BagError as error:
            messages.append(str(error))
    assert len(messages) >= 8
    assert [text for text in messages if str(tmp_path) not in text or not text.isprintable()] == []


def test_ros_2_types_are_those_of_every_distribution() -> None:
    """The hashes of the written types do not depend on the distribution."""
    for store in Stores:
        if not store.name.startswith("ROS2"):
            continue
        theirs = get_typestore(store)
        for name in ("nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"):
            assert theirs.hash_rihs01(name) == typestore(ROS2).hash_rihs01(name)


def test_definitions_are_those_that_ros_ships() -> None:
    """Compare with the MD5 sums in the generated headers of ackermann_msgs, geographic_msgs."""
    store = typestore(ROS1)
    sums = {
        "ackermann_msgs/msg/AckermannDriveStamped": "1fd5d7f58889cefd44d29f6653240d0c",
        "geographic_msgs/msg/GeoPointStamped": "ea50d268b03080563c330351a21edc89",
    }
    assert {name: store.generate_msgdef(name)[1] for name in sums} == sums
