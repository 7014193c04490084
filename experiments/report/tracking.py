"""Sections of figures: paths in simulation and in real time, errors over time, other settings."""

from collections.abc import Callable, Sequence

from experiments.report import path_figures, time_figures
from experiments.report.document import Document, folded, joined, paragraph
from experiments.report.drives import Drive, Family, Result, families
from experiments.report.path_figures import Panel, StyleOf
from experiments.report.styles import LineStyle, Styles, legend
from experiments.run import tables

Draw = Callable[[Sequence[Drive], StyleOf], list[Panel]]

CONDITIONS = (LineStyle(0, 0, 2.2), LineStyle(1, 0, 1.2))
"""The first and the second kind of conditions; further ones take the next colours."""
START = "Reference broad and grey, start ●, an end before the path's ×."
OVER_TIME: tuple[tuple[str, str, Draw], ...] = (
    (
        "Lateral error over time",
        "Left of the path is positive. Scales differ between panels.",
        time_figures.lateral_error,
    ),
    (
        "Orientation error over time",
        "Heading less the path's, in (−π, π]; on a bend sideslip keeps it from zero.",
        time_figures.heading_error,
    ),
)
DRIVING: tuple[tuple[str, str, Draw], ...] = (
    ("Speed over arc length", "The path's reference speed broad and grey.", time_figures.speed),
    (
        "Inputs over time",
        "Steering angle and acceleration in force, after the actuators.",
        time_figures.inputs,
    ),
)


def condition_styles(names: Sequence[str]) -> dict[str, LineStyle]:
    """Styles of kinds of conditions, in order."""
    return {
        name: CONDITIONS[k] if k < len(CONDITIONS) else LineStyle(k % 7, k // 7 % 4)
        for k, name in enumerate(names)
    }


def tracking_section(document: Document, family: Family, styles: Styles) -> str:
    """Paths and yaw of a family: of one agent under all conditions, or of all agents.

    With several kinds of conditions the leading agent's figures stand open, those of the others
    are folded away. With one, all agents share the panels.
    """
    if len(family.conditions) < 2:
        return _together(document, family, styles)
    kinds = condition_styles(family.conditions)
    shown = legend(kinds, kinds)
    compared = " and ".join(family.conditions)
    lead, *others = family.labels

    def of_conditions(drive: Drive) -> LineStyle:
        return kinds[drive.conditions]

    own = family.of(lead)
    parts = [
        paragraph(f"{family.name}; {compared}, one seed each."),
        document.figure(
            f"Paths of {lead}, {compared}, over the reference. {START}",
            path_figures.paths(own, of_conditions), shown,
        ),
        document.figure(
            f"The same paths of {lead} with deviations magnified. Each point stands as many times "
            "its lateral error beside the path as the panel says.",
            path_figures.magnified(own, of_conditions), shown,
        ),
        document.figure(
            f"Yaw of {lead} against the reference's over time. Broad and grey: the path's heading "
            f"at the foot points of the drive under {family.conditions[0]}.",
            time_figures.yaw(own, of_conditions), shown,
        ),
    ]  # fmt: skip
    folds = [
        document.figure(
            f"Paths of {label}, {compared}, over the reference.",
            path_figures.paths(family.of(label), of_conditions), shown,
        )
        for label in others
    ]  # fmt: skip
    if folds:
        parts.append(folded(f"Paths of the other agents ({len(folds)} figures)", joined(folds)))
    return joined(parts)


def _together(document: Document, family: Family, styles: Styles) -> str:
    def of_label(drive: Drive) -> LineStyle:
        return styles[drive.label]

    shown = legend(styles, family.labels)
    where = f"{family.name}, {family.conditions[0]}"
    return joined(
        [
            document.figure(
                f"Driven paths over the reference, {where}. {START}",
                path_figures.paths(family.drives, of_label), shown,
            ),
            document.figure(
                f"The same paths with deviations magnified, {where}. Each point stands as many "
                "times its lateral error beside the path as the panel says.",
                path_figures.magnified(family.drives, of_label), shown,
            ),
            document.figure(
                f"Yaw against the reference's over time, {where}. Broad and grey: the path's "
                "heading at the foot points of the first agent's drive.",
                time_figures.yaw(family.drives, of_label), shown,
            ),
        ]
    )  # fmt: skip


def errors_section(document: Document, family: Family, styles: Styles) -> str:
    """Errors over time of the leading agent under all conditions, then of all agents under each."""
    parts: list[str] = []
    kinds = condition_styles(family.conditions)
    lead = family.labels[0]

    def of_conditions(drive: Drive) -> LineStyle:
        return kinds[drive.conditions]

    def of_label(drive: Drive) -> LineStyle:
        return styles[drive.label]

    if len(kinds) > 1:
        own = family.of(lead)
        parts += [
            document.figure(
                f"{title}, {lead}. {caption}", draw(own, of_conditions), legend(kinds, kinds)
            )
            for title, caption, draw in (*OVER_TIME, *DRIVING)
        ]
    for conditions in family.conditions:
        group = family.under(conditions)
        if len(kinds) > 1 and {drive.label for drive in group} == {lead}:
            continue
        shown = legend(styles, {drive.label for drive in group})
        drawn = OVER_TIME if len(kinds) > 1 else (*OVER_TIME, *DRIVING)
        parts += [
            document.figure(
                f"{title}, every agent, {conditions}. {caption}", draw(group, of_label), shown
            )
            for title, caption, draw in drawn
        ]
    return joined(parts)


def other_settings_section(document: Document, others: Sequence[Family], styles: Styles) -> str:
    """Paths and lateral errors of all families but the first, folded away."""

    def of_label(drive: Drive) -> LineStyle:
        return styles[drive.label]

    parts = []
    for family in others:
        figures = []
        for conditions in family.conditions:
            group = family.under(conditions)
            shown = legend(styles, {drive.label for drive in group})
            where = f"{family.name}, {conditions}"
            figures += [
                document.figure(
                    f"Driven paths, {where}. {START}", path_figures.paths(group, of_label), shown
                ),
                document.figure(
                    f"Lateral error over time, {where}. {OVER_TIME[0][1]}",
                    time_figures.lateral_error(group, of_label),
                    shown,
                ),
            ]
        parts.append(folded(f"{family.name} ({len(figures)} figures)", joined(figures)))
    return joined(parts)


def missing_words(drives: Sequence[Drive], missing: Sequence[Result]) -> str:
    """What is drawn of several seeds, and which cases cannot be drawn."""
    parts = []
    if any(drive.case.get("seed") for drive in drives):
        parts.append(paragraph("Of several seeds the first is drawn."))
    if missing:
        names = ", ".join(
            f"{tables.label_of(case)} on {case.get('trajectory')} (seed {case.get('seed')})"
            for case in missing
        )
        parts.append(paragraph(f"Not drawn, for want of a readable trace: {names}.", "bad"))
    return joined(parts)


def figure_sections(
    document: Document, drives: Sequence[Drive], missing: Sequence[Result], styles: Styles
) -> None:
    """Add the sections of figures over paths and time."""
    found = families(drives)
    note = missing_words(drives, missing)
    if not found:
        document.section("Paths and yaw", note)
        return
    document.section("Paths and yaw", joined([note, tracking_section(document, found[0], styles)]))
    document.section("Errors over time", errors_section(document, found[0], styles))
    document.section("Other settings", other_settings_section(document, found[1:], styles))
