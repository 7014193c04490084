"""Folders that anybody may have written: no traceback, nothing opened or run, text stays text."""

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest

from experiments.cli import main
from experiments.leaderboard.board import code, entries_of, escaped, markdown, page
from experiments.leaderboard.rows import sections_of
from experiments.run import ranking, resampling
from tests.helpers.made_results import HOSTILE, case, folder_of, own_scripts_alone

BASE = [
    case(1, regime="a regime"),
    case(
        2, "lpv-nmpc", "u-turn", regime="a regime", search={"setting": "grip"}, manifest="0123abcd",
        training={"algorithm": "ppo", "steps": 3, "seconds": 1.0, "solves": 2},
    ),
]  # fmt: skip
VALUES: dict[str, Any] = {
    "null": None, "negative": -1, "zero": 0, "text": "text", "list": [], "object": {},
    "nested": {"a": {"b": [1]}}, "true": True, "huge": 1e308, "large": 1e12, "whole": 10**18,
    "long": "x" * 200_000, "control": "\x1b[31m\x00", "html": HOSTILE, "half": "\ud800",
    "backwards": "\u202eevil", "lines": "a\n# b\n\n```sh\nlpv-track drive\n```",
}  # fmt: skip
KEYS = [
    *((key,) for key in BASE[1]),
    *(("metrics", key) for key in ("mle", "ale", "duration", "fastest_lap", "cone_clearance")),
    *(("solver", key) for key in BASE[1]["solver"]),
    *(("training", key) for key in BASE[1]["training"]),
    ("search", "setting"),
]


def built(folder: Path) -> tuple[str, str, list[str]]:
    """Page, Markdown and what was left out."""
    skipped: list[str] = []
    made = [(one, entries_of(one, {}, {})) for one in sections_of([folder], skipped)]
    return page(made, "t", "s", skipped), markdown(made, "t", "c", skipped), skipped


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder_of(tmp_path_factory.mktemp("foreign"), BASE, traces=False).folder


@pytest.mark.parametrize("kind", ["missing", *VALUES])
def test_no_entry_of_a_case_breaks_the_board(
    folder: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (ranking, resampling):
        monkeypatch.setattr(module, "RESAMPLES", 50)
    value = VALUES.get(kind, ...)
    for key in KEYS:
        changed = copy.deepcopy(BASE[1])
        inner = changed
        for one in key[:-1]:
            inner = inner[one]
        inner[key[-1]] = value
        if value is ...:
            del inner[key[-1]]
        lines = "".join(json.dumps(one) + "\n" for one in (BASE[0], changed))
        (folder / "cases.jsonl").write_text(lines)
        text, marked, skipped = built(folder)
        name = ".".join(key)
        assert len(skipped) <= 1, name
        assert own_scripts_alone(text), name
        assert not re.search(r"[\x1b\u202e]|<script|onerror|nan", marked), name
        assert all(len(line) < 20_000 for line in marked.splitlines()), name
        # Nothing of a folder begins a line: no heading, no block of code.
        code = [line for line in marked.splitlines() if line.startswith("lpv-track")]
        assert all(line.startswith("lpv-track reproduce ") for line in code), name
        assert marked.count("\n## ") == 2 + marked.count("drives\n"), name


@pytest.mark.parametrize(
    "content",
    [
        "[1]", "null", '"x"', "{", '{"settings": 5, "versions": [1], "hardware": "x"}',
        '{"settings": {"suite": ["paper"]}}', '{"settings": {"suite": "../paper"}}',
        json.dumps({"revision": {"commit": HOSTILE}, "versions": {"numpy": [HOSTILE]},
                    "hardware": {"processor": HOSTILE * 1000, "cores": {}, "system": None}}),
    ],
)  # fmt: skip
def test_no_manifest_breaks_the_board(tmp_path: Path, content: str) -> None:
    folder_of(tmp_path, [case(1)], traces=False)
    (tmp_path / "manifest.json").write_text(content)
    text, marked, _ = built(tmp_path)
    assert own_scripts_alone(text)
    assert "<script" not in marked
    assert "Custom drives" in marked


def test_a_folder_without_a_readable_line_is_named_and_the_others_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder_of(tmp_path / "good", [case(1)], traces=False)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "cases.jsonl").write_text("nonsense\n" * 50)
    words = ["--sample", "0", "--out", str(tmp_path / "out")]
    assert main(["leaderboard", str(tmp_path / "good"), str(tmp_path / "bad"), *words]) == 0
    said = capsys.readouterr().out
    assert "no line of cases.jsonl can be read" in (tmp_path / "out" / "index.html").read_text()
    assert said.count("left out") == 11
    assert main(["leaderboard", str(tmp_path / "bad"), *words]) == 2
    assert "is not JSON" in capsys.readouterr().err


@pytest.mark.parametrize("more", [[], ["--sample", "2"]])
def test_nothing_that_a_folder_names_is_opened_or_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: list[str]
) -> None:
    """A named pipe would be waited for, a module would leave its trace."""
    import os

    ran = tmp_path / "ran"
    module = tmp_path / "evil.py"
    module.write_text(f"open({str(ran)!r}, 'w')\nclass Evil: pass\n")
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    monkeypatch.syspath_prepend(str(tmp_path))
    folder_of(
        tmp_path / "theirs",
        [
            case(1, f"{module}:Evil"), case(2, "evil:Evil"), case(3, str(tmp_path / "no.json")),
            case(4, trajectory=str(pipe)), case(5, vehicle=str(pipe)),
            case(6, "lpv-nmpc-tuned", agent_settings={"weights": str(pipe)}),
            case(7, f"{tmp_path}/seed-0/policy.json"),
        ],
        traces=False,
    )  # fmt: skip
    manifest = {"settings": {"suite": "paper", "agents": [f"{module}:Evil"]}}
    (tmp_path / "theirs" / "manifest.json").write_text(json.dumps(manifest))
    out = tmp_path / "out"
    assert main(["leaderboard", str(tmp_path / "theirs"), "--out", str(out), *more]) in {0, 1}
    assert not ran.exists()
    text = (out / "leaderboard.md").read_text()
    assert text.count("--open-named-files") >= 5


@pytest.mark.parametrize("name", ["a\n```\n# b", "a`<b>", "a\udcffb"])
@pytest.mark.parametrize("command", ["leaderboard", "compare"])
def test_a_folder_may_have_any_name(tmp_path: Path, name: str, command: str) -> None:
    folder_of(tmp_path / name, [case(1), case(2, "pid")], traces=False)
    more = {"leaderboard": ["--sample", "0"], "compare": ["--metrics", "ale"]}[command]
    given = [command, str(tmp_path / name), *more, "--out", str(tmp_path / "out")]
    assert main(given) == 0
    for file in (tmp_path / "out").glob("*.[mct]*"):
        text = file.read_text(encoding="utf-8")
        assert "\n# b" not in text
        assert text.count("\n```\n") == text.count("```sh\n")


def test_code_stays_code_in_markdown() -> None:
    assert code("a b\n\nc") == "`a b c`"
    assert code("a`b``c") == "``` a`b``c ```"


def test_text_stays_text_in_markdown() -> None:
    given = 'a|b *c* `d` [e](http://f) <b> {: .x } # $x$ !\\ \n ## g --8<-- "h"'
    assert escaped(given) == (
        "a&#124;b &#42;c&#42; &#96;d&#96; &#91;e&#93;(http://f) &lt;b&gt; &#123;: .x &#125; &#35; "
        "&#36;x&#36; &#33;&#92; &#35;&#35; g --8&lt;-- \"h\""
    )  # fmt: skip
