"""`speed.png`: how times grow, from the contents of `speed.json` alone."""

import io
from collections.abc import Callable, Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.figures import COLOURS
from experiments.speed.measure import WINDOW_MEDIAN
from experiments.speed.tables import label

Result = Mapping[str, Any]
MARKERS = "os^Dv<>P"


def picture(result: Result) -> bytes | None:
    """PNG with a panel per section that scales or compares; None where nothing can be drawn."""
    panels = [
        (section, draw)
        for name, draw in PANELS.items()
        if (section := result["sections"].get(name)) and section["series"]
    ]
    if not panels:
        return None
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(7.0 * columns, 4.6 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for (section, draw), ax in zip(panels, axes, strict=False):
        draw(section, ax)
        ax.set_title(section["title"])
        ax.grid(visible=True, which="major", alpha=0.3)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    machine = result["machine"]
    commit = (machine["revision"]["commit"] or "unknown revision")[:10]
    figure.suptitle(
        f"lpv-track speed: {machine['processor']}, {machine['cores']} cores, {commit}; "
        "medians, bars from the least to the greatest round"
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _spread(series: list[Result], factor: float) -> tuple[list[float], list[list[float]]]:
    """Medians and the two lengths of their error bars."""
    middle = [factor * one["median"] for one in series]
    low = [factor * (one["median"] - one["min"]) for one in series]
    high = [factor * (one["max"] - one["median"]) for one in series]
    return middle, [low, high]


def _lines(section: Result, ax: Axes, key: str, factor: float) -> None:
    """A line per series over one of its settings, log-log."""
    groups: dict[str, list[Result]] = {}
    for series in section["series"]:
        if series["unit"] != WINDOW_MEDIAN:
            groups.setdefault(label(series, without=key), []).append(series)
    for k, (name, series) in enumerate(groups.items()):
        x = [one["settings"][key] for one in series]
        y, bars = _spread(series, factor)
        ax.errorbar(
            x, y, bars, label=name, color=COLOURS[k % len(COLOURS)],
            marker=MARKERS[k % len(MARKERS)], markersize=5, linewidth=1.5, capsize=2,
        )  # fmt: skip
    ax.set_yscale("log")
    ax.legend(fontsize="small")


def _bars(section: Result, ax: Axes, unit: str, factor: float) -> None:
    """A bar per series of a unit, on a logarithmic axis."""
    series = [one for one in section["series"] if one["unit"] == unit]
    middle, bars = _spread(series, factor)
    names = [label(one) for one in series]
    ax.barh(names, middle, xerr=bars, color=COLOURS[: len(series)], capsize=3)
    for k, value in enumerate(middle):
        ax.annotate(f" {value:.3g}", (value, k), va="bottom", fontsize="small")
    ax.set_xscale("log")
    ax.invert_yaxis()


def _single(section: Result, ax: Axes) -> None:
    _bars(section, ax, "s/step", 1e6)
    ax.set_xlabel("µs per step, logarithmic")


def _vector(section: Result, ax: Axes) -> None:
    _lines(section, ax, "n", 1e9)
    ax.set_xscale("log", base=2)
    ax.set_xlabel("environments")
    ax.set_ylabel("ns per env-step")


def _solvers(section: Result, ax: Axes) -> None:
    _bars(section, ax, "s/predict", 1e3)
    ax.set_xlabel("ms per predict, median with least and greatest, logarithmic")


def _horizons(section: Result, ax: Axes) -> None:
    _lines(section, ax, "horizon", 1e3)
    ax.set_xlabel("horizon N, periods")
    ax.set_ylabel("ms per predict")


def _batches(section: Result, ax: Axes) -> None:
    _lines(section, ax, "n", 1e3)
    ax.set_xscale("log", base=2)
    ax.set_xlabel("observations in a batch")
    ax.set_ylabel("ms per solve")


PANELS: dict[str, Callable[[Result, Axes], None]] = {
    "single": _single,
    "vector": _vector,
    "solvers": _solvers,
    "horizons": _horizons,
    "batches": _batches,
}
"""What draws a section."""
