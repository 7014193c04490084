"""Tables and the report, from hand-made results folders."""

import math
import re

import numpy as np
import pytest

from experiments.report import sideslip, svg_charts
from experiments.report.build import ERRATA, write_report
from experiments.report.drives import reference_path, usable
from experiments.report.page import line_styles
from experiments.run import tables
from experiments.run.estimates import Estimate, estimate
from experiments.run.metrics import published_row
from experiments.run.store import ResultStore
from lpv_track_env import vehicle
from tests.helpers.made_results import (
    HOSTILE,
    Outline,
    case,
    folder_of,
    own_scripts_alone,
    page,
    printed,
    trace,
)
from trajectories import load

# Rows


def test_mean_and_interval_by_hand():
    # Mean 2, s = 1, t_(0.975, 2) = 4.302653: 4.302653 / sqrt(3).
    found = estimate([1.0, 2.0, 3.0])
    assert found.mean == 2.0
    assert found.half_width == pytest.approx(4.302652730 / math.sqrt(3.0), rel=1e-8)
    assert estimate([0.7]) == Estimate(0.7, None)
    assert estimate([0.5, 0.5]).half_width == 0.0


def test_the_published_row_comes_first_and_seeds_are_one_row():
    seeds = [case(k, seed=k, metrics={"ale": value}) for k, value in enumerate((0.1, 0.2, 0.3))]
    rows = tables.build_rows([case(9, "pid"), *seeds])
    assert [row.label for row in rows] == ["published", "stanley", "pid"]
    first, stanley, pid = rows
    assert first.published
    assert {key: value.mean for key, value in first.values.items()} == published_row("T2")
    assert stanley.runs == 3
    assert stanley.values["ale"].mean == pytest.approx(0.2)
    assert stanley.values["ale"].half_width == pytest.approx(4.302652730 * 0.1 / math.sqrt(3.0))
    assert stanley.values["mle"].half_width == pytest.approx(0.0)
    assert pid.values["ale"].half_width is None
    assert (stanley.end, pid.end) == ("3 finished", "finished")


def test_what_is_not_the_same_experiment_is_not_averaged():
    changes = [
        {"vehicle": "course-car"},
        {"speed_mode": "fixed", "fixed_speed": 4.0},
        {"conditions": "field"},
        {"control_period": 0.1},
        {"env_settings": {"preview_steps": 5}},
        {"vehicle_changes": {"max_lateral_velocity_ratio": 0.5}},
    ]
    results = [case(k, **change) for k, change in enumerate(changes)]
    settings = [*map(str, tables.by_setting(tables.build_rows([case(99), *results])))]
    assert len(settings) == 1 + len(changes)
    assert "m2-minibus · variable speed" in settings
    assert "m2-minibus · with max_lateral_velocity_ratio=0.5 · variable speed" in settings
    assert "m2-minibus · fixed speed 4.0 m/s" in settings
    tuned = case(7, agent_settings={"gain": 2.0})
    assert [row.label for row in tables.build_rows([tuned, case(8)])][1:] == [
        "stanley",
        "stanley (gain=2.0)",
    ]


def test_the_default_setting_stands_first_and_raw_waypoints_apart():
    results = [
        case(1, vehicle="course-car"), case(2, trajectory="T2-raw"), case(3),
        case(4, vehicle="course-car", speed_mode="fixed"),
    ]  # fmt: skip
    assert [*map(str, tables.by_setting(tables.build_rows(results)))] == [
        "m2-minibus · variable speed",
        "course-car · variable speed",
        "m2-minibus · variable speed · raw waypoints",
        "course-car · fixed speed",
    ]


def test_a_case_run_again_from_other_sources_replaces_the_first():
    rows = tables.build_rows([case(1, metrics={"ale": 0.9}), case(2, metrics={"ale": 0.1})])
    assert rows[1].runs == 1
    assert rows[1].values["ale"].mean == 0.1


def test_rows_do_not_depend_on_the_order_of_runs():
    results = [
        case(1, "pid", "T1"), case(2, "stanley", "T1"), case(3, "mine:Own", "T1"),
        case(4, "stanley", "circle"), case(5, "stanley", "T6"), case(6, "stanley", "random-3"),
    ]  # fmt: skip
    rows = tables.build_rows(results)
    assert rows == tables.build_rows(results[::-1])
    assert list(dict.fromkeys(row.trajectory for row in rows)) == ["T1", "T6", "circle", "random-3"]
    assert [row.label for row in rows[:4]] == ["published", "stanley", "pid", "mine:Own"]


