"""Figures of estimates with their intervals: errors by agent, and by the path's curvature."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from experiments.report.charts import BOTTOM, TOP, Chart
from experiments.report.path_figures import Panel
from experiments.report.scales import Scale, decades
from experiments.report.styles import LineStyle, Styles
from experiments.run import published
from experiments.run.band_metrics import BANDS
from experiments.run.curvature_table import Line
from experiments.run.tables import Estimate

FLOOR = 1e-5
"""m, the least error that a logarithmic axis shows."""
CHARACTER = 5.6
"""Width of a character of an axis, in units of a chart."""


@dataclass(frozen=True)
class Measured:
    """An estimate of one agent on one trajectory under one kind of conditions."""

    trajectory: str
    label: str
    conditions: str
    value: Estimate


def brief(label: str, limit: int = 22) -> str:
    """A label that fits beside an axis."""
    return label if len(label) <= limit else f"{label[: limit - 1]}…"


def ends(value: Estimate) -> tuple[float, float]:
    """The interval of an estimate, or twice its mean."""
    width = value.half_width or 0.0
    return value.mean - width, value.mean + width


def upright(chart: Chart, x: float, interval: tuple[float, float, float], style: LineStyle) -> None:
    """A mark at the middle of (low, middle, high) of the y axis, a line from end to end.

    Hollow where the style's lines are dashed: colours come twice.
    """
    low, middle, high = interval
    if high > low:
        chart.segment((x, x), (low, high), f"c{style.colour} mark")
    kind = f"hollow c{style.colour}" if style.dashes else f"f{style.colour}"
    chart.dot(x, middle, kind, 2.6)


def by_agent(
    measured: Sequence[Measured], styles: Mapping[str, LineStyle], words: str, key: str
) -> list[Panel]:
    """A panel a trajectory, a line an agent, a mark with its interval each kind of conditions.

    Parameters
    ----------
    measured
        Estimates, m or rad.
    styles
        Of the conditions, in their order.
    words
        The axis' label.
    key
        Column of the published table whose value is drawn as a line through the panel.
    """
    panels = []
    for name in dict.fromkeys(one.trajectory for one in measured):
        group = [one for one in measured if one.trajectory == name]
        labels = list(dict.fromkeys(one.label for one in group))
        shown = list(dict.fromkeys(one.conditions for one in group))
        rows = {
            conditions: row[key]
            for conditions in shown
            if (row := published.row(name, conditions)) is not None
        }
        values = [end for one in group for end in ends(one.value)]
        chart = Chart(
            decades([[*values, *rows.values()]], FLOOR),
            Scale(len(labels) - 0.4, -0.6),
            x_label=words, y_names=[brief(label) for label in labels],
            left=12.0 + CHARACTER * max(len(brief(label)) for label in labels),
            height=TOP + BOTTOM + 16.0 * len(labels),
        )  # fmt: skip
        for conditions, value in rows.items():
            chart.rule(x=value, kind=f"c{styles[conditions].colour} d1")
        for one in group:
            place = labels.index(one.label) + 0.16 * (2 * shown.index(one.conditions) + 1)
            place -= 0.16 * len(shown)
            style = styles[one.conditions]
            low, high = (max(end, FLOOR) for end in ends(one.value))
            if high > low:
                chart.segment((low, high), (place, place), f"c{style.colour} mark")
            chart.dot(max(one.value.mean, FLOOR), place, f"f{style.colour}")
        panels.append(Panel(name, chart.svg()))
    return panels


def by_band(lines: Mapping[str, Sequence[Line]], styles: Styles) -> list[Panel]:
    """A panel a setting: ALE of each agent in each band of curvature, with intervals."""
    panels = []
    for title, agents in lines.items():
        every = [end for _, cells in agents for cell in cells if cell for end in ends(cell.ale)]
        count = len(BANDS.names)
        chart = Chart(
            Scale(-0.5, count - 0.5), decades([every], FLOOR),
            x_names=BANDS.names, y_label="ALE (m)", x_label="|curvature| of the path",
            height=230.0,
        )  # fmt: skip
        for k, (label, cells) in enumerate(agents):
            style = styles[label]
            offset = 0.8 * ((k + 0.5) / len(agents) - 0.5)
            for band, cell in enumerate(cells):
                if cell is None:
                    continue
                low, high = (max(end, FLOOR) for end in ends(cell.ale))
                upright(chart, band + offset, (low, max(cell.ale.mean, FLOOR), high), style)
        panels.append(Panel(title, chart.svg()))
    return panels
