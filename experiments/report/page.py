"""A report's page: numbered sections, figures and tables in one HTML file that fetches nothing.

"Figure 3" is also an address, `#figure-3`.
"""

import base64
import hashlib
import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from string import Template

from experiments.figures import COLOURS

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
        """Return the whole page as text, with further `scripts` from files in this folder.

        The page's policy forbids all requests and all scripts but its own, which it identifies by
        their digests: nothing in a results folder can run.
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


Cell = str | tuple[str, str]
"""Text of a table's cell, or text and a remark in small print."""


def html_table(
    headings: Sequence[Cell],
    lines: Iterable[Sequence[Cell]],
    numeric: Iterable[int] = (),
    wrapped: Iterable[int] = (),
) -> str:
    """Return an HTML table of cells, all escaped; the first column heads its line.

    Columns `numeric` are aligned right; columns `wrapped` hold prose and break into lines.
    """
    kinds = {**dict.fromkeys(numeric, "n"), **dict.fromkeys(wrapped, "t")}
    return _table(headings, ((line, "") for line in lines), kinds)


def html_groups(
    headings: Sequence[Cell], lines: Sequence[tuple[Sequence[Cell], bool]], numeric: Iterable[int],
    wrapped: Iterable[int],
) -> str:  # fmt: skip
    """Return an HTML table of lines, (cells, published) each, grouped by the first column, a path.

    Every line names its path, so that lines keep their meaning when they are sorted; the style
    sheet hides repetitions where lines are grouped.
    """
    kinds = {**dict.fromkeys(numeric, "n"), **dict.fromkeys(wrapped, "t"), 0: "path", 1: "who"}
    paths = [cells[0] for cells, _ in lines]
    marked = [
        (cells, " ".join(["published"] * published + ["first"] * (k == 0 or path != paths[k - 1])))
        for k, ((cells, published), path) in enumerate(zip(lines, paths, strict=True))
    ]
    width = min(max(map(len, paths), default=4), 9)
    return _table(headings, marked, kinds, f' class="grouped" style="--path: {max(width, 4)}ch"', 1)


def _table(
    headings: Sequence[Cell],
    lines: Iterable[tuple[Sequence[Cell], str]],
    kinds: Mapping[int, str],
    attributes: str = "",
    label: int = 0,
) -> str:
    """Return a table of lines, (cells, class) each; column `label` heads its line."""

    def cell(place: int, content: Cell, tag: str, scope: str = "") -> str:
        text, small = content if isinstance(content, tuple) else (content, "")
        remark = f"<small>{html.escape(small)}</small>" if small else ""
        mark = f' class="{kinds[place]}"' if place in kinds else ""
        return f"<{tag}{scope}{mark}>{html.escape(text)}{remark}</{tag}>"

    head = "".join(cell(k, content, "th", ' scope="col"') for k, content in enumerate(headings))
    rows = []
    for line, kind in lines:
        cells = "".join(
            cell(k, content, "th", ' scope="row"') if k == label else cell(k, content, "td")
            for k, content in enumerate(line)
        )
        rows.append(f'<tr class="{kind}">{cells}</tr>' if kind else f"<tr>{cells}</tr>")
    body = "\n".join(rows)
    return f"<table{attributes}><thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table>"