def test_violations_name_the_constraint_the_excess_and_the_share():
    none = tables.build_rows([case(1)])[1]
    assert none.violations == "none"  # 3e-7 m/s³ of jerk is rounding
    broken = {"excess_lateral_velocity": 0.3224, "violated_lateral_velocity": 0.322}
    assert (
        tables.build_rows([case(1, metrics=broken)])[1].violations == "|vy|/vx: 0.322 m/s, 32.2 %"
    )
    jerk = {"excess_jerk": 2.0, "violated_jerk": 1e-4, "excess_mine": 0.5, "violated_mine": 1.0}
    both = tables.build_rows([case(1, metrics=jerk), case(2, seed=1)])[1]
    assert both.violations == "|da/dt|: 2 m/s³, <0.1 %; mine: 0.5, 50.0 %"


def test_failures_and_ends_are_counted():
    solves = {"solves": 100, "failures": 3}
    results = [
        case(1, solver=solves),
        case(2, seed=1, end="left_corridor", solver=solves),
        case(3, seed=2, status="failed", end=None, error="x"),
    ]
    row = tables.build_rows(results)[1]
    assert row.end == "1 finished, 1 left corridor, 1 failed"
    assert row.failures == "6 of 200"
    assert row.runs == 2
    lone = tables.build_rows(results[2:])[1]
    assert (lone.end, lone.failures, lone.violations, lone.values) == ("failed", "–", "–", {})


def test_raw_trajectories_stand_beside_the_published_row_and_others_beside_none():
    assert tables.build_rows([case(1, trajectory="T3-raw")])[0].published
    assert not tables.build_rows([case(1, trajectory="circle")])[0].published


def test_the_console_table_fits_120_columns_unbroken():
    long = {"solves": 5000, "failures": 12}
    broken = {"excess_lateral_velocity": 0.32, "violated_lateral_velocity": 0.3,
              "excess_jerk": 2.0, "violated_jerk": 0.1}  # fmt: skip
    results = [
        case(seed, "lpv-nmpc-ipopt", "double-lane-change", seed=seed, solver=long, metrics=broken)
        for seed in range(3)
    ] + [case(10 + k, name, "T1") for k, name in enumerate(("stanley", "pid"))]
    text = printed(results)
    assert max(map(len, text.splitlines())) <= 120
    for words in ("lpv-nmpc-ipopt", "double-lane-change", "published", "0.080", "±0.000", "1.36",
                  "3 finished", "36 of 15000", "2.00", "4.00", "|da/dt|"):  # fmt: skip
        assert words in text, words
    assert "…" not in text


def test_the_console_table_shows_markup_as_it_is():
    assert "[bold]x[/bold]" in printed([case(1, "[bold]x[/bold]")])


# The report


def test_the_report_holds_published_and_own_rows(tmp_path):
    folder_of(tmp_path, [case(1), case(2, "pid", metrics={"ale": 0.456})])
    text = page(tmp_path)
    assert re.search(r'class="n">0\.14</td>', text)  # published ALE of T2
    assert re.search(r'class="n">0\.456</td>', text)
    headings = re.findall(r"<h2><span[^>]*>(\d+)</span> ([^<]*)</h2>", text)
    assert [name for _, name in headings] == [
        "Summary", "Paths and yaw", "Errors over time", "Replay", "Against the published table",
        "Computing time", "Failures and warnings", "Where the sideslip limit forbids the path",
        "Errata of the paper", "Settings and provenance",
    ]  # fmt: skip
    assert [int(number) for number, _ in headings] == [*range(1, 11)]
    assert "Failed cases" not in text
    assert text.count("<svg") >= 6
    assert len(ERRATA) == 9


def test_the_report_is_one_sound_file_that_fetches_nothing(tmp_path):
    store = folder_of(tmp_path, [case(k, trajectory=f"T{k}") for k in (1, 2)])
    store.write_manifest({"suite": "test"})
    text = page(tmp_path)
    outline = Outline(text)
    assert not outline.tags & {"link", "img", "iframe", "object", "base"}
    assert own_scripts_alone(text)
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    rules = dict(rule.split(" ", 1) for rule in policy[1].split("; "))
    assert rules["default-src"] == "'none'"
    assert set(rules) == {"default-src", "script-src", "style-src", "base-uri", "form-action"}
    assert "unsafe" not in rules["script-src"]
    assert all(link.startswith("#") for link in outline.links)
    assert len(outline.ids) == len(set(outline.ids))
    assert {link[1:] for link in outline.links} <= set(outline.ids)
    assert "@import" not in text
    assert not re.search(r"url\((?!#)", text)
    assert "http://" not in text
    assert "https://" not in text
    assert [file.name for file in tmp_path.glob("*.html")] == ["report.html"]
    assert not list(tmp_path.glob(".*"))


