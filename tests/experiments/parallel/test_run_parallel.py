"""Estimator and controller as processes: faults brake the vehicle, and nothing is left behind."""

import json
import math
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.commands.run_parallel import verdict
from experiments.parallel import control
from experiments.parallel.child_processes import Child, Link, Stop
from experiments.parallel.recording import COMPLETE, Outcome, Recording, summarise, timing
from experiments.parallel.report import sentences
from experiments.parallel.setup import (
    COMMAND,
    DRIVING,
    ESTIMATE,
    FAILED,
    NO_FIX,
    NOT_FINITE,
    SAMPLE,
    STALE_ESTIMATE,
    Setup,
)
from experiments.parallel.simulated_vehicle import Sensors, Vehicle
from experiments.parallel.supervisor import run
from lpv_track_env import conditions
from lpv_track_env.vehicle import VEHICLES
from tests.helpers import faulty_agents

ROOT = Path(__file__).parents[3]
AGENTS = Path(faulty_agents.__file__)
SLOW = Setup(trajectory="T2", agent="stanley", rate=20, seconds=1.0, watchdog=200)
"""A run at a rate that a busy machine can hold."""
BUS = VEHICLES["m2-minibus"]

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals")


def named_memory(pids: Iterable[int]) -> list[str]:
    """Return the shared memory of processes that has a name, which would outlive them."""
    maps = [Path(f"/proc/{pid}/maps") for pid in pids]
    lines = [line for file in maps if file.exists() for line in file.read_text().splitlines()]
    return [line for line in lines if "/dev/shm/" in line]  # noqa: S108


def ended(pid: int) -> bool:
    """Return whether a process is gone or a zombie."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return not Path(f"/proc/{pid}").exists() and Path("/proc").exists()


def pids_in(line: str) -> dict[str, int]:
    """Read the process ids by role from the line "processes: ..."."""
    return {name: int(pid) for name, pid in re.findall(r"(estimator|controller) (\d+)", line)}


class Saboteur:
    """Receives the run's first line, and sends a signal to one of its processes after a while."""

    def __init__(self, role: str = "", number: int = 0, after: float = 0.4) -> None:
        self.role, self.number, self.after = role, number, after
        self.pids: dict[str, int] = {}
        self.timers: list[threading.Timer] = []

    def __call__(self, line: str) -> None:
        self.pids = pids_in(line)
        if self.role:
            victim = self.pids[self.role]
            self.timers.append(threading.Timer(self.after, os.kill, (victim, self.number)))
            self.timers[-1].start()


def drive(setup: Setup, saboteur: Saboteur) -> Outcome:
    """Drive in this process and check that nothing is left."""
    outcome = run(setup, saboteur)
    for timer in saboteur.timers:
        timer.join()
    assert len(saboteur.pids) == 2, outcome.fault
    assert all(ended(pid) for pid in saboteur.pids.values())
    return outcome


def assert_braked_in_time(setup: Setup, outcome: Outcome) -> None:
    """Check that the vehicle braked to a stand three periods after its last answered sample."""
    assert outcome.stale_brakings
    for braking in outcome.stale_brakings:
        assert braking.age == pytest.approx(3.0 * setup.period, abs=1.1e-3)
    last = outcome.stale_brakings[-1]
    assert last.ended is None
    # Before the first command, the age counts from the start.
    answered = max((row[0] for row in outcome.recording.commands), default=0)
    assert last.began <= (answered + 3) * setup.period + 1e-9
    assert outcome.final_speed < 0.02
    assert outcome.stop[0] > 0.0


