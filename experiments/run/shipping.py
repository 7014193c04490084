"""Files and folders that travel by content between the computers of a sweep.

A file of a relative name is laid at the same name below a folder of the worker's own, in which the
run takes place. A file of an absolute name must lie there already, with the same content.

Workers load this module: it loads numerical libraries only where the sender needs them.
"""

import hashlib
import os
import time
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path, PurePath
from typing import NamedTuple

from experiments.run.folder_lock import LEFTOVER, LOCK

PACKAGES = ("trajectories", "lpv_track_env", "agents", "experiments")
PROJECT = Path(__file__).parents[2]
"""Folder of the project's packages."""
SUFFIXES = {".py", ".json", ".safetensors"}
"""Suffixes of the files that the project computes with."""
TRIES = 20
"""Most attempts to read a folder while nobody writes in it."""


@cache
def sources_digest() -> str:
    """Return the digest of this project's sources and data, on which a training depends.

    `provenance.project_digest`, which goes into ids, is that of the sources which cases depend on.
    """
    digest = hashlib.sha256()
    for file in sorted(one for name in PACKAGES for one in (PROJECT / name).rglob("*")):
        if file.suffix in SUFFIXES:
            name = file.relative_to(PROJECT).as_posix()
            digest.update(name.encode() + b"\0" + _digest(file.read_bytes()).encode())
    return digest.hexdigest()[:16]


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def with_weights(files: Iterable[Path]) -> list[Path]:
    """Return files, each policy's .json followed by the .safetensors that it refers to."""
    from agents.learned.files import BESIDE, MOST_SPEC
    from trajectories.fileio import read_json

    found: dict[Path, None] = {}
    for file in files:
        found[file] = None
        if file.suffix != ".json":
            continue
        try:
            name = read_json(file, MOST_SPEC)["weights"]["file"]
        except (ValueError, TypeError, LookupError):  # no policy: its reader will say so
            continue
        if isinstance(name, str) and BESIDE.fullmatch(name) and file.with_name(name).is_file():
            found[file.with_name(name)] = None
    return list(found)


def contents(files: Iterable[Path]) -> dict[str, bytes]:
    """Return the content of files by name, without those of the project: every worker has them."""
    own = [PROJECT / name for name in PACKAGES]
    return {
        str(file): file.read_bytes()
        for file in files
        if not any(file.resolve().is_relative_to(folder) for folder in own)
    }


class Place:
    """A folder of a worker's own that stands for the working directory of a run's sender.

    `folder` lies some levels deep, so that names such as `../paths/mine.csv` stay within `root`.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.folder = self.root.joinpath(*["level"] * 8)
        self.folder.mkdir(parents=True)

    def file(self, name: str) -> Path | None:
        """Return where a file of a relative name lies; None for one that cannot be laid here."""
        place = Path(os.path.normpath(self.folder / name))
        inside = not Path(name).is_absolute() and place.is_relative_to(self.root)
        return place if inside else None

    def lay(self, name: str, content: bytes) -> None:
        """Write a file of a name that `file` accepts."""
        place = self.file(name)
        assert place is not None
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)

    def has(self, name: str, digest: str) -> bool:
        """Return whether a file of this content lies where a run looks for its name."""
        file = self.file(name) or Path(name)
        return file.is_absolute() and file.is_file() and _digest(file.read_bytes()) == digest


# Folders ------------------------------------------------------------------------------------------


class Changes(NamedTuple):
    """Content of a folder, as far as it differs from what the receiver knows.

    Parameters
    ----------
    files
        Contents of new and changed files by relative name, in the order in which they were written.
    names
        Names of all files.
    """

    files: Mapping[str, bytes]
    names: frozenset[str]


def digests(files: Mapping[str, bytes]) -> dict[str, str]:
    """Return the digests of contents by name."""
    return {name: _digest(content) for name, content in files.items()}


def changes(folder: Path, known: Mapping[str, str]) -> Changes:
    """Read what has changed in a folder against files of known digests.

    The folder is read while nobody writes in it: it is read again if a file has changed meanwhile,
    and if that goes on, nothing counts as changed. Locks and temporary files stay behind.
    """
    for _ in range(TRIES):
        before = _listing(folder)
        try:
            files = {name: (folder / name).read_bytes() for name in before}
        except FileNotFoundError:
            continue
        if _listing(folder) == before:
            own = digests(files)
            new = {name: files[name] for name in files if known.get(name) != own[name]}
            return Changes(new, frozenset(files))
        time.sleep(0.05)
    return Changes({}, frozenset(known))


def _listing(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Return inode, size and time of the files in a folder, those written first in front."""
    found = {}
    for file in folder.rglob("*"):
        if file.name == LOCK or LEFTOVER.fullmatch(file.name):
            continue
        try:
            state = file.stat()
        except FileNotFoundError:
            continue
        if file.is_file():
            name = file.relative_to(folder).as_posix()
            found[name] = (state.st_mtime_ns, state.st_ino, state.st_size)
    return dict(sorted(found.items(), key=lambda one: one[1]))


def apply(folder: Path, changed: Changes, known: Mapping[str, str]) -> dict[str, str]:
    """Write changes into a folder, in the order in which they were made; return the new digests.

    A process that is killed meanwhile leaves a state that the run itself could have left. Known
    files that are gone are removed.

    Raises
    ------
    ValueError
        If a name leads out of the folder.
    """
    from trajectories.fileio import write_atomically

    for name in changed.files:
        if PurePath(name).is_absolute() or ".." in PurePath(name).parts:
            raise ValueError(f"{name!r} is not the name of a file within {folder}")
        write_atomically(folder / name, changed.files[name])
    for name in set(known) - changed.names:
        (folder / name).unlink(missing_ok=True)
    kept = {name: digest for name, digest in known.items() if name in changed.names}
    return {**kept, **digests(changed.files)}
