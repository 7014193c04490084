"""A report's page: numbered sections, figures and tables in one HTML file that fetches nothing.

"Figure 3" is also an address, `#figure-3`.
"""

import base64
import hashlib
import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from string import Template

from experiments.figures import COLOURS
from experiments.run.tables import Column, Row

PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="$policy">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
$style</style>
</head>
<body>
<main>
<header>
<h1>$title</h1>
<p class="soft">$subtitle</p>
<nav aria-label="Contents">$contents</nav>
</header>
$body
</main>
$scripts
</body>
</html>
""")
SCRIPTS = ("page.js",)
"""Scripts of every page: choice of colours, sorting of tables."""
DASHES = 4
"""Kinds of dashes in the style sheet, `d0` to `d3`; colours are `c0` to `c6`."""


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph of escaped text."""
    return f'<p class="{kind}">{html.escape(text)}</p>' if kind else f"<p>{html.escape(text)}</p>"


def folded(words: str, content: str) -> str:
    """Return content that is hidden until the reader opens it."""
    return f"<details><summary>{html.escape(words)}</summary>\n{content}\n</details>"


def joined(parts: Iterable[str]) -> str:
    """Join the parts of a section, leaving out empty ones."""
    return "\n".join(part for part in parts if part)


def first_open(parts: Iterable[tuple[bool, str]], words: str) -> str:
    """Join parts, (open, HTML) each: the open ones first, then the others folded together."""
    every = list(parts)
    others = [part for is_open, part in every if not is_open]
    shown = [part for is_open, part in every if is_open]
    if others:
        shown.append(folded(f"{words} ({len(others)})", joined(others)))
    return joined(shown)


@dataclass(frozen=True)
class LineStyle:
    """Colour and dashes of a line, numbers of the style sheet's classes, and its width in px."""

    colour: int
    dashes: int
    width: float = 1.4

    @property
    def kind(self) -> str:
        """Classes of the line."""
        return f"c{self.colour} d{self.dashes}"


Styles = Mapping[str, LineStyle]


def line_styles(labels: Iterable[str]) -> dict[str, LineStyle]:
    """Return a style for each label: all colours solid first, then the same colours dashed.

    Earlier lines are broader, so that they show beneath a later one that covers them.
    """
    n, once = len(COLOURS), list(dict.fromkeys(labels))
    return {
        label: LineStyle(k % n, k // n % DASHES, 2.4 - 1.2 * k / max(len(once) - 1, 1))
        for k, label in enumerate(once)
    }


def legend(styles: Styles, labels: Iterable[str]) -> str:
    """Return a list of labels with their lines, in the order of the styles."""
    shown = set(labels)
    items = "".join(
        f'<li><svg class="chart" viewBox="0 0 30 10" aria-hidden="true">'
        f'<path class="l {style.kind}" stroke-width="2.4" d="M1 5h28"/></svg>{html.escape(label)}'
        "</li>"
        for label, style in styles.items()
        if label in shown
    )
    return f'<ul class="legend">{items}</ul>'


@dataclass(frozen=True)
class Panel:
    """One plot of a figure."""

    title: str
    svg: str


@dataclass
class Document:
    """Body of a page; numbers its figures, tables and sections in the order they are added."""

    figures: int = 0
    tables: int = 0
    sections: list[tuple[str, str, str]] = field(default_factory=list)
    """Title, content and attributes of each section."""

    def figure(
        self, caption: str, panels: Sequence[Panel], legend: str = "", wide: bool = False
    ) -> str:
        """Return a numbered figure: legend, panels side by side where they fit, caption.

        Parameters
        ----------
        caption
            Unescaped text; its first sentence names the figure.
        panels
            Plots of the figure.
        legend
            HTML above the panels.
        wide
            Allow panels twice as wide.
        """
        self.figures += 1
        place = f"figure-{self.figures}"
        name = caption.split(". ", 1)[0].rstrip(".")
        parts = "\n".join(
            f'<div class="panel"><p class="title">{html.escape(panel.title)}</p>'
            f'<div role="img" aria-label="{html.escape(f"{name}: {panel.title}")}">{panel.svg}'
            "</div></div>"
            for panel in panels
        )
        kind = "panels few" if wide else "panels"
        # Figures of one panel stand side by side.
        plate = "plate" if wide or len(panels) > 1 else "plate lone"
        return (
            f'<figure class="{plate}" id="{place}">{legend}\n'
            f'<div class="{kind}">\n{parts}\n</div>\n'
            f"{_caption(f'Figure {self.figures}', place, caption)}</figure>"
        )

    def table(self, caption: str, table: str) -> str:
        """Return a numbered table with its caption above it."""
        self.tables += 1
        place = f"table-{self.tables}"
        box = (
            f'<div class="wide" tabindex="0" role="region" aria-label="Table {self.tables}">'
            f"{table}</div>"
        )
        head = _caption(f"Table {self.tables}", place, caption)
        return f'<figure class="tabular" id="{place}">{head}\n{box}</figure>'

    def section(self, title: str, content: str, *, printed: bool = True) -> None:
        """Add a section unless its content is empty; `printed=False` shows it on screens only."""
        if content:
            self.sections.append((title, content, "" if printed else ' class="screen"'))

    def render(self, title: str, subtitle: str, scripts: Sequence[str] = ()) -> str:
        """Return the whole page as text.

        The page's policy forbids all requests and all scripts but its own, which it identifies by
        their digests: nothing in a results folder can run.

        Parameters
        ----------
        title, subtitle
            Unescaped text.
        scripts
            Names of further script files in this folder.
        """
        sources = [asset(name) for name in (*SCRIPTS, *scripts)]
        digests = [
            base64.b64encode(hashlib.sha256(f"\n{source}".encode()).digest()).decode()
            for source in sources
        ]
        allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
        policy = (
            f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
            "base-uri 'none'; form-action 'none'"
        )
        return PAGE.substitute(
            policy=policy,
            title=html.escape(title),
            subtitle=html.escape(subtitle),
            style=asset("page.css"),
            contents="".join(
                f'<a href="#s{number}">{html.escape(name)}</a>'
                for number, (name, _, _) in enumerate(self.sections, start=1)
            ),
            body="\n".join(
                f'<section id="s{number}"{kind}><h2><span class="number">{number}</span> '
                f"{html.escape(name)}</h2>\n{content}\n</section>"
                for number, (name, content, kind) in enumerate(self.sections, start=1)
            ),
            scripts="\n".join(f"<script>\n{source}</script>" for source in sources),
        )


@cache
def asset(name: str) -> str:
    """Return the text of a file beside this module.

    Raises
    ------
    FileNotFoundError
        If the installation lacks it.
    """
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _caption(number: str, place: str, text: str) -> str:
    return (
        f'<figcaption><a href="#{place}">{number}.</a> <span>{html.escape(text)}</span>'
        "</figcaption>"
    )


def html_table(
    headings: Sequence[str],
    lines: Iterable[Sequence[str]],
    numeric: Iterable[int] = (),
    wrapped: Iterable[int] = (),
) -> str:
    """Return an HTML table of text cells, all escaped; the first column heads its line.

    Columns `numeric` are aligned right; columns `wrapped` hold prose and break into lines.
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
    """Return an HTML table of one setting: trajectory, agent, numeric columns, columns of text.

    Every line names its trajectory, so that lines keep their meaning when they are sorted; the
    style sheet hides repetitions where lines are grouped.
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
