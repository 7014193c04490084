"""Write a file as a whole or not at all."""

import os
import secrets
from pathlib import Path


def write_atomically(file: Path, content: bytes) -> None:
    """Replace a file: temporary file in the same folder (made if need be), fsync, rename.

    Raises
    ------
    OSError
        If it cannot be written; what was there before is untouched, nothing is left beside it.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("wb") as handle:
            handle.write(content)
            handle.flush()
            os.fsync(handle.fileno())
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)
