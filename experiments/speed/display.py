"""Tables and figure of `lpv-track speed`, from the contents of `speed.json` alone."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from experiments.figures import COLOURS, plain_ticks
from experiments.speed.measure import PREDICT, WINDOW_MEDIAN

Result = Mapping[str, Any]

ROW_SETTINGS = ("n", "horizon")
"""Settings that become the rows of a section's table if its series differ in them."""
SCALES = ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (1e-9, "ns"))
BUSY = 0.5
"""Load per core from which on the machine counts as busy."""
MARKERS = "os^Dv<>P"
DECADE = 10.0


class Panel(NamedTuple):
    """Panel of a section in the figure: lines over a setting, or a dot per series."""

    factor: float
    """Multiplies the measured seconds to give the panel's unit."""
    values: str
    """Label of the axis of the values."""
    setting: str = ""
    """Setting on the x axis; a dot per series without one."""
    setting_label: str = ""
    doubling: bool = True
    """True if the x axis is logarithmic."""


PANELS = {
    "single": Panel(1e6, "µs per step"),
    "vector": Panel(1e9, "ns per env-step", "n", "environments stepped together"),
    "solvers": Panel(1e3, "ms per predict (stroke: 99th percentile)"),
    "horizons": Panel(1e3, "ms per predict", "horizon", "stages N", doubling=False),
    "batches": Panel(1e3, "ms per solve", "n", "observations in a batch"),
    "loops": Panel(
        1e6, "µs per environment and control period", "n", "environments in a call"
    ),
    "tuning": Panel(1e6, "µs per decision", "n", "environments in a call"),
}  # fmt: skip


def quantity(value: float, unit: str) -> str:
    """Format a value with three digits: seconds in a fitting multiple, bytes in MiB or B."""
    if unit.startswith("bytes"):
        return f"{value / 2**20:.1f} MiB" if value >= 2**20 else f"{value:.0f} B"
    if unit.startswith("share"):
        return f"{100.0 * value:.1f} %"
    scale, name = next((pair for pair in SCALES if value >= pair[0]), SCALES[-1])
    digits = ".3g" if value < 999.5 * scale else ".0f"
    return f"{value / scale:{digits}} {name}"


def rate(seconds: float) -> str:
    """Format the number of times per second from the seconds of one."""
    times = 1.0 / seconds
    for scale, name in ((1e6, " M"), (1e3, " k")):
        if times >= scale:
            return f"{times / scale:.3g}{name}/s"
    return f"{times:.3g}/s"


def ratio(found: Result | None) -> str:
    """Format median and range of a ratio: how many times as long as ours."""
    if found is None:
        return ""
    return f"x {found['median']:.3g} ({found['min']:.3g}..{found['max']:.3g})"


def ratio_of(section: Result, series: Result) -> Result | None:
    """Return the section's ratio of a series to ours, or None."""
    for found in section["ratios"]:
        same = found["other"] == series["name"]
        if same and found["settings"]["other"] == series["settings"]:
            of_medians = found["unit"] == WINDOW_MEDIAN and series["unit"] == PREDICT
            if found["unit"] == series["unit"] or of_medians:
                return dict(found)
    return None


def differing(section: Result) -> set[str]:
    """Return the settings that are not the same in all series of a section."""
    settings = [series["settings"] for series in section["series"]]
    return {
        key for one in settings for key in one
        if any(other.get(key) != one[key] for other in settings)
    }  # fmt: skip


def label(series: Result, keys: set[str]) -> str:
    """Return the name of a series followed by its settings in `keys`; one thread is omitted."""
    words = [
        f"{value} threads" if key == "threads" else f"{key} {value}"
        for key, value in series["settings"].items()
        if key in keys and (key, value) != ("threads", 1)
    ]
    return ", ".join([series["name"], *words])


def leading(section: Result) -> list[Result]:
    """Return the series in the unit of the section's first one."""
    return [one for one in section["series"] if one["unit"] == section["series"][0]["unit"]]


def show(result: Result, console: Console) -> None:
    """Print every section, the measurements left out and why, and the load of the machine."""
    for section in result["sections"].values():
        console.print(section["title"], style="bold", highlight=False)
        if section["series"]:
            console.print(section_table(section))
        if section["ratios"]:
            console.print("x: times as long as ours, median (min..max) of the rounds", style="dim")
        for note in section["notes"]:
            console.print(note, style="dim", highlight=False, markup=False)
        for missing in section["unavailable"]:
            console.print(
                f"left out: {missing['name']}: {missing['reason']}", style="yellow",
                markup=False, highlight=False,
            )  # fmt: skip
        console.print()
    console.print(load(result), highlight=False)


def section_table(section: Result) -> Table:
    """Return the table of a section with at least one series."""
    everywhere = set.intersection(*(set(series["settings"]) for series in section["series"]))
    key = next((key for key in ROW_SETTINGS if key in differing(section) & everywhere), None)
    return _list(section) if key is None else _grid(section, key)


