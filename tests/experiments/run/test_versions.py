"""Results of other versions are never mixed with those of today, and stay readable."""

import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from experiments.report.build import write_report
from experiments.run import provenance
from experiments.run.benchmark import run_benchmark
from experiments.run.case import Case
from experiments.run.engines import Engine
from experiments.run.provenance import computing_versions, manifest_key
from experiments.run.result_schema import plain
from experiments.run.store import ResultStore
from experiments.run.traffic import TrafficCase

SPEC = {"agent": "stanley", "trajectory": "u-turn"}


@pytest.fixture
def other_versions(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Set the version of a package."""
    real = provenance.importlib.metadata.version

    def forget() -> None:
        for function in (computing_versions, manifest_key):
            function.cache_clear()

    def install(package: str, version: str) -> None:
        monkeypatch.setattr(
            provenance.importlib.metadata, "version",
            lambda name: version if name == package else real(name),
        )  # fmt: skip
        forget()

    yield install
    monkeypatch.undo()
    forget()


def sweep(folder: Path) -> str:
    """Run the case, or find it there; return what was printed."""
    console = Console(file=io.StringIO(), width=400)
    run_benchmark([SPEC], folder, engine=Engine(1), settings={}, console=console)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def test_versions_of_what_computes_are_part_of_an_id(other_versions: Any) -> None:
    cases = Case(**SPEC), Case("file.py:Own", "T2"), Case("ppo", "T2"), TrafficCase("stanley")
    before = {(type(case).__name__, case.agent): case.id for case in cases}
    for package, changed in {
        "numpy": {"stanley", "file.py:Own", "ppo"},
        "numba": {"stanley", "file.py:Own", "ppo"},
        "torch": {"file.py:Own"},
        "rich": set(),
    }.items():
        other_versions(package, "0.0.1")
        for case in cases:
            differs = case.id != before[type(case).__name__, case.agent]
            assert differs == (case.agent in changed), (package, case)
    other_versions("highway-env", "0.0.1")
    assert TrafficCase("stanley").id != before["TrafficCase", "stanley"]
    assert Case(**SPEC).id == before["Case", "stanley"]


def test_a_sweep_with_other_versions_runs_anew_and_says_so(
    tmp_path: Path, other_versions: Any
) -> None:
    assert "anew" not in sweep(tmp_path)
    first = json.loads((tmp_path / "manifest.json").read_text())
    assert "1 of 1 cases are in" in sweep(tmp_path)
    numpy = first["versions"]["numpy"]
    other_versions("numpy", "99.1.0")
    told = " ".join(sweep(tmp_path).split())
    assert (
        f"1 of 1 cases are run anew: those in {tmp_path} were made with numpy {numpy} inst" in told
    )
    cases = ResultStore(tmp_path).cases()
    assert len(cases) == 2
    assert cases[0]["metrics"] == cases[1]["metrics"]
    assert cases[0]["id"] != cases[1]["id"]
    # The manifest of the versions before is kept beside that of the last run.
    kept = json.loads((tmp_path / f"manifest-{first['key']}.json").read_text())
    assert kept == {**first, "written": kept["written"]}
    assert cases[0]["manifest"] == first["key"]
    assert ResultStore(tmp_path).manifest_of(first["key"]) == kept
    assert cases[1]["manifest"] == json.loads((tmp_path / "manifest.json").read_text())["key"]
    page = write_report(tmp_path).read_text()
    assert "1 older result of cases" in page


def test_a_folder_of_an_earlier_version_of_the_project_is_read_and_gone_on_with(
    tmp_path: Path,
) -> None:
    sweep(tmp_path)
    case = plain(*ResultStore(tmp_path).cases(), "case")
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    del case["manifest"], manifest["key"]
    (tmp_path / "cases.jsonl").write_text(json.dumps({**case, "id": "0123456789abcdef"}) + "\n")
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    assert ResultStore(tmp_path).manifest_of("before") == manifest
    assert "u-turn" in write_report(tmp_path).read_text()
    assert "1 of 1 cases are run anew" in sweep(tmp_path)
    assert len(ResultStore(tmp_path).cases()) == 2
    assert json.loads((tmp_path / "manifest-before.json").read_text()) == manifest
    assert ResultStore(tmp_path).manifest_of("before") == manifest
