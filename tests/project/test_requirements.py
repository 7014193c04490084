"""The lists of packages that `make setup` installs: pinned, hashed, as in constraints.txt."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LISTS = ("run", "dev", "docs")
PIN = re.compile(r"([A-Za-z0-9._-]+)==(\S+)")
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(text: str) -> dict[str, str]:
    return {normal(name): version for name, version in PIN.findall(text)}


CONSTRAINTS = pins((ROOT / "constraints.txt").read_text())


def entries(name: str) -> list[str]:
    text = (ROOT / "requirements" / f"{name}.txt").read_text()
    return re.split(r"\n(?=\S)", text.strip())


@pytest.mark.parametrize("name", [*LISTS, "torch-cpu"])
def test_every_package_has_one_version_and_hashes_of_its_files(name: str) -> None:
    found = entries(name)
    assert found
    for entry in found:
        assert PIN.match(entry), entry
        assert HASH.search(entry), entry
        rest = HASH.sub("", entry.split("\n", 1)[1]).replace("\\", "").strip()
        assert rest == "", entry


@pytest.mark.parametrize("name", LISTS)
def test_versions_are_those_of_the_constraints(name: str) -> None:
    found = pins("\n".join(entry.split(" ")[0] for entry in entries(name)))
    assert {key: CONSTRAINTS[key] for key in found if key in CONSTRAINTS} == {
        key: version for key, version in found.items() if key in CONSTRAINTS
    }
    # What else is listed belongs to other platforms, or builds the project.
    alone = {entry.split("==")[0] for entry in entries(name) if " ; " not in entry.split("\n")[0]}
    assert {normal(key) for key in alone} <= set(CONSTRAINTS) | {"setuptools"}


def test_all_dependencies_are_listed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    tested = extras["test"][0].split("[")[1].rstrip("]").split(",")
    sets = {
        "run": project["dependencies"],
        "dev": [one for extra in (*tested, "test", "dev") for one in extras[extra]],
        "docs": extras["docs"],
    }
    for name, dependencies in sets.items():
        wanted = {normal(re.split(r"[<>=\[ ]", one)[0]) for one in dependencies}
        listed = set(pins("\n".join(entries(name))))
        assert wanted - {"lpv-track-env"} <= listed, name


def test_no_list_names_a_host() -> None:
    for file in (ROOT / "requirements").iterdir():
        assert "://" not in file.read_text(), file.name
