"""The folder of results survives what a killed run leaves, and says what it cannot read."""

import json
import subprocess

import numpy as np
import pytest

from experiments.run import provenance
from experiments.run import store as results
from experiments.run.store import ResultStore
from trajectories.fileio import write_atomically


def result(name, **more):
    return {"id": name, "agent": "stanley", "status": "ok", "metrics": {"ale": 0.1}, **more}


@pytest.fixture
def store(tmp_path):
    return ResultStore(tmp_path / "made" / "on" / "demand")


def test_what_is_appended_is_read_back_in_order(store):
    assert store.cases() == []
    trace = {"time": np.arange(3.0), "state": np.ones((3, 6))}
    store.append(result("b", trace=trace))
    store.append(result("a", trace={}))
    assert store.cases() == [result("b"), result("a")]  # lines carry no traces
    read = store.trace("b")
    assert sorted(read) == ["state", "time"]
    assert np.array_equal(read["state"], np.ones((3, 6)))
    assert store.trace("a") is None


def test_a_second_store_goes_on_where_the_first_stopped(store):
    store.append(result("a"))
    ResultStore(store.folder).append(result("b"))
    assert [case["id"] for case in store.cases()] == ["a", "b"]


@pytest.mark.parametrize("torn", [b'{"id": "c", "metr', b'{"id": "c"}', b"{", b"\xc3"])
def test_a_torn_last_line_is_dropped_and_cut_off_by_the_next_append(store, torn):
    store.append(result("a"))
    with store.cases_file.open("ab") as handle:
        handle.write(torn)
    assert store.cases() == [result("a")]
    store.append(result("b"))
    assert store.cases() == [result("a"), result("b")]
    assert store.cases_file.read_bytes().count(b"\n") == 2


def test_a_file_that_is_one_torn_line_is_empty(store):
    store.cases_file.write_bytes(b'{"id": "c", "me')
    assert store.cases() == []
    store.append(result("b"))
    assert store.cases() == [result("b")]


def test_of_lines_with_one_id_the_last_counts_in_the_place_of_the_first(store):
    store.append(result("a", status="failed"))
    store.append(result("b"))
    store.append(result("a", seconds=2.0))
    assert store.cases() == [result("a", seconds=2.0), result("b")]


@pytest.mark.parametrize("line", ["not json", "[1, 2]", "null", "7", '{"agent": "without id"}'])
def test_a_damaged_line_in_the_middle_is_named(store, line):
    store.append(result("a"))
    with store.cases_file.open("a") as handle:
        handle.write(f"{line}\n")
    store.append(result("b"))
    with pytest.raises(ValueError, match=r"cases\.jsonl, line 2: "):
        store.cases()
    skipped: list[str] = []
    assert store.cases(skipped) == [result("a"), result("b")]
    assert len(skipped) == 1
    assert "cases.jsonl, line 2: " in skipped[0]


def test_empty_lines_are_no_cases(store):
    store.append(result("a"))
    with store.cases_file.open("a") as handle:
        handle.write("\n  \n")
    assert store.cases() == [result("a")]


def test_numbers_that_json_does_not_know_are_refused_and_leave_no_line(store):
    store.append(result("a"))
    with pytest.raises(ValueError, match="JSON"):
        store.append(result("b", metrics={"ale": float("nan")}))
    assert store.cases() == [result("a")]


def test_a_trace_with_pickled_objects_is_not_loaded(store):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    store.append(result("a"))
    folder = store.folder / "traces"
    folder.mkdir()
    with (folder / "a.npz").open("wb") as handle:
        np.savez(handle, time=np.array([Trap()], dtype=object))
    assert store.trace("a") is None


@pytest.mark.parametrize("keep", [0, 3, 40, 300, -30])
def test_a_torn_trace_is_none(store, keep):
    store.append(result("a", trace={"time": np.random.default_rng(0).normal(size=200)}))
    file = store.folder / "traces" / "a.npz"
    file.write_bytes(file.read_bytes()[:keep])
    assert store.trace("a") is None


