"""Ray engine: results as those of the local pool, whatever dies; files and folders travel."""

import importlib.util
import shutil
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from agents.learned import write
from experiments.run import ray_engine, ray_worker
from experiments.run.benchmark import run_benchmark
from experiments.run.engines import Engine
from experiments.run.exact import compare
from experiments.run.store import ResultStore
from tests.experiments.run.test_engines import runs
from tests.helpers import ray_runs
from tests.helpers.learned_policies import random_policy
from tests.helpers.ray_runs import failed, misbehave, node, note, work_in_folder

if importlib.util.find_spec("ray") is None:
    pytest.skip("Ray is not installed: pip install 'lpv-track-env[ray]'", allow_module_level=True)

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def temporary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the nodes' temporary files."""
    return tmp_path_factory.mktemp("nodes")


@pytest.fixture(scope="module")
def cluster(temporary: Path) -> Iterator[Any]:
    with ray_runs.cluster(TMPDIR=str(temporary)) as made:
        yield made


@pytest.fixture
def engine(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Engine:
    """The cluster; its nodes look for files elsewhere than this process."""
    monkeypatch.chdir(tmp_path)
    return Engine(None, "ray", cluster.address)


def connected() -> bool:
    import ray

    return bool(ray.is_initialized())


def seeds(results: list[dict[str, Any]]) -> list[int]:
    return sorted(result["seed"] for result in results)


def test_specs_run_on_all_nodes_and_nothing_is_left(engine: Engine, temporary: Path) -> None:
    specs, begun = [{"seed": seed, "lasts": 0.1} for seed in range(12)], []
    results = list(engine.run(specs, note, failed=failed, started=begun.append))
    assert seeds(results) == list(range(12))
    assert begun == specs
    # The same process runs one spec after another.
    assert len({result["pid"] for result in results}) == 2
    assert len({result["actor"] for result in results}) == 2
    assert not connected()
    assert not [result for result in results if runs(result["pid"])]
    places = {Path(result["where"]) for result in results}
    assert all(place.is_relative_to(temporary) and not place.exists() for place in places)
    assert not list(temporary.glob(f"{ray_worker.LEFT_BY}*/level"))


def test_specs_that_misbehave_end_as_in_the_local_pool(engine: Engine, tmp_path: Path) -> None:
    does = ["die", "die once", "last", "kill the actor", "nothing", "nothing"]
    specs = [
        {"seed": seed, "does": one, "mark": str(tmp_path / "mark")} for seed, one in enumerate(does)
    ]
    results = list(engine.run(specs, misbehave, failed=failed, limit=4.0))
    assert seeds(results) == list(range(6))
    assert {one["seed"]: one["error"] for one in results if one["status"] != "ok"} == {
        0: "the worker process died, twice",
        2: "took longer than 4 s",
        3: "the worker that ran it was lost, 5 times",
    }


def test_what_a_run_raises_comes_through_and_ends_the_sweep(engine: Engine) -> None:
    specs = [{"seed": 0, "does": "raise"}, {"seed": 1, "does": "last"}]
    began = time.monotonic()
    with pytest.raises(ArithmeticError, match="no such luck"):
        list(engine.run(specs, misbehave, failed=failed))
    assert time.monotonic() - began < 60.0
    assert not connected()


AGENT = """
from agents.classical.geometric import Stanley

class Mine(Stanley):
    pass
"""


def test_files_of_cases_travel_and_bits_are_those_of_a_local_run(
    engine: Engine, tmp_path: Path
) -> None:
    Path("files").mkdir()
    write(random_policy(), Path("files/mine.json"))
    rows = "".join(f"{0.5 * k:g},{0.02 * k:g}\n" for k in range(60))
    Path("files/path.csv").write_text("x,y\n" + rows)
    Path("mine.py").write_text(AGENT)
    specs = [
        {"agent": agent, "trajectory": "files/path.csv", "conditions": "realtime"}
        for agent in ("stanley", "files/mine.json", "mine.py:Mine")
    ]
    console = Console(file=sys.stderr)
    for name, one in (("ray", replace(engine, workers=1)), ("local", Engine(1))):
        run_benchmark(specs, Path(name), engine=one, settings={}, console=console)
    found = ResultStore(Path("ray")).cases()
    assert [(case["status"], case.get("error")) for case in found] == [("ok", None)] * 3
    compared = compare(Path("ray"), Path("local"))
    assert (compared.paired, compared.differences) == (3, [])
    assert compared.values > 100


def copy_with_changes(folder: Path) -> Path:
    for name in ("trajectories", "lpv_track_env", "agents", "experiments", "tests/helpers"):
        skipped = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=skipped)
    file = folder / "experiments" / "run" / "metrics.py"
    file.write_text(file.read_text() + "\n# changed\n")
    return folder


