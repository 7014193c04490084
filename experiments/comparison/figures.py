"""Figures of comparisons that go into a paper as they are: legible in grey and without colour."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from experiments.comparison.outcomes import Metric, Outcome
from experiments.figures import COLOURS, STYLE, plain_ticks, save_figure
from experiments.run.statistics import Interval
from trajectories.arguments import shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTHS = {"column": 3.5, "page": 7.16}
"""Widths of a column and of a page of two columns, in."""
PANELS = {"column": 2, "page": 4}
"""Panels beside each other."""
PRINT: dict[str, Any] = {
    **STYLE,
    "font.size": 7.0,
    "axes.titlesize": 7.0,
    "legend.fontsize": 7.0,
    "lines.linewidth": 1.0,
    "lines.solid_capstyle": "butt",
    # Fonts are embedded in PDF as TrueType, and drawn as outlines in SVG.
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "lpv-track",
}
SUFFIXES = (".svg", ".pdf")
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)))
MARKS = ("o", "s", "^", "D", "v", "P", "X")
NARROW, WIDE = 10.0, 100.0
"""Ratios of the ends of an axis: a narrow one is linear, a wide one labelled at powers of ten.

So that two labels at least fit on each: with fewer, Matplotlib chooses labels that overlap.
"""
MOST_LINEAR, LINEAR = 200.0, 10.0
"""Relative difference beyond which their axis is logarithmic, and its linear part at 0, %."""
LONGEST = 40
"""Characters of a name in a legend."""


class _Curve(NamedTuple):
    """Curve of a performance profile; all figures draw a competitor in the same colour."""

    name: str
    colour: int
    metric: Metric
    shares: list[Interval]


def write_figures(outcomes: Sequence[Outcome], folder: Path, width: str) -> list[str]:
    """Write performance profiles, differences and probabilities of improvement; return names.

    `width` is one of `WIDTHS`; every figure is written as SVG and as PDF.
    """
    names = []
    with mpl.rc_context(cast("Any", PRINT)):
        for name, figure in (
            ("profiles", profiles(outcomes, width)),
            ("differences", differences(outcomes, width)),
            ("improvement", improvement(outcomes, width)),
        ):
            for suffix in SUFFIXES:
                save_figure(figure, folder / f"{name}{suffix}")
                names.append(f"{name}{suffix}")
    return names


def profiles(outcomes: Sequence[Outcome], width: str) -> Figure:
    """Draw a panel for each metric: the share of drives up to each value, with 95 % bands."""
    keys = list(dict.fromkeys(one.measure.key for outcome in outcomes for one in outcome.metrics))
    columns = min(PANELS[width], len(keys))
    rows = math.ceil(len(keys) / columns)
    figure = Figure(layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[len(keys) :]:
        panel.remove()
    for place, (panel, key) in enumerate(zip(panels, keys, strict=False)):
        _profile(panel, outcomes, key)
        panel.set_ylabel("" if place % columns else "share of drives")
    handles, names = panels[0].get_legend_handles_labels()
    lines = math.ceil(len(names) / columns)
    figure.set_size_inches(WIDTHS[width], 0.2 + 0.15 * lines + 1.25 * rows)
    figure.legend(handles, names, loc="outside upper left", ncols=columns, frameon=False)
    return figure


def _profile(panel: "Axes", outcomes: Sequence[Outcome], key: str) -> None:
    """Draw the curves of a metric: one of each baseline, then one of each competitor."""
    found = [
        (place, outcome, one)
        for place, outcome in enumerate(outcomes)
        for one in outcome.metrics
        if one.measure.key == key
    ]
    # A baseline has another curve where it meets others on other drives.
    bases = {(outcome.a.label, tuple(outcome.drives)) for outcome in outcomes}
    baselines: dict[Any, _Curve] = {}
    competitors = []
    for place, outcome, one in found:
        own, other = _names(outcome)
        if len(bases) > len({label for label, _ in bases}):
            own = f"{own}, {len(outcome.drives)} drives"
        basis = outcome.a.folder, outcome.a.label, tuple(outcome.drives)
        baselines.setdefault(basis, _Curve(own, 0, one, one.profile.a))
        competitors.append(_Curve(other, place + 1, one, one.profile.b))
    measure = found[0][2].measure
    levels = np.concatenate([one.profile.levels for *_, one in found])
    relation = "≤" if measure.sign > 0.0 else "≥"
    unit = f" {measure.unit}" if measure.unit else ""
    panel.set_xlabel(f"{measure.heading} {relation} x{unit}")
    panel.set_ylim(-0.02, 1.02)
    if not len(levels):
        return
    # The axis runs towards worse values also where more is better.
    end = float(levels.max())
    curves = [*baselines.values(), *competitors]
    for place, (name, colour_place, one, shares) in enumerate(curves):
        x = measure.sign * np.append(one.profile.levels, end)
        value, low, high = (
            np.array([getattr(share, part) for share in (*shares, shares[-1])])
            for part in ("value", "low", "high")
        )
        colour = COLOURS[colour_place % len(COLOURS)]
        panel.step(
            x, value, where="post", color=colour, linestyle=LINES[place % len(LINES)], label=name
        )
        panel.fill_between(x, low, high, step="post", color=colour, alpha=0.15, linewidth=0.0)
    ratio = end / float(levels.min()) if levels.min() > 0.0 else 1.0
    if ratio > NARROW:
        panel.set_xscale("log")
        plain_ticks(panel.xaxis, (1.0,) if ratio > WIDE else (1.0, 3.0))
        panel.xaxis.set_minor_locator(NullLocator())
    else:
        panel.xaxis.set_major_locator(MaxNLocator(4))
    if measure.sign < 0.0:
        panel.invert_xaxis()


def differences(outcomes: Sequence[Outcome], width: str) -> Figure:
    """Draw the relative differences of all metrics with their intervals, %."""

    def percent(metric: Metric) -> Interval:
        one = metric.relative
        return Interval(100.0 * one.value, 100.0 * one.low, 100.0 * one.high)

    figure, panel = _forest(outcomes, width, percent, 0.0)
    panel.set_xlabel("difference to the baseline, % of its mean")
    if max(map(abs, panel.get_xlim())) > MOST_LINEAR:
        # One hopeless competitor would press all others onto the line at 0.
        panel.set_xscale("symlog", linthresh=LINEAR)
        panel.xaxis.set_major_formatter("{x:g}")
    return figure


def improvement(outcomes: Sequence[Outcome], width: str) -> Figure:
    """Draw the probability that a competitor is better than its baseline, by metric."""
    figure, panel = _forest(outcomes, width, lambda metric: metric.improvement, 0.5)
    panel.set_xlabel("probability of improvement over the baseline")
    panel.set_xlim(-0.02, 1.02)
    return figure


def _forest(
    outcomes: Sequence[Outcome], width: str, of: Callable[[Metric], Interval], neutral: float
) -> tuple[Figure, "Axes"]:
    """Draw an interval for each metric and comparison, and a line where neither side is better."""
    measures = {one.measure.key: one.measure for outcome in outcomes for one in outcome.metrics}
    rows = {key: place for place, key in enumerate(measures)}
    height = len(measures) * (0.1 + 0.1 * len(outcomes))
    figure = Figure(figsize=(WIDTHS[width], 0.6 + 0.12 * len(outcomes) + height))
    figure.set_layout_engine("constrained")
    panel = figure.subplots()
    panel.axvline(neutral, color="0.3", linewidth=0.8)
    for place, outcome in enumerate(outcomes):
        shift = (place - (len(outcomes) - 1) / 2) * 0.7 / len(outcomes)
        colour = COLOURS[(place + 1) % len(COLOURS)]
        own, other = _names(outcome)
        label = f"{other} against {own}"
        for metric in outcome.metrics:
            one, y = of(metric), rows[metric.measure.key] + shift
            if not math.isfinite(one.value):
                continue
            panel.plot(
                [one.low, one.high], [y, y], color=colour, linewidth=1.4, solid_capstyle="butt"
            )
            panel.plot(
                [one.value], [y], MARKS[place % len(MARKS)], color=colour, markersize=3.5,
                markeredgewidth=0.0, label=label,
            )  # fmt: skip
            label = ""
        if label:
            panel.plot([], [], " ", label=f"{label}: no drive passed by both")
    panel.set_yticks(range(len(measures)), [f"{m.heading} {m.better}" for m in measures.values()])
    panel.set_ylim(len(measures) - 0.5, -0.5)
    panel.grid(visible=False, axis="y")
    figure.legend(loc="outside upper left", ncols=PANELS[width] // 2, frameon=False)
    return figure, panel


def _names(outcome: Outcome) -> tuple[str, str]:
    """Return the names of both sides, with their folders where the agents are namesakes."""
    a, b = outcome.a, outcome.b
    if a.folder == b.folder:
        return shortened(a.label, LONGEST), shortened(b.label, LONGEST)
    own, other = a.folder.name, b.folder.name
    if a.label == b.label and own != other:
        return f"{shortened(a.label, LONGEST)}, {own}", f"{shortened(b.label, LONGEST)}, {other}"
    return f"{shortened(a.label, LONGEST)} ({own})", f"{shortened(b.label, LONGEST)} ({other})"
