"""Replay of drives: the data that `replay.js` shows, thinned and quantised."""

import base64
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.report.drives import (
    Drive,
    by_setting,
    by_trajectory,
    families,
    family_of,
    reference_line,
)
from experiments.report.page import joined, paragraph
from experiments.report.svg_charts import spread
from lpv_track_env.bicycle import PSI, VX, X, Y

Array = NDArray[np.float64]

SCRIPT = "replay.js"
SAMPLES = 500
"""Largest number of samples of a drive; the script interpolates between them."""
REFERENCE_POINTS = 1000
BUDGET = 3_000_000
"""Largest size of all drives' data, bytes."""
PLACE = (
    '<div class="replay" id="replay" role="group" aria-label="Replay of drives" hidden></div>\n'
    "<noscript><p>The replay needs JavaScript; everything else reads without.</p></noscript>"
)
QUANTA = 32_000
"""Steps of a signed 16-bit integer on each side of the middle of a quantity's range."""
BODY = (4.5, 1.8, 1.3, 1.4)
"""Length, width, front and rear axle distance (m) of a vehicle that cannot be loaded."""


def quantised(values: Array) -> list[Any]:
    """Return middle, quantum and 16-bit little-endian integers in base64 of values (n,)."""
    middle = 0.5 * float(values.max() + values.min())
    quantum = max(float(np.ptp(values)) / (2 * QUANTA), 1e-9)
    whole = np.rint((values - middle) / quantum).astype("<i2")
    return [
        float(f"{middle:.9g}"), float(f"{quantum:.6g}"),
        base64.b64encode(whole.tobytes()).decode("ascii"),
    ]  # fmt: skip


def moments(drive: Drive) -> dict[str, Any]:
    """Return the labels, the end and the quantities of a drive at evenly spaced times."""
    trace, case = drive.trace, drive.case
    time = trace["time"]
    count = min(len(time), SAMPLES)
    at = np.linspace(time[0], time[-1], count)
    state = trace["state"]
    quantities = {
        "x": state[:, X], "y": state[:, Y], "yaw": np.unwrap(state[:, PSI]), "speed": state[:, VX],
        "steering": trace["steering_angle"], "acceleration": trace["acceleration"],
        "lateral": trace["lateral_error"], "heading": trace["heading_error"],
    }  # fmt: skip
    car = drive.car
    body = BODY
    if car is not None:
        body = car.length, car.width, car.front_axle_distance, car.rear_axle_distance
    return {
        "path": drive.trajectory,
        "agent": drive.label,
        "conditions": drive.conditions,
        "seed": case.get("seed"),
        "family": str(family_of(case)),
        "end": str(case.get("end") or "?").replace("_", " "),
        "duration": float(time[-1] - time[0]),
        "count": count,
        "body": body,
        "values": {
            name: quantised(np.interp(at, time, values)) for name, values in quantities.items()
        },
    }


def chosen(drives: Sequence[Drive], budget: int = BUDGET) -> list[tuple[Drive, str]]:
    """Return the drives to embed, each with its JSON: whole settings while they fit the budget.

    The first family's conditions come first. If the first setting alone is too large, those of its
    drives that fit are embedded.
    """
    kept: list[tuple[Drive, str]] = []
    used = 0
    ordered = [drive for family in families(drives) for drive in family.drives]
    for group in by_setting(ordered).values():
        texts = [(drive, json.dumps(moments(drive), separators=(",", ":"))) for drive in group]
        size = sum(len(text) for _, text in texts)
        if used and used + size > budget:
            continue
        for one in texts:
            if used + len(one[1]) <= budget:
                kept.append(one)
                used += len(one[1])
    return kept


def data_block(kept: Sequence[tuple[Drive, str]]) -> str:
    """Return the script element with all data; no text of a results folder can end it."""
    paths: dict[str, Mapping[str, Any]] = {}
    for name, group in by_trajectory(drive for drive, _ in kept).items():
        x, y = reference_line(group)
        at = spread(len(x), REFERENCE_POINTS)
        paths[name] = {"count": len(at), "x": quantised(x[at]), "y": quantised(y[at])}
    runs = ",".join(text for _, text in kept)
    text = f'{{"paths":{json.dumps(paths, separators=(",", ":"))},"runs":[{runs}]}}'
    # In JSON, < occurs in strings only.
    safe = text.replace("<", "\\u003c")
    return f'<script type="application/json" id="replay-data">{safe}</script>'


def replay_section(drives: Sequence[Drive]) -> str:
    """Return the element that the replay fills, with its data; "" without drives."""
    kept = chosen(drives)
    if not kept:
        return ""
    groups = by_setting(drive for drive, _ in kept)
    left = [setting for setting in by_setting(drives) if setting not in groups]
    rule = (
        f"{len(kept)} drives are embedded: every agent's first seed on every path, setting by "
        f"setting up to {BUDGET / 1e6:g} MB ({'; '.join(map(str, groups))}). A drive is thinned to "
        f"at most {SAMPLES} samples, quantities to 16 bits; the results folder has the exact "
        "values."
    )
    if left:
        rule += f" Not embedded: {'; '.join(map(str, left))}."
    return joined(
        [
            paragraph(
                "Choose a path and one or two drives, then play, or drag the slider or a chart. "
                "With the slider in focus, the arrow keys step and Home and End jump; the space "
                "bar plays and pauses."
            ),
            PLACE,
            paragraph(rule, "soft"),
            data_block(kept),
        ]
    )
