"""Write and remove the two files of a policy, so that a crash at any moment leaves a whole policy.

The weights have their digest in their name, NAME.DIGEST.safetensors, so new ones never replace
those that the present NAME.json refers to. First the new weights are written, then NAME.json is
replaced, and at last the weights of earlier policies of this NAME are removed, with whatever killed
writers have left; so copy a policy with both of its files into another folder, not within one.
Writers of one folder wait for each other; where it cannot be locked, nothing is removed.
"""

import hashlib
import json
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from safetensors.numpy import save

from agents.learned.files import (
    BESIDE,
    MOST_SPEC,
    MOST_WEIGHTS,
    Kind,
    Spec,
    Tensors,
    digest_of,
)
from trajectories.fileio import write_atomically

try:
    import fcntl
except ModuleNotFoundError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

DIGITS = 16
"""Hexadecimal digits of the weights' SHA-256 in their file's name."""
PATIENCE = 10.0
"""Longest wait for another writer, s; a writer takes milliseconds."""


def write_files(
    kind: Kind, file: str | Path, spec: Spec, training: Mapping[str, Any], tensors: Tensors
) -> None:
    """Write NAME.DIGEST.safetensors, then the NAME.json that refers to it, each atomically.

    Parameters
    ----------
    kind
        Kind of policy.
    file
        NAME.json.
    spec
        All of the spec but format, weights, training and digest; plain JSON.
    training
        Origin of the policy, plain JSON.
    tensors
        Content of the weights file.

    Raises
    ------
    ValueError
        If the name does not end in .json, or a file would be too large to be read again.
    OSError
        If a file cannot be written; an earlier policy of this name then stays.
    """
    file = Path(file)
    if file.suffix != ".json":
        raise ValueError(f"{file}: a {kind.noun} is written to NAME.json, give it such a name")
    weights = save(tensors)
    sha256 = hashlib.sha256(weights).hexdigest()
    beside = file.with_name(f"{file.stem}.{sha256[:DIGITS]}.safetensors")
    if not BESIDE.fullmatch(beside.name):
        raise ValueError(
            f"{file.name!r} is no name for a {kind.noun}: leave out \\, : and the like"
        )
    whole: Spec = {
        "format": kind.format,
        **spec,
        "weights": {"file": beside.name, "sha256": sha256, "bytes": len(weights)},
        "training": training,
    }
    text = json.dumps({**whole, "digest": digest_of(whole)}, indent=2, allow_nan=False) + "\n"
    for content, most in ((weights, MOST_WEIGHTS), (text.encode(), MOST_SPEC)):
        if len(content) > most:
            raise ValueError(
                f"{file}: {len(content)} bytes, at most {most} are allowed: make the {kind.noun} "
                "smaller"
            )
    file.parent.mkdir(parents=True, exist_ok=True)
    with _locked(file.parent) as locked:
        if not beside.exists() or beside.read_bytes() != weights:
            write_atomically(beside, weights)
        write_atomically(file, text.encode())
        if locked:
            _remove_others(file, beside.name)


def remove_files(file: Path) -> None:
    """Remove NAME.json, then its weights, if they are there."""
    with _locked(file.parent):
        file.unlink(missing_ok=True)
        _remove_others(file, None)


def _remove_others(file: Path, kept: str | None) -> None:
    """Remove weights of NAME.json but those kept, and temporary files of it and its weights."""
    stem = re.escape(file.stem)
    # Before version 2 of the project the weights were NAME.safetensors.
    weights = rf"{stem}\.(?:[0-9a-f]{{{DIGITS}}}\.)?safetensors"
    ours = re.compile(rf"{weights}|\.(?:{weights}|{stem}\.json)\.[0-9a-f]+\.tmp")
    for other in sorted(file.parent.iterdir()):
        if other.name != kept and ours.fullmatch(other.name):
            with suppress(OSError):  # in use, on Windows: the next writer removes it
                other.unlink()


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a folder against other writers of policies; yields False where that is not possible.

    The lock is on the folder itself and ends with the process at the latest.
    """
    with ExitStack() as stack:
        locked = False
        if fcntl is not None:
            handle = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, handle)
            locked = _flock(handle)
        yield locked


def _flock(handle: int) -> bool:
    """Wait for the lock; returns False without one, or if a writer seems to be stopped."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.005)
        except OSError:  # a file system without locks
            return False
        else:
            return True
    return False
