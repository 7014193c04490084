"""Cases of a results folder run again: what differs is found, and said to be what it is."""

import io
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from experiments.cli import main
from experiments.commands.reproduce import summary
from experiments.run import provenance
from experiments.run.benchmark import run_benchmark
from experiments.run.case import Case, run_case
from experiments.run.engines import Engine
from experiments.run.foreign import opened_by
from experiments.run.provenance import changes_since, manifest_key
from experiments.run.reproduction import (
    ABSOLUTE,
    MEASURED,
    RELATIVE,
    Row,
    case_of,
    judged,
    kind_of,
    pasted,
    prepared,
    reproduce,
    sampled,
    torn_line,
)
from experiments.run.store import BLOCK, ResultStore
from experiments.run.traffic import TrafficCase
from experiments.run.worker_process import DIED, late

SPEC = {"agent": "stanley", "trajectory": "u-turn", "conditions": "realtime"}
SEEDS = 3

Reproduce = Callable[..., tuple[int, str]]


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of a results folder with `SEEDS` drives."""
    folder = tmp_path_factory.mktemp("driven")
    specs = [{**SPEC, "seed": seed} for seed in range(SEEDS)]
    console = Console(file=io.StringIO())
    run_benchmark(specs, folder, engine=Engine(1), settings={}, console=console)
    return {name: (folder / name).read_bytes() for name in ("cases.jsonl", "manifest.json")}


@pytest.fixture
def folder(driven: dict[str, bytes], tmp_path: Path) -> Path:
    """A fresh copy of the folder."""
    copy = tmp_path / "results"
    copy.mkdir()
    for name, content in driven.items():
        (copy / name).write_bytes(content)
    return copy


@pytest.fixture
def again(capsys: pytest.CaptureFixture[str]) -> Reproduce:
    """Run `lpv-track reproduce`; return its exit code and all that it printed."""

    def run(*words: object) -> tuple[int, str]:
        code = main(["reproduce", *map(str, words), "--workers", "1"])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return code, said.out + said.err

    return run


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "cases.jsonl").read_text().splitlines()]


def write(folder: Path, results: list[dict[str, Any]]) -> None:
    text = "".join(json.dumps(result) + "\n" for result in results)
    (folder / "cases.jsonl").write_text(text)


def made_elsewhere(folder: Path, ids: str = "kept", **entries: Any) -> None:
    """Let the folder be that of a machine whose manifest has other entries."""
    manifest = json.loads((folder / "manifest.json").read_text())
    for name, changes in entries.items():
        manifest[name] |= changes
    (folder / "manifest.json").write_text(json.dumps({**manifest, "key": "00000000"}))
    results = [{**result, "manifest": "00000000"} for result in lines_of(folder)]
    if ids == "others":
        results = [{**result, "id": f"{k:016x}"} for k, result in enumerate(results)]
    write(folder, results)


def test_a_folder_is_reproduced_to_the_last_bit(folder: Path, again: Reproduce) -> None:
    code, said = again(folder)
    values = sum(len(dict(row.result["metrics"])) for row in rows_of(folder))
    assert code == 0
    assert "3 results: the same versions, sources and processor as here" in said
    assert f"compared: {SEEDS} cases" in said
    assert int(said.split(" values bit for bit: equal")[0].split()[-1]) > values
    assert sorted(folder.iterdir()) == [folder / "cases.jsonl", folder / "manifest.json"]


def rows_of(folder: Path) -> list[Row]:
    store = ResultStore(folder)
    return prepared(store.cases(), store.manifest_of).chosen


def test_the_last_bit_of_a_metric_is_found(folder: Path, again: Reproduce) -> None:
    results = lines_of(folder)
    ale = results[1]["metrics"]["ale"]
    results[1]["metrics"]["ale"] = changed = math.nextafter(ale, 1.0)
    results[2]["warnings"] = ["it rained"]
    del results[2]["metrics"]["mle"]
    write(folder, results)
    code, said = again(folder)
    assert code == 1
    name = f"stanley u-turn m2-minibus variable realtime seed 1 ({results[1]['id']})"
    assert f"{name}: metrics.ale {changed} there, {ale} here" in said
    assert "warnings[0] it rained there, missing here" in said
    assert "metrics.mle missing there, 0." in said
    assert said.splitlines()[-1].endswith("3 differences in 2 cases")


@pytest.mark.parametrize(
    "change", [{"seed": 7}, {"grip": 0.8, "speed_mode": "grip"}, {"id": "0" * 16}]
)
def test_a_changed_field_is_found_by_the_id(
    folder: Path, again: Reproduce, change: dict[str, Any]
) -> None:
    results = lines_of(folder)
    write(folder, [{**results[0], **change}, *results[1:]])
    code, said = again(folder)
    assert code == 1
    assert f"fields or files were changed after it was driven: the id is {'0' * 16}" in said or (
        f"fields or files were changed after it was driven: the id is {results[0]['id']}" in said
    )
    assert said.splitlines()[-1].endswith(" in 1 case")


def test_a_torn_line_and_a_damaged_one_are_named(folder: Path, again: Reproduce) -> None:
    first, second, third = (folder / "cases.jsonl").read_text().splitlines()
    (folder / "cases.jsonl").write_text(f"{first}\n{second}\n{third[:500]}")
    code, said = again(folder)
    assert code == 0
    assert f"not run again: {folder / 'cases.jsonl'}, line 3: is torn" in said
    assert "compared: 2 cases" in said
    (folder / "cases.jsonl").write_text(f"{first}\n{second[:500]}\n{third}\n")
    code, said = again(folder)
    assert code == 1
    assert f"damaged: {folder / 'cases.jsonl'}, line 2: is not JSON" in said
    assert "compared: 2 cases" in said


def test_the_torn_line_is_found_whatever_its_length(tmp_path: Path) -> None:
    file = tmp_path / "cases.jsonl"
    long = b"x" * 3 * BLOCK
    for content, number in ((b"", 0), (b"a\n", 0), (long + b"\n", 0), (b"a", 1), (b"a\nb", 2)):
        file.write_bytes(content)
        assert len(torn_line(file)) == (number > 0)
        file.write_bytes(content + (b"\n" if number else b"") + long)
        lines = content.count(b"\n") + (2 if number else 1)
        assert torn_line(file)[0].startswith(f"{file}, line {lines}: is torn")


def test_other_versions_are_named_and_met_within_a_tolerance(
    folder: Path, again: Reproduce
) -> None:
    made_elsewhere(folder, "others", versions={"numpy": "1.99.1"})
    results = lines_of(folder)
    results[0]["metrics"]["ale"] *= 1.0 + 0.5 * RELATIVE
    write(folder, results)
    code, said = again(folder)
    assert code == 0
    now = provenance.versions()["numpy"]
    assert f"made with: 3 results: numpy 1.99.1 there, {now} here\n" in said
    assert f"within {RELATIVE:g} of the value or {ABSOLUTE:g}" in said
    assert again(folder, "--exact")[0] == 1
    results[0]["metrics"]["ale"] *= 1.0 + 2.0 * RELATIVE
    write(folder, results)
    code, said = again(folder)
    assert code == 1
    assert said.splitlines()[-1].endswith("1 difference in 1 case")


def test_other_sources_are_named_and_may_compute_more(folder: Path, again: Reproduce) -> None:
    made_elsewhere(folder, "others", revision={"sources": "ab" * 8, "commit": "c" * 40})
    results = lines_of(folder)
    del results[0]["metrics"]["ale"]
    write(folder, results)
    code, said = again(folder)
    assert code == 0
    assert f"sources {'ab' * 8} (commit {'c' * 12}" in said
    assert f"{provenance.project_digest()} " in said


def test_another_processor_is_named(folder: Path, again: Reproduce) -> None:
    name, features = provenance.processor_features()
    made_elsewhere(
        folder, hardware={"architecture": "sparrow", "features": [*features[1:], "avx9"]}
    )
    code, said = again(folder, "--sample", 1)
    assert code == 0
    words = f"processor sparrow there, {name} here with avx9 only there with {features[0]} only"
    assert words in said
    assert "1 case" in said
    assert "bit for bit: equal" not in said


def test_without_a_manifest_the_id_still_proves_versions_and_sources(
    folder: Path, again: Reproduce
) -> None:
    made_elsewhere(folder)
    (folder / "manifest.json").unlink()
    code, said = again(folder)
    assert code == 0
    assert "made with: 3 results: processor features not known\n" in said
    # The key in the results alone tells this machine and these versions.
    write(folder, [{**result, "manifest": manifest_key()} for result in lines_of(folder)])
    assert "bit for bit: equal" in again(folder)[1]


def test_results_of_a_first_version_are_compared(folder: Path, again: Reproduce) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest["key"], manifest["revision"]["sources"], manifest["hardware"]["features"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    old = [
        {k: v for k, v in result.items() if k not in ("manifest", "grip", "search", "regime")}
        for result in lines_of(folder)
    ]
    write(folder, [{**result, "id": f"{k:016x}"} for k, result in enumerate(old)])
    code, said = again(folder)
    assert code == 0
    assert "processor features not known" in said
    assert "changed after" not in said


def test_what_time_decides_is_no_difference(folder: Path, again: Reproduce) -> None:
    results = lines_of(folder)
    for result, error in ((results[0], late(3.0)), (results[1], DIED)):
        result.update(status="failed", error=error, end=None, metrics={}, solver={})
    measured = {"arrangement": "sequential", "estimation": 0.01, "control": "measured"}
    results.append({**results[2], "computing": measured, "id": "f" * 16})
    write(folder, results)
    code, said = again(folder)
    assert code == 0
    assert f"failed there: {late(3.0)}; here: finished" in said
    assert f"failed there: {DIED}; here: finished" in said
    assert f"not run again: {MEASURED}" in said
    assert "compared: 1 case," in said


def test_a_drive_that_is_too_slow_here_is_a_difference(folder: Path, again: Reproduce) -> None:
    code, said = again(folder, "--case-limit", 0.001, "--sample", 1)
    assert code == 1
    assert "status ok there, failed here" in said
    assert "error missing there, took longer than 0.001 s here" in said
    assert "metrics" not in said


def test_a_sample_is_the_same_for_a_seed(folder: Path) -> None:
    rows = rows_of(folder)
    assert sampled(rows, 2, seed=4) == sampled(rows, 2, seed=4)
    assert sampled(rows, 9, seed=0) == rows
    drawn = {tuple(row.case.seed for row in sampled(rows, 2, seed)) for seed in range(30)}
    assert drawn == {(0, 1), (0, 2), (1, 2)}


def test_ids_choose_the_cases(folder: Path, again: Reproduce) -> None:
    one = lines_of(folder)[1]["id"]
    code, said = again(folder, "--id", one)
    assert code == 0
    assert f"({one})" in said
    assert "compared: 1 case," in said
    code, said = again(folder, "--id", one, "none")
    assert code == 2
    assert said.strip() == "lpv-track: no result has the id none"


def test_what_is_no_folder_of_results_is_refused(tmp_path: Path, again: Reproduce) -> None:
    assert again(tmp_path / "none") == (
        2,
        f"lpv-track: {tmp_path / 'none'} is not a folder of results\n",
    )
    assert again(tmp_path) == (2, f"lpv-track: no results in {tmp_path}\n")
    assert not any(tmp_path.iterdir())


def test_ctrl_c_says_how_far_it_came(
    folder: Path, again: Reproduce, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pressed(*arguments: Any, **settings: Any) -> Any:
        yield next(reproduce(*arguments, **settings))
        raise KeyboardInterrupt

    monkeypatch.setattr("experiments.run.reproduction.reproduce", pressed)
    code, said = again(folder)
    assert code == 130
    assert (
        "interrupted: 1 of 3 cases were run again; --sample N draws fewer\ncompared: 1 case, "
        in said
    )


def test_without_a_comparison_nothing_is_called_equal() -> None:
    assert summary([]) == "compared: nothing"


def test_a_case_of_two_results_is_run_once(folder: Path) -> None:
    """Such as one that an earlier version of the project has driven too."""
    (result, *_) = lines_of(folder)
    old = {**result, "id": "0" * 16, "manifest": "00000000"}
    rows = prepared([old, result]).chosen
    begun: list[Any] = []
    verdicts = list(reproduce(rows, Engine(1), limit=60.0, started=begun.append))
    assert len(begun) == 1
    assert [verdict.row.result["id"] for verdict in verdicts] == ["0" * 16, result["id"]]
    assert [verdict.exact for verdict in verdicts] == [False, True]
    assert not any(verdict.differences for verdict in verdicts)


def test_searches_and_policies_are_reproduced(again: Reproduce, tmp_path: Path) -> None:
    search = {"setting": "fixed_speed", "low": 2.0, "high": 4.0, "resolution": 1.0}
    specs = [
        {"agent": "stanley", "trajectory": "u-turn", "speed_mode": "fixed", "search": search},
        {"agent": "bc", "trajectory": "u-turn", "vehicle_changes": {"mass": 3000}},
    ]
    console = Console(file=io.StringIO())
    run_benchmark(specs, tmp_path, engine=Engine(1), settings={}, console=console)
    results = lines_of(tmp_path)
    assert results[0]["tried"]
    assert results[1]["training"]
    code, said = again(tmp_path)
    assert code == 0, said
    results[0]["tried"][0][1] = not results[0]["tried"][0][1]
    write(tmp_path, results)
    code, said = again(tmp_path)
    assert code == 1
    assert "tried[0][1] " in said


# ---- results pasted into standard input


@pytest.fixture
def paste(again: Reproduce, monkeypatch: pytest.MonkeyPatch) -> Reproduce:
    """Give a text to `lpv-track reproduce -`."""

    def run(text: str, *words: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "stdin", io.StringIO(text))
        return again("-", *words)

    return run


def test_a_pasted_line_is_reproduced(folder: Path, paste: Reproduce) -> None:
    line = (folder / "cases.jsonl").read_text().splitlines()[0]
    code, said = paste(line)
    assert code == 0
    assert "compared: 1 case, " in said
    assert "bit for bit: equal" in said
    # A page may break it anywhere.
    wrapped = "\r\n".join(line[k : k + 61] for k in range(0, len(line), 61))
    assert paste(f"\ufeff  {wrapped}\n\n") == (code, said)


def test_fields_and_metrics_that_a_pasted_result_lacks(folder: Path, paste: Reproduce) -> None:
    ale = lines_of(folder)[0]["metrics"]["ale"]
    row = {**SPEC, "metrics": {"ale": ale}}
    code, said = paste(json.dumps(row, indent=2) + "\n" + json.dumps({**row, "seed": 1}))
    assert code == 1
    assert "versions not known; sources not known; processor features not known" in said
    assert said.count(" there, ") == 1
    assert f"seed 1: metrics.ale {ale} there" in said
    assert "compared: 2 cases, 2 values within" in said
    assert said.splitlines()[-1].endswith(": 1 difference in 1 case")
    assert "(1 equal bit for bit, largest relative difference 0." in said


def test_a_case_that_cannot_be_run_says_why(paste: Reproduce) -> None:
    row = {**SPEC, "conditions": "storm", "end": "finished"}
    code, said = paste(json.dumps(row))
    assert code == 1
    assert "end finished there, missing here" in said
    assert "error missing there, ValueError: unknown conditions 'storm'" in said


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "standard input: holds no result"),
        ("hello", "standard input, result 1: is not JSON"),
        ('{"agent": "stanley"} [1]', "standard input, result 2: must be a JSON object"),
        ('{"agent": "pid", "agent": "pid"}', "key 'agent' twice"),
        ('{"agent": 3}', "standard input, result 1: Expected `str`"),
        ('{"agent": "pid\\u001b[2J"}', "holds characters that cannot be printed"),
        ("[" * 100_000, "nested too deeply"),
        ('{"agent": "stanley", "end": "finished"}', "the result names no trajectory"),
        (
            '{"agent": "stanly", "end": "finished"}',
            "unknown agent 'stanly'",
        ),
        ('{"trajectory": "T2", "end": "finished"}', "the result names no agent"),
        ('{"agent": "stanley", "trajectory": "T2"}', "holds no value to compare"),
        (
            '{"agent": "stanley", "trajectory": "T2", "end": "finished", "sed": 1}',
            "this version knows no entry 'sed' of a result",
        ),
    ],
)
def test_what_is_no_result_is_refused_in_a_line(paste: Reproduce, text: str, message: str) -> None:
    code, said = paste(text)
    assert code == 2
    assert message in said
    assert all(len(line) < 400 for line in said.splitlines())


def test_a_text_without_end_is_refused(paste: Reproduce, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trajectories.fileio.MOST_BYTES", 1000)
    code, said = paste(" " * 2000)
    assert (code, said) == (2, "lpv-track: standard input: at most 1000 characters are read\n")


def test_pasted_results_keep_only_what_was_given() -> None:
    assert pasted('{"agent": "pid"}{"seed": 3}') == [{"agent": "pid"}, {"seed": 3}]


# ---- results of strangers


def test_nothing_that_a_stranger_names_is_opened_or_run(
    tmp_path: Path, paste: Reproduce, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    trap = "import pathlib; pathlib.Path('sprung').touch()\n"
    Path("trap.py").write_text(trap)
    (tmp_path / "parent").mkdir()
    Path("parent/__init__.py").write_text(trap)
    Path("notes").write_text("{}")
    given = {"trajectory": "u-turn", "agent": "stanley", "end": "finished"}
    rows = [
        {**given, "agent": "trap.py:Own"},
        {**given, "agent": "trap:Own"},
        {**given, "agent": "parent.child:Own"},
        {**given, "agent": "policy.json"},
        {**given, "agent": "ppo", "agent_settings": {"policy": "/etc/hostname"}},
        {**given, "agent": "ppo", "agent_settings": {"policy": "notes"}},
        {**given, "agent_settings": {"model": "x" * 5000 + "/mine"}},
        {**given, "trajectory": "/etc/hostname"},
        {**given, "trajectory": "random-1e9"},
        {**given, "vehicle": "car.json"},
        {"scene": "racetrack", "agent": "trap.py:Own", "end": "finished"},
        {"scene": "racetrack", "agent": "pid", "end": "", "env_settings": {"vehicle": "a.json"}},
    ]
    code, said = paste("\n".join(map(json.dumps, rows)))
    assert code == 2
    assert "no result of standard input can be run again" in said
    assert (
        said.count("--open-named-files does, for results you trust") == len(rows) - 2
    )  # two have an agent, two a file in common
    assert "2 results: to run it again would open or execute 'trap.py:Own'" in said
    assert not Path("sprung").exists()
    assert all(opened_by(row) for row in rows)


def test_what_this_project_ships_is_no_stranger() -> None:
    for row in (
        {"agent": "ppo", "trajectory": "random-limit-12", "vehicle": "bmw-320i"},
        {"agent": "lpv-nmpc-tuned", "trajectory": "T2", "agent_settings": {"weights": "paired"}},
        {"agent": "lpv-nmpc", "trajectory": "iso-3888-1-1.8", "agent_settings": {"weights": {}}},
        {"agent": "idm", "scene": "racetrack"},
    ):
        assert opened_by(row) == []


def test_files_that_are_trusted_are_run(
    tmp_path: Path, again: Reproduce, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("from agents.classical.geometric import Stanley as Mine\n")
    spec = {**SPEC, "agent": "mine.py:Mine"}
    console = Console(file=io.StringIO())
    run_benchmark([spec], Path("out"), engine=Engine(1), settings={}, console=console)
    assert again("out")[0] == 2
    code, said = again("out", "--open-named-files")
    assert code == 0
    assert "bit for bit: equal" in said
    with Path("mine.py").open("a") as handle:
        handle.write("# changed\n")
    code, said = again("out", "--open-named-files")
    assert code == 1
    assert "its fields or files were changed after it was driven" in said
    Path("mine.py").unlink()
    code, said = again("out", "--open-named-files")
    assert code == 2
    assert "'mine.py:Mine' is not here; run this where the results were made" in said


def test_a_named_path_that_is_not_here_is_said(paste: Reproduce) -> None:
    row = {"agent": "stanley", "trajectory": "gone.csv", "end": "finished"}
    code, said = paste(json.dumps(row), "--open-named-files")
    assert code == 2
    assert "not run again: 'gone.csv' is not here" in said


# ---- parts


def test_kinds_of_cases_are_told_apart() -> None:
    traffic = TrafficCase("idm", scene="racetrack-oval", env_settings={"laps": 2})
    stored = {**traffic.as_dict(), "others": 3, "metrics": {}}
    assert case_of(stored) == traffic
    assert kind_of(SPEC) is Case
    assert case_of({**SPEC, "start": None, "metrics": {"ale": 1.0}}) == Case(**SPEC)


def test_values_are_compared_by_the_tolerance_or_by_their_bits(folder: Path) -> None:
    row = rows_of(folder)[0]
    made = run_case(row.case.as_dict())
    assert judged(row, made, exact=True).equal == judged(row, made, exact=True).values
    metrics = made["metrics"]
    near = {**made, "metrics": {**metrics, "ale": metrics["ale"] * (1.0 + 0.9 * RELATIVE)}}
    far = {**made, "metrics": {**metrics, "ale": metrics["ale"] * (1.0 + 1.1 * RELATIVE)}}
    assert not judged(row, near, exact=False).differences
    assert len(judged(row, near, exact=True).differences) == 1
    assert len(judged(row, far, exact=False).differences) == 1
    assert judged(row, far, exact=False).largest == pytest.approx(1.1 * RELATIVE, rel=0.01)
    small = {**made, "metrics": {**metrics, "excess_speed": 0.9 * ABSOLUTE}}
    assert row.result["metrics"]["excess_speed"] == 0.0
    assert not judged(row, small, exact=False).differences
    # The edge of a curvature band may have moved by a period.
    moved = {**made, "metrics": {**metrics, "mle_sharp": 2.0 * metrics["mle_sharp"]}}
    assert not judged(row, moved, exact=False).differences
    assert len(judged(row, moved, exact=True).differences) == 1


def test_a_manifest_says_what_has_changed() -> None:
    name, features = provenance.processor_features()
    now = {
        "versions": provenance.versions(),
        "revision": provenance.revision(),
        "hardware": provenance.hardware(),
    }
    same = changes_since(now, ("numpy", "torch"))
    assert same == {"versions": [], "sources": [], "processor": []}
    python = now["versions"]["python"]
    patch = {**now["versions"], "python": python.rpartition(".")[0] + ".99"}
    assert changes_since({**now, "versions": patch}, ("numpy",)) == same
    other = {**now["versions"], "python": "3.9.1", "torch": "0.1"}
    assert changes_since({**now, "versions": other}, ("numpy",))["versions"] == [
        f"python 3.9.1 there, {python} here"
    ]
    del other["torch"]
    found = changes_since({**now, "versions": other}, ("torch",))["versions"][1]
    assert found.startswith("torch none there, ")
    assert features
    assert name
    for damaged in ({}, {"versions": 3, "revision": [], "hardware": {"features": "avx"}}):
        assert all(len(words) == 1 for words in changes_since(damaged, ()).values())
    trap = "\x1b[2J" * 10_000
    hostile = {
        "versions": {"numpy": trap, "python": [trap]},
        "revision": {"sources": trap, "commit": trap},
        "hardware": {"architecture": trap, "features": [trap] * 3},
    }
    told = "; ".join(
        word for words in changes_since(hostile, ("numpy",)).values() for word in words
    )
    assert told.isprintable()
    assert len(told) < 1500


@pytest.mark.slow  # highway-env compiles and draws its roads
def test_drives_in_traffic_are_reproduced(tmp_path: Path, again: Reproduce) -> None:
    pytest.importorskip("highway_env")
    console = Console(file=io.StringIO())
    specs = [{"agent": "idm", "seed": 1}]
    run_benchmark(specs, tmp_path, engine=Engine(1), settings={}, console=console, kind=TrafficCase)
    code, said = again(tmp_path)
    assert code == 0, said
    assert "idm racetrack seed 1" in said
