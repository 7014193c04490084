"""Section that holds results against the published table: figures, and tables of every setting."""

from collections.abc import Callable, Sequence

from experiments.report.document import Document, first_open, folded, joined, paragraph
from experiments.report.drives import family_of, main_family
from experiments.report.estimate_figures import Measured, by_agent
from experiments.report.html_tables import html_rows, trained_words
from experiments.report.learning import TRAINED_NOTE
from experiments.report.styles import legend
from experiments.report.tracking import condition_styles
from experiments.run import tables
from experiments.run.tables import (
    EFFORT,
    FURTHER,
    PUBLISHED_NOTE,
    TRACKING,
    Result,
    Row,
    build_rows,
)

ERRORS = (
    ("ale", "ALE (m)", "Average lateral error"),
    ("aoe", "AOE (rad)", "Average orientation error"),
)


def comparison_section(document: Document, cases: Sequence[Result]) -> str:
    """Errors by agent as figures of the first family, then the tables of every setting."""
    parts = [
        paragraph(
            f"{PUBLISHED_NOTE} Max CTE and MLE, by formula the same, use the foot point on "
            "the path. Several seeds (×n): mean ± 95 % interval by the t-distribution."
        )
    ]
    if any(case.get("training") for case in cases):
        parts.append(paragraph(TRAINED_NOTE))
    parts += _figures(document, cases)
    rows = tables.by_setting(build_rows(cases))
    family = main_family(cases)
    shown = [
        (family_of(group[0]) == family, joined(_tables(document, setting, rows[setting])))
        for setting, group in tables.cases_by_setting(cases).items()
    ]
    parts.append(first_open(shown, "Other settings"))
    return joined(parts)


def _figures(document: Document, cases: Sequence[Result]) -> list[str]:
    done = [case for case in cases if case.get("status") == "ok"]
    if not done:
        return []
    family = main_family(done)
    own = [case for case in done if family_of(case) == family]
    words = {
        tables.setting_of(case): tables.conditions_words(case.get("conditions", "simulation"))
        for case in own
    }
    rows = [row for row in build_rows(own) if not row.published]
    styles = condition_styles(list(dict.fromkeys(words.values())))
    parts = []
    for key, axis, name in ERRORS:
        measured = [
            Measured(row.trajectory, row.label, words[row.setting], row.values[key])
            for row in rows
            if key in row.values
        ]
        if measured:
            parts.append(
                document.figure(
                    f"{name} of every agent, {family}. Means, with 95 % intervals where there are "
                    "several seeds. Dashed: the published values of the same kind; the errata "
                    "say what stands between the two.",
                    by_agent(measured, styles, axis, key),
                    legend(styles, styles),
                )
            )
    return parts


def _tables(document: Document, setting: str, rows: Sequence[Row]) -> list[str]:
    """Tracking open; what it took, and what the paper leaves out, folded away."""
    ours = [row for row in rows if not row.published]
    texts: dict[str, Callable[[Row], str]] = {"end": lambda row: row.end}
    if any(row.learning for row in rows):
        texts["trained"] = trained_words
    return [
        document.table(
            f"Tracking errors in the paper's terms, {setting}.", html_rows(rows, TRACKING, texts)
        ),
        folded(
            "Effort, constraints and further figures",
            joined(
                [
                    document.table(
                        f"Effort and constraints, {setting}.",
                        html_rows(
                            ours,
                            EFFORT,
                            {
                                "solves failed": lambda row: row.failures,
                                "constraints broken: largest excess, share of control periods": (
                                    lambda row: row.violations
                                ),
                            },
                        ),
                    ),
                    document.table(
                        f"Beyond the paper's columns, {setting}.", html_rows(ours, FURTHER, {})
                    ),
                ]
            ),
        ),
    ]
