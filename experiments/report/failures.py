"""Section on what went wrong: ends of drives, failed solves and cases, warnings."""

from collections import Counter
from collections.abc import Iterable, Sequence

from experiments.report.document import Document, first_open, joined, paragraph
from experiments.report.drives import family_of, main_family
from experiments.report.html_tables import html_table
from experiments.run import tables
from experiments.run.statistics import rate_interval
from experiments.run.tables import Result

HEADINGS = (
    "agent", "drives", "whole path", "left the corridor", "other ends", "failed cases",
    "not the whole path, %", "95 % interval, %", "solves failed", "deadline misses",
    "drives that braked by themselves",
)  # fmt: skip
NOTE = (
    "A drive fails if it does not end at the path's end. Intervals are two-sided Clopper-Pearson "
    "ones: rates of failure under which what was seen would not be surprising. Drives of one seed "
    "share their disturbances, so that they are not quite independent. Deadline misses are "
    "computations that landed late in the simulated vehicle; a vehicle brakes by itself when it "
    "gets no command in time."
)


def failures_section(document: Document, cases: Sequence[Result]) -> str:
    """Counts with bounds, then each failed case with its error and each warning."""
    family = main_family(cases)
    shown = [
        (
            family_of(group[0]) == family,
            document.table(
                f"How drives ended, with the rate of failures and its 95 % interval, {setting}.",
                html_table(
                    HEADINGS,
                    [
                        _line(label, [case for case in group if tables.label_of(case) == label])
                        for label in tables.labels(group)
                    ],
                    range(1, len(HEADINGS)),
                ),
            ),
        )
        for setting, group in tables.cases_by_setting(cases).items()
    ]
    failed = [case for case in cases if case.get("status") != "ok"]
    return joined(
        [
            paragraph(NOTE),
            first_open(shown, "Other settings"),
            document.table(
                "Failed cases.",
                html_table(
                    ("id", "agent", "path", "setting", "seed", "error"), _failed(failed), (4,), (5,)
                ),
            )
            if failed
            else "",
            _warnings(document, cases),
        ]
    )


def _line(label: str, cases: Sequence[Result]) -> list[str]:
    done = [case for case in cases if case.get("status") == "ok"]
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


def _failed(cases: Iterable[Result]) -> list[list[str]]:
    return [
        [
            str(case["id"]), tables.label_of(case), str(case.get("trajectory")),
            tables.setting_of(case), str(case.get("seed")), str(case.get("error", "no message")),
        ]
        for case in cases
    ]  # fmt: skip


def _warnings(document: Document, cases: Iterable[Result]) -> str:
    """Each different warning once, with the number of cases that gave it."""
    counts = Counter(text for case in cases for text in case.get("warnings") or [])
    if not counts:
        return ""
    lines = [[str(count), text] for text, count in sorted(counts.items())]
    return document.table(
        "Warnings, and the number of cases that gave them.",
        html_table(("cases", "warning"), lines, (0,), (1,)),
    )