def test_a_run_to_its_end() -> None:
    outcome = drive(SLOW, Saboteur())
    assert (outcome.end, outcome.fault, outcome.signal) == ("seconds", "", 0)
    assert len(outcome.recording.rows) == 21
    applied = outcome.recording.applied()
    assert (np.diff(applied["period"]) >= 0).all()
    assert (applied["estimated"] <= applied["commanded"]).all()
    assert (applied["commanded"] <= applied["latency"]).all()
    assert (applied["estimated"] > 0.0).all()
    assert outcome.final_speed < 0.02
    # The vehicle followed the path over about the distance of its speed.
    driven = outcome.recording.driven()
    assert np.abs(driven.lateral_error).max() < 0.5
    assert driven.arc_length[-1] > 0.5 * driven.state[0, 0]
    summary = summarise(SLOW, outcome)
    assert summary["periods"] == 20
    assert summary["complete"]
    assert json.dumps(summary, allow_nan=False)


@pytest.mark.parametrize("estimator", ["ekf", "truth"])
@pytest.mark.parametrize("given", ["realtime", "simulation"])
def test_nothing_is_compiled_or_loaded_while_driving(estimator: str, given: str) -> None:
    """Whatever the processes found on disk before."""
    setup = replace(SLOW, agent="lpv-nmpc", conditions=given, estimator=estimator)
    outcome = drive(setup, Saboteur())
    assert outcome.end == "seconds"
    assert outcome.compiled == {}


def test_what_is_compiled_while_driving_is_told() -> None:
    outcome = drive(replace(SLOW, agent=f"{AGENTS}:Compiles"), Saboteur())
    assert list(outcome.compiled) == ["controller"]
    assert re.fullmatch(r"predict \(.*faulty_agents.py:\d+\)", outcome.compiled["controller"])
    assert any(
        "the controller had to compile" in line for line in sentences(summarise(SLOW, outcome))
    )


@pytest.mark.parametrize("role", ["estimator", "controller"])
def test_a_killed_process_brakes_the_vehicle_and_ends_the_run(role: str, capsys) -> None:
    saboteur = Saboteur(role, signal.SIGKILL)
    setup = replace(SLOW, seconds=20.0)
    outcome = drive(setup, saboteur)
    assert outcome.end == "fault"
    assert outcome.fault == f"the {role} was killed by SIGKILL"
    assert_braked_in_time(setup, outcome)
    summary = summarise(setup, outcome)
    assert verdict(outcome, summary) == 1
    assert capsys.readouterr().err == f"lpv-track: the {role} was killed by SIGKILL\n"


def test_a_hung_solver_is_found_by_the_watchdog() -> None:
    setup = replace(SLOW, agent=f"{AGENTS}:Hangs", watchdog=20, seconds=20.0)
    outcome = drive(setup, Saboteur())
    assert outcome.end == "fault"
    assert re.fullmatch(r"the controller hangs: no command for \d+\.\d\d s", outcome.fault)
    assert_braked_in_time(setup, outcome)


def started(*more: str) -> tuple[subprocess.Popen[str], dict[str, int], int]:
    """Start the command as a process and wait until its clock runs."""
    process = subprocess.Popen(
        [
            sys.executable, "-m", "experiments", "run-parallel", "--agent", "stanley",
            "--rate", "20", "--seconds", "60", *more,
        ],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    assert process.stdout is not None
    line = process.stdout.readline()
    assert "the clock runs" in line
    return process, pids_in(line), process.pid


def wait_for_the_end(pids: Iterator[int]) -> None:
    waiting = set(pids)
    deadline = time.monotonic() + 20.0
    while waiting and time.monotonic() < deadline:
        waiting = {pid for pid in waiting if not ended(pid)}
        time.sleep(0.02)
    assert waiting == set()


def test_sigterm_brakes_first_and_ends_all(tmp_path: Path) -> None:
    process, pids, _ = started("--out", str(tmp_path))
    time.sleep(1.5)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=30.0)
    assert process.returncode == 128 + signal.SIGTERM
    assert "end: SIGTERM" in out
    wait_for_the_end(iter(pids.values()))
    result = json.loads((tmp_path / "run.json").read_text())
    assert result["run"]["end"] == "SIGTERM"
    assert result["run"]["stop"]["final_speed"] < 0.02
    assert result["machine"]["revision"].keys() == {"sources", "commit", "modified"}
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")


