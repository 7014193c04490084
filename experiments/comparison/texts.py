"""Comparisons as text: a table for a terminal of 120 columns, lines that explain it, LaTeX, CSV."""

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from experiments.comparison.competitors import Competitor, Drive
from experiments.comparison.outcomes import Metric, Outcome
from experiments.run.statistics import Interval

HEADINGS = (
    "metric", "mean A", "mean B", "B - A\n[95 %]", "IQM A", "IQM B", "P(B better)\n[95 %]",
    "B wins/\nties/loses",
)  # fmt: skip
LATEX_HEADINGS = (
    "metric", "mean A", "mean B", r"B $-$ A [95\,\%]", "IQM A", "IQM B",
    r"P(B better) [95\,\%]", "W/T/L",
)  # fmt: skip
NOTE = (
    "↓ less is better, ↑ more is better; B - A is positive where B has more. Means and B - A are "
    "over pairs of drives that both passed. All else is over all drives, a failed one being behind "
    "every other: the interquartile mean (IQM), the probability that B is better than A in a "
    "random drive of each on the same path, every path of a setting counting alike, and the drives "
    "that B wins. Speed error, steering rate and jerk are root mean squares. Definitions: Agarwal "
    "et al., NeurIPS 2021."
)
GAP_NOTE = "Optimality gap: 1 - mean(min(1, target / metric)); 0 is the best, a failed drive has 1."
SHOWN = 3
"""Drives of one side alone that are named."""
ESCAPED = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "_%&#${}"},
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}",
    "³": r"\textsuperscript{3}", "²": r"\textsuperscript{2}", "·": r"\textperiodcentered{}",
    "–": "--", "|e_d|": r"$|e_d|$",
}  # fmt: skip


class Line(NamedTuple):
    """Cells of a metric, as numbers of equal decimals."""

    name: str
    mean_a: str
    mean_b: str
    difference: str
    iqm_a: str
    iqm_b: str
    improvement: str
    counts: str


def number(value: float, decimals: int, *, sign: bool = False) -> str:
    """Write a number, zero without a minus; too many failures make interquartile means infinite."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "failed"
    return f"{value:{'+' if sign else ''}z.{decimals}f}"


def with_ends(interval: Interval, decimals: int, *, sign: bool = False) -> str:
    """Write an estimate and its interval, if it has one."""
    value = number(interval.value, decimals, sign=sign)
    if math.isnan(interval.low) or math.isnan(interval.value):
        return value
    low, high = (number(end, decimals) for end in (interval.low, interval.high))
    return f"{value} [{low}, {high}]"


def decimals_of(metric: Metric) -> int:
    """Return the decimals that show three digits of the means and two of the interval.

    Without pairs that passed there are no means: then three digits of the interquartile means.
    """
    values = metric.mean_a, metric.mean_b
    if math.isnan(metric.mean_a):
        values = metric.iqm_a.value, metric.iqm_b.value
    scale = max((abs(one) for one in values if math.isfinite(one)), default=math.nan)
    width = metric.difference.high - metric.difference.low
    wanted = [0]
    if math.isfinite(scale) and scale > 0.0:
        wanted.append(2 - math.floor(math.log10(scale)))
    if math.isfinite(width) and width > 0.0:
        wanted.append(1 - math.floor(math.log10(width)))
    return min(max(wanted), 6)


def line_of(metric: Metric) -> Line:
    """Return the cells of a metric."""
    digits = decimals_of(metric)
    return Line(
        f"{metric.measure.title} {metric.measure.better}",
        number(metric.mean_a, digits),
        number(metric.mean_b, digits),
        with_ends(metric.difference, digits, sign=True),
        number(metric.iqm_a.value, digits),
        number(metric.iqm_b.value, digits),
        with_ends(metric.improvement, 2),
        f"{metric.wins}/{metric.ties}/{metric.losses}",
    )


def name_of(competitor: Competitor) -> str:
    """Return agent and folder."""
    return f"{competitor.label} in {competitor.folder}"


def basis(outcome: Outcome) -> str:
    """Say what was compared: drives, settings, paths, seeds."""
    settings = list(dict.fromkeys(drive.setting for drive in outcome.drives))
    paths = {drive.path for drive in outcome.drives}
    seeds = {drive.seed for drive in outcome.drives}
    where = settings[0] if len(settings) == 1 else f"{len(settings)} settings"
    return (
        f"{_plural(len(outcome.drives), 'drive')} of both: {_plural(len(paths), 'path')}, "
        f"{_plural(len(seeds), 'seed')}, {where}"
    )


def failures(outcome: Outcome) -> str:
    """Say how many drives failed on each side, with intervals of their rates and the test."""
    rates = [
        f"{side} {failed} of {runs} ({100 * low:.1f} to {100 * high:.1f} %)"
        for side, failed, runs, (low, high) in zip(
            "AB", (outcome.failed_a, outcome.failed_b), (outcome.runs_a, outcome.runs_b),
            outcome.failure_rates(), strict=True,
        )
    ]  # fmt: skip
    line = f"failed: {', '.join(rates)}"
    if outcome.a_alone or outcome.b_alone:
        line += f"; A alone {outcome.a_alone}, B alone {outcome.b_alone}"
        if outcome.failures_p is not None:
            line += f", McNemar's exact p = {outcome.failures_p:.2g}"
    return line


def left_out(outcome: Outcome) -> Iterator[str]:
    """Say which drives one side alone has, the first few by name."""
    for side, found in (("A", outcome.only_a), ("B", outcome.only_b)):
        if found:
            yield f"left out, {_plural(len(found), 'drive')} that {side} alone has: {_few(found)}"


def _few(drives: Sequence[Drive]) -> str:
    more = "" if len(drives) <= SHOWN else f"; and {len(drives) - SHOWN} more"
    return "; ".join(map(str, drives[:SHOWN])) + more


def intervals(outcome: Outcome) -> str:
    """Say over what the intervals are."""
    if not outcome.resampled:
        return "no intervals: there is one drive alone"
    return f"95 % intervals: bootstrap, {outcome.resamples:,} resamples, over {outcome.resampled}"


def times(outcome: Outcome) -> str | None:
    """Return the median times of `predict` of both sides; None if they are not known."""
    if outcome.seconds_a is None or outcome.seconds_b is None:
        return None
    return (
        f"median time of predict: A {1e3 * outcome.seconds_a:.3f} ms, "
        f"B {1e3 * outcome.seconds_b:.3f} ms"
    )


def spreads(outcome: Outcome) -> Iterator[str]:
    """Yield, with several trainings, each metric's interval over drives and over trainings."""
    if max(outcome.trainings) == 1:
        return
    found = [one for one in outcome.metrics if math.isfinite(one.difference.value)]
    if found:
        yield "B - A apart: [over drives alone], [over trainings alone]"
    for metric in found:
        digits = decimals_of(metric)
        ends = (
            f"[{number(one.low, digits)}, {number(one.high, digits)}]"
            for one in (metric.over_drives, metric.over_trainings)
        )
        yield f"  {metric.measure.title}: {', '.join(ends)}"


