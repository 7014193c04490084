"""Read files that anybody may have written, and write any file as a whole or not at all.

Every reader of this project goes through `read_bytes`: only regular files up to a stated size are
read. JSON must be UTF-8 with finite numbers, each key once, and little nesting. Anything else is a
ValueError of one line that begins with the file's name.
"""

import contextlib
import json
import math
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TypeVar

import msgspec

from trajectories.arguments import shortened, shown

Value = TypeVar("Value")

MOST_BYTES = 16 * 2**20
"""Largest file that is read unless its reader says otherwise, bytes."""
DEEPEST = 32
"""Largest number of JSON objects and lists inside each other."""
LARGEST_INTEGER = 2**63 - 1
"""Largest integer in JSON, as in a 64-bit integer of NumPy."""


def file_name(name: str) -> str:
    """Return a name from anywhere as the stem of a file's name: never a path, on any system.

    All but letters, digits and `_+=@.` becomes "-", dots at the ends are left out, and at most 60
    characters are kept; an empty name becomes "unnamed". Different names may become equal.
    """
    kept = "".join(c if c.isalnum() or c in "_+=@." else " " for c in name)
    return "-".join(kept.split())[:60].strip(".-") or "unnamed"


def read_bytes(file: str | Path, limit: int = MOST_BYTES) -> bytes:
    """Read a regular file of at most `limit` bytes.

    Raises
    ------
    ValueError
        In one line that begins with the file's name, for a pipe, device, folder, a larger file, or
        one that cannot be read.
    """
    with opened(file) as handle:
        size = os.fstat(handle.fileno()).st_size
        # A file may grow meanwhile; memory for all that is allowed is not reserved.
        content = handle.read(min(size, limit) + 1)
    if (size := max(size, len(content))) > limit:
        raise ValueError(f"{shortened(file)}: {size} bytes are too many: at most {limit} are read")
    return content


@contextlib.contextmanager
def opened(file: str | Path) -> Iterator[BinaryIO]:
    """Open a regular file to read its bytes, for files that are too large for memory.

    Raises
    ------
    ValueError
        In one line that begins with the file's name, for a pipe, device, folder, or a file that
        cannot be read, then or in the context.
    """
    name = shortened(file)
    try:
        handle = open(file, "rb", opener=_opened)  # noqa: SIM115  closed below
    except (OSError, ValueError) as error:  # ValueError: the name holds a NUL or half a surrogate
        reason = getattr(error, "strerror", None) or shortened(error)
        raise ValueError(f"{name}: cannot be read: {reason}") from error
    with handle:
        if not stat.S_ISREG(os.fstat(handle.fileno()).st_mode):
            raise ValueError(f"{name}: cannot be read: it is a pipe or device, no regular file")
        try:
            yield handle
        except OSError as error:
            raise ValueError(f"{name}: cannot be read: {error.strerror}") from error


def _opened(file: str, flags: int) -> int:
    """Open without waiting for the writer of a pipe."""
    return os.open(file, flags | getattr(os, "O_NONBLOCK", 0))


def read_text(file: str | Path, limit: int = MOST_BYTES) -> str:
    """Read a text file in UTF-8, with or without a byte order mark; errors as in `read_bytes`."""
    return _decoded(read_bytes(file, limit), file)


def _decoded(content: bytes, name: object) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{shortened(name)}: is not a text file in UTF-8 (byte {error.start})"
        ) from error


def read_json(file: str | Path, limit: int = MOST_BYTES, *, infinite: bool = False) -> Any:
    """Read a JSON file; errors as in `read_bytes` and `parse_json`."""
    return parse_json(read_bytes(file, limit), file, infinite=infinite)


def parse_json(content: str | bytes, name: object, *, infinite: bool = False) -> Any:
    """Parse JSON.

    Parameters
    ----------
    content
        Text, or bytes in UTF-8.
    name
        Origin for messages, such as a file and line.
    infinite
        Reads the words Infinity and NaN, which Python writes although JSON has none.

    Raises
    ------
    ValueError
        In one line that begins with `name`: for anything that is not JSON in UTF-8, a key twice in
        an object, a number beyond double precision, an integer beyond 64 bits, or more than
        `DEEPEST` objects and lists inside each other.
    """
    text = _decoded(content, name) if isinstance(content, bytes) else content
    try:
        found = json.loads(
            text, object_pairs_hook=_unique, parse_constant=float if infinite else _refuse,
            parse_float=_finite, parse_int=_integer,
        )  # fmt: skip
        _check_depth(found)
    except RecursionError:
        raise ValueError(f"{shortened(name)}: is not JSON: nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{shortened(name)}: is not JSON: {shortened(error)}") from error
    return found


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        keys: set[str] = set()
        twice = next(key for key, _ in pairs if key in keys or keys.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"key {shown(twice)} twice")
    return found


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{shown(text)} is beyond double precision")
    return value


def finite_number(text: object, name: object, what: str) -> float:
    """Return the number in a text, or a number of JSON, that `what` is.

    Raises
    ------
    ValueError
        In one line that begins with `name`, for anything that is not a finite number.
    """
    try:
        value = math.nan if isinstance(text, bool) else float(text)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{shortened(name)}: {what}: {shown(text)} is not a finite number")
    return value


def _integer(text: str) -> int:
    if len(text) > 20 or abs(int(text)) > LARGEST_INTEGER:
        raise ValueError(f"integer {shown(text)} is beyond 64 bits")
    return int(text)


def _check_depth(value: object) -> None:
    level = [value]
    for _ in range(DEEPEST + 1):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise RecursionError


def checked(value: object, kind: type[Value], name: object) -> Value:
    """Convert plain JSON to a type that msgspec knows: a dataclass, Struct, TypedDict, list[...].

    Raises
    ------
    ValueError
        In one line that begins with `name`, and names the place in the JSON.
    """
    try:
        return msgspec.convert(value, kind)
    except (msgspec.ValidationError, UnicodeError) as error:  # or half of a surrogate pair
        raise ValueError(f"{shortened(name)}: {shortened(error)}") from error


def write_atomically(file: Path, content: bytes, *, durable: bool = True) -> None:
    """Replace a file: temporary file in the same folder (made if need be), fsync, rename.

    Without `durable` there is no fsync: a crash of the system may leave a torn file.

    Raises
    ------
    OSError
        If the file cannot be written; the old file is unchanged, and no temporary file is left.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("wb") as handle:
            handle.write(content)
            handle.flush()
            if durable:
                os.fsync(handle.fileno())
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)
