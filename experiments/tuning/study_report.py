"""The tuning study's report: one page, with everything that its figures can be checked by."""

import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.band_metrics import BANDS
from experiments.html_tables import html_table
from experiments.report_page import PAGE
from experiments.results import hardware, revision, versions
from experiments.tuning import study_figures as figures
from experiments.tuning import study_tables as tables
from experiments.tuning.ladder import BASELINE, OURS, PPO
from experiments.tuning.oracle import Headroom
from experiments.tuning.statistics import Interval
from experiments.tuning.study import Study
from trajectories.atomic import write_atomically

FORMULA = (
    "score = rms lateral error / 0.05 m + rms heading error / 0.1 rad + rms speed error / 0.5 m/s "
    "(tracking) + rms steering rate / 0.2 rad/s + rms jerk / 4 m/s³ (comfort); of the truth, mean "
    "over drives, lower is better; a drive that fails scores 25"
)


def write_report(
    study: Study, headroom: list[Headroom], greedy: float | None, file: Path
) -> dict[str, Any]:
    """Write the page and, beside it, `summary.json`; what the summary holds."""
    main = study.sets[0].name
    rows = [tables.judged(study, main, label) for label in tables.shown(study)]
    gain = None if greedy is None else 1.0 - greedy / headroom[0].hindsight
    body = [
        _section("Score", f"<p>{html.escape(FORMULA)}.</p>"),
        _section("Headroom", _headroom(headroom, greedy)),
        _section(
            f"The ladder on {main}",
            html_table(tables.LADDER_HEADINGS, tables.ladder_lines(rows, gain), tables.NUMERIC)
            + "<p>Interquartile means over trainings; intervals by bootstrap over trainings and "
            "paths, 10,000 resamples. Gains are paired: the same drives, training against "
            "training. “At most” is the 95 % Clopper-Pearson bound on the rate of failures.</p>",
        ),
    ]
    rivals = [row.rung.label for row in rows if row.rung.label != BASELINE]
    gains = {}
    if BASELINE in study.labels:
        gains = {label: tables.band_gains(study, main, label) for label in rivals}
        body.append(
            _section(
                f"Gains in each band of curvature on {main}",
                html_table(
                    ("rung", *BANDS.names), tables.band_lines(gains),
                    range(1, 1 + len(BANDS.names)),
                ) + "<p>Over the best fixed set, of the score of the periods in a band.</p>",
            )
        )  # fmt: skip
    if alone := tables.curvature_alone(study):
        name = next(one.name for one in study.sets if one.conditions == "simulation")
        lines = tables.ladder_lines([tables.judged(study, name, one) for one in alone], None)
        body.append(
            _section(
                f"Curvature alone: {name}",
                "<p>Tuned and judged without disturbances: nothing differs but the path.</p>"
                + html_table(tables.LADDER_HEADINGS, lines, tables.NUMERIC),
            )
        )
    headings, lines = tables.sets_lines(study, study.labels)
    body.append(_section("Every set", html_table(headings, lines, range(1, len(headings)))))
    for given in study.sets:
        if given.name.startswith("six"):
            compared = ("default", "paper", BASELINE, PPO, OURS)
            some = [label for label in compared if label in study.labels]
            body.append(
                _section(
                    f"In the paper's terms: {given.name}",
                    html_table(
                        tables.PAPER_HEADINGS, tables.paper_lines(study, given.name, some),
                        range(2, len(tables.PAPER_HEADINGS)),
                    ),
                )
            )  # fmt: skip
    body.append(_section("Pictures", _pictures(study, rows, greedy, gains)))
    manifest = {
        "solves": study.solves, "seeds": list(study.seeds), "rungs": list(study.labels),
        "sets": [
            {"name": one.name, "paths": list(one.labels), "seeds": one.seeds,
             "conditions": one.conditions}
            for one in study.sets
        ],
        "versions": versions(), "revision": revision(), "hardware": hardware(),
    }  # fmt: skip
    body.append(_section("Manifest", f"<pre>{html.escape(json.dumps(manifest, indent=2))}</pre>"))
    page = PAGE.substitute(
        title="Tuning study: weights of the NMPC",
        subtitle=f"{len(study.seeds)} trainings a rung, {study.solves:,} solves each",
        contents="", body="\n".join(body),
    )  # fmt: skip
    write_atomically(file, page.encode())
    summary = {
        **manifest,
        "headroom": [vars(row) for row in headroom],
        "greedy": greedy,
        "ladder": tables.ladder_lines(rows, gain),
    }
    write_atomically(file.with_name("summary.json"), json.dumps(summary, indent=2).encode())
    return summary


def _section(title: str, content: str) -> str:
    return f"<h2>{html.escape(title)}</h2>\n{content}"


def _headroom(rows: list[Headroom], greedy: float | None) -> str:
    lines = tables.headroom_lines(rows, greedy)
    return html_table(tables.HEADROOM_HEADINGS, lines, range(1, 5)) + (
        "<p>The best set of a pool for all drives, and what better knowledge would make of the "
        "same pool. Hindsight chooses on the drives that are scored: an upper bound, luck "
        "included. Foresight chooses on the drives of other seeds.</p>"
    )


def _pictures(
    study: Study,
    rows: list[tables.Judged],
    greedy: float | None,
    gains: Mapping[str, Mapping[str, Interval]],
) -> str:
    labels = [row.rung.label for row in rows if row.rung.method != "fixed"]
    pictures = {"Scores of what was tried": figures.learning_curves(study, labels)}
    if greedy is not None:
        pictures["Regret against solves"] = figures.regret(rows, greedy)
    some = [label for label in ("bands", "gradient", PPO, OURS) if label in labels]
    if some:
        pictures["Weights in use by band of curvature"] = figures.weights_over_curvature(
            study, some, study.sets[0]
        )
    if shown := {label: gains[label] for label in some if label in gains}:
        pictures["Gains by band of curvature"] = figures.gains_in_bands(shown)
    return (
        '<div class="panels">'
        + "".join(
            f"<figure><figcaption>{html.escape(caption)}</figcaption>{svg}</figure>"
            for caption, svg in pictures.items()
        )
        + "</div>"
    )
