"""Options of path files on the command line, and the line that says what an import did."""

import math
from pathlib import Path

import numpy as np
import pytest

import trajectories
from experiments.cli import main
from experiments.commands.options import EXIT_USAGE


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """An open arc of 80 m radius with speeds in a third column, without a header."""
    angle = np.linspace(0.0, 4.0, 80)
    rows = np.column_stack([80.0 * np.cos(angle), 80.0 * np.sin(angle), np.full(80, 18.0)])
    np.savetxt(tmp_path / "arc.txt", rows)
    return tmp_path / "arc.txt"


def test_options_reach_the_path(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "paths"
    command = [
        "trajectories",
        str(file),
        "--columns",
        "x",
        "y",
        "speed_kmh",
        "--write",
        str(folder),
    ]
    more = ["--smoothing", "0", "--closed", "--minimum-distance", "3", "--max-speed", "4.5"]
    assert main([*command, *more, "--vehicle", "bmw-320i"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"{file}: x,y waypoints of 80 points: closed, " in said
    assert "speeds of speed_kmh, 5 to 5 m/s, up to " in said
    assert "lowered on 100 % of the length, at most by 0.50 m/s" in said
    path = trajectories.load(folder / "arc.csv")
    assert path.closed
    assert path.speed.max() == pytest.approx(4.5)
    assert path.metadata["smoothing"] == 0.0
    assert path.metadata["minimum_distance"] == 3.0
    assert "lowered on 100 %" in path.metadata["imported"]  # native files keep all metadata
    assert main([*command, "--open", "--scale", "2", "--speeds", "planned"]) == 0
    wide = trajectories.load(folder / "arc.csv")
    assert not wide.closed
    assert wide.length == pytest.approx(640.0, rel=1e-3)
    assert "speed planned for at most 10 m/s" in wide.metadata["imported"]


def test_a_line_is_said_once_in_every_command(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = tmp_path / "arc.csv"
    lines = "\n".join(",".join(line.split()) for line in file.read_text().splitlines()[:30])
    points.write_text(f"x,y,v_kmh\n{lines}\n")
    command = ["benchmark", "--agents", "stanley", "pid", "--trajectories", str(points)]
    out = ["--workers", "1", "--out", str(tmp_path / "out")]
    assert main([*command, *out]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "waypoints of" in line]
    assert len(said) == 1
    assert said[0].startswith(f"{points}: x,y waypoints of 30 points: open")
    assert said[0].endswith("kept")
    assert main(["trajectories", str(points), str(points)]) == 0
    assert capsys.readouterr().out.count("waypoints of") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["T2", "--scale", "2"], "scale is an option of files, and 'T2' is none"),
        (["--open"], "closed is an option of files, and 'T1' is none"),
        (["u-turn", "--vehicle", "f1tenth"], "vehicle is an option of files, and 'u-turn'"),
        (["FILE"], "FILE --columns x y v --write DIR"),
        (["FILE", "--columns", "x", "y"], "has 3 columns, but 2 are named"),
        (["FILE", "--columns", "x", "y", "q"], "column name 'q' is not known"),
        (["FILE", "--columns", "x", "y", "v", "--scale", "0"], "scale must be positive"),
        (["FILE", "--columns", "x", "y", "v", "--vehicle", "tank"], "'tank'"),
        (["FILE", "--columns", "x", "y", "v", "--speed-unit", "c"], "unknown speed_unit 'c'"),
        (["FILE", "--columns", "x", "y", "-", "--speeds", "file"], "has no column of speeds"),
        (["FILE", "--open", "--closed"], "not allowed with"),
        (["FILE", "--max-speed", "nan"], "--max-speed must be"),
        (["array.npy"], "cannot be read: No such file"),
    ],
)  # fmt: skip
def test_wrong_options_are_one_line(
    arguments: list[str], words: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(file) if argument == "FILE" else argument for argument in arguments]
    assert main(["trajectories", *given]) == EXIT_USAGE
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert math.isfinite(len(error))