def test_children_end_with_a_killed_supervisor(tmp_path: Path) -> None:
    process, pids, own = started("--out", str(tmp_path))
    assert named_memory([own, *pids.values()]) == []
    process.kill()
    process.communicate(timeout=30.0)
    wait_for_the_end(iter(pids.values()))


def fails(link: Link) -> None:
    link.report("ready")
    raise OSError("no such\nthing")


def exits(link: Link) -> None:
    sys.exit("enough")


def fails_unreadably(link: Link) -> None:
    raise faulty_agents.UnreadableError


@pytest.mark.parametrize(
    ("role", "told"),
    [
        (fails, "failed: OSError: no such thing"),
        (exits, "failed: SystemExit: enough"),
        (fails_unreadably, "failed: UnreadableError, whose message cannot be read"),
    ],
)
def test_a_child_tells_what_it_failed_of(role: Callable[[Link], None], told: str) -> None:
    context = multiprocessing.get_context("spawn")
    child = Child("estimator", context, role, ())
    child.process.join(30.0)
    assert child.dead
    assert child.reported("ready") == (role is fails)
    assert child.how_it_ended() == told
    child.end()


def test_signals_are_remembered_and_handlers_put_back() -> None:
    before = [signal.getsignal(number) for number in Stop.SIGNALS]
    with Stop() as stop:
        assert stop.number == 0
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert stop.number == signal.SIGINT
    assert [signal.getsignal(number) for number in Stop.SIGNALS] == before


# The vehicle


def test_the_vehicle_brakes_when_left_alone_and_drives_on_when_not() -> None:
    vehicle = Vehicle(Setup(conditions="simulation", estimator="truth"))
    vehicle.advance(0.010)
    assert vehicle.take(1.0, 0.05, 0.0)
    vehicle.advance(0.060)
    assert vehicle.braking is None
    steering = vehicle.in_force[1]
    assert steering > 0.0
    vehicle.advance(0.061)
    assert vehicle.braking is not None
    assert vehicle.braking.began == pytest.approx(0.060)
    assert vehicle.braking.age == pytest.approx(0.060)
    speed = vehicle.speed
    vehicle.advance(1.0)
    assert vehicle.in_force[1] == pytest.approx(steering, abs=1e-6)
    assert vehicle.speed < speed - 1.0
    # A command based on an old sample is stale; a fresh one is valid.
    assert vehicle.take(1.0, 0.0, 0.9)
    vehicle.advance(1.01)
    assert vehicle.braking is not None
    assert vehicle.take(1.0, 0.0, 1.0)
    vehicle.advance(1.02)
    assert vehicle.braking is None
    assert vehicle.stale_brakings[0].ended == pytest.approx(1.01)
    # Without further commands it stops and stays stopped.
    vehicle.advance(12.0)
    assert abs(vehicle.speed) < 0.01
    assert len(vehicle.stale_brakings) == 2


def test_the_vehicle_refuses_what_is_not_finite() -> None:
    vehicle = Vehicle(Setup(conditions="simulation", estimator="truth"))
    vehicle.advance(0.01)
    assert not vehicle.take(math.nan, 0.0, 0.01)
    assert not vehicle.take(0.0, math.inf, 0.01)
    assert vehicle.commands_refused == 2
    vehicle.advance(0.1)
    assert vehicle.braking is not None


def test_mean_inputs_are_those_since_last_asked() -> None:
    vehicle = Vehicle(Setup(conditions="simulation", estimator="truth"))
    vehicle.advance(0.02)
    before = vehicle.in_force[0]
    assert vehicle.mean_inputs()[0] == pytest.approx(before)
    vehicle.take(before + 1.0, 0.0, 0.02)
    vehicle.advance(0.03)  # Limited jerk: it rises by 5 mm/s^2 per ms.
    a, _ = vehicle.mean_inputs()
    assert a == pytest.approx(before + 5.5 * BUS.max_jerk * 1e-3)
    assert vehicle.in_force[0] == pytest.approx(before + 10.0 * BUS.max_jerk * 1e-3)


