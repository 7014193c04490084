"""Where the frames of a drive go: PNG files, a video, a window."""

import io
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import pygame
from numpy.typing import NDArray

from experiments.video import Video
from lpv_track_env.rendering.window import Window
from trajectories.fileio import write_atomically

Frame = NDArray[np.uint8]

MOST_FPS = 50.0
"""Frames a second of a video unless told otherwise; players of .gif take no more."""


class Sink(ABC):
    """Takes the frames of a drive; a context manager."""

    live = False
    """Whether somebody watches, and no progress need be told."""

    @abstractmethod
    def copies(self, step: int) -> int:
        """How many frames show the picture after a step, from 1: 0 if it need not be drawn."""

    @abstractmethod
    def add(self, step: int, frame: Frame, times: int) -> None:
        """Take the picture after a step, as often as `copies` said."""

    def end(self, picture: Callable[[], Frame]) -> None:  # noqa: B027  most take no notice
        """Take the end of the drive; `picture` draws it."""

    @property
    def outcome(self) -> str:
        """What has become of it, in words; empty if there is nothing to say."""
        return ""

    def __enter__(self) -> Self:
        return self

    def __exit__(  # noqa: B027  most have nothing to end
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it; after an exception, what is unfinished is thrown away."""


class PngSink(Sink):
    """PNG files in a folder, one every so many steps."""

    def __init__(self, folder: Path, every: int) -> None:
        self._folder, self._every, self._count = folder, every, 0

    def __enter__(self) -> Self:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self

    def copies(self, step: int) -> int:
        """One every so many steps."""
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
        """How many, and where."""
        return f"{self._count} frames in {self._folder}"


class VideoSink(Sink):
    """A video; its last frame stays for a second.

    Parameters
    ----------
    file
        See `experiments.video.Video`.
    period
        Control period, s.
    fps
        Frames a second; None for one frame a control period, but at most `MOST_FPS`.
    speed_up
        How many times faster than the drive.

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
        # Frames a control period, and how many have been asked for.
        self._share, self._asked = period * rate / speed_up, 0

    def __enter__(self) -> Self:
        self._video.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._video.__exit__(kind, error, trace)

    def copies(self, step: int) -> int:
        """As many frames as their rate asks for by the end of a step."""
        due = int(step * self._share + 1e-6) - self._asked
        self._asked += due
        return due

    def add(self, step: int, frame: Frame, times: int) -> None:  # noqa: ARG002
        """Encode it."""
        self._video.add(frame, times)

    def end(self, picture: Callable[[], Frame]) -> None:
        """Hold the last picture."""
        self._video.add(picture(), max(round(self._video.fps), 1))

    @property
    def outcome(self) -> str:
        """What was written."""
        count, fps = self._video.count, self._video.fps
        return f"{self._video.file}: {count} frames, {count / fps:.1f} s"


class WindowSink(Sink):
    """A window in real time; closing it ends the drawing, not the drive."""

    live = True

    def __init__(self, fps: int) -> None:
        self._window = Window(fps, otherwise="use --frames DIR or --video FILE")

    def __enter__(self) -> Self:
        try:
            self._window.prepare()
        except RuntimeError as error:
            raise ValueError(str(error)) from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._window.close()

    def copies(self, step: int) -> int:  # noqa: ARG002
        """All, until it is closed."""
        return int(not self._window.dismissed)

    def add(self, step: int, frame: Frame, times: int) -> None:  # noqa: ARG002
        """Show it for its time."""
        size = (frame.shape[1], frame.shape[0])
        self._window.show(pygame.image.frombuffer(frame.tobytes(), size, "RGB"))
