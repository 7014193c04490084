"""Sections that compare agents: with the published table, and by the path's curvature."""

from collections.abc import Callable, Iterable, Mapping, Sequence

from experiments.report.cost import TRAINED_NOTE
from experiments.report.drive_figures import condition_styles
from experiments.report.drives import family_of, main_family, per_setting
from experiments.report.page import (
    Cell,
    Document,
    Panel,
    Styles,
    folded,
    html_groups,
    html_table,
    joined,
    legend,
    paragraph,
)
from experiments.report.svg_charts import BOTTOM, TOP, Chart, Scale, decades
from experiments.run import tables
from experiments.run.console_tables import BAND_NOTE, Line, band_lines, band_ranges
from experiments.run.estimates import Estimate
from experiments.run.excerpts import of_paths
from experiments.run.metrics import BANDS, published_row
from experiments.run.settings import Setting, conditions_words, setting_of
from experiments.run.tables import EFFORT, FURTHER, SPREADS, TRACKING, Column, Result, Row

ERRORS = (
    ("ale", "ALE (m)", "Average lateral error"),
    ("aoe", "AOE (rad)", "Average orientation error"),
)
FLOOR = 1e-5
"""Smallest error that a logarithmic axis shows, m."""
CHARACTER = 5.6
"""Width of a character of an axis label, in units of a chart."""
LONGEST_LABEL = 22


def comparison_section(document: Document, cases: Sequence[Result], rows: Sequence[Row]) -> str:
    """Return errors by agent as figures of the first family, then the tables of every setting."""
    parts = [
        paragraph(
            f"{tables.PUBLISHED_NOTE} Max CTE and MLE, equal by formula, refer to the foot point "
            "on the path. Rows of several seeds (×n) show the mean ± the 95 % interval by the "
            "t-distribution."
        )
    ]
    if tables.has_trainings(cases):
        parts.append(paragraph(tables.TRAININGS_NOTE))
    if any(case.get("training") for case in cases):
        parts.append(paragraph(TRAINED_NOTE))
    parts += _agent_figures(document, cases, rows)
    of_setting = tables.by_setting(rows)
    parts.append(
        per_setting(cases, lambda setting, _: _tables(document, setting, of_setting[setting]))
    )
    return joined(parts)


def _agent_figures(document: Document, cases: Sequence[Result], rows: Sequence[Row]) -> list[str]:
    done = [case for case in cases if case.get("status") == "ok"]
    if not done:
        return []
    family = main_family(done)
    conditions = {
        setting_of(case): conditions_words(case.get("conditions", "simulation"))
        for case in done
        if family_of(case) == family
    }
    styles = condition_styles(list(dict.fromkeys(conditions.values())))
    of_setting = tables.by_setting(rows)
    parts = []
    for key, axis, name in ERRORS:
        ours = [
            row
            for setting in conditions
            for row in of_paths(of_setting.get(setting, []))[0]
            if not row.published and key in row.values
        ]
        if ours:
            parts.append(
                document.figure(
                    f"{name} of every agent, {family}. Means, with 95 % intervals where there are "
                    "several seeds, over trainings where that is wider. Dashed: the published "
                    "values of the same kind; the errata explain how the two differ.",
                    by_agent(ours, conditions, styles, axis, key),
                    legend(styles, styles),
                )
            )
    return parts


def by_agent(
    rows: Sequence[Row], conditions: Mapping[Setting, str], styles: Styles, words: str, key: str
) -> list[Panel]:
    """Return a panel per trajectory, a line per agent, a mark with interval per conditions.

    It draws the value `key` (m or rad) of agents' rows, on an axis labelled `words`; the published
    value is a line across the panel. `conditions` are those of each setting in words.
    """
    panels = []
    for name in dict.fromkeys(row.trajectory for row in rows):
        group = [row for row in rows if row.trajectory == name]
        labels = list(dict.fromkeys(row.label for row in group))
        names = [_shortened(label) for label in labels]
        shown = list(dict.fromkeys(conditions[row.setting] for row in group))
        references = {
            kind: reference[key]
            for kind in shown
            if (reference := published_row(name, kind)) is not None
        }
        values = [end for row in group for end in _ends(row.values[key])]
        chart = Chart(
            decades([[*values, *references.values()]], FLOOR),
            Scale(len(labels) - 0.4, -0.6),
            x_label=words, y_names=names, left=12.0 + CHARACTER * max(map(len, names)),
            height=TOP + BOTTOM + 16.0 * len(labels),
        )  # fmt: skip
        for kind, value in references.items():
            chart.rule(x=value, kind=f"c{styles[kind].colour} d1")
        for row in group:
            kind = conditions[row.setting]
            place = labels.index(row.label) + 0.16 * (2 * shown.index(kind) + 1 - len(shown))
            colour = styles[kind].colour
            low, high = (max(end, FLOOR) for end in _ends(row.values[key]))
            if high > low:
                chart.segment((low, high), (place, place), f"c{colour} mark")
            chart.dot(max(row.values[key].mean, FLOOR), place, f"f{colour}")
        panels.append(Panel(name, chart.svg()))
    return panels


def _shortened(label: str) -> str:
    """Return a label that fits beside an axis."""
    return label if len(label) <= LONGEST_LABEL else f"{label[: LONGEST_LABEL - 1]}…"


