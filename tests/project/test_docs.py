"""What README and documentation say to type works: every block of Python, every command line."""

import importlib.util
import json
import re
import shlex
import sys
from argparse import ArgumentParser
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from experiments import cli
from experiments.cli import parser
from experiments.report.build import ERRATA

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)([^\n]*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
TITLE = re.compile(r'title="([^"]+)"')
SHOWN = re.compile(r"(?<![\w/])lpv-track(?: [^`\n#]*)?")
"""A command as it stands in a line of code."""
SHORTER = {
    "300_000": "2048", "3_000_000": "512", "num_envs=512": "num_envs=16", "range(20)": "range(2)",
    "batch_size=4096": "batch_size=512", "num_envs=64": "num_envs=8",
    "PathTrackingVectorEnv(256": "PathTrackingVectorEnv(8", "(256, 1)": "(8, 1)",
    "lpv-track benchmark": "lpv-track benchmark --workers 1",
    "train ppo --fast": "train ppo --fast --steps 2048 --segment 2048 --envs 16 --paths 1 "
    "--set rollout=64",
    "tune --method paired": "tune --method paired --solves 2000 --random-paths 2 --time-limit 2",
}  # fmt: skip
"""Sizes that are cut where a page's blocks are run: what they show is how, not how well."""
INSTALL = ("make ", ". .venv", "pip ")
"""Lines of shells that no test runs: they make the environment that tests run in."""


def blocks(page: Path) -> list[tuple[str, str, str]]:
    """Language, rest of the fence's line, text of every fenced block."""
    return [(m[1], m[2], m[3]) for m in FENCE.finditer(page.read_text())]


def shorter(text: str) -> str:
    for words, instead in SHORTER.items():
        text = text.replace(words, instead)
    return text


def run_page(page: Path, names: dict[str, Any] | None = None) -> dict[str, Any]:
    """Run a page's blocks in their order in the working directory, as its reader would."""
    names = {"__name__": "page"} if names is None else names
    for language, more, text in blocks(page):
        if "--8<--" in text:
            continue  # a script of examples/, see test_examples
        if language == "python" and (title := TITLE.search(more)):
            Path(title[1]).write_text(text)
        if language == "python":
            exec(compile(shorter(text), page.name, "exec"), names)  # noqa: S102  our own text
        elif language == "sh" and page.name == "tutorial.md":
            for line in text.replace("\\\n", " ").splitlines():
                if not line.startswith(INSTALL):
                    words = shlex.split(shorter(line), comments=True)
                    assert cli.main(words[1:]) == 0, line
    return names


def has_python(page: Path) -> bool:
    return any(language == "python" and "--8<--" not in text for language, _, text in blocks(page))


PYTHON_PAGES = [
    page for page in PAGES
    if has_python(page) and page.name not in {"tutorial.md", "learning.md"}
]  # fmt: skip


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=lambda page: page.stem)
def test_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if "stable_baselines3" in page.read_text():
        pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    run_page(page)


def test_the_tutorial_runs_from_drive_to_tuned_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    run_page(DOCS / "tutorial.md")
    said = capsys.readouterr().out  # what the tutorial shows was printed
    for language, _, text in blocks(DOCS / "tutorial.md"):
        if language == "text":
            assert text in said
    lines = Path("results/noise/cases.jsonl").read_text().splitlines()
    noise = [json.loads(line) for line in lines]
    assert {case["agent"] for case in noise} == {
        "my_controllers.py:Proportional", "lpv-nmpc", "lpv-nmpc-tuned",
    }  # fmt: skip


def test_policies_of_the_page_are_trained_written_and_driven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("stable_baselines3")
    from experiments.run.case import run_case

    monkeypatch.chdir(tmp_path)
    run_page(DOCS / "learning.md")
    words = ["mine.zip", "--algorithm", "ppo", "--trust", "--out", "plain.json"]
    assert cli.main(["import-policy", *words]) == 0
    for file in ("mine.json", "plain.json"):
        result = run_case({"agent": file, "trajectory": "u-turn"})
        assert result["status"] == "ok", result.get("error")
        assert result["training"]["algorithm"] in {"mine", "ppo"}


