"""Errors by curvature band in the report and on a terminal."""

import math

import numpy as np
import pytest

from experiments.run.console_tables import band_lines, band_ranges
from tests.helpers.made_results import (
    HOSTILE,
    Outline,
    case,
    folder_of,
    own_scripts_alone,
    page,
    printed,
)

NAMES = ("straight", "gentle", "moderate", "sharp")
T_975_2 = 4.302652730
"""t_(0.975, 2): quantile for three drives."""


def bands(**ale_and_share):
    """Metrics of a drive: (ALE, share of time) of the bands that it visits."""
    found = {}
    for name, (ale, share) in ale_and_share.items():
        found |= {f"ale_{name}": ale, f"mle_{name}": 2 * ale, f"aoe_{name}": 0.01,
                  f"share_{name}": share}  # fmt: skip
    return found


def three_drives(agent="stanley", first=1):
    """0.1, 0.2 and 0.6 m on straights; one of them never bends, and lasts twice as long."""
    return [
        case(first, agent, seed=0, metrics=bands(straight=(0.1, 0.75), sharp=(0.3, 0.25))),
        case(first + 1, agent, seed=1, metrics=bands(straight=(0.2, 0.5), sharp=(0.5, 0.5))),
        case(
            first + 2,
            agent,
            "T6",
            seed=2,
            metrics={**bands(straight=(0.6, 1.0)), "duration": 120.0},
        ),
    ]


def section(text):
    return text[text.index("> By curvature</h2>") :].partition("</section>")[0]


def test_one_agent_by_hand():
    ((label, cells),) = band_lines(three_drives())
    assert label == "stanley"
    straight, gentle, moderate, sharp = cells
    assert gentle is moderate is None
    assert (straight.drives, sharp.drives) == (3, 2)
    assert straight.ale.mean == pytest.approx(0.3)
    deviation = math.sqrt((0.2**2 + 0.1**2 + 0.3**2) / 2)
    assert straight.ale.half_width == pytest.approx(T_975_2 * deviation / math.sqrt(3))
    assert sharp.ale.mean == pytest.approx(0.4)
    # Of 60, 60 and 120 s: 45, 30 and 120 straight on.
    assert straight.share == pytest.approx(195 / 240)
    assert sharp.share == pytest.approx(45 / 240)


def test_all_agents_stand_in_the_order_of_the_main_table_whatever_they_drove():
    early = case(20, "mine:Own", metrics=bands(straight=(0.1, 1.0)))
    failed = case(21, "pid", status="failed", end=None, error="x")
    lines = band_lines([early, failed, *three_drives("lqr", 4), *three_drives()])
    assert [label for label, _ in lines] == ["stanley", "lqr", "pid", "mine:Own"]
    assert dict(lines)["pid"] == [None] * 4
    assert dict(lines)["mine:Own"][1:] == [None] * 3
    assert dict(lines)["mine:Own"][0].ale.half_width is None


def test_drives_of_one_seed_are_one_sample():
    """They share their disturbances, whatever the path."""
    paths = [("T1", 0, 0.1), ("T2", 0, 0.3), ("T1", 1, 0.5), ("T2", 1, 0.7)]
    cases = [
        case(k, trajectory=path, seed=seed, metrics=bands(sharp=(ale, 1.0)))
        for k, (path, seed, ale) in enumerate(paths)
    ]
    ((_, cells),) = band_lines(cases)
    assert cells[3].drives == 4
    assert cells[3].ale.mean == pytest.approx(0.4)
    # Means of 0.2 and 0.6; t_(0.975, 1) = 12.706.
    assert cells[3].ale.half_width == pytest.approx(12.7062 * 0.4 / 2.0, rel=1e-4)
    ((_, alone),) = band_lines(cases[:2])
    assert alone[3].ale.half_width is None


def test_drives_that_do_not_know_bands_count_neither_as_drives_nor_as_time():
    ((_, cells),) = band_lines([*three_drives(), case(9, seed=7)])
    assert cells[0].drives == 3
    assert cells[0].share == pytest.approx(195 / 240)


def test_ranges_of_the_bands():
    assert band_ranges() == ["< 0.005", "0.005 to 0.02", "0.02 to 0.05", "≥ 0.05"]


def test_the_report_shows_every_setting_apart(tmp_path):
    other = [{**result, "vehicle": "course-car"} for result in three_drives(first=10)]
    folder_of(tmp_path, [*three_drives(), *other], traces=False)
    text = section(page(tmp_path))
    Outline(f"<section><h2{text}</section>")
    assert text.count("<table>") == 2
    assert text.index("m2-minibus") < text.index("course-car")
    for name in NAMES:
        assert text.count(f">{name}<small>") == 2
    width = T_975_2 * math.sqrt(0.07) / math.sqrt(3)
    assert text.count(f"0.300 ±{width:.3f}<small>3 drives, 81 %</small>") == 2
    assert text.count("2 drives, 19 %") == 2
    assert text.count('<td class="n">–</td>') == 4  # gentle and moderate, for lack of visits


def test_short_stays_and_single_drives_are_put_into_words(tmp_path):
    lone = case(1, metrics=bands(straight=(0.1, 0.998), sharp=(0.2, 0.002)))
    folder_of(tmp_path, [lone], traces=False)
    text = section(page(tmp_path))
    assert "0.100<small>1 drive, 100 %</small>" in text
    assert "0.200<small>1 drive, &lt;1 %</small>" in text


def test_agents_and_settings_are_escaped(tmp_path):
    results = [case(1, HOSTILE, vehicle=HOSTILE, metrics=bands(sharp=(0.1, 1.0)))]
    folder_of(tmp_path, results, traces=False)
    assert own_scripts_alone(page(tmp_path))


def test_results_from_before_bands_were_measured_have_no_such_section(tmp_path):
    folder_of(tmp_path, [case(1)], traces=False)
    assert "By curvature" not in page(tmp_path)
    assert "by curvature" not in printed([case(1)])


def test_the_console_shows_it_within_120_columns():
    text = printed([*three_drives("a-policy-with-a-rather-long-name/policy.json"), *three_drives()])
    table = text[text.index("ALE by curvature") :]
    assert max(map(len, text.splitlines())) <= 120
    for words in (*NAMES, "< 0.005 1/m", "≥ 0.05 1/m", "0.300 ±", "3 drives, 81 %", "–"):
        assert words in table, words
    assert table.index("stanley") < table.index("a-policy")


def test_shares_of_a_whole_setting_sum_to_one():
    rng = np.random.default_rng(0)
    results = []
    for seed in range(5):
        shares = rng.dirichlet(np.ones(4))
        metrics = bands(**{name: (0.1, share) for name, share in zip(NAMES, shares, strict=True)})
        results.append(case(seed, seed=seed, metrics={**metrics, "duration": rng.uniform(10, 90)}))
    ((_, cells),) = band_lines(results)
    assert sum(cell.share for cell in cells) == pytest.approx(1.0)
