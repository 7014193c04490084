"""Rows, their drives and places, on hand-made folders."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from experiments.leaderboard.board import (
    Entry,
    cells,
    command_of,
    entries_of,
    markdown,
    origin,
    page,
)
from experiments.leaderboard.marks import Mark
from experiments.leaderboard.rows import Section, drives_of_suite, sections_of
from experiments.run import suites
from tests.helpers.made_results import Outline, case, folder_of, own_scripts_alone


def results(
    mle: float, agent: str = "stanley", first: int = 0, paths: Sequence[str] = ("T2", "u-turn")
) -> list[dict[str, Any]]:
    return [
        case(first + k, agent, path, {"mle": mle, "ale": mle / 2}) for k, path in enumerate(paths)
    ]


def folder(
    place: Path, cases: Sequence[dict[str, Any]], suite: str | None = "quick", seeds: int = 1
) -> Path:
    folder_of(place, cases, traces=False)
    manifest = {
        "settings": {"suite": suite, "seeds": list(range(seeds))},
        "versions": {"numpy": "2.4.0", "python": "3.11.7"},
        "revision": {"commit": "0123456789abcdef", "modified": True},
        "hardware": {"processor": "A processor", "cores": 8, "system": "Linux"},
    }  # fmt: skip
    if suite is not None:
        (place / "manifest.json").write_text(json.dumps(manifest))
    return place


def board(*folders: Path) -> list[tuple[Section, list[Entry]]]:
    return [(one, entries_of(one, {}, {})) for one in sections_of(folders, [])]


def only(*folders: Path) -> list[Entry]:
    ((_, entries),) = board(*folders)
    return entries


def texts(entry: Entry) -> list[str]:
    return [
        cell if isinstance(cell, str) else " | ".join(filter(None, cell)) for cell in cells(entry)
    ]


def test_rows_of_several_folders_are_ranked_in_one_section(tmp_path: Path) -> None:
    a = folder(tmp_path / "a", results(0.3) + results(0.1, "pid", 10))
    b = folder(tmp_path / "b", results(0.2))
    entries = only(a, b)
    assert [(one.place, one.row.label, one.row.name) for one in entries] == [
        (1, "pid", "a"), (2, "stanley", "b"), (3, "stanley", "a"),
    ]  # fmt: skip
    assert [one.rank.rank for one in entries if one.rank] == [1.0, 2.0, 3.0]


def test_a_row_shows_what_its_cases_and_manifest_hold(tmp_path: Path) -> None:
    entry = only(folder(tmp_path / "a", results(0.2)))[0]
    assert texts(entry) == [
        "stanley | a", "1", "1.00 | 1.00 to 1.00", "2 of 2 | failures 0.0 to 84.2 %",
        "0.1000 | 0.1000 to 0.1000", "0.2000 | 0.2000 to 0.2000", "2.000 | p99 4.00",
        "2 of 2", "–", "not rerun",
    ]  # fmt: skip
    text = markdown([(sections_of([tmp_path / "a"], [])[0], [entry])], "t", "c", [])
    assert "0123456789ab with changes" in text
    assert "python 3.11.7, numpy 2.4.0" in text
    assert "A processor" in text


def test_equal_rows_share_a_place(tmp_path: Path) -> None:
    entries = only(
        folder(tmp_path / "a", results(0.2)), folder(tmp_path / "b", results(0.2)),
        folder(tmp_path / "c", results(0.3)),
    )  # fmt: skip
    assert [one.place for one in entries] == [1, 1, 3]


def test_a_row_that_lacks_drives_has_no_place_and_does_not_change_the_others(
    tmp_path: Path,
) -> None:
    whole = folder(tmp_path / "whole", results(0.2) + results(0.1, "pid", 10))
    before = [(one.place, one.rank) for one in only(whole)]
    part = folder(tmp_path / "part", results(0.001, paths=["T2"]))
    entries = only(whole, part)
    assert [(one.place, one.rank) for one in entries[:2]] == before
    assert entries[2].place is None
    assert texts(entries[2])[1] == "– | incomplete"
    assert texts(entries[2])[7] == "1 of 2"


def test_drives_beside_those_of_the_suite_do_not_count(tmp_path: Path) -> None:
    further = [case(5, trajectory="T2", seed=1), case(6, trajectory="T6", metrics={"mle": 99.0})]
    entry = only(folder(tmp_path / "a", results(0.2) + further))[0]
    assert entry.place == 1
    assert texts(entry)[7] == "2 of 2 | and 2 further"
    assert texts(entry)[5] == "0.2000 | 0.2000 to 0.2000"


def test_failed_drives_are_behind_and_make_the_scores_infinite(tmp_path: Path) -> None:
    lost = [case(1, end="left_corridor"), case(2, "stanley", "u-turn", status="failed", end=None)]
    entries = only(folder(tmp_path / "a", lost), folder(tmp_path / "b", results(5.0, "pid", 10)))
    assert [one.row.label for one in entries] == ["pid", "stanley"]
    assert texts(entries[1])[3:6] == ["0 of 2 | failures 15.8 to 100.0 %", "∞", "∞"]


def test_folders_without_a_suite_meet_only_on_the_same_drives(tmp_path: Path) -> None:
    a = folder(tmp_path / "a", results(0.2), "custom")
    b = folder(tmp_path / "b", results(0.1), suite=None)
    c = folder(tmp_path / "c", results(0.1, paths=["T2"]), "no such suite")
    found = {tuple(one.row.name for one in entries): section for section, entries in board(a, b, c)}
    assert set(found) == {("b", "a"), ("c",)}
    assert {section.suite for section in found.values()} == {"custom"}


def test_a_suite_and_own_drives_are_sections_of_their_own(tmp_path: Path) -> None:
    found = board(
        folder(tmp_path / "a", results(0.2), "custom"), folder(tmp_path / "b", results(0.2))
    )
    assert [section.suite for section, _ in found] == ["quick", "custom"]


def test_trainings_are_one_row_with_both_spreads(tmp_path: Path) -> None:
    def trained(seed: int, mle: float) -> list[dict[str, Any]]:
        cost = {"algorithm": "ppo", "steps": 1000, "seconds": 60.0 + seed, "solves": 0}
        found = results(mle, f"runs/ppo/seed-{seed}/policy.json", 10 * seed)
        return [{**one, "training": cost} for one in found]

    cases = [*trained(0, 0.1), *trained(1, 0.2), *trained(2, 0.6), *results(0.15, "pid", 90)]
    entries = only(folder(tmp_path / "a", cases))
    assert [(one.row.label, one.place) for one in entries] == [("pid", 1), ("runs/ppo", 2)]
    shown = texts(entries[1])
    assert shown[3] == "6 of 6 | by training 2 to 2 of 2"
    assert shown[5] == "0.2750 | drives 0.2750 to 0.2750; trainings 0.1000 to 0.6000"
    assert shown[7] == "2 of 2"
    assert shown[8] == "3"
    assert origin(entries[1])[-2] == "3.00 k steps, 3 min, 0 solves"


def test_a_training_that_lacks_a_drive_makes_its_row_incomplete(tmp_path: Path) -> None:
    cases = [
        *results(0.1, "ppo/seed-0/policy.json"), *results(0.1, "ppo/seed-1/policy.json", 10)[:1]
    ]  # fmt: skip
    entry = only(folder(tmp_path / "a", cases))[0]
    assert entry.place is None
    assert texts(entry)[7] == "1 of 2"


def test_a_refuted_row_has_no_place_and_does_not_change_the_others(tmp_path: Path) -> None:
    a, b = folder(tmp_path / "a", results(0.01)), folder(tmp_path / "b", results(0.2))
    section = sections_of([a, b], [])[0]
    marks = {section.rows[0].key: Mark("✗ does not reproduce (1 of 5)", "m", refuted=True)}
    first, second = entries_of(section, marks, {})
    assert (first.row.name, first.place, first.rank and first.rank.rank) == ("b", 1, 1.0)
    assert (second.row.name, second.place, second.rank) == ("a", None, None)


def test_folders_of_one_name_are_told_apart(tmp_path: Path) -> None:
    entries = only(
        folder(tmp_path / "one" / "results", results(0.1)),
        folder(tmp_path / "two" / "results", results(0.2)),
    )
    assert [one.row.name for one in entries] == ["one/results", "two/results"]


def test_the_command_of_a_row_names_its_sample(tmp_path: Path) -> None:
    made = folder(tmp_path / "of mine", results(0.1))
    section = sections_of([made], [])[0]
    (entry,) = entries_of(section, {}, {section.rows[0].key: ["ab", "cd"]})
    assert command_of(entry) == f"lpv-track reproduce '{made}' --id ab cd"
    assert command_of(only(made)[0]) == f"lpv-track reproduce '{made}' --sample 5"


def test_a_command_of_several_rows_is_written_once(tmp_path: Path) -> None:
    made = folder(tmp_path / "mine", [*results(0.1), *results(0.2, "pid", 10)])
    assert len(only(made)) == 2
    text = markdown(board(made), "Board", "made", [])
    assert text.count(f"lpv-track reproduce {made} --sample 5") == 1


@pytest.mark.parametrize(
    ("suite", "number"),
    [("quick", 2), ("realtime", 60), ("paper", 78), ("learned", 346), ("converged", 18)],
)
def test_drives_of_a_suite_are_those_of_every_agent(suite: str, number: int) -> None:
    """`paper`: the six at variable and at fixed speed and with another car, and 60 in real time;
    raw waypoints are not given to learned policies, and IPOPT's NMPC has six drives in all."""
    assert len(drives_of_suite(suite, 1)) == number


