"""Results that somebody else wrote: no traceback, no file opened, nothing that runs."""

import copy
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trajectories
from experiments.cli import main
from experiments.report.build import write_report
from experiments.report.drives import NamedFiles, reference_path
from experiments.run import store as stores
from experiments.run.result_schema import read_driven
from experiments.run.store import ResultStore
from lpv_track_env import vehicle
from tests.helpers.made_results import HOSTILE, case, folder_of, own_scripts_alone, printed, trace
from trajectories import files

BASE = [
    case(1),
    case(
        2, agent="lpv-nmpc", conditions={"name": "realtime", "gnss_noise": 0.3},
        computing={"arrangement": "sequential", "load": 1.0},
        training={"algorithm": "ppo", "steps": 3, "command": "lpv-track train ppo"},
    ),
]  # fmt: skip
VALUES: dict[str, Any] = {
    "null": None, "whole": 5, "negative": -1, "real": 1.5, "text": "text", "list": [], "object": {},
    "mixed": [1, "a"], "nested": {"a": {"b": [1]}}, "true": True, "digits": 10**400, "huge": 1e308,
    "long": "x" * 200_000, "control": "\x1b[31m\x00", "html": HOSTILE,
    "half": "\ud800",
}  # fmt: skip
KEYS = [
    *((key,) for key in BASE[1]),
    *(("metrics", key) for key in ("mle", "ale", "duration", "excess_speed")),
    *(("solver", key) for key in BASE[1]["solver"]),
    *(("training", key) for key in BASE[1]["training"]),
    *(("computing", key) for key in BASE[1]["computing"]),
]


def rewritten(folder: Path, key: tuple[str, ...], value: object) -> None:
    """Change an entry of the second case; `...` removes it."""
    changed = copy.deepcopy(BASE[1])
    inner = changed
    for one in key[:-1]:
        inner = inner[one]
    if value is ...:
        del inner[key[-1]]
    else:
        inner[key[-1]] = value
    lines = "".join(json.dumps(one) + "\n" for one in (BASE[0], changed))
    (folder / "cases.jsonl").write_text(lines)


def reported(folder: Path) -> tuple[str, list[str]]:
    """Return page and skipped lines; the tables of a terminal must work as well."""
    skipped: list[str] = []
    page = write_report(folder, skipped=skipped).read_text(encoding="utf-8")
    printed(ResultStore(folder).cases([], read_driven)).encode()
    return page, skipped


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("foreign")
    store = folder_of(made, BASE, traces=False)
    stores.write_arrays(made / "traces" / f"{BASE[1]['id']}.npz", trace(n=40))
    return store.folder


@pytest.mark.parametrize("kind", ["missing", *VALUES])
def test_no_entry_of_a_case_breaks_the_report(folder: Path, kind: str) -> None:
    value = VALUES.get(kind, ...)
    for key in KEYS:
        rewritten(folder, key, value)
        page, skipped = reported(folder)
        name = ".".join(key)
        assert len(skipped) <= 1, name
        for line in skipped:
            assert line.startswith(f"{folder}/cases.jsonl, line 2: "), name
            assert "\n" not in line
            assert len(line) < 500
        assert ("Left out, because they cannot be read" in page) == bool(skipped), name
        assert "\x1b" not in page
        assert own_scripts_alone(page), name


@pytest.mark.parametrize(
    "line",
    [
        '{"id":' + "[" * 10**5 + "]" * 10**5 + "}", "[" * 10**5, "null", "7", '"text"', "[]",
        '{"id": "../../secret", "agent": "a", "status": "failed"}', '{"id": NaN}', "\ufeff{}",
        '{"id": "a", "id": "b", "agent": "a", "status": "failed"}', '{"id": "\\ud800"}',
    ],
)  # fmt: skip
def test_no_line_breaks_the_report(folder: Path, line: str) -> None:
    (folder / "cases.jsonl").write_text(f"{json.dumps(BASE[0])}\n{line}\n", encoding="utf-8")
    page, skipped = reported(folder)
    assert len(skipped) == 1
    assert "line 2: " in skipped[0]
    assert "line 2: " in page


def test_a_folder_without_a_readable_line_names_the_first(folder: Path) -> None:
    (folder / "cases.jsonl").write_text("nonsense\n{}\n")
    with pytest.raises(ValueError, match=r"cases\.jsonl, line 1: is not JSON"):
        write_report(folder)


