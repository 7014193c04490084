"""Results as tables for a terminal of 120 columns."""

from collections.abc import Callable, Iterable, Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from experiments.run.curvature_table import console_curvature
from experiments.run.learning_table import console_learning
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
)


def console_table(cases: Iterable[Result]) -> RenderableType:
    """Three tables a setting for a terminal of 120 columns: tracking, what it took, by curvature.

    Then a line for each learned policy: what learning cost.
    """
    kept = ordered(current(cases))
    groups = cases_by_setting(kept)
    parts: list[RenderableType] = []
    for setting, rows in by_setting(build_rows(kept)).items():
        curvature = console_curvature(groups[setting])
        parts += [_console_tracking(setting, rows), _console_effort(rows)]
        parts += [Text()] if curvature is None else [curvature, Text()]
    return Group(*parts, *console_learning(kept), Text(PUBLISHED_NOTE, style="dim"))


def _console_start(title: str | None = None) -> Table:
    table = Table(
        title=Text(title) if title else None, title_justify="left", title_style="bold",
        box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False,
    )  # fmt: skip
    table.add_column("path", no_wrap=True, min_width=4, max_width=18, overflow="ellipsis")
    table.add_column("agent", min_width=16, max_width=26, overflow="fold")
    return table


def _console_lines(
    table: Table, rows: Sequence[Row], cells: Callable[[Row], Sequence[str]]
) -> Table:
    """Add rows; the trajectory is named once and its group closed by a blank line."""
    seen = ""
    for place, row in enumerate(rows):
        last = place + 1 == len(rows) or rows[place + 1].trajectory != row.trajectory
        name = "" if row.trajectory == seen else row.trajectory
        seen = row.trajectory
        table.add_row(
            Text(name, style="bold"),
            *(Text(cell) for cell in (row.label, *cells(row))),
            style="italic dim" if row.published else "",
            end_section=last,
        )
    return table


def _console_tracking(setting: str, rows: Sequence[Row]) -> Table:
    table = _console_start(setting)
    for column in TRACKING:
        table.add_column(f"{column.heading}\n{column.unit}", justify="right", no_wrap=True)
    table.add_column("end", max_width=18)
    return _console_lines(
        table,
        rows,
        lambda row: [
            *(column.text(row, "\n") for column in TRACKING),
            row.end,
        ],
    )


def _console_effort(rows: Sequence[Row]) -> Table:
    table = _console_start()
    for column in EFFORT:
        heading = column.heading.replace(" ", "\n", 1)
        table.add_column(f"{heading}\n{column.unit}", justify="right", no_wrap=True)
    table.add_column("solves\nfailed", justify="right", max_width=11)
    table.add_column("constraints broken: largest excess,\nshare of periods", ratio=1)
    return _console_lines(
        table,
        [row for row in rows if not row.published],
        lambda row: [
            *(column.text(row, "\n") for column in EFFORT),
            row.failures,
            row.violations,
        ],
    )
