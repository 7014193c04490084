"""Folder of results: a JSON line per case, traces beside it, a manifest.

Layout: `manifest.json` (revision, versions, settings, hardware), `cases.jsonl`, `traces/ID.npz`,
and `manifest-KEY.json` of earlier runs with other versions. A run that was killed can be resumed: a
torn last line is dropped, the last of several lines with one id counts, and files are replaced
atomically. Who writes holds the folder's lock (`experiments.run.folder_lock`). Folders of a hundred
thousand cases are usual: `stream` and `ids` read them in little memory, `cases` with some 2 kB a
case.
"""

import io
import json
import os
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from experiments.run.compact import Packed, Sharing
from experiments.run.folder_lock import TRACES
from experiments.run.provenance import command_line, manifest_key, provenance
from experiments.run.result_schema import LONGEST_LINE, Case, read_case
from trajectories.arguments import shortened
from trajectories.fileio import checked, opened, read_bytes, read_json, write_atomically

Array = NDArray[np.float64]

MOST_UNREADABLE = 10_000
"""Most lines that cannot be read and are left out; a file with more is no file of results."""
TOGETHER = 1.0
"""Time within which results that a sweep stores reach the disk together, s."""
BLOCK = 2**16
"""Bytes that are read at once."""
LARGEST_TRACE = 2**28
"""Largest trace that is read, bytes on disk and in memory."""
LARGEST_NUMBER = 1e12
"""Bound on the numbers of a trace that is read."""


