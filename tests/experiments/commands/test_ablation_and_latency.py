"""`lpv-track ablation` and `lpv-track latency`, on tiny cases."""

import json
from pathlib import Path
from typing import Any

import matplotlib.image as mpimg
import pytest

from experiments import cli
from experiments.commands import ablation, latency
from experiments.run.computing import ARRANGEMENTS
from lpv_track_env.conditions import DRAWN, IDEAL, REALTIME


def test_every_disturbance_of_realtime_is_in_one_group() -> None:
    grouped = [name for names in ablation.GROUPS.values() for name in names]
    assert len(grouped) == len(set(grouped))
    ideal = {"gnss_wander_time", "gnss_outlier_size", "gust_time", "side_area"}
    assert set(grouped) == set(DRAWN) - ideal
    changed = {name for name, value in REALTIME.as_dict().items() if value != getattr(IDEAL, name)}
    assert changed - set(grouped) == {"name", "estimator"}


def test_ablation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = ("steering: lag", "computing delay")
    monkeypatch.setattr(ablation, "GROUPS", {name: ablation.GROUPS[name] for name in kept})
    command = ["ablation", "--trajectories", "u-turn", "--seeds", "2", "--workers", "1", "--out",
               str(tmp_path), "--agent", "stanley"]  # fmt: skip
    assert cli.main(command) == 0
    shown = capsys.readouterr().out
    result = json.loads((tmp_path / "ablation.json").read_text())
    rows = {(row["row"], row["compensated"]): row for row in result["rows"]}
    labels = ["none", *kept, "all: realtime", *ablation.ALL_BUT]
    assert list(rows) == [(label, flag) for label in labels for flag in (True, False)]
    assert all(row["episodes"] == 2 for row in rows.values())
    # Nothing to compensate where nothing is late.
    assert rows["none", True]["ale"] == pytest.approx(rows["none", False]["ale"], abs=1e-6)
    assert rows["none", True]["rms_estimate_error"] < 1e-9
    assert rows["all, perfect sensors", True]["rms_estimate_error"] == 0.0
    assert rows["all: realtime", True]["rms_estimate_error"] > 0.01
    assert rows["all: realtime", True]["ale"] > rows["none", True]["ale"]
    assert result["revision"].keys() == {"sources", "commit", "modified"}
    for label in labels:
        assert label.split(",")[0] in shown
    assert mpimg.imread(tmp_path / "ablation.png").std() > 0.05
    # What is there is not driven again.
    assert cli.main(command) == 0
    assert "32 of 32 cases are in" in capsys.readouterr().out


def test_latency(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latency, "SHARES", (1.5,))
    monkeypatch.setattr(latency, "RECORDED_STEPS", 6)
    times = tmp_path / "recorded.json"
    spread = [0.001 + 0.0001 * k for k in range(10)]
    times.write_text(json.dumps(dict.fromkeys(("ekf", *latency.SOLVERS), spread)))
    command = ["latency", "--trajectories", "u-turn", "--seeds", "1", "--workers", "1"]
    assert cli.main([*command, "--times", str(times), "--out", str(tmp_path / "one")]) == 0
    shown = capsys.readouterr().out
    result = json.loads((tmp_path / "one" / "latency.json").read_text())
    rows: dict[Any, Any] = {(row["row"], row["arrangement"]): row for row in result["rows"]}
    slow = "slower: 1.5 of a period"
    # In sequence it misses half of them; with a slower clock, or in parallel, none.
    assert rows[slow, "sequential"]["missed"] == pytest.approx(0.5, abs=0.02)
    assert rows[slow, latency.SLOWER_CLOCK]["period"] == pytest.approx(0.04)
    assert rows[slow, latency.SLOWER_CLOCK]["missed"] == 0.0
    assert rows[slow, "triggered"]["missed"] == 0.0
    assert rows[slow, "triggered"]["latency_median"] == pytest.approx(0.0301, rel=0.05)
    wait = rows[slow, "free-running"]["latency_median"] - rows[slow, "triggered"]["latency_median"]
    assert wait == pytest.approx(0.01, abs=0.003)
    fast = "measured: ekf, lpv-nmpc"
    assert {name for row, name in rows if row == fast} == set(ARRANGEMENTS)
    assert rows[fast, "sequential"]["latency_median"] == pytest.approx(0.0029, rel=0.1)
    assert "slower" in shown
    assert mpimg.imread(tmp_path / "one" / "latency.png").std() > 0.05
    # Its own record repeats it, bit for bit.
    again = tmp_path / "one" / "times.json"
    assert cli.main([*command, "--times", str(again), "--out", str(tmp_path / "two")]) == 0
    repeated = json.loads((tmp_path / "two" / "latency.json").read_text())
    assert repeated["rows"] == result["rows"]


def test_recorded_times_of_the_filter_and_the_solvers() -> None:
    recorded = latency.record("T2", 12)
    assert list(recorded) == ["ekf", *latency.SOLVERS]
    for times in recorded.values():
        assert len(times) == 65
        assert 0.0 < times[0] <= times[-1]
    assert recorded["lpv-nmpc"][32] < recorded["lpv-nmpc-ipopt"][32]


def test_no_table_of_what_is_left_where_cases_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ablation, "GROUPS", {})
    monkeypatch.setattr(ablation, "ALL_BUT", {})
    faulty = tmp_path / "faulty.py"
    faulty.write_text(
        "class Faulty:\n"
        "    def __init__(self, task): pass\n"
        "    def predict(self, *arguments, **settings): raise ArithmeticError('no idea')\n"
    )
    command = ["ablation", "--agent", f"{faulty}:Faulty", "--trajectories", "u-turn", "--seeds",
               "1", "--workers", "1", "--out", str(tmp_path / "out")]  # fmt: skip
    assert cli.main(command) == 1
    assert capsys.readouterr().out.count("no idea") >= 4
    assert not (tmp_path / "out" / "ablation.json").exists()


def test_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = tmp_path / "times.json"
    wrong.write_text('{"ekf": [0.1]}')
    out = ["--out", str(tmp_path / "out")]
    assert cli.main(["latency", "--times", str(wrong), *out]) == cli.EXIT_USAGE
    assert "does not hold recorded times" in capsys.readouterr().err
    assert cli.main(["latency", "--seeds", "0", *out]) == cli.EXIT_USAGE
    assert "--seeds must be a whole number" in capsys.readouterr().err
    assert cli.main(["ablation", "--agent", "nobody", *out]) == cli.EXIT_USAGE
    assert "unknown agent 'nobody'" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["ablation", "latency"])
def test_help_has_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert ended.value.code == 0
    assert f"example: lpv-track {command} " in capsys.readouterr().out
