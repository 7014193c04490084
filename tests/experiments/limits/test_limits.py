"""Limits of lane changes and laps: their checks, the shipped table, the command."""

import json
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

import trajectories
from experiments.cli import main
from experiments.limits import compute, lane_changes, laps
from experiments.limits.compute import Found
from experiments.limits.figures import draw
from experiments.run import physical_limits as table
from experiments.run.physical_limits import Limit, LimitCase, limit_of
from lpv_track_env.bicycle import VX
from lpv_track_env.vehicle import load

CASE = LimitCase("iso-3888-2-1.61", "bmw-320i", 0.9)


@pytest.fixture(scope="module")
def found() -> Iterator[Found]:
    """Limit of a lane change with nodes 1 m apart."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lane_changes, "SPACING", 1.0)
        yield compute.compute(CASE)


def test_an_entry_speed_is_shown_by_its_replay_and_by_what_is_beyond(found: Found) -> None:
    limit, motion = found
    assert limit.kind == "entry speed"
    assert limit.shown
    # Held over 1 m in place of 0.5 m the inputs reach a little less than in the shipped table.
    assert limit.value == pytest.approx(21.3, abs=0.15)
    assert motion.state[0, VX] == pytest.approx(limit.value)
    assert limit.starts == 3
    assert -0.1 < limit.beyond < -0.005
    # An environment's start, and actuators within their limits.
    car = load("bmw-320i")
    np.testing.assert_allclose(motion.state[0, 1:], 0.0, atol=1e-12)
    rates = np.diff(motion.inputs, axis=0, prepend=[[car.rolling_deceleration, 0.0]])
    most = np.outer(motion.steps, [car.max_jerk, car.max_steering_rate])
    assert (np.abs(rates) <= most + 1e-7).all()


def test_a_lap_is_shown_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small one: a circle, where the corridor lets the vehicle drive on a smaller one."""
    monkeypatch.setattr(laps, "PERIOD", 0.2)
    limit, motion = compute.compute(LimitCase("circle", "bmw-320i", 0.6))
    assert limit.kind == "lap time"
    assert limit.shown
    assert limit.replayed == pytest.approx(0.5, abs=0.02)
    assert motion.time[-1] == pytest.approx(limit.value)


def test_paths_without_cones_or_seam_have_no_limit() -> None:
    with pytest.raises(ValueError, match="'sine' has no cones and is not closed"):
        compute.compute(LimitCase("sine", "bmw-320i", 0.9))


def test_shipped_limits_are_shown_and_of_the_present_paths() -> None:
    limits = table.read()
    assert {limit.case for limit in limits} == set(table.CASES)
    for limit in limits:
        assert limit.shown, limit.case
        assert limit.path_digest == table.digest(trajectories.load(limit.case.path)), limit.case


def test_limits_are_looked_up() -> None:
    limit = limit_of("iso-3888-2-1.61", "bmw-320i", 0.9)
    assert limit == pytest.approx(21.316, abs=0.02)
    assert limit_of("iso-3888-1-2", "m2-minibus", 0.9) == limit_of(
        "iso-3888-1-2.0", "m2-minibus", 0.9, corridor=3.0
    )
    held = limit_of("iso-3888-2-1.61", "bmw-320i", 0.9, kept=0.95)
    assert held is not None
    assert 0.9 < held / 21.316 < 1.0
    lap = table.LAPS[0]
    assert limit_of(lap.path, lap.vehicle, lap.friction, 0.5) == pytest.approx(33.59, abs=0.01)
    assert limit_of(lap.path, lap.vehicle, lap.friction, 0.4) is None
    assert limit_of("iso-3888-2-1.61", "bmw-320i", 0.8) is None


def made(path: str, **changes: object) -> Limit:
    """A limit that nobody has computed."""
    case = LimitCase(path, "bmw-320i", 0.9)
    values = {
        "case": case, "kind": "entry speed", "value": 20.0, "replayed": 0.001, "beyond": -0.02,
        "starts": 3, "nodes": 10, "iterations": 5, "seconds": 1.0,
        "path_digest": table.digest(trajectories.load(path)),
    }  # fmt: skip
    return Limit(**{**values, **changes})  # type: ignore[arg-type]


def test_a_limit_is_shown_only_by_both_checks() -> None:
    assert made("iso-3888-1-1.61").shown
    assert not made("iso-3888-1-1.61", replayed=-0.001).shown
    assert not made("iso-3888-1-1.61", beyond=0.001).shown
    assert not made("iso-3888-1-1.61", starts=0).shown
    lap = {"kind": "lap time", "replayed": 0.499, "beyond": 0.6}
    assert made("circle", **lap).shown
    assert not made("circle", **{**lap, "replayed": 0.51}).shown
    assert not made("circle", **{**lap, "beyond": 0.49}).shown


def test_tables_come_back_from_their_file(tmp_path: Path) -> None:
    file = tmp_path / "limits.json"
    limits = [made("iso-3888-1-1.61"), made("circle", kind="lap time", value=12.0)]
    table.write(limits, file)
    assert table.read(file) == limits
    assert {"command", "revision", "versions", "hardware"} <= json.loads(file.read_text()).keys()
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "format": "other"}))
    with pytest.raises(ValueError, match="format 'other' is not known"):
        table.read(file)


def test_the_command_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    found: Found,
) -> None:  # fmt: skip
    computed = []

    def stand_in(case: LimitCase, progress: compute.Progress) -> Found:
        progress("")
        computed.append(case.path)
        if len(computed) == 2:
            raise KeyboardInterrupt
        return Found(msgspec.structs.replace(found.limit, case=case), found.motion)

    monkeypatch.setattr(compute, "compute", stand_in)
    monkeypatch.setenv("COLUMNS", "160")
    file = tmp_path / "limits.json"
    command = ["limits", "iso-3888-2-1.61", "iso-3888-2-1.7", "--out", str(file)]
    assert main(command) == 130
    assert [limit.case.path for limit in table.read(file)] == ["iso-3888-2-1.61"]
    assert main(command) == 0
    assert computed == ["iso-3888-2-1.61", "iso-3888-2-1.7", "iso-3888-2-1.7"]
    assert f"{found.limit.value:.3f} m/s" in capsys.readouterr().out
    assert main(["limits", "sine", "--friction", "7"]) == 2


def test_motions_are_drawn(found: Found, tmp_path: Path) -> None:
    draw(found, tmp_path / "change.png")
    assert (tmp_path / "change.png").read_bytes().startswith(b"\x89PNG")
