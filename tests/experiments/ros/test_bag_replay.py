"""Recorded drives through the estimator and an agent, and the command that does it."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib.image
import numpy as np
import pytest
from numpy.testing import assert_allclose

import agents
import trajectories
from experiments.cli import main
from experiments.ros.comparison import draw, summary
from experiments.ros.read import BagError, info, read
from experiments.ros.replay import Inputs, Replay, record, replay
from experiments.ros.runs import measured, topics_of
from experiments.ros.topics import SECOND, Commands, Odometry, Topic
from experiments.ros.write import write
from lpv_track_env.conditions import REALTIME, Conditions
from lpv_track_env.estimation.observer import PathObserver
from tests.helpers.recorded_drives import CAR, driven

pytest.importorskip("rosbags", reason="rosbags is not installed")


def replayed(bag: Path, trajectory: str = "u-turn", **settings: Any) -> Replay:
    path = trajectories.load(trajectory)
    env = gymnasium.make("lpv_track_env/PathTracking-v0", trajectory=path, vehicle=CAR)
    observer = PathObserver(path, env.unwrapped.layout)  # type: ignore[attr-defined]
    return replay(record(bag, **settings), path, CAR, agents.make("pid", env), observer)


def truth() -> dict[str, Topic]:
    return topics_of(driven())


def test_perfect_sensors_show_the_truth_again(tmp_path: Path) -> None:
    """The estimate equals the driven states, and the same agent proposes the recorded commands."""
    write(tmp_path / "a.bag", truth())
    done = replayed(tmp_path / "a.bag")
    trace = driven()
    n = len(done.time)
    assert n == len(trace.time) - 1
    # Recorded commands have 32 bits.
    assert_allclose(done.estimate, trace.state[:n], atol=1e-5)
    assert_allclose(done.lateral_error, trace.lateral_error[:n], atol=1e-5)
    # What was in force before the first command is not in the bag.
    assert_allclose(done.proposed[1:], done.recorded[1:], atol=1e-4)
    assert_allclose(done.recorded[:, 1], trace.steering_angle[1:], atol=1e-6)
    assert done.fix_used.all()
    assert done.recording.remarks == []


def test_measured_sensors_are_estimated_from(tmp_path: Path) -> None:
    sensors = REALTIME.replace(gnss_outlier_rate=0.03)
    write(tmp_path / "a.bag", measured(truth(), sensors, seed=1))
    done = replayed(tmp_path / "a.bag")
    found = summary(done)
    # Fixes wander by 3 cm each way and have 3 cm of noise; outliers of 3 m must not get through.
    assert found["errors"]["position"]["max"] < 0.25
    assert found["counts"]["fixes_gated"] == (~done.fix_used).sum() > 0
    assert found["errors"]["heading"]["rms"] < 0.01
    assert found["fix_nis"]["share_within_95"] > 0.9
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_sensors_err_as_their_conditions_say(tmp_path: Path) -> None:
    sensors = Conditions(
        gnss_noise=0.05, gnss_wander=0.1, gnss_wander_time=2.0, heading_noise=0.01,
        heading_bias=0.02, yaw_rate_noise=0.003, speed_noise=0.05, speed_scale=0.01,
    )  # fmt: skip
    perfect = topics_of(driven("T2"))
    read_topics: Any = measured(perfect, sensors, seed=0)
    true: Any = perfect
    error = read_topics["/imu"].heading - true["/imu"].heading
    n = len(error)
    assert_allclose(error.mean(), 0.02, atol=4 * 0.01 / math.sqrt(n))
    assert_allclose(error.std(), 0.01, rtol=4 / math.sqrt(2 * n))
    ratio = read_topics["/wheel_speed"].speed - 1.01 * true["/wheel_speed"].speed
    assert_allclose(ratio.std(), 0.05, rtol=4 / math.sqrt(2 * n))
    off = read_topics["/fix"].positions((45.0, 10.0, 0.0)) - true["/fix"].positions(
        (45.0, 10.0, 0.0)
    )
    # Neighbours share the wander, not the noise: the variance of differences is that of twice the
    # noise and of what a wander of 2 s moves in 0.1 s, 2 * 0.1^2 (1 - exp(-0.05)).
    expected = 2.0 * 0.05**2 + 2.0 * 0.1**2 * (1.0 - math.exp(-0.05))
    assert_allclose(np.diff(off, axis=0).var(), expected, rtol=0.15)
    assert read_topics["/imu"].heading_deviation == 0.01
    assert read_topics["/odom"] is true["/odom"]
    again: Any = measured(perfect, sensors, seed=0)
    assert_allclose(again["/fix"].latitude, read_topics["/fix"].latitude, rtol=0.0)


def test_fixes_drop_out() -> None:
    sensors = Conditions(gnss_dropout_rate=0.2, gnss_dropout_duration=1.0)
    found: Any = measured(topics_of(driven("T2")), sensors, seed=0)
    gaps = np.diff(found["/fix"].time)
    assert gaps.max() > 1.0
    assert (gaps > 0.15).sum() >= 5


def test_inputs_are_averaged() -> None:
    stamp = np.array([1, 2, 4]) * SECOND
    inputs = Inputs(Commands(stamp, np.array([1.0, 3.0, 0.0]), np.zeros(3), np.zeros(3)))
    assert inputs.mean(SECOND, 3 * SECOND)[0] == 2.0
    assert inputs.mean(0, 2 * SECOND)[0] == 1.0
    assert inputs.mean(3 * SECOND, 6 * SECOND)[0] == 1.0
    assert (inputs.before(2 * SECOND)[0], inputs.after(2 * SECOND)[0]) == (1.0, 3.0)
    assert inputs.mean(2 * SECOND, 2 * SECOND)[0] == 1.0


def test_an_odometry_of_its_own_frame_is_laid_onto_the_fixes(tmp_path: Path) -> None:
    topics = truth()
    odom: Any = topics["/odom"]
    turn = np.exp(0.8j)
    z = turn * (odom.x + 1j * odom.y) + (40.0 - 7.0j)
    topics["/odom"] = replace(odom, x=z.real, y=z.imag, heading=odom.heading + 0.8)
    del topics["/datum"]
    write(tmp_path / "a.bag", topics)
    # The path's datum, as if a path of this place were at hand.
    done = replayed(tmp_path / "a.bag", datum=(45.0, 10.0, 0.0))
    assert done.recording.odometry_is_aligned
    errors = summary(done)["errors"]
    assert errors["position"]["max"] < 1e-3
    assert errors["heading"]["max"] < 1e-3
    assert done.recording.remarks[0].startswith("no datum of the frame odom: odometry is turned")


def test_a_heading_that_does_not_point_north_is_left_out(tmp_path: Path) -> None:
    topics = truth()
    imu: Any = topics["/imu"]
    topics["/imu"] = replace(imu, heading=imu.heading + 1.2)
    write(tmp_path / "a.bag", topics)
    done = replayed(tmp_path / "a.bag")
    assert done.recording.remarks == [
        "the IMU's heading is off the fixes' course by 1.20 rad: left out"
    ]
    assert summary(done)["errors"]["position"]["rms"] < 0.05


def test_fixes_and_commands_are_enough(tmp_path: Path) -> None:
    topics = {name: topic for name, topic in truth().items() if name in {"/fix", "/command"}}
    write(tmp_path / "a.bag", topics)
    done = replayed(tmp_path / "a.bag", datum=(45.0, 10.0, 0.0))
    trace = driven()
    apart = done.estimate[:, 4:6] - trace.state[: len(done.time), 4:6]
    assert np.hypot(*apart[100:].T).max() < 0.1
    found = summary(done)
    assert found["errors"] == {}
    assert found["reading_nis"]["mean"] is None
    draw(done, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_what_cannot_be_replayed(tmp_path: Path) -> None:
    topics = truth()
    write(tmp_path / "a.bag", topics)
    with pytest.raises(BagError, match="the drive begins 91 m from the path: give its own path"):
        replayed(tmp_path / "a.bag", datum=(44.999, 10.0, 0.0))
    for name, kind in (("/fix", "NavSatFix"), ("/command", "AckermannDriveStamped")):
        some = {other: topic for other, topic in topics.items() if other != name}
        bag = tmp_path / f"without-{kind}.bag"
        write(bag, some)
        with pytest.raises(BagError, match=f"no topic with messages .*{kind}"):
            record(bag)


def test_fixes_and_commands_of_other_times(tmp_path: Path) -> None:
    topics = truth()
    command: Any = topics["/command"]
    topics["/command"] = replace(command, stamp=command.stamp - command.stamp[0] + 1)
    fix: Any = topics["/fix"]
    topics["/fix"] = replace(fix, stamp=fix.stamp + 100 * SECOND)
    write(tmp_path / "a.bag", topics)
    with pytest.raises(BagError, match="fixes and commands do not overlap in time"):
        replayed(tmp_path / "a.bag")


def test_the_command_from_export_to_replay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, path, out = tmp_path / "run", tmp_path / "path.csv", tmp_path / "replay"
    assert main(["bag", "export", "--agent", "pid", "--trajectory", "u-turn", "--out", str(bag),
                 "--storage", "mcap", "--sensors", "realtime",
                 "--datum", "48", "11", "500"]) == 0  # fmt: skip
    assert capsys.readouterr().out.endswith(f"messages in {bag}\n")
    assert info(bag).storage == "mcap"
    assert len(read(bag, Odometry).data) == len(driven().time)
    assert main(["bag", "info", str(bag)]) == 0
    told = capsys.readouterr().out
    assert "ROS 2, mcap" in told
    assert all(name in told for name in ("/odom", "/imu", "/fix", "/command", "/wheel_speed"))
    assert main(["bag", "reference", str(bag), "--source", "fix", "--out", str(path)]) == 0
    assert "positions of /fix" in capsys.readouterr().out
    origin = trajectories.load(path).metadata["origin"]
    assert origin == {"latitude_deg": 48.0, "longitude_deg": 11.0, "height_m": 500.0}
    assert main(["bag", "replay", str(bag), "--trajectory", str(path), "--agent", "pid",
                 "--out", str(out)]) == 0  # fmt: skip
    assert "estimate - odometry: position" in capsys.readouterr().out
    found = json.loads((out / "replay.json").read_text())
    assert found["errors"]["position"]["max"] < 0.3
    picture = matplotlib.image.imread(out / "replay.png")
    assert picture.std() > 0.05


def test_what_the_user_can_mend(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "run.bag"
    topics = truth()
    write(bag, {**topics, "/slam": topics["/odom"]})
    (tmp_path / "torn.bag").write_bytes(bag.read_bytes()[:5000])
    cases = {
        "several topics": ["reference", str(bag), "--out", str(tmp_path / "p.csv")],
        "--odometry-topic": ["replay", str(bag), "--trajectory", "u-turn"],
        "written as NAME.csv": ["reference", str(bag), "--out", str(tmp_path / "p.txt")],
        "cannot be read as a ROS 1 bag": ["info", str(tmp_path / "torn.bag")],
        "No such file": ["info", str(tmp_path / "none.bag")],
        "exists already": ["export", "--out", str(bag)],
        "a datum is latitude": ["export", "--out", "x", "--datum", "99", "0", "0"],
        "unknown conditions": ["export", "--out", "x", "--sensors", "perfect"],
        "unknown trajectory": ["replay", str(bag), "--trajectory", "T9"],
        "unknown agent": ["replay", str(bag), "--trajectory", "T2", "--agent", "nobody"],
    }
    for words, arguments in cases.items():
        assert main(["bag", *arguments]) == 2, arguments
        told = capsys.readouterr().err
        assert words in told
        assert told.count("\n") == 1
    assert main(["bag", "reference", str(bag), "--out", str(tmp_path / "p.csv"),
                 "--odometry-topic", "/slam"]) == 0  # fmt: skip


def test_the_missing_package_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert main(["bag", "info", "run.bag"]) == 2
    assert "pip install 'lpv-track-env[bags]'" in capsys.readouterr().err


@pytest.mark.parametrize("action", ["export", "info", "reference", "replay"])
def test_help_has_an_example(action: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["bag", action, "--help"])
    assert ended.value.code == 0
    assert f"example: lpv-track bag {action} " in capsys.readouterr().out
