"""Sections of figures: driven paths, errors over time, other settings."""

from collections.abc import Callable, Sequence

from experiments.figures import COLOURS
from experiments.report import drive_figures
from experiments.report.drive_figures import StyleOf
from experiments.report.drives import Drive, Family, Result, families
from experiments.report.page import (
    DASHES,
    Document,
    LineStyle,
    Panel,
    Styles,
    folded,
    joined,
    legend,
    paragraph,
)
from experiments.run import tables

Draw = Callable[[Sequence[Drive], StyleOf], list[Panel]]

CONDITIONS = (LineStyle(0, 0, 2.2), LineStyle(1, 0, 1.2))
"""Styles of the first and the second conditions; further ones take the next colours."""
MARKS = "The broad grey line is the reference, ● its start; × marks a drive that ended early."
MAGNIFIED = "Lateral errors are multiplied by the factor above the panel."
YAW = "The broad grey line is the path's heading at the foot points of the first drive."
LATERAL_ERROR = (
    "Lateral error over time", "Left of the path is positive. Scales differ between panels.",
    drive_figures.lateral_error,
)  # fmt: skip
ERRORS: tuple[tuple[str, str, Draw], ...] = (
    LATERAL_ERROR,
    (
        "Orientation error over time",
        "Vehicle's heading minus the path's, in (−π, π]; on bends sideslip keeps it from zero.",
        drive_figures.heading_error,
    ),
)
"""Title, remark and function of each figure."""
DRIVING: tuple[tuple[str, str, Draw], ...] = (
    (
        "Speed over arc length",
        "The broad grey line is the path's reference speed.",
        drive_figures.speed,
    ),
    (
        "Inputs over time",
        "Steering angle and acceleration in force, after the actuators.",
        drive_figures.inputs,
    ),
)


def condition_styles(names: Sequence[str]) -> dict[str, LineStyle]:
    """Return the style of each kind of conditions."""
    n = len(COLOURS)
    return {
        name: CONDITIONS[k] if k < len(CONDITIONS) else LineStyle(k % n, k // n % DASHES)
        for k, name in enumerate(names)
    }


def figure_sections(
    document: Document, drives: Sequence[Drive], missing: Sequence[Result], styles: Styles
) -> None:
    """Add the sections of figures over paths and time.

    With several kinds of conditions the leading agent's figures compare them, and those of the
    other agents are folded away. With one, all agents share the panels.
    """
    found = families(drives)
    note = _not_drawn(drives, missing)
    if not found:
        document.section("Paths and yaw", note)
        return
    main, *others = found
    document.section("Paths and yaw", joined([note, _paths_section(document, main, styles)]))
    document.section("Errors over time", _errors_section(document, main, styles))
    document.section("Other settings", _other_settings(document, others, styles))


def _not_drawn(drives: Sequence[Drive], missing: Sequence[Result]) -> str:
    """State which seeds are drawn, and which cases cannot be."""
    parts = []
    if any(drive.case.get("seed") for drive in drives):
        parts.append(paragraph("Of several seeds only the first is drawn."))
    if missing:
        names = ", ".join(
            f"{tables.label_of(case)} on {case.get('trajectory')} (seed {case.get('seed')})"
            for case in missing
        )
        parts.append(paragraph(f"Not drawn, because their traces cannot be read: {names}.", "bad"))
    return joined(parts)


def _by_label(styles: Styles) -> StyleOf:
    return lambda drive: styles[drive.label]


def _by_conditions(styles: Styles) -> StyleOf:
    return lambda drive: styles[drive.conditions]


def _paths_section(document: Document, family: Family, styles: Styles) -> str:
    conditions = family.conditions
    if len(conditions) < 2:
        shown = legend(styles, family.labels)
        where = f"{family.name}, {conditions[0]}"
        return _path_figures(document, family.drives, where, _by_label(styles), shown)
    kinds = condition_styles(conditions)
    shown, style_of = legend(kinds, kinds), _by_conditions(kinds)
    compared = " and ".join(conditions)
    lead, *others = family.labels
    parts = [
        paragraph(f"{family.name}; {compared}, one seed each."),
        _path_figures(document, family.of(lead), f"{lead}, {compared}", style_of, shown),
    ]
    folds = [
        document.figure(
            f"Driven paths, {label}, {compared}.",
            drive_figures.paths(family.of(label), style_of),
            shown,
        )
        for label in others
    ]
    if folds:
        parts.append(folded(f"Paths of the other agents ({len(folds)} figures)", joined(folds)))
    return joined(parts)


def _path_figures(
    document: Document, drives: Sequence[Drive], where: str, style_of: StyleOf, shown: str
) -> str:
    """Return figures of driven paths, to scale and magnified, and of yaw."""
    figures: tuple[tuple[str, Draw], ...] = (
        (f"Driven paths, {where}. {MARKS}", drive_figures.paths),
        (f"Driven paths with deviations magnified, {where}. {MAGNIFIED}", drive_figures.magnified),
        (f"Yaw over time, {where}. {YAW}", drive_figures.yaw),
    )
    return joined(
        document.figure(caption, draw(drives, style_of), shown) for caption, draw in figures
    )


def _errors_section(document: Document, family: Family, styles: Styles) -> str:
    """Return errors of the leading agent under all conditions, then of all agents under each."""
    parts: list[str] = []
    kinds = condition_styles(family.conditions)
    lead = family.labels[0]
    if len(kinds) > 1:
        own, style_of = family.of(lead), _by_conditions(kinds)
        parts += [
            document.figure(f"{title}, {lead}. {remark}", draw(own, style_of), legend(kinds, kinds))
            for title, remark, draw in (*ERRORS, *DRIVING)
        ]
    for conditions in family.conditions:
        group, style_of = family.under(conditions), _by_label(styles)
        labels = {drive.label for drive in group}
        if len(kinds) > 1 and labels == {lead}:
            continue
        figures = ERRORS if len(kinds) > 1 else (*ERRORS, *DRIVING)
        parts += [
            document.figure(
                f"{title}, every agent, {conditions}. {remark}",
                draw(group, style_of),
                legend(styles, labels),
            )
            for title, remark, draw in figures
        ]
    return joined(parts)


def _other_settings(document: Document, others: Sequence[Family], styles: Styles) -> str:
    """Return paths and lateral errors of all families but the first, folded away."""
    title, remark, draw = LATERAL_ERROR
    style_of = _by_label(styles)
    parts = []
    for family in others:
        figures = []
        for conditions in family.conditions:
            group = family.under(conditions)
            shown = legend(styles, {drive.label for drive in group})
            where = f"{family.name}, {conditions}"
            paths = drive_figures.paths(group, style_of)
            figures += [
                document.figure(f"Driven paths, {where}. {MARKS}", paths, shown),
                document.figure(f"{title}, {where}. {remark}", draw(group, style_of), shown),
            ]
        parts.append(folded(f"{family.name} ({len(figures)} figures)", joined(figures)))
    return joined(parts)
