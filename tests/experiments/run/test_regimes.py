"""Results by regime: groups, means over finished drives, scores, and where they are shown."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from experiments.run import regimes
from experiments.run.console_tables import screen
from experiments.run.settings import setting_of
from experiments.run.tables import current
from tests.helpers.made_results import METRICS, case, folder_of, page

RATES = {"steering_rate_rms": 0.1, "jerk_rms": 2.0, "rms_speed_error": 0.25}
SLOW, DRIFT = "slow actuators", "95 % of grip, brush tyres"


def made() -> list[dict]:
    return [
        case(1, regime=SLOW, metrics=RATES),
        case(2, regime=SLOW, seed=1, metrics={**RATES, "mle": 0.6}),
        case(3, regime=SLOW, seed=2, metrics={**RATES, "mle": 5.1}, end="left_corridor"),
        case(4, regime=SLOW, seed=3, status="failed", end=None, error="broke"),
        case(5, regime=SLOW, agent="lpv-nmpc", end="wrong_heading"),
        case(6, regime=DRIFT, trajectory="T1"),
        case(7, regime="of one's own"),
        case(8),
    ]


def test_lines_count_failures_and_average_what_finished() -> None:
    groups = regimes.by_regime(made())
    assert list(groups) == [DRIFT, SLOW, "of one's own"]
    nmpc, stanley = regimes.lines(groups[SLOW])
    assert (nmpc.label, nmpc.drives, nmpc.failed, set(nmpc.means)) == ("lpv-nmpc", 1, 1, {None})
    assert (stanley.label, stanley.drives, stanley.failed) == ("stanley", 4, 2)
    # 0.08 m / 0.05 m + 0.03 / 0.1 rad + 0.25 / 0.5 m/s + 0.1 / 0.2 rad/s + 2 / 4 m/s^3
    assert stanley.means == pytest.approx((0.4, 0.08, 0.25, 0.1, 2.0, 3.4))
    assert stanley.cells == [
        "stanley", "4", "2", "7–93 %", "0.400", "0.080", "0.25", "0.100", "2.00", "3.40",
    ]  # fmt: skip
    # An old result lacks speed errors and rates.
    (old,) = regimes.lines(groups[DRIFT])
    assert old.means == (METRICS["mle"], METRICS["ale"], None, None, None, None)


def test_regimes_come_first_on_the_terminal_and_in_the_report(tmp_path: Path) -> None:
    console = Console(width=120, file=io.StringIO())
    tables, complete = screen(made())
    console.print(tables)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert not complete
    assert text.index(DRIFT[:12]) < text.index(SLOW[:12]) < text.index("of one's")
    row = next(line for line in text.splitlines() if "3.40" in line)
    assert row.split()[-6:] == ["0.400", "0.080", "0.25", "0.100", "2.00", "3.40"]
    assert text.index("Ranking") < text.index("By regime")
    assert regimes.tables_of([case(8)]) == []
    folder_of(tmp_path / "with", made())
    shown = page(tmp_path / "with")
    assert shown.index("By regime</h2>") < shown.index("Against the published table</h2>")
    assert "<td>2 of 4<small>0.400</small></td>".replace("<td>", '<td class="n">') in shown
    assert f"Every agent, {SLOW}." in shown
    folder_of(tmp_path / "without", [case(8)])
    assert "By regime</h2>" not in page(tmp_path / "without")


def test_a_regime_is_a_setting_of_its_own_and_old_results_have_none() -> None:
    old, new, slow = case(1), case(2, regime="", computing={}), case(3, regime=SLOW)
    assert setting_of(old) == setting_of(new) != setting_of(slow)
    assert str(setting_of(slow)).startswith(f"{SLOW} · m2-minibus")
    # The same drive by later sources counts once, although the old result has no regime.
    assert current([old, new, slow]) == [new, slow]


def test_cases_with_a_start_show_how_they_come_back() -> None:
    back = {**RATES, "overshoot": 0.25, "recovery_time": 4.56}
    away = {"arc_length": 7, "speed": 0.0}
    cases = [case(1, regime="beside", start=away, metrics=back), case(2, regime=SLOW)]
    groups = regimes.by_regime(cases)
    (line,) = regimes.lines(groups["beside"])
    assert regimes.headings(line.columns)[4:7] == ["ALE, m", "overshoot, m", "back after, s"]
    assert line.cells[4:7] == [f"{METRICS['ale']:.3f}", "0.250", "4.6"]
    assert regimes.columns_of(groups[SLOW]) == regimes.MEANS
    console = Console(width=120, file=io.StringIO())
    console.print(screen(cases)[0])
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "overshoot" in text
    assert "4.6" in text


def test_searches_show_what_is_reached_and_what_is_possible(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = {"iso": 20.0, "lap": 30.0}
    monkeypatch.setattr(regimes.physical_limits, "limit_of", lambda path, *_: known.get(path))
    entry = {"regime": "a", "search": {"setting": "fixed_speed"}}
    lap = {"regime": "b", "search": {"setting": "grip"}, "conditions": {"friction": 0.9}}
    cases = [
        case(1, trajectory="iso", metrics={"highest_fixed_speed": 19.0}, **entry,
             conditions={"friction": 0.9}),
        case(2, trajectory="iso", metrics={"cone_clearance": -0.01}, **entry),
        case(3, trajectory="lap", metrics={"fastest_lap": 40.0}, **lap),
        case(4, trajectory="no", metrics={"fastest_lap": 50.0}, **lap),
    ]  # fmt: skip
    (passed,), (laps,) = (regimes.lines(group) for group in regimes.by_regime(cases).values())
    assert passed.cells[1:6] == ["2", "1", "1–99 %", "19.00", "95"]
    # The unknown limit has no share in the mean.
    assert laps.cells[1:6] == ["2", "0", "0–84 %", "45.00", "75"]


def test_starts_are_settings_of_their_own_but_within_a_regime() -> None:
    """Cases from different places are not averaged, and their tables say where they start."""
    beside, ahead = (setting_of(case(k, start={"lateral_error": k})) for k in (1, 2))
    assert beside != ahead
    assert str(beside).endswith(" · start lateral_error=1")
    together = {str(setting_of(case(k, regime=SLOW, start={"lateral_error": k}))) for k in (1, 2)}
    assert len(together) == 1
    assert "start" not in together.pop()
