"""Destinations of a drive's frames: PNG files, a video (.mp4 or .gif), a window.

A video's frames are encoded as they come; none is kept in memory.
"""

import io
import secrets
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import pygame
from numpy.typing import NDArray

from lpv_track_env.rendering.window import Window
from trajectories.fileio import write_atomically

Frame = NDArray[np.uint8]

MOST_FPS = 50.0
"""Default limit on the frames a second of a video; players of .gif take no more."""
MISSING = "videos need an encoder: pip install 'lpv-track-env[video]'"
ENCODINGS = {
    # Plays everywhere; the index comes first, so that browsers start before they have it all.
    ".mp4": ("-vcodec", "libx264", "-preset", "veryfast", "-crf", "18", "-pix_fmt", "yuv420p",
             "-movflags", "+faststart", "-f", "mp4"),
    # A palette for every frame: a common one would have to keep all frames.
    ".gif": ("-filter_complex",
             "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=none",
             "-f", "gif"),
}  # fmt: skip
"""Arguments of ffmpeg by the file's ending."""


class Closing:
    """Context manager that opens on entry and closes on exit."""

    def open(self) -> None:
        """Prepare for frames."""

    def close(self, *, failed: bool) -> None:
        """Finish; if an exception has `failed` the drive, discard what is unfinished."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close(failed=kind is not None)


class Video(Closing):
    """Encoder of a video file, which is written whole or not at all.

    Frames go to a temporary file beside it, which replaces it once all have been encoded. After an
    exception, Ctrl-C included, a file that was there before is untouched.

    Parameters
    ----------
    file
        Ends in .mp4 or .gif; its folder is made if need be.
    fps
        Frames a second.

    Raises
    ------
    ValueError
        For another ending, or frames a second that are not in (0, 240].
    ModuleNotFoundError
        In one line that names the extra to install, without an encoder.
    """

    def __init__(self, file: Path, fps: float) -> None:
        if file.suffix.lower() not in ENCODINGS:
            raise ValueError(f"a video ends in {' or '.join(ENCODINGS)}, unlike {file.name!r}")
        if not 0.0 < fps <= 240.0:
            raise ValueError(f"a video needs a number of frames a second up to 240, not {fps:g}")
        try:
            from imageio_ffmpeg import get_ffmpeg_exe
        except ModuleNotFoundError:
            raise ModuleNotFoundError(MISSING) from None
        self.file, self.fps = file, fps
        self.count = 0
        """Frames so far."""
        self._executable = get_ffmpeg_exe()
        self._temporary = file.with_name(f".{file.name}.{secrets.token_hex(4)}.tmp")
        self._encoder: subprocess.Popen[bytes] | None = None
        self._size = (0, 0)

    def open(self) -> None:
        """Make the file's folder."""
        self.file.parent.mkdir(parents=True, exist_ok=True)

    def add(self, frame: Frame, times: int = 1) -> None:
        """Add a frame (height, width, 3), shown `times` frame periods.

        Raises
        ------
        ValueError
            If its shape differs from that of the frames before.
        OSError
            If the encoder fails, with its message.
        """
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise ValueError(f"a frame must be (height, width, 3) uint8, not {frame.shape}")
        size = (frame.shape[1], frame.shape[0])
        encoder = self._encoder or self._start(size)
        if size != self._size:
            raise ValueError(f"frames must be of one size: {self._size}, then {size}")
        pixels = np.ascontiguousarray(frame)
        assert encoder.stdin is not None
        try:
            for _ in range(times):
                encoder.stdin.write(pixels.data)
                self.count += 1
        except OSError:
            raise OSError(f"{self.file}: {self._finish()}") from None

    def close(self, *, failed: bool) -> None:
        """Finish the file, or remove the temporary one after a failure."""
        try:
            if not failed and self._encoder is not None:
                message = self._finish()
                if self._encoder.returncode != 0:
                    raise OSError(f"{self.file}: {message}")
                self._temporary.replace(self.file)
        finally:
            if self._encoder is not None and self._encoder.poll() is None:
                self._encoder.kill()
                self._encoder.communicate()
            self._temporary.unlink(missing_ok=True)

    def _start(self, size: tuple[int, int]) -> "subprocess.Popen[bytes]":
        self._size = size
        command = [
            self._executable, "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
            "-s", f"{size[0]}x{size[1]}", "-r", f"{self.fps:.6g}", "-i", "-", "-threads", "1",
            *ENCODINGS[self.file.suffix.lower()], str(self._temporary),
        ]  # fmt: skip
        # In a session of its own: Ctrl-C is for this process, which then discards the file.
        self._encoder = subprocess.Popen(  # noqa: S603
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            start_new_session=True,
        )  # fmt: skip
        return self._encoder

    def _finish(self) -> str:
        """End the encoder's input, wait for it, and return its message."""
        assert self._encoder is not None
        try:
            _, message = self._encoder.communicate()
        except (BrokenPipeError, ValueError):
            message = self._encoder.stderr.read() if self._encoder.stderr else b""
            self._encoder.wait()
        return " ".join(message.decode(errors="replace").split()) or "the encoder gave up"


