"""Files and figures of an identification."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from experiments.identification.identify import Check, Identification
from experiments.identification.model import (
    COUNT,
    PARAMETERS,
    SCALED,
    SHORTEST_LAG,
    UNITS,
    nominal_parameters,
)
from trajectories.fileio import write_atomically

if TYPE_CHECKING:
    from rich.table import Table

FORMAT = "lpv-track-identification/1"
DRAWN = (
    ("yaw_rate", "yaw rate (rad/s)"), ("vy", "lateral speed (m/s)"), ("vx", "speed (m/s)"),
)  # fmt: skip
"""Channels of the figure; without the lateral speed, the heading takes its place."""
CHANNEL_UNITS = {
    "vx": "m/s", "vy": "m/s", "heading": "rad", "yaw_rate": "rad/s", "x": "m", "y": "m",
}  # fmt: skip


def parameters_of(found: Identification) -> dict[str, dict[str, Any]]:
    """Return value, deviation (None where the logs do not tell it) and unit by parameter."""
    rows = {}
    for place in range(COUNT):
        value = float(found.fit.parameters[place])
        deviation = float(found.fit.deviations[place])
        if place in SCALED:
            deviation *= value
        rows[PARAMETERS[place]] = {
            "value": value,
            "deviation": deviation if math.isfinite(deviation) else None,
            "unit": UNITS[place],
        }
    return rows


def write(found: Identification, out: Path, settings: dict[str, Any]) -> list[Path]:
    """Write the vehicle to NAME.json, and beside it NAME.identification.json and NAME.png."""
    from experiments.run.provenance import provenance

    details = out.with_name(f"{out.stem}.identification.json")
    picture = out.with_suffix(".png")
    content = {
        "format": FORMAT,
        "settings": settings,
        "nominal": found.nominal.as_dict(),
        "parameters": parameters_of(found),
        "conditions": found.conditions,
        "noise": found.fit.noise,
        "readings": found.fit.rows,
        "windows": found.windows,
        "excitation": found.excitation,
        "remarks": found.remarks,
        "held_out": {
            label: {"rms": check.rms, "fit": check.share} for label, check in found.checks.items()
        },
        **provenance(),
    }
    write_atomically(out, json.dumps(found.vehicle.as_dict(), indent=2).encode())
    write_atomically(details, json.dumps(content, indent=2, allow_nan=False).encode())
    draw(found, picture)
    return [out, details, picture]


def draw(found: Identification, file: Path) -> None:
    """Draw log, nominal and identified prediction over the windows that were not fitted."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    from experiments.figures import COLOURS, STYLE, save_figure

    channels = [
        ("heading", "heading (rad)") if name == "vy" and name not in found.fit.noise
        else (name, label)
        for name, label in DRAWN
    ]  # fmt: skip
    channels = [(name, label) for name, label in channels if name in found.fit.noise]
    with mpl.rc_context(cast("Any", STYLE)):
        figure = Figure(figsize=(11.0, 2.3 * len(channels) + 0.4), layout="constrained")
        axes = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
        for axis, (name, label) in zip(axes, channels, strict=True):
            for case, colour, style in (
                ("nominal", COLOURS[1], "dashed"), ("identified", COLOURS[0], "solid"),
            ):  # fmt: skip
                check = found.checks[case]
                for k, one in enumerate(check.traces):
                    if name not in one:
                        continue
                    times, read, predicted = one[name]
                    if case == "nominal":
                        axis.plot(
                            times, read, ".", color="#999999", markersize=2.5,
                            label="log" if k == 0 else None,
                        )  # fmt: skip
                    legend = f"{case}: rms {check.rms[name]:.3g} {CHANNEL_UNITS[name]}"
                    if name not in {"heading", "x", "y"}:
                        legend += f", fit {100.0 * check.share[name]:.0f} %"
                    axis.plot(
                        times, predicted, color=colour, linestyle=style,
                        label=legend if k == 0 else None,
                    )  # fmt: skip
            axis.set_ylabel(label)
            axis.legend(
                loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, frameon=False,
                borderaxespad=0.1,
            )  # fmt: skip
        axes[-1].set_xlabel("time (s), windows that were not fitted")
        save_figure(figure, file)


def table(found: Identification) -> "Table":
    """Return the console's table of parameters."""
    from rich.table import Table

    nominal = nominal_parameters(found.nominal)
    nominal[nominal <= SHORTEST_LAG] = 0.0
    shown = Table("parameter", "unit", title="Parameters, per mass", title_justify="left")
    for heading in ("nominal", "identified", "1 sigma"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for (name, row), before in zip(parameters_of(found).items(), nominal, strict=True):
        deviation = row["deviation"]
        shown.add_row(
            name, row["unit"], f"{before:.4g}", f"{row['value']:.4g}",
            "held" if deviation is None else f"{deviation:.2g}",
        )  # fmt: skip
    return shown


def check_table(checks: dict[str, Check]) -> "Table":
    """Return the console's table of errors over the windows that were not fitted."""
    from rich.table import Table

    shown = Table("channel", "unit", title="Predictions of the last third", title_justify="left")
    for label in checks:
        shown.add_column(f"{label} rms", justify="right", no_wrap=True)
        shown.add_column("fit %", justify="right", no_wrap=True)
    for name in next(iter(checks.values())).rms:
        row = [name, CHANNEL_UNITS[name]]
        for check in checks.values():
            told = name not in {"heading", "x", "y"}
            share = f"{max(100.0 * check.share[name], -999.0):.0f}" if told else ""
            row += [f"{check.rms[name]:.3g}", share]
        shown.add_row(*row)
    return shown


def summary(found: Identification) -> str:
    """Return a line on the windows and what was driven."""
    windows, driven = found.windows, found.excitation
    left = [
        f"{windows[key]} {words}"
        for key, words in (("slow", "too slow"), ("sliding", "beyond the tyres' linear range"))
        if windows[key]
    ]
    return (
        f"{windows['fitted']} windows fitted, {windows['checked']} checked"
        + (f", left out: {', '.join(left)}" if left else "")
        + f"; {driven['lowest_speed']:.1f} to {driven['highest_speed']:.1f} m/s, lateral "
        f"acceleration up to {driven['lateral_acceleration']:.1f} m/s^2, yaw acceleration "
        f"{driven['yaw_acceleration_rms']:.2f} rad/s^2 rms"
    )
