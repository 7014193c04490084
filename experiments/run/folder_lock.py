"""One writer for a folder of results, of a training, a tuning or a study."""

import contextlib
import os
import re
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has no such locks: two writers in one folder are not refused there
    fcntl = None  # type: ignore[assignment]

LOCK, TRACES = ".lock", "traces"
UNLOCKED = ("report.html", "training.png")
"""Files that are also written without the lock, so that a report can be made during a sweep."""
PLACES = (".", TRACES, "judged/*")
"""Folders within a folder that only the holder of its lock writes in."""
LEFTOVER = re.compile(r"\..+\.[0-9a-f]{8}\.tmp")
"""Names of the temporary files of `trajectories.fileio.write_atomically`."""
ABANDONED = 60.0
"""Age from which a temporary file of `UNLOCKED` is a leftover, s; writing one takes a second."""


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make a folder, lock it for as long as this process lives, and remove leftovers in it.

    Leftovers are the temporary files of writers that were killed. The lock belongs to the process:
    it is gone when the process ends, however it ends. Between computers that share a folder by NFS
    it holds where the server supports locks; where it does not, and on Windows, two writers are not
    refused.

    Raises
    ------
    ValueError
        If another process holds the lock.
    OSError
        If the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # A link named .lock is not followed, and whatever the file holds stays.
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    descriptor = os.open(folder / LOCK, flags, 0o666)
    try:
        if fcntl is not None:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(
                    f"another process writes in {folder}: wait for it, or give another --out"
                ) from None
            except OSError as error:
                warnings.warn(
                    f"{folder} cannot be locked ({error.strerror}): let no other process write in "
                    "it",
                    stacklevel=3,
                )
        remove_leftovers(folder)
        yield
    finally:
        os.close(descriptor)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of killed writers from a folder and its `PLACES`.

    Links to folders are not followed: a foreign folder could lead anywhere.
    """
    for file in [file for place in PLACES for file in folder.glob(f"{place}/.*.tmp")]:
        inside = file.parent.resolve().is_relative_to(folder.resolve())
        if not (inside and file.is_file() and LEFTOVER.fullmatch(file.name)):
            continue
        shared = file.name.startswith(tuple(f".{name}." for name in UNLOCKED))
        with contextlib.suppress(FileNotFoundError):
            if not shared or time.time() - file.stat().st_mtime > ABANDONED:
                file.unlink()
