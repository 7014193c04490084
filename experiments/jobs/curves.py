"""Learning curves of trainings and tunings, of one or of several seeds."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.jobs.job import Line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Runs = Mapping[int, Sequence[Line]]
"""Lines of each training, by its seed."""


class Curve(NamedTuple):
    """Figure of a line that is drawn over the budget; None where there is none."""

    label: str
    value: Callable[[Line], float | None]
    top: float | None = None
    """End of the axis; None: by the later half, since the first policies leave the road."""


def of_finished(line: Line, key: str) -> float | None:
    """Return a figure of a training's validation drives; None where no drive finished.

    A vehicle that leaves the road at once, or does not move, has small errors.
    """
    validation = line["validation"]
    value: float | None = validation.get(key) if validation["finished"] > 0.0 else None
    return value


TRAINING = (
    Curve("finished, % of validation drives", lambda line: 100.0 * line["validation"]["finished"],
          105.0),
    Curve("ALE m, mean of those that finished", lambda line: of_finished(line, "mean_ale")),
    Curve("steering variation rad, mean of those",
          lambda line: of_finished(line, "mean_steering_variation")),
)  # fmt: skip
TUNING = (Curve("score of the candidates", lambda line: line["score"]),)


def draw(runs: Runs, curves: Sequence[Curve], budget: str, file: Path) -> None:
    """Draw each curve in a panel: every training thin and, of several, their median thick.

    `budget` is the entry of a line that the curves are drawn over, "steps" or "solves". A training
    without a figure counts as the worst in the median.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    from experiments.figures import save_figure

    figure = Figure(figsize=(1.0 + 3.7 * len(curves), 3.6), layout="constrained")
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for axes, curve in zip(panels, curves, strict=True):
        _draw_curve(axes, runs, curve, budget)
        axes.set(xlabel=budget, ylabel=curve.label)
        axes.grid(alpha=0.3)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    handles, labels = panels[0].get_legend_handles_labels()
    if handles:
        panels[0].legend(handles, labels)
    last = [lines[-1] for lines in runs.values()]
    for axes in panels:
        axes.set_xlim(0.0, 1.03 * max(1, *(line[budget] for line in last)))
    seconds, solves = sum(line["seconds"] for line in last), sum(line["solves"] for line in last)
    several = f"{len(runs)} trainings, " if len(runs) > 1 else ""
    figure.suptitle(f"{several}{seconds:,.0f} s, {solves:,} NMPC solves")
    save_figure(figure, file)


def _draw_curve(axes: "Axes", runs: Runs, curve: Curve, budget: str) -> None:
    from experiments.figures import COLOURS

    several = len(runs) > 1
    own = {seed: values_of(lines, curve) for seed, lines in runs.items()}
    over = {seed: np.array([line[budget] for line in lines]) for seed, lines in runs.items()}
    for seed, lines in runs.items():
        colour, width = (COLOURS[5], 0.9) if several else (COLOURS[0], 1.5)
        axes.plot(over[seed], own[seed], color=colour, linewidth=width, marker=".", markersize=4)
        # In trainings alone: every step of a tuning may be better than the one before.
        kept = [k for k, line in enumerate(lines) if line.get("best") is True][-1:]
        label = "kept" if seed == next(iter(runs)) else None
        if kept:
            place = over[seed][kept], own[seed][kept]
            axes.plot(*place, "o", markersize=5, color=COLOURS[1], label=label)
    if several:
        shortest = min(map(len, runs.values()))
        shared = np.array([values[:shortest] for values in own.values()])
        middle = np.median([steps[:shortest] for steps in over.values()], axis=0)
        axes.plot(middle, median_of(shared), color=COLOURS[0], linewidth=2.4, label="median")
    if curve.top is not None:
        axes.set_ylim(-0.03 * curve.top, curve.top)
        return
    later = np.concatenate([values[len(values) // 2 :] for values in own.values()])
    known = later[np.isfinite(later)]
    if known.size and known.max() > 0.0:
        axes.set_ylim(0.0, 1.3 * known.max())
    elif not known.size:
        axes.set_ylim(0.0, 1.0)
        axes.text(0.5, 0.5, "no drive finished", ha="center", transform=axes.transAxes)


def values_of(lines: Sequence[Line], curve: Curve) -> Array:
    """Return a curve's figure of every line, NaN where there is none."""
    found = [curve.value(line) for line in lines]
    return np.array([np.nan if value is None else value for value in found])


def median_of(values: Array) -> Array:
    """Return the median over trainings (trainings, lines); a missing value counts as the worst."""
    found: Array = np.median(np.where(np.isnan(values), np.inf, values), axis=0)
    return np.where(np.isfinite(found), found, np.nan)
