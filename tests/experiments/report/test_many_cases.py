"""A report of many cases shows the first and the worst, and says how many there are."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.report import drives, sideslip, summary
from experiments.report.drives import drives_of
from experiments.run import console_tables, excerpts
from experiments.run.excerpts import first_and_worst
from tests.helpers import made_results as made

WORST = {"random-4": 9.0, "random-6": 8.0}
"""Largest errors of two of the later paths, m; random-5 has a failed drive."""


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four paths, two settings and three listed cases are many."""
    monkeypatch.setattr(excerpts, "MOST_PATHS", 4)
    for module in (drives, console_tables):
        monkeypatch.setattr(module, "MOST_SETTINGS", 2)
    for module in (summary, sideslip):
        monkeypatch.setattr(module, "MOST_LISTED", 3)


def results() -> list[dict[str, Any]]:
    found = [
        made.case(
            k, trajectory=f"random-{k}", metrics={"mle": WORST.get(f"random-{k}", 0.2)},
            warnings=[f"warning {k}"],
        )
        for k in range(9)
    ]  # fmt: skip
    found += [
        made.case(20 + k, trajectory="random-5", seed=k, status="failed", end=None, error=f"{k}")
        for k in range(1, 6)
    ]
    return found


def test_half_of_the_paths_are_the_first_and_half_the_worst(few: None) -> None:
    errors = {f"{k}": error for k, error in enumerate((1.0, 0.0, 2.0, np.inf, 3.0, 9.0))}
    assert first_and_worst(errors) == ["0", "1", "3", "5"]
    assert first_and_worst(dict(list(errors.items())[:4])) == ["0", "1", "2", "3"]
    # Among equally bad ones the earlier come first.
    assert first_and_worst({f"{k}": 1.0 for k in range(6)}) == ["0", "1", "2", "3"]


def test_a_report_shows_the_first_and_the_worst_paths(tmp_path: Path, few: None) -> None:
    store = made.folder_of(tmp_path, results())
    found, missing = drives_of(store.cases(), store)
    assert [drive.trajectory for drive in found] == ["random-0", "random-1", "random-4", "random-5"]
    assert missing == []
    text = made.page(tmp_path)
    made.Outline(text)
    assert "4 of 9 paths are shown" in text
    assert "Failed cases, 3 of 5." in text
    assert "the number of cases that gave them, 3 of 9." in text
    assert "9 of 14" in text  # drove the whole path: over all
    assert "random-4" in text
    assert "random-7" not in text
    table = made.printed(store.cases())
    assert "4 of 9 paths are shown" in " ".join(table.split())
    assert "9 of 14" in table


def test_a_report_of_many_settings_shows_the_first(tmp_path: Path, few: None) -> None:
    every = [made.case(k, conditions={"name": "ideal", "friction": 0.5 + k / 10}) for k in range(4)]
    store = made.folder_of(tmp_path, every, traces=False)
    assert "2 of 4 settings are shown." in made.page(tmp_path)
    assert "2 of 4 settings are shown." in made.printed(store.cases())


def test_the_worst_cases_at_the_sideslip_limit_are_listed(tmp_path: Path, few: None) -> None:
    every = [
        made.case(k, trajectory=f"random-{k}", metrics={"excess_lateral_velocity": 0.111 * k})
        for k in range(1, 5)
    ]
    made.folder_of(tmp_path, every, traces=False)
    text = made.page(tmp_path)
    assert "3 of 4 cases are listed: the worst." in text
    assert '<td class="n">0.444</td>' in text
    assert '<td class="n">0.111</td>' not in text


@pytest.mark.parametrize(("kept", "noted"), [("all", True), ("drawn", False), ("none", False)])
def test_traces_that_were_not_kept_are_not_missed(tmp_path: Path, kept: str, noted: bool) -> None:
    made.folder_of(tmp_path, [made.case(1)], traces=False)
    (tmp_path / "manifest.json").write_text(json.dumps({"settings": {"traces": kept}}))
    assert ("their traces cannot be read" in made.page(tmp_path)) == noted


def test_many_seeds_are_named_in_short(tmp_path: Path) -> None:
    made.folder_of(tmp_path, [made.case(k, seed=k) for k in range(40)], traces=False)
    text = made.page(tmp_path)
    assert "22, 23 … (40 in all)" in text
    assert "30, 31" not in text
