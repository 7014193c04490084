"""One case never ends the sweep: whatever it raises, reports or does, it is a failed case."""

import io
import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from experiments.run.benchmark import run_benchmark
from experiments.run.case import run_case
from experiments.run.engines import Engine
from experiments.run.result_schema import plain
from experiments.run.store import ResultStore
from experiments.run.time_limit import TimeLimit
from tests.helpers import faulty_agents
from trajectories import files, load

FAULTY = Path(faulty_agents.__file__)
EXPECTED = {
    "Exits": "SystemExit: enough",
    "RaisesUnreadably": "UnreadableError, whose message cannot be read",
    "ExplainsNothing": "ValueError: solver.mean_iterations is nan, not a finite number",
}


def spec(name: str, **more: Any) -> dict[str, Any]:
    return {"agent": f"{FAULTY}:{name}", "trajectory": "u-turn", **more}


def swept(folder: Path, names: list[str], **more: Any) -> dict[str, dict[str, Any]]:
    """Results of a sweep by the agent's class, as the folder holds them."""
    specs = [spec(name) for name in names]
    settings: dict[str, Any] = {"engine": Engine(1), "settings": {}, **more}
    store = run_benchmark(specs, folder, console=Console(file=io.StringIO()), **settings)
    return {case["agent"].rpartition(":")[2]: case for case in store.cases()}


def test_whatever_a_case_raises_the_others_are_run(tmp_path: Path) -> None:
    found = swept(tmp_path, [*EXPECTED, "Shouts", "Rolls"])
    assert {name: found[name]["error"] for name in EXPECTED} == EXPECTED
    assert {case["status"] for case in found.values()} == {"failed", "ok"}
    assert found["Rolls"]["status"] == "ok"
    shout = found["Shouts"]["error"]
    assert len(shout) < 1200
    assert shout.isprintable()
    assert shout.startswith("ValueError: \\x1b[31mloud")
    # A console that knows ASCII alone can show it.
    shout.encode("ascii")


def test_an_agent_that_changes_the_working_directory_takes_no_results_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = swept(Path("out"), ["Moves", "Rolls"])
    assert {name: case["status"] for name, case in found.items()} == {"Moves": "ok", "Rolls": "ok"}
    assert (tmp_path / "out" / "cases.jsonl").read_bytes().count(b"\n") == 2


def test_values_of_numpy_are_stored_as_plain_json(tmp_path: Path) -> None:
    result = run_case(spec("Explains"))
    assert result["status"] == "ok"
    assert result["solver"]["mean_iterations"] == 3.0
    assert result["solver"]["statuses"] == {"7": result["solver"]["solves"]}
    store = ResultStore(tmp_path)
    store.append(result)
    assert store.cases() == [{key: value for key, value in result.items() if key != "trace"}]


def test_ctrl_c_of_a_case_in_this_process_ends_the_sweep() -> None:
    with pytest.raises(KeyboardInterrupt):
        run_case(spec("Interrupts"))


def test_a_case_that_takes_too_long_is_ended_in_this_process(tmp_path: Path) -> None:
    found = swept(tmp_path, ["Loops", "Rolls"], limit=1.5)
    assert found["Loops"]["error"] == "took longer than 1.5 s"
    assert found["Rolls"]["status"] == "ok"


def test_an_agent_that_catches_everything_is_ended_too(tmp_path: Path) -> None:
    found = swept(tmp_path, ["SwallowsAll", "Rolls"], limit=1.0)
    assert found["SwallowsAll"]["error"] == "took longer than 1 s"
    assert found["Rolls"]["status"] == "ok"


def test_warnings_of_the_machine_are_shown_and_not_stored() -> None:
    with pytest.warns(RuntimeWarning, match="the machine is odd"):
        result = run_case(spec("WarnsOfTheMachine"))
    assert result["status"] == "ok"
    assert result["warnings"] == []


def test_traces_are_not_written_through_a_link(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "results", tmp_path / "elsewhere"
    for made in (folder, elsewhere):
        made.mkdir()
    (folder / "traces").symlink_to(elsewhere, target_is_directory=True)
    with pytest.raises(ValueError, match="is a link"):
        swept(folder, ["Rolls"])
    assert list(elsewhere.iterdir()) == []


def test_results_are_not_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine\nno newline")
    (tmp_path / "cases.jsonl").symlink_to(tmp_path / "mine")
    with pytest.raises(ValueError, match="is a link"):
        ResultStore(tmp_path).append({"id": "x", "status": "ok", "agent": "a"})
    assert (tmp_path / "mine").read_text() == "mine\nno newline"


def test_workers_survive_what_ends_a_process_and_are_killed_in_native_code(tmp_path: Path) -> None:
    began = time.monotonic()
    found = swept(
        tmp_path, ["Sticks", "Exits", "Interrupts", "Rolls"], engine=Engine(2), limit=20.0
    )
    assert found["Sticks"]["error"] == "took longer than 20 s"
    assert found["Interrupts"]["error"] == "KeyboardInterrupt: "
    assert found["Exits"]["error"] == EXPECTED["Exits"]
    assert found["Rolls"]["status"] == "ok"
    assert time.monotonic() - began < 120.0


def test_a_limit_that_is_over_at_once_ends_the_case_alone() -> None:
    for _ in range(100):
        with TimeLimit(1e-9) as clock:
            time.sleep(10.0)
        assert clock.over


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan")])
def test_a_limit_that_is_none_is_refused(tmp_path: Path, limit: float) -> None:
    with pytest.raises(ValueError, match="time limit of a case must be positive"):
        swept(tmp_path, ["Rolls"], limit=limit)


def test_a_path_whose_warnings_are_no_list_is_refused_at_the_start(
    tmp_path: Path,
) -> None:
    file = tmp_path / "own.csv"
    files.write(load("u-turn"), file)
    text = file.read_text()
    file.write_text(text.replace("\n", "\n# warnings: 5\n", 1))
    specs = [{"agent": "stanley", "trajectory": name} for name in (str(file), "u-turn")]
    console = Console(file=io.StringIO())
    with pytest.raises(ValueError, match=r"own\.csv: .*warnings"):
        run_benchmark(specs, tmp_path / "out", engine=Engine(1), settings={}, console=console)


@pytest.mark.parametrize(
    "settings", [{"a": 10**30}, {"a": "\x1b[2J"}, {"a": "\ud800"}, {"a": float("nan")}]
)
def test_a_case_that_no_folder_could_give_back_is_refused_at_the_start(
    tmp_path: Path, settings: dict[str, Any]
) -> None:
    console = Console(file=io.StringIO())
    own = tmp_path / "own.py"
    own.write_text("class Own:\n    def __init__(self, task, own=None): ...\n")
    first = {"agent": f"{own}:Own", "trajectory": "u-turn"}
    specs = [first, {**first, "agent_settings": {"own": settings}}]
    with pytest.raises(ValueError, match=r"^(the result: |agent_settings\.own\.a is nan)"):
        run_benchmark(specs, tmp_path / "out", engine=Engine(1), settings={}, console=console)
    assert not (tmp_path / "out").exists()


def test_what_json_does_not_hold_is_named() -> None:
    assert plain({"a": (1, [2.5, None])}, "x") == {"a": [1, [2.5, None]]}
    with pytest.raises(ValueError, match=r"^x\.a\[1\] is inf, not a finite number$"):
        plain({"a": [0.0, float("inf")]}, "x")
    with pytest.raises(TypeError, match=r"^x\.a is of type set, which a result cannot hold$"):
        plain({"a": {1}}, "x")
