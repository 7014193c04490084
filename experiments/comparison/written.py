"""Files of a comparison: comparison.csv, .tex and .json, and the figures as SVG and PDF."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.comparison.competitors import Drive
from experiments.comparison.figures import write_figures
from experiments.comparison.measures import Measure
from experiments.comparison.outcomes import Metric, Outcome, Profile
from experiments.comparison.texts import NOTE, as_csv, basis, latex, name_of, remarks
from experiments.run.provenance import command_line, provenance
from experiments.run.statistics import Interval
from experiments.run.store import ResultStore, write_json
from trajectories.fileio import write_atomically


def write(outcomes: Sequence[Outcome], folder: Path, width: str) -> list[str]:
    """Write all files of comparisons into a folder and return their names.

    `width` is that of the figures, "column" or "page" (`experiments.comparison.figures.WIDTHS`).
    """
    folder.mkdir(parents=True, exist_ok=True)
    texts = {"csv": as_csv(outcomes), "tex": latex(outcomes, comment(outcomes))}
    for suffix, text in texts.items():
        # A folder's name may be no UTF-8.
        content = text.encode(errors="backslashreplace")
        write_atomically(folder / f"comparison.{suffix}", content)
    write_json(folder / "comparison.json", as_json(outcomes))
    names = ["comparison.csv", "comparison.tex", "comparison.json"]
    return [*names, *write_figures(outcomes, folder, width)]


def comment(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the lines that say how a table came about: command, versions, what it shows."""
    made = provenance()
    versions = ", ".join(
        f"{name} {made['versions'][name]}" for name in ("lpv-track-env", "numpy", "scipy")
        if name in made["versions"]
    )  # fmt: skip
    lines = [" ".join(command_line()), f"{versions}; commit {made['revision'].get('commit')}"]
    for outcome in outcomes:
        lines += [
            f"A: {name_of(outcome.a)} (baseline); B: {name_of(outcome.b)}", basis(outcome),
            *remarks(outcome),
        ]  # fmt: skip
    return [*lines, NOTE]


def as_json(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return all numbers as plain JSON; what is infinite is the text "inf", what is not None."""
    folders = {one.folder: None for outcome in outcomes for one in (outcome.a, outcome.b)}
    return {
        "format": "lpv-track-comparison/1",
        "command": command_line(),
        **provenance(),
        "folders": {str(folder): _manifest(folder) for folder in folders},
        "comparisons": [_comparison(outcome) for outcome in outcomes],
    }


def _manifest(folder: Path) -> dict[str, Any]:
    """Return what a folder's manifest says of how its results came about."""
    manifest = ResultStore(folder).manifest()
    names = ("key", "written", "command", "revision", "versions", "hardware")
    return {name: manifest[name] for name in names if name in manifest}


def _comparison(outcome: Outcome) -> dict[str, Any]:
    found = {key: _plain(value) for key, value in vars(outcome).items() if key not in ("a", "b")}
    for side in ("a", "b"):
        competitor = getattr(outcome, side)
        found[side] = {
            "label": competitor.label, "folder": str(competitor.folder),
            "trainings": competitor.trainings,
        }  # fmt: skip
    (a_low, a_high), (b_low, b_high) = outcome.failure_rates()
    rates = {"failure_rate_a": [a_low, a_high], "failure_rate_b": [b_low, b_high]}
    return {**found, **rates, "drives": len(outcome.drives)}


def _plain(value: Any) -> Any:
    """Convert results to plain JSON."""
    if isinstance(value, Metric | Profile | Interval):
        value = vars(value)
    elif isinstance(value, Measure):
        value = value._asdict()
    elif isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return str(value) if isinstance(value, Drive) else value
