"""Build `report.html` from a results folder: nothing is simulated again, nothing is fetched."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.report import drive_replay
from experiments.report.agent_comparison import comparison_section, curvature_section
from experiments.report.appendix import errata_section, manifest_section
from experiments.report.cost import computing_section, learning_section
from experiments.report.drives import Result, drives_of, in_families
from experiments.report.page import Document, line_styles
from experiments.report.sideslip import sideslip_section
from experiments.report.summary import failures_section, summary_section
from experiments.report.tracking import figure_sections
from experiments.run import tables
from experiments.run.store import ResultStore
from trajectories.fileio import write_atomically


def write_report(folder: Path) -> Path:
    """Build `report.html` in a results folder from what the folder holds, and return its path.

    Raises
    ------
    ValueError
        If the folder holds no cases, or a damaged line other than the last.
    """
    none = f"no results in {folder}: run lpv-track benchmark --out {folder} first"
    if not (folder / "cases.jsonl").is_file():
        raise ValueError(none)
    store = ResultStore(folder)
    cases = store.cases()
    if not cases:
        raise ValueError(none)
    file = folder / "report.html"
    write_atomically(file, build(cases, store).encode())
    return file


def where(report: Path) -> str:
    """Return a line for a terminal: path and size of the report."""
    return f"report: {report} ({report.stat().st_size / 1e6:.1f} MB)"


def build(cases: Sequence[Result], store: ResultStore) -> str:
    """Return the page as text."""
    kept = in_families(tables.ordered(tables.current(cases)))
    rows = tables.build_rows(kept)
    manifest = store.manifest()
    drives, missing = drives_of(kept, store)
    styles = line_styles(tables.labels(kept))
    document = Document()
    document.section("Summary", summary_section(document, kept, len(cases) - len(kept)))
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
