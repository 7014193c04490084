"""`lpv-track speed`: its files, its ratios, and its messages when a package is missing."""

import importlib
import json
import resource
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rich.text import Text

import agents
import trajectories
from experiments import cli
from experiments.commands.options import EXIT_INTERRUPTED
from experiments.commands.speed import FORMAT, SECTIONS
from experiments.speed import display, environments, measure, processes, solvers
from experiments.speed.measure import (
    COLD_START,
    FULL,
    PREDICT,
    QUICK,
    WINDOW_MEDIAN,
    Comparison,
    Section,
    Series,
    Tick,
    Unavailable,
    calibrated,
    interleave,
)

MEASURED = ["single", "vector", "solvers", "batches", "loops", "tuning", "rendering"]


def quietly(text: str) -> None:
    """Show no progress."""


def speed(folder: Path, *arguments: str) -> int:
    return cli.main(["speed", "--quick", "--out", str(folder), *arguments])


def read(folder: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((folder / "speed.json").read_text())
    return result


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("speed") / "tiny"
    assert speed(folder, "--only", *MEASURED) == 0
    return folder


def shown(result: dict[str, Any]) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        display.show(result, console)
    return capture.get()


# Written files -------------------------------------------------------------------------------


def test_the_json_holds_every_round_the_machine_and_the_settings(tiny: Path) -> None:
    result = read(tiny)
    assert result["format"] == FORMAT
    assert result["complete"] is True
    assert list(result["sections"]) == MEASURED
    assert result["settings"]["rounds"] == QUICK.rounds
    assert result["settings"]["quick"] is True
    machine = result["machine"]
    assert {"processor", "cores", "versions", "revision", "threads"} <= set(machine)
    assert machine["versions"]["numpy"] == np.__version__
    assert len(machine["load_average_before"]) == len(machine["load_average_after"]) == 3
    for section in result["sections"].values():
        assert section["seconds"] > 0
        assert section["series"]
        for series in section["series"]:
            rounds = series["rounds"]
            assert rounds
            assert min(rounds) > 0
            assert series["median"] == np.median(rounds)
            assert (series["min"], series["max"]) == (min(rounds), max(rounds))
    names = [series["name"] for series in result["sections"]["single"]["series"]]
    assert names[:3] == ["lpv-track-env", "CartPole-v1", "Pendulum-v1"]
    for series in result["sections"]["single"]["series"]:
        assert len(series["rounds"]) == QUICK.rounds
    assert not list(tiny.rglob("*.tmp"))


def test_ratios_are_those_of_the_raw_rounds(tiny: Path) -> None:
    checked = 0
    for section in read(tiny)["sections"].values():
        for ratio in section["ratios"]:
            ours, other = (
                next(
                    series["rounds"]
                    for series in section["series"]
                    if series["name"] == ratio[side]
                    and series["settings"] == ratio["settings"][side]
                    and series["unit"] == ratio["unit"]
                )
                for side in ("ours", "other")
            )
            wanted = np.array(other) / np.array(ours)
            np.testing.assert_allclose(ratio["rounds"], wanted, rtol=1e-12)
            assert ratio["median"] == pytest.approx(np.median(wanted), rel=1e-12)
            assert ratio["min"] == pytest.approx(wanted.min(), rel=1e-12)
            checked += 1
    assert checked >= 2


def test_solvers_are_timed_solve_by_solve(tiny: Path) -> None:
    series = read(tiny)["sections"]["solvers"]["series"]
    windows = QUICK.windows * len(QUICK.trajectories)
    for name in dict.fromkeys(one["name"] for one in series):
        rounds = {one["unit"]: one["rounds"] for one in series if one["name"] == name}
        assert len(rounds[COLD_START]) == windows
        warm = np.array(rounds[PREDICT]).reshape(windows, QUICK.window - 1)
        assert rounds[WINDOW_MEDIAN] == np.median(warm, axis=1).tolist()


def test_the_picture_is_a_png(tiny: Path) -> None:
    assert (tiny / "speed.png").read_bytes().startswith(b"\x89PNG\r\n")
    assert display.figure_of({"sections": {}, "machine": {}}) is None


def test_tables_show_every_series_and_how_busy_the_machine_was(tiny: Path) -> None:
    result = read(tiny)
    text = " ".join(shown(result).split())
    for section in result["sections"].values():
        assert section["title"] in text
        for series in section["series"]:
            if series["unit"] != WINDOW_MEDIAN:
                assert display.quantity(series["median"], series["unit"]) in text
    assert "load average over a minute" in text
    assert result["machine"]["processor"] in text
    ratio = result["sections"]["single"]["ratios"][0]
    assert f"x {ratio['median']:.3g} ({ratio['min']:.3g}..{ratio['max']:.3g})" in text


def test_a_setting_of_some_series_makes_no_rows_of_it() -> None:
    section = Section("Memory")
    section.add("one", "bytes").rounds.append(3.0)
    section.add("each", "bytes", n=64).rounds.append(5.0)
    table = display.section_table(section.as_dict())
    assert list(table.columns[0].cells) == [Text("one"), Text("each, n 64")]
    for n in (1, 4):
        section.add("grows", "bytes", n=n).rounds.append(1.0)
    section.series = section.series[2:]
    table = display.section_table(section.as_dict())
    assert [list(column.cells) for column in table.columns] == [["1", "4"], ["1 B", "1 B"]]


def test_a_busy_machine_is_said_to_be() -> None:
    machine: dict[str, Any] = {
        "processor": "P", "cores": 2, "load_average_before": [1.5, 0, 0],
        "load_average_after": [2.0, 0, 0],
    }  # fmt: skip
    assert "was busy before" in display.load({"machine": machine})
    machine["load_average_before"] = [0.2, 0, 0]
    assert "was busy before" not in display.load({"machine": machine})


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (2.0, "s", "2 s"),
        (0.0123, "s/step", "12.3 ms"),
        (5.27e-6, "s/step", "5.27 us"),
        (6.4e-11, "s", "0.064 ns"),
        (0.9996, "s", "1000 ms"),
        (3.5 * 2**20, "bytes", "3.5 MiB"),
        (612.0, "bytes", "612 B"),
        (0.0512, "share of wall time", "5.1 %"),
    ],
)
def test_quantities(value: float, unit: str, text: str) -> None:
    assert display.quantity(value, unit) == text


