"""A user's folder or file that hides one of the packages is reported at the import."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("trajectories", "lpv_track_env", "agents", "experiments")

EDITABLE = f"""
import importlib.machinery, importlib.util, sys

class Finder:
    def find_spec(name, path=None, target=None):
        if name in {PACKAGES}:
            folder = {str(ROOT)!r} + "/" + name
            return importlib.util.spec_from_file_location(
                name, folder + "/__init__.py", submodule_search_locations=[folder])

sys.meta_path.insert(1 + sys.meta_path.index(importlib.machinery.PathFinder), Finder)
"""
"""Setuptools' editable installs put such a finder behind Python's own."""


def run(folder: Path, code: str, install: str) -> subprocess.CompletedProcess[str]:
    script = folder / "script.py"
    script.write_text((EDITABLE if install == "editable" else "") + code)
    env = {**os.environ, "PYTHONPATH": str(ROOT) if install == "ordinary" else ""}
    return subprocess.run(
        [sys.executable, script.name], cwd=folder, env=env, capture_output=True, text=True,
        check=False, timeout=100,
    )  # fmt: skip


def hide(folder: Path, name: str, kind: str) -> None:
    if kind == "file":
        (folder / f"{name}.py").touch()
        return
    (folder / name).mkdir()
    (folder / name / ("__init__.py" if kind == "package" else "notes.txt")).touch()


@pytest.mark.parametrize("install", ["editable", "ordinary"])
@pytest.mark.parametrize("kind", ["package", "folder", "file"])
@pytest.mark.parametrize("name", ["trajectories", "agents", "experiments"])
def test_hidden_packages_are_told_of(name: str, kind: str, install: str, tmp_path: Path) -> None:
    hide(tmp_path, name, kind)
    done = run(tmp_path, "import lpv_track_env\nprint('imported')\n", install)
    # Among the folders on the path, Python takes one with an __init__.py, if there is any.
    hidden = not (kind == "folder" and install == "ordinary")
    told = [line for line in done.stderr.splitlines() if "hides the package" in line]
    assert len(told) == hidden
    assert (done.stdout == "imported\n") == (not hidden or name != "trajectories")
    if hidden:
        assert f"the package '{name}' of lpv-track-env: rename it, or run your script" in told[0]


@pytest.mark.parametrize("install", ["editable", "ordinary"])
def test_nothing_is_told_where_nothing_is_hidden(install: str, tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    code = "import agents, trajectories, lpv_track_env, experiments\nprint(agents.names()[0])\n"
    done = run(tmp_path, code, install)
    assert (done.stdout, done.stderr) == ("lpv-nmpc\n", "")