# The controller


class Constant:
    """Agent with a constant action; a test may set the action or an error to raise."""

    def __init__(self) -> None:
        self.action = np.array([0.5, 0.1])
        self.error: Exception | None = None

    def predict(self, _observation, state=None, *_, **__):
        if self.error is not None:
            raise self.error
        return self.action, state


@pytest.fixture
def controller() -> control.Controller:
    made = control.prepared(Setup(agent="stanley"))
    return control.Controller(Constant(), made._observer, BUS, Setup())


def an_estimate(controller: control.Controller, age: float = 0.001) -> np.ndarray:
    path = controller._observer.path
    record = np.zeros((), ESTIMATE)
    record["due"] = time.monotonic_ns() - int(1e9 * age)
    record["state"] = [5.0, 0.0, path.heading[0], 0.0, path.x[0], path.y[0]]
    record["steering_angle"] = 0.02
    return record


def test_the_controller_drives_on_a_fresh_estimate(controller: control.Controller) -> None:
    assert not controller.is_stale(time.monotonic_ns())
    estimate = an_estimate(controller)
    estimate["period"] = 7
    estimate["steering_offset"] = 0.01
    controller.answer(estimate, 5)
    command = controller.command
    assert command["period"] == 7
    assert command["due"] == estimate["due"]
    assert command["estimated"] == 5
    assert command["reason"] == DRIVING
    assert float(command["acceleration"]) == 0.5
    assert float(command["steering_angle"]) == pytest.approx(0.09)
    assert command["solve_time"] > 0.0


@pytest.mark.parametrize(
    ("reason", "name", "value"),
    [(NO_FIX, "fix_age", 2.5), (NOT_FINITE, "state", math.nan), (STALE_ESTIMATE, "due", 1)],
)
def test_the_controller_brakes_on_an_estimate_it_cannot_trust(
    controller: control.Controller, reason: int, name: str, value: float
) -> None:
    estimate = an_estimate(controller)
    estimate[name] = value
    controller.answer(estimate, 5)
    assert controller.command["reason"] == reason
    assert float(controller.command["steering_angle"]) == 0.02
    known = reason != NOT_FINITE
    # 2 m/s^2 more than rolling resistance; without a known speed, rolling.
    expected = BUS.rolling_deceleration - (2.0 if known else 0.0)
    assert float(controller.command["acceleration"]) == pytest.approx(expected)
    # It drives again with the next valid estimate.
    controller.answer(an_estimate(controller), 6)
    assert controller.command["reason"] == DRIVING


def test_the_controller_finds_its_place_again_after_estimates_that_were_missed(
    controller: control.Controller,
) -> None:
    observer = controller._observer
    path = observer.path
    for s in (0.0, 0.1, 0.2, 20.2, 20.3, 62.0, 80.0, 80.1):
        here = path.sample(s)
        estimate = an_estimate(controller)
        estimate["state"] = [5.0, 0.0, here.heading, 0.0, here.x, here.y]
        estimate["fix_age"] = 3.0 if s == 20.2 else 0.0
        controller.answer(estimate, 1)
        # Round a corner the path is longer than the distance, within the range of the search.
        assert observer.arc_length == pytest.approx(s, abs=1e-3)
        assert observer.lateral_error == pytest.approx(0.0, abs=1e-3)


