"""The leaderboard as one HTML page and as Markdown; both hold what anybody may have written."""

import html
import json
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from experiments.leaderboard.marks import Mark
from experiments.leaderboard.rows import CUSTOM, LONGEST, Row, Section, groups_of
from experiments.leaderboard.scores import Score, score
from experiments.report.build import skipped_note
from experiments.report.page import Cell, Document, folded, html_table, joined, paragraph
from experiments.run import regimes
from experiments.run.learning_cost import words
from experiments.run.ranking import Place, ranked
from experiments.run.result_schema import plain
from experiments.run.statistics import rate_interval
from experiments.run.tables import path_name
from trajectories.arguments import shortened

HEADINGS = (
    "agent", "place", "mean rank", "whole path", ("ALE", "m"), ("MLE", "m"), ("predict", "ms"),
    "drives", "trainings", "rerun here",
)  # fmt: skip
ORIGIN = (
    "agent", "revision", "versions", "processor", "system", "cost of training", "differs here",
)  # fmt: skip
NUMERIC = range(1, 9)
NOTES = (
    (
        "A row is an agent in a folder of results. The rows of a section are ranked on the drives "
        "that its suite gives to every agent; further drives of a folder do not count. A row "
        "that lacks some of them is incomplete: it has no place, and its figures are those of "
        "its own drives."
    ),
    (
        "In every drive the rows are ranked: one that fails is behind all that pass, and those "
        "that pass by the first figure of their regime (MLE; from a start ALE; entry speed; "
        "fastest lap). An agent with several trainings has the mean rank over them. The mean rank "
        "counts every regime alike, and in suites without regimes every setting; its "
        "95 % interval is a bootstrap over the drives of each, and over trainings. It depends "
        "on who else is on the board."
    ),
    (
        "ALE and MLE, the root mean square and the largest lateral error, are interquartile "
        "means over drives (Agarwal et al. 2021), a failed drive counting as infinitely bad: "
        "they are infinite (∞) where more than a quarter failed. Their 95 % intervals are "
        "bootstraps over drives as in lpv-track compare, stratified by path; agents with several "
        "trainings have a second one over trainings. Beside the drives that reached the end of "
        "their path stands the Clopper-Pearson interval of the rate of failures, with several "
        "trainings the least and the most drives of one training. The times of predict are the "
        "median over drives of each drive's median, and the largest 99th percentile of a drive "
        "(p99), on the row's own machine."
    ),
    (
        "Rerun here: a sample of the row's cases was run again on the machine that made this "
        "page. Where versions, sources and processor are those of the row, every bit must be "
        "the same; elsewhere values must agree within the tolerance of lpv-track reproduce. A "
        "row has no place if a case does not reproduce, or if an id does not fit the fields of "
        "its case. A sample proves nothing about the other cases: the commands below each table "
        "run the same sample again, and without --id all cases; for an agent that is a file add "
        "--open-named-files, which executes that file."
    ),
)
FROM_OTHERS = (
    "Run a suite with your agent beside some others, such as lpv-track benchmark --suite limits "
    "--agents lpv-nmpc my_controllers.py:Mine --out results/mine, and hand in cases.jsonl and "
    "manifest.json of that folder; traces are not needed. An agent of your own can only be run "
    "again with its file, its policy or its weights: hand them in, too. Whoever makes the page "
    "gives the command all folders, yours among them."
)
LONGEST_LINE = 20_000
"""Characters of the longest JSON line of a case that the page shows."""
SHOWN_VERSIONS = ("python", "numpy", "scipy", "numba", "casadi", "torch")


@dataclass(frozen=True)
class Entry:
    """A row as it stands on the board.

    Parameters
    ----------
    row
        The row.
    mark
        Verdict of its reruns.
    place
        Its place, from 1; None if it is not ranked.
    rank
        Its mean rank with interval.
    sample
        Ids of its sample.
    """

    row: Row
    mark: Mark
    place: int | None
    rank: Place | None
    sample: Sequence[str]

    @cached_property
    def scores(self) -> tuple[Score, Score] | None:
        """Return the scores of ALE and MLE; None without drives that all trainings have."""
        if not self.row.shared:
            return None
        ale, mle = (score(self.row.losses(key), self.row.plan) for key in ("ale", "mle"))
        return ale, mle


def entries_of(
    section: Section, marks: Mapping[str, Mark], samples: Mapping[str, Sequence[str]]
) -> list[Entry]:
    """Rank the complete rows of a section that no rerun refutes; the others come behind."""

    def mark(row: Row) -> Mark:
        return marks.get(row.key, Mark())

    kept = [row for row in section.rows if row.complete and not mark(row).refuted]
    places = ranked(groups_of(kept)) if kept else []
    ranks = {place.label: place for place in places}
    numbers = {  # equal ranks share a place
        place.label: 1 + sum(other.rank < place.rank for other in places) for place in places
    }
    entries = [
        Entry(row, mark(row), numbers.get(row.key), ranks.get(row.key), samples.get(row.key, ()))
        for row in section.rows
    ]
    last = len(entries) + 1
    return sorted(entries, key=lambda one: (one.place or last, one.row.label, one.row.name))