# Missing packages and errors ----------------------------------------------------------------


def test_a_missing_package_is_one_line_and_the_rest_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "highway_env", None)
    monkeypatch.setenv("COLUMNS", "300")
    assert speed(tmp_path, "--only", "single") == 0
    section = read(tmp_path)["sections"]["single"]
    (missing,) = section["unavailable"]
    assert missing["name"] == "highway-env lane-keeping-v0"
    assert "highway_env is not installed: pip install 'lpv-track-env[highway]'" in missing["reason"]
    assert f"left out: {missing['name']}: {missing['reason']}" in capsys.readouterr().out
    assert len(section["series"]) == 4


@pytest.mark.parametrize("name", ["gymnax", "envpool", "stable_baselines3"])
def test_a_missing_package_names_the_command_that_installs_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(Unavailable, match=f"{name} is not installed: pip install"):
        measure.module(name)


def test_an_unknown_section_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert speed(tmp_path, "--only", "vectr") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert all(name in said for name in SECTIONS)


@pytest.mark.parametrize("name", SECTIONS)
def test_every_section_has_its_function(name: str) -> None:
    module, _ = SECTIONS[name]
    assert callable(getattr(importlib.import_module(f"experiments.speed.{module}"), name))


@pytest.mark.parametrize("swallowed", [False, True])
def test_ctrl_c_keeps_what_was_measured(
    swallowed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure_one(section: Section, _effort: Any, tick: Tick) -> None:
        series = section.add("something", "s/step")
        series.rounds.append(1.5)
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            # So does CasADi within a solve.
            if not swallowed:
                raise
        tick("next")
        series.rounds.append(2.5)

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(environments, "single", measure_one)
    assert speed(tmp_path, "--only", "single", "vector") == EXIT_INTERRUPTED
    result = read(tmp_path)
    assert result["complete"] is False
    assert list(result["sections"]) == ["single"]
    assert result["sections"]["single"]["series"][0]["rounds"] == [1.5]
    assert (tmp_path / "speed.png").exists()
    assert signal.getsignal(signal.SIGINT) is before


# Measuring -----------------------------------------------------------------------------------


def test_rounds_go_in_turn() -> None:
    order: list[str] = []

    def once(name: str) -> float:
        order.append(name)
        return float(len(order))

    a, b = Series("a", "s"), Series("b", "s")
    interleave([(a, lambda: once("a")), (b, lambda: once("b"))], 3)
    assert order == ["a", "b"] * 3
    assert (a.rounds, b.rounds) == ([1.0, 3.0, 5.0], [2.0, 4.0, 6.0])


def test_a_ratio_takes_the_rounds_that_both_have() -> None:
    ours, other = Series("ours", "s", rounds=[1.0, 2.0, 4.0]), Series("b", "s", rounds=[3.0, 8.0])
    found = Comparison(ours, other).as_dict()
    assert found["rounds"] == [3.0, 4.0]
    assert (found["median"], found["min"], found["max"]) == (3.5, 3.0, 4.0)


def test_a_round_is_calibrated_to_its_length() -> None:
    counts: list[int] = []

    def run(count: int) -> float:
        counts.append(count)
        return 0.001 * count

    once = calibrated(run, 0.1)
    assert once() == pytest.approx(0.001)
    assert counts[-1] == 100
    slow = calibrated(lambda count: 5.0 * count, 0.1)
    assert slow() == 5.0


def test_a_first_time_that_compiles_does_not_shorten_the_rounds() -> None:
    counts: list[int] = []

    def run(count: int) -> float:
        counts.append(count)
        return 0.001 * count + (10.0 if len(counts) == 1 else 0.0)

    calibrated(run, 0.1)()
    assert counts[-1] == 100


def test_of_many_rounds_there_is_a_99th_percentile() -> None:
    assert "p99" not in Series("a", "s", rounds=[1.0] * 99).as_dict()
    rounds = list(np.arange(1.0, 202.0))
    assert Series("a", "s", rounds=rounds).as_dict()["p99"] == pytest.approx(199.0)


class Clock:
    """Clock that advances only when a step or a reset advances it."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


class Counted:
    """Environment with episodes of 7 steps; a step takes 1 s of its clock, a reset 1000 s."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.resets, self.steps, self.left = clock, 0, 0, 0
        self.action_space = SimpleNamespace(seed=lambda _: None, sample=lambda: 0)

    def reset(self, **_: int) -> None:
        self.clock.now += 1000.0
        self.resets, self.left = self.resets + 1, 7

    def step(self, _action: int) -> tuple[None, float, bool, bool, dict[str, Any]]:
        assert self.left > 0, "stepped after the end"
        self.clock.now += 1.0
        self.steps, self.left = self.steps + 1, self.left - 1
        return None, 0.0, self.left == 0, False, {}


def test_resets_of_single_environments_stand_outside_the_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock()
    monkeypatch.setattr(environments, "time", clock)
    env = Counted(clock)
    run = environments.single_run(env)  # type: ignore[arg-type]
    assert run(30) == 30.0
    assert env.steps == 30
    assert env.resets == 1 + 5


def test_a_recording_is_of_a_closed_loop_at_places_along_the_path() -> None:
    windows = solvers.record("T2", 2, 4)
    length = trajectories.load("T2").length
    assert [window.arc_length for window in windows] == [0.0, length / 2]
    env = solvers.environment("T2")
    driver = agents.make(solvers.DRIVER, env)
    for window in windows:
        observation, _ = env.reset(
            seed=0, options={**solvers.START, "arc_length": window.arc_length}
        )
        assert window.observations.shape == (4, 48)
        for k, seen in enumerate(window.observations):
            np.testing.assert_array_equal(seen, observation)
            action, _ = driver.predict(observation, episode_start=np.array([k == 0]))
            observation, *_ = env.step(action)


def test_rows_of_a_batch_follow_the_recording_each_from_its_place() -> None:
    seen: list[list[float]] = []

    class Agent:
        def predict(self, observation: Any, **_: Any) -> None:
            seen.append(observation[:, 0].tolist())

    stream = np.arange(8, dtype=np.float32)[:, None]
    run = solvers.batch_run(Agent(), stream, 4)  # type: ignore[arg-type]
    assert run(2) > 0
    run(1)
    assert seen == [[0, 2, 4, 6], [1, 3, 5, 7], [2, 4, 6, 0], [3, 5, 7, 1]]


# Fresh processes -----------------------------------------------------------------------------


def test_a_childs_peak_memory_is_its_own() -> None:
    _, bare = processes.child("")
    seconds, filled = processes.child("block = bytearray(b'x') * (100 * 2**20)\n")
    assert 99 * 2**20 < filled - bare < 110 * 2**20
    assert 0 < seconds < processes.LIMIT
    if sys.platform == "linux":
        assert bare < 0.5 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def test_a_childs_clock_runs_from_before_it_starts() -> None:
    began = time.perf_counter()
    seconds, _ = processes.child("import time\ntime.sleep(0.3)\n")
    assert 0.3 <= seconds <= time.perf_counter() - began


def test_a_child_that_fails_says_its_last_line() -> None:
    with pytest.raises(Unavailable, match="ValueError: no luck"):
        processes.child("raise ValueError('no luck')\n")


def test_a_cold_child_compiles_into_a_folder_of_its_own(tmp_path: Path) -> None:
    program = "import numba\nassert numba.config.CACHE_DIR == "
    processes.child(f"{program}{str(tmp_path)!r}\n", tmp_path)


def test_memory_and_startup_measure_what_can_be_run(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = {
        "bare interpreter": "",
        "import lpv_track_env": "import lpv_track_env\n",
        "broken": "import nothing_of_the_kind\n",
        f"{processes.VECTOR_ENV} of 1": "a = bytearray(b'x') * 2**20\n",
        f"{processes.VECTOR_ENV} of {QUICK.large}": "a = bytearray(b'x') * (64 * 2**20)\n",
    }
    monkeypatch.setattr(processes, "programs", lambda _: listed)
    section = Section("memory")
    processes.memory(section, QUICK, quietly)
    peaks = {series.name: series.rounds for series in section.series if series.rounds}
    assert peaks["bare interpreter"][0] < peaks["import lpv_track_env"][0]
    (each,) = peaks[f"{processes.VECTOR_ENV}, per environment"]
    assert each == pytest.approx(2**20, rel=0.02)
    assert section.unavailable == [
        {"name": "broken", "reason": "ModuleNotFoundError: No module named 'nothing_of_the_kind'"}
    ]
    section = Section("startup")
    processes.startup(section, QUICK, quietly)
    started = {series.name: series for series in section.series if series.rounds}
    assert started["import lpv_track_env"].settings == {"cache": "warm"}
    assert "broken" not in started


def test_the_full_effort_is_more_than_the_quick_one_everywhere() -> None:
    for name, value in vars(FULL).items():
        quick = getattr(QUICK, name)
        assert (len(quick) <= len(value)) if isinstance(value, tuple) else (quick <= value)


# Learning ------------------------------------------------------------------------------------


def test_the_share_of_learning_is_the_vecenvs() -> None:
    pytest.importorskip("stable_baselines3")
    from experiments.speed import loops

    section = Section("learning")
    loops.learning(section, QUICK, quietly)
    found = {(series.name, series.unit): series.rounds for series in section.series}
    shares = found["DummyVecEnv of single ones", "share of wall time"]
    assert len(shares) == QUICK.learning_rounds
    assert 0.0 < shares[0] < 1.0
    assert found["DummyVecEnv of single ones", "s/env-step of learning"][0] > 0
