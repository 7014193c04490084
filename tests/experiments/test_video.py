"""Videos: read back frame by frame, whole or not there, agents side by side."""

import builtins
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pygame
import pytest
from numpy.typing import NDArray

from agents.weights import in_words
from experiments import drive, sinks
from experiments.cli import main
from experiments.drive import agent_notes, beside
from experiments.sinks import Video, VideoSink

Frame = NDArray[np.uint8]
SIZE = (120, 80)
MANY = 25


def read(file: Path) -> tuple[dict[str, Any], list[Frame]]:
    """Return the properties and frames of a video, read independently."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra 'video' is not installed")
    reader = ffmpeg.read_frames(str(file))
    about = next(reader)
    width, height = about["size"]
    pictures = [np.frombuffer(raw, dtype=np.uint8).reshape(height, width, 3) for raw in reader]
    return about, pictures


@pytest.fixture
def _encoder() -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra 'video' is not installed")


def frames(count: int) -> Iterator[Frame]:
    """Frames that grow brighter."""
    for k in range(count):
        yield np.full((SIZE[1], SIZE[0], 3), 10 * k, dtype=np.uint8)


@pytest.mark.usefixtures("_encoder")
@pytest.mark.parametrize("ending", [".mp4", ".gif"])
def test_a_video_holds_every_frame(ending: str, tmp_path: Path) -> None:
    file = tmp_path / "new" / f"video{ending}"
    with Video(file, 20.0) as video:
        for frame in frames(MANY):
            video.add(frame)
        assert not file.exists()
    about, pictures = read(file)
    assert about["size"] == SIZE
    assert about["fps"] == pytest.approx(20.0)
    assert len(pictures) == video.count == MANY
    means = np.array([picture.mean() for picture in pictures])
    np.testing.assert_allclose(means, 10.0 * np.arange(MANY), atol=4.0)
    assert [path.name for path in file.parent.iterdir()] == [file.name]


@pytest.mark.usefixtures("_encoder")
@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interrupted_video_leaves_what_was_there(
    error: type[BaseException], tmp_path: Path
) -> None:
    file = tmp_path / "video.mp4"
    file.write_bytes(b"before")

    def interrupted() -> None:
        with Video(file, 20.0) as video:
            for frame in frames(5):
                video.add(frame)
            raise error

    with pytest.raises(error):
        interrupted()
    assert file.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.usefixtures("_encoder")
def test_what_cannot_be_encoded_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ends in \.mp4 or \.gif"):
        Video(tmp_path / "video.avi", 20.0)
    for fps in (0.0, np.inf, np.nan, 1000.0):
        with pytest.raises(ValueError, match="frames a second"):
            Video(tmp_path / "video.mp4", fps)

    def write(*shapes: tuple[int, ...]) -> None:
        with Video(tmp_path / "video.mp4", 20.0) as video:
            for shape in shapes:
                video.add(np.zeros(shape, dtype=np.uint8))

    with pytest.raises(ValueError, match="of one size"):
        write((80, 120, 3), (80, 122, 3))
    with pytest.raises(ValueError, match="height, width, 3"):
        write((80, 120))
    with pytest.raises(OSError, match=r"video\.mp4: .*not divisible by 2") as caught:
        write((81, 121, 3))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_missing_encoder_is_one_line_that_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = builtins.__import__

    def lacking(name: str, *arguments: Any, **settings: Any) -> Any:
        if name == "imageio_ffmpeg":
            raise ModuleNotFoundError(name)
        return real(name, *arguments, **settings)

    monkeypatch.setattr(builtins, "__import__", lacking)
    command = ["drive", "--agent", "stanley", "--trajectory", "u-turn"]
    assert main([*command, "--video", str(tmp_path / "out.mp4")]) == 2
    said = capsys.readouterr().err
    assert "pip install 'lpv-track-env[video]'" in said
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


# What drive makes of it -------------------------------------------------------------------------


@pytest.mark.usefixtures("_encoder")
def test_drive_writes_two_agents_side_by_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten times as fast, the end held for a second; the shorter drive keeps its last picture."""
    file = tmp_path / "out.mp4"
    command = ["drive", "--agents", "lpv-nmpc", "stanley", "--trajectory", "u-turn"]
    assert main([*command, "--video", str(file), "--fps", "10", "--speed-up", "10"]) == 0
    said = capsys.readouterr().out
    assert said.count("finished") == 2
    about, pictures = read(file)
    assert about["size"] == (1800, 600)
    assert about["fps"] == pytest.approx(10.0)
    driven = max(float(line.split(" after ")[1].split()[0]) for line in said.splitlines()[:2])
    assert len(pictures) == int(driven + 1e-6) + 10
    assert f"{len(pictures)} frames" in said
    assert all(picture.mean() > 50 and picture.std() > 5 for picture in pictures)
    moving = pictures[: len(pictures) - 11]
    for k in range(1, len(moving)):
        for side in (slice(0, 898), slice(902, 1800)):
            assert np.abs(moving[k][:, side].astype(int) - moving[k - 1][:, side]).max() > 20
    # Only the agent that plans shows its plan and its weights.
    left, right = pictures[5][150:400, :240], pictures[5][150:400, 900:1140]
    assert (left != 0).any()
    assert np.abs(left.astype(int) - right).max() > 100


