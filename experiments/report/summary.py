"""Sections that count: key figures of every agent, how drives ended, errors and warnings."""

import html
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.report.drives import LEAD, family_of, main_family, per_setting
from experiments.report.page import Document, html_table, joined, paragraph
from experiments.run import published, tables
from experiments.run.statistics import rate_interval
from experiments.run.tables import Estimate, Result, estimate

KEY_HEADINGS = (
    "agent", "whole path", "mean ALE, m", "worst MLE, m", "mean AOE, rad",
    "ALE against published", "median predict, ms", "worst p99, ms", "all constraints kept",
)  # fmt: skip
KEY_NOTE = (
    "ALE, AOE: root mean square lateral and heading error, MLE: largest lateral error; over all "
    "runs that did not fail, with the 95 % interval over seeds where there are several. An episode "
    "that ended early counts for the part it drove. “Against published”: mean over T1 to T6 of "
    "ours divided by the published value of the same kind."
)
END_HEADINGS = (
    "agent", "drives", "whole path", "left the corridor", "other ends", "failed cases",
    "not the whole path, %", "95 % interval, %", "solves failed", "deadline misses",
    "drives that braked by themselves",
)  # fmt: skip
END_NOTE = (
    "A drive fails if it does not reach the end of the path. Intervals are two-sided "
    "Clopper-Pearson intervals of the rate of failures. Drives of one seed share their "
    "disturbances and so are not quite independent. Deadline misses are computations that ended "
    "too late in the simulated vehicle; a vehicle brakes by itself when no command arrives in time."
)

Tile = tuple[str, str, str]
"""Name, value and remark of a figure at a glance."""


def summary_section(document: Document, cases: Sequence[Result], superseded: int) -> str:
    """Return key findings as tiles, then a table with a line for each agent of each setting.

    Parameters
    ----------
    document
        Page to number the tables.
    cases
        Results to report.
    superseded
        Number of results left out because later ones repeat their cases.
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
    parts.append(
        per_setting(
            cases,
            lambda setting, group: document.table(
                f"Key figures of every agent, {setting}.",
                html_table(KEY_HEADINGS, _key_lines(group), range(1, len(KEY_HEADINGS))),
            ),
        )
    )
    return joined(parts)


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
        words = tables.conditions_words(case.get("conditions", "simulation"))
        by_conditions.setdefault(words, []).append(case)
    shown: list[Tile] = []
    for conditions, group in by_conditions.items():
        remark = _against_published(group)
        worst = max(group, key=lambda case: case["metrics"]["mle"])
        shown += [
            (
                f"{lead}: ALE, {conditions}",
                f"{_words(over_seeds(group, 'ale'))} m",
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


def over_seeds(cases: Iterable[Result], key: str) -> Estimate:
    """Return the mean over seeds of the mean over a seed's drives, with its interval.

    Drives of one seed share their disturbances whatever the path.
    """
    by_seed: dict[Any, list[float]] = {}
    for case in cases:
        by_seed.setdefault(case.get("seed"), []).append(float(case["metrics"][key]))
    return estimate([sum(values) / len(values) for values in by_seed.values()])


def _words(value: Estimate) -> str:
    width = value.half_width
    return f"{value.mean:.3f}" if width is None else f"{value.mean:.3f} ±{width:.3f}"


def _by_label(cases: Sequence[Result]) -> dict[str, list[Result]]:
    """Group cases by their agent's label, in the order of the tables."""
    return {
        label: [case for case in cases if tables.label_of(case) == label]
        for label in tables.labels(cases)
    }


def _key_lines(cases: Sequence[Result]) -> list[list[str]]:
    lines = []
    for label, group in _by_label(cases).items():
        done = _done(group)
        finished = sum(case.get("end") == "finished" for case in group)
        line = [label, f"{finished} of {len(group)}"]
        if not done:
            lines.append([*line, *["–"] * (len(KEY_HEADINGS) - len(line))])
            continue
        metrics: list[Mapping[str, float]] = [case["metrics"] for case in done]
        worst = max(done, key=lambda case: case["metrics"]["mle"])
        kept = sum(not tables.violated(one) for one in metrics)
        medians = [case["solver"]["median"] for case in done]
        lines.append(
            [
                *line,
                _words(over_seeds(done, "ale")),
                f"{worst['metrics']['mle']:.3f} ({worst.get('trajectory')})",
                _words(over_seeds(done, "aoe")),
                _against_published(done),
                f"{1e3 * np.median(medians):.3f}",
                f"{1e3 * max(case['solver']['p99'] for case in done):.2f}",
                f"{kept} of {len(done)}",
            ]
        )
    return lines


def _against_published(cases: Iterable[Result]) -> str:
    shares = [
        case["metrics"]["ale"] / row["ale"]
        for case in cases
        if case.get("trajectory") in published.SIMULATION
        and (row := published.row(str(case["trajectory"]), case.get("conditions", "simulation")))
        is not None
    ]
    return f"{100 * np.mean(shares):.1f} %" if shares else "–"


def failures_section(document: Document, cases: Sequence[Result]) -> str:
    """Return counts with bounds, then each failed case with its error and each warning."""
    ends = per_setting(
        cases,
        lambda setting, group: document.table(
            f"How drives ended, with the rate of failures and its 95 % interval, {setting}.",
            html_table(
                END_HEADINGS,
                [_end_line(label, own) for label, own in _by_label(group).items()],
                range(1, len(END_HEADINGS)),
            ),
        ),
    )
    failed = [
        [
            str(case["id"]), tables.label_of(case), str(case.get("trajectory")),
            tables.setting_of(case), str(case.get("seed")), str(case.get("error", "no message")),
        ]
        for case in cases
        if case.get("status") != "ok"
    ]  # fmt: skip
    warnings = Counter(text for case in cases for text in case.get("warnings") or [])
    parts = [paragraph(END_NOTE), ends]
    if failed:
        headings = ("id", "agent", "path", "setting", "seed", "error")
        parts.append(document.table("Failed cases.", html_table(headings, failed, (4,), (5,))))
    if warnings:
        lines = [[str(count), text] for text, count in sorted(warnings.items())]
        parts.append(
            document.table(
                "Warnings, and the number of cases that gave them.",
                html_table(("cases", "warning"), lines, (0,), (1,)),
            )
        )
    return joined(parts)


def _end_line(label: str, cases: Sequence[Result]) -> list[str]:
    done = _done(cases)
    ends = Counter(str(case.get("end")) for case in done)
    whole, left = ends["finished"], ends["left_corridor"]
    low, high = rate_interval(len(cases) - whole, len(cases))
    solves = sum(case["solver"].get("solves") or 0 for case in done)
    failures = sum(case["solver"].get("failures") or 0 for case in done)
    misses = sum(case["metrics"].get("deadline_misses", 0.0) for case in done)
    braked = sum(case["metrics"].get("stopping_share", 0.0) > 0.0 for case in done)
    return [
        label, str(len(cases)), str(whole), str(left), str(len(done) - whole - left),
        str(len(cases) - len(done)), f"{100 * (1 - whole / len(cases)):.1f}",
        f"{100 * low:.1f} to {100 * high:.1f}", f"{failures} of {solves}" if solves else "–",
        f"{misses:.0f}", f"{braked}",
    ]  # fmt: skip