def write_arrays(file: Path, arrays: Mapping[str, Any], *, durable: bool = True) -> None:
    """Write arrays by name as a compressed .npz, atomically; see `write_atomically`."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(file, buffer.getvalue(), durable=durable)


def read_arrays(file: Path) -> dict[str, Any]:
    """Read arrays by name from an .npz of at most `LARGEST_TRACE` bytes, packed and unpacked.

    Raises
    ------
    ValueError
        In one line that begins with the file's name, if it cannot be read.
    """
    content = io.BytesIO(read_bytes(file, LARGEST_TRACE))
    try:
        with zipfile.ZipFile(content) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > LARGEST_TRACE:
            raise ValueError(f"{size} bytes are too many")
        with np.load(content, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except Exception as error:  # noqa: BLE001  anything can be wrong with a damaged archive
        raise ValueError(f"{file}: holds no arrays ({shortened(error)})") from None


class ResultStore:
    """Results of one benchmark in a folder, which is created if it does not exist.

    As a context manager it keeps `cases.jsonl` open for many calls of `append`, whose results reach
    the disk together within `TOGETHER` seconds.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cases_file = folder / "cases.jsonl"
        folder.mkdir(parents=True, exist_ok=True)
        self._lines: _Lines | None = None

    def __enter__(self) -> "ResultStore":
        self._lines = _Lines(self.cases_file)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        lines, self._lines = self._lines, None
        if lines is not None:
            lines.close()

    def append(self, result: Mapping[str, Any]) -> None:
        """Store one result: its trace first, then its line.

        When this returns, the system has both, so that a kill loses nothing. Both are on disk, too,
        unless the store is used as a context manager: then a power loss may cost the results of the
        last second.
        """
        if self._lines is None:
            with self:
                self.append(result)
            return
        entries = {key: value for key, value in result.items() if key != "trace"}
        line = json.dumps(entries, sort_keys=True, allow_nan=False).encode() + b"\n"
        trace = None
        if result.get("trace"):
            trace = self.folder / TRACES / f"{result['id']}.npz"
            write_arrays(trace, result["trace"], durable=False)
        self._lines.append(line, trace)

    def stream(
        self, skipped: list[str] | None = None, read: Callable[[bytes, str], Case] = read_case
    ) -> Iterator[Case]:
        """Yield the result of each line, in bounded memory; of lines with one id the last counts.

        Parameters
        ----------
        skipped
            Receives a message for each line that cannot be read; without it they are refused.
        read
            Reads a line, such as `experiments.run.result_schema.read_driven`.

        Raises
        ------
        ValueError
            In one line, for a line other than the last that cannot be read, or for more than
            `MOST_UNREADABLE` of them.
        """
        if not self.cases_file.exists():
            return
        with opened(self.cases_file) as handle:
            number = 0
            while line := handle.readline(LONGEST_LINE + 2):
                number += 1
                rest = line
                while rest and not rest.endswith(b"\n"):
                    rest = handle.readline(BLOCK)
                if not rest:  # a writer was killed in it
                    return
                if not line.strip():
                    continue
                try:
                    result = read(line.removesuffix(b"\n"), f"{self.cases_file}, line {number}")
                except ValueError as error:
                    if skipped is None:
                        raise
                    if len(skipped) >= MOST_UNREADABLE:
                        raise ValueError(
                            f"{self.cases_file}: more than {MOST_UNREADABLE} lines cannot be read"
                        ) from error
                    skipped.append(str(error))
                else:
                    yield result

    def ids(self, skipped: list[str] | None = None) -> dict[str, str]:
        """Return the status of every result by its id; parameters and errors as `stream`."""
        return {result["id"]: result["status"] for result in self.stream(skipped)}

    def cases(
        self, skipped: list[str] | None = None, read: Callable[[bytes, str], Case] = read_case
    ) -> list[Packed]:
        """Return the results in the order of their first lines, without traces.

        The last line of an id counts. Results are read-only and share what they have in common
        (`experiments.run.compact`): `dict(result)` copies the outer mapping alone,
        `result_schema.plain` all of it. Parameters and errors are those of `stream`.
        """
        sharing = Sharing()
        every = self.stream(skipped, read)
        return list({result["id"]: sharing.compact(result) for result in every}.values())

    def trace(self, case_id: str) -> dict[str, Array] | None:
        """Return the arrays of a case's trace by name, or None if it is missing or damaged.

        Arrays hold finite numbers.
        """
        try:
            trace = read_arrays(self.folder / TRACES / f"{case_id}.npz")
        except ValueError:
            return None
        if not all(array.dtype.kind in "fiu" and _finite(array) for array in trace.values()):
            return None
        return {name: array.astype(float, copy=False) for name, array in trace.items()}

    def write_manifest(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Write and return the manifest, which holds what is needed to reproduce the results.

        That of an earlier run with other versions is kept as `manifest-KEY.json`.
        """
        manifest = {
            "format": "lpv-track-results/1",
            "key": manifest_key(),
            "written": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": command_line(),
            "settings": dict(settings),
            **provenance(),
        }
        before = self.manifest()
        if before and (key := str(before.get("key", "before"))) != manifest["key"] and is_key(key):
            write_json(self.folder / f"manifest-{key}.json", before)
        write_json(self.folder / "manifest.json", manifest)
        return manifest

    def add_manifest(self, machine: Mapping[str, Any]) -> None:
        """Write `manifest-KEY.json` of another machine that takes part in the run.

        `machine` has its `key` and provenance; all else is that of the run's manifest.
        """
        if is_key(key := str(machine["key"])):
            write_json(self.folder / f"manifest-{key}.json", {**self.manifest(), **machine})

    def manifest(self) -> dict[str, Any]:
        """Return the manifest of the last run, or {} without a readable one."""
        return _manifest(self.folder / "manifest.json")

    def manifests(self) -> dict[str, dict[str, Any]]:
        """Return the manifests of the last run and of earlier ones by their keys."""
        files = [self.folder / "manifest.json", *sorted(self.folder.glob("manifest-*.json"))]
        found: dict[str, dict[str, Any]] = {}
        for manifest in filter(None, map(_manifest, files)):
            if is_key(key := str(manifest.get("key", "before"))):
                found.setdefault(key, manifest)
        return found

    def manifest_of(self, key: str) -> dict[str, Any]:
        """Return the manifest with a key, of the last run or an earlier one; {} if there is none.

        Results of old versions name no manifest; theirs has the key "before".
        """
        last = self.manifest()
        if last and last.get("key", "before") == key:
            return last
        return _manifest(self.folder / f"manifest-{key}.json") if is_key(key) else {}


class _Lines:
    """`cases.jsonl`, open to append whole lines; what is appended is on disk a second later.

    An incomplete last line, left by a writer that was killed, is cut off.
    """

    def __init__(self, file: Path) -> None:
        if file.is_symlink():
            raise ValueError(f"{file} is a link: results are written into {file.parent} only")
        # Unbuffered: the system has what is written, whatever becomes of this process.
        self._handle: BinaryIO = file.open("a+b", buffering=0)
        self._end = -1
        self._lock, self._disk = threading.Lock(), threading.Lock()
        self._unsynced: list[Path] = []
        self._timer: threading.Timer | None = None
        self._planned = False
        self._failed: OSError | None = None

    def append(self, line: bytes, trace: Path | None) -> None:
        """Write a line whole or not at all; its trace reaches the disk before it."""
        with self._lock:
            if self._failed is not None:
                raise self._failed
            start = self._handle.seek(0, os.SEEK_END)
            if start != self._end:
                start = self._without_torn_line(start)
            try:
                rest = memoryview(line)
                while rest:
                    rest = rest[self._handle.write(rest) :]
            except BaseException:
                self._handle.truncate(start)
                raise
            self._end = start + len(line)
            if trace is not None:
                self._unsynced.append(trace)
            if not self._planned:
                self._planned = True
                self._timer = threading.Timer(TOGETHER, self._sync)
                self._timer.daemon = True
                self._timer.start()

    def _without_torn_line(self, size: int) -> int:
        """Cut the file behind its last newline and return its size."""
        end = size
        while end:
            begin = max(end - BLOCK, 0)
            self._handle.seek(begin)
            found = self._handle.read(end - begin).rfind(b"\n")
            if found >= 0:
                end = begin + found + 1
                break
            end = begin
        if end < size:
            self._handle.truncate(end)
        return end

    def _sync(self) -> None:
        """Bring to the disk what was appended; the next `append` raises an error of this."""
        with self._disk:
            with self._lock:
                traces, self._unsynced, self._planned = self._unsynced, [], False
            try:
                for trace in traces:
                    with trace.open("rb+") as handle:
                        os.fsync(handle.fileno())
                os.fsync(self._handle.fileno())
            except OSError as error:
                self._failed = error

    def close(self) -> None:
        """Bring all to the disk."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()
        with self._handle:
            self._sync()
        if self._failed is not None:
            raise self._failed


def _manifest(file: Path) -> dict[str, Any]:
    try:
        return checked(read_json(file), dict[str, Any], file)
    except ValueError:
        return {}


def write_json(file: Path, content: Mapping[str, Any]) -> None:
    """Write JSON for readers, atomically."""
    write_atomically(file, json.dumps(content, indent=2, sort_keys=True).encode())


def is_key(text: str) -> bool:
    """Return whether a text can be the key in a manifest's name."""
    return text == "before" or (len(text) == 8 and set(text) <= set("0123456789abcdef"))


def _finite(array: Array) -> bool:
    return bool((np.abs(array) < LARGEST_NUMBER).all())