def gaps(outcome: Outcome) -> Iterator[str]:
    """Yield the optimality gaps of metrics that have a target."""
    found = [one for one in outcome.metrics if one.gap_a is not None and one.gap_b is not None]
    for metric in found:
        assert metric.gap_a is not None
        assert metric.gap_b is not None
        yield (
            f"optimality gap of {metric.measure.heading}, target {metric.target:g} "
            f"{metric.measure.unit}: A {with_ends(metric.gap_a, 3)}, "
            f"B {with_ends(metric.gap_b, 3)}"
        )
    if found:
        yield GAP_NOTE


def remarks(outcome: Outcome) -> list[str]:
    """Return the lines below a table."""
    lines = [failures(outcome), intervals(outcome)]
    if line := times(outcome):
        lines.append(line)
    fewer = Counter({one.measure.heading: one.drives for one in outcome.metrics})
    lines += [
        f"{name}: {_plural(count, 'drive')} that have it"
        for name, count in fewer.items()
        if count < len(outcome.drives)
    ]
    return [*lines, *gaps(outcome), *spreads(outcome), *left_out(outcome)]


def terminal(outcomes: Sequence[Outcome]) -> RenderableType:
    """Return all comparisons for a terminal of 120 columns."""
    parts: list[RenderableType] = []
    for outcome in outcomes:
        parts += [
            Text(f"A  {name_of(outcome.a)} (baseline)", style="bold"),
            Text(f"B  {name_of(outcome.b)}", style="bold"),
            Text(basis(outcome)),
            _table(outcome),
            *map(Text, remarks(outcome)),
            Text(),
        ]
    return Group(*parts, Text(NOTE, style="dim"))


def _table(outcome: Outcome) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for place, heading in enumerate(HEADINGS):
        table.add_column(heading, justify="right" if place else "left", no_wrap=place > 0)
    for metric in outcome.metrics:
        style = ""
        difference = metric.difference
        if difference.low * difference.high > 0.0:
            style = "green" if difference.value * metric.measure.sign < 0.0 else "red"
        cells = [Text(cell) for cell in line_of(metric)]
        cells[3].stylize(style)
        table.add_row(*cells)
    return table


