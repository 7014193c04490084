"""The command `lpv-track`: what it writes, how it resumes, what it says when it cannot."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pygame
import pytest

import trajectories
from experiments.cli import main, parser
from experiments.run.store import ResultStore

COMMAND = [sys.executable, "-m", "experiments"]
COMMANDS = list(parser()._subparsers._group_actions[0].choices)  # type: ignore[union-attr]
SMALL = ["--agents", "stanley", "pid", "--trajectories", "u-turn", "straight"]
ONE = ["--agents", "stanley", "--trajectories", "u-turn", "--workers", "1"]
# Enough cases for a run to be caught in the middle of it.
LONG = [
    "--agents", "stanley", "pure-pursuit", "pid", "--trajectories", "T2", "T4", "sine", "circle",
]  # fmt: skip


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a small benchmark; the tests work on copies."""
    folder = tmp_path_factory.mktemp("cli") / "small"
    assert main(["benchmark", *SMALL, "--workers", "1", "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def copy(small: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small, tmp_path / "results"))


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the report out where it is not what is tested: it takes a second."""
    monkeypatch.setattr(
        "experiments.report.build.write_report", lambda folder, _: folder / "cases.jsonl"
    )


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "cases.jsonl").read_text().splitlines()]


def outcome(folder: Path) -> dict[str, Any]:
    """Return the part of results that depends on neither time nor place: no times, no order."""
    found = lines(folder)
    assert len({case["id"] for case in found}) == len(found)
    return {case["id"]: (case["status"], case["end"], case["metrics"]) for case in found}


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Message of a command that ends with 2 and one line."""
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("lpv-track: ")
    assert said.count("\n") == 1
    assert "Traceback" not in said
    return said


def test_help_of_the_root() -> None:
    done = subprocess.run(
        [*COMMAND, "--help"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0
    assert "example: lpv-track" in done.stdout
    assert all(command in done.stdout for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    assert f"example: lpv-track {command}" in capsys.readouterr().out


def test_a_benchmark_writes_its_cases_its_manifest_and_its_report(small: Path) -> None:
    cases = lines(small)
    assert len(cases) == 4
    assert {case["status"] for case in cases} == {"ok"}
    assert {case["end"] for case in cases} == {"finished"}
    for case in cases:
        assert {"id", "agent", "trajectory", "vehicle", "conditions", "seed"} <= set(case)
        assert {"max_cte", "ale", "steering_variation"} <= set(case["metrics"])
        assert {"median", "p99", "max", "failures"} <= set(case["solver"])
        assert (small / "traces" / f"{case['id']}.npz").is_file()
    manifest = json.loads((small / "manifest.json").read_text())
    assert {"revision", "versions", "settings", "hardware", "command"} <= set(manifest)
    assert manifest["versions"]["numpy"] == np.__version__
    assert manifest["settings"]["cases"] == [case["id"] for case in cases]
    assert manifest["settings"]["agents"] == ["stanley", "pid"]
    assert "</html>" in (small / "report.html").read_text()
    assert not list(small.rglob("*.tmp"))


@pytest.mark.usefixtures("no_report")
def test_resume_runs_nothing_that_is_there(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (copy / "cases.jsonl").read_bytes()
    assert main(["benchmark", *SMALL, "--workers", "1", "--out", str(copy), "--resume"]) == 0
    assert (copy / "cases.jsonl").read_bytes() == before
    assert "4 of 4 cases are in" in " ".join(capsys.readouterr().out.split())


def test_without_resume_a_folder_of_results_is_refused(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (copy / "cases.jsonl").read_bytes()
    said = refused(capsys, "benchmark", *SMALL, "--workers", "1", "--out", str(copy))
    assert "--resume" in said
    assert (copy / "cases.jsonl").read_bytes() == before


def test_two_workers_give_what_one_gives(small: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [*COMMAND, "benchmark", *SMALL, "--workers", "2", "--out", str(tmp_path / "two")],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    # Where nothing is in numba's cache yet, workers say that they compile.
    assert not [line for line in done.stderr.splitlines() if "compiling" not in line]
    assert str(tmp_path / "two" / "report.html") in done.stdout
    assert outcome(tmp_path / "two") == outcome(small)


@pytest.mark.usefixtures("no_report")
def test_names_given_twice_run_once(small: Path, tmp_path: Path) -> None:
    twice = ["--agents", "stanley", "stanley", "--trajectories", "u-turn", "u-turn"]
    assert main(["benchmark", *twice, "--workers", "1", "--out", str(tmp_path / "twice")]) == 0
    (key,) = outcome(tmp_path / "twice")
    assert outcome(tmp_path / "twice")[key] == outcome(small)[key]


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("kept", [2, 0])
def test_a_torn_last_line_is_run_again(small: Path, copy: Path, kept: int) -> None:
    whole = (copy / "cases.jsonl").read_bytes().splitlines(keepends=True)
    torn = whole[kept][: len(whole[kept]) // 2]
    (copy / "cases.jsonl").write_bytes(b"".join(whole[:kept]) + torn)
    assert main(["benchmark", *SMALL, "--workers", "1", "--out", str(copy), "--resume"]) == 0
    assert outcome(copy) == outcome(small)


def test_a_damaged_line_is_named(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (copy / "cases.jsonl").read_bytes().splitlines(keepends=True)
    (copy / "cases.jsonl").write_bytes(b"".join([whole[0], b"\0\0\0\n", *whole[1:]]))
    assert main(["report", str(copy)]) == 0
    message = "cases.jsonl, line 2: is not JSON"
    shown = "".join(capsys.readouterr().out.split("\n"))
    assert f"left out: {copy}/{message}" in shown
    assert message in (copy / "report.html").read_text()


def begin(folder: Path, workers: int) -> subprocess.Popen[str]:
    """A long benchmark in a process group of its own, two cases done."""
    process = subprocess.Popen(
        [*COMMAND, "benchmark", *LONG, "--workers", str(workers), "--out", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    until = time.monotonic() + 60
    while time.monotonic() < until:
        if (folder / "cases.jsonl").exists() and len(ResultStore(folder).cases()) >= 2:
            return process
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)
    process.kill()
    raise TimeoutError("no case ended within a minute")


def workers_of(parent: int) -> list[int]:
    found = []
    for entry in Path("/proc").glob("[0-9]*"):  # nothing where there is no /proc
        try:
            stat = entry.joinpath("stat").read_text().rpartition(")")[2].split()
            command = entry.joinpath("cmdline").read_bytes()
        except OSError:
            continue
        if int(stat[1]) == parent and b"spawn_main" in command:
            found.append(int(entry.name))
    return found


def runs(process: int) -> bool:
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] not in "ZX"


def wait_until(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


@pytest.mark.usefixtures("no_report")
def test_after_kill_9_resume_ends_with_every_case_once(tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    process = begin(folder, workers=2)
    workers = workers_of(process.pid)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)
    before = ResultStore(folder).cases()
    assert 2 <= len(before) < 12
    # Its workers notice and end too.
    wait_until(lambda: not any(map(runs, workers)))
    assert main(["benchmark", *LONG, "--workers", "1", "--out", str(folder), "--resume"]) == 0
    after = outcome(folder)
    assert len(after) == 12
    assert {status for status, _, _ in after.values()} == {"ok"}
    assert {case["id"] for case in before} < set(after)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert set(manifest["settings"]["cases"]) == set(after)


def test_ctrl_c_ends_with_130_and_one_line(tmp_path: Path) -> None:
    process = begin(tmp_path / "interrupted", workers=2)
    workers = workers_of(process.pid)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "--resume" in out
    assert "Traceback" not in out + err
    wait_until(lambda: not any(map(runs, workers)))


@pytest.mark.parametrize("command", ["benchmark", "drive"])
def test_ctrl_c_that_a_solver_takes_for_its_own_failure_counts(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As CasADi does. A case that went on with such a failure is not a result."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    agent = tmp_path / "swallowing.py"
    agent.write_text(
        "import os, signal\n"
        "from agents.classical.geometric import Stanley\n"
        "class Swallowing(Stanley):\n"
        "    def control(self, observation, memory):\n"
        "        try:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "        except KeyboardInterrupt:\n"
        "            pass\n"
        "        return super().control(observation, memory)\n"
    )
    out = tmp_path / "out"
    arguments = {
        "benchmark": ["--agents", f"{agent}:Swallowing", "--trajectories", "u-turn",
                      "--workers", "1", "--out", str(out)],
        "drive": ["--agent", f"{agent}:Swallowing", "--trajectory", "u-turn",
                  "--frames", str(tmp_path / "frames"), "--every", "1000"],
    }  # fmt: skip
    before = signal.getsignal(signal.SIGINT)
    assert main([command, *arguments[command]]) == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert not ResultStore(out).cases()


def test_report_is_rebuilt_from_saved_cases_alone(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / "report.html").unlink()
    assert main(["report", str(copy)]) == 0
    first = (copy / "report.html").read_bytes()
    assert str(copy / "report.html") in capsys.readouterr().out
    assert main(["report", str(copy)]) == 0
    assert (copy / "report.html").read_bytes() == first
    assert sorted(path.name for path in copy.iterdir()) == [
        ".lock", "cases.jsonl", "manifest.json", "report.html", "traces",
    ]  # fmt: skip


def test_report_without_results_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no results in" in refused(capsys, "report", str(tmp_path))
    assert "is not a folder" in refused(capsys, "report", str(tmp_path / "missing"))
    assert not (tmp_path / "missing").exists()


@pytest.mark.parametrize(
    ("arguments", "unknown", "nearest"),
    [
        (["--agents", "stanly"], "agent 'stanly'", "stanley"),
        (["--agents", "stanley", "--trajectories", "U-trun"], "trajectory 'U-trun'", "u-turn"),
        (["--agents", "stanley", "--vehicles", "m2-bus"], "vehicle 'm2-bus'", "m2-minibus"),
        (["--agents", "stanley", "--suite", "papr"], "suite 'papr'", "paper"),
        ([*ONE, "--env", "inital_error_range=3"], "environment setting", "initial_error_range"),
        ([*ONE, "--agent-set", "gian=3"], "setting 'gian'", "gain"),
        ([*ONE, "--vehicle-set", "mas=3"], "vehicle field 'mas'", "mass"),
    ],
)
def test_unknown_names_list_the_known_and_the_nearest(
    arguments: list[str], unknown: str, nearest: str,
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    said = refused(capsys, "benchmark", *arguments, "--out", str(tmp_path / "out"))
    assert unknown in said
    assert "known: " in said
    assert f"nearest: {nearest}" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([*ONE, "--env", "time_limit"], "'time_limit' is not KEY=VALUE"),
        ([*ONE, "--env", "time_limit=Infinity"], "Infinity is no number"),
        ([*ONE, "--seeds", "0"], "--seeds must be a whole number from 1 to 10,000, not 0"),
        ([*ONE, "--workers", "0"], "--workers must be a whole number from 1 to 1,024, not 0"),
        (["--agents", "stanley", "--trajectories", "none.csv"], "none.csv"),
        (["--agents", "stanley", "--vehicles", "none.json"], "none.json"),
        (["--agents", "no.such:Agent"], "cannot be loaded"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    arguments: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(capsys, "benchmark", *arguments, "--out", str(tmp_path / "out"))
    assert reason in said
    assert not (tmp_path / "out").exists()


def test_an_unwritable_folder_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    for out in ("file", "file/below"):
        assert "file" in refused(capsys, "benchmark", *ONE, "--out", str(tmp_path / out))


def test_refusals_reach_the_shell() -> None:
    done = subprocess.run(
        [*COMMAND, "benchmark", "--agents", "stanly"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("lpv-track: unknown agent 'stanly'; known: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.usefixtures("no_report")
def test_initial_errors_differ_by_seed_and_repeat(tmp_path: Path) -> None:
    errors = ["--env", "initial_error_range=[0.3,0.1,0.5]", "--seeds", "2"]
    for folder in ("one", "two"):
        assert main(["benchmark", *ONE, *errors, "--out", str(tmp_path / folder)]) == 0
    first = outcome(tmp_path / "one")
    assert outcome(tmp_path / "two") == first
    zero, one = (metrics for _, _, metrics in first.values())
    assert zero["max_cte"] != one["max_cte"]
    starts = [
        ResultStore(tmp_path / "one").trace(key)["lateral_error"][0]  # type: ignore[index]
        for key in first
    ]
    assert all(0.0 < abs(start) <= 0.3 for start in starts)


@pytest.mark.usefixtures("no_report")
def test_the_fixed_speed_mode_runs(tmp_path: Path) -> None:
    out = tmp_path / "fixed"
    assert main(["benchmark", *ONE, "--speed-modes", "fixed", "--out", str(out)]) == 0
    (case,) = lines(out)
    assert (case["speed_mode"], case["status"], case["end"]) == ("fixed", "ok", "finished")
    speeds = ResultStore(out).trace(case["id"])["reference_speed"]  # type: ignore[index]
    np.testing.assert_allclose(speeds, speeds[0])


@pytest.mark.usefixtures("no_report")
def test_a_changed_file_is_another_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trajectories", "straight", "--write", str(tmp_path)]) == 0
    file, out = tmp_path / "straight.csv", str(tmp_path / "out")
    run = ["benchmark", "--agents", "stanley", "--trajectories", str(file), "--workers", "1"]
    assert main([*run, "--out", out]) == 0
    assert main([*run, "--out", out, "--resume"]) == 0
    assert len(lines(tmp_path / "out")) == 1
    assert main(["trajectories", "u-turn", "--write", str(tmp_path)]) == 0
    (tmp_path / "u-turn.csv").replace(file)
    assert main([*run, "--out", out, "--resume"]) == 0
    straight, turn = (case["metrics"]["duration"] for case in lines(tmp_path / "out"))
    assert straight != turn


def test_drive_writes_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = tmp_path / "frames"
    command = ["drive", "--agent", "stanley", "--trajectory", "u-turn", "--frames", str(frames)]
    assert main([*command, "--every", "40"]) == 0
    said = capsys.readouterr().out
    assert "finished" in said
    files = sorted(frames.iterdir())
    assert len(files) > 5
    assert f"{len(files)} frames" in said
    assert {file.suffix for file in files} == {".png"}
    pictures = [pygame.surfarray.array3d(pygame.image.load(file)) for file in files]
    for picture in pictures:
        assert picture.shape == (900, 600, 3)
        assert picture.mean() > 50
        assert picture.std() > 5
    assert not np.array_equal(pictures[0], pictures[-1])


def test_drive_starts_where_it_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["drive", "--agent", "stanley", "--trajectory", "straight", "--frames", "unused"]
    assert "at -3 m/s" in refused(capsys, *command, "--start", "speed=-3")
    assert "nearest: arc_length" in refused(capsys, *command, "--start", "arc_lenth=3")


def test_drive_refuses_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "nearest: stanley" in refused(capsys, "drive", "--agent", "stanly")
    command = ["drive", "--agent", "stanley", "--trajectory", "u-turn"]
    assert "preview_steps" in refused(capsys, *command, "--env", "preview_step=3")
    assert "--every must be" in refused(capsys, *command, "--every", "0")
    (tmp_path / "file").touch()
    assert "file" in refused(capsys, *command, "--frames", str(tmp_path / "file"))


HOSTILE: dict[str, list[str]] = {
    "cases without end": ["--seeds", "99999999999"],
    "workers without end": ["--workers", "1000000000"],
    "digits": ["--seeds", "1" * 5000],
    "preview without end": ["--env", "preview_steps=100000000"],
    "no time": ["--control-period", "1e-12"],
    "no number": ["--control-period", "nan"],
    "long": ["--vehicles", "x" * 500_000],
    "long lines": ["--agents", "a b\n" * 100_000],
    "long option": ["--no-" + "x" * 500_000],
    "long setting": ["--env", "plant=" + "x" * 500_000],
    "deep setting": ["--env", "plant=" + "[" * 100_000],
    "escape": ["--suite", "\x1b[2J"],
    "no folder": ["--out", ""],
    "nul": ["--out", "a\0b"],
    "dashes": ["--control-period=--"],
    "dashes among names": ["--agents=--"],
}


@pytest.mark.parametrize("arguments", HOSTILE.values(), ids=HOSTILE)
def test_hostile_values_are_refused_at_once(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    began = time.monotonic()
    small = ["benchmark", "--agents", "stanley", "--out", str(tmp_path / "out")]
    small += [] if "--suite" in arguments else ["--trajectories", "u-turn"]
    said = refused(capsys, *small, *arguments)
    assert len(said) < 400
    assert said.strip().isprintable()
    assert time.monotonic() - began < 20.0
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize(
    ("streams", "codes", "said"),
    [
        (">&-", {0}, ""),
        (">&- 2>&-", {0}, ""),
        ("<&-", {0}, ""),
        (">/dev/full", {2}, "No space left on device"),
        ("| true", {0, 1}, ""),
    ],
)
def test_streams_that_cannot_be_used_end_in_one_line(
    streams: str, codes: set[int], said: str
) -> None:
    line = shlex.join([*COMMAND, "trajectories", "u-turn"])
    done = subprocess.run(
        ["bash", "-c", f"{line} {streams}; exit ${{PIPESTATUS[0]}}"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode in codes
    assert said in done.stderr
    assert done.stderr.count("\n") == bool(said)


def test_any_terminal_can_print_the_tables() -> None:
    done = subprocess.run(
        [*COMMAND, "trajectories", "u-turn"], capture_output=True, timeout=60, check=False,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    assert done.returncode == 0
    assert b"u-turn" in done.stdout
    assert done.stderr == b""


def test_drive_without_any_display_is_one_line() -> None:
    done = subprocess.run(
        [*COMMAND, "drive", "--agent", "stanley", "--trajectory", "u-turn"],
        capture_output=True, text=True, timeout=60, check=False,
        env={**os.environ, "SDL_VIDEODRIVER": "no-such-driver"},
    )  # fmt: skip
    assert done.returncode == 2
    assert "display" in done.stderr
    assert done.stderr.count("\n") == 1


def test_trajectories_are_drawn_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture, folder = tmp_path / "paths.png", tmp_path / "paths"
    command = ["trajectories", "u-turn", "--draw", str(picture), "--write", str(folder)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    row = next(line for line in printed.splitlines() if "u-turn" in line)
    assert [cell.strip() for cell in row.strip("│").split("│")][1:2] == ["achieved"]
    assert "published" not in printed
    assert pygame.surfarray.array3d(pygame.image.load(picture)).std() > 5
    (file,) = folder.iterdir()
    path, original = trajectories.load(str(file)), trajectories.load("u-turn")
    np.testing.assert_allclose(path.x, original.x, atol=1e-6)
    np.testing.assert_allclose(path.curvature, original.curvature, atol=1e-6)
    np.testing.assert_allclose(path.speed, original.speed, atol=1e-6)
    # The written file can be given instead of a name.
    assert main(["trajectories", str(file)]) == 0


def test_a_plan_is_written_and_driven_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, plan = "random-limit-0", ["--plan", "grip=0.4", "max_speed=18", "end_speed=4"]
    command = ["trajectories", name, "--section", "100", "400", *plan, "--write", str(tmp_path)]
    assert main(command) == 0
    file = tmp_path / f"{name}-100-400.csv"
    path, own = trajectories.load(file), trajectories.load(name).metadata["limits"]
    assert path.length == pytest.approx(300.0, abs=0.3)
    assert path.metadata["limits"]["max_lateral_acceleration"] == pytest.approx(0.4 * 9.81)
    assert path.metadata["limits"]["max_total_acceleration"] == pytest.approx(0.4 * 9.81)
    assert path.metadata["limits"]["max_jerk"] == own["max_jerk"]
    lateral = (path.speed**2 * np.abs(path.curvature)).max()
    assert lateral == pytest.approx(0.4 * 9.81, rel=0.02)
    assert path.speed[[0, -1]] == pytest.approx(4.0)
    run = ["benchmark", "--agents", "stanley", "--trajectories", str(file), "--workers", "1"]
    assert main([*run, "--out", str(tmp_path / "out")]) == 0
    (case,) = ResultStore(tmp_path / "out").cases()
    trace = ResultStore(tmp_path / "out").trace(case["id"])
    assert trace is not None
    wanted = path.sample(trace["arc_length"]).speed
    np.testing.assert_allclose(trace["reference_speed"], wanted, atol=1e-9)
    capsys.readouterr()
    for setting, words in (
        ("gripp=0.7", "nearest: grip"), ("grip=x", "grip must be"),
        ("max_jerk=-1", "max_jerk must be"), ("max_speed", "is not KEY=VALUE"),
    ):  # fmt: skip
        assert words in refused(capsys, "trajectories", "T2", "--plan", setting)
    both = ("grip=0.5", "max_lateral_acceleration=3")
    assert "not both" in refused(capsys, "trajectories", "T2", "--plan", *both)


def test_a_plan_for_a_vehicle_is_the_one_it_is_driven_at(tmp_path: Path) -> None:
    """`--plan vehicle=...` writes the profile of the speed mode grip."""
    plan = ["--plan", "vehicle=bmw-320i", "grip=0.6", "friction=0.8"]
    assert main(["trajectories", "T4", *plan, "--write", str(tmp_path)]) == 0
    speed = ["--grip", "0.6", "--conditions", "ideal", "--conditions-set", "friction=0.8"]
    command = ["benchmark", "--agents", "stanley", "--vehicles", "bmw-320i", "--trajectories", "T4"]
    assert main([*command, *speed, "--workers", "1", "--out", str(tmp_path / "out")]) == 0
    (case,) = ResultStore(tmp_path / "out").cases()
    assert (case["speed_mode"], case["grip"], case["end"]) == ("grip", 0.6, "finished")
    assert 0.5 < case["metrics"]["grip_used_max"] < 0.7
    trace = ResultStore(tmp_path / "out").trace(case["id"])
    assert trace is not None
    assert set(trace["friction"]) == {0.8}
    wanted = trajectories.load(tmp_path / "T4.csv").sample(trace["arc_length"]).speed
    np.testing.assert_allclose(trace["reference_speed"], wanted, atol=1e-9)


def test_the_published_rows_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trajectories", "T2", "T4-raw"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [
        [cell.strip() for cell in line.strip("│").split("│")]
        for line in lines
        if "published" in line or "achieved" in line
    ]
    assert rows[0] == ["T2", "published", "7.79", "2.01", "1.50", "513.2", "2.790", "24.49", ""]
    assert rows[1][:6] == ["", "achieved", "7.79", "2.01", "1.50", "513.2"]
    assert rows[1][6:8] == ["0.100", "24.49"]
    assert rows[3][6:8] == rows[2][6:8] == ["4.000", "44.00"]
    assert "nearest: T2" in refused(capsys, "trajectories", "T22")