def _list(section: Result) -> Table:
    """Return a table with a row per series, without its empty columns."""
    rows, keys = [], differing(section)
    for series in section["series"]:
        unit = series["unit"]
        if unit == WINDOW_MEDIAN:
            continue
        low, high = quantity(series["min"], unit), quantity(series["max"], unit)
        rows.append(
            {
                "": label(series, keys),
                "in": unit,
                "median": quantity(series["median"], unit),
                "a second": rate(series["median"]) if unit.startswith("s/") else "",
                "rounds": f"{low} .. {high}" if len(series["rounds"]) > 1 else "",
                "99th percentile": quantity(series["p99"], unit) if "p99" in series else "",
                "ratio to ours": ratio(ratio_of(section, series)),
            }
        )
    table = Table(box=box.SIMPLE_HEAD)
    headings = [heading for heading in rows[0] if any(row[heading] for row in rows)]
    for heading in headings:
        table.add_column(heading, justify="left" if heading in {"", "in"} else "right")
    for row in rows:
        table.add_row(*(Text(row[heading]) for heading in headings))
    return table


def _grid(section: Result, key: str) -> Table:
    """Return a table with a row per value of a setting and a column per series.

    Each cell has the median, and below it the ratio to ours.
    """
    series, keys = leading(section), differing(section) - {key}
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column(key, justify="right")
    columns = list(dict.fromkeys(label(one, keys) for one in series))
    for column in columns:
        table.add_column(column, justify="right")
    for value in dict.fromkeys(one["settings"][key] for one in series):
        row = {label(one, keys): one for one in series if one["settings"][key] == value}
        cells = []
        for column in columns:
            one = row.get(column)
            if one is None:
                cells.append("")
                continue
            # The range has a line of its own, so that columns stay narrow.
            against = ratio(ratio_of(section, one)).replace(" (", "\n(")
            cells.append(f"{quantity(one['median'], one['unit'])}\n{against}".rstrip())
        table.add_row(str(value), *cells)
    return table


def load(result: Result) -> str:
    """Return a sentence on the load of the machine, and a warning if it was busy."""
    machine = result["machine"]
    before, after = machine["load_average_before"], machine["load_average_after"]
    if before is None or after is None:
        return "This system reports no load average."
    cores = machine["cores"] or 1
    text = (
        f"{machine['processor']}, {cores} cores; load average over a minute {before[0]:.2f} before,"
        f" {after[0]:.2f} after (this command itself counts for about 1)."
    )
    if before[0] > BUSY * cores:
        text += " The machine was busy before: rely on the ratios and their ranges, not the times."
    return text


def figure_of(result: Result) -> Figure | None:
    """Draw a panel per section that scales or compares; return None if there is none."""
    panels = [
        (section, panel)
        for name, panel in PANELS.items()
        if (section := result["sections"].get(name)) and section["series"]
    ]
    if not panels:
        return None
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(7.0 * columns, 4.6 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for (section, panel), ax in zip(panels, axes, strict=False):
        if panel.setting:
            _draw_lines(section, ax, panel)
        else:
            _draw_dots(section, ax, panel)
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
    """Return the medians and the lengths of their error bars below and above."""
    middle = [factor * one["median"] for one in series]
    low = [factor * (one["median"] - one["min"]) for one in series]
    high = [factor * (one["max"] - one["median"]) for one in series]
    return middle, [low, high]


def _draw_lines(section: Result, ax: Axes, panel: Panel) -> None:
    """Draw a line per series over one of its settings, on a logarithmic y axis."""
    key = panel.setting
    keys = differing(section) - {key}
    groups: dict[str, list[Result]] = {}
    for one in leading(section):
        groups.setdefault(label(one, keys), []).append(one)
    for k, (name, series) in enumerate(groups.items()):
        x = [one["settings"][key] for one in series]
        y, bars = _spread(series, panel.factor)
        ax.errorbar(
            x, y, bars, label=name, color=COLOURS[k % len(COLOURS)],
            marker=MARKERS[k % len(MARKERS)], markersize=5, linewidth=1.5, capsize=2,
        )  # fmt: skip
    ticks = sorted({one["settings"][key] for one in section["series"]})
    if panel.doubling:
        ax.set_xscale("log", base=2)
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_yscale("log")
    _plain(ax.yaxis)
    ax.legend(fontsize="small")
    ax.set_xlabel(panel.setting_label)
    ax.set_ylabel(panel.values)


def _draw_dots(section: Result, ax: Axes, panel: Panel) -> None:
    """Draw a dot per series on a logarithmic x axis, with its 99th percentile as a stroke."""
    series, keys = leading(section), differing(section)
    middle, (low, high) = _spread(series, panel.factor)
    for k, one in enumerate(series):
        colour = COLOURS[k % len(COLOURS)]
        ax.errorbar(
            [middle[k]], [k], xerr=[[low[k]], [high[k]]], color=colour, marker="o", capsize=3
        )
        if "p99" in one:
            ax.plot([panel.factor * one["p99"]], [k], color=colour, marker="|", markersize=16)
        text = quantity(one["median"], one["unit"])
        ax.annotate(text, (middle[k], k), (0, 6), textcoords="offset points", ha="center")
    ax.set_yticks(range(len(series)), [label(one, keys) for one in series])
    ax.set_ylim(len(series) - 0.5, -0.5)
    ax.set_xscale("log")
    _plain(ax.xaxis)
    ax.set_xlabel(panel.values)


def _plain(axis: Axis) -> None:
    """Put plain numbers at 1, 2 and 5 of every decade, or at all digits within one decade."""
    low, high = axis.get_view_interval()
    plain_ticks(axis, (1.0, 2.0, 5.0) if high > DECADE * low else tuple(range(1, 10)))
