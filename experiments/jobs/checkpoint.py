"""Checkpoints: plain values and tensors, written atomically, read without unpickling objects."""

import io
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from trajectories.arguments import shortened, shown
from trajectories.fileio import write_atomically

FORMAT = "lpv-track-checkpoint/1"
NAME = "checkpoint.pt"


def write(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the checkpoint of a folder, in place of the last one."""
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, **content}, buffer)
    write_atomically(folder / NAME, buffer.getvalue())


def read(folder: Path) -> dict[str, Any] | None:
    """Read the checkpoint of a folder; None if there is none.

    Raises
    ------
    ValueError
        If it is damaged, of another version, or holds anything but tensors and plain values.
    """
    file = folder / NAME
    if not file.exists():
        return None
    try:
        content: dict[str, Any] = torch.load(file, map_location="cpu", weights_only=True)
        if content["format"] != FORMAT:
            raise ValueError(f"its format is {shown(content['format'])}, not {FORMAT!r}")
    except (
        pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError, OSError,
        zipfile.BadZipFile,
    ) as error:  # fmt: skip
        # PyTorch's own message is many lines long and advises loading the file unsafely.
        reason = str(error) if isinstance(error, ValueError) else type(error).__name__
        raise ValueError(unusable(folder, reason)) from None
    return content


def unusable(folder: Path, reason: str) -> str:
    """Return the message for a checkpoint that a training cannot go on from, in one line."""
    return (
        f"{folder / NAME} cannot be read ({shortened(reason)}): remove it, and the training begins "
        "anew"
    )
