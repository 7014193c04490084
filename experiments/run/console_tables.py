"""Results as lines of text, an agent each, and as tables for a terminal of 120 columns."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from experiments.run import ranking, regimes
from experiments.run.estimates import Estimate, two_way
from experiments.run.excerpts import MOST_SETTINGS, of_paths
from experiments.run.learning_cost import words
from experiments.run.metrics import BANDS, PAPER_SIMULATION, published_row
from experiments.run.tables import (
    EFFORT,
    PUBLISHED_NOTE,
    SPREADS,
    TRACKING,
    TRAININGS_NOTE,
    Result,
    Row,
    build_rows,
    by_label,
    by_setting,
    cases_by_setting,
    current,
    has_trainings,
    ordered,
    path_name,
    path_names,
    training_of,
    trainings,
    trainings_of,
    violated,
    with_trainings,
)

KEY_FIGURES = (
    "agent", "whole path", "mean ALE, m", "worst MLE, m", "mean AOE, rad",
    "ALE against published", "median predict, ms", "worst p99, ms", "all constraints kept",
)  # fmt: skip
"""Headings of `key_lines`."""
BAND_NOTE = (
    "ALE (m) where the path's |curvature| at the foot point is in the band: mean over seeds of the "
    "mean over a seed's drives, ± 95 % interval by the t-distribution over seeds, since drives of "
    "one seed share their disturbances whatever the path. Below it, the number of drives that "
    "reached the band and its share of the agent's driving time; an agent that leaves the road "
    "early covers less of the path. The largest lateral and the rms heading error by band are in "
    "cases.jsonl."
)
KEY_HEADINGS = (
    "agent", "whole\npath", "mean ALE\nm", "worst MLE\nm (path)", "mean AOE\nrad",
    "ALE /\npublished", "predict\nmedian ms", "worst\np99 ms", "constraints\nkept",
)  # fmt: skip
"""Headings of `key_lines`, narrower than `KEY_FIGURES`."""
SCREEN = 8
"""Most rows of agents that are printed on every path."""


def over_seeds(cases: Iterable[Result], key: str) -> Estimate:
    """Compute the mean over seeds of a metric's mean over a seed's drives, with its interval.

    Drives of one seed share their disturbances whatever the path. An agent with several trainings
    has a second interval, over the means of each.
    """
    return two_way(
        (case.get("seed"), training_of(case), float(case["metrics"][key])) for case in cases
    )


def against_published(cases: Iterable[Result]) -> str:
    """Return the mean of our ALE divided by the published one, as a percentage; "–" without any."""
    shares = [
        case["metrics"]["ale"] / row["ale"]
        for case in cases
        if case.get("trajectory") in PAPER_SIMULATION
        and (row := published_row(str(case["trajectory"]), case.get("conditions", "simulation")))
        is not None
    ]
    return f"{100 * np.mean(shares):.1f} %" if shares else "–"


def key_lines(cases: Sequence[Result]) -> list[list[str]]:
    """Return the key figures of one setting's agents, a line of `KEY_FIGURES` for each."""
    lines = []
    for label, group in by_label(cases).items():
        done = [case for case in group if case.get("status") == "ok"]
        finished = sum(case.get("end") == "finished" for case in group)
        line = [with_trainings(label, trainings_of(group)), f"{finished} of {len(group)}"]
        if not done:
            lines.append([*line, *["–"] * (len(KEY_FIGURES) - len(line))])
            continue
        metrics: list[Mapping[str, float]] = [case["metrics"] for case in done]
        worst = max(done, key=lambda case: case["metrics"]["mle"])
        kept = sum(not violated(one) for one in metrics)
        medians = [case["solver"]["median"] for case in done]
        lines.append(
            [
                *line,
                over_seeds(done, "ale").words(3),
                f"{worst['metrics']['mle']:.3f} ({path_name(worst.get('trajectory'))})",
                over_seeds(done, "aoe").words(3),
                against_published(done),
                f"{1e3 * np.median(medians):.3f}",
                f"{1e3 * max(case['solver']['p99'] for case in done):.2f}",
                f"{kept} of {len(done)}",
            ]
        )
    return lines


@dataclass(frozen=True)
class Cell:
    """ALE (m) of one agent in one band over the drives that came there."""

    ale: Estimate
    drives: int
    share: float
    """Share of all time that the agent drove in the setting, 0 to 1."""

    @property
    def error(self) -> str:
        """ALE with its interval."""
        return self.ale.words(3)

    @property
    def basis(self) -> str:
        """Number of drives and share of time."""
        share = f"{100 * self.share:.0f}" if self.share >= 5e-3 else "<1"
        return f"{self.drives} drive{'s' * (self.drives != 1)}, {share} %"


Line = tuple[str, list[Cell | None]]
"""An agent's label and a cell for each band, None where no drive came there."""


def band_lines(cases: Sequence[Result]) -> list[Line]:
    """Return a line per agent of one setting; [] where no case has metrics by band."""
    lines = []
    for label, group in by_label(cases).items():
        measured = [
            case for case in group if any(f"ale_{name}" in case["metrics"] for name in BANDS.names)
        ]
        lines.append((label, [_cell(measured, name) for name in BANDS.names]))
    return lines if any(cell for _, cells in lines for cell in cells) else []


