"""The house's rules: imports run one way, files stay short, what is declared is what there is."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import lpv_track_env

ROOT = Path(__file__).parents[2]
LAYERS = ("trajectories", "lpv_track_env", "agents", "experiments")
"""From the lowest: each may import what stands before it."""
LONGEST = 500

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
each_layer = pytest.mark.parametrize("layer", LAYERS)


def sources(layer: str) -> list[Path]:
    return sorted((ROOT / layer).rglob("*.py"))


def imported(file: Path) -> Iterator[tuple[int, str]]:
    """(line, top-level package) of every import, also those inside functions and TYPE_CHECKING."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name.partition(".")[0]
        elif isinstance(node, ast.ImportFrom):
            own = file.relative_to(ROOT).parts[0]
            yield node.lineno, own if node.level else str(node.module).partition(".")[0]


@each_layer
def test_imports_run_one_way(layer: str) -> None:
    above = LAYERS[LAYERS.index(layer) + 1 :]
    upwards = [
        f"{file.relative_to(ROOT)}:{line} imports {package}"
        for file in sources(layer)
        for line, package in imported(file)
        if package in {*above, "tests"}
    ]
    assert upwards == []


def test_import_linter_agrees() -> None:
    command = shutil.which("lint-imports", path=str(Path(sys.executable).parent))
    if command is None:
        pytest.skip("import-linter is not installed (make setup-dev); the scan above has run")
    done = subprocess.run(
        [command, "--no-cache"], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@each_layer
def test_no_file_is_too_long(layer: str) -> None:
    lengths = {
        str(file.relative_to(ROOT)): len(file.read_text().splitlines()) for file in sources(layer)
    }
    assert lengths
    assert {name: length for name, length in lengths.items() if length > LONGEST} == {}


def test_every_folder_of_modules_is_a_package() -> None:
    """Without an `__init__.py`, setuptools would leave a folder out of the wheel."""
    folders = {file.parent for layer in LAYERS for file in sources(layer)}
    assert folders
    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def constraints() -> dict[str, str]:
    pinned = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        match = re.fullmatch(r"([A-Za-z0-9._-]+)==([A-Za-z0-9.+!]+)", line.strip())
        assert match, f"not NAME==VERSION: {line}"
        assert normalised(match[1]) not in pinned, f"twice: {line}"
        pinned[normalised(match[1])] = match[2]
    return pinned


def direct() -> dict[str, str]:
    """Requirement by normalised name, those of all extras too."""
    project = PYPROJECT["project"]
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    lines = [line for requirements in lists for line in requirements]
    named = {normalised(re.split(r"[\[<>=!~; ]", line, maxsplit=1)[0]): line for line in lines}
    return {name: line for name, line in named.items() if name != normalised(project["name"])}


def test_every_direct_dependency_is_pinned() -> None:
    """Two want an environment of their own: they require other versions than the pinned ones."""
    assert set(direct()) - set(constraints()) == {"tianshou"}


def test_every_direct_dependency_has_a_lowest_version() -> None:
    assert [line for line in direct().values() if ">=" not in line] == []


def test_somebody_elses_agents_is_told(tmp_path: Path) -> None:
    package = tmp_path / "agents"
    package.mkdir()
    (package / "__init__.py").write_text('"""Somebody else\'s."""\n')
    done = subprocess.run(
        [sys.executable, "-c", "import experiments"],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
    )  # fmt: skip
    assert done.returncode != 0
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: the package 'agents' at ")
    assert str(package) in last
    assert "openai-agents" in last
    assert "virtual environment" in last


def test_submodules_of_the_environment_load_on_first_use() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = lpv_track_env.nothing
    assert lpv_track_env.conditions.REALTIME.name == "realtime"
