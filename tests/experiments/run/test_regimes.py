"""Results by regime: groups, means over finished drives, scores, and where they are shown."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from experiments.run import regimes
from experiments.run.console_tables import screen
from experiments.run.suites import REGIMES
from experiments.run.tables import current, setting_of
from tests.helpers.made_results import METRICS, case, folder_of, page

RATES = {"steering_rate_rms": 0.1, "jerk_rms": 2.0, "rms_speed_error": 0.25}
SLOW, DRIFT = "slow actuators", REGIMES[0]


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
    assert stanley.cells == ["stanley", "4", "2", "0.400", "0.080", "0.25", "0.100", "2.00", "3.40"]
    # An old result lacks speed errors and rates.
    (old,) = regimes.lines(groups[DRIFT])
    assert old.means == (METRICS["mle"], METRICS["ale"], None, None, None, None)


def test_regimes_come_first_on_the_terminal_and_in_the_report(tmp_path: Path) -> None:
    console = Console(width=120, file=io.StringIO())
    tables, complete = screen(made())
    console.print(tables)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert not complete
    assert text.index(DRIFT) < text.index(SLOW) < text.index("of one's own")
    row = next(line for line in text.splitlines() if "3.40" in line)
    assert row.split()[-8:] == ["4", "2", "0.400", "0.080", "0.25", "0.100", "2.00", "3.40"]
    assert regimes.table([case(8)]) is None
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
    assert regimes.headings(line.columns)[3:6] == ["MLE, m", "overshoot, m", "back after, s"]
    assert line.cells[3:6] == [f"{METRICS['mle']:.3f}", "0.250", "4.6"]
    assert regimes.columns_of(groups[SLOW]) == regimes.MEANS
    console = Console(width=120, file=io.StringIO())
    console.print(screen(cases)[0])
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "overshoot" in text
    assert "4.6" in text


def test_starts_are_settings_of_their_own_but_within_a_regime() -> None:
    """Cases from different places are not averaged, and their tables say where they start."""
    beside, ahead = (setting_of(case(k, start={"lateral_error": k})) for k in (1, 2))
    assert beside != ahead
    assert str(beside).endswith(" · start lateral_error=1")
    together = {str(setting_of(case(k, regime=SLOW, start={"lateral_error": k}))) for k in (1, 2)}
    assert len(together) == 1
    assert "start" not in together.pop()
