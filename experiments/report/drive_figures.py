"""Sections of figures: driven paths, errors and quantities over time, other settings.

A figure has a panel for each trajectory.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from experiments.figures import COLOURS
from experiments.report.drives import (
    Drive,
    Family,
    by_trajectory,
    families,
    foot_points,
    longest_trace,
    reference_line,
)
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
from experiments.report.svg_charts import (
    BOTTOM,
    LEFT,
    RIGHT,
    TOP,
    WIDTH,
    Chart,
    Scale,
    around,
    exactly,
    spread,
)
from experiments.run import tables
from experiments.run.tables import Result
from lpv_track_env.bicycle import PSI, VX, X, Y

Array = NDArray[np.float64]
StyleOf = Callable[[Drive], LineStyle]
Draw = Callable[[Sequence[Drive], StyleOf], list[Panel]]

HEIGHT, FLAT = 260.0, 170.0
"""Heights of a view from above and of a chart over time."""
ELONGATED = 0.08
"""Ratio of a path's extents below which it would look like a line on equal scales."""
MAGNIFIED_SHARE = 0.06
"""Share of a path's extent to which the largest deviation is magnified."""
SHOWN = 24
"""Number of cases that a note names."""
POINTS = 600
"""Points of a path that are drawn."""
CONDITIONS = (LineStyle(0, 0, 2.2), LineStyle(1, 0, 1.2))
"""Styles of the first and the second conditions; further ones take the next colours."""
MARKS = "The broad grey line is the reference, ● its start; × marks a drive that ended early."
MAGNIFIED = "Lateral errors are multiplied by the factor above the panel."
YAW = "The broad grey line is the path's heading at the foot points of the first drive."


