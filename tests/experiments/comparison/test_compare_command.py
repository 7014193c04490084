"""`lpv-track compare`: what it prints and writes, and how it refuses."""

import csv
import itertools
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.cli import main
from experiments.comparison.texts import decimals_of, escaped
from experiments.comparison.texts import number as written
from experiments.run.store import ResultStore
from tests.helpers.compared_folders import folder, results
from tests.helpers.made_results import METRICS, case, folder_of

WEIGHED = {"rms_speed_error": 0.1, "steering_rate_rms": 0.2, "jerk_rms": 0.5, "reward": 9.0}


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """Return a folder of two agents with all metrics on two paths, five seeds each."""
    rng = np.random.default_rng(0)
    made = [
        case(
            number, agent, path, {**WEIGHED, "ale": (0.1, 0.2)[place] + 0.01 * rng.normal()},
            seed=seed, end="finished" if seed or place == 0 else "left_corridor",
        )
        for number, (place, agent, path, seed) in enumerate(
            (place, agent, path, seed)
            for place, agent in enumerate(("lpv-nmpc", "stanley"))
            for path in ("T2", "T4")
            for seed in range(5)
        )
    ]  # fmt: skip
    folder_of(tmp_path / "mine_&_yours", made, traces=False)
    return Path("mine_&_yours")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Name folders as seen from this one: long names break the lines of a terminal."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write no figures, which take most of the time."""
    monkeypatch.setattr("experiments.comparison.written.write_figures", lambda *_: [])


def compare(*arguments: object) -> int:
    words = [os.path.relpath(one) if isinstance(one, Path) else str(one) for one in arguments]
    return main(["compare", *words])


@pytest.mark.usefixtures("without_figures")
def test_the_table_says_what_a_b_and_the_signs_are(
    mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(mine, "--out", tmp_path / "out", "--target", "ale=0.1") == 0
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines()[:20])) <= 120
    assert f"A  lpv-nmpc in {mine} (baseline)" in said
    assert f"B  stanley in {mine}" in said
    assert "10 drives of both: 2 paths, 5 seeds" in said
    assert "B - A is positive where B has more" in " ".join(said.split())
    assert "failed: A 0 of 10 (0.0 to 30.8 %), B 2 of 10 (2.5 to 55.6 %)" in said
    assert "A alone 0, B alone 2, McNemar's exact p = 0.5" in said
    assert "10,000 resamples, over 5 seeds, stratified by path (2 paths" in said
    assert "optimality gap of ALE, target 0.1 m" in said
    (line,) = (line for line in said.splitlines() if line.startswith(" ALE, m"))
    assert "0/0/10" in line
    # Every metric keeps to its line.
    assert sum("↓" in line or "↑" in line for line in said.splitlines()[:20]) == 8
    assert compare(mine, "--out", tmp_path / "again", "--target", "ale=0.1") == 0
    assert capsys.readouterr().out.replace("in again:", "in out:") == said


