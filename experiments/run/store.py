"""Folder of results: a JSON line per case, traces beside it, a manifest.

Layout: `manifest.json` (revision, versions, settings, hardware), `cases.jsonl`, `traces/ID.npz`,
and `manifest-KEY.json` of earlier runs with other versions. A run that was killed can be resumed: a
torn last line is dropped, the last of several lines with one id counts, and files are replaced
atomically. Who writes holds the folder's lock (`experiments.run.folder_lock`).
"""

import io
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.run.folder_lock import TRACES
from experiments.run.provenance import command_line, manifest_key, provenance
from experiments.run.result_schema import Case, read_case
from trajectories.arguments import shortened
from trajectories.fileio import checked, read_bytes, read_json, write_atomically

Array = NDArray[np.float64]

MOST_BYTES = 2**30
"""Largest `cases.jsonl` that is read."""
LARGEST_TRACE = 2**28
"""Largest trace that is read, bytes on disk and in memory."""
LARGEST_NUMBER = 1e12
"""Bound on the numbers of a trace that is read."""


def write_arrays(file: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by name as a compressed .npz, atomically."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(file, buffer.getvalue())


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

    Raises
    ------
    OSError
        If the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cases_file = folder / "cases.jsonl"
        folder.mkdir(parents=True, exist_ok=True)

    def append(self, result: Mapping[str, Any]) -> None:
        """Store one result: its trace first, then its line, both on disk when this returns."""
        line = {key: value for key, value in result.items() if key != "trace"}
        if result.get("trace"):
            write_arrays(self.folder / TRACES / f"{result['id']}.npz", result["trace"])
        self._drop_torn_line()
        with self.cases_file.open("ab") as handle:
            handle.write(json.dumps(line, sort_keys=True, allow_nan=False).encode() + b"\n")
            handle.flush()
            os.fsync(handle.fileno())

    def _drop_torn_line(self) -> None:
        """Remove an incomplete last line, left by a writer that was killed."""
        if not self.cases_file.exists():
            return
        with self.cases_file.open("rb+") as handle:
            size = handle.seek(0, os.SEEK_END)
            if size == 0:
                return
            handle.seek(size - 1)
            if handle.read(1) == b"\n":
                return
            handle.seek(0)
            handle.truncate(handle.read().rfind(b"\n") + 1)

    def cases(
        self, skipped: list[str] | None = None, read: Callable[[bytes, str], Case] = read_case
    ) -> list[Case]:
        """Return the results in the order of their first lines, without traces.

        The last line of an id counts.

        Parameters
        ----------
        skipped
            Receives a message for each line that cannot be read; without it they are refused.
        read
            Reads a line, such as `experiments.run.result_schema.read_driven`.

        Raises
        ------
        ValueError
            In one line, for a line other than the last that cannot be read, or a file that is too
            large.
        """
        if not self.cases_file.exists():
            return []
        found: dict[str, Case] = {}
        content = read_bytes(self.cases_file, MOST_BYTES)
        complete, _, _ = content.rpartition(b"\n")
        for number, line in enumerate(complete.split(b"\n"), start=1):
            if not line.strip():
                continue
            try:
                result = read(line, f"{self.cases_file}, line {number}")
            except ValueError as error:
                if skipped is None:
                    raise
                skipped.append(str(error))
            else:
                found[result["id"]] = result
        return list(found.values())

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

    def manifest_of(self, key: str) -> dict[str, Any]:
        """Return the manifest with a key, that of the last run or an earlier one; {} without it.

        Results of old versions name none; theirs has the key "before".
        """
        last = self.manifest()
        if last and last.get("key", "before") == key:
            return last
        return _manifest(self.folder / f"manifest-{key}.json") if is_key(key) else {}


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
