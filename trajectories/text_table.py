"""Read text files of points: cells, header and line numbers."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from trajectories.arguments import shortened, shown
from trajectories.fileio import read_text

Array = NDArray[np.float64]

MOST_BYTES = 32 * 2**20
"""Largest file that is read, bytes: three hours of a GPS log at 50 Hz."""
MOST_ROWS, MOST_COLUMNS = 1_000_000, 1000

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
        raise ValueError(f"{shortened(self.file)}: {message}")

    def check_size(self) -> None:
        """Refuse a table without rows, or with more rows or columns than are read."""
        if not self.rows:
            self.fail("has no rows of numbers")
        if len(self.rows) > MOST_ROWS:
            self.fail(f"more than {MOST_ROWS} rows are not read: thin them out")
        if len(self.header or self.rows[0]) > MOST_COLUMNS:
            self.fail(f"more than {MOST_COLUMNS} columns are not read")

    def find(self, quantity: str) -> int | None:
        """Return the index of a quantity's column, one of `COLUMNS`; None if there is none."""
        for name in COLUMNS[quantity]:
            if name in self.header:
                return self.header.index(name)
        return None

    def column(self, index: int) -> Array:
        """Return the numbers of a column, (n,); a cell that is not a finite number is an error."""
        name = shortened(self.header[index], 40) if self.header else str(index + 1)
        values = np.empty(len(self.rows))
        for k, (row, line) in enumerate(zip(self.rows, self.lines, strict=True)):
            try:
                values[k] = float(row[index])
            except ValueError:
                self.fail(f"line {line}, column {name}: {shown(row[index])} is not a number")
            if not math.isfinite(values[k]):
                self.fail(f"line {line}, column {name}: {shown(row[index])} is not finite")
        return values


def read_lines(file: str | Path) -> list[str]:
    """Read the lines of a text file of at most `MOST_BYTES`; errors as in `fileio.read_bytes`."""
    return read_text(file, MOST_BYTES).split("\n")


def read_table(file: str | Path) -> TextTable:
    """Split a text file at `,` or `;`; its header may be a `#` comment or a line without numbers.

    Raises
    ------
    ValueError
        For a file that cannot be read, has no rows or too many, or if rows differ in their number
        of cells.
    """
    comments: list[tuple[str, ...]] = []
    header: tuple[str, ...] = ()
    rows: list[list[str]] = []
    lines: list[int] = []
    for number, line in enumerate(read_lines(file), start=1):
        text = line.strip()
        if not text:
            continue
        parts = text.lstrip("#").split(";" if ";" in text else ",", MOST_COLUMNS)
        cells = [cell.strip() for cell in parts]
        if text.startswith("#"):
            if not rows:
                comments.append(tuple(cell.strip('" ').lower() for cell in cells))
        elif not rows and not header and not any(map(is_number, cells)):
            header = tuple(cell.strip('" ').lower() for cell in cells)
        else:
            rows.append(cells)
            lines.append(number)
            if len(rows) > MOST_ROWS:
                break
    table = TextTable(Path(file), header, rows, lines)
    table.check_size()
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
