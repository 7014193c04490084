"""Mutations of files, each drawn from a generator: the same generator gives the same file."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator
Mutation = Callable[[bytes, bytes, Rng], bytes]
"""Mutates a content; the second argument is that of another file of the same kind."""

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
NUMBERS = (
    b"1e400", b"-1e400", b"NaN", b"-Infinity", b"inf", b"-0", b"0", b"-1", b"1e-320", b"1e308",
    b"1e15", b"1e-9", b"9223372036854775808", b"-9223372036854775809", b"9" * 400, b"9" * 5000,
    b"0.1", b"3", b"1e3", b"0x10", b"1_000", b"", b"true", b"null", b"[]", b"{}", b'"1"', b"1,2",
    "\u0661\u0662".encode(), b"1" + b"0" * 30,
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 10**400, 0.5, -0.0, 1e-300, 1e300, 1e-9, 1e9, "",
    "x" * 100_000, "../../x", "/etc/passwd", "\0", "a\nb", "\x1b[2J", "\ud800", [], {}, [[]],
    [1, 2], {"a": 1}, [0.0] * 1000,
)  # fmt: skip


def _at(content: bytes, rng: Rng) -> int:
    return int(rng.integers(0, len(content) + 1))


def flip(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Flip up to 20 bits."""
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 20)) if changed else 0):
        changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def truncate(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Keep the beginning."""
    return content[: _at(content, rng)]


def splice(content: bytes, other: bytes, rng: Rng) -> bytes:
    """Continue with the end of another file."""
    return content[: _at(content, rng)] + other[_at(other, rng) :]


def drop(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Leave out a block."""
    first = _at(content, rng)
    return content[:first] + content[first + int(rng.integers(1, 200)) :]


def repeat(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Repeat a block up to a thousand times."""
    first = _at(content, rng)
    block = content[first : first + int(rng.integers(1, 400))]
    return content[:first] + block * int(10 ** rng.uniform(0, 3)) + content[first:]


def insert(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Insert random bytes, NULs, a byte order mark, line ends, or a very long line."""
    pieces = (
        rng.bytes(int(rng.integers(1, 50))), b"\0" * int(rng.integers(1, 5000)), b"\xef\xbb\xbf",
        b"\xff\xfe", b"\r\n", b"\r", b"\n\n", b"#", b'"', b"," * 50_000, b"a" * 1_000_000,
        b"\x1b]0;x\x07", b"[" * 100_000, b"# key: " + b"{" * 3000 + b"\n",
    )  # fmt: skip
    at = int(rng.choice([0, len(content), _at(content, rng)]))
    return content[:at] + pieces[int(rng.integers(len(pieces)))] + content[at:]


def encode(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Write a text in another encoding."""
    text = content.decode("utf-8", "replace")
    name = ("utf-16", "utf-32", "utf-16-be", "utf-7", "utf-8-sig")[int(rng.integers(5))]
    return text.encode(name, "replace")


def number(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Replace up to five numbers, or all that are equal to one."""
    found = list(NUMBER.finditer(content))
    if not found:
        return content
    new = NUMBERS[int(rng.integers(len(NUMBERS)))]
    if rng.random() < 0.2:
        return content.replace(found[int(rng.integers(len(found)))].group(), new)[: 2**22]
    for index in sorted(rng.integers(0, len(found), int(rng.integers(1, 5))), reverse=True):
        first, last = found[index].span()
        content = content[:first] + new + content[last:]
    return content


def scale(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Scale all numbers of a text by a power of ten."""
    factor = 10.0 ** int(rng.integers(-12, 13))
    return NUMBER.sub(lambda found: repr(float(found.group()) * factor).encode(), content)


def jitter(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Multiply a number in a hundred, or all of them, by about one, or by far more or less."""
    share, spread = float(rng.choice([0.01, 1.0])), float(rng.choice([1e-3, 0.1, 3.0]))

    def moved(found: "re.Match[bytes]") -> bytes:
        if rng.random() > share:
            return found.group()
        return repr(float(found.group()) * float(np.exp(rng.normal(0.0, spread)))).encode()

    return NUMBER.sub(moved, content)


def lines(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Swap, repeat, reverse or drop lines."""
    rows = content.split(b"\n")
    kind = int(rng.integers(4))
    if kind == 0:
        rng.shuffle(rows)  # type: ignore[arg-type]
    elif kind == 1:
        at = int(rng.integers(len(rows)))
        rows[at:at] = rows[at : at + 3] * int(10 ** rng.uniform(0, 3))
    elif kind == 2:
        rows.reverse()
    else:
        rows = [row for row in rows if rng.random() < 0.7]
    return b"\n".join(rows)


def value(content: bytes, _: bytes, rng: Rng) -> bytes:
    """Replace a value in JSON, drop or rename its key, or nest it deeply; for JSON lines in one."""
    rows = content.split(b"\n")
    at = int(rng.integers(len(rows)))
    for text, only in ((content, True), (rows[at], False)):
        try:
            whole = json.loads(text)
        except (ValueError, RecursionError):
            continue
        edit(whole, rng)
        new = json.dumps(whole).encode()
        return new if only else b"\n".join([*rows[:at], new, *rows[at + 1 :]])
    return number(content, b"", rng)


def edit(whole: Any, rng: Rng) -> None:
    """Change one value inside of plain JSON in place."""
    places = list(_places(whole))
    if not places:
        return
    holder, key = places[int(rng.integers(len(places)))]
    kind = int(rng.integers(6))
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[str(key) + "x"] = holder.pop(key)
    elif kind == 2:
        for _ in range(int(rng.choice([2, 40, 300]))):
            holder[key] = [holder[key]]
    else:
        holder[key] = VALUES[int(rng.integers(len(VALUES)))]


def _places(whole: Any) -> Any:
    items: Any = []
    if isinstance(whole, dict | list):
        items = list(whole.items() if isinstance(whole, dict) else enumerate(whole))
    for key, inner in items:
        yield whole, key
        yield from _places(inner)


BYTES: tuple[Mutation, ...] = (flip, truncate, splice, drop, repeat, insert)
TEXT: tuple[Mutation, ...] = (*BYTES, number, number, number, scale, jitter, jitter, lines, encode)
JSON: tuple[Mutation, ...] = (*TEXT, value, value, value, value, value)


def special(file: Path, rng: Rng) -> str:
    """Put something that is no regular file, or is far too large, in a file's place."""
    file.unlink(missing_ok=True)
    kind = ("pipe", "folder", "loop", "zero", "none", "large", "empty")[int(rng.integers(7))]
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "folder":
        file.mkdir()
    elif kind == "loop":
        file.symlink_to(file)
    elif kind == "zero":
        file.symlink_to("/dev/zero")
    elif kind in {"large", "empty"}:
        file.touch()
        os.truncate(file, 2**40 if kind == "large" else 0)  # sparse
    return kind