class Sink(Closing, ABC):
    """Destination of the frames of a drive; a context manager."""

    live = False
    """True where the frames are watched as they come, so that no progress is shown."""

    @abstractmethod
    def copies(self, step: int) -> int:
        """Return how often the picture after a step, from 1, is shown; 0: it is not drawn."""

    @abstractmethod
    def add(self, step: int, frame: Frame, times: int) -> None:
        """Take the picture after a step, shown as often as `copies` returned."""

    def end(self, picture: Callable[[], Frame]) -> None:
        """Take the end of the drive; `picture` draws it."""

    @property
    def outcome(self) -> str:
        """Line on what was written; empty where nothing was."""
        return ""


class PngSink(Sink):
    """PNG files in a folder, one every so many steps."""

    def __init__(self, folder: Path, every: int) -> None:
        self._folder, self._every, self._count = folder, every, 0

    def open(self) -> None:
        """Make the folder."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def copies(self, step: int) -> int:
        """Return 1 every so many steps."""
        return int(step % self._every == 0)

    def add(self, step: int, frame: Frame, times: int) -> None:  # noqa: ARG002
        """Write a file, atomically."""
        surface = pygame.image.frombuffer(frame.tobytes(), (frame.shape[1], frame.shape[0]), "RGB")
        buffer = io.BytesIO()
        pygame.image.save(surface, buffer, "frame.png")
        write_atomically(self._folder / f"frame-{step:06d}.png", buffer.getvalue())
        self._count += 1

    @property
    def outcome(self) -> str:
        """Number of files, and their folder."""
        return f"{self._count} frames in {self._folder}"


class VideoSink(Sink):
    """A video; its last frame stays for a second.

    Parameters
    ----------
    file
        See `Video`.
    period
        Control period, s.
    fps
        Frames a second; None for one frame a control period, but at most `MOST_FPS`.
    speed_up
        How many times faster than the drive the video runs.

    Raises
    ------
    ValueError
        If `speed_up` is not positive, or as `Video`.
    ModuleNotFoundError
        Without an encoder.
    """

    def __init__(self, file: Path, period: float, fps: float | None, speed_up: float) -> None:
        if not 0.0 < speed_up < np.inf:
            raise ValueError(f"--speed-up must be positive, not {speed_up:g}")
        rate = min(speed_up / period, MOST_FPS) if fps is None else fps
        self._video = Video(file, rate)
        # Frames a control period, and frames due so far.
        self._share, self._due = period * rate / speed_up, 0

    def open(self) -> None:
        """Open the video."""
        self._video.open()

    def close(self, *, failed: bool) -> None:
        """Close the video."""
        self._video.close(failed=failed)

    def copies(self, step: int) -> int:
        """Return the number of frames that become due by the end of a step."""
        new = int(step * self._share + 1e-6) - self._due
        self._due += new
        return new

    def add(self, step: int, frame: Frame, times: int) -> None:  # noqa: ARG002
        """Encode the frame."""
        self._video.add(frame, times)

    def end(self, picture: Callable[[], Frame]) -> None:
        """Hold the last picture."""
        self._video.add(picture(), max(round(self._video.fps), 1))

    @property
    def outcome(self) -> str:
        """The file, its frames and its duration."""
        count, fps = self._video.count, self._video.fps
        return f"{self._video.file}: {count} frames, {count / fps:.1f} s"


class WindowSink(Sink):
    """A window in real time; closing it ends the drawing, not the drive."""

    live = True

    def __init__(self, fps: int) -> None:
        self._window = Window(fps, otherwise="use --frames DIR or --video FILE")

    def open(self) -> None:
        """Check that there is a display.

        Raises
        ------
        ValueError
            Without one.
        """
        try:
            self._window.prepare()
        except RuntimeError as error:
            raise ValueError(str(error)) from error

    def close(self, *, failed: bool) -> None:  # noqa: ARG002
        """Close the window."""
        self._window.close()

    def copies(self, step: int) -> int:  # noqa: ARG002
        """Return 1 until the window is closed."""
        return int(not self._window.dismissed)

    def add(self, step: int, frame: Frame, times: int) -> None:  # noqa: ARG002
        """Show the frame for its time."""
        size = (frame.shape[1], frame.shape[0])
        self._window.show(pygame.image.frombuffer(frame.tobytes(), size, "RGB"))
