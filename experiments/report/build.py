"""Build `report.html` from a results folder: nothing is simulated again, nothing is fetched."""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.report import drive_replay
from experiments.report.agent_comparison import comparison_section, curvature_section
from experiments.report.cost import computing_section, learning_section
from experiments.report.drive_figures import figure_sections
from experiments.report.drives import NO_FILES, NamedFiles, drives_of, in_families
from experiments.report.page import Document, html_table, joined, line_styles, paragraph
from experiments.report.sideslip import sideslip_section
from experiments.report.summary import failures_section, regime_section, summary_section
from experiments.run import tables
from experiments.run.result_schema import read_driven
from experiments.run.store import ResultStore
from experiments.run.tables import Result
from trajectories.fileio import write_atomically

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
SHOWN = 5
"""Number of messages and of files that a note names."""
LONGEST_LIST = 24
"""Number of entries of a list that are shown."""


def write_report(
    folder: Path, files: NamedFiles = NO_FILES, skipped: list[str] | None = None
) -> Path:
    """Build `report.html` in a results folder from what the folder holds, and return its path.

    Lines of `cases.jsonl` that cannot be read are left out; the page says so.

    Parameters
    ----------
    folder
        The results.
    files
        Files of paths and vehicles that the cases name and that may be opened.
    skipped
        Receives a message for each line that is left out.

    Raises
    ------
    ValueError
        If the folder holds no cases that can be read.
    """
    none = f"no results in {folder}: run lpv-track benchmark --out {folder} first"
    if not (folder / "cases.jsonl").is_file():
        raise ValueError(none)
    store = ResultStore(folder)
    skipped = [] if skipped is None else skipped
    cases = store.cases(skipped, read_driven)
    if not cases:
        raise ValueError(skipped[0] if skipped else none)
    file = folder / "report.html"
    write_atomically(file, build(cases, store, files, skipped).encode())
    return file


def where(report: Path) -> str:
    """Return a line for a terminal: path and size of the report."""
    return f"report: {report} ({report.stat().st_size / 1e6:.1f} MB)"


def build(
    cases: Sequence[Result], store: ResultStore, files: NamedFiles, skipped: Sequence[str]
) -> str:
    """Return the page as text; `skipped` are messages on lines that could not be read."""
    kept = in_families(tables.ordered(tables.current(cases)))
    rows = tables.build_rows(kept)
    manifest = store.manifest()
    drives, missing = drives_of(kept, store, files)
    settings = manifest.get("settings")
    if isinstance(settings, Mapping) and settings.get("traces") in ("drawn", "none"):
        missing = []
    styles = line_styles(tables.labels(kept))
    document = Document()
    notes = joined([skipped_note(skipped), closed_note(kept, files)])
    summary = summary_section(document, kept, len(cases) - len(kept))
    document.section("Summary", joined([notes, summary]))
    document.section("By regime", regime_section(document, kept))
    figure_sections(document, drives, missing, styles)
    document.section("Replay", drive_replay.replay_section(drives), printed=False)
    document.section("Against the published table", comparison_section(document, kept, rows))
    document.section("By curvature", curvature_section(document, kept, styles))
    document.section("Computing time", computing_section(document, drives, styles))
    document.section("Failures and warnings", failures_section(document, kept))
    document.section(
        "Where the sideslip limit forbids the path",
        sideslip_section(document, kept, drives, styles),
    )
    document.section("What learning cost", learning_section(document, kept))
    document.section("Errata of the paper", errata_section())
    document.section("Settings and provenance", manifest_section(document, manifest, kept))
    scripts = (drive_replay.SCRIPT,) if drives else ()
    return document.render("Path tracking benchmark", subtitle(manifest), scripts)


def skipped_note(skipped: Sequence[str]) -> str:
    """Return a paragraph on lines of `cases.jsonl` that could not be read; "" without any."""
    if not skipped:
        return ""
    rest = f" … and {len(skipped) - SHOWN} more" if len(skipped) > SHOWN else ""
    lines = "; ".join(skipped[:SHOWN])
    return paragraph(f"Left out, because they cannot be read: {lines}{rest}.", "bad")


def closed_note(cases: Sequence[Result], files: NamedFiles) -> str:
    """Return a paragraph on the files that cases name and that were not opened; "" without any."""
    paths = {name for case in cases if files.closed_path(name := str(case.get("trajectory")))}
    cars = {name for case in cases if files.closed_vehicle(name := str(case.get("vehicle", "")))}
    closed = sorted(paths | cars)
    if not closed:
        return ""
    rest = f" … and {len(closed) - SHOWN} more" if len(closed) > SHOWN else ""
    return paragraph(
        f"Files that the cases name were not opened: {', '.join(closed[:SHOWN])}{rest}. Paths are "
        "drawn as far as they were driven, and vehicles in a usual size. If you trust the results, "
        "lpv-track report --open-named-files reads them.", "soft"
    )  # fmt: skip


def subtitle(manifest: Mapping[str, Any]) -> str:
    """Return date and revision of the results, as far as the manifest has them."""
    parts = ["LPV-NMPC after kumar2025lpv and other agents on lpv-track-env"]
    if written := manifest.get("written"):
        parts.append(str(written))
    revision = manifest.get("revision")
    if isinstance(revision, Mapping) and revision.get("commit"):
        modified = ", with changes" if revision.get("modified") else ""
        parts.append(f"revision {str(revision['commit'])[:12]}{modified}")
    return " · ".join(parts)


def errata_section() -> str:
    """Return the errata that matter when our numbers are compared with the paper's."""
    items = "".join(f"<li>{html.escape(text)}</li>" for text in ERRATA)
    return f"<ol>{items}</ol>"


def manifest_section(
    document: Document, manifest: Mapping[str, Any], cases: Sequence[Result]
) -> str:
    """Return command, settings, revision, versions, hardware and seeds."""
    parts = []
    keys = sorted({str(case["manifest"]) for case in cases if "manifest" in case})
    if len(keys) > 1:
        parts.append(
            paragraph(
                f"Computed with {len(keys)} different sets of versions ({', '.join(keys)}), so "
                "that last digits may differ: see the files manifest-….json.", "bad"
            )
        )  # fmt: skip
    command = manifest.get("command")
    if isinstance(command, list):
        parts.append(f'<pre tabindex="0">{html.escape(" ".join(map(str, command)))}</pre>')
    seeds = sorted({case.get("seed", 0) for case in cases})
    lines = _flattened(seeds, "seeds")
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
        rest = f" … ({len(value)} in all)" if len(value) > LONGEST_LIST else ""
        return [(name, words + rest)]
    return [(name, str(value))]