def _plural(count: int, word: str) -> str:
    return f"{count:,} {word}{'s' * (count != 1)}"


# LaTeX and CSV ------------------------------------------------------------------------------------


def escaped(text: str) -> str:
    """Return a text as a line with LaTeX's own characters escaped."""
    return "".join(ESCAPED.get(character, character) for character in _flat(text))


def latex(outcomes: Sequence[Outcome], comment: Sequence[str]) -> str:
    r"""Return a `tabular` for the package booktabs, below comments that say what it shows.

    In the text below the table, A is the baseline.
    """
    lines = ["% needs \\usepackage{booktabs}", *(f"% {_flat(line)}" for line in comment)]
    lines += [
        r"\begin{tabular}{lrrrrrrr}",
        r"\toprule",
        " & ".join(LATEX_HEADINGS) + r" \\",
    ]
    for outcome in outcomes:
        heading = f"A: {escaped(outcome.a.label)}, B: {escaped(outcome.b.label)}"
        if outcome.a.folder != outcome.b.folder:
            folders = [escaped(one.folder.name) for one in (outcome.a, outcome.b)]
            heading = (
                f"A: {escaped(outcome.a.label)} ({folders[0]}), "
                f"B: {escaped(outcome.b.label)} ({folders[1]})"
            )
        lines += [r"\midrule", rf"\multicolumn{{8}}{{l}}{{{heading}}} \\", r"\midrule"]
        for metric in outcome.metrics:
            name, *cells = line_of(metric)
            arrow = r"$\downarrow$" if metric.measure.sign > 0.0 else r"$\uparrow$"
            texts = [f"{escaped(name[:-2])} {arrow}", *map(_math, cells)]
            lines.append(" & ".join(texts) + r" \\")
        shares = [
            f"{100 * failed / runs:.1f}\\,\\% [{100 * low:.1f}, {100 * high:.1f}]"
            for failed, runs, (low, high) in zip(
                (outcome.failed_a, outcome.failed_b), (outcome.runs_a, outcome.runs_b),
                outcome.failure_rates(), strict=True,
            )
        ]  # fmt: skip
        lines.append(
            rf"failed & \multicolumn{{7}}{{l}}{{A {shares[0]}, B {shares[1]} of "
            rf"{outcome.runs_a} and {outcome.runs_b} drives}} \\"
        )
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _math(cell: str) -> str:
    """Return a cell of numbers with real minus signs."""
    return escaped(cell).replace("-", "$-$") if "--" not in escaped(cell) else escaped(cell)


def _flat(line: str) -> str:
    return " ".join(line.split())


def _no_formula(text: str) -> str:
    """Return a text as a line that a spreadsheet does not take for a formula to execute."""
    line = _flat(text)
    return f"'{line}" if line.startswith(("=", "+", "-", "@")) else line


CSV_COLUMNS = (
    "baseline", "baseline_folder", "competitor", "competitor_folder", "metric", "unit",
    "less_is_better", "drives", "pairs_both_passed", "mean_a", "mean_b", "difference",
    "difference_low", "difference_high", "relative", "relative_low", "relative_high", "iqm_a",
    "iqm_a_low", "iqm_a_high", "iqm_b", "iqm_b_low", "iqm_b_high", "improvement",
    "improvement_low", "improvement_high", "wins", "ties", "losses", "gap_a", "gap_a_low",
    "gap_a_high", "gap_b", "gap_b_low", "gap_b_high", "runs_a", "failed_a", "runs_b", "failed_b",
)  # fmt: skip


def as_csv(outcomes: Sequence[Outcome]) -> str:
    """Return a line for each metric of each comparison, numbers in full."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for outcome in outcomes:
        for one in outcome.metrics:
            names = (
                _no_formula(str(name))
                for side in (outcome.a, outcome.b)
                for name in (side.label, side.folder)
            )
            estimates = one.difference, one.relative, one.iqm_a, one.iqm_b, one.improvement
            gap_cells = [
                cell
                for gap in (one.gap_a, one.gap_b)
                for cell in (("", "", "") if gap is None else (gap.value, gap.low, gap.high))
            ]
            writer.writerow(
                [
                    *names, one.measure.key, one.measure.unit, one.measure.sign > 0.0, one.drives,
                    one.pairs, one.mean_a, one.mean_b,
                    *(end for each in estimates for end in (each.value, each.low, each.high)),
                    one.wins, one.ties, one.losses, *gap_cells, outcome.runs_a, outcome.failed_a,
                    outcome.runs_b, outcome.failed_b,
                ]
            )  # fmt: skip
    return buffer.getvalue()