def commands(page: Path) -> list[str]:
    """Command lines in a page's blocks, indented lines and inline code."""
    text = page.read_text()
    code = [
        block.replace("\\\n", " ") for language, _, block in blocks(page) if language in {"sh", ""}
    ]
    rest = FENCE.sub("", text)
    code += [line for line in rest.splitlines() if line.startswith("    lpv-track")]
    code += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", rest)]
    return [match.strip() for piece in code for match in SHOWN.findall(piece)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_command_lines_are_those_of_the_parser(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = set(_subcommands(parser()))
    for line in commands(page):
        words = shlex.split(line)[1:]
        if not words or words[0] in {"COMMAND", "--help"}:
            continue
        assert words[0] in known, line
        # A command's name alone, in a sentence, says less than a line to type.
        if len(words) == 1:
            continue
        try:
            parser().parse_args(words)
        except (SystemExit, ValueError) as error:
            pytest.fail(f"{page.name}: {line}\n{error}{capsys.readouterr().err}")


def _subcommands(root: ArgumentParser) -> list[str]:
    return [parser.prog.split()[-1] for parser in _generator("commands").subparsers(root)]


def _generator(name: str) -> ModuleType:
    """A module that makes pages, from where it lies beside them."""
    spec = importlib.util.spec_from_file_location(name, DOCS / "_generate" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_the_command_reference_has_every_option() -> None:
    generator = _generator("commands")
    text = generator.command_reference(parser())
    for command, _ in generator.walk(parser()):
        section = text.split(f"`{command.prog}`\n", 1)[1].split("\n## ")[0]
        for option in re.findall(r"--[a-z][a-z-]+", command.format_usage()):
            assert f"`{option}" in section, (command.prog, option)


def test_every_erratum_is_on_its_page_once() -> None:
    page = (DOCS / "errata.md").read_text()
    numbers = [int(number) for number in re.findall(r"<!-- erratum (\d+) -->", page)]
    headings = [int(number) for number in re.findall(r"^## (\d+)\. ", page, re.MULTILINE)]
    assert numbers == headings == list(range(1, len(ERRATA) + 1))


def test_docstrings_become_markdown() -> None:
    text = """What it is::

    a = b

=====  ====
name   unit
=====  ====
x      m, of
       both
y      *
=====  ====

first
    What it does,
    and more.
second, third
    Another.

Raises
------
ValueError
    If not.
""".rstrip()
    expected = """What it is:

    a = b


| name | unit |
| --- | --- |
| x | m, of both |
| y | \\* |



`first`
:   What it does,
    and more.

`second, third`
:   Another.

Raises
------
ValueError
    If not.
""".rstrip()
    assert _generator("docstrings").markdown(text) == expected


def cells_of(table: list[str]) -> dict[tuple[str, str], str]:
    """Return the cells of a Markdown table by row and column."""
    lines = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table]
    heading, _, *rows = lines
    return {
        (row[0], name): cell
        for row in rows
        for name, cell in zip(heading[1:], row[1:], strict=True)
    }


def test_the_headline_tables_are_those_of_the_results_page() -> None:
    """MLE / ALE of README's table stand in the rows of the results."""
    results = (DOCS / "results.md").read_text()
    simulated = re.findall(r"^\|\s*(T\d)?\s*\|([^|]+)\|(.*)\|$", results, re.MULTILINE)
    found: dict[tuple[str, str], str] = {}
    path = ""
    for name, agent, values in simulated:
        path = name or path
        cells = [cell.strip(" *") for cell in values.split("|")]
        if path and len(cells) == 8:
            found[agent.strip(" *"), path] = f"{cells[2]} / {cells[3]}"
    section = (ROOT / "README.md").read_text().split("## Results")[1].split("\n## ")[0]
    rows, limits = (
        [line for line in part.splitlines() if line.startswith("|")]
        for part in section.split("The suite `limits` drives where")[:2]
    )
    # Each entry of the second table stands in the larger one of the results.
    assert len(limits) > 8
    larger = results[results.index("| regime (drives) |") :].splitlines()
    entries = cells_of(larger[: larger.index("")])
    for place, entry in cells_of(limits).items():
        assert entries[place] == entry, place
    compared = 0
    for row in rows:
        if row in results or row.startswith(("| simulation", "| `realtime`", "|---")):
            continue
        agent, *values = (cell.strip(" *") for cell in row.strip("| ").split("|"))
        assert values == [found[agent, f"T{k}"] for k in range(1, 7)], agent
        compared += 1
    assert compared >= 10
