"""Docstrings as Markdown: what the sources write for plain-text readers, put in Markdown's words.

The sources keep three habits of reStructuredText, which read well in a terminal: tables ruled by
equals signs, `::` before an indented formula, and names with an indented explanation below them.
Sections in NumPy's form, from the first underlined one on, are left to their own parser.
"""

import re
from collections.abc import Iterator

RULE = re.compile(r"=+(?: +=+)+\s*")
SECTION = re.compile(r"-{3,}\s*")
TERM = re.compile(r"[a-z_]+(?:, [a-z_]+)*")


def markdown(docstring: str) -> str:
    """Return a docstring, its first indentation taken off already, as Markdown."""
    lines = docstring.split("\n")
    first = next((k - 1 for k, line in enumerate(lines) if SECTION.fullmatch(line)), len(lines))
    return "\n".join([*definitions(formulas(list(tables(lines[:first])))), *lines[first:]])


def tables(lines: list[str]) -> Iterator[str]:
    """Turn tables ruled by equals signs into Markdown's."""
    k = 0
    while k < len(lines):
        if not RULE.fullmatch(lines[k]):
            yield lines[k]
            k += 1
            continue
        end = next(j for j in range(k + 2, len(lines)) if RULE.fullmatch(lines[j]) and j > k + 2)
        starts = [match.start() for match in re.finditer("=+", lines[k])]
        rows: list[list[str]] = []
        for line in (lines[k + 1], *lines[k + 3 : end]):
            cells = cut(line, starts)
            if cells[0] or not rows:
                rows.append(cells)
            else:  # a row goes on
                rows[-1] = [f"{a} {b}".strip() for a, b in zip(rows[-1], cells, strict=True)]
        yield from ("", row(rows[0]), row(["---"] * len(starts)), *map(row, rows[1:]), "")
        k = end + 1


def cut(line: str, starts: list[int]) -> list[str]:
    """Cells of a line of a table whose columns begin at `starts`."""
    ends = [*starts[1:], max(len(line), starts[-1])]
    return [line[start:end].strip() for start, end in zip(starts, ends, strict=True)]


def row(cells: list[str]) -> str:
    """A row of a Markdown table; a lone asterisk is none of emphasis."""
    return "| " + " | ".join(cell.replace("|", "\\|").replace("*", "\\*") for cell in cells) + " |"


def formulas(lines: list[str]) -> list[str]:
    """`::` before an indented block becomes `:`, or nothing where it stands alone."""
    return [
        re.sub(r"^\s*::$", "", line) if line.strip() == "::" else re.sub(r"::$", ":", line)
        for line in lines
    ]


def definitions(lines: list[str]) -> Iterator[str]:
    """Names with an indented explanation below become definition lists."""
    opened = False
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if opened:
            opened = False
            yield f":   {line.strip()}"
        elif TERM.fullmatch(line) and following.startswith("    "):
            opened = True
            yield from ("", f"`{line}`")
        else:
            yield line
