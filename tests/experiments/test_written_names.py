"""Names from files and results never become paths: every place that names a file after data."""

import json
from pathlib import Path

import numpy as np
import pytest

import trajectories
from experiments.cli import main
from experiments.run.result_schema import as_stored, read_case
from experiments.run.store import ResultStore
from experiments.study.study import Study
from tests.helpers.made_results import case
from trajectories.fileio import file_name
from trajectories.files import write

HOSTILE = (
    "../../x", "..", ".", "/etc/passwd", "a/b", "a\\b", "C:\\x", "\x00", "a\nb", "\ud800",
    ".bashrc", "~", "$HOME", "x" * 5000, "", " ", "-rf", "CON", "ünï", "\u202ex",
)  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_files_name_stays_in_its_folder(name: str, tmp_path: Path) -> None:
    file = tmp_path / f"{file_name(name)}.csv"
    assert file.resolve().parent == tmp_path
    assert not file.name.startswith((".", "-"))
    file.write_text("x")
    assert [found.name for found in tmp_path.iterdir()] == [file.name]
    assert len(file.name.encode()) < 255


@pytest.mark.parametrize("name", [*trajectories.names(), "random-fast-12", "a_b+c=1.5@2"])
def test_usual_names_are_kept(name: str) -> None:
    assert file_name(name) == name


def named(file: Path, name: str) -> str:
    """Write a path with such a name in its header; return the file."""
    write(trajectories.load("u-turn"), file)
    text = file.read_text().replace('"u-turn"', json.dumps(name), 1)
    file.write_text(text)
    return str(file)


@pytest.mark.parametrize("name", ["../../x", "/x", "a/b", ".hidden", ".."])
def test_trajectories_are_written_inside_of_their_folder(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = named(tmp_path / "in.csv", name)
    folder = tmp_path / "one" / "two"
    assert main(["trajectories", file, "--write", str(folder)]) == 0, capsys.readouterr().err
    written = [found for found in folder.rglob("*") if found.is_file()]
    assert [found.name for found in written] == [f"{file_name(name)}.csv"]
    assert trajectories.load(written[0]).name == name
    others = {found.name for found in tmp_path.rglob("*") if found.is_file()}
    assert others == {"in.csv", written[0].name}


def test_no_path_is_written_over_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [named(tmp_path / f"{k}.csv", name) for k, name in enumerate(("a/b", "A-b"))]
    assert main(["trajectories", *files, "--write", str(tmp_path / "out")]) == 2
    assert "two paths would be written to" in capsys.readouterr().err
    assert not list((tmp_path / "out").rglob("*.csv"))


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a/b", "", ".", "x" * 200, "a\nb"])
def test_ids_of_results_are_no_paths(name: str, tmp_path: Path) -> None:
    line = json.dumps({**case(1), "id": name}).encode()
    with pytest.raises(ValueError, match="id"):
        read_case(line, "here")
    with pytest.raises(ValueError, match="id"):
        as_stored({**case(1), "id": name})
    np.savez(tmp_path / "outside.npz", x=np.zeros(3))
    folder = ResultStore(tmp_path / "results")
    folder.cases_file.write_bytes(line + b"\n")
    skipped: list[str] = []
    assert folder.cases(skipped) == []
    assert len(skipped) == 1


def test_folders_of_a_study_are_in_it(tmp_path: Path) -> None:
    study = Study(tmp_path, ("search",), (0,), 1, ())
    for name in HOSTILE:
        for file in (study.training(name, 0), study.evaluation(name, name, 0)):
            assert tmp_path in file.resolve().parents
            assert ".." not in file.parts