CHANGES: dict[str, Callable[[Any], Any]] = {
    "short": lambda v: v[:3],
    "single": lambda v: v[0],
    "scalar": lambda _: np.float64(3.0),
    "text": lambda v: np.full(len(v), "a"),
    "complex": lambda v: v + 1j,
    "deep": lambda v: np.zeros((len(v), 2, 2)),
    "zero": lambda v: 0.0 * v,
    "flat": lambda v: np.zeros(len(v)),
    "huge": lambda v: 1e300 * (1.0 + v),
    "nan": lambda v: np.nan * v,
    "whole": lambda v: np.arange(v.size).reshape(v.shape),
    "bool": lambda v: v > 0.0,
    "reversed": lambda v: v[::-1],
    "objects": lambda v: np.array([None] * len(v)),
}


@pytest.mark.parametrize("kind", CHANGES)
def test_no_trace_breaks_the_report(tmp_path: Path, kind: str) -> None:
    folder_of(tmp_path, BASE, traces=False)
    (tmp_path / "traces").mkdir()
    for name in ("time", "state", "arc_length", "lateral_error", "solve_time"):
        arrays = trace(n=40)
        arrays[name] = CHANGES[kind](arrays[name])
        with (tmp_path / "traces" / f"{BASE[1]['id']}.npz").open("wb") as handle:
            np.savez(handle, **arrays)
        page, skipped = reported(tmp_path)
        assert skipped == []
        assert "nan" not in page.lower().split("<svg", 1)[-1].split("</svg>")[0]


def test_a_trace_that_unpacks_to_gigabytes_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "LARGEST_TRACE", 10_000)
    store = ResultStore(tmp_path)
    stores.write_arrays(tmp_path / "traces" / "small.npz", {"time": np.zeros(100)})
    stores.write_arrays(tmp_path / "traces" / "large.npz", {"time": np.zeros(100_000)})
    with zipfile.ZipFile(tmp_path / "traces" / "large.npz") as packed:
        assert sum(entry.compress_size for entry in packed.infolist()) < 10_000
    assert store.trace("small") is not None
    assert store.trace("large") is None


@pytest.mark.parametrize("content", ["[1]", "null", '"x"', '{"command": 5, "versions": [1]}', "{}"])
def test_no_manifest_breaks_the_report(tmp_path: Path, content: str) -> None:
    folder_of(tmp_path, BASE, traces=False)
    (tmp_path / "manifest.json").write_text(content)
    page, _ = reported(tmp_path)
    assert "Settings and provenance" in page


def test_a_report_opens_no_file_that_the_cases_name_unless_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, car = tmp_path / "own.csv", tmp_path / "own.json"
    files.write(trajectories.load("u-turn"), path)
    values = {
        name: getattr(vehicle.load("m2-minibus"), name)
        for name in vehicle.VehicleParameters.__dataclass_fields__
    }
    car.write_text(json.dumps({**values, "length": 7.25}))
    results = [case(1, trajectory=str(path), vehicle=str(car)), case(2, vehicle="course-car")]
    out = tmp_path / "results"
    folder_of(out, results)
    opened: list[str] = []
    for module in (trajectories, vehicle):

        def noted(name: str, load: Callable[..., Any] = module.load, **more: Any) -> Any:
            opened.append(name)
            return load(name, **more)

        monkeypatch.setattr(module, "load", noted)
    reference_path.cache_clear()
    closed = write_report(out).read_text()
    assert not {str(path), str(car)} & set(opened)
    assert {"T2", "course-car"} <= set(opened)
    assert "were not opened" in closed
    assert str(path) in closed
    assert '"body":[7.25' not in closed
    assert main(["report", str(out), "--open-named-files"]) == 0
    assert {str(path), str(car)} <= set(opened)
    told = (out / "report.html").read_text()
    assert "were not opened" not in told
    assert '"body":[7.25' in told
    capsys.readouterr()


def test_files_of_the_own_sweep_are_opened_and_no_others() -> None:
    named = NamedFiles(frozenset({"a.csv"}))
    assert not named.closed_path("a.csv")
    assert named.closed_path("b.csv")
    assert named.closed_path("/dev/random")
    assert named.closed_path("random-1.csv")
    for made in ("random-fast-17", "random-limit-3", "circuit-5", "iso-3888-2-1.61"):
        assert not named.closed_path(made)
    assert named.closed_path("iso-3888-3-1.61")
    assert not named.closed_path("T2-raw")
    assert named.closed_vehicle("mine.json")
    assert not named.closed_vehicle("m2-minibus")
