"""Section on errors by the path's curvature: a table a setting, and a figure of it."""

import html
from collections.abc import Iterable, Sequence

from experiments.report.document import Document, first_open, joined, paragraph
from experiments.report.drives import family_of, main_family
from experiments.report.estimate_figures import by_band
from experiments.report.styles import Styles, legend
from experiments.run.band_metrics import BANDS
from experiments.run.curvature_table import NOTE, Line, band_lines, band_ranges
from experiments.run.tables import Result, cases_by_setting


def curvature_section(document: Document, cases: Sequence[Result], styles: Styles) -> str:
    """What the bands are, a figure, and a table for each setting; "" where no case knows bands."""
    by_setting = cases_by_setting(cases)
    groups = {
        setting: lines for setting, group in by_setting.items() if (lines := band_lines(group))
    }
    if not groups:
        return ""
    family = main_family(cases)
    own = {
        setting: lines
        for setting, lines in groups.items()
        if family in {family_of(case) for case in by_setting[setting]}
    }
    figure = ""
    if own:
        figure = document.figure(
            "ALE by the path's curvature. Mean with its 95 % interval over seeds where there are "
            "several; hollow marks are those whose lines are dashed elsewhere.",
            by_band(own, styles),
            legend(styles, [label for lines in own.values() for label, _ in lines]),
            wide=True,
        )
    shown = [
        (
            setting in own,
            document.table(f"ALE (m) by the path's curvature, {setting}.", _html(lines)),
        )
        for setting, lines in groups.items()
    ]
    return joined([paragraph(NOTE), figure, first_open(shown, "Other settings")])


def _html(lines: Iterable[Line]) -> str:
    heads = "".join(
        f'<th class="n" scope="col">{html.escape(name)}<small>{html.escape(words)} 1/m</small></th>'
        for name, words in zip(BANDS.names, band_ranges(), strict=True)
    )
    body = "\n".join(
        f'<tr><th class="who" scope="row">{html.escape(label)}</th>'
        + "".join(
            f'<td class="n">{cell.error}<small>{html.escape(cell.basis)}</small></td>'
            if cell
            else '<td class="n">–</td>'
            for cell in cells
        )
        + "</tr>"
        for label, cells in lines
    )
    return (
        f'<table><thead><tr><th class="who" scope="col">agent</th>{heads}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table>"
    )
