"""Charts, scales and the replay's data, against the data that they show."""

import base64
import json
import math
import re

import numpy as np
import pytest

from experiments.report import drive_replay, svg_charts
from experiments.report.drive_figures import magnified
from experiments.report.drives import Drive, families, foot_points, in_families
from experiments.report.page import LineStyle, asset
from experiments.report.summary import over_seeds
from experiments.report.svg_charts import Scale, around, decades, exactly
from experiments.run.statistics import rate_interval
from tests.helpers.made_results import HOSTILE, case, folder_of, page, trace

# Scales


@pytest.mark.parametrize(
    ("scale", "count", "ticks"),
    [
        (Scale(0.0, 10.0), 5, [0, 2, 4, 6, 8, 10]),
        (Scale(-0.31, 0.29), 4, [-0.2, 0.0, 0.2]),
        (Scale(1003.0, 1019.0), 4, [1005, 1010, 1015]),
        (Scale(0.004, 30.0, log=True), 6, [0.01, 0.1, 1.0, 10.0]),
        (Scale(0.012, 0.12, log=True), 6, [0.02, 0.05, 0.1]),
        (Scale(0.025, 0.12, log=True), 6, [0.03, 0.05, 0.07, 0.1]),
        (Scale(0.0431, 0.0448, log=True), 4, [0.0435, 0.044, 0.0445]),
    ],
)
def test_ticks_are_round_numbers_within(scale, count, ticks):
    assert scale.ticks(count) == pytest.approx(ticks)


def test_shares_are_linear_in_the_value_or_in_its_logarithm():
    np.testing.assert_allclose(Scale(2.0, 6.0).share([2.0, 3.0, 6.0]), [0.0, 0.25, 1.0])
    np.testing.assert_allclose(
        Scale(1e-2, 1e2, log=True).share([0.01, 1.0, 100.0]), [0.0, 0.5, 1.0]
    )
    assert Scale(1e-2, 1e2, log=True).share(0.0) < -1.0


def test_scales_hold_what_they_are_made_of_also_if_that_is_nothing():
    values = np.random.default_rng(0).normal(size=(3, 50))
    for scale in (around(values), around(values, zero=True), decades(np.exp(values), 1e-6)):
        shown = scale.share(np.exp(values) if scale.log else values)
        assert shown.min() > 0.0
        assert shown.max() < 1.0
    assert around([[1.0, 2.0]], zero=True).low == 0.0
    for constant in ([[5.0, 5.0]], [], [[math.nan]]):
        scale = around(constant)
        assert scale.low < scale.high
        assert exactly(constant).low < exactly(constant).high


def test_ticks_are_worded_in_short():
    words = [Scale.words(value) for value in (0.0, -0.5, 1e-4, 9999.0, 20_000.0, 2.5e6)]
    assert words == ["0", "−0.5", "0.0001", "9999", "20k", "2.5M"]


# Lines


def distance(point, line):
    """Return the distance from a point (2,) to a polyline (n, 2)."""
    starts, chords = line[:-1], np.diff(line, axis=0)
    along = ((point - starts) * chords).sum(axis=1) / (chords**2).sum(axis=1)
    nearest = starts + np.clip(along, 0.0, 1.0)[:, None] * chords
    return np.hypot(*(point - nearest).T).min()


def test_a_simplified_line_passes_by_every_point_it_left_out():
    rng = np.random.default_rng(1)
    points = np.column_stack([np.arange(300.0), np.cumsum(rng.normal(size=300))])
    kept = svg_charts.simplify(points, 1.5)
    assert 2 < len(kept) < 200
    assert (kept[[0, -1]] == points[[0, -1]]).all()
    assert max(distance(point, kept) for point in points) <= 1.5
    assert len(svg_charts.simplify(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]), 0.1)) == 2
    # There and back again: ends that meet are no reason to drop what lies between.
    loop = np.array([[0.0, 0.0], [5.0, 5.0], [0.0, 0.0]])
    assert len(svg_charts.simplify(loop, 0.1)) == 3


