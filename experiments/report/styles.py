"""Lines of agents and conditions: the same in every figure and legend of a page."""

import html
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from experiments.figures import COLOURS

DASHES = 4
"""Kinds of dashes in the style sheet, `d0` to `d3`; colours are `c0` to `c6`."""


@dataclass(frozen=True)
class LineStyle:
    """Colour and dashes as numbers of the style sheet's classes, and width in px."""

    colour: int
    dashes: int
    width: float = 1.4

    @property
    def kind(self) -> str:
        """Classes of a line."""
        return f"c{self.colour} d{self.dashes}"


Styles = Mapping[str, LineStyle]


def line_styles(labels: Iterable[str]) -> dict[str, LineStyle]:
    """A style for each label: colours first, then the same colours dashed.

    Earlier lines are broader, so that they show beneath a later one that covers them.
    """
    n, once = len(COLOURS), list(dict.fromkeys(labels))
    return {
        label: LineStyle(k % n, k // n % DASHES, 2.4 - 1.2 * k / max(len(once) - 1, 1))
        for k, label in enumerate(once)
    }


def legend(styles: Styles, labels: Iterable[str]) -> str:
    """Labels with their lines, in the order of the styles."""
    shown = set(labels)
    items = "".join(
        f'<li><svg class="chart" viewBox="0 0 30 10" aria-hidden="true">'
        f'<path class="l {style.kind}" stroke-width="2.4" d="M1 5h28"/></svg>{html.escape(label)}'
        "</li>"
        for label, style in styles.items()
        if label in shown
    )
    return f'<ul class="legend">{items}</ul>'
