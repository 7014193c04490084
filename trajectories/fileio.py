"""Read text files of points, and write any file as a whole or not at all."""

import math
import os
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COLUMNS = {
    "x": ("x", "x_m", "east", "east_m", "easting", "easting_m"),
    "y": ("y", "y_m", "north", "north_m", "northing", "northing_m"),
    "latitude": ("lat", "latitude", "lat_deg", "latitude_deg"),
    "longitude": ("lon", "lng", "long", "longitude", "lon_deg", "longitude_deg"),
    "height": ("h", "h_m", "height", "height_m", "alt", "alt_m", "altitude", "altitude_m", "ele"),
    "time": ("t", "t_s", "time", "time_s", "timestamp"),
    "width": ("w_tr_right_m", "w_tr_left_m"),
}
"""Names that a column of each quantity may have in a header, in lower case."""


@dataclass(frozen=True)
class TextTable:
    """Cells of a text file: header (lower case, may be empty), rows and their line numbers."""

    file: Path
    header: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]

    def fail(self, message: str) -> NoReturn:
        """Raise a ValueError that begins with the file's name."""
        raise ValueError(f"{self.file}: {message}")

    def find(self, quantity: str) -> int | None:
        """Return the index of a quantity's column, one of `COLUMNS`; None if there is none."""
        for name in COLUMNS[quantity]:
            if name in self.header:
                return self.header.index(name)
        return None

    def column(self, index: int) -> Array:
        """Return the numbers of a column, (n,); a cell that is not a finite number is an error."""
        name = self.header[index] if self.header else str(index + 1)
        values = np.empty(len(self.rows))
        for k, (row, line) in enumerate(zip(self.rows, self.lines, strict=True)):
            try:
                values[k] = float(row[index])
            except ValueError:
                self.fail(f"line {line}, column {name}: {row[index][:40]!r} is not a number")
            if not math.isfinite(values[k]):
                self.fail(f"line {line}, column {name}: {row[index][:40]!r} is not finite")
        return values


def read_text(file: str | Path) -> str:
    """Read a text file; raise a ValueError of one line if it cannot be read."""
    try:
        return Path(file).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ValueError(f"{file}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{file}: is not a text file (byte {error.start})") from error


def read_table(file: str | Path) -> TextTable:
    """Split a text file at `,` or `;`; its header may be a `#` comment or a line without numbers.

    Raises
    ------
    ValueError
        For a file that cannot be read or has no rows, or if rows differ in their number of cells.
    """
    comments: list[tuple[str, ...]] = []
    header: tuple[str, ...] = ()
    rows: list[list[str]] = []
    lines: list[int] = []
    for number, line in enumerate(read_text(file).split("\n"), start=1):
        text = line.strip()
        cells = [cell.strip() for cell in text.lstrip("#").split(";" if ";" in text else ",")]
        if not text:
            continue
        if text.startswith("#"):
            if not rows:
                comments.append(tuple(cell.strip('" ').lower() for cell in cells))
        elif not rows and not header and not any(map(is_number, cells)):
            header = tuple(cell.strip('" ').lower() for cell in cells)
        else:
            rows.append(cells)
            lines.append(number)
    table = TextTable(Path(file), header, rows, lines)
    if not rows:
        table.fail("has no rows of numbers")
    width = len(header or rows[0])
    for row, number in zip(rows, lines, strict=True):
        if len(row) != width:
            table.fail(f"line {number} has {len(row)} columns, not {width}: torn or not a table")
    if not header:
        known = {name for group in COLUMNS.values() for name in group}
        fitting = [c for c in comments if len(c) == width and len(known.intersection(c)) >= 2]
        table = TextTable(table.file, fitting[-1] if fitting else (), rows, lines)
    return table


def is_number(text: str) -> bool:
    """Return whether a cell can be read as a number; NaN and infinity count as numbers."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def write_atomically(file: Path, content: bytes) -> None:
    """Replace a file: temporary file in the same folder (made if need be), fsync, rename.

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
            os.fsync(handle.fileno())
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)