def cells(entry: Entry) -> list[Cell]:
    """Return text and remark of each of `HEADINGS`."""
    row, rank = entry.row, entry.rank
    scores = entry.scores
    finished = sum(map(regimes.passed, row.cases))
    solver = [case["solver"] for case in row.cases if case["status"] == "ok"]
    return [
        _agent(row),
        (str(entry.place), "") if entry.place else ("–", _why_unranked(entry)),
        (f"{rank.rank:.2f}", f"{rank.low:.2f} to {rank.high:.2f}") if rank else ("–", ""),
        (f"{finished} of {len(row.cases)}", _failures(row, finished)),
        *((_score(one) for one in scores) if scores else [("–", "")] * 2),
        (
            number(1e3 * float(np.median([one["median"] for one in solver])), 3),
            f"p99 {number(1e3 * max(one['p99'] for one in solver), 2)}",
        )
        if solver
        else ("–", ""),
        (
            f"{len(row.shared)} of {row.drives}",
            f"and {row.further} further" if row.further else "",
        ),
        _trainings(row),
        (entry.mark.words, shortened(entry.mark.remark, 2 * LONGEST)),
    ]


def origin(entry: Entry) -> list[Cell]:
    """Return the columns of `ORIGIN`, as far as manifests have them; last what differs here."""
    row = entry.row
    other = shortened(entry.mark.differs, 2 * LONGEST)
    return [_agent(row), *_provenance(row.manifests), _cost(row), other or "–"]


def _agent(row: Row) -> tuple[str, str]:
    return shortened(row.label, LONGEST), row.name


def _why_unranked(entry: Entry) -> str:
    return "incomplete" if not entry.row.complete else ""


def _failures(row: Row, finished: int) -> str:
    """Return the interval of the rate of failures; of several trainings the range of counts."""
    if not row.cases:
        return ""
    if len(row.by_training) > 1:
        counts = [sum(map(regimes.passed, own.values())) for own in row.by_training.values()]
        return f"by training {min(counts)} to {max(counts)} of {len(row.shared)}"
    low, high = rate_interval(len(row.cases) - finished, len(row.cases))
    return f"failures {100 * low:.1f} to {100 * high:.1f} %"


def _score(one: Score) -> tuple[str, str]:
    drives, trainings = _interval(one.drives), _interval(one.trainings)
    over = (("drives", drives), ("trainings", trainings))
    both = "; ".join(f"{name} {ends}" for name, ends in over if ends)
    return number(one.value, 4), both if trainings else drives


def _interval(ends: tuple[float, float] | None) -> str:
    if ends is None or not np.isfinite(ends[0]):
        return ""
    return f"{number(ends[0], 4)} to {number(ends[1], 4)}"


def number(value: float, decimals: int) -> str:
    """Write a number that may be huge or infinite."""
    if not np.isfinite(value):
        return "∞"
    return f"{value:.{decimals}f}" if abs(value) < 1e5 else f"{value:.3g}"


def _trainings(row: Row) -> str:
    """Return the number of trainings; "–" for agents that were not trained, as far as is known."""
    if not row.seeds:
        return "1" if row.trained else "–"
    return str(len(row.seeds))


def _cost(row: Row) -> str:
    """Return the cost of all trainings together."""
    costs = row.trained
    if not costs:
        return "not recorded" if row.seeds else "–"
    whole = {
        key: sum(cost[key] for cost in costs)
        for key in ("steps", "seconds", "solves")
        if all(key in cost for cost in costs)
    }
    return words(whole)


