"""Sections that count: key figures of every agent, how drives ended, errors and warnings."""

import html
from collections import Counter
from collections.abc import Iterable, Sequence, Sized

import numpy as np

from experiments.report.drives import LEAD, family_of, main_family, per_setting
from experiments.report.page import Cell, Document, html_table, joined, paragraph
from experiments.run import ranking, regimes, tables
from experiments.run.console_tables import (
    KEY_FIGURES,
    against_published,
    key_lines,
    over_seeds,
)
from experiments.run.excerpts import MOST_LISTED
from experiments.run.settings import conditions_words, setting_of
from experiments.run.statistics import rate_interval
from experiments.run.tables import Result

KEY_NOTE = (
    "ALE, AOE: root mean square lateral and heading error; MLE: largest lateral error; over all "
    "runs that did not fail, with the 95 % interval over seeds where there are several. An episode "
    "that ended early counts for the part it drove. “Against published”: our ALE divided by the "
    "published one for the same kind of conditions, mean over T1 to T6."
)
END_HEADINGS = (
    "agent", "drives", "whole path", "left the corridor", "other ends", "failed cases",
    "not the whole path, %", "95 % interval, %", "solves failed", "deadline misses",
    "drives that braked by themselves",
)  # fmt: skip
END_NOTE = (
    "A drive fails if it does not reach the end of the path. Intervals are two-sided "
    "Clopper-Pearson intervals of the rate of failures. Drives of one seed share their "
    "disturbances and so are not quite independent; of several trainings of an agent the range of "
    "their rates stands beside the interval of all drives. Deadline misses are computations that "
    "ended too late in the simulated vehicle; a vehicle brakes by itself when none arrives in time."
)

Tile = tuple[str, str, str]
"""Name, value and remark of a figure at a glance."""


def summary_section(document: Document, cases: Sequence[Result], superseded: int) -> str:
    """Return key findings as tiles, then a table with a line for each agent of each setting.

    `superseded` is the number of results left out because later ones repeat their cases.
    """
    parts = [tiles([*findings(cases), *counts(cases)])]
    if superseded:
        parts.append(
            paragraph(
                f"Left out: {superseded} older result{'s' * (superseded > 1)} of cases that were "
                "run again with other source code."
            )
        )
    parts.append(paragraph(KEY_NOTE, "soft"))
    if tables.has_trainings(cases):
        parts.append(paragraph(tables.TRAININGS_NOTE, "soft"))
    parts.append(
        per_setting(
            cases,
            lambda setting, group: document.table(
                f"Key figures of every agent, {setting}{_spreads(group)}.",
                html_table(KEY_FIGURES, key_lines(group), range(1, len(KEY_FIGURES))),
            ),
        )
    )
    return joined(parts)


def _spreads(cases: Sequence[Result]) -> str:
    """Return the words of a caption on the intervals of agents with several trainings."""
    return f"; {tables.SPREADS}" if tables.has_trainings(cases) else ""


def regime_section(document: Document, cases: Sequence[Result]) -> str:
    """Return an overview of all regimes, then a table for each; "" for cases without regimes."""
    groups = {name: regimes.lines(group) for name, group in regimes.by_regime(cases).items()}
    if not groups:
        return ""
    labels = tables.labels(case for case in cases if case.get("regime"))
    overview = [[name, *_overview(found, labels)] for name, found in groups.items()]
    ranked = [line.cells for line in ranking.ranking(cases)]
    return joined(
        [
            document.table(
                "Ranking of the agents.",
                html_table(ranking.HEADINGS, ranked, range(1, len(ranking.HEADINGS))),
            ),
            paragraph(ranking.NOTE),
            paragraph(regimes.NOTE),
            document.table(
                "Failed drives of all drives, and below them the first figure of those that "
                "finished: MLE, m; from a start ALE, m; entry speed, m/s; fastest lap, s.",
                html_table(("regime", *labels), overview, range(1, len(labels) + 1), (0,)),
            ),
            *(
                document.table(
                    f"Every agent, {name}.",
                    html_table(
                        regimes.headings(found[0].columns),
                        [line.cells for line in found],
                        range(1, len(found[0].cells)),
                    ),
                )
                for name, found in groups.items()
            ),
        ]
    )


def _overview(found: Sequence[regimes.Line], labels: Sequence[str]) -> list[Cell]:
    """Return a cell for each agent: its failures, and its MLE in small print."""
    own = {line.label: line for line in found}
    return [
        (f"{line.failed} of {line.drives}", line.cells[len(regimes.COUNTS)])
        if (line := own.get(label))
        else "–"
        for label in labels
    ]


def tiles(shown: Iterable[Tile]) -> str:
    """Return figures at a glance as HTML."""
    items = "".join(
        f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}"
        + (f"<small>{html.escape(remark)}</small>" if remark else "")
        + "</dd></div>"
        for name, value, remark in shown
    )
    return f'<dl class="tiles">{items}</dl>'


