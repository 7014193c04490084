"""A page of numbered sections, figures and tables: "Figure 3" is an address, `#figure-3`."""

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from experiments.report.path_figures import Panel


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of escaped text."""
    return f'<p class="{kind}">{html.escape(text)}</p>' if kind else f"<p>{html.escape(text)}</p>"


def folded(words: str, content: str) -> str:
    """Content that a reader opens."""
    return f"<details><summary>{html.escape(words)}</summary>\n{content}\n</details>"


@dataclass
class Document:
    """Numbers what is added to it in the order in which it is asked for."""

    figures: int = 0
    tables: int = 0
    sections: list[tuple[str, str, str]] = field(default_factory=list)
    """Title, content and attributes of each."""

    def figure(
        self, caption: str, panels: Sequence[Panel], legend: str = "", wide: bool = False
    ) -> str:
        """A numbered figure: its legend, its panels beside each other as the page allows, caption.

        Parameters
        ----------
        caption
            Its first sentence names the figure; not escaped text.
        panels
            Parts, each with its title and SVG.
        legend
            HTML above the panels.
        wide
            Whether a panel may be as wide as two.
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
        # Figures of one panel stand beside each other.
        plate = "plate" if wide or len(panels) > 1 else "plate lone"
        return (
            f'<figure class="{plate}" id="{place}">{legend}\n'
            f'<div class="{kind}">\n{parts}\n</div>\n'
            f"{_caption(f'Figure {self.figures}', place, caption)}</figure>"
        )

    def table(self, caption: str, table: str) -> str:
        """A numbered table, its caption above it."""
        self.tables += 1
        place = f"table-{self.tables}"
        box = (
            f'<div class="wide" tabindex="0" role="region" aria-label="Table {self.tables}">'
            f"{table}</div>"
        )
        head = _caption(f"Table {self.tables}", place, caption)
        return f'<figure class="tabular" id="{place}">{head}\n{box}</figure>'

    def section(self, title: str, content: str, *, printed: bool = True) -> None:
        """Add a section, unless it is empty; one that is not printed is for screens alone."""
        if content:
            self.sections.append((title, content, "" if printed else ' class="screen"'))

    @property
    def contents(self) -> str:
        """Links to the sections."""
        return "".join(
            f'<a href="#s{number}">{html.escape(title)}</a>'
            for number, (title, _, _) in enumerate(self.sections, start=1)
        )

    @property
    def body(self) -> str:
        """All sections."""
        return "\n".join(
            f'<section id="s{number}"{kind}><h2><span class="number">{number}</span> '
            f"{html.escape(title)}</h2>\n{content}\n</section>"
            for number, (title, content, kind) in enumerate(self.sections, start=1)
        )


def _caption(number: str, place: str, text: str) -> str:
    return (
        f'<figcaption><a href="#{place}">{number}.</a> <span>{html.escape(text)}</span>'
        "</figcaption>"
    )


def first_open(parts: Iterable[tuple[bool, str]], words: str) -> str:
    """Parts that are to stand open, then the others folded away together."""
    every = list(parts)
    others = [part for is_open, part in every if not is_open]
    shown = [part for is_open, part in every if is_open]
    if others:
        shown.append(folded(f"{words} ({len(others)})", joined(others)))
    return joined(shown)


def joined(parts: Iterable[str]) -> str:
    """Parts of a section below each other, without empty ones."""
    return "\n".join(part for part in parts if part)
