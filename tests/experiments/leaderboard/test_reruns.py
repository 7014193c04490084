"""`lpv-track leaderboard` on real folders: samples are run again, what was changed is found."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from experiments.cli import main
from experiments.run.case import run_case
from experiments.run.store import ResultStore

OWN = """from agents.classical.geometric import Stanley
from pathlib import Path
Path(__file__).with_name("ran").touch()
class Mine(Stanley):
    pass
"""


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two agents on two short paths."""
    folder = tmp_path_factory.mktemp("driven") / "results"
    store = ResultStore(folder)
    for agent in ("stanley", "pid"):
        for path in ("u-turn", "straight"):
            store.append({**run_case({"agent": agent, "trajectory": path}), "trace": {}})
    store.write_manifest({"suite": "custom"})
    return folder


@pytest.fixture
def folder(driven: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "results"
    shutil.copytree(driven, copy)
    return copy


def changed(folder: Path, change: Callable[[dict[str, Any]], None], places: slice) -> None:
    file = folder / "cases.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    for line in lines[places]:
        change(line)
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))


def board(folder: Path, *more: str) -> tuple[int, dict[str, list[str]]]:
    """Run the command; return its code and the cells of each agent's row in Markdown."""
    out = folder.parent / "board"
    code = main(["leaderboard", str(folder), "--out", str(out), "--workers", "1", *more])
    tables = (out / "leaderboard.md").read_text().split("\n\n")
    first = next(text for text in tables if text.startswith("| agent | place"))
    rows = [line.strip("| ").split(" | ") for line in first.splitlines()[2:]]
    return code, {cells[0].split("<br>")[0]: cells for cells in rows}


def test_sound_rows_reproduce_bit_for_bit(folder: Path) -> None:
    code, rows = board(folder)
    assert code == 0
    assert {cells[-1] for cells in rows.values()} == {"✓ bit for bit (2 of 2)"}
    page = (folder.parent / "board" / "index.html").read_text()
    assert "✓ bit for bit (2 of 2)" in page


def test_a_sample_of_none_runs_nothing(folder: Path) -> None:
    code, rows = board(folder, "--sample", "0")
    assert code == 0
    assert {cells[-1] for cells in rows.values()} == {"not rerun"}


def test_a_changed_digit_is_found_and_takes_the_place(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def last_digit(case: dict[str, Any]) -> None:
        case["metrics"]["mle"] *= 1.0 + 2.0**-52

    changed(folder, last_digit, slice(0, 1))
    code, rows = board(folder)
    assert code == 1
    assert rows["stanley"][1] == "–"
    assert rows["stanley"][-1].startswith("✗ does not reproduce (1 of 2)<br>stanley u-turn ")
    assert "metrics.mle" in rows["stanley"][-1]
    assert rows["pid"][1] == "1"
    assert rows["pid"][-1] == "✓ bit for bit (2 of 2)"
    assert "does not reproduce" in capsys.readouterr().out


def test_a_changed_field_is_found_without_a_rerun(folder: Path) -> None:
    def another_seed(case: dict[str, Any]) -> None:
        case["seed"] = 5

    changed(folder, another_seed, slice(0, 2))
    code, rows = board(folder, "--sample", "0")
    assert code == 1
    assert rows["stanley"][-1].startswith("✗ does not reproduce: 2 of 2 ids do not fit<br>")
    assert rows["pid"][-1] == "not rerun"


def test_other_versions_are_compared_within_a_tolerance(folder: Path) -> None:
    """A result of other sources and NumPy: the manifest says so, and ids cannot be the same."""
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["versions"]["numpy"] = "1.0.0"
    manifest["key"] = "0123abcd"
    (folder / "manifest.json").write_text(json.dumps(manifest))

    def elsewhere(case: dict[str, Any]) -> None:
        case["manifest"], case["id"] = "0123abcd", f"{case['id'][:-4]}beef"

    def slightly_off(case: dict[str, Any]) -> None:
        case["metrics"]["ale"] *= 1.0 + 1e-12

    changed(folder, elsewhere, slice(None))
    changed(folder, slightly_off, slice(0, 2))
    code, rows = board(folder)
    assert code == 0
    assert rows["pid"][-1] == "✓ bit for bit (2 of 2)"
    assert (folder.parent / "board" / "leaderboard.md").read_text().count("numpy 1.0.0 there") == 2
    assert rows["stanley"][-1] == "✓ within 0.001 (2 of 2)"

    def off(case: dict[str, Any]) -> None:
        case["metrics"]["ale"] *= 1.0 + 1e-2

    changed(folder, off, slice(0, 1))
    code, rows = board(folder)
    assert code == 1
    assert rows["stanley"][-1].startswith("✗ does not reproduce (1 of 2)")


def test_an_own_agent_runs_only_if_told(folder: Path) -> None:
    agent = folder.parent / "mine.py"
    agent.write_text(OWN)
    ran = folder.parent / "ran"
    result = run_case({"agent": f"{agent}:Mine", "trajectory": "u-turn"})
    assert result["status"] == "ok"
    ran.unlink()
    ResultStore(folder).append({**result, "trace": {}})
    code, rows = board(folder)
    assert code == 0
    mine = next(cells for label, cells in rows.items() if label.endswith("mine.py:Mine"))
    assert mine[-1].startswith("– not rerun<br>")
    assert "--open-named-files" in mine[-1]
    assert not ran.exists()
    _, rows = board(folder, "--open-named-files")
    mine = next(cells for label, cells in rows.items() if label.endswith("mine.py:Mine"))
    assert mine[-1] == "✓ bit for bit (1 of 1)"


def test_a_damaged_line_is_named_and_the_rest_is_shown(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = folder / "cases.jsonl"
    first, *others = file.read_text().splitlines(keepends=True)
    file.write_text("".join([first[: len(first) // 2] + "\n", *others]))
    code, rows = board(folder, "--sample", "1")
    assert code == 0
    assert rows["stanley"][1] == "–<br>incomplete"
    assert rows["pid"][1] == "1"
    assert "line 1: " in capsys.readouterr().out
    text = (folder.parent / "board" / "leaderboard.md").read_text()
    assert "cases.jsonl, line 1: " in text


def test_the_page_is_the_same_every_time(folder: Path) -> None:
    board(folder)
    before = (folder.parent / "board" / "index.html").read_bytes()
    board(folder)
    assert (folder.parent / "board" / "index.html").read_bytes() == before


def test_the_commands_on_the_page_reproduce(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import shlex

    board(folder)
    text = (folder.parent / "board" / "leaderboard.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("lpv-track reproduce")]
    assert len(lines) == 2
    for line in lines:
        assert main([*shlex.split(line)[1:], "--workers", "1"]) == 0
    capsys.readouterr()