def findings(cases: Sequence[Result]) -> list[Tile]:
    """Return the leading agent's errors under each kind of conditions of the first family."""
    done = _done(cases)
    if not done:
        return []
    family = main_family(done)
    labels = {tables.label_of(case) for case in done if family_of(case) == family}
    lead = LEAD if LEAD in labels else tables.label_of(done[0])
    own = [case for case in done if family_of(case) == family and tables.label_of(case) == lead]
    by_conditions: dict[str, list[Result]] = {}
    for case in own:
        words = conditions_words(case.get("conditions", "simulation"))
        words = f"{family.regime}, {words}" if family.regime else words
        by_conditions.setdefault(words, []).append(case)
    shown: list[Tile] = []
    for conditions, group in by_conditions.items():
        remark = against_published(group)
        worst = max(group, key=lambda case: case["metrics"]["mle"])
        shown += [
            (
                f"{lead}: ALE, {conditions}",
                f"{over_seeds(group, 'ale').words(3)} m",
                f"{remark} of the published" if remark != "–" else "",
            ),
            (
                f"{lead}: largest lateral error, {conditions}",
                f"{worst['metrics']['mle']:.3f} m",
                f"on {worst.get('trajectory')}, of {len(group)} drives",
            ),
        ]
    period = min(case.get("control_period", np.inf) for case in own)
    rare = max(case["solver"].get("p99", 0.0) for case in own)
    median = float(np.median([case["solver"].get("median", 0.0) for case in own]))
    shown.append(
        (
            f"{lead}: predict, median / worst p99",
            f"{1e3 * median:.3f} / {1e3 * rare:.2f} ms",
            f"control period {1e3 * period:g} ms",
        )
    )
    return shown


def counts(cases: Sequence[Result]) -> list[Tile]:
    """Return how much was run, and how it ended."""
    done = _done(cases)
    whole = sum(case.get("end") == "finished" for case in done)
    late = [
        case for case in done if case["solver"].get("p99", 0.0) > case.get("control_period", np.inf)
    ]
    low, high = rate_interval(len(cases) - whole, len(cases))
    minutes = sum(case["metrics"].get("duration", 0.0) for case in done) / 60
    computed = sum(case.get("seconds") or 0.0 for case in cases) / 60
    sizes = [
        _plural(len(set(map(key, cases))), word)
        for word, key in (
            ("agent", tables.label_of),
            ("path", lambda case: str(case.get("trajectory"))),
            ("seed", lambda case: case.get("seed")),
        )
    ]
    return [
        (
            "drove the whole path", f"{whole} of {len(cases)}",
            f"failures: {100 * low:.1f} to {100 * high:.1f} % (95 %)",
        ),
        ("failed cases", f"{len(cases) - len(done)}", "ended in an error"),
        ("p99 of predict over the control period", f"{len(late)} of {len(done)}", "drives"),
        ("cases", f"{len(cases)}", ", ".join(sizes)),
        ("time driven", f"{minutes:.0f} min", f"{computed:.1f} min of computing"),
    ]  # fmt: skip


def _plural(number: int, word: str) -> str:
    return f"{number} {word}{'s' * (number != 1)}"


def _done(cases: Iterable[Result]) -> list[Result]:
    return [case for case in cases if case.get("status") == "ok"]


def failures_section(document: Document, cases: Sequence[Result]) -> str:
    """Return counts with bounds, then each failed case with its error and each warning."""
    ends = per_setting(
        cases,
        lambda setting, group: document.table(
            f"How drives ended, with the rate of failures and its 95 % interval, {setting}.",
            html_table(
                END_HEADINGS,
                [_end_line(label, own) for label, own in tables.by_label(group).items()],
                range(1, len(END_HEADINGS)),
            ),
        ),
    )
    failed = [
        [
            str(case["id"]), tables.case_name(case), str(case.get("trajectory")),
            str(setting_of(case)), str(case.get("seed")),
            str(case.get("error", "no message")),
        ]
        for case in cases
        if case.get("status") != "ok"
    ]  # fmt: skip
    warnings = Counter(text for case in cases for text in case.get("warnings") or [])
    parts = [paragraph(END_NOTE), ends]
    if failed:
        headings = ("id", "agent", "path", "setting", "seed", "error")
        first = f"Failed cases{_of(failed)}."
        parts.append(document.table(first, html_table(headings, failed[:MOST_LISTED], (4,), (5,))))
    if warnings:
        common = sorted(warnings.most_common(MOST_LISTED))
        lines = [[str(count), text] for text, count in common]
        parts.append(
            document.table(
                f"Warnings, and the number of cases that gave them{_of(warnings)}.",
                html_table(("cases", "warning"), lines, (0,), (1,)),
            )
        )
    return joined(parts)


def _of(every: Sized) -> str:
    """Return how many of many entries are listed, in words; "" where all are."""
    return f", {MOST_LISTED} of {len(every)}" if len(every) > MOST_LISTED else ""


def _end_line(label: str, cases: Sequence[Result]) -> list[str]:
    done = _done(cases)
    ends = Counter(str(case.get("end")) for case in done)
    whole, left = ends["finished"], ends["left_corridor"]
    low, high = rate_interval(len(cases) - whole, len(cases))
    solves = sum(case["solver"].get("solves") or 0 for case in done)
    failures = sum(case["solver"].get("failures") or 0 for case in done)
    by_training = tables.training_range(cases, lambda case: case.get("end") != "finished")
    misses = sum(case["metrics"].get("deadline_misses", 0.0) for case in done)
    braked = sum(case["metrics"].get("stopping_share", 0.0) > 0.0 for case in done)
    return [
        tables.with_trainings(label, tables.trainings_of(cases)), str(len(cases)), str(whole),
        str(left), str(len(done) - whole - left),
        str(len(cases) - len(done)), f"{100 * (1 - whole / len(cases)):.1f}",
        ", ".join(filter(None, [f"{100 * low:.1f} to {100 * high:.1f}", by_training])),
        f"{failures} of {solves}" if solves else "–",
        f"{misses:.0f}", f"{braked}",
    ]  # fmt: skip
