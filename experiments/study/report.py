"""Report of the tuning study: one page with tables, figures and the manifest."""

import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.report.page import (
    Document,
    html_table,
    joined,
    legend,
    line_styles,
    paragraph,
)
from experiments.run.metrics import BANDS
from experiments.run.provenance import provenance
from experiments.run.statistics import Interval
from experiments.study import figures, tables
from experiments.study.oracle import Headroom
from experiments.study.study import BASELINE, OURS, PPO, Study
from trajectories.fileio import write_atomically

FORMULA = (
    "score = rms lateral error / 0.05 m + rms heading error / 0.1 rad + rms speed error / 0.5 m/s "
    "(tracking) + rms steering rate / 0.2 rad/s + rms jerk / 4 m/s³ (comfort); of the true state, "
    "mean over drives, lower is better; a drive that fails scores 25"
)


def write_report(
    study: Study, headroom: list[Headroom], greedy: float | None, file: Path
) -> dict[str, Any]:
    """Write the page and `summary.json` beside it; return the content of the summary."""
    main = study.sets[0].name
    rows = [
        tables.rung_result(study, main, label)
        for label in tables.labels_under(study, disturbed=True)
    ]
    gain = None if greedy is None else 1.0 - greedy / headroom[0].hindsight
    page = Document()
    page.section("Score", paragraph(f"{FORMULA}."))
    page.section("Headroom", _headroom(page, headroom, greedy))
    page.section(f"The ladder on {main}", _ladder(page, main, rows, gain))
    rivals = [row.rung.label for row in rows if row.rung.label != BASELINE]
    gains = {}
    if BASELINE in study.labels:
        gains = {label: tables.band_gains(study, main, label) for label in rivals}
        page.section(
            f"Gains in each band of curvature on {main}",
            page.table(
                "Gains over the best fixed set, of the score of the periods in a band.",
                html_table(
                    ("rung", *BANDS.names), tables.band_lines(gains), range(1, 1 + len(BANDS.names))
                ),
            ),
        )
    if alone := tables.labels_under(study, disturbed=False):
        name = next(one.name for one in study.sets if one.conditions == "simulation")
        undisturbed = [tables.rung_result(study, name, label) for label in alone]
        page.section(
            f"Curvature alone: {name}",
            paragraph("Tuned and evaluated without disturbances: drives differ in the path alone.")
            + _ladder(page, name, undisturbed, None),
        )
    headings, lines = tables.sets_lines(study, study.labels)
    page.section(
        "Every set",
        page.table("Scores on every set.", html_table(headings, lines, range(1, len(headings)))),
    )
    for given in study.sets:
        if given.name.startswith("six"):
            page.section(f"In the paper's terms: {given.name}", _paper(page, study, given.name))
    page.section("Figures", _figures(page, study, rows, greedy, gains))
    manifest = {
        "solves": study.solves, "seeds": list(study.seeds), "rungs": list(study.labels),
        "sets": [
            {"name": one.name, "paths": list(one.labels), "seeds": one.seeds,
             "conditions": one.conditions}
            for one in study.sets
        ],
        **provenance(),
    }  # fmt: skip
    page.section(
        "Manifest", f'<pre tabindex="0">{html.escape(json.dumps(manifest, indent=2))}</pre>'
    )
    subtitle = f"{len(study.seeds)} trainings a rung, {study.solves:,} solves each"
    text = page.render("Tuning study: weights of the NMPC", subtitle)
    write_atomically(file, text.encode())
    summary = {
        **manifest,
        "headroom": [vars(row) for row in headroom],
        "greedy": greedy,
        "ladder": tables.rung_lines(rows, gain),
    }
    write_atomically(file.with_name("summary.json"), json.dumps(summary, indent=2).encode())
    return summary


def _ladder(page: Document, name: str, rows: list[tables.RungResult], gain: float | None) -> str:
    """Return the table of the rungs' results, and one of what the rungs are."""
    words = [[row.rung.label, row.rung.words] for row in rows]
    headings = tables.RUNG_HEADINGS
    lines = tables.rung_lines(rows, gain)
    prose = headings.index("what it is")
    return joined(
        [
            page.table(
                f"The ladder on {name}. Interquartile means over trainings; intervals by bootstrap "
                "over trainings and paths, 10,000 resamples. Gains are those over the best fixed "
                "set, paired: the same drives, training against training. “At most” is the 95 % "
                "Clopper-Pearson bound on the rate of failures.",
                html_table(
                    [one for k, one in enumerate(headings) if k != prose],
                    [[one for k, one in enumerate(line) if k != prose] for line in lines],
                    range(1, len(headings) - 1),
                ),
            ),
            page.table("What the rungs are.", html_table(("rung", "what it is"), words, (), (1,))),
        ]
    )


def _paper(page: Document, study: Study, name: str) -> str:
    compared = ("default", "paper", BASELINE, PPO, OURS)
    some = [label for label in compared if label in study.labels]
    return page.table(
        f"Errors on {name}.",
        html_table(
            tables.PAPER_HEADINGS, tables.paper_lines(study, name, some),
            range(2, len(tables.PAPER_HEADINGS)),
        ),
    )  # fmt: skip


def _headroom(page: Document, rows: list[Headroom], greedy: float | None) -> str:
    return page.table(
        "The best set of a pool for all drives, and what better knowledge would make of the same "
        "pool. Hindsight chooses on the drives that are scored: an upper bound, luck included. "
        "Foresight chooses on the drives of other seeds.",
        html_table(tables.HEADROOM_HEADINGS, tables.headroom_lines(rows, greedy), range(1, 5)),
    )


def _figures(
    page: Document,
    study: Study,
    rows: list[tables.RungResult],
    greedy: float | None,
    gains: Mapping[str, Mapping[str, Interval]],
) -> str:
    styles = line_styles(row.rung.label for row in rows)
    labels = [row.rung.label for row in rows if row.rung.method != "fixed"]
    tried = {label: styles[label] for label in labels}
    parts = []
    if curves := figures.learning_curves(study, tried):
        parts.append(page.figure("Scores of the candidates.", curves, legend(styles, labels), True))
    if greedy is not None:
        parts.append(
            page.figure(
                "Regret against solves. Straight lines: rungs without training.",
                figures.regret(rows, greedy, styles),
                legend(styles, styles),
                True,
            )
        )
    some = [label for label in ("bands", "gradient", PPO, OURS) if label in labels]
    if some:
        parts.append(
            page.figure(
                "Weights in use by band of curvature. Medians and quartiles over drives.",
                figures.weights_over_curvature(study, some, study.sets[0], styles),
                legend(styles, some),
            )
        )
    if shown := {label: gains[label] for label in some if label in gains}:
        parts.append(
            page.figure(
                "Gains by band of curvature.",
                figures.gains_in_bands(shown, styles),
                legend(styles, shown),
                True,
            )
        )
    return joined(parts)