def test_every_line_of_a_table_has_a_cell_for_each_heading(tmp_path):
    banded = {"ale_sharp": 0.1, "share_sharp": 1.0}
    failed = case(3, "pid", status="failed", end=None, error="no")
    folder_of(tmp_path, [case(1, metrics=banded), case(2, "lqr"), failed])
    tables = re.findall(r"<table.*?</table>", page(tmp_path), re.DOTALL)
    assert len(tables) >= 8
    for table in tables:
        head, *lines = re.findall(r"<tr.*?</tr>", table, re.DOTALL)
        assert {len(re.findall(r"<t[dh]", line)) for line in lines} == {head.count("<th")}


def test_every_foreign_word_is_escaped(tmp_path):
    results = [
        case(1, agent=HOSTILE, warnings=[HOSTILE]),
        case(2, trajectory=HOSTILE),
        case(3, vehicle=HOSTILE, metrics={"excess_lateral_velocity": 0.5}),
        case(4, agent="pid", status="failed", end=None, error=HOSTILE),
        case(5, agent_settings={HOSTILE: HOSTILE}, end=HOSTILE),
        case(6, seed=1, metrics={f"excess_{HOSTILE}": 1.0}),
    ]
    store = folder_of(tmp_path, results)
    store.write_manifest({HOSTILE: [HOSTILE]})
    text = page(tmp_path)
    outline = Outline(text)
    assert own_scripts_alone(text)
    assert "<script>alert" not in text
    assert sum(HOSTILE in words for words in outline.words) > 6


def test_the_same_folder_gives_the_same_bytes(tmp_path):
    folder_of(tmp_path, [case(1), case(2, "pid"), case(3, trajectory="circle")])
    first = write_report(tmp_path).read_bytes()
    reference_path.cache_clear()
    assert write_report(tmp_path).read_bytes() == first


def test_missing_and_damaged_traces_are_named_and_the_rest_is_drawn(tmp_path):
    store = folder_of(tmp_path, [case(k, trajectory=f"T{k}") for k in (1, 2, 3, 4)])
    names = [tmp_path / "traces" / f"{k:016x}.npz" for k in (1, 2, 3)]
    names[0].unlink()
    names[1].write_bytes(names[1].read_bytes()[:500])
    store.append({**case(3, trajectory="T3"), "trace": {"time": np.arange(4.0)}})
    text = page(tmp_path)
    assert (
        "Not drawn, because their traces cannot be read: stanley on T1 (seed 0), stanley on T2"
        in text
    )
    assert "stanley on T3" in text
    assert "stanley on T4" not in text
    assert "<svg" in text


def test_a_report_without_any_trace_still_has_its_tables(tmp_path):
    folder_of(tmp_path, [case(1)], traces=False)
    text = page(tmp_path)
    assert "0.080" in text
    assert "Not drawn" in text


def test_a_torn_last_line_is_ignored(tmp_path):
    folder_of(tmp_path, [case(1)])
    with (tmp_path / "cases.jsonl").open("a") as handle:
        handle.write('{"id": "2", "agent": "half')
    assert "half" not in page(tmp_path)


def test_failed_cases_are_listed_with_their_error(tmp_path):
    failed = case(2, "mine:Own", status="failed", end=None, error="ValueError: no")
    folder_of(tmp_path, [case(1), failed])
    text = page(tmp_path)
    assert "Failed cases" in text
    assert "ValueError: no" in text


def test_a_folder_of_failed_cases_alone_gives_a_report(tmp_path):
    folder_of(tmp_path, [case(1, status="failed", end=None, error="no")])
    assert "Failed cases" in page(tmp_path)


def test_unknown_trajectories_are_drawn_from_the_trace_alone(tmp_path):
    folder_of(tmp_path, [case(1, trajectory="mine.csv"), case(2, trajectory="gone")])
    text = page(tmp_path)
    assert text.count(">mine.csv</p>") >= 5
    assert text.count(">gone</p>") >= 5


