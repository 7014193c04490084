"""Two folders of results held against each other."""

from pathlib import Path

import pytest

from experiments.cli import main
from experiments.run.exact import compare, values_of
from tests.helpers.made_results import METRICS, case, folder_of


def test_equal_results_have_no_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither ids, order nor times count."""
    first = [case(1), case(2, trajectory="T4")]
    second = [
        case(7, trajectory="T4", solver={"median": 0.003}, seconds=9.0),
        case(8, solver={"p99": 0.1}),
    ]
    folder_of(tmp_path / "a", first, traces=False)
    folder_of(tmp_path / "b", second, traces=False)
    assert main(["compare", "--exact", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    said = capsys.readouterr().out
    assert "2 cases in both" in said
    assert "no differences" in said
    assert "stanley 2.000 -> 2.500 ms" in said


def test_entries_that_an_old_result_lacks_are_empty(tmp_path: Path) -> None:
    folder_of(tmp_path / "a", [case(1)], traces=False)
    folder_of(tmp_path / "b", [case(2, regime="", computing={})], traces=False)
    assert compare(tmp_path / "a", tmp_path / "b").paired == 1
    folder_of(tmp_path / "c", [case(2, regime="slow actuators")], traces=False)
    assert compare(tmp_path / "a", tmp_path / "c").paired == 0


def test_the_last_digit_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder_of(tmp_path / "a", [case(1), case(2, seed=1)], traces=False)
    changed = case(1, metrics={"ale": 0.08 + 2**-53}, end="left")
    folder_of(tmp_path / "b", [changed, case(2, seed=1)], traces=False)
    found = compare(tmp_path / "a", tmp_path / "b")
    assert found.paired == 2
    assert [line.split(": ")[1] for line in found.differences] == [
        "end finished -> left", f"metrics.ale 0.08 -> {0.08 + 2**-53}",
    ]  # fmt: skip
    assert main(["compare", "--exact", str(tmp_path / "a"), str(tmp_path / "b")]) == 1
    assert "2 differences" in capsys.readouterr().out


def test_cases_of_one_folder_alone_are_differences(tmp_path: Path) -> None:
    folder_of(tmp_path / "a", [case(1), case(2, agent="lqr")], traces=False)
    # The first of two runs of one case no longer counts.
    runs = [case(1, metrics={"ale": 1.0}), case(3), case(4, agent_settings={"gain": 2.0})]
    folder_of(tmp_path / "b", runs, traces=False)
    found = compare(tmp_path / "a", tmp_path / "b")
    assert found.paired == 1
    lost, added = found.differences
    assert "agent lqr" in lost
    assert lost.endswith(f"only in {tmp_path / 'a'}")
    assert "agent_settings {'gain': 2.0}" in added
    assert added.endswith(f"only in {tmp_path / 'b'}")


def test_values_are_single_numbers_and_texts_without_times() -> None:
    result = case(
        1, solver={"slack": [0.0, 0.5, 0.0], "statuses": {"SUCCESS": 3}, "mean_iterations": None},
        metrics={"predict_median": 0.1}, tried=[[5.0, True], [6.0, False]], warnings=["cold"],
        latency={"median": 0.02}, error=None,
    )  # fmt: skip
    found = dict(values_of(result))
    metrics = {name for name in found if name.startswith("metrics.")}
    assert metrics == {f"metrics.{name}" for name in METRICS}
    assert {name: value for name, value in found.items() if name not in metrics} == {
        "status": "ok", "end": "finished", "solver.failures": 0, "solver.solves": 0,
        "solver.slack[0]": 0.0, "solver.slack[1]": 0.5, "solver.slack[2]": 0.0,
        "solver.statuses.SUCCESS": 3, "warnings[0]": "cold", "latency.median": 0.02,
        "tried[0][0]": 5.0, "tried[0][1]": True, "tried[1][0]": 6.0, "tried[1][1]": False,
    }  # fmt: skip


def test_searches_that_tried_other_values_are_one_case(tmp_path: Path) -> None:
    folder_of(tmp_path / "a", [case(1, tried=[[5.0, True]])], traces=False)
    folder_of(tmp_path / "b", [case(2, tried=[[5.0, False]])], traces=False)
    found = compare(tmp_path / "a", tmp_path / "b")
    assert found.paired == 1
    (line,) = found.differences
    assert line.endswith("tried[0][1] True -> False")


def test_no_results_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder_of(tmp_path / "a", [case(1)], traces=False)
    assert main(["compare", "--exact", str(tmp_path / "a"), str(tmp_path / "none")]) == 2
    assert f"no results in {tmp_path / 'none'}" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
    assert main(["compare", "--exact", str(tmp_path / "a")]) == 2
    assert "two folders, not 1" in capsys.readouterr().err
