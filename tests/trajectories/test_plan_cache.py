"""Arrays on disk: the same bits as without, and nothing wrong with a file is ever noticed."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from trajectories import SpeedLimits, plan_cache, plan_speed, speed, speed_program
from trajectories.shapes import smooth

LIMITS = SpeedLimits(max_speed=10.0, max_lateral_acceleration=2.0, max_acceleration=1.5)
CURVATURE = 0.05 * np.sin(np.arange(401) / 40.0) ** 2


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(plan_cache.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def programmes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the linear programmes that are solved."""
    sizes: list[int] = []
    solve = speed_program.linprog

    def counted(cost: np.ndarray, **more: object) -> object:
        sizes.append(len(cost))
        return solve(cost, **more)

    monkeypatch.setattr(speed_program, "linprog", counted)
    return sizes


def planned(limits: SpeedLimits = LIMITS) -> np.ndarray:
    """Plan as another process would, with nothing in memory."""
    speed._planned.cache_clear()
    return plan_speed(CURVATURE, 0.25, limits)


def test_a_plan_is_made_once_and_has_the_same_bits(
    folder: Path, programmes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = planned()
    count = len(programmes)
    assert count > 0
    assert [entry.suffix for entry in folder.iterdir()] == [".f64"]
    second = planned()
    assert len(programmes) == count
    monkeypatch.setenv(plan_cache.VARIABLE, "off")
    without = planned()
    assert len(programmes) == 2 * count
    assert first.tobytes() == second.tobytes() == without.tobytes()


@pytest.mark.parametrize("change", ["limits", "curvature", "spacing", "closed", "share"])
def test_another_problem_is_planned_anew(folder: Path, change: str) -> None:
    planned()
    curvature, spacing, limits, options = CURVATURE.copy(), 0.25, LIMITS, {}
    if change == "limits":
        limits = SpeedLimits(10.0, 2.0, np.nextafter(1.5, 2.0))
    elif change == "curvature":
        curvature[7] = np.nextafter(curvature[7], 1.0)
    elif change == "spacing":
        spacing = np.nextafter(0.25, 1.0)
    elif change == "closed":
        options["closed"] = True
    else:
        options["share"] = 0.9
    plan_speed(curvature, spacing, limits, **options)
    assert len(list(folder.iterdir())) == 2


def test_another_process_reads_what_this_one_kept(folder: Path) -> None:
    first = planned()
    code = (
        "import numpy as np; from trajectories import SpeedLimits, plan_speed, speed_program\n"
        "speed_program.linprog = None\n"
        "speed = plan_speed(0.05 * np.sin(np.arange(401) / 40.0) ** 2, 0.25,"
        " SpeedLimits(10.0, 2.0, 1.5))\n"
        "print(speed.tobytes().hex())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == first.tobytes().hex()


def test_smoothed_points_are_kept_with_all_bits(folder: Path) -> None:
    points = np.column_stack([np.arange(60.0), np.sin(np.arange(60.0) / 5.0)])
    first, second = smooth(points, 0.05), smooth(points, 0.05)
    assert len(list(folder.iterdir())) == 1
    for one, other in zip((*first.geometry, first.places), (*second.geometry, second.places),
                          strict=True):  # fmt: skip
        assert one.tobytes() == other.tobytes()
    assert first[1:3] == second[1:3]
    smooth(points, 0.06)
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize("damage", ["flipped", "cut", "empty", "folder", "pipe", "unreadable"])
def test_a_bad_entry_counts_as_missing(folder: Path, damage: str) -> None:
    first = planned()
    (entry,) = folder.iterdir()
    content = bytearray(entry.read_bytes())
    entry.unlink()
    if damage == "flipped":
        content[100] ^= 1
        entry.write_bytes(content)
    elif damage == "cut":
        entry.write_bytes(content[:-8])
    elif damage == "empty":
        entry.write_bytes(b"")
    elif damage == "folder":
        entry.mkdir()
    elif damage == "pipe":
        os.mkfifo(entry)
    else:
        entry.write_bytes(content)
        entry.chmod(0)
    assert planned().tobytes() == first.tobytes()
    if damage in {"flipped", "cut", "empty", "pipe"}:  # replaced
        checked = entry.read_bytes()
        assert hashlib.sha256(checked[32:]).digest() == checked[:32]
        np.testing.assert_array_equal(np.frombuffer(checked[32:]), first)


def test_a_folder_that_cannot_be_written_is_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    monkeypatch.setenv(plan_cache.VARIABLE, str(file / "below"))
    assert planned().max() > 5.0
    assert file.read_text() == ""


def test_the_folder_is_the_user_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(plan_cache.VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert plan_cache.place() == tmp_path / "lpv-track"
    monkeypatch.setenv(plan_cache.VARIABLE, "OFF")
    assert plan_cache.place() is None


def test_the_oldest_entries_are_removed_and_nothing_else(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.mkdir()
    names = [f"{k:064x}.f64" for k in range(10)]
    for k, name in enumerate(names):
        (folder / name).write_bytes(bytes(1000))
        os.utime(folder / name, (1e9 + k, 1e9 + k))
    (folder / "notes.txt").write_bytes(bytes(5000))
    monkeypatch.setattr(plan_cache, "MOST_BYTES", 8000)
    monkeypatch.setattr(plan_cache, "SEARCHED", "")
    first = planned()
    left = {entry.name for entry in folder.iterdir()}
    assert "notes.txt" in left
    assert sum((folder / name).stat().st_size for name in left - {"notes.txt"}) <= 6000
    assert len(left.intersection(names)) == 2  # of 1000 bytes, beside the new one of 3240
    assert names[-2:] == sorted(left.intersection(names))
    assert planned().tobytes() == first.tobytes()
