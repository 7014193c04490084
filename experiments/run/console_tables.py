"""Results as tables for a terminal of 120 columns."""

from collections.abc import Callable, Iterable, Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from experiments.run.agent_tables import band_lines, band_ranges, key_lines
from experiments.run.learning_cost import words
from experiments.run.metrics import BANDS
from experiments.run.tables import (
    EFFORT,
    PUBLISHED_NOTE,
    TRACKING,
    Result,
    Row,
    build_rows,
    by_setting,
    cases_by_setting,
    current,
    ordered,
    path_names,
    trainings,
)

KEY_HEADINGS = (
    "agent", "whole\npath", "mean ALE\nm", "worst MLE\nm (path)", "mean AOE\nrad",
    "ALE /\npublished", "predict\nmedian ms", "worst\np99 ms", "constraints\nkept",
)  # fmt: skip
"""Headings of `key_lines`, narrower than `KEY_FIGURES`."""
SCREEN = 8
"""Most rows of agents that are printed on every path."""


def all_tables(cases: Iterable[Result]) -> RenderableType:
    """Return three tables for each setting: tracking, effort, errors by curvature.

    Below them comes a line for each learned policy, with what learning cost.
    """
    kept = ordered(current(cases))
    groups = cases_by_setting(kept)
    parts: list[RenderableType] = []
    for setting, rows in by_setting(build_rows(kept)).items():
        parts += [_tracking(str(setting), rows), _effort(rows)]
        if (curvature := _curvature(groups[setting])) is not None:
            parts.append(curvature)
        parts.append(Text())
    learning = [
        Text(f"trained: {label}: {training.get('algorithm', '?')}, {words(training)}")
        for label, training in trainings(kept)
    ]
    return Group(*parts, *learning, Text(PUBLISHED_NOTE, style="dim"))


def screen(cases: Iterable[Result]) -> tuple[RenderableType, bool]:
    """Return tables that fit on a screen, and whether they are all there are.

    A few agents on a few paths get all tables. Of more there are the key figures of every agent, in
    the first setting and in the next that differs from it only in its conditions.
    """
    kept = ordered(current(cases))
    rows = [row for row in build_rows(kept) if not row.published]
    if len(rows) <= SCREEN:
        return all_tables(kept), True
    groups = cases_by_setting(kept)
    family = next(iter(groups)).family
    shown = [setting for setting in groups if setting.family == family][:2]
    return Group(*(_key_figures(str(setting), groups[setting]) for setting in shown)), False


def _start(title: str | None = None) -> Table:
    return Table(
        title=Text(title) if title else None, title_justify="left", title_style="bold",
        box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False,
    )  # fmt: skip


def _add_agent_column(table: Table) -> None:
    table.add_column("agent", min_width=16, max_width=26, overflow="fold")


def _key_figures(title: str, cases: Sequence[Result]) -> Table:
    table = _start(title)
    _add_agent_column(table)
    for heading in KEY_HEADINGS[1:]:
        table.add_column(heading, justify="right", no_wrap=True)
    for line in key_lines(cases):
        table.add_row(*map(Text, line))
    return table


def _curvature(cases: Sequence[Result]) -> Table | None:
    """Return the table of errors by curvature; None where no case has metrics by band."""
    lines = band_lines(cases)
    if not lines:
        return None
    table = _start("ALE by curvature, m; drives, share of time")
    table.title_style = ""
    _add_agent_column(table)
    for name, bounds in zip(BANDS.names, band_ranges(), strict=True):
        table.add_column(f"{name}\n{bounds} 1/m", justify="right", no_wrap=True)
    for label, cells in lines:
        table.add_row(
            Text(label),
            *(Text(f"{cell.error}\n{cell.basis}" if cell else "–") for cell in cells),
        )
    return table


def _tracking(title: str, rows: Sequence[Row]) -> Table:
    table = _start_paths(title)
    for column in TRACKING:
        table.add_column(f"{column.heading}\n{column.unit}", justify="right", no_wrap=True)
    table.add_column("end", max_width=18)
    return _add_lines(
        table, rows, lambda row: [*(column.text(row, "\n") for column in TRACKING), row.end]
    )


def _effort(rows: Sequence[Row]) -> Table:
    table = _start_paths()
    for column in EFFORT:
        heading = column.heading.replace(" ", "\n", 1)
        table.add_column(f"{heading}\n{column.unit}", justify="right", no_wrap=True)
    table.add_column("solves\nfailed", justify="right", max_width=11)
    table.add_column("constraints broken: largest excess,\nshare of periods", ratio=1)
    return _add_lines(
        table,
        [row for row in rows if not row.published],
        lambda row: [
            *(column.text(row, "\n") for column in EFFORT),
            row.failures,
            row.violations,
        ],
    )


def _start_paths(title: str | None = None) -> Table:
    table = _start(title)
    table.add_column("path", no_wrap=True, min_width=4, max_width=18, overflow="ellipsis")
    _add_agent_column(table)
    return table


def _add_lines(table: Table, rows: Sequence[Row], cells: Callable[[Row], Sequence[str]]) -> Table:
    """Add rows; the path is named once and its group closed by a blank line."""
    names = path_names(row.trajectory for row in rows)
    seen = ""
    for place, row in enumerate(rows):
        last = place + 1 == len(rows) or rows[place + 1].trajectory != row.trajectory
        name = "" if row.trajectory == seen else names[row.trajectory]
        seen = row.trajectory
        table.add_row(
            Text(name, style="bold"),
            *(Text(cell) for cell in (row.label, *cells(row))),
            style="italic dim" if row.published else "",
            end_section=last,
        )
    return table