def test_more_seeds_add_drives_or_make_a_section_of_their_own(tmp_path: Path) -> None:
    """In `quick` seeds add drives; in `limits` paths that meet chance have other seeds then."""
    one, two = folder(tmp_path / "a", results(0.2)), folder(tmp_path / "b", results(0.1), seeds=2)
    assert [one.place for one in only(one, two)] == [1, 2]
    spec = suites.limits(("stanley",), (0,))[0]
    driven = {**case(1, "stanley"), **spec, "agent": "stanley"}
    found = board(
        folder(tmp_path / "c", [driven], "limits"),
        folder(tmp_path / "d", [driven], "limits", 5),
        folder(tmp_path / "e", [driven], "limits", 10_000),
    )
    assert [(section.seeds, len(entries)) for section, entries in found] == [(1, 2), (5, 1)]
    assert [len(section.drives) for section, _ in found] == [580, 741]


def test_every_suite_has_drives_for_every_agent() -> None:
    assert min(len(drives_of_suite(suite, 1)) for suite in suites.SUITES) >= 2


def test_a_folder_that_is_none_or_given_twice_is_refused(tmp_path: Path) -> None:
    made = folder(tmp_path / "a", results(0.1))
    with pytest.raises(ValueError, match=r"holds no cases\.jsonl"):
        sections_of([made, tmp_path / "nothing"], [])
    assert not (tmp_path / "nothing").exists()
    with pytest.raises(ValueError, match="is given twice"):
        sections_of([made, tmp_path / "." / "a" / ".." / "a"], [])


def test_page_and_markdown_hold_every_row(tmp_path: Path) -> None:
    made = board(folder(tmp_path / "a", results(0.2) + results(0.1, "pid", 10)))
    text = page(made, "Our board", "made by a command", [])
    Outline(text)
    assert own_scripts_alone(text)
    for words in ("Our board", "Suite quick", "pid", "stanley", "lpv-track reproduce"):
        assert words in text
    lines = markdown(made, "Our board", "lpv-track leaderboard a", []).splitlines()
    assert lines[0] == "# Our board"
    assert lines[2] == "Made by `lpv-track leaderboard a`; do not edit."
    rows = [line for line in lines if line.startswith("| ")]
    assert len({line.count(" | ") for line in rows[:4]}) == 1
    assert math.isclose(float(rows[2].split(" | ")[2].split("<br>")[0]), 1.0)