def _ends(value: Estimate) -> tuple[float, float]:
    """Return the ends of the wider of an estimate's intervals, both the mean if it has none."""
    width = max(value.half_width or 0.0, value.over_trainings or 0.0)
    return value.mean - width, value.mean + width


def _tables(document: Document, setting: Setting, rows: Sequence[Row]) -> str:
    """Return the paper's table, with effort, constraints and further columns folded away."""
    rows, left_out = of_paths(rows)
    ours = [row for row in rows if not row.published]
    spreads = f"; {SPREADS}" if any(row.trainings > 1 for row in ours) else ""
    texts: dict[str, Callable[[Row], str]] = {"end": lambda row: row.end}
    if any(row.learning for row in rows):
        texts["trained"] = _trained
    effort: dict[str, Callable[[Row], str]] = {
        "solves failed": lambda row: row.failures,
        "constraints broken: largest excess, share of control periods": lambda row: row.violations,
    }
    tracking = document.table(
        f"Tracking errors in the paper's terms, {setting}{spreads}.",
        html_rows(rows, TRACKING, texts),
    )
    known = [column for column in FURTHER if any(column.key in row.values for row in ours)]
    further = [
        document.table(
            f"Effort and constraints, {setting}{spreads}.", html_rows(ours, EFFORT, effort)
        ),
        document.table(
            f"Beyond the paper's columns, {setting}{spreads}.", html_rows(ours, known, {})
        ),
    ]
    note = paragraph(left_out, "soft") if left_out else ""
    folds = folded("Effort, constraints and further figures", joined(further))
    return joined([note, tracking, folds])


def _trained(row: Row) -> str:
    """Return the cost of learning, each quantity kept on one line with its unit."""
    words = ", ".join(part.replace(" ", "\u00a0") for part in row.learning.split(", "))
    return words or ("" if row.published else "–")


def html_rows(
    rows: Sequence[Row], columns: Sequence[Column], texts: Mapping[str, Callable[[Row], str]]
) -> str:
    """Return an HTML table of one setting: path, agent, numeric columns, columns of text."""
    units = [(column.heading, column.unit) for column in columns]
    headings: list[Cell] = ["path", "agent", *units, *texts]
    prose = 2 + len(columns)
    lines = []
    for row in rows:
        label = row.name + (f" ×{row.runs}" if row.runs > 1 else "")
        cells = [column.text(row) for column in columns] + [text(row) for text in texts.values()]
        lines.append(([tables.path_name(row.trajectory), label, *cells], row.published))
    return html_groups(headings, lines, range(2, prose), range(prose, len(headings)))


def curvature_section(document: Document, cases: Sequence[Result], styles: Styles) -> str:
    """Return errors by the path's curvature: a figure, and a table for each setting."""
    lines = {
        setting: found
        for setting, group in tables.cases_by_setting(cases).items()
        if (found := band_lines(group))
    }
    if not lines:
        return ""
    family = main_family(cases)
    own = {setting: found for setting, found in lines.items() if setting.family == family}
    figure = ""
    if own:
        figure = document.figure(
            "ALE by the path's curvature. Mean with its 95 % interval over seeds where there are "
            "several, over trainings where that is wider; hollow marks are those whose lines are "
            "dashed elsewhere.",
            by_band({str(setting): found for setting, found in own.items()}, styles),
            legend(styles, [label for found in own.values() for label, _ in found]),
            wide=True,
        )

    def table(setting: Setting, group: Sequence[Result]) -> str:
        if setting not in lines:
            return ""
        spreads = f"; {SPREADS}" if tables.has_trainings(group) else ""
        caption = f"ALE (m) by the path's curvature, {setting}{spreads}."
        return document.table(caption, _band_table(lines[setting]))

    return joined([paragraph(BAND_NOTE), figure, per_setting(cases, table)])


def by_band(lines: Mapping[str, Sequence[Line]], styles: Styles) -> list[Panel]:
    """Return a panel per setting: ALE of each agent in each band of curvature, with intervals."""
    panels = []
    for title, agents in lines.items():
        every = [end for _, cells in agents for cell in cells if cell for end in _ends(cell.ale)]
        chart = Chart(
            Scale(-0.5, len(BANDS.names) - 0.5), decades([every], FLOOR),
            x_names=BANDS.names, y_label="ALE (m)", x_label="|curvature| of the path",
            height=230.0,
        )  # fmt: skip
        for k, (label, cells) in enumerate(agents):
            offset = 0.8 * ((k + 0.5) / len(agents) - 0.5)
            for band, cell in enumerate(cells):
                if cell is None:
                    continue
                low, high = (max(end, FLOOR) for end in _ends(cell.ale))
                interval = low, max(cell.ale.mean, FLOOR), high
                chart.interval(band + offset, interval, styles[label])
        panels.append(Panel(title, chart.svg()))
    return panels


def _band_table(lines: Iterable[Line]) -> str:
    ranges = [f"{words} 1/m" for words in band_ranges()]
    headings: list[Cell] = ["agent", *zip(BANDS.names, ranges, strict=True)]
    cells = [
        [label, *((cell.error, cell.basis) if cell else "–" for cell in found)]
        for label, found in lines
    ]
    return html_table(headings, cells, range(1, len(headings)))
