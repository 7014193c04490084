"""Tables on a terminal: a screen of them, or all; progress in few lines."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from experiments.commands.benchmark import finish
from experiments.run import benchmark, engines, suites
from experiments.run.console_tables import SCREEN, screen
from experiments.run.engines import Engine
from experiments.run.store import ResultStore
from tests.helpers.made_results import case, folder_of, printed

AGENTS = ("lpv-nmpc", "stanley", "pid", "lqr", "pure-pursuit")


def shown(results: list[dict[str, Any]]) -> tuple[str, bool]:
    tables, complete = screen(results)
    console = Console(width=120, file=io.StringIO())
    console.print(tables)
    return console.file.getvalue(), complete  # type: ignore[attr-defined]


def many() -> list[dict[str, Any]]:
    """More rows than a screen takes, in three settings."""
    changes = ({}, {"conditions": "realtime"}, {"vehicle": "course-car"})
    return [
        case(1000 * k + 10 * i + j, agent, f"T{j}", **change)
        for k, change in enumerate(changes)
        for i, agent in enumerate(AGENTS)
        for j in range(1, 7)
    ]


def test_few_results_are_shown_whole() -> None:
    results = [case(1), case(2, "pid")]
    text, complete = shown(results)
    assert complete
    assert text == printed(results)


def test_of_many_results_a_screen_shows_two_tables_of_every_agent() -> None:
    text, complete = shown(many())
    assert not complete
    lines = text.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 120
    assert [line.strip() for line in lines if "m2-minibus" in line] == [
        "m2-minibus · variable speed", "m2-minibus · variable speed · conditions realtime",
    ]  # fmt: skip
    for agent in AGENTS:
        assert text.count(f"\n {agent} ") == 2
    assert len(AGENTS) * 18 > SCREEN
    assert "6 of 6" in text


def test_paths_given_as_files_are_shown_by_their_names() -> None:
    far = "/a/folder/of/a/very/long/name/indeed"
    text = printed([case(1, trajectory=f"{far}/line.csv"), case(2, trajectory="T2")])
    assert "line.csv" in text
    assert far not in text
    # Two files of one name keep what tells them apart.
    text = printed([case(1, trajectory=f"{far}/a/x.csv"), case(2, trajectory=f"{far}/b/x.csv")])
    assert "a/x.csv" in text
    assert "b/x.csv" in text


@pytest.mark.parametrize(("count", "most"), [(3, 3), (744, 20)])
def test_progress_without_a_terminal_is_a_line_now_and_then(
    count: int, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    specs = suites.grid(["stanley"], ["T2"], seeds=range(count))

    def results(specs: list[dict[str, Any]], *_: Any) -> Iterator[dict[str, Any]]:
        for number, spec in enumerate(specs):
            yield case(number, seed=spec["seed"])

    monkeypatch.setattr(engines, "in_process", results)
    monkeypatch.setattr(benchmark.Case, "check", lambda _: None)
    monkeypatch.setattr(ResultStore, "append", lambda *_: None)
    console = Console(width=120, file=io.StringIO())
    benchmark.run_benchmark(specs, tmp_path, engine=Engine(1), settings={}, console=console)
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert len(lines) == most
    assert lines[-1].startswith(f"[{count}/{count}, ")


def test_the_end_says_where_the_rest_is(tmp_path: Path) -> None:
    specs = [
        {"agent": agent, "trajectory": path, "seed": seed}
        for agent in AGENTS for path in ("T1", "T2") for seed in range(3)
    ]  # fmt: skip
    results = [case(0, id=benchmark.Case(**spec).id, **spec) for spec in specs]
    store = folder_of(tmp_path, results, traces=False)
    for chosen, most in ((specs, 30), (specs[:2], 40)):
        console = Console(width=120, file=io.StringIO())
        assert finish(store, benchmark.selected(store, chosen), console) == 0
        text = console.file.getvalue()  # type: ignore[attr-defined]
        assert len(text.splitlines()) <= most
        assert f"report: {tmp_path / 'report.html'} (" in text
        assert (f"all tables: lpv-track report {tmp_path}" in text) == (chosen is specs)
