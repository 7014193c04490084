"""Videos of frames, .mp4 or .gif, encoded as they come: none is kept in memory."""

import secrets
import subprocess
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
from numpy.typing import NDArray

MISSING = "videos need an encoder: pip install 'lpv-track-env[video]'"
ENCODINGS = {
    # Plays everywhere; the index in front, so that a browser begins before it has all.
    ".mp4": ("-vcodec", "libx264", "-preset", "veryfast", "-crf", "18", "-pix_fmt", "yuv420p",
             "-movflags", "+faststart", "-f", "mp4"),
    # A palette for every frame: one for all would have to keep all frames.
    ".gif": ("-filter_complex",
             "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=none",
             "-f", "gif"),
}  # fmt: skip
"""Arguments of ffmpeg by the file's ending."""


class Video:
    """A video file; a context manager that leaves a whole file or none.

    Frames go to a temporary file beside it, which takes its place once all have been encoded; after
    an exception, Ctrl-C included, there is none, and what was there before is untouched.

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

    def add(self, frame: NDArray[np.uint8], times: int = 1) -> None:
        """Add a frame (height, width, 3), as often as it is to be seen.

        Raises
        ------
        ValueError
            If it has another shape than those before.
        OSError
            If the encoder gives up: it says why.
        """
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise ValueError(f"a frame must be (height, width, 3) uint8, not {frame.shape}")
        size = (frame.shape[1], frame.shape[0])
        encoder = self._encoder or self._start(size)
        if size != self._size:
            raise ValueError(f"frames must be of one size: {self._size}, then {size}")
        pixels = np.ascontiguousarray(frame)
        try:
            for _ in range(times):
                _input(encoder).write(pixels.data)
                self.count += 1
        except OSError:
            raise OSError(f"{self.file}: {self._complaint()}") from None

    def __enter__(self) -> "Video":
        self.file.parent.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None and self._encoder is not None:
                complaint = self._complaint()
                if self._encoder.returncode != 0:
                    raise OSError(f"{self.file}: {complaint}")
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
        # In a session of its own: Ctrl-C is for us, who then throw its file away.
        self._encoder = subprocess.Popen(  # noqa: S603
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            start_new_session=True,
        )  # fmt: skip
        return self._encoder

    def _complaint(self) -> str:
        """End the encoder's input, wait for it, and return what it said."""
        assert self._encoder is not None
        try:
            _, said = self._encoder.communicate()
        except (BrokenPipeError, ValueError):
            said = self._encoder.stderr.read() if self._encoder.stderr else b""
            self._encoder.wait()
        return " ".join(said.decode(errors="replace").split()) or "the encoder gave up"


def _input(encoder: "subprocess.Popen[bytes]") -> IO[bytes]:
    assert encoder.stdin is not None
    return encoder.stdin
