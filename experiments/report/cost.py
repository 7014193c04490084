"""Sections on cost: times of `predict` against the control period, and what learning took."""

import html
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from experiments.report.drives import Drive, by_setting, family_of
from experiments.report.page import (
    Document,
    Panel,
    Styles,
    first_open,
    html_table,
    joined,
    legend,
    paragraph,
)
from experiments.report.svg_charts import Chart, Scale, decades
from experiments.run.learning_cost import UNKNOWN, duration
from experiments.run.tables import Result, trainings

Array = NDArray[np.float64]

RAREST = 1e-4
"""Smallest share of calls that is drawn."""
PERIOD = 0.05
HEADINGS = (
    "agent", "calls", "median, ms", "95 %, ms", "99 %, ms", "longest, ms", "control period, ms",
    "longer than the period, %",
)  # fmt: skip
NOTE = (
    "Times of whole calls of predict, on the machine of the manifest with all its workers busy, "
    "in the drives that are drawn (of several seeds the first). The first call of an episode "
    "counts like any other."
)
LEARNING_NOTE = (
    "Environment steps, wall time with validation on the training machine, and NMPC solves for "
    "demonstrations or for the base of a residual policy. They count the whole training, although "
    "the agent drives with the checkpoint that was best on the validation paths, and include the "
    "training that it continued (--from), if any. Agents that are not listed were designed by "
    "hand, at a cost that was not recorded."
)
TRAINED_NOTE = (
    "Trained: environment steps, wall time and NMPC solves of the training; “–” for agents "
    "designed by hand, whose cost was not recorded."
)


def calls_of(drives: Iterable[Drive]) -> dict[str, Array]:
    """Return the times (s) of all calls of each agent, without periods in which it was busy."""
    found: dict[str, list[Array]] = {}
    for drive in drives:
        seconds = drive.trace["solve_time"][1:]
        found.setdefault(drive.label, []).append(seconds[seconds > 0.0])
    return {label: calls for label, every in found.items() if (calls := np.concatenate(every)).size}


def computing_section(document: Document, drives: Sequence[Drive], styles: Styles) -> str:
    """Return the distribution of the calls' times, and the share that missed the deadline."""
    groups = {
        setting: (group, calls)
        for setting, group in by_setting(drives).items()
        if (calls := calls_of(group))
    }
    if not groups:
        return ""
    family = family_of(drives[0].case)
    own = [setting for setting, (group, _) in groups.items() if family_of(group[0].case) == family]
    drawn = own or list(groups)[:1]
    panels = [
        Panel(str(setting), _exceedance(groups[setting][1], styles, _period(groups[setting][0])))
        for setting in drawn
    ]
    shown = {label for setting in drawn for label in groups[setting][1]}
    figure = document.figure(
        "Share of calls of predict that took longer than a time. Both axes are logarithmic: a line "
        "crosses 0.5 at the median and 0.01 at the 99th percentile. Dashed in red: the control "
        "period, which is the deadline.",
        panels, legend(styles, shown), wide=True,
    )  # fmt: skip
    parts = [
        (
            setting in drawn,
            document.table(
                f"Times of predict, and the share of calls that missed the deadline, {setting}.",
                html_table(
                    HEADINGS,
                    [_line(label, own, _period(group)) for label, own in calls.items()],
                    range(1, len(HEADINGS)),
                ),
            ),
        )
        for setting, (group, calls) in groups.items()
    ]
    return joined([paragraph(NOTE), figure, first_open(parts, "Other settings")])


def _period(drives: Iterable[Drive]) -> float:
    return min(float(drive.case.get("control_period", PERIOD)) for drive in drives)


def _exceedance(calls: Mapping[str, Array], styles: Styles, period: float) -> str:
    every = [np.array([one.min(), one.max(), period]) for one in calls.values()]
    chart = Chart(
        decades([1e3 * one for one in every], 1e-4),
        Scale(RAREST, 1.15, log=True),
        x_label="time t (ms)", y_label="share of calls longer than t", height=230.0,
    )  # fmt: skip
    for label, style in styles.items():
        if label not in calls:
            continue
        ordered = np.sort(calls[label])
        longer = 1.0 - np.arange(1, len(ordered) + 1) / len(ordered)
        # Evenly over the logarithm of the share, so that the tail is as detailed as the middle.
        wanted = np.geomspace(1.0, RAREST, 160)
        kept = np.unique(np.searchsorted(-longer, -wanted).clip(0, len(ordered) - 1))
        chart.line(
            1e3 * ordered[kept], np.maximum(longer[kept], 0.5 * RAREST), style.kind, style.width
        )
    chart.rule(x=1e3 * period)
    chart.note(f"{1e3 * period:g} ms ", 1e3 * period, 0.72, "limit", "end")
    return chart.svg()


def _line(label: str, calls: Array, period: float) -> list[str]:
    median, high, rare = 1e3 * np.percentile(calls, (50, 95, 99))
    late = int((calls > period).sum())
    share = f"{100 * late / len(calls):.3f}" if late else "0"
    return [
        label, f"{len(calls):,}", f"{median:.3f}", f"{high:.3f}", f"{rare:.3f}",
        f"{1e3 * calls.max():.2f}", f"{1e3 * period:g}", share,
    ]  # fmt: skip


def learning_section(document: Document, cases: Iterable[Result]) -> str:
    """Return the cost of each learned policy and the command that trains it; "" without any."""
    found = trainings(cases)
    if not found:
        return ""
    lines = [
        [
            label,
            str(training.get("algorithm", UNKNOWN)),
            f"{training['steps']:,}" if "steps" in training else UNKNOWN,
            duration(training["seconds"]) if "seconds" in training else UNKNOWN,
            f"{training['solves']:,}" if "solves" in training else UNKNOWN,
        ]
        for label, training in found
    ]
    headings = ("agent", "algorithm", "steps", "wall time", "NMPC solves")
    commands = "\n".join(
        f"# {label}\n{training.get('command', f'# {UNKNOWN}')}" for label, training in found
    )
    return joined(
        [
            paragraph(LEARNING_NOTE),
            document.table("What learning cost.", html_table(headings, lines, range(2, 5))),
            f'<pre tabindex="0">{html.escape(commands)}</pre>',
        ]
    )
