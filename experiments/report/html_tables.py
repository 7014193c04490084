"""Results as tables of a page: the table alone, which `Document.table` numbers and frames."""

import html
from collections.abc import Callable, Iterable, Mapping, Sequence

from experiments.run.tables import Column, Row


def html_table(
    headings: Sequence[str],
    lines: Iterable[Sequence[str]],
    numeric: Iterable[int] = (),
    wrapped: Iterable[int] = (),
) -> str:
    """A plain HTML table from text cells, all escaped; the first column heads its line.

    Columns `numeric` are aligned right; `wrapped` ones hold prose and break into lines.
    """
    right, prose = set(numeric), set(wrapped)

    def cell(place: int, text: str, tag: str, more: str = "") -> str:
        kind = "n" if place in right else "t" if place in prose else ""
        mark = f' class="{kind}"' if kind else ""
        return f"<{tag}{more}{mark}>{html.escape(text)}</{tag}>"

    head = "".join(cell(k, text, "th", ' scope="col"') for k, text in enumerate(headings))
    body = "\n".join(
        "<tr>"
        + "".join(
            cell(k, text, "td") if k else cell(k, text, "th", ' scope="row"')
            for k, text in enumerate(line)
        )
        + "</tr>"
        for line in lines
    )
    return f"<table><thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table>"


def html_rows(
    rows: Sequence[Row], columns: Sequence[Column], texts: Mapping[str, Callable[[Row], str]]
) -> str:
    """HTML table of one setting's rows: trajectory, agent, numeric columns, columns of text.

    Every line names its trajectory, so that lines keep their meaning in whatever order they are
    sorted; the style sheet hides repetitions where lines stand in groups.
    """
    heads = "".join(
        f'<th class="n" scope="col">{html.escape(column.heading)} '
        f"<small>{html.escape(column.unit)}</small></th>"
        for column in columns
    ) + "".join(f'<th scope="col">{html.escape(heading)}</th>' for heading in texts)
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
        label = html.escape(row.label + (f" ×{row.runs}" if row.runs > 1 else ""))
        mark = f' class="{classes}"' if classes else ""
        lines.append(
            f'<tr{mark}><td class="path">{html.escape(row.trajectory)}</td>'
            f'<th class="who" scope="row">{label}</th>{cells}</tr>'
        )
    longest = max((len(row.trajectory) for row in rows), default=4)
    body = "\n".join(lines)
    return (
        f'<table class="grouped" style="--path: {min(max(longest, 4), 9)}ch"><thead><tr>'
        f'<th class="path" scope="col">path</th><th class="who" scope="col">agent</th>{heads}'
        f"</tr></thead>\n<tbody>\n{body}\n</tbody></table>"
    )


def trained_words(row: Row) -> str:
    """What learning cost, each quantity with its unit in one line."""
    told = ", ".join(part.replace(" ", "\u00a0") for part in row.learning.split(", "))
    return told or ("" if row.published else "–")
