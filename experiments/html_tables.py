"""Results as tables of a page."""

import html
from collections.abc import Callable, Iterable, Mapping, Sequence

from experiments.tables import (
    EFFORT,
    FURTHER,
    TRACKING,
    Column,
    Result,
    Row,
    build_rows,
    by_setting,
)


def html_table(
    headings: Sequence[str], lines: Iterable[Sequence[str]], numeric: Iterable[int] = ()
) -> str:
    """A plain HTML table from text cells, all escaped; columns `numeric` are aligned right."""
    right = set(numeric)

    def cell(tag: str, place: int, text: str) -> str:
        kind = ' class="n"' if place in right else ""
        return f"<{tag}{kind}>{html.escape(text)}</{tag}>"

    head = "".join(cell("th", place, text) for place, text in enumerate(headings))
    body = "\n".join(
        "<tr>" + "".join(cell("td", place, text) for place, text in enumerate(line)) + "</tr>"
        for line in lines
    )
    return (
        f'<div class="wide" tabindex="0"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def html_rows(
    rows: Sequence[Row], columns: Sequence[Column], texts: Mapping[str, Callable[[Row], str]]
) -> str:
    """HTML table of one setting's rows: trajectory, agent, numeric columns, columns of text."""
    heads = "".join(
        f'<th class="n">{html.escape(column.heading)} '
        f"<small>{html.escape(column.unit)}</small></th>"
        for column in columns
    ) + "".join(f"<th>{html.escape(heading)}</th>" for heading in texts)
    lines = []
    seen = ""
    for row in rows:
        first = row.trajectory != seen
        seen = row.trajectory
        classes = " ".join(
            name for name, on in (("published", row.published), ("first", first)) if on
        )
        cells = "".join(
            f'<td class="n">{html.escape(column.text(row))}</td>' for column in columns
        ) + "".join(f'<td class="t">{html.escape(words(row))}</td>' for words in texts.values())
        name = html.escape(row.trajectory) if first else ""
        label = html.escape(row.label + (f" ×{row.runs}" if row.runs > 1 else ""))
        lines.append(
            f'<tr class="{classes}"><th scope="row">{name}</th><td class="who">{label}</td>'
            f"{cells}</tr>"
        )
    body = "\n".join(lines)
    return (
        f'<div class="wide" tabindex="0"><table class="grouped"><thead><tr><th>path</th>'
        f"<th>agent</th>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def _trained(row: Row) -> str:
    """What learning cost, each quantity with its unit in one line."""
    told = ", ".join(part.replace(" ", "\u00a0") for part in row.learning.split(", "))
    return told or ("" if row.published else "–")


def html_tables(cases: Iterable[Result]) -> dict[str, str]:
    """Per setting the tables of a report: tracking, what it took, and what the paper leaves out."""
    result = {}
    for setting, rows in by_setting(build_rows(cases)).items():
        ours = [row for row in rows if not row.published]
        texts: dict[str, Callable[[Row], str]] = {"end": lambda row: row.end}
        if any(row.learning for row in rows):
            texts["trained"] = _trained
        result[setting] = "\n".join(
            [
                html_rows(rows, TRACKING, texts),
                "<h4>Effort and constraints</h4>",
                html_rows(
                    ours,
                    EFFORT,
                    {
                        "solves failed": lambda row: row.failures,
                        "constraints broken: largest excess, share of control periods": (
                            lambda row: row.violations
                        ),
                    },
                ),
                "<h4>Beyond the paper's columns</h4>",
                html_rows(ours, FURTHER, {}),
            ]
        )
    return result
