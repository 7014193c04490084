"""One writer for a folder, and nothing left of those that were killed."""

import io
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from experiments.run import folder_lock
from experiments.run.benchmark import run_benchmark
from experiments.run.engines import Engine
from experiments.run.folder_lock import locked

HOLD = """
import sys
from pathlib import Path
from experiments.run.folder_lock import locked
with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""
SPECS = [{"agent": "stanley", "trajectory": "u-turn"}]


def sweep(folder: Path, **more: Any) -> None:
    run_benchmark(
        SPECS, folder, engine=Engine(1), settings={}, console=Console(file=io.StringIO()), **more
    )


@pytest.fixture
def holder(tmp_path: Path) -> Any:
    """Another process that holds the lock of a folder until it is killed."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"locked\n"
    yield process
    process.kill()
    process.communicate()


def test_a_second_sweep_in_a_folder_is_refused(tmp_path: Path, holder: Any) -> None:
    message = "another process writes in .*: wait for it, or give another --out"
    with pytest.raises(ValueError, match=message):
        sweep(tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == [".lock"]
    holder.kill()
    holder.wait()
    sweep(tmp_path)
    assert (tmp_path / "cases.jsonl").read_bytes().count(b"\n") == 1


def test_leftovers_of_killed_writers_go_and_other_files_stay(tmp_path: Path) -> None:
    gone = [tmp_path / ".manifest.json.0a1b2c3d.tmp", tmp_path / "traces" / ".a.npz.0b1b2c3d.tmp"]
    kept = [tmp_path / ".report.html.0c1b2c3d.tmp", tmp_path / "notes.tmp", tmp_path / ".tmp"]
    (tmp_path / "traces").mkdir()
    for file in gone + kept:
        file.touch()
    with locked(tmp_path):
        assert [file.exists() for file in gone] == [False, False]
        # A report may be written at this moment: it takes no lock.
        assert all(file.exists() for file in kept)
    past = time.time() - folder_lock.ABANDONED - 1.0
    os.utime(kept[0], (past, past))
    with locked(tmp_path):
        assert [file.exists() for file in kept] == [False, True, True]


def test_only_files_of_our_own_making_within_the_folder_are_removed(tmp_path: Path) -> None:
    folder, own = tmp_path / "results", tmp_path / "own"
    for place in (folder / ".a.json.0a1b2c3d.tmp", own):
        place.mkdir(parents=True)
    (folder / "traces").symlink_to(own, target_is_directory=True)
    others = [own / ".a.npz.0a1b2c3d.tmp", folder / ".a.json.tmp", folder / ".vim.1234.tmp"]
    for file in others:
        file.touch()
    with locked(folder):
        pass
    assert all(file.exists() for file in others)


def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    own = tmp_path / "own.txt"
    own.write_text("mine")
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / ".lock").symlink_to(own)
    with pytest.raises(OSError, match="symbolic links"), locked(folder):
        pass
    assert own.read_text() == "mine"


def test_without_locks_a_warning_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(*_: object) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(folder_lock.fcntl, "flock", none_left)
    with pytest.warns(UserWarning, match="cannot be locked"), locked(tmp_path):
        pass