def test_the_controller_brakes_by_itself_when_no_estimate_comes(
    controller: control.Controller,
) -> None:
    now = time.monotonic_ns()
    assert controller.patience(now) == pytest.approx(0.02)
    estimate = an_estimate(controller)
    estimate["due"] = now
    controller.answer(estimate, now)
    assert controller.patience(now) == pytest.approx(0.02)
    assert controller.patience(now + 50_000_000) == pytest.approx(0.01)
    assert not controller.is_stale(now + 59_000_000)
    assert controller.is_stale(now + 60_000_000)
    accelerations = []
    for _ in range(400):
        controller.brake_on_stale()
        assert controller.command["reason"] == STALE_ESTIMATE
        assert controller.command["due"] == now
        accelerations.append(float(controller.command["acceleration"]))
    assert accelerations[0] == pytest.approx(BUS.rolling_deceleration - 2.0)
    # After 8 s its extrapolated speed is zero.
    assert accelerations[-1] == pytest.approx(BUS.rolling_deceleration, abs=1e-3)


def test_failed_solves_brake_and_ten_in_a_row_end_the_process(
    controller: control.Controller,
) -> None:
    agent = controller._agent
    agent.error = ArithmeticError("no solution")
    for k in range(control.MAX_FAILURES - 1):
        controller.answer(an_estimate(controller), 1)
        assert controller.command["reason"] == FAILED
        assert controller.command["failures"] == k + 1
    agent.error = None
    controller.answer(an_estimate(controller), 1)
    assert controller.command["reason"] == DRIVING
    agent.action = np.array([0.0, math.nan])
    for _ in range(control.MAX_FAILURES - 1):
        controller.answer(an_estimate(controller), 1)
        assert controller.command["reason"] == FAILED
    with pytest.raises(
        RuntimeError, match=r"10 times in a row, last with ValueError: .*not finite"
    ):
        controller.answer(an_estimate(controller), 1)


# Sensors


