"""`lpv-track highway`, at a small size."""

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("highway_env")

from experiments.cli import main
from experiments.run.case import run_case
from experiments.run.traffic import TrafficCase

SMALL = ["--env", "time_limit=2.0", "--seeds", "2", "--workers", "1"]


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "cases.jsonl").read_text().splitlines()]


def test_agents_and_highway_envs_own_beside_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    folder = tmp_path / "out"
    command = ["highway", "--agents", "stanley", "idm", "--out", str(folder), *SMALL]
    assert main(command) == 0
    told = capsys.readouterr().out
    assert "stanley" in told
    assert "0 (<84%)" in told  # 1 - 0.025^(1/2), Clopper and Pearson
    results = lines(folder)
    assert {(one["agent"], one["seed"]) for one in results} == {
        (agent, seed) for agent in ("stanley", "idm") for seed in (0, 1)
    }
    for one in results:
        assert one["status"] == "ok"
        assert one["error"] is None
        assert one["end"] == "time_limit"
        assert one["metrics"]["duration"] == pytest.approx(2.0)
        assert one["metrics"]["lateral_max"] < 0.5
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["versions"]["highway-env"]
    # Again: nothing is left to drive; one seed more is driven alone.
    assert main(command) == 0
    assert lines(folder) == results
    assert main([*command[:-3], "3", *command[-2:]]) == 0
    assert len(lines(folder)) == 6


@pytest.mark.parametrize("agent", ["lpv-nmpc", "idm"])
def test_a_drive_is_its_spec(agent: str) -> None:
    spec = {"agent": agent, "seed": 3, "env_settings": {"time_limit": 3.0, "other_vehicles": 5}}
    once, again = run_case(spec, TrafficCase), run_case(spec, TrafficCase)
    for one in (once, again):
        del one["seconds"]
        one["metrics"].pop("predict_median", None)
    assert once == again
    assert once["metrics"]["progress"] > 10.0
    other = TrafficCase(**{**spec, "seed": 4})
    assert other.id != once["id"]


def test_a_lap_of_highway_envs_own_ends_where_ours_does() -> None:
    settings = {"other_vehicles": 0}
    results = [
        run_case({"agent": agent, "scene": "racetrack-oval", "env_settings": settings}, TrafficCase)
        for agent in ("idm", "stanley")
    ]
    assert [one["end"] for one in results] == ["finished", "finished"]
    own, ours = (one["metrics"] for one in results)
    assert own["progress"] == pytest.approx(ours["progress"], abs=1.5)
    assert own["lateral_rms"] > ours["lateral_rms"]


def test_a_video_of_two_agents(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    file = tmp_path / "lap.mp4"
    main(["highway", "--agents", "stanley", "idm", "pid", "--video", str(file), *SMALL])
    assert "stanley on racetrack: time_limit" in capsys.readouterr().out
    reader = imageio_ffmpeg.read_frames(str(file))
    assert next(reader)["size"] == (1800, 600)
    frames = list(reader)
    assert len(frames) >= 40
    assert frames[0] != frames[30]
    assert max(frames[0]) > 0


def test_a_drive_that_breaks_down_is_a_failed_one(tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_text(
        "from agents import TrackingAgent\n\n\n"
        "class Broken(TrackingAgent[None]):\n"
        "    def new_memory(self):\n        return None\n\n"
        "    def control(self, observation, memory):\n        raise RuntimeError('no idea')\n"
    )
    result = run_case({"agent": f"{file}:Broken"}, TrafficCase)
    assert result["status"] == "failed"
    assert result["error"] == "RuntimeError: no idea"
    assert result["others"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scene", "racetrak"], "nearest: racetrack"),
        (["--seeds", "0"], "--seeds must be a whole number"),
        (["--agents", "stanly"], "unknown agent 'stanly'"),
        (["--env", "lapss=2"], "lapss"),
        (["--scene", "roundabout", "--laps", "2"], "laps must be exactly 1"),
        (["--conditions", "rain"], "rain"),
    ],
)
def test_mistakes_are_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["highway", "--out", str(tmp_path / "none"), *arguments]) == 2
    told = capsys.readouterr().err.strip()
    assert message in told
    assert "\n" not in told
    assert not (tmp_path / "none").exists()
