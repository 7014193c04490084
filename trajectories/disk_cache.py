"""Machine code on disk: whatever is wrong with a cache file, the function is compiled anew.

numba's own cache raises for a damaged file, at every start, and for a full disk. Here a file is
only a shortcut: one that is damaged, foreign or unreadable counts as missing, and one that cannot
be written is left out, with one warning in a process for each folder.

A cache file is unpickled and its machine code is run, so it must be as hard to change for others as
the Python sources are. It is used only if

* it is a regular file that belongs to the user, to root, or to the owner of the function's source,
  and not everybody may write to it (unless everybody may write to the source, too), and
* its checksum matches: no other bytes are ever unpickled.
"""

import hashlib
import os
import pickle
import secrets
import stat
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from llvmlite import __version__ as llvmlite_version
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

CHECKSUM = hashlib.sha256
SIZE = CHECKSUM().digest_size
MODE = 0o644
"""Permissions of a new file: never writable by others, whatever the umask."""


class DiskCache(FunctionCache):
    """Cache of one function, in place of the one that `numba.njit(cache=True)` sets.

    Parameters
    ----------
    function
        The Python function.
    options
        Those of `numba.njit`: other options give other machine code.
    digest
        Digest of all sources that the machine code depends on.

    Raises
    ------
    RuntimeError
        If no cache folder is writable.
    """

    _cache_file: Any  # declared by numba as a file of its own

    def __init__(self, function: Callable[..., Any], options: dict[str, Any], digest: str) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._options = repr(sorted(options.items()))
        place = Path(self._cache_path) / f"{self._impl.filename_base}.nbc"
        stamp = repr((self._impl.locator.get_source_stamp(), digest))
        self._cache_file = CacheFile(place, stamp, Path(function.__code__.co_filename))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code for these types of arguments, or None if there is none."""
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception as error:  # noqa: BLE001  whatever is wrong: it is compiled anew
            warn_of(self._cache_file.place, error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep machine code on disk if possible."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except Exception as error:  # noqa: BLE001  the code is there, only not on disk
            warn_of(self._cache_file.place, error)

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return (*super()._index_key(sig, codegen), self._options)  # type: ignore[no-untyped-call]


class CacheFile:
    """File with the machine code of one function, for all types of arguments.

    It holds a checksum of the rest, a digest of all that the code depends on, and a pickled
    dictionary of pickled code by key.

    Parameters
    ----------
    place
        The file.
    stamp
        Of the sources; together with the versions of the compiler it must match the file's.
    source
        The function's source file, whose owner is trusted.
    """

    def __init__(self, place: Path, stamp: str, source: Path) -> None:
        self.place, self._source = place, source
        made_with = repr((numba.__version__, llvmlite_version, stamp))
        self._identity = CHECKSUM(made_with.encode()).digest()

    def load(self, key: Any) -> Any:
        """Return the code kept under a key, or None.

        Raises
        ------
        Exception
            Of any kind, if the file is there but cannot be used.
        """
        code = self._entries().get(key)
        return None if code is None else pickle.loads(code)  # noqa: S301  checked

    def save(self, key: Any, data: Any) -> None:
        """Add code to the file, or replace it; a file that cannot be used is replaced.

        Raises
        ------
        OSError
            If the file cannot be written; no temporary file is left.
        """
        try:
            entries = self._entries()
        except Exception:  # noqa: BLE001  `load` has warned of it
            entries = {}
        content = self._identity + pickle.dumps({**entries, key: dumps(data)})  # type: ignore[no-untyped-call]
        temporary = self.place.with_name(f"{self.place.name}.tmp.{secrets.token_hex(8)}")
        try:
            # Not `fsync`: a file that a crash of the system tears does not pass its checksum.
            opened = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, MODE)
            with os.fdopen(opened, "wb") as handle:
                handle.write(CHECKSUM(content).digest())
                handle.write(content)
            temporary.replace(self.place)
        finally:
            temporary.unlink(missing_ok=True)

    def flush(self) -> None:
        """Remove the file."""
        self.place.unlink(missing_ok=True)

    def _entries(self) -> dict[Any, bytes]:
        try:
            content = self._trusted_bytes()
        except FileNotFoundError:
            return {}
        checked = memoryview(content)[SIZE:]
        if CHECKSUM(checked).digest() != content[:SIZE]:
            raise ValueError("it is damaged")
        if checked[:SIZE] != self._identity:
            return {}  # of other sources or versions
        entries: dict[Any, bytes] = pickle.loads(checked[SIZE:])  # noqa: S301  checked
        return entries

    def _trusted_bytes(self) -> bytes:
        # Without O_NONBLOCK the open of a pipe would wait for its writer.
        opened = os.open(self.place, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(opened, "rb") as handle:
            status = os.fstat(handle.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise ValueError("it is not a regular file")
            if os.name == "posix":
                check_owner(status, self._source.stat())
            return handle.read()


def check_owner(status: os.stat_result, source: os.stat_result) -> None:
    """Raise a ValueError if others than those who may change the source may change the file."""
    if status.st_uid not in {0, os.geteuid(), source.st_uid}:
        raise ValueError(f"it belongs to another user, {status.st_uid}")
    if status.st_mode & ~source.st_mode & stat.S_IWOTH:
        raise ValueError("everybody may write to it")


def warn_of(place: Path, error: Exception) -> None:
    """Warn that a cache file cannot be used, once in a process for each folder."""
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    if place.parent not in _told:
        _told.add(place.parent)
        message = f"compiled code on disk not used: {place}: {reason}; compiling anew"
        warnings.warn(message, RuntimeWarning, stacklevel=2)


_told: set[Path] = set()


@cache
def warn_of_no_cache() -> None:
    """Warn, once in a process, that nothing can be kept on disk."""
    warnings.warn(
        "numba finds no writable cache folder: compiling anew in this process "
        "(set NUMBA_CACHE_DIR to a writable folder to avoid the wait)",
        RuntimeWarning,
        stacklevel=5,
    )