def readings(sensors: Sensors, until_ms: int, state: np.ndarray) -> np.ndarray:
    records = np.zeros(until_ms // 10, SAMPLE)
    for k, record in enumerate(records):
        sensors.read(10 * k, state, record)
    return records


STATE = np.array([5.0, 0.1, 0.3, 0.2, 100.0, -50.0])


def test_perfect_sensors_read_the_truth_each_at_its_rate() -> None:
    found = readings(Sensors(None, 100, seed=0), 1000, STATE)
    assert (found["heading"] == 0.3).all()
    assert (found["yaw_rate"] == 0.2).all()
    assert (found["speed"][::2] == 5.0).all()
    assert np.isnan(found["speed"][1::2]).all()
    assert np.flatnonzero(~np.isnan(found["fix_x"])).tolist() == list(range(0, 100, 10))
    assert np.nanmax(np.abs(found["fix_x"] - 100.0)) == 0.0
    assert found["fix_time"][30] == pytest.approx(0.3)


def test_noise_latency_outages_and_outliers_are_those_of_the_conditions() -> None:
    noisy = conditions.Conditions(
        gnss_latency=0.13, gnss_noise=0.05, gnss_outlier_rate=0.05, gnss_outlier_size=4.0,
        gnss_dropout_rate=0.2, gnss_dropout_duration=1.0, heading_noise=0.01, heading_bias=0.02,
        yaw_rate_noise=0.004, yaw_rate_bias=-0.003, speed_noise=0.05, speed_scale=0.01,
    )  # fmt: skip
    found = readings(Sensors(noisy, 100, seed=1), 400_000, STATE)
    several = 5.0 / math.sqrt(len(found))  # Standard deviations of a mean.
    for name, true, bias, deviation in (
        ("heading", 0.3, 0.02, 0.01),
        ("yaw_rate", 0.2, -0.003, 0.004),
        ("speed", 5.0, 0.05, 0.05),
    ):
        errors = found[name][~np.isnan(found[name])] - true
        assert errors.mean() == pytest.approx(bias, abs=2.0 * several * deviation)
        assert errors.std() == pytest.approx(deviation, rel=2.0 * several)
    there = np.flatnonzero(~np.isnan(found["fix_x"]))
    late = 0.01 * there[1:] - found["fix_time"][there[1:]]
    assert late == pytest.approx(0.13)
    assert found["fix_time"][0] == 0.0  # The first fix arrives at once, to start the filter.
    errors = np.hypot(found["fix_x"][there] - 100.0, found["fix_y"][there] + 50.0)
    wild = errors > 2.0
    assert np.mean(wild) == pytest.approx(0.05, abs=5.0 * math.sqrt(0.05 / wild.size))
    assert errors[wild] == pytest.approx(4.0, abs=0.3)
    assert np.sqrt(np.mean(errors[~wild] ** 2)) == pytest.approx(0.05 * math.sqrt(2.0), rel=0.05)
    # Outages of 1 s, after 5 s on average without one.
    gaps = np.diff(found["fix_time"][there])
    outages = gaps > 0.15
    assert gaps[outages].min() >= 1.0
    count = 400.0 / (1.0 / 0.2 + 1.0)
    assert outages.sum() == pytest.approx(count, abs=5.0 * math.sqrt(count))


# The report


def test_deadlines_and_latencies_of_a_run_by_hand() -> None:
    setup = Setup()
    recording = Recording(ages=[0.01, 0.03], lateness=[1e-4, 3e-4])
    recording.rows = [(0.0,)] * 6  # Five periods.
    for period, latency in ((0, 0.004), (1, 0.006), (2, 0.021), (4, 0.005), (4, 0.012)):
        recording.commands.append((period, latency, 0.001, 0.003, 0.0005, DRIVING, 0))
    found = timing(setup, recording)
    assert found["periods"] == 5
    assert found["answered_in_time"] == 3  # 2 came too late, 3 not at all, 4 twice.
    assert found["deadline_misses"] == 2
    assert found["rate"] == pytest.approx(30.0)
    assert found["wake_to_action"]["median"] == pytest.approx(0.0055)
    assert found["wake_to_action"]["max"] == pytest.approx(0.021)
    assert found["stages"]["estimate_to_command"]["median"] == pytest.approx(0.002)
    assert found["solve_time"]["p99"] == pytest.approx(0.0005)
    assert found["estimate_age"]["max"] == 0.03


@pytest.mark.parametrize(
    ("end", "fault", "number", "held", "code", "said"),
    [
        ("seconds", "", 0, True, 0, ""),
        ("finished", "", 0, True, 0, ""),
        ("seconds", "", 0, False, 1, "the rate was not held: 5 of 10 periods"),
        ("left_corridor", "", 0, True, 1, "the drive ended before its time: left_corridor"),
        ("fault", "the estimator hangs", 0, True, 1, "the estimator hangs"),
        ("SIGINT", "", signal.SIGINT, True, 130, ""),
        ("SIGTERM", "the estimator hangs", signal.SIGTERM, True, 143, ""),
    ],
)
def test_the_exit_code_tells_how_it_went(
    end: str, fault: str, number: int, held: bool, code: int, said: str, capsys
) -> None:
    outcome = Outcome(end, fault, number, Recording(), [], (0.0, 0.0), 0.0, 0)
    complete = end in COMPLETE
    summary = {"complete": complete, "held": held, "deadline_misses": 5, "periods": 10}
    assert verdict(outcome, summary) == code
    assert capsys.readouterr().err.startswith(f"lpv-track: {said}" if said else "")


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"rate": 30}, "--rate must divide 1000"),
        ({"rate": 0}, "--rate must divide 1000"),
        ({"seconds": 0.0}, "--seconds must be from one control period"),
        ({"watchdog": 2}, "--watchdog must be at least 4"),
        ({"estimator": "ukf"}, "unknown estimator 'ukf'; known: ekf, truth"),
        ({"agent": "nobody"}, "unknown agent 'nobody'"),
        ({"conditions": "storm"}, "unknown conditions 'storm'"),
        ({"trajectory": "T9"}, "T9"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes: dict, complaint: str) -> None:
    with pytest.raises(ValueError, match=re.escape(complaint)):
        Setup(**changes)


def test_commands_fit_their_mailboxes() -> None:
    assert all(not dtype.hasobject for dtype in (SAMPLE, ESTIMATE, COMMAND))