def drawn(data):
    """Return the points of path data written by `svg_charts.polyline`."""
    x, y, rest = re.fullmatch(r"M(-?\d+) (-?\d+)l(.*)", data).groups()
    steps = np.array([int(number) for number in re.findall(r"-?\d+", rest)]).reshape(-1, 2)
    return np.cumsum(np.vstack([[int(x), int(y)], steps]), axis=0)


def test_path_data_leads_through_the_points():
    points = np.array([[10, -5], [12, 7], [12, 7], [0, -20], [-3, 0]])
    np.testing.assert_array_equal(drawn(svg_charts.polyline(points)), points[[0, 1, 3, 4]])
    still = np.array([[1, 2], [1, 2]])
    np.testing.assert_array_equal(drawn(svg_charts.polyline(still)), still)


def test_a_line_stands_where_its_axes_say_and_breaks_where_it_is_not_finite():
    chart = svg_charts.Chart(Scale(0.0, 10.0), Scale(0.0, 1.0))
    x = np.array([0.0, 5.0, 6.0, 7.0, 10.0])
    chart.line(x, np.array([0.0, 1.0, np.nan, 0.5, 0.0]), "c0")
    first, second = re.findall(r"M[^M\"]+", chart.svg().split('class="l c0" d="')[1].split('"')[0])
    wide, high = svg_charts.FINE * chart.plot_width, svg_charts.FINE * chart.plot_height
    np.testing.assert_allclose(drawn(first), [[0, high], [wide / 2, 0]], atol=0.5)
    np.testing.assert_allclose(drawn(second), [[0.7 * wide, high / 2], [wide, high]], atol=0.5)


def test_words_on_a_chart_are_escaped():
    chart = svg_charts.Chart(
        Scale(0.0, 1.0), Scale(0.0, 1.0), x_label=HOSTILE, y_label=HOSTILE, x_names=[HOSTILE]
    )
    chart.note(HOSTILE, 0.5, 0.5)
    assert "<script" not in chart.svg()
    assert chart.svg().count("&lt;script") == 4


# Drives


def drive(number=1, agent="stanley", **more):
    result = case(number, agent, **more)
    return Drive(result["agent"], result["trajectory"], result, trace(n=300))


def test_foot_points_lie_on_the_path():
    x, y, heading = foot_points(trace(n=300))
    made = trace(n=300)
    np.testing.assert_allclose(heading, made["state"][:, 2] - made["heading_error"], atol=1e-12)
    np.testing.assert_allclose(y, 0.0, atol=1e-12)
    np.testing.assert_allclose(x, made["state"][:, 4], atol=1e-12)


def test_a_magnified_deviation_is_that_many_lateral_errors():
    (panel,) = magnified([drive(trajectory="gone")], lambda _: LineStyle(0, 0))
    # 0.1 m of deviation on 75 m of path: 6 % of that are 44 times as much, 20 the next below.
    assert panel.title == "gone, deviations ×20"


def test_families_differ_in_no_more_than_conditions():
    drives = [
        drive(1), drive(2, vehicle="course-car"), drive(3, conditions="realtime"),
        drive(4, "pid", conditions={"name": "realtime", "wind": 1.0}),
    ]  # fmt: skip
    first, second = families(drives)
    assert first.conditions == ["simulation", "realtime", "realtime with wind=1.0"]
    assert [one.label for one in first.of("pid")] == ["pid"]
    assert second.conditions == ["simulation"]
    order = in_families([one.case for one in drives])
    assert [one["id"][-1] for one in order] == ["1", "3", "4", "2"]


# Statistics


def test_the_interval_of_a_rate_by_hand():
    # Nothing seen in n: the upper end solves (1 - p)^n = 0.025.
    low, high = rate_interval(0, 60)
    assert low == 0.0
    assert high == pytest.approx(1.0 - 0.025 ** (1 / 60))
    assert rate_interval(60, 60) == pytest.approx((0.025 ** (1 / 60), 1.0))
    # 1 of 2: P(X >= 1) = 0.025 at the lower end.
    low, high = rate_interval(1, 2)
    assert 1.0 - (1.0 - low) ** 2 == pytest.approx(0.025)
    assert high == pytest.approx(1.0 - low)