@pytest.mark.usefixtures("_encoder")
def test_drive_interrupted_leaves_no_video(tmp_path: Path) -> None:
    agent = tmp_path / "interrupting.py"
    agent.write_text(
        "import os, signal\n"
        "from agents.classical.geometric import Stanley\n"
        "class Interrupting(Stanley):\n"
        "    steps = 0\n"
        "    def control(self, observation, memory):\n"
        "        self.steps += 1\n"
        "        if self.steps == 20:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "        return super().control(observation, memory)\n"
    )
    before = signal.getsignal(signal.SIGINT)
    folder = tmp_path / "videos"
    command = ["drive", "--agent", f"{agent}:Interrupting", "--trajectory", "u-turn"]
    assert main([*command, "--video", str(folder / "out.mp4")]) == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--agent", "pid", "--agents", "pid"], "not both"),
        (["--frames", "a", "--video", "b.mp4"], "not both"),
        (["--fps", "30"], "--video FILE"),
        (["--colour", "red", "--frames", "a"], "render_colour"),
    ],
)
def test_drive_refuses_in_one_line(
    options: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["drive", "--trajectory", "u-turn", *options]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.usefixtures("_encoder")
@pytest.mark.parametrize(
    ("period", "fps", "speed_up", "expected"),
    [(0.05, None, 1.0, 100), (0.05, 40.0, 1.0, 200), (0.05, 10.0, 2.0, 25), (0.01, None, 1.0, 50)],
)
def test_frames_are_as_many_as_their_rate_asks_for(
    period: float, fps: float | None, speed_up: float, expected: int, tmp_path: Path
) -> None:
    """Frames of 100 steps, spread evenly."""
    sink = VideoSink(tmp_path / "out.mp4", period, fps, speed_up)
    copies = [sink.copies(step) for step in range(1, 101)]
    assert sum(copies) == expected
    assert max(copies) - min(copies) <= 1
    with pytest.raises(ValueError, match="--speed-up"):
        VideoSink(tmp_path / "out.mp4", period, fps, 0.0)


def test_side_by_side_frames_keep_their_pixels() -> None:
    one, other = (np.full((6, 8, 3), value, dtype=np.uint8) for value in (10, 200))
    picture = beside([one, other])
    assert picture.shape == (6, 16, 3)
    assert (picture[:, :7] == 10).all()
    assert (picture[:, 9:] == 200).all()
    assert (picture[:, 7:9] == drive.SEAM).all()
    assert beside([one]) is one


def test_a_window_shows_a_drive_and_its_end_does_not_end_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    shown = []

    class Watched(sinks.WindowSink):
        def add(self, step: int, frame: Frame, times: int) -> None:
            super().add(step, frame, times)
            shown.append(step)
            if step == 5:
                pygame.event.post(pygame.event.Event(pygame.QUIT))

    monkeypatch.setattr(drive, "WindowSink", Watched)
    assert main(["drive", "--agents", "pid", "stanley", "--trajectory", "u-turn"]) == 0
    assert shown == [1, 2, 3, 4, 5, 6]
    assert capsys.readouterr().out.count("finished") == 2
    assert not pygame.display.get_init()


def test_notes_hold_what_is_in_use_and_no_time() -> None:
    told = {
        "status": "SUCCESS", "iterations": 6, "seconds": 1.0, "fallback": "",
        "weights": np.arange(12.0),
    }  # fmt: skip
    notes = agent_notes("mine", {"agent": told})
    assert notes["Q"].split() == ["0", "1", "2", "3"]
    assert notes["S"].split() == ["4", "5", "6", "7"]
    assert notes["R"].split() == ["8", "9"]
    assert notes["R_rate"].split() == ["10", "11"]
    assert notes["agent"] == "mine"
    assert notes == agent_notes("mine", {"agent": {**told, "seconds": 2.0}})
    assert agent_notes("pid", {"agent": {}}) == {"agent": "pid"}
    wide = [1e-4, 0.12345, 12.3, 123.4, 9999.0, 1e6, 0.0, 1.0, 0.01, 10.0, 0.002, 0.2]
    assert " ".join(in_words(wide).values()).split() == [
        "0.0001", "0.12", "12", "123", "9999", "1e+06", "0", "1", "0.01", "10", "0.002", "0.2"
    ]  # fmt: skip


def test_gymnasium_records_videos(tmp_path: Path) -> None:
    """Its RecordVideo, on the single environment."""
    pytest.importorskip("moviepy", reason="the extra 'video' is not installed")
    env: gymnasium.Env[Any, Any] = gymnasium.make(
        "lpv_track_env/PathTracking-v0", trajectory="u-turn", render_mode="rgb_array"
    )
    recorded = gymnasium.wrappers.RecordVideo(env, str(tmp_path / "videos"), disable_logger=True)
    recorded.reset(seed=0)
    for _ in range(12):
        recorded.step(np.array([0.3, 0.05], dtype=np.float32))
    recorded.close()
    (file,) = tmp_path.glob("videos/*.mp4")
    about, pictures = read(file)
    assert about["size"] == (900, 600)
    assert about["fps"] == pytest.approx(20.0)
    assert len(pictures) == 13
    assert all(picture.mean() > 50 and picture.std() > 5 for picture in pictures)
    assert (pictures[0] != pictures[-1]).any()