@pytest.mark.usefixtures("without_figures")
def test_files_hold_all_numbers(mine: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert compare(mine, "--out", out, "--seed", 7, "--target", "ale=0.1") == 0
    with (out / "comparison.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    found = json.loads((out / "comparison.json").read_text())
    (one,) = found["comparisons"]
    assert {"versions", "revision", "command", "folders", "hardware"} <= set(found)
    assert (one["seed"], one["resamples"]) == (7, 10_000)
    assert (one["a"]["label"], one["b"]["label"]) == ("lpv-nmpc", "stanley")
    assert [row["metric"] for row in rows] == [each["measure"]["key"] for each in one["metrics"]]
    ours = {case["seed"]: case for case in ResultStore(mine).cases() if case["agent"] == "stanley"}
    assert len(ours) == 5
    for row, each in zip(rows, one["metrics"], strict=True):
        assert float(row["difference"]) == each["difference"]["value"]
        assert float(row["difference_low"]) == each["difference"]["low"]
        assert row["competitor_folder"] == str(mine)
    ale = one["metrics"][0]
    assert rows[0]["gap_b"] == str(ale["gap_b"]["value"])
    assert len(ale["profile"]["levels"]) == len(ale["profile"]["b"])
    # Two of ten drives failed: the largest level leaves them out.
    assert ale["profile"]["b"][-1]["value"] == 0.8


def test_figures_are_vectors_with_embedded_fonts(mine: Path, tmp_path: Path) -> None:
    for width, points in (("column", 3.5 * 72), ("page", 7.16 * 72)):
        out = tmp_path / width
        assert compare(mine, "--out", out, "--width", width, "--metrics", "ale", "score") == 0
        for name in ("profiles", "differences", "improvement"):
            picture = (out / f"{name}.svg").read_text()
            size = re.search(r'<svg [^>]*?width="([\d.]+)pt"', picture)
            assert size is not None
            assert float(size[1]) == pytest.approx(points, abs=0.01)
            assert "<text" not in picture
            document = (out / f"{name}.pdf").read_bytes()
            assert b"/Type3" not in document
            assert b"/FontFile2" in document


def groups(text: str) -> Any:
    """Parse LaTeX into nested lists of characters; an unbalanced brace raises."""
    stack: list[list[Any]] = [[]]
    escape = False
    for character in text:
        if character == "{" and not escape:
            stack.append([])
        elif character == "}" and not escape:
            inner = stack.pop()
            stack[-1].append(inner)
        else:
            stack[-1].append(character)
        escape = character == "\\" and not escape
    assert len(stack) == 1
    return stack[0]


@pytest.mark.usefixtures("without_figures")
def test_latex_is_a_table_of_equal_rows(
    mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert compare(mine, "--out", out, "--latex") == 0
    text = capsys.readouterr().out
    assert text == (out / "comparison.tex").read_text()
    comments, _, table = text.partition(r"\begin{tabular}")
    assert all(line.startswith("%") for line in comments.splitlines())
    assert "lpv-track-env" in comments
    body = r"\begin{tabular}" + table
    assert body.isascii()
    groups(body)
    assert body.endswith("\\end{tabular}\n")
    assert [body.count(rule) for rule in (r"\toprule", r"\midrule", r"\bottomrule")] == [1, 2, 1]
    rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    metrics = [row for row in rows if "multicolumn" not in row]
    assert len(metrics) == 9
    for row in metrics:
        assert len(re.split(r"(?<!\\)&", row)) == 8
    for row in rows:
        assert not re.search(r"(?<!\\)[%#_]", row)
        assert row.count("$") % 2 == 0


def test_no_name_is_a_formula_or_a_new_line(tmp_path: Path) -> None:
    names = ['=HYPERLINK("x")', "@SUM(1)", "-1", "+1", "\n=1\n\nx"]
    drives = [case(k, name) for k, name in enumerate(("stanley", *names))]
    folder_of(tmp_path, drives, traces=False)
    given = ["compare", str(tmp_path), "--baseline", "stanley", "--out", str(tmp_path)]
    assert main([*given, "--metrics", "ale"]) == 0
    with (tmp_path / "comparison.csv").open() as handle:
        found = {row["competitor"] for row in csv.DictReader(handle)}
    lines = {" ".join(name.split()) for name in names}
    assert found == {f"'{line}" for line in lines}
    table = (tmp_path / "comparison.tex").read_text().splitlines()
    for line in lines:
        assert rf"\multicolumn{{8}}{{l}}{{A: stanley, B: {escaped(line)}}} \\" in table


def test_names_are_escaped() -> None:
    assert escaped("a_b & 50 % #1 {x} ~ ^ \\ $ m/s³ <") == (
        r"a\_b \& 50 \% \#1 \{x\} \textasciitilde{} \textasciicircum{} \textbackslash{} \$ "
        r"m/s\textsuperscript{3} \textless{}"
    )


@pytest.mark.usefixtures("without_figures")
def test_folders_of_namesakes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    errors = {"T2": [0.1, 0.2, 0.3]}
    folder(tmp_path / "a", ("stanley", errors), ("pid", errors))
    folder(tmp_path / "b", ("stanley", {"T2": [0.2, 0.3, 0.4, 0.5]}), ("lqr", errors))
    assert compare(tmp_path / "a", tmp_path / "b", "--out", tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "B  stanley in b\n" in said
    assert "left out, 1 drive that B alone has: T2 seed 3" in said
    assert "pid" not in said
    (line,) = (line for line in said.splitlines() if line.startswith(" ALE"))
    assert "+0.10 [0.10, 0.10]" in re.sub(r"(\.\d\d)0+", r"\1", line)


def test_what_all_failed_is_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Failed on one side or both, no passed drive at all: no number, and no error."""
    lost = {"T2": [None, None]}
    folder(tmp_path / "a", ("stanley", {"T2": [0.1, 0.2]}), ("pid", lost), ("lqr", lost))
    assert compare(tmp_path / "a", "--out", tmp_path / "out") == 0
    assert compare(tmp_path / "a", "--agents", "pid", "lqr", "--out", tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "B 2 of 2" in said
    assert "failed" in said
    found = json.loads((tmp_path / "out" / "comparison.json").read_text())
    ale = found["comparisons"][0]["metrics"][0]
    assert ale["difference"] == {"value": None, "low": None, "high": None}
    assert ale["iqm_a"]["value"] == "inf"
    assert ale["improvement"]["value"] == 0.5


@pytest.mark.usefixtures("without_figures")
def test_crashed_cases_are_failures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = results("stanley", {"T2": [0.1, 0.2]})
    made += [case(100 + k, "pid", seed=k, conditions="realtime", status="failed", end=None)
             for k in range(2)]  # fmt: skip
    folder_of(tmp_path / "a", made, traces=False)
    assert compare(tmp_path / "a", "--out", tmp_path / "out") == 0
    assert "B 2 of 2" in capsys.readouterr().out


@pytest.mark.usefixtures("without_figures")
def test_scenes_of_traffic_are_drives_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = []
    for number, agent in enumerate(("lpv-nmpc", "idm")):
        for seed in range(3):
            one = case(10 * number + seed, agent, metrics={"progress": 10.0 + number}, seed=seed)
            del one["trajectory"], one["speed_mode"], one["fixed_speed"]
            made.append({**one, "scene": "racetrack"})
    folder_of(tmp_path / "a", made, traces=False)
    assert compare(tmp_path / "a", "--metrics", "progress", "--out", tmp_path / "out") == 0
    assert "3 drives of both: 1 path, 3 seeds" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--metrics", "alle"], "unknown metric 'alle'; known: "),
        (["--target", "ale"], "'ale' is not KEY=VALUE"),
        (["--target", "ale=0"], "--target ale must be positive and finite, not 0"),
        (["--target", "ale=nan"], "--target ale must be positive and finite"),
        (["--baseline", "lqr"], "unknown agent 'lqr'; known: lpv-nmpc, stanley"),
        (["--agents", "stanley"], "no agent to compare with stanley"),
        (["--exact"], "--exact compares two folders, not 1"),
        (["--width", "poster"], "--width"),
        (["--seed", "-1"], "--seed"),
    ],
)
def test_wrong_words_are_one_line(
    arguments: list[str], said: str, mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(mine, "--out", tmp_path / "out", *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / "out").exists()


def test_a_folder_without_results_is_refused(
    mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(mine, tmp_path / "none", "--out", tmp_path / "out") == 2
    assert "no results in none\n" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


@pytest.mark.usefixtures("without_figures")
def test_damaged_lines_are_told(
    mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = mine / "cases.jsonl"
    good = lines.read_bytes()
    lines.write_bytes(good + b'{"id": 3}\n')
    words = f"left out: {lines}, line 21"
    assert compare(mine, "--out", tmp_path / "out") == 0
    assert words in " ".join(capsys.readouterr().out.split())
    assert compare(mine, "--out", tmp_path / "out", "--latex") == 0
    said = capsys.readouterr()
    assert said.out.endswith("\\end{tabular}\n")
    assert words in " ".join(said.err.split())


def test_digits_follow_the_numbers(mine: Path) -> None:
    from experiments.comparison.competitors import pairs_within, read_folder
    from experiments.comparison.measures import measure_of
    from experiments.comparison.outcomes import compare as outcome_of

    measures = [measure_of("ale"), measure_of("mle")]
    found = read_folder(mine, measures, [])
    (pair,) = pairs_within(found, [], None)
    ale, mle = outcome_of(*pair, found.drives, measures, {}).metrics
    assert METRICS["mle"] == 0.2
    assert math.isclose(mle.mean_a, 0.2)
    assert decimals_of(mle) == 3
    assert decimals_of(ale) in (3, 4)
    assert [written(-0.0, 0), written(-0.004, 2, sign=True)] == ["0", "+0.00"]


def test_an_agent_that_never_passes_leaves_the_digits_of_the_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ends = (("lpv-nmpc", "finished"), ("stanley", "left_corridor"))
    made = [
        case(number, agent, path, {**WEIGHED, "ale": 0.0321}, end=end)
        for number, (agent, end, path) in enumerate(
            (agent, end, path) for agent, end in ends for path in ("T2", "T4")
        )
    ]
    folder_of(tmp_path / "mine", made, traces=False)
    assert compare(tmp_path / "mine", "--metrics", "ale", "--out", tmp_path / "out") == 0
    (line,) = (one for one in capsys.readouterr().out.splitlines() if one.startswith(" ALE, m"))
    assert line.split()[3:8] == ["–", "–", "–", "0.0321", "failed"]


@pytest.mark.parametrize("high", [0.085, 0.16, 1.3])
def test_labels_of_a_profile_do_not_overlap(tmp_path: Path, high: float) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from experiments.comparison.competitors import pairs_within, read_folder
    from experiments.comparison.figures import profiles
    from experiments.comparison.measures import measure_of
    from experiments.comparison.outcomes import compare as outcome_of

    ends = (("lpv-nmpc", 0.014), ("stanley", high))
    made = [case(k, agent, "T2", {"ale": ale}) for k, (agent, ale) in enumerate(ends)]
    folder_of(tmp_path / "mine", made, traces=False)
    found = read_folder(tmp_path / "mine", [measure_of("ale")], [])
    (pair,) = pairs_within(found, [], None)
    figure = profiles([outcome_of(*pair, found.drives, [measure_of("ale")], {})], "page")
    figure.set_size_inches(1.8, 1.6)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    (panel,) = figure.axes
    low, top = panel.get_xlim()
    shown = [
        label.get_window_extent()
        for place, label in zip(panel.get_xticks(), panel.get_xticklabels(), strict=True)
        if low <= place <= top and label.get_text()
    ]
    assert len(shown) >= 2
    assert all(one.x1 < other.x0 for one, other in itertools.pairwise(shown))


def test_a_hopeless_competitor_leaves_the_others_legible(tmp_path: Path) -> None:
    from experiments.comparison.competitors import pairs_within, read_folder
    from experiments.comparison.figures import differences
    from experiments.comparison.measures import measure_of
    from experiments.comparison.outcomes import compare as outcome_of

    drives = (("lpv-nmpc", 0.01, "finished"), ("stanley", 0.2, "finished"),
              ("lqr", 0.011, "finished"), ("pid", 0.01, "left_corridor"))  # fmt: skip
    made = [
        case(k, agent, "T2", {"ale": ale}, end=end) for k, (agent, ale, end) in enumerate(drives)
    ]
    folder_of(tmp_path / "mine", made, traces=False)
    measures = [measure_of("ale")]
    found = read_folder(tmp_path / "mine", measures, [])
    outcomes = [
        outcome_of(*pair, found.drives, measures, {}) for pair in pairs_within(found, [], None)
    ]
    figure = differences(outcomes, "page")
    (panel,) = figure.axes
    # 1900 % and 10 % stand on one axis, and pid is named though it has nothing to show.
    assert panel.get_xscale() == "symlog"
    (names,) = ([text.get_text() for text in legend.get_texts()] for legend in figure.legends)
    assert "pid against lpv-nmpc: no drive passed by both" in names
    near = differences([one for one in outcomes if one.b.label == "lqr"], "page")
    assert near.axes[0].get_xscale() == "linear"