def _provenance(manifests: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return revisions, versions, processors and systems of manifests, each different one once."""
    found: list[list[str]] = [[], [], [], []]
    for manifest in manifests:
        revision, versions, hardware = (
            value if isinstance(value := manifest.get(key), Mapping) else {}
            for key in ("revision", "versions", "hardware")
        )
        changed = " with changes" if revision.get("modified") else ""
        commit, sources = revision.get("commit"), revision.get("sources")
        texts = (
            f"{str(commit)[:12]}{changed}" if commit else f"sources {str(sources or '?')[:16]}",
            ", ".join(f"{key} {versions[key]}" for key in SHOWN_VERSIONS if key in versions),
            str(hardware.get("processor", "?")),
            f"{hardware.get('cores', '?')} cores, {hardware.get('system', '?')}",
        )
        for column, text in zip(found, texts, strict=True):
            column.append(text)
    return [_once(column) for column in found]


def _once(texts: Sequence[str]) -> str:
    return shortened("; ".join(dict.fromkeys(texts)), LONGEST)


def title_of(section: Section) -> str:
    """Return the title of a section: its suite, or paths of drives without one."""
    if section.suite != CUSTOM:
        more = f", {section.seeds} seeds" if section.seeds > 1 else ""
        return f"Suite {section.suite}{more}"
    found = {path_name(case.get("trajectory")) for row in section.rows for case in row.cases}
    names = sorted(found)
    rest = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return shortened(f"Custom drives: {', '.join(names[:6])}{rest}", LONGEST)


def command_of(entry: Entry) -> str:
    """Return the command that runs a row's sample again, or without one a sample of its folder."""
    ids = ["--id", *entry.sample] if entry.sample else ["--sample", "5"]
    return shlex.join(["lpv-track", "reproduce", str(entry.row.store.folder), *ids])


def page(
    sections: Sequence[tuple[Section, Sequence[Entry]]],
    title: str,
    subtitle: str,
    skipped: Sequence[str],
) -> str:
    """Return the page as text; `skipped` are messages on lines and folders not read."""
    document = Document()
    for section, entries in sections:
        table = document.table(
            f"{title_of(section)}, {len(section.drives)} drives.",
            html_table(HEADINGS, map(cells, entries), NUMERIC, (9,)),
        )
        sources = document.table(
            "Origin of the rows.",
            html_table(ORIGIN, map(origin, entries), wrapped=range(1, len(ORIGIN))),
        )
        again = folded(
            "Where the rows come from, and how to run a sample of each again",
            joined([sources, _commands(entries)]),
        )
        document.section(title_of(section), joined([table, again]))
    document.section("How it is made", joined([skipped_note(skipped), *map(paragraph, NOTES)]))
    document.section("How to add a row", paragraph(FROM_OTHERS))
    return document.render(title, subtitle)


def _commands(entries: Iterable[Entry]) -> str:
    """Return a block for each row: its command, and a case as the line that `reproduce -` reads."""
    blocks = []
    for entry in entries:
        name = ", ".join(shortened(part, LONGEST) for part in _agent(entry.row))
        text = f"# {name}\n{command_of(entry)}"
        if line := _line(entry):
            text += f"\n# or paste one of its cases:\nlpv-track reproduce -\n{line}"
        blocks.append(f'<pre tabindex="0">{html.escape(text)}</pre>')
    return joined(blocks)


def _line(entry: Entry) -> str:
    """Return a case of a row's sample as JSON; "" if it is too long, or there is none."""
    found = {case["id"]: case for case in entry.row.cases}
    chosen = found.get(next(iter([*entry.sample, *found]), ""))
    line = json.dumps(plain(chosen, "case"), sort_keys=True) if chosen else ""
    return line if len(line) <= LONGEST_LINE else ""


def markdown(
    sections: Sequence[tuple[Section, Sequence[Entry]]],
    title: str,
    command: str,
    skipped: Sequence[str],
) -> str:
    """Return the board as Markdown, made by `command`."""
    parts = [f"# {escaped(title)}", f"Made by {code(command)}; do not edit."]
    for section, entries in sections:
        parts.append(f"## {escaped(title_of(section))}, {len(section.drives)} drives")
        parts.append(_table(HEADINGS, map(cells, entries), NUMERIC))
        parts.append(_table(ORIGIN, map(origin, entries)))
        commands = "\n".join(dict.fromkeys(" ".join(command_of(one).split()) for one in entries))
        parts.append(f"These commands run a sample again:\n\n```sh\n{commands}\n```")
    parts.append("## How it is made")
    if skipped:
        parts.append(f"Left out, because it cannot be read: {escaped('; '.join(skipped[:5]))}.")
    parts += [*map(escaped, NOTES), "## How to add a row", escaped(FROM_OTHERS)]
    return "\n\n".join(parts) + "\n"


def _table(
    headings: Sequence[Cell], lines: Iterable[Sequence[Cell]], numeric: Sequence[int] = ()
) -> str:
    """Return a table in Markdown, remarks below the texts."""

    def cell(content: Cell, separator: str) -> str:
        texts = (content,) if isinstance(content, str) else content
        return separator.join(escaped(text) for text in texts if text)

    rule = ["--:" if place in numeric else "---" for place in range(len(headings))]
    rows = [[cell(one, ", ") for one in headings], rule]
    rows += [[cell(one, "<br>") for one in line] for line in lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def code(text: str) -> str:
    """Return text as code within a line of Markdown, whatever backticks and line ends it holds."""
    marks = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    space = " " * (len(marks) > 1)
    return f"{marks}{space}{' '.join(text.split())}{space}{marks}"


def escaped(text: str) -> str:
    """Return text that Markdown and its extensions show as it is, in a cell of a table too."""
    line = " ".join(html.escape(text, quote=False).split())
    return re.sub(r"[\\`*\[\]{}|~^$#!]", lambda match: f"&#{ord(match[0])};", line)
