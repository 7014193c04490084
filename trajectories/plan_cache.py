"""Arrays on disk by the content that they are computed from: speed profiles and smoothed points.

An entry's name is a digest of all that its numbers depend on, so it never becomes wrong, only
unused. Entries are raw numbers with a checksum; nothing in them is executed or trusted. An entry
that is damaged or cannot be read counts as missing; what cannot be written is not kept.

The folder is `LPV_TRACK_CACHE` if that is set ("off" for none), otherwise `lpv-track` in the user's
folder for caches. Other files in it are left alone.
"""

import contextlib
import hashlib
import os
import platform
import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from trajectories.fileio import read_bytes, write_atomically

Array = NDArray[np.float64]

VARIABLE = "LPV_TRACK_CACHE"
"""Environment variable with the folder."""
MOST_BYTES = 256 * 2**20
"""Size that the entries have at most, bytes; the oldest are removed."""
KEPT = 0.75
"""Share of `MOST_BYTES` that is left when entries are removed."""
SEARCHED = "0"
"""First digit of an entry's name after whose writing the oldest are removed: once in 16 entries."""
CHECKSUM = hashlib.sha256
SIZE = CHECKSUM().digest_size
_ENTRY = re.compile(r"[0-9a-f]{64}\.f64|\.[0-9a-f]{64}\.f64\.[0-9a-f]{8}\.tmp")
"""Names of entries, and of temporary files whose process died."""


def computed(
    sources: Sequence[str], content: Iterable[bytes], compute: Callable[[], Array]
) -> Array:
    """Return an array (n,) from the disk, or compute it and keep it there.

    Parameters
    ----------
    sources
        Python files whose code computes the array.
    content
        All that the array depends on besides.
    compute
        Function that computes the array.
    """
    folder = place()
    try:
        made_with = _made_with(tuple(sources))
    except OSError:  # sources that are not files, as in an archive
        folder, made_with = None, b""
    if folder is None:
        return compute()
    key = CHECKSUM(made_with)
    for part in content:
        key.update(len(part).to_bytes(8, "little"))
        key.update(part)
    entry = folder / f"{key.hexdigest()}.f64"
    with contextlib.suppress(ValueError):
        return _read(entry)
    array = compute()
    with contextlib.suppress(OSError):
        _write(entry, array)
    return array


def place() -> Path | None:
    """Return the folder of the entries, which need not exist, or None if there is none."""
    given = os.environ.get(VARIABLE, "")
    if given.lower() == "off":
        return None
    if given:
        return Path(given)
    windows = os.environ.get("LOCALAPPDATA") if os.name == "nt" else None
    try:
        above = windows or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # a user without a home
        return None
    return Path(above) / "lpv-track"


@cache
def _made_with(sources: tuple[str, ...]) -> bytes:
    """Return a digest of source files and of what else may change the last bits of a result."""
    digest = CHECKSUM(repr((np.__version__, scipy.__version__, platform.machine())).encode())
    for source in sources:
        digest.update(CHECKSUM(Path(source).read_bytes()).digest())
    return digest.digest()


def _read(entry: Path) -> Array:
    """Read an entry; raise a ValueError if it is missing or damaged."""
    content = read_bytes(entry)
    if CHECKSUM(content[SIZE:]).digest() != content[:SIZE]:
        raise ValueError(f"{entry.name} is damaged")
    # An entry in use is among the last that are removed.
    with contextlib.suppress(OSError):
        os.utime(entry)
    return np.frombuffer(content, "<f8", offset=SIZE).astype(np.float64)


def _write(entry: Path, array: Array) -> None:
    content = np.ascontiguousarray(array, "<f8").tobytes()
    # A file that a crash of the system tears does not pass its checksum.
    write_atomically(entry, CHECKSUM(content).digest() + content, durable=False)
    if entry.name.startswith(SEARCHED):
        _remove_oldest(entry.parent)


def _remove_oldest(folder: Path) -> None:
    """Remove entries, the oldest first, if all together are too large."""
    entries = []
    for file in os.scandir(folder):
        if _ENTRY.fullmatch(file.name):
            with contextlib.suppress(OSError):  # another process removed it
                status = file.stat(follow_symlinks=False)
                entries.append((status.st_mtime, status.st_size, file.path))
    size = sum(bytes_ for _, bytes_, _ in entries)
    if size <= MOST_BYTES:
        return
    for _, bytes_, path in sorted(entries):
        with contextlib.suppress(OSError):
            Path(path).unlink()
        size -= bytes_
        if size <= KEPT * MOST_BYTES:
            return
