"""Folder of results: a JSON line per case, traces beside it, a manifest.

Layout: `manifest.json` (revision, versions, settings, hardware), `cases.jsonl`, `traces/ID.npz`.
A run that was killed can be resumed: a torn last line is dropped, the last of several lines with
one id counts, and files are replaced atomically.
"""

import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.run.provenance import command_line, provenance
from trajectories.fileio import write_atomically

Array = NDArray[np.float64]


def write_arrays(file: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by name as a compressed .npz, atomically."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(file, buffer.getvalue())


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
            write_arrays(self.folder / "traces" / f"{result['id']}.npz", result["trace"])
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

    def cases(self) -> list[dict[str, Any]]:
        """Return the results in the order of their first lines, without traces.

        The last line of an id counts.

        Raises
        ------
        ValueError
            For a line other than the last that is not JSON.
        """
        if not self.cases_file.exists():
            return []
        found: dict[str, dict[str, Any]] = {}
        content = self.cases_file.read_bytes()
        complete, _, _ = content.rpartition(b"\n")
        for number, line in enumerate(complete.split(b"\n"), start=1):
            if not line.strip():
                continue
            try:
                result = json.loads(line)
                found[result["id"]] = result
            except (ValueError, KeyError, TypeError) as error:
                message = f"{self.cases_file}, line {number}: not a case ({error})"
                raise ValueError(message) from error
        return list(found.values())

    def trace(self, case_id: str) -> dict[str, Array] | None:
        """Return the arrays of a case's trace by name, or None if it is missing or damaged."""
        file = self.folder / "traces" / f"{case_id}.npz"
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
            return None

    def write_manifest(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Write and return the manifest, which holds what is needed to reproduce the results."""
        manifest = {
            "format": "lpv-track-results/1",
            "written": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": command_line(),
            "settings": dict(settings),
            **provenance(),
        }
        content = json.dumps(manifest, indent=2, sort_keys=True).encode()
        write_atomically(self.folder / "manifest.json", content)
        return manifest

    def manifest(self) -> dict[str, Any]:
        """Return the manifest, or {} without one."""
        try:
            content: dict[str, Any] = json.loads((self.folder / "manifest.json").read_text())
        except (OSError, ValueError):
            return {}
        return content
