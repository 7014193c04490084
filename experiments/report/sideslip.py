"""Section on the limit |vy| <= 0.17 vx: where it forbids the path, and which cases reached it."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.report.drive_figures import POINTS, reference_chart
from experiments.report.drives import (
    Drive,
    by_setting,
    by_trajectory,
)
from experiments.report.page import (
    Document,
    Panel,
    Styles,
    folded,
    html_table,
    joined,
    legend,
    paragraph,
)
from experiments.report.svg_charts import Chart, around, decimate, exactly, spread
from experiments.run import tables
from experiments.run.excerpts import MOST_LISTED
from experiments.run.settings import setting_of
from experiments.run.tables import Result
from lpv_track_env.bicycle import VX, VY, X, Y
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]

AT_LIMIT = 0.99
"""Share of the limit on |vy|/vx above which a vehicle is drawn as being at the limit."""
EXCESS = 1e-3
"""Excess or slack that counts as reaching the limit, m/s."""
USUAL = 0.17
"""Limit drawn where the vehicle cannot be loaded."""
FEW = 12
"""Number of lines up to which the table of cases is not folded away."""


def sideslip(trace: Mapping[str, Array]) -> Array:
    """Return |vy| / vx along a trace, (n,)."""
    state = trace["state"]
    return np.abs(state[:, VY]) / np.maximum(state[:, VX], 1e-3)


def steady_sideslip(curvature: Array, speed: Array, car: VehicleParameters) -> Array:
    """Return |vy| / vx of a steady turn, |kappa (lr - m lf v^2 / (L Car))|, any shape.

    It follows from the lateral force on the rear axle in a steady turn, m v^2 kappa lf / L.
    """
    give = car.mass * car.front_axle_distance / (car.wheelbase * car.rear_cornering_stiffness)
    return np.abs(curvature * (car.rear_axle_distance - give * speed**2))


def required_sideslip(drive: Drive) -> tuple[Array, Array] | None:
    """Return arc length and |vy| / vx of steady driving on the path at its reference speed.

    None if the path or the vehicle cannot be loaded.
    """
    path, car = drive.path, drive.car
    if path is None or car is None:
        return None
    reach = drive.trace["arc_length"]
    order = np.argsort(reach, kind="stable")
    speed = np.interp(path.arc_length, reach[order], drive.trace["reference_speed"][order])
    return path.arc_length, steady_sideslip(path.curvature, speed, car)


def reaches_limit(case: Result) -> bool:
    """Return whether |vy| <= ratio vx was violated, or a plan needed slack on it."""
    return _excess(case) > EXCESS


def _excess(case: Result) -> float:
    """Return the larger of the excess over the limit and the slack that a plan needed, m/s."""
    slack = case.get("solver", {}).get("slack") or (0.0, 0.0, 0.0)
    return float(max(case.get("metrics", {}).get("excess_lateral_velocity", 0.0), slack[1]))


def sideslip_section(
    document: Document, cases: Sequence[Result], drives: Sequence[Drive], styles: Styles
) -> str:
    """Return what the limit means, which cases reached it, and where."""
    parts = [
        paragraph(
            "The paper bounds |vy| by 0.17 vx at the centre of gravity. In a steady turn vy/vx is "
            "κ (lr − m lf v² / (L Car)), at low speed about lr κ: the bound is a limit on the "
            "curvature that may be driven, whatever the speed. On sharper bends a controller that "
            "respects it must leave the path, and one that follows the path must violate it. The "
            "published errors (MLE 0.7 to 1.6 m, MOE 0.3 to 0.6 rad) are consistent with that."
        )
    ]
    if limits := _limits(drives):
        lines = [[name, f"{limit:.2f}", f"{limit / lever:.3f}"] for name, limit, lever in limits]
        headings = ("vehicle", "limit on |vy|/vx", "curvature limit at low speed, 1/m")
        parts.append(document.table("What the limit allows.", html_table(headings, lines, (1, 2))))
    reached = [case for case in cases if reaches_limit(case)]
    if not reached:
        parts.append(paragraph("No case broke the limit or needed slack on it."))
        return joined(parts)
    by_id = {drive.case["id"]: drive for drive in drives}
    listed = reached
    if len(reached) > MOST_LISTED:
        parts.append(paragraph(f"{MOST_LISTED} of {len(reached)} cases are listed: the worst."))
        listed = sorted(reached, key=_excess, reverse=True)[:MOST_LISTED]
    table = document.table(
        "Cases that broke the limit, or whose plans needed slack on it. “Needed” is the share "
        "of the path's length whose curvature requires more than the limit at the reference "
        "speed; “at the limit” is the length driven at 99 % of it or more.",
        _reached(listed, by_id),
    )
    parts.append(table if len(reached) <= FEW else folded(f"{len(reached)} cases", table))
    drawn = [by_id[case["id"]] for case in reached if case["id"] in by_id]
    for setting, group in by_setting(drawn).items():
        parts.append(
            document.figure(
                f"Sideslip at its limit, {setting}. Above: |vy|/vx driven, its limit (dashed), "
                "what the path requires (grey), and where that exceeds the limit (shaded). Below: "
                "the driven path, red where the limit is reached.",
                _panels(group, styles),
                legend(styles, {drive.label for drive in group}),
            )
        )
    return joined(parts)


def _limits(drives: Iterable[Drive]) -> list[tuple[str, float, float]]:
    """Return name, limit on |vy|/vx and lr of every vehicle that can be loaded."""
    found: dict[tuple[str, float, float], None] = {}
    for drive in drives:
        car = drive.car
        if car is not None:
            key = (
                str(drive.case.get("vehicle")),
                car.max_lateral_velocity_ratio,
                car.rear_axle_distance,
            )
            found[key] = None
    return sorted(found)


def _reached(cases: Iterable[Result], drives: Mapping[Any, Drive]) -> str:
    lines = []
    for case in cases:
        metrics, slack = case["metrics"], case["solver"].get("slack")
        drive = drives.get(case["id"])
        lines.append(
            [
                tables.case_name(case),
                str(case.get("trajectory")),
                str(setting_of(case)),
                str(case.get("seed")),
                f"{metrics.get('excess_lateral_velocity', 0.0):.3f}",
                f"{100 * metrics.get('violated_lateral_velocity', 0.0):.1f}",
                f"{slack[1]:.3f}" if slack else "–",
                *(_lengths(drive) if drive else ("–", "–")),
                f"{metrics['mle']:.3f}",
            ]
        )
    headings = (
        "agent", "path", "setting", "seed", "largest excess, m/s", "periods over, %",
        "largest slack, m/s", "needed, %", "at the limit, m", "MLE, m",
    )  # fmt: skip
    return html_table(headings, lines, range(3, 10))


def _lengths(drive: Drive) -> tuple[str, str]:
    car, needed = drive.car, required_sideslip(drive)
    if car is None:
        return "–", "–"
    limit = car.max_lateral_velocity_ratio
    share = "–" if needed is None else f"{100 * np.mean(needed[1] > limit):.1f}"
    steps = np.hypot(*np.diff(drive.trace["state"][:, 4:6], axis=0).T)
    at_limit = sideslip(drive.trace)[1:] >= AT_LIMIT * limit
    return share, f"{steps[at_limit].sum():.1f}"


def _panels(drives: Sequence[Drive], styles: Styles) -> list[Panel]:
    """Draw |vy| / vx over arc length with its limit; below, where on the path it was reached."""
    return [
        Panel(name, _shares(group, styles) + _places(group, styles))
        for name, group in by_trajectory(drives).items()
    ]


def _limit(drives: Sequence[Drive]) -> float:
    car = drives[0].car
    return USUAL if car is None else car.max_lateral_velocity_ratio


def _shares(drives: Sequence[Drive], styles: Styles) -> str:
    limit, needed = _limit(drives), required_sideslip(drives[0])
    slips = [sideslip(drive.trace) for drive in drives]
    wanted = [] if needed is None else [needed[1]]
    chart = Chart(
        exactly([0.0, *(drive.trace["arc_length"] for drive in drives)]),
        around([limit, *slips, *wanted], zero=True),
        x_label="arc length (m)", y_label="|vy| / vx (–)", height=150.0,
    )  # fmt: skip
    if needed is not None:
        chart.bands(needed[0], needed[1] > limit, "shade")
        chart.course(*needed, "broad")
    for drive, slip in zip(drives, slips, strict=True):
        style = styles[drive.label]
        chart.course(drive.trace["arc_length"], slip, style.kind, style.width)
    chart.rule(y=limit)
    return chart.svg()


def _places(drives: Sequence[Drive], styles: Styles) -> str:
    limit = _limit(drives)
    states = [drive.trace["state"] for drive in drives]
    chart = reference_chart(drives, [axis for one in states for axis in (one[:, X], one[:, Y])])
    for drive, state in zip(drives, states, strict=True):
        slip, style = sideslip(drive.trace), styles[drive.label]
        kept = np.union1d(spread(len(state), POINTS), decimate(slip))
        at_limit = slip[kept] >= AT_LIMIT * limit
        x, y = state[kept, X], state[kept, Y]
        chart.line(np.where(at_limit, x, np.nan), y, "reached")
        chart.line(x, y, style.kind, style.width)
    return chart.svg()