def paths(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the reference and the driven paths, to scale."""
    return [
        Panel(name, _plan(group, style_of, {id(drive): _driven(drive) for drive in group}))
        for name, group in by_trajectory(drives).items()
    ]


def magnified(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the driven paths with lateral errors multiplied by the factor in the panel's title."""
    panels = []
    for name, group in by_trajectory(drives).items():
        x, y = reference_line(group)
        largest = max(float(np.abs(drive.trace["lateral_error"]).max()) for drive in group)
        factor = _round_down(MAGNIFIED_SHARE * max(np.ptp(x), np.ptp(y)) / max(largest, 1e-6))
        lines = {id(drive): _driven(drive, factor) for drive in group}
        panels.append(Panel(f"{name}, deviations ×{factor:g}", _plan(group, style_of, lines)))
    return panels


def _round_down(value: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten, at least 1."""
    if value < 2.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(factor for factor in (1.0, 2.0, 5.0) if factor * power <= value))


def _driven(drive: Drive, factor: float = 1.0) -> tuple[Array, Array]:
    state = drive.trace["state"]
    if factor == 1.0:
        return state[:, X], state[:, Y]
    x, y, heading = foot_points(drive.trace)
    away = factor * drive.trace["lateral_error"]
    return x - away * np.sin(heading), y + away * np.cos(heading)


def _plan(
    group: Sequence[Drive], style_of: StyleOf, lines: Mapping[int, tuple[Array, Array]]
) -> str:
    chart = reference_chart(group, [line for drive in group for line in lines[id(drive)]])
    for drive in group:
        x, y = lines[id(drive)]
        style, kept = style_of(drive), spread(len(x), POINTS)
        chart.line(x[kept], y[kept], style.kind, style.width)
        if not drive.finished:
            chart.cross(float(x[-1]), float(y[-1]), style.kind)
    return chart.svg()


def reference_chart(group: Sequence[Drive], driven: Sequence[Array]) -> Chart:
    """Return a chart from above with the reference as a broad line and its start as a disc.

    Its scales fit the lines to be drawn on it: `driven` holds their X, Y, X, Y, ... (m).
    """
    x, y = reference_line(group)
    every = (
        np.concatenate([np.ravel(one) for one in (x, *driven[0::2])]),
        np.concatenate([np.ravel(one) for one in (y, *driven[1::2])]),
    )
    scales, equal = _plan_scales(*every)
    chart = Chart(
        *scales, x_label="X (m)", y_label="Y (m)" if equal else "Y (m), not to scale",
        height=HEIGHT,
    )  # fmt: skip
    kept = spread(len(x), POINTS)
    chart.line(x[kept], y[kept], "broad")
    chart.dot(float(x[0]), float(y[0]), "start", 3.5)
    return chart


def _plan_scales(x: Array, y: Array) -> tuple[tuple[Scale, Scale], bool]:
    """Return scales over all points, equal ones unless the path is too slender for that."""
    width, height = (WIDTH - LEFT - RIGHT), (HEIGHT - TOP - BOTTOM)
    spans = [float(np.ptp(x)), float(np.ptp(y))]
    equal = min(spans) > ELONGATED * max(spans)
    middles = [0.5 * float(one.min() + one.max()) for one in (x, y)]
    reach = [1.1 * max(span, 1e-3) for span in spans]
    if equal:
        unit = max(reach[0] / width, reach[1] / height)
        reach = [unit * width, unit * height]
    pairs = zip(middles, reach, strict=True)
    first, second = (Scale(middle - span / 2, middle + span / 2) for middle, span in pairs)
    return (first, second), equal


def _over_time(
    height: float, quantities: Mapping[str, str], drives: Sequence[Drive], style_of: StyleOf
) -> list[Panel]:
    """Draw arrays of the traces over time, one chart below the other.

    `quantities` gives the axis label of each array.
    """
    return [
        Panel(
            name,
            "".join(_time_chart(group, style_of, height, *one) for one in quantities.items()),
        )
        for name, group in by_trajectory(drives).items()
    ]


def _time_chart(
    drives: Sequence[Drive], style_of: StyleOf, height: float, name: str, words: str
) -> str:
    """Return the SVG of one quantity, with × where a drive ended before the path did."""
    chart = Chart(
        exactly([0.0, *(drive.trace["time"] for drive in drives)]),
        around([drive.trace[name] for drive in drives]),
        x_label="time (s)", y_label=words, height=height,
    )  # fmt: skip
    for drive in drives:
        time, values, style = drive.trace["time"], drive.trace[name], style_of(drive)
        chart.course(time, values, style.kind, style.width)
        if not drive.finished:
            chart.cross(float(time[-1]), float(values[-1]), style.kind)
    return chart.svg()


def yaw(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the yaw over time, and the path's heading at the foot points of the first drive."""
    panels = []
    for name, group in by_trajectory(drives).items():
        yaws = [np.unwrap(drive.trace["state"][:, PSI]) for drive in group]
        _, _, reference = foot_points(group[0].trace)
        # Whole turns between yaw and reference are no error.
        turn = 2.0 * np.pi
        yaws = [one - turn * np.round((one[0] - reference[0]) / turn) for one in yaws]
        chart = Chart(
            exactly([0.0, *(drive.trace["time"] for drive in group)]),
            around([reference, *yaws]),
            x_label="time (s)", y_label="yaw (rad)", height=FLAT,
        )  # fmt: skip
        chart.course(group[0].trace["time"], reference, "broad")
        for drive, values in zip(group, yaws, strict=True):
            style = style_of(drive)
            chart.course(drive.trace["time"], values, style.kind, style.width)
        panels.append(Panel(name, chart.svg()))
    return panels


def speed(drives: Sequence[Drive], style_of: StyleOf) -> list[Panel]:
    """Draw the speed over arc length, and the path's reference speed."""
    panels = []
    for name, group in by_trajectory(drives).items():
        longest = longest_trace(group)
        speeds = [drive.trace["state"][:, VX] for drive in group]
        chart = Chart(
            exactly([0.0, *(drive.trace["arc_length"] for drive in group)]),
            around([longest["reference_speed"], *speeds], zero=True),
            x_label="arc length (m)", y_label="speed (m/s)", height=FLAT,
        )  # fmt: skip
        chart.course(longest["arc_length"], longest["reference_speed"], "broad")
        for drive, values in zip(group, speeds, strict=True):
            style = style_of(drive)
            chart.course(drive.trace["arc_length"], values, style.kind, style.width)
        panels.append(Panel(name, chart.svg()))
    return panels


LATERAL_ERROR: tuple[str, str, Draw] = (
    "Lateral error over time",
    "Left of the path is positive. Scales differ between panels.",
    partial(_over_time, FLAT, {"lateral_error": "lateral error (m)"}),
)
ERRORS: tuple[tuple[str, str, Draw], ...] = (
    LATERAL_ERROR,
    (
        "Orientation error over time",
        "Vehicle's heading minus the path's, in (−π, π]; on bends sideslip keeps it from zero.",
        partial(_over_time, FLAT, {"heading_error": "heading error (rad)"}),
    ),
)
"""Title, remark and function of each figure."""
INPUTS = {"steering_angle": "steering (rad)", "acceleration": "accel. (m/s²)"}
DRIVING: tuple[tuple[str, str, Draw], ...] = (
    ("Speed over arc length", "The broad grey line is the path's reference speed.", speed),
    (
        "Inputs over time",
        "Steering angle and acceleration in force, after the actuators.",
        partial(_over_time, 135.0, INPUTS),
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
    if any(tables.training_of(drive.case) is not None for drive in drives):
        parts.append(paragraph("Of several trainings only the first is drawn."))
    if missing:
        names = ", ".join(
            f"{tables.case_name(case)} on {case.get('trajectory')} (seed {case.get('seed')})"
            for case in missing[:SHOWN]
        )
        rest = f" … and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        words = f"Not drawn, because their traces cannot be read: {names}{rest}."
        parts.append(paragraph(words, "bad"))
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
            paths(family.of(label), style_of),
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
        (f"Driven paths, {where}. {MARKS}", paths),
        (f"Driven paths with deviations magnified, {where}. {MAGNIFIED}", magnified),
        (f"Yaw over time, {where}. {YAW}", yaw),
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
            figures += [
                document.figure(caption, plots(group, style_of), shown)
                for caption, plots in (
                    (f"Driven paths, {where}. {MARKS}", paths),
                    (f"{title}, {where}. {remark}", draw),
                )
            ]
        parts.append(folded(f"{family.name} ({len(figures)} figures)", joined(figures)))
    return joined(parts)
