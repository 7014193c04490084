"""`speed.png`: how times grow, from the contents of `speed.json` alone."""

from collections.abc import Callable, Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure

from experiments.figures import COLOURS, plain_ticks
from experiments.speed.tables import differing, label, leading, quantity

Result = Mapping[str, Any]
MARKERS = "os^Dv<>P"
DECADE = 10.0


def picture(result: Result) -> Figure | None:
    """Figure with a panel per section that scales or compares; None where nothing can be drawn."""
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
    return figure


def _spread(series: list[Result], factor: float) -> tuple[list[float], list[list[float]]]:
    """Medians and the two lengths of their error bars."""
    middle = [factor * one["median"] for one in series]
    low = [factor * (one["median"] - one["min"]) for one in series]
    high = [factor * (one["max"] - one["median"]) for one in series]
    return middle, [low, high]


def _lines(section: Result, ax: Axes, key: str, factor: float) -> None:
    """A line per series over one of its settings, its values logarithmic."""
    keys = differing(section) - {key}
    groups: dict[str, list[Result]] = {}
    for one in leading(section):
        groups.setdefault(label(one, keys), []).append(one)
    for k, (name, series) in enumerate(groups.items()):
        x = [one["settings"][key] for one in series]
        y, bars = _spread(series, factor)
        ax.errorbar(
            x, y, bars, label=name, color=COLOURS[k % len(COLOURS)],
            marker=MARKERS[k % len(MARKERS)], markersize=5, linewidth=1.5, capsize=2,
        )  # fmt: skip
    ax.set_xticks(sorted({one["settings"][key] for one in section["series"]}))
    ax.set_yscale("log")
    _plain(ax.yaxis)
    ax.legend(fontsize="small")


def _dots(section: Result, ax: Axes, factor: float) -> None:
    """A dot per series on a logarithmic axis, its 99th percentile as a stroke."""
    series = leading(section)
    middle, (low, high) = _spread(series, factor)
    for k, one in enumerate(series):
        colour = COLOURS[k % len(COLOURS)]
        ax.errorbar(
            [middle[k]], [k], xerr=[[low[k]], [high[k]]], color=colour, marker="o", capsize=3
        )
        if "p99" in one:
            ax.plot([factor * one["p99"]], [k], color=colour, marker="|", markersize=16)
        text = quantity(one["median"], one["unit"])
        ax.annotate(text, (middle[k], k), (0, 6), textcoords="offset points", ha="center")
    ax.set_yticks(range(len(series)), [label(one, differing(section)) for one in series])
    ax.set_ylim(len(series) - 0.5, -0.5)
    ax.set_xscale("log")
    _plain(ax.xaxis)


def _plain(axis: Axis) -> None:
    """Plain numbers at 1, 2 and 5 of every decade of a logarithmic axis, or at more of a part."""
    low, high = axis.get_view_interval()
    subs = (1.0, 2.0, 5.0) if high > DECADE * low else tuple(range(1, 10))
    plain_ticks(axis, subs)


def _doubling(ax: Axes, what: str) -> None:
    """A logarithmic x axis of numbers that are each written out."""
    ticks = ax.get_xticks()
    ax.set_xscale("log", base=2)
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_xlabel(what)


def _single(section: Result, ax: Axes) -> None:
    _dots(section, ax, 1e6)
    ax.set_xlabel("µs per step")


def _vector(section: Result, ax: Axes) -> None:
    _lines(section, ax, "n", 1e9)
    _doubling(ax, "environments stepped together")
    ax.set_ylabel("ns per env-step")


def _solvers(section: Result, ax: Axes) -> None:
    _dots(section, ax, 1e3)
    ax.set_xlabel("ms per predict (stroke: 99th percentile)")


def _horizons(section: Result, ax: Axes) -> None:
    _lines(section, ax, "horizon", 1e3)
    ax.set_xlabel("horizon N, periods")
    ax.set_ylabel("ms per predict")


def _batches(section: Result, ax: Axes) -> None:
    _lines(section, ax, "n", 1e3)
    _doubling(ax, "observations in a batch")
    ax.set_ylabel("ms per solve")


def _loops(section: Result, ax: Axes) -> None:
    _lines(section, ax, "n", 1e6)
    _doubling(ax, "environments in a call")
    ax.set_ylabel("µs per environment and control period")


def _tuning(section: Result, ax: Axes) -> None:
    _lines(section, ax, "n", 1e6)
    _doubling(ax, "environments in a call")
    ax.set_ylabel("µs per decision")


PANELS: dict[str, Callable[[Result, Axes], None]] = {
    "single": _single,
    "vector": _vector,
    "solvers": _solvers,
    "horizons": _horizons,
    "batches": _batches,
    "loops": _loops,
    "tuning": _tuning,
}
"""What draws a section."""