def test_a_node_with_other_sources_refuses_and_the_others_go_on(
    cluster: Any, engine: Engine, tmp_path: Path
) -> None:
    copy = copy_with_changes(tmp_path / "copy")
    added = cluster.add_node(**node(1, PYTHONPATH=str(copy)))
    specs = [{"seed": seed, "lasts": 0.3} for seed in range(8)]
    with pytest.warns(UserWarning, match="refuses: other sources") as caught:
        results = list(engine.run(specs, note, failed=failed))
    (line,) = {str(one.message) for one in caught}
    assert line.startswith("node 127.0.0.1 refuses: other sources (digest ")
    assert line.endswith("install the same version of lpv-track-env there")
    assert seeds(results) == list(range(8))
    assert len({result["actor"] for result in results}) == 2
    cluster.remove_node(added)


def test_versions_are_named_and_without_a_node_left_the_sweep_ends(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = ray_worker.about()
    monkeypatch.setattr(
        ray_engine, "about", lambda: {**here, "versions": {**here["versions"], "numpy": "9.9.9"}}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ValueError, match=r"no node .*numpy [0-9.]+ there, 9\.9\.9 here"):
            list(engine.run([{"seed": 0}], note, failed=failed))


def test_a_case_of_another_identity_is_refused(engine: Engine) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ValueError, match=r"a case has another id there"):
            list(engine.run([{"seed": 0}], note, failed=failed, identity=ray_runs.seed_and_folder))


def folder_of(spec: ray_runs.Spec) -> Path:
    return Path(spec["folder"])


@pytest.mark.parametrize("absolute", [False, True])
def test_folders_go_there_and_come_back(engine: Engine, tmp_path: Path, absolute: bool) -> None:
    folder = tmp_path / "mine" / "0"
    folder.mkdir(parents=True)
    (folder / "old.txt").write_text("old")
    (folder / ".lock").touch()
    spec = {"seed": 0, "folder": str(folder if absolute else folder.relative_to(tmp_path))}
    (first,) = engine.run([spec], work_in_folder, failed=failed, folder=folder_of)
    assert Path(first["where"]).is_relative_to(tmp_path) == absolute
    with pytest.raises(ArithmeticError):
        list(engine.run([{**spec, "raises": 1}], work_in_folder, failed=failed, folder=folder_of))
    assert (folder / "inner" / "count.txt").read_text() == "2"
    names = sorted(file.name for file in folder.rglob("*") if file.is_file())
    assert names == [".lock", "count.txt"]


def test_folders_of_interrupted_and_long_runs_come_back(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_engine, "COPIED", 0.5)
    copies = []
    take = ray_engine._Sweep._take_copy

    def taken(sweep: Any, hand: Any) -> None:
        take(sweep, hand)
        copies.append(Path("long/inner/count.txt").exists())

    monkeypatch.setattr(ray_engine._Sweep, "_take_copy", taken)
    specs = [
        {"seed": 0, "folder": "long", "lasts": 600.0},
        {"seed": 1, "folder": "short", "lasts": 4.0},
    ]
    results = engine.run(specs, work_in_folder, failed=failed, folder=folder_of)
    next(results)
    assert any(copies)
    Path("long/inner/count.txt").unlink()
    results.close()  # type: ignore[attr-defined]
    assert Path("long/inner/count.txt").read_text() == "1"


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere", "[]:x", "127.0.0.1:99999", ""])
def test_an_address_without_a_cluster_is_one_line(address: str) -> None:
    with pytest.raises(ValueError, match=r"^no Ray at .*: on a cluster run ray start") as error:
        list(Engine(1, "ray", address).run([{"seed": 0}], note))
    assert len(str(error.value).splitlines()) == 1


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lpv-track-env\[ray\]'"):
        list(Engine(1, "ray").run([{"seed": 0}], note))


def test_a_host_refuses_files_and_folders_that_it_lacks(tmp_path: Path) -> None:
    host = ray_worker.Host()
    order = {
        "call": b"",
        "spec": b"",
        "id": None,
        "limit": 1.0,
        "files": {"/no/such.csv": "0" * 64},
    }
    answer = host.take(order, {}, None)
    assert answer["kind"] == "refused"
    assert answer["content"].startswith("/no/such.csv is not there, or differs: give names below")
    answer = host.take({**order, "files": {}, "token": str(tmp_path / "none" / "token")}, {}, None)
    assert answer["content"].startswith(f"{tmp_path}/none is not there")
    many = "/".join([".."] * 12) + "/mine.csv"
    assert host.take({**order, "files": {many: "0" * 64}}, {many: b""}, None)["kind"] == "refused"
    host.close()
