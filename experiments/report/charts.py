"""Charts as small SVG texts, their colours left to the page's style sheet.

A chart is a plot area with two axes. Lines are thinned to what a screen shows and written as whole
tenths of a pixel, so that a page can hold hundreds of them; the plot area is an SVG of its own,
which clips what it holds. Classes, not colours, are written: `c0` to `c6` are series, `d0` to `d3`
dashes, `broad` a reference, `limit` a bound. The same data give the same text.
"""

import html
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from experiments.report.scales import Scale

Array = NDArray[np.float64]

WIDTH = 340.0
"""Of a chart, in its own units: about the CSS pixels of a panel."""
LEFT, RIGHT, TOP, BOTTOM = 50.0, 9.0, 8.0, 34.0
FINE = 10
"""Units of the plot area per unit of the chart."""
POINTS = 400
"""Most points of a line before those that nobody can tell from a straight line go."""
TOLERANCE = 0.25
"""px, how far a thinned line may be from its points."""


def decimate(values: Array, limit: int = POINTS) -> NDArray[np.intp]:
    """Indices of at most `limit` of (n,) values: the ends, and each bucket's least and greatest."""
    n = len(values)
    if n <= limit:
        return np.arange(n)
    edges = np.linspace(1, n - 1, (limit - 2) // 2 + 1).astype(int)
    kept = [0, n - 1]
    for start, stop in pairwise(edges):
        part = values[start:stop]
        kept += [start + int(part.argmin()), start + int(part.argmax())]
    return np.unique(kept)


def spread(n: int, limit: int = POINTS) -> NDArray[np.intp]:
    """At most `limit` indices evenly over n, ends included."""
    return np.unique(np.linspace(0, n - 1, min(n, limit)).astype(int))


def simplify(points: Array, tolerance: float) -> Array:
    """Points (n, 2) without those that a polyline through the rest passes within `tolerance`.

    Douglas and Peucker's, with a stack in place of recursion.
    """
    n = len(points)
    kept = np.zeros(n, dtype=bool)
    kept[[0, n - 1]] = True
    stack = [(0, n - 1)]
    while stack:
        first, last = stack.pop()
        if last - first < 2:
            continue
        inner = points[first + 1 : last] - points[first]
        chord = points[last] - points[first]
        length = float(chord @ chord)
        along = np.clip(inner @ chord / length, 0.0, 1.0) if length > 0.0 else np.zeros(len(inner))
        away = ((inner - along[:, None] * chord) ** 2).sum(axis=1)
        place = int(away.argmax())
        if away[place] > tolerance**2:
            middle = first + 1 + place
            kept[middle] = True
            stack += [(first, middle), (middle, last)]
    return points[kept]


def polyline(points: NDArray[np.int_]) -> str:
    """Path data of whole-numbered points (n, 2): absolute start, relative steps."""
    steps = np.diff(points, axis=0)
    moved: list[int] = steps[(steps != 0).any(axis=1)].ravel().tolist()
    rest = "".join(f"{step}" if step < 0 else f" {step}" for step in moved or (0, 0))
    return f"M{points[0, 0]} {points[0, 1]}l{rest.lstrip()}"


class Chart:
    """A plot area with axes, to which lines and marks are added.

    Parameters
    ----------
    x, y
        Scales of the axes.
    x_label, y_label
        Their words, with units.
    height
        Of the whole chart, in its own units; `WIDTH` is its width.
    x_names, y_names
        Words in place of numbers at 0, 1, 2, ... of an axis.
    left
        Room for the y axis.
    """

    def __init__(
        self,
        x: Scale,
        y: Scale,
        *,
        x_label: str = "",
        y_label: str = "",
        height: float = 190.0,
        x_names: Sequence[str] = (),
        y_names: Sequence[str] = (),
        left: float = LEFT,
    ) -> None:
        self.x, self.y = x, y
        self.labels = x_label, y_label
        self.names = x_names, y_names
        self.height, self.left = height, left
        self.plot_width = WIDTH - left - RIGHT
        self.plot_height = height - TOP - BOTTOM
        self.inside: list[str] = []
        self.above: list[str] = []

    def across(self, values: Array | float) -> Array:
        """Places along x, in units of the plot area."""
        return np.asarray(self.x.share(values)) * self.plot_width * FINE

    def down(self, values: Array | float) -> Array:
        """Places along y, in units of the plot area, from its top."""
        return (1.0 - np.asarray(self.y.share(values))) * self.plot_height * FINE

    def line(self, x: Array, y: Array, kind: str, width: float | None = None) -> None:
        """A line through (n,) and (n,), in the order given; where y is not finite it is broken."""
        finite = np.isfinite(x) & np.isfinite(y)
        edges = np.flatnonzero(np.diff(np.r_[False, finite, False].astype(int)))
        parts = []
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            # Far outside it is clipped anyway, and whole numbers stay small.
            points = np.column_stack([self.across(x[start:stop]), self.down(y[start:stop])])
            points = np.clip(points, -1e4, 2e4)
            parts.append(polyline(np.rint(simplify(points, TOLERANCE * FINE)).astype(int)))
        if parts:
            broad = f' stroke-width="{width:.1f}"' if width is not None else ""
            self.inside.append(f'<path class="l {kind}"{broad} d="{"".join(parts)}"/>')

    def course(self, x: Array, y: Array, kind: str, width: float | None = None) -> None:
        """A line through samples (n,) of y over a rising x, thinned to the extremes."""
        kept = decimate(y)
        self.line(x[kept], y[kept], kind, width)

    def bands(self, x: Array, inside: NDArray[np.bool_], kind: str) -> None:
        """The full height shaded over runs of samples (n,) that are `inside`."""
        edges = np.flatnonzero(np.diff(np.r_[False, inside, False].astype(int)))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            low, high = self.across(x[start]), self.across(x[min(stop, len(x) - 1)])
            self.inside.append(
                f'<path class="{kind}" d="M{low:.0f} 0h{high - low:.0f}'
                f'v{self.plot_height * FINE:.0f}h{low - high:.0f}z"/>'
            )

    def rule(self, *, x: float | None = None, y: float | None = None, kind: str = "limit") -> None:
        """A straight line through the whole plot area at an x or a y."""
        if x is not None:
            data = f"M{self.across(x):.0f} 0v{self.plot_height * FINE:.0f}"
        else:
            data = f"M0 {self.down(float(y or 0.0)):.0f}h{self.plot_width * FINE:.0f}"
        self.inside.append(f'<path class="l {kind}" d="{data}"/>')

    def segment(self, x: tuple[float, float], y: tuple[float, float], kind: str) -> None:
        """A straight line between two points, not thinned."""
        a, b = self.across(np.array(x)), self.down(np.array(y))
        self.inside.append(
            f'<path class="l {kind}" d="M{a[0]:.0f} {b[0]:.0f}L{a[1]:.0f} {b[1]:.0f}"/>'
        )

    def dot(self, x: float, y: float, kind: str, radius: float = 3.0) -> None:
        """A disc at a point."""
        self.inside.append(
            f'<circle class="{kind}" cx="{self.across(x):.0f}" cy="{self.down(y):.0f}" '
            f'r="{radius * FINE:.0f}"/>'
        )

    def cross(self, x: float, y: float, kind: str) -> None:
        """An × at a point."""
        a, b = self.across(x), self.down(y)
        self.inside.append(
            f'<path class="l {kind} mark" d="M{a - 40:.0f} {b - 40:.0f}l80 80m0-80l-80 80"/>'
        )

    def note(self, words: str, x: float, y: float, kind: str = "", anchor: str = "start") -> None:
        """Words at a point of the plot area, over everything else."""
        across, down = self.left + self.across(x) / FINE, TOP + self.down(y) / FINE
        self.above.append(
            f'<text class="{kind}" x="{across:.1f}" y="{down:.1f}" text-anchor="{anchor}">'
            f"{html.escape(words)}</text>"
        )

    def svg(self) -> str:
        """The chart as SVG text."""
        right, floor = self.left + self.plot_width, TOP + self.plot_height
        parts = [
            f'<svg class="chart" viewBox="0 0 {WIDTH:g} {self.height:g}" aria-hidden="true">',
            *self._axes(right, floor),
            (
                f'<svg x="{self.left:g}" y="{TOP:g}" width="{self.plot_width:g}" '
                f'height="{self.plot_height:g}" viewBox="0 0 {self.plot_width * FINE:g} '
                f'{self.plot_height * FINE:g}">'
            ),
            *self.inside,
            "</svg>",
            *self.above,
            "</svg>",
        ]
        return "".join(parts)

    def _axes(self, right: float, floor: float) -> Iterable[str]:
        grid, texts = [], []
        for place, words in self._ticks(0):
            x = self.left + float(self.across(place)) / FINE
            grid.append(f"M{x:.1f} {TOP:g}V{floor:g}")
            texts.append(
                f'<text x="{x:.1f}" y="{floor + 13:g}" text-anchor="middle">{words}</text>'
            )
        for place, words in self._ticks(1):
            y = TOP + float(self.down(place)) / FINE
            grid.append(f"M{self.left:g} {y:.1f}H{right:g}")
            texts.append(
                f'<text x="{self.left - 4:g}" y="{y + 3.5:.1f}" text-anchor="end">{words}</text>'
            )
        x_label, y_label = (html.escape(label) for label in self.labels)
        if x_label:
            texts.append(
                f'<text x="{0.5 * (self.left + right):g}" y="{self.height - 5:g}" '
                f'text-anchor="middle">{x_label}</text>'
            )
        if y_label:
            middle = 0.5 * (TOP + floor)
            texts.append(
                f'<text transform="translate(10.5 {middle:g}) rotate(-90)" '
                f'text-anchor="middle">{y_label}</text>'
            )
        frame = f"M{self.left:g} {TOP:g}V{floor:g}H{right:g}"
        return (
            f'<path class="grid" d="{"".join(grid)}"/><path class="frame" d="{frame}"/>',
            *texts,
        )

    def _ticks(self, axis: int) -> list[tuple[float, str]]:
        names, scale = self.names[axis], (self.x, self.y)[axis]
        if names:
            return [(float(k), html.escape(name)) for k, name in enumerate(names)]
        size = (self.plot_width / 52.0, self.plot_height / 26.0)[axis]
        return [(value, scale.words(value)) for value in scale.ticks(max(2, int(size)))]