def test_a_trace_with_flipped_bytes_is_none(store):
    store.append(result("a", trace={"time": np.random.default_rng(0).normal(size=200)}))
    file = store.folder / "traces" / "a.npz"
    content = bytearray(file.read_bytes())
    content[200:260] = bytes(60)
    file.write_bytes(bytes(content))
    assert store.trace("a") is None


def test_the_manifest_says_what_was_run_where(store):
    assert store.manifest() == {}
    written = store.write_manifest({"suite": "paper", "seeds": [0, 1]})
    assert store.manifest() == written
    assert written["settings"] == {"suite": "paper", "seeds": [0, 1]}
    assert written["format"] == "lpv-track-results/1"
    assert written["revision"]["sources"] == provenance.project_digest()
    assert store.manifest_of(written["key"]) == written
    assert store.manifest_of("00000000") == store.manifest_of("../before") == {}
    assert {"python", "numpy", "casadi", "lpv-track-env"} <= set(written["versions"])
    assert set(written["hardware"]) == {
        "processor", "architecture", "features", "cores", "memory_gib", "system",
    }  # fmt: skip
    assert written["written"].endswith("+00:00")
    assert "/" not in written["command"][0]


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe"])
def test_a_damaged_manifest_is_none(store, content):
    (store.folder / "manifest.json").write_bytes(content)
    assert store.manifest() == {}


def test_without_git_the_revision_is_the_digest_of_the_sources(monkeypatch):
    def missing(*arguments, **settings):
        raise FileNotFoundError("git")

    monkeypatch.setattr(provenance.subprocess, "run", missing)
    assert provenance.revision() == {"sources": provenance.project_digest()}


def test_an_atomic_write_replaces_the_whole_file_and_leaves_nothing_beside_it(tmp_path):
    file = tmp_path / "new" / "report.html"
    write_atomically(file, b"long content")
    write_atomically(file, b"short")
    assert file.read_bytes() == b"short"
    assert list(file.parent.iterdir()) == [file]


def test_a_write_that_fails_keeps_the_old_file_and_leaves_nothing_beside_it(tmp_path, monkeypatch):
    file = tmp_path / "report.html"
    write_atomically(file, b"old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(results.os, "fsync", full)
    with pytest.raises(OSError, match="space"):
        write_atomically(file, b"new")
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def test_lines_are_plain_json_with_sorted_keys(store):
    store.append(result("a", trace={"time": np.arange(2.0)}))
    line = store.cases_file.read_text()
    assert line == json.dumps(result("a"), sort_keys=True) + "\n"


def test_a_commit_is_that_of_this_projects_checkout_alone(tmp_path, monkeypatch):
    """A wheel may be installed inside another project's repository, which may even hold it."""

    def git(*words):
        identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        call = ["git", "-C", str(tmp_path), *identity, *words]
        return subprocess.run(call, check=True, capture_output=True, text=True).stdout.strip()

    def revision_in(folder):
        folder.mkdir(parents=True)
        (folder / "provenance.py").touch()
        monkeypatch.setattr(provenance, "HERE", folder)
        return provenance.revision()

    sources = {"sources": provenance.project_digest()}
    git("init", "-q")
    wheel = tmp_path / ".venv" / "site-packages" / "experiments" / "run"
    checkout = tmp_path / "experiments" / "run"
    assert revision_in(wheel) == sources
    git("add", "-A")
    git("commit", "-qm", "all")
    assert provenance.revision() == sources
    assert revision_in(checkout) == sources
    git("add", "-A")
    git("commit", "-qm", "more")
    commit = git("rev-parse", "HEAD")
    assert provenance.revision() == {**sources, "commit": commit, "modified": False}
    (checkout / "provenance.py").write_text("# changed\n")
    assert provenance.revision() == {**sources, "commit": commit, "modified": True}
