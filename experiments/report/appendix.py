"""Closing sections: errata of the paper, settings and provenance of the results."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.report.drives import Result
from experiments.report.page import Document, html_table, joined, paragraph

ERRATA = (
    "A[vy, vy] is printed with the front stiffness twice; the field gives Car + Caf cos δ.",
    "B is printed with its columns in the order [δ, a], while u = [a, δ].",
    (
        "The text bounds dvx/dt by 2 m/s², the derived row by 1; the table's own trajectories "
        "need up to 2.01. We take 2."
    ),
    "The section is titled kinematic; the model is the dynamic bicycle.",
    (
        "Ts, N, the vehicle's parameters and the weights are not given. The rate limits are per "
        "step: we take Ts = 0.02 s for them (0.5236 rad/s, 5 m/s³) and keep them as physical "
        "rates."
    ),
    (
        "The reference velocities are rotated with a sign that does not give the tangential "
        "speed; the tangential speed is meant."
    ),
    (
        "“Average” lateral and orientation errors are root mean squares by formula. By the "
        "formulas Max CTE equals MLE and Mean CTE never exceeds ALE, yet the published table "
        "has Mean CTE above ALE everywhere: its reference point must be another one, for "
        "example by the clock. The distance by the clock is given separately."
    ),
    (
        "The published maximum curvatures (up to 4.0 1/m) cannot be driven: |δ| ≤ π/6 allows "
        "0.175 1/m at a wheelbase of 3.3 m. The drivable trajectories match the other rows; the "
        "Tn-raw ones have kinks that match the curvature rows."
    ),
    (
        "The parallel nodes are said to cut latency; the paper gives no figure. Solve times are "
        "measured here."
    ),
)
"""Points where kumar2025lpv contradicts itself or leaves something out, and our reading."""
LONGEST_LIST = 24
"""Number of entries of a list that are shown."""


def errata_section() -> str:
    """Return the errata that matter when our numbers are compared with the paper's."""
    items = "".join(f"<li>{html.escape(text)}</li>" for text in ERRATA)
    return f"<ol>{items}</ol>"


def manifest_section(
    document: Document, manifest: Mapping[str, Any], cases: Sequence[Result]
) -> str:
    """Return command, settings, revision, versions, hardware and seeds."""
    parts = []
    command = manifest.get("command")
    if isinstance(command, list):
        parts.append(f'<pre tabindex="0">{html.escape(" ".join(map(str, command)))}</pre>')
    seeds = sorted({case.get("seed", 0) for case in cases})
    lines = [("seeds", ", ".join(map(str, seeds)))]
    if manifest:
        entries = _flattened({**manifest, "command": None})
        lines += [(name, value) for name, value in entries if value != "None"]
    else:
        parts.append(paragraph("The folder has no readable manifest.json.", "bad"))
    parts.append(
        document.table("The manifest.", html_table(("entry", "value"), lines, wrapped=(1,)))
    )
    return joined(parts)


def _flattened(value: Any, name: str = "") -> list[tuple[str, str]]:
    """Return the leaves of nested mappings with their dotted names; a list is one leaf."""
    if isinstance(value, Mapping):
        return [
            leaf
            for key in sorted(value, key=str)
            for leaf in _flattened(value[key], f"{name}.{key}" if name else str(key))
        ]
    if isinstance(value, list):
        words = ", ".join(map(str, value[:LONGEST_LIST]))
        rest = f" … ({len(value)} in manifest.json)" if len(value) > LONGEST_LIST else ""
        return [(name, words + rest)]
    return [(name, str(value))]