def test_a_mean_over_seeds_takes_a_seeds_drives_as_one():
    cases = [
        case(k, seed=seed, metrics={"ale": ale})
        for k, (seed, ale) in enumerate([(0, 0.1), (0, 0.3), (1, 0.6)])
    ]
    found = over_seeds(cases, "ale")
    assert found.mean == pytest.approx(0.4)
    assert found.half_width == pytest.approx(12.7062047 * 0.2)
    assert over_seeds(cases[:2], "ale").half_width is None


def test_failures_are_counted_with_their_bounds(tmp_path):
    ends = ["finished"] * 3 + ["left_corridor"] * 2 + ["time_limit"]
    results = [case(k, seed=k, end=end) for k, end in enumerate(ends)]
    failed = case(6, seed=6, status="failed", end=None, error="no")
    folder_of(tmp_path, [*results, failed], traces=False)
    text = page(tmp_path)
    row = text[text.index("How drives ended") :].split("<tbody>")[1].split("</tr>")[0]
    cells = re.findall(r">([^<]*)</t[dh]>", row)
    low, high = rate_interval(4, 7)
    assert cells[:8] == [
        "stanley", "7", "3", "2", "1", "1", "57.1", f"{100 * low:.1f} to {100 * high:.1f}",
    ]  # fmt: skip


# Replay


def restored(packed, count):
    middle, quantum, text = packed
    whole = np.frombuffer(base64.b64decode(text), dtype="<i2")
    assert len(whole) == count
    return middle + quantum * whole


def test_embedded_quantities_are_the_traces_to_16_bits():
    made = drive()
    moments = json.loads(json.dumps(drive_replay.moments(made)))
    assert moments["count"] == 300
    assert moments["duration"] == pytest.approx(made.trace["time"][-1])
    values = {name: restored(packed, 300) for name, packed in moments["values"].items()}
    for name, wanted in (
        ("lateral", made.trace["lateral_error"]), ("heading", made.trace["heading_error"]),
        ("x", made.trace["state"][:, 4]), ("y", made.trace["state"][:, 5]),
        ("steering", made.trace["steering_angle"]), ("speed", made.trace["state"][:, 0]),
        ("acceleration", made.trace["acceleration"]),
    ):  # fmt: skip
        assert np.abs(values[name] - wanted).max() <= max(np.ptp(wanted) / 64_000, 1e-8)


def test_long_drives_are_thinned_evenly_in_time():
    long = Drive("a", "T1", case(1), trace(n=4000))
    moments = drive_replay.moments(long)
    assert moments["count"] == drive_replay.SAMPLES
    x = restored(moments["values"]["x"], drive_replay.SAMPLES)
    np.testing.assert_allclose(np.diff(x), np.diff(x).mean(), atol=0.05)


def test_whole_settings_are_embedded_while_they_fit():
    drives = [
        drive(1), drive(2, "pid"), drive(3, vehicle="course-car"),
        drive(4, conditions="realtime"), drive(5, "pid", vehicle="course-car"),
    ]  # fmt: skip
    size = max(len(text) for _, text in drive_replay.chosen(drives))
    everything = drive_replay.chosen(drives)
    assert [one.case["id"][-1] for one, _ in everything] == ["1", "2", "4", "3", "5"]
    three = drive_replay.chosen(drives, budget=4 * size)
    assert [one.case["id"][-1] for one, _ in three] == ["1", "2", "4"]
    assert [one.case["id"][-1] for one, _ in drive_replay.chosen(drives, budget=size)] == ["1"]
    assert drive_replay.chosen([]) == []


def test_no_name_ends_the_script_that_holds_the_data():
    name = "</script><script>alert(1)</script><!--"
    block = drive_replay.data_block(drive_replay.chosen([drive(1, agent=name, trajectory=name)]))
    head, content = block.removesuffix("</script>").split(">", 1)
    assert "<" not in content
    assert json.loads(content)["runs"][0]["agent"] == name
    assert list(json.loads(content)["paths"]) == [name]
    assert head == '<script type="application/json" id="replay-data"'


def test_the_scripts_touch_no_network_and_build_no_code():
    for name in ("page.js", "replay.js"):
        source = asset(name)
        for word in ("fetch(", "XMLHttp", "import(", "eval(", "Function(", "innerHTML", "http",
                     "document.write", "localStorage"):  # fmt: skip
            assert word not in source, (name, word)
