"""Shards of a benchmark, joined, are the benchmark; what does not fit together is refused."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from experiments.cli import main
from experiments.run import exact
from experiments.run.benchmark import distinct, run_benchmark, shard
from experiments.run.engines import Engine
from experiments.run.merging import merge
from experiments.run.store import ResultStore
from experiments.run.suites import grid
from tests.helpers import made_results as made

SPECS = distinct(
    grid(["stanley", "pure-pursuit"], ["u-turn"], conditions="randomised", seeds=range(3))
)


def sweep(folder: Path, specs: list[dict[str, Any]], **more: Any) -> ResultStore:
    more = {"settings": {}, **more}
    console = Console(file=io.StringIO())
    return run_benchmark(specs, folder, engine=Engine(1), console=console, **more)


def test_joined_shards_are_the_whole_benchmark_to_the_last_bit(tmp_path: Path) -> None:
    whole = sweep(tmp_path / "whole", SPECS)
    parts = [tmp_path / f"shard-{k}" for k in (1, 2, 3, 4)]
    for k, part in enumerate(parts, start=1):
        sweep(part, shard(SPECS, k, 4), settings={"suite": "custom", "shard": f"{k}/4"})
    found = merge(tmp_path / "all", parts)
    assert found == (len(SPECS), len(SPECS), [])
    joined = ResultStore(tmp_path / "all")
    compared = exact.compare(whole.folder, joined.folder)
    assert (compared.paired, compared.differences) == (len(SPECS), [])
    for case in whole.cases():
        old, new = whole.trace(case["id"]), joined.trace(case["id"])
        assert old is not None
        assert new is not None
        assert old.keys() == new.keys()
        assert all(np.array_equal(old[name], new[name]) for name in old if name != "solve_time")
    settings = joined.manifest()["settings"]
    assert sorted(settings["cases"]) == sorted(whole.ids())
    assert [part["shard"] for part in settings["merged"]] == ["1/4", "2/4", "3/4", "4/4"]
    assert settings["suite"] == "custom"
    assert "shard" not in settings
    before = joined.cases_file.read_bytes()
    assert merge(tmp_path / "all", parts[:2]).added == 0
    assert joined.cases_file.read_bytes() == before
    assert joined.manifest()["settings"] == settings


def test_an_interrupted_merge_is_completed(tmp_path: Path) -> None:
    made.folder_of(tmp_path / "a", [made.case(k) for k in range(4)])
    made.folder_of(tmp_path / "b", [made.case(k) for k in range(4, 8)])

    def stop(done: int, _: int) -> None:
        if done == 6:
            raise KeyboardInterrupt

    folders = [tmp_path / "a", tmp_path / "b"]
    with pytest.raises(KeyboardInterrupt):
        merge(tmp_path / "all", folders, stop)
    assert len(ResultStore(tmp_path / "all").ids()) == 6
    assert merge(tmp_path / "all", folders) == (8, 2, [])
    joined = ResultStore(tmp_path / "all")
    assert joined.cases() == [made.case(k) for k in range(8)]
    assert joined.cases_file.read_bytes().count(b"\n") == 8
    assert all(joined.trace(case["id"]) is not None for case in joined.cases())


def test_a_case_with_two_values_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made.folder_of(tmp_path / "a", [made.case(0), made.case(1)], traces=False)
    other = made.case(1, metrics={"ale": 0.08000000000000002}, seconds=99.0)
    made.folder_of(tmp_path / "b", [made.case(2), other], traces=False)
    folders = [str(tmp_path / name) for name in ("all", "a", "b")]
    assert main(["merge", *folders]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"case {other['id']}: metrics.ale is 0.08 in {folders[1]}" in line
    assert f"and 0.08000000000000002 in {folders[2]}" in line
    assert not ResultStore(tmp_path / "all").ids()


def test_equal_cases_may_differ_in_times_and_in_how_numbers_are_written(tmp_path: Path) -> None:
    first, second = made.case(1), made.case(1, seconds=99.0, solver={"median": 0.5, "p99": 0.6})
    second["metrics"]["duration"] = 60
    made.folder_of(tmp_path / "a", [first])
    made.folder_of(tmp_path / "b", [second])
    assert merge(tmp_path / "all", [tmp_path / "a", tmp_path / "b"]) == (1, 1, [])
    assert ResultStore(tmp_path / "all").cases() == [first]


def test_what_went_well_is_kept_and_not_what_failed(tmp_path: Path) -> None:
    failed = [made.case(k, status="failed", error="late") for k in (1, 2)]
    made.folder_of(tmp_path / "a", [failed[0], made.case(2)])
    # Within a folder the last line of an id counts.
    made.folder_of(tmp_path / "b", [failed[0], failed[1], made.case(1)])
    merge(tmp_path / "all", [tmp_path / "a"])
    assert ResultStore(tmp_path / "all").ids() == {failed[0]["id"]: "failed", failed[1]["id"]: "ok"}
    assert merge(tmp_path / "all", [tmp_path / "a", tmp_path / "b"]) == (2, 1, [])
    assert ResultStore(tmp_path / "all").cases() == [made.case(1), made.case(2)]


def test_damaged_lines_are_named_and_manifests_of_all_machines_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, key in (("a", "aaaaaaaa"), ("b", "bbbbbbbb"), ("c", "aaaaaaaa")):
        store = made.folder_of(tmp_path / name, [made.case(int(name, 16))], traces=False)
        text = json.dumps({"key": key, "settings": {"suite": name}, "command": ["x"]})
        (store.folder / "manifest.json").write_text(text)
    (tmp_path / "b" / "manifest-before.json").write_text("{}")
    with (tmp_path / "b" / "cases.jsonl").open("a") as handle:
        handle.write("damaged\n")
    folders = [str(tmp_path / name) for name in ("all", "a", "b", "c")]
    assert main(["merge", *folders]) == 0
    out = capsys.readouterr().out
    assert "cases.jsonl, line 2: is not JSON" in " ".join(out.split())
    assert "3 cases in" in out
    joined = ResultStore(tmp_path / "all")
    assert joined.manifest()["key"] == "aaaaaaaa"
    assert joined.manifest_of("bbbbbbbb")["settings"] == {"suite": "b"}
    assert sorted(file.name for file in (tmp_path / "all").glob("manifest*")) == [
        "manifest-bbbbbbbb.json", "manifest.json",
    ]  # fmt: skip


def test_folders_without_results_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made.folder_of(tmp_path / "a", [made.case(1)], traces=False)
    assert main(["merge", str(tmp_path / "a"), str(tmp_path / "a")]) == 2
    assert "cannot be merged into itself" in capsys.readouterr().err
    assert main(["merge", str(tmp_path / "all"), str(tmp_path / "none")]) == 2
    assert "holds no results to merge" in capsys.readouterr().err
    assert not (tmp_path / "all").exists()


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "-1/3", "1/3/5", "a/b", "1/0", "1.0/2"])
def test_what_is_no_shard_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", f"--shard={text}"]) == 2
    assert "must be I/N with 1 <= I <= N" in capsys.readouterr().err


def test_shards_hold_every_case_once() -> None:
    specs = [{"seed": k} for k in range(10)]
    parts = [shard(specs, k, 4) for k in (1, 2, 3, 4)]
    assert [len(part) for part in parts] == [3, 3, 2, 2]
    assert sorted(spec["seed"] for part in parts for spec in part) == list(range(10))
    with pytest.raises(ValueError, match="shard 11/12 holds none of the 10 cases"):
        shard(specs, 11, 12)


@pytest.mark.parametrize(("kept", "count"), [("all", 6), ("drawn", 2), ("none", 0)])
def test_traces_are_kept_as_wanted(tmp_path: Path, kept: str, count: int) -> None:
    store = sweep(tmp_path, SPECS, traces=kept)
    assert store.manifest()["settings"]["traces"] == kept
    there = [case for case in store.cases() if store.trace(case["id"]) is not None]
    assert len(there) == count
    if kept == "drawn":
        assert {(case["agent"], case["seed"]) for case in there} == {
            ("stanley", 0), ("pure-pursuit", 0),
        }  # fmt: skip


@pytest.mark.parametrize("name", ["cases.jsonl", "manifest.json", "traces"])
@pytest.mark.parametrize("side", ["out", "in"])
def test_folders_of_links_are_refused(tmp_path: Path, name: str, side: str) -> None:
    made.folder_of(tmp_path / "out", [made.case(1)]).write_manifest({})
    made.folder_of(tmp_path / "in", [made.case(2)]).write_manifest({})
    mine = (tmp_path / side / name).rename(tmp_path / "mine")
    (tmp_path / side / name).symlink_to(mine)
    before = mine.read_bytes() if mine.is_file() else sorted(mine.iterdir())
    with pytest.raises(ValueError, match=f"{name} is a link"):
        merge(tmp_path / "out", [tmp_path / "in"])
    assert before == (mine.read_bytes() if mine.is_file() else sorted(mine.iterdir()))


def test_a_link_in_place_of_a_trace_brings_no_file_from_elsewhere(tmp_path: Path) -> None:
    store = made.folder_of(tmp_path / "in", [made.case(1)], traces=False)
    (tmp_path / "mine").write_text("secret")
    (store.folder / "traces").mkdir()
    trace = store.folder / "traces" / f"{made.case(1)['id']}.npz"
    trace.symlink_to(tmp_path / "mine")
    found = merge(tmp_path / "out", [store.folder])
    assert (found.cases, found.skipped) == (1, [f"{trace}: is a link"])
    assert not (tmp_path / "out" / "traces").exists()


def test_many_numbers_that_are_written_otherwise_are_compared_in_one_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pass over both folders for each of them would take days for a hundred thousand cases."""
    for name, value, zero in (("a", 1.0, 0.0), ("b", 1, -0.0)):
        cases = [
            made.case(k, metrics={"mle": value, "aoe": zero}, fixed_speed=value) for k in range(3)
        ]
        made.folder_of(tmp_path / name, cases, traces=False)
    monkeypatch.setattr("experiments.run.merging._refuse", None)
    assert merge(tmp_path / "all", [tmp_path / "a", tmp_path / "b"]).cases == 3