@pytest.mark.parametrize("made", [True, False])
def test_an_empty_folder_is_a_clear_error_and_stays_as_it_was(tmp_path, made):
    folder = tmp_path / "results"
    if made:
        folder.mkdir()
    message = rf"^no results in {re.escape(str(folder))}: run lpv-track benchmark --out .* first$"
    with pytest.raises(ValueError, match=message):
        write_report(folder)
    assert folder.exists() == made
    folder.mkdir(exist_ok=True)
    (folder / "cases.jsonl").write_text('{"id": "torn')
    with pytest.raises(ValueError, match=message):
        write_report(folder)


def test_the_manifest_is_shown(tmp_path):
    store = folder_of(tmp_path, [case(1), case(2, seed=3)])
    assert "no readable manifest" in page(tmp_path)
    written = store.write_manifest({"suite": "quick", "agents": ["stanley", "pid"]})
    text = page(tmp_path)
    for words in ("stanley, pid", "settings.suite", written["versions"]["numpy"], "0, 3"):
        assert words in text


def test_older_results_of_the_same_case_are_left_out_and_counted(tmp_path):
    folder_of(tmp_path, [case(1, metrics={"ale": 0.987}), case(2)])
    text = page(tmp_path)
    assert "1 older result of" in text
    assert "0.987" not in text


def test_noisy_traces_keep_the_report_small(tmp_path):
    """A case costs at most 80 kB of page, so that 60 stay under 5 MB."""
    store = ResultStore(tmp_path)
    agents = ("stanley", "pid", "lqr", "pure-pursuit")
    for k, agent in enumerate(agents):
        store.append({**case(k, agent), "trace": trace(n=6000, seed=k, noise=0.05)})
    assert write_report(tmp_path).stat().st_size < len(agents) * 80_000


# The sideslip limit


def test_cases_at_the_sideslip_limit_are_drawn_and_others_are_not(tmp_path):
    folder_of(tmp_path, [case(1)])
    assert "No case broke the limit" in page(tmp_path)
    store = ResultStore(tmp_path)
    over = {"excess_lateral_velocity": 0.4, "violated_lateral_velocity": 1.0}
    slack = {"slack": [0.0, 0.02, 0.0], "solves": 9}
    store.append({**case(2, "pid", "sine", over), "trace": trace(slip=0.25)})
    store.append({**case(3, "lqr", "u-turn", solver=slack), "trace": trace(slip=0.17)})
    text = page(tmp_path)
    section = text[text.index("forbids the path</h2>") : text.index("Errata of the paper</h2>")]
    assert section.count('class="panel"') == 2
    for words in ("<td>sine</td>", "<td>u-turn</td>", "0.400", "0.020", "100.0"):
        assert words in section
    assert "<td>T2</td>" not in section


def test_steady_sideslip_is_lr_kappa_at_low_speed_and_that_of_a_long_turn():
    car = vehicle.load("course-car")
    low = sideslip.steady_sideslip(np.array([0.1]), np.array([0.0]), car)
    assert low == pytest.approx(0.1 * car.rear_axle_distance)
    # Against the driven one: a lap of a circle, its second half.
    from experiments.run.case import run_case

    result = run_case({"agent": "stanley", "trajectory": "circle", "vehicle": "course-car"})
    n = len(result["trace"]["time"])
    path = load("circle")
    driven = sideslip.sideslip(result["trace"])[n // 2]
    speed = result["trace"]["state"][n // 2, 0]
    needed = sideslip.steady_sideslip(path.curvature[:1], np.array([speed]), car)
    assert driven == pytest.approx(needed[0], rel=0.05)


# Parts of figures


@pytest.mark.parametrize("n", [1, 2, 599, 600, 601, 1199, 5000, 100_001])
def test_decimation_keeps_ends_and_extremes(n):
    values = np.random.default_rng(n).normal(size=n)
    kept = svg_charts.decimate(values)
    assert len(kept) <= svg_charts.POINTS
    assert (np.diff(kept) > 0).all()
    assert {0, n - 1} <= set(kept.tolist())
    assert values[kept].max() == values.max()
    assert values[kept].min() == values.min()


def test_agents_keep_distinct_styles_and_one_each():
    names = [f"agent-{k}" for k in range(20)]
    styles = line_styles([*names, *names])
    assert len({style.kind for style in styles.values()}) == 20
    assert line_styles(names) == styles


@pytest.mark.parametrize("name", ["time", "state", "solve_time"])
def test_traces_that_lack_something_are_not_usable(name):
    good = trace(n=20)
    assert usable(good)
    assert not usable({key: good[key] for key in good if key != name})
    assert not usable({**good, name: good[name][:-1]})
    assert not usable({**good, name: np.full_like(good[name], np.nan)})
    assert not usable(None)
    assert not usable({key: values[:1] for key, values in good.items()})