def _cell(measured: Sequence[Result], name: str) -> Cell | None:
    came = [case for case in measured if f"ale_{name}" in case["metrics"]]
    if not came:
        return None
    total = sum(case["metrics"]["duration"] for case in measured)
    stayed = sum(
        case["metrics"].get(f"share_{name}", 0.0) * case["metrics"]["duration"] for case in came
    )
    share = stayed / total if total > 0.0 else 0.0
    return Cell(over_seeds(came, f"ale_{name}"), len(came), share)


def band_ranges() -> list[str]:
    """Return each band's range of |curvature| in words, 1/m."""
    edges = [f"{threshold:g}" for threshold in BANDS.thresholds]
    between = [f"{low} to {high}" for low, high in pairwise(edges)]
    return [f"< {edges[0]}", *between, f"≥ {edges[-1]}"]


# Tables for a terminal ----------------------------------------------------------------------------


def all_tables(cases: Iterable[Result]) -> RenderableType:
    """Return three tables for each setting: tracking, effort, errors by curvature.

    Below them comes a line for each learned policy, with what learning cost.
    """
    kept = ordered(current(cases))
    groups = cases_by_setting(kept)
    parts: list[RenderableType] = [*by_regime(kept)]
    of_setting = by_setting(build_rows(kept))
    for setting, every in list(of_setting.items())[:MOST_SETTINGS]:
        rows, left_out = of_paths(every)
        title = _with_spreads(str(setting), any(row.trainings > 1 for row in rows))
        parts += [_tracking(title, rows), _effort(rows)]
        if left_out:
            parts += [Text(left_out, style="dim"), _key_figures("", groups[setting])]
        if (curvature := _curvature(groups[setting])) is not None:
            parts.append(curvature)
        parts.append(Text())
    if len(of_setting) > MOST_SETTINGS:
        parts.append(Text(f"{MOST_SETTINGS} of {len(of_setting)} settings are shown.", style="dim"))
    learning = [
        Text(f"trained: {label}: {training.get('algorithm', '?')}, {words(training)}")
        for label, training in trainings(kept)
    ]
    return Group(*parts, *learning, *_spread_note(kept), Text(PUBLISHED_NOTE, style="dim"))


def by_regime(cases: Sequence[Result]) -> list[RenderableType]:
    """Return the ranking of the agents, the tables of all regimes and a note; none without any."""
    found = regimes.tables_of(cases)
    if not found:
        return []
    ranked = _start("Ranking")
    for place, heading in enumerate(ranking.HEADINGS):
        ranked.add_column(heading.replace(" ", "\n"), justify="right" if place else "left")
    for line in ranking.ranking(cases):
        ranked.add_row(*map(Text, line.cells))
    notes = [Text(words, style="dim") for words in (ranking.NOTE, regimes.NOTE)]
    return [ranked, notes[0], Text(), Text("By regime", style="bold"), *found, notes[1]]


def _spread_note(cases: Sequence[Result]) -> list[RenderableType]:
    """Return the note on agents with several trainings; none without any."""
    return [Text(TRAININGS_NOTE, style="dim")] if has_trainings(cases) else []


def _with_spreads(title: str, several: bool) -> str:
    """Return a title that says which ± is which, where an agent has several trainings."""
    return f"{title} · {SPREADS}" if several else title


def screen(cases: Iterable[Result]) -> tuple[RenderableType, bool]:
    """Return tables that fit on a screen, and whether they are all there are.

    Cases with a regime get the table by regime. Else a few agents on a few paths get all tables. Of
    more there are the key figures of every agent, in the first setting and in the next that differs
    from it only in its conditions.
    """
    kept = ordered(current(cases))
    if found := by_regime(kept):
        return Group(*found, *_spread_note(kept)), False
    rows = [row for row in build_rows(kept) if not row.published]
    if len(rows) <= SCREEN:
        return all_tables(kept), True
    groups = cases_by_setting(kept)
    family = next(iter(groups)).family
    shown = [setting for setting in groups if setting.family == family][:2]
    figures = [_key_figures(str(setting), groups[setting]) for setting in shown]
    return Group(*figures, *_spread_note(kept)), False


def _start(title: str | None = None) -> Table:
    return Table(
        title=Text(title) if title else None, title_justify="left", title_style="bold",
        box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False,
    )  # fmt: skip


def _add_agent_column(table: Table) -> None:
    table.add_column("agent", min_width=16, max_width=26, overflow="fold")


def _key_figures(title: str, cases: Sequence[Result]) -> Table:
    table = _start(_with_spreads(title, has_trainings(cases)))
    _add_agent_column(table)
    for heading in KEY_HEADINGS[1:]:
        table.add_column(heading, justify="right", no_wrap=True)
    for line in key_lines(cases):
        table.add_row(*(Text(cell.replace(" ±", "\n±")) for cell in line))
    return table


def _curvature(cases: Sequence[Result]) -> Table | None:
    """Return the table of errors by curvature; None where no case has metrics by band."""
    lines = band_lines(cases)
    if not lines:
        return None
    title = "ALE by curvature, m; drives, share of time"
    table = _start(_with_spreads(title, has_trainings(cases)))
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
            *(Text(cell) for cell in (row.name, *cells(row))),
            style="italic dim" if row.published else "",
            end_section=last,
        )
    return table
