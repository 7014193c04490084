"""Read text files of points: cells, header and line numbers."""

import csv
import math
import re
from collections.abc import Callable, Sequence
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
LONGEST_QUOTED = 100_000
"""Characters of a line whose quoted cells may hold separators."""

_BEFORE_UNIT = re.compile(r"\s+(?=[\[(])")
"""Blanks before a unit, where blanks separate cells."""
SEPARATORS = (";", ",", "\t", None)
"""Separators of cells, None being blanks: of equals the first is taken."""


@dataclass(frozen=True)
class TextTable:
    """Cells of a text file: header (lower case, may be empty), rows and their line numbers."""

    file: Path
    header: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]
    separator: str | None = ","

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

    def column(self, index: int, *, gaps: bool = False) -> Array:
        """Return the numbers of a column, (n,); a cell that is not a finite number is an error.

        With `gaps` an empty cell is NaN.
        """
        name = shortened(self.header[index], 40) if self.header else str(index + 1)
        values = np.full(len(self.rows), np.nan)
        for k, (row, line) in enumerate(zip(self.rows, self.lines, strict=True)):
            if gaps and row[index].strip() in {"", "nan", "NaN"}:
                continue
            try:
                values[k] = _number(row[index], self.separator)
            except ValueError:
                self.fail(f"line {line}, column {name}: {shown(row[index])} is not a number")
            if not math.isfinite(values[k]):
                self.fail(f"line {line}, column {name}: {shown(row[index])} is not finite")
        return values


def read_lines(file: str | Path) -> list[str]:
    """Read the lines of a text file of at most `MOST_BYTES`; errors as in `fileio.read_bytes`."""
    return read_text(file, MOST_BYTES).replace("\r\n", "\n").replace("\r", "\n").split("\n")


def read_table(file: str | Path, known: Callable[[str], object]) -> TextTable:
    """Split a text file at `;`, `,`, tabs or blanks; commas are decimal ones unless they separate.

    The first row is the first line with two numbers, or with one below known names. A header is a
    line before it, a comment (`#`, `%`) or not, with as many cells: the last one of which two
    names, in lower case, are `known`, or else the last one that is no comment. Units may stand in a
    line of their own below it. A cell that is empty in every row and beyond the header, after a
    last separator, is left out.

    Raises
    ------
    ValueError
        For a file that cannot be read, has no rows or too many, or if rows differ in their number
        of cells.
    """
    heads: list[str] = []
    rows: list[list[str]] = []
    lines: list[int] = []
    separator: str | None = None
    least = 2
    for number, line in enumerate(read_lines(file), start=1):
        text = line.strip(" ")
        if not text.strip() or (rows and text[0] in "#%"):
            continue
        if not rows:
            separator = _separator(text)
            numbers = sum(is_number(cell, separator) for cell in _split(text, separator))
            if numbers < least or text[0] in "#%":
                heads.append(text)
                if any(_are_names(_names(text, sign), known) for sign in SEPARATORS):
                    least = 1
                continue
        rows.append(_split(text, separator))
        lines.append(number)
        if len(rows) > MOST_ROWS:
            break
    table = TextTable(Path(file), (), rows, lines, separator)
    table.check_size()
    header = _header(heads, len(rows[0]), separator, known)
    if len(header) in {0, len(rows[0]) - 1} and len(rows[0]) > 2 and not any(r[-1] for r in rows):
        rows = [row[:-1] for row in rows]
        header = _header(heads, len(rows[0]), separator, known)
    width = len(header or rows[0])
    for row, number in zip(rows, lines, strict=True):
        if len(row) != width:
            table.fail(f"line {number} has {len(row)} columns, not {width}: torn or not a table")
    return TextTable(table.file, header, rows, lines, separator)


def _header(
    heads: Sequence[str], width: int, separator: str | None, known: Callable[[str], object]
) -> tuple[str, ...]:
    """Return the names in the lines before the first row, () if none are there.

    Units in a line below known names are put behind these in brackets.
    """
    header: tuple[str, ...] = ()
    units = ("",) * width
    for text in reversed(heads):
        comment = text[0] in "#%"
        for sign in (separator, *SEPARATORS):
            names = _names(text, sign)
            fits = len(names) == width
            if (fits or not comment) and _are_names(names, known):
                return names if len(names) != width else tuple(map(_with_unit, names, units))
            if fits and not header and not comment and any(names):
                header = units = names
    return header


def _names(text: str, separator: str | None) -> tuple[str, ...]:
    if separator is None:
        text = _BEFORE_UNIT.sub("", text)
    return tuple(cell.lower() for cell in _split(text.lstrip("#% "), separator))


def _are_names(cells: Sequence[str], known: Callable[[str], object]) -> bool:
    return sum(known(cell) is not None for cell in cells) >= 2


def _with_unit(name: str, unit: str) -> str:
    plain = unit.strip("[]()- ")
    return f"{name} [{plain}]" if plain else name


def _separator(text: str) -> str | None:
    """Return the separator that makes numbers of most of a row's cells."""

    def share(separator: str | None) -> float:
        cells = _split(text, separator)
        found = sum(is_number(cell, separator) for cell in cells)
        return found / len(cells) if len(cells) > 1 else 0.0

    return max(SEPARATORS, key=share)


def _split(text: str, separator: str | None) -> list[str]:
    """Split a line into cells without quotes; of too many, a few more than are read."""
    if separator is not None and '"' in text and len(text) < LONGEST_QUOTED:
        cells = next(csv.reader([text.replace("\r", " ")], delimiter=separator))
    else:
        cells = text.split(separator, MOST_COLUMNS)
    return [cell.strip('" ') for cell in cells]


def _number(text: str, separator: str | None) -> float:
    """Read a number, with a decimal comma where commas do not separate cells."""
    return float(text if separator == "," else text.replace(",", ".", 1))


def is_number(text: str, separator: str | None = ",") -> bool:
    """Return whether a cell can be read as a number; NaN and infinity count as numbers."""
    try:
        _number(text, separator)
    except ValueError:
        return False
    return True
