"""Section that says what was driven and what came of it, before any figure."""

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.report.document import Document, first_open, joined, paragraph
from experiments.report.drives import LEAD, family_of, main_family
from experiments.report.html_tables import html_table
from experiments.run import published, tables
from experiments.run.statistics import rate_interval
from experiments.run.tables import Estimate, Result, estimate

HEADINGS = (
    "agent", "whole path", "mean ALE, m", "worst MLE, m", "mean AOE, rad",
    "ALE against published", "median predict, ms", "worst p99, ms", "all constraints kept",
)  # fmt: skip
NOTE = (
    "ALE, AOE: root mean square lateral and heading error, MLE: largest lateral error; over all "
    "runs that did not fail, with the 95 % interval over seeds where there are several. An episode "
    "that ended early counts for the part it drove. “Against published”: mean over T1 to T6 of "
    "ours divided by the published value of the same kind."
)

Tile = tuple[str, str, str]
"""What it is, its value, a remark."""


def summary_section(document: Document, cases: Sequence[Result], superseded: int) -> str:
    """Key findings as tiles, then a table with a line for each agent of each setting."""
    parts = [tiles([*findings(cases), *counts(cases)])]
    if superseded:
        parts.append(
            paragraph(
                f"Left out: {superseded} older result{'s' * (superseded > 1)} of cases that were "
                "run again from other sources."
            )
        )
    family = main_family(cases)
    shown = [
        (
            family_of(group[0]) == family,
            document.table(
                f"Key figures of every agent, {setting}.",
                html_table(HEADINGS, _key_lines(group), range(1, len(HEADINGS))),
            ),
        )
        for setting, group in tables.cases_by_setting(cases).items()
    ]
    parts.append(paragraph(NOTE, "soft"))
    parts.append(first_open(shown, "Other settings"))
    return joined(parts)


def tiles(shown: Iterable[Tile]) -> str:
    """Figures at a glance."""
    items = "".join(
        f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}"
        + (f"<small>{html.escape(remark)}</small>" if remark else "")
        + "</dd></div>"
        for name, value, remark in shown
    )
    return f'<dl class="tiles">{items}</dl>'


def findings(cases: Sequence[Result]) -> list[Tile]:
    """The leading agent's errors under each kind of conditions of the first family."""
    done = [case for case in cases if case.get("status") == "ok"]
    if not done:
        return []
    family = main_family(done)
    labels = {tables.label_of(case) for case in done if family_of(case) == family}
    lead = LEAD if LEAD in labels else tables.label_of(done[0])
    own = [case for case in done if family_of(case) == family and tables.label_of(case) == lead]
    shown: list[Tile] = []
    for conditions in dict.fromkeys(_conditions(case) for case in own):
        group = [case for case in own if _conditions(case) == conditions]
        remark = _against_published(group)
        shown.append(
            (
                f"{lead}: ALE, {conditions}",
                f"{_words(over_seeds(group, 'ale'))} m",
                f"{remark} of the published" if remark != "–" else "",
            )
        )
        worst = max(group, key=lambda case: case["metrics"]["mle"])
        shown.append(
            (
                f"{lead}: largest lateral error, {conditions}",
                f"{worst['metrics']['mle']:.3f} m",
                f"on {worst.get('trajectory')}, of {len(group)} drives",
            )
        )
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
    """What was run, and how it ended."""
    done = [case for case in cases if case.get("status") == "ok"]
    whole = sum(case.get("end") == "finished" for case in done)
    late = [
        case for case in done if case["solver"].get("p99", 0.0) > case.get("control_period", np.inf)
    ]
    low, high = rate_interval(len(cases) - whole, len(cases))
    minutes = sum(case["metrics"].get("duration", 0.0) for case in done) / 60
    computed = sum(case.get("seconds") or 0.0 for case in cases) / 60
    agents = len({tables.label_of(case) for case in cases})
    paths = len({str(case.get("trajectory")) for case in cases})
    seeds = len({case.get("seed") for case in cases})
    return [
        (
            "drove the whole path", f"{whole} of {len(cases)}",
            f"failures: {100 * low:.1f} to {100 * high:.1f} % (95 %)",
        ),
        ("failed cases", f"{len(cases) - len(done)}", "ended in an error"),
        (
            "p99 of predict over the control period", f"{len(late)} of {len(done)}", "drives",
        ),
        (
            "cases", f"{len(cases)}",
            f"{agents} agent{_s(agents)}, {paths} path{_s(paths)}, {seeds} seed{_s(seeds)}",
        ),
        ("time driven", f"{minutes:.0f} min", f"{computed:.1f} min of computing"),
    ]  # fmt: skip


def _s(number: int) -> str:
    return "s" * (number != 1)


def _conditions(case: Result) -> str:
    return tables.conditions_words(case.get("conditions", "simulation"))


def over_seeds(cases: Iterable[Result], key: str) -> Estimate:
    """Mean over seeds of the mean over a seed's drives, with its interval.

    Drives of one seed share their disturbances whatever the path.
    """
    by_seed: dict[Any, list[float]] = {}
    for case in cases:
        by_seed.setdefault(case.get("seed"), []).append(float(case["metrics"][key]))
    return estimate([sum(values) / len(values) for values in by_seed.values()])


def _words(value: Estimate, decimals: int = 3) -> str:
    mean = f"{value.mean:.{decimals}f}"
    width = value.half_width
    return mean if width is None else f"{mean} ±{width:.{decimals}f}"


def _key_lines(cases: Sequence[Result]) -> list[list[str]]:
    lines = []
    for label in tables.labels(cases):
        group = [case for case in cases if tables.label_of(case) == label]
        done = [case for case in group if case.get("status") == "ok"]
        finished = sum(case.get("end") == "finished" for case in group)
        line = [label, f"{finished} of {len(group)}"]
        if not done:
            lines.append([*line, *["–"] * 7])
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
