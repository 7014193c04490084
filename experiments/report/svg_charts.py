"""Charts as small SVG texts whose colours come from the page's style sheet.

A chart is a plot area with two axes. Lines are thinned to the resolution of a screen and written
in whole tenths of a pixel, so that a page can hold hundreds of them; the plot area is an SVG of its
own, which clips its content. Elements have classes instead of colours: `c0` to `c6` are series,
`d0` to `d3` dashes, `broad` a reference, `limit` a bound. The same data give the same text.
"""

import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from experiments.report.page import LineStyle

Array = NDArray[np.float64]

MARGIN = 0.05
"""Share of a range added at each end of an axis."""
WIDTH = 340.0
"""Width of a chart in its own units, roughly CSS pixels."""
LEFT, RIGHT, TOP, BOTTOM = 50.0, 9.0, 8.0, 34.0
FINE = 10
"""Units of the plot area per unit of the chart."""
POINTS = 400
"""Samples of a line kept before points on a straight line are removed."""
TOLERANCE = 0.25
"""Largest distance between a thinned line and its points, px."""


@dataclass(frozen=True)
class Scale:
    """Axis from `low` (share 0) to `high` (share 1); both positive if logarithmic."""

    low: float
    high: float
    log: bool = False

    def share(self, values: ArrayLike) -> Array:
        """Return positions along the axis, any shape: 0 at `low`, 1 at `high`, not clipped.

        On a logarithmic axis, values that are not positive lie far below 0.
        """
        given = np.asarray(values, dtype=float)
        if not self.log:
            return (given - self.low) / (self.high - self.low)
        lowest = math.log10(self.low)
        logs = np.log10(np.maximum(given, 1e-30))
        return np.asarray((logs - lowest) / (math.log10(self.high) - lowest))

    def ticks(self, count: int) -> list[float]:
        """Return about `count` round numbers in range, 1, 2 or 5 times a power of ten apart."""
        if self.log:
            return self._decades(count)
        rough = (self.high - self.low) / count
        power = 10.0 ** math.floor(math.log10(rough))
        step = power * next(factor for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]

    def _decades(self, count: int) -> list[float]:
        first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high))
        every = max(1, -(-(last - first + 1) // max(count, 1)))
        decades = [10.0**k for k in range(first, last + 1, every)]
        if len(decades) >= 2:
            return decades
        fine: list[float] = []
        for factors in ((1.0, 2.0, 5.0), (1.0, 2.0, 3.0, 5.0, 7.0)):
            fine = [
                value
                for k in range(first - 1, last + 1)
                for factor in factors
                if self.low <= (value := factor * 10.0**k) <= self.high
            ]
            if len(fine) > 2:
                return fine
        return fine if len(fine) > 1 else Scale(self.low, self.high).ticks(count)

    @staticmethod
    def words(value: float) -> str:
        """Return the label of a tick; large numbers as 10k or 1M."""
        for least, size, unit in ((1e6, 1e6, "M"), (1e4, 1e3, "k")):
            if abs(value) >= least:
                return f"{value / size:.4g}{unit}"
        text = f"{value:.6g}"
        return "0" if text == "-0" else text.replace("-", "\N{MINUS SIGN}")


def around(values: Iterable[ArrayLike], *, zero: bool = False, least: float = 1e-9) -> Scale:
    """Return a linear scale over all finite values with a margin; it includes 0 if `zero`."""
    low, high = _ends(values)
    if zero:
        low = min(low, 0.0)
    width = max(high - low, least)
    middle = 0.5 * (low + high)
    low, high = min(low, middle - 0.5 * width), max(high, middle + 0.5 * width)
    return Scale(low if zero and low == 0.0 else low - MARGIN * width, high + MARGIN * width)


def exactly(values: Iterable[ArrayLike]) -> Scale:
    """Return a linear scale from the smallest to the largest value, without a margin."""
    low, high = _ends(values)
    return Scale(low, high if high > low else low + 1.0)


def decades(values: Iterable[ArrayLike], floor: float) -> Scale:
    """Return a logarithmic scale over all values, those below `floor` raised to it."""
    low, high = _ends(np.maximum(np.asarray(one, dtype=float), floor) for one in values)
    room = max((high / low) ** MARGIN, 1.15)
    return Scale(low / room, high * room, log=True)


def _ends(values: Iterable[ArrayLike]) -> tuple[float, float]:
    flat = [np.ravel(np.asarray(one, dtype=float)) for one in values]
    every = np.concatenate(flat) if flat else np.zeros(0)
    every = every[np.isfinite(every)]
    return (float(every.min()), float(every.max())) if every.size else (0.0, 1.0)


def decimate(values: Array, limit: int = POINTS) -> NDArray[np.intp]:
    """Return at most `limit` indices of values (n,): both ends and the extremes of each bucket."""
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
    """Return at most `limit` indices spaced evenly over n samples, ends included."""
    return np.unique(np.linspace(0, n - 1, min(n, limit)).astype(int))


def simplify(points: Array, tolerance: float) -> Array:
    """Remove points (n, 2) that lie within `tolerance` of the polyline through the others.

    Douglas-Peucker algorithm, with a stack in place of recursion.
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
    """Return SVG path data of integer points (n, 2): absolute start, relative steps."""
    steps = np.diff(points, axis=0)
    moved: list[int] = steps[(steps != 0).any(axis=1)].ravel().tolist()
    rest = "".join(f"{step}" if step < 0 else f" {step}" for step in moved or (0, 0))
    return f"M{points[0, 0]} {points[0, 1]}l{rest.lstrip()}"


class Chart:
    """Plot area with axes, to which lines and marks are added.

    Parameters
    ----------
    x, y
        Scales.
    x_label, y_label
        Axis labels, with units.
    height
        Height of the whole chart, in its own units (its width is `WIDTH`).
    x_names, y_names
        Labels in place of numbers at 0, 1, 2, ... of an axis.
    left
        Space for the labels of the y axis.
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
        """Return horizontal positions of x values, in units of the plot area."""
        return np.asarray(self.x.share(values)) * self.plot_width * FINE

    def down(self, values: Array | float) -> Array:
        """Return vertical positions of y values, in units of the plot area, from its top."""
        return (1.0 - np.asarray(self.y.share(values))) * self.plot_height * FINE

    def line(self, x: Array, y: Array, kind: str, width: float | None = None) -> None:
        """Draw a line through points x (n,), y (n,) in order, broken where one is not finite."""
        finite = np.isfinite(x) & np.isfinite(y)
        edges = np.flatnonzero(np.diff(np.r_[False, finite, False].astype(int)))
        parts = []
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            # Points far outside are clipped anyway; the limits keep the numbers short.
            points = np.column_stack([self.across(x[start:stop]), self.down(y[start:stop])])
            points = np.clip(points, -1e4, 2e4)
            parts.append(polyline(np.rint(simplify(points, TOLERANCE * FINE)).astype(int)))
        if parts:
            broad = f' stroke-width="{width:.1f}"' if width is not None else ""
            self.inside.append(f'<path class="l {kind}"{broad} d="{"".join(parts)}"/>')

    def course(self, x: Array, y: Array, kind: str, width: float | None = None) -> None:
        """Draw samples y (n,) over a rising x (n,), thinned with their extremes kept."""
        kept = decimate(y)
        self.line(x[kept], y[kept], kind, width)

    def bands(self, x: Array, inside: NDArray[np.bool_], kind: str) -> None:
        """Shade the full height over runs of samples (n,) that are `inside`."""
        edges = np.flatnonzero(np.diff(np.r_[False, inside, False].astype(int)))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            low, high = self.across(x[start]), self.across(x[min(stop, len(x) - 1)])
            self.inside.append(
                f'<path class="{kind}" d="M{low:.0f} 0h{high - low:.0f}'
                f'v{self.plot_height * FINE:.0f}h{low - high:.0f}z"/>'
            )

    def rule(self, *, x: float | None = None, y: float | None = None, kind: str = "limit") -> None:
        """Draw a straight line across the whole plot area at an x or a y."""
        if x is not None:
            data = f"M{self.across(x):.0f} 0v{self.plot_height * FINE:.0f}"
        else:
            data = f"M0 {self.down(float(y or 0.0)):.0f}h{self.plot_width * FINE:.0f}"
        self.inside.append(f'<path class="l {kind}" d="{data}"/>')

    def segment(self, x: tuple[float, float], y: tuple[float, float], kind: str) -> None:
        """Draw a straight line between two points."""
        a, b = self.across(np.array(x)), self.down(np.array(y))
        self.inside.append(
            f'<path class="l {kind}" d="M{a[0]:.0f} {b[0]:.0f}L{a[1]:.0f} {b[1]:.0f}"/>'
        )

    def dot(self, x: float, y: float, kind: str, radius: float = 3.0) -> None:
        """Draw a disc at a point."""
        self.inside.append(
            f'<circle class="{kind}" cx="{self.across(x):.0f}" cy="{self.down(y):.0f}" '
            f'r="{radius * FINE:.0f}"/>'
        )

    def interval(self, x: float, interval: tuple[float, float, float], style: LineStyle) -> None:
        """Draw a vertical line over (low, middle, high) with a mark at the middle.

        The mark is hollow where the style's lines are dashed, since colours repeat.
        """
        low, middle, high = interval
        if high > low:
            self.segment((x, x), (low, high), f"c{style.colour} mark")
        kind = f"hollow c{style.colour}" if style.dashes else f"f{style.colour}"
        self.dot(x, middle, kind, 2.6)

    def cross(self, x: float, y: float, kind: str) -> None:
        """Draw an × at a point."""
        a, b = self.across(x), self.down(y)
        self.inside.append(
            f'<path class="l {kind} mark" d="M{a - 40:.0f} {b - 40:.0f}l80 80m0-80l-80 80"/>'
        )

    def note(self, words: str, x: float, y: float, kind: str = "", anchor: str = "start") -> None:
        """Write words at a point of the plot area, above everything else."""
        across, down = self.left + self.across(x) / FINE, TOP + self.down(y) / FINE
        self.above.append(
            f'<text class="{kind}" x="{across:.1f}" y="{down:.1f}" text-anchor="{anchor}">'
            f"{html.escape(words)}</text>"
        )

    def svg(self) -> str:
        """Return the chart as SVG text."""
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
