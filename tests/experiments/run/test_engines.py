"""Engines: what runs where, and that neither a dead worker nor a stop loses or leaves anything."""

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from experiments.run.case import Case, failed_case
from experiments.run.engines import in_process, local_pool

Spec = Mapping[str, Any]


def specs(count: int, **notes: Any) -> list[dict[str, Any]]:
    """Cases told apart by their seed; `notes` reach the run functions below."""
    return [
        {"agent": "nobody", "trajectory": "nowhere", "seed": seed, "env_settings": notes}
        for seed in range(count)
    ]


def note(spec: Spec) -> dict[str, Any]:
    return {"id": Case(**spec).id, "seed": spec["seed"], "status": "ok", "pid": os.getpid()}


def kill_some(spec: Spec) -> dict[str, Any]:
    if spec["seed"] in spec["env_settings"]["killers"]:
        os._exit(9)
    time.sleep(0.02)
    return note(spec)


def kill_once(spec: Spec) -> dict[str, Any]:
    """Seed 1 kills its worker the first time only."""
    mark = Path(spec["env_settings"]["mark"])
    if spec["seed"] == 1 and not mark.exists():
        mark.touch()
        os._exit(9)
    return note(spec)


def raise_one(spec: Spec) -> dict[str, Any]:
    if spec["seed"] == 0:
        raise ArithmeticError("no such luck")
    time.sleep(120)
    return note(spec)


def linger(spec: Spec) -> dict[str, Any]:
    time.sleep(0 if spec["seed"] == 0 else 120)
    return note(spec)


def stick(spec: Spec) -> dict[str, Any]:
    """Leave the process's number, and wait for ever in native code that holds the interpreter."""
    Path(spec["env_settings"]["mark"]).write_text(str(os.getpid()))
    ctypes.PyDLL(None).pause()
    return note(spec)


def stick_first(spec: Spec) -> dict[str, Any]:
    return stick(spec) if spec["seed"] == 0 else note(spec)


def other_process(run: str, *notes: str) -> "subprocess.Popen[str]":
    """Another process that has just begun to run specs in a pool, in a session of its own."""
    code = (
        "import sys\n"
        "from experiments.run.engines import local_pool\n"
        f"from tests.experiments.run.test_engines import {run} as run, specs\n"
        "print('begun', flush=True)\n"
        "list(local_pool(specs(3, mark=sys.argv[1])[1:], 2, run=run))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, *notes], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    return process


def runs(pid: int) -> bool:
    """Return whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def session(entry: Path) -> int:
    """Session of a process."""
    try:
        return int(entry.joinpath("stat").read_text().rpartition(")")[2].split()[3])
    except OSError:
        return 0


def workers_left(patience: float = 5.0) -> list[str]:
    """Command lines of this process's spawned workers, once they had time to end."""
    until = time.monotonic() + patience
    while True:
        found = [str(child) for child in multiprocessing.active_children()]
        for entry in Path("/proc").glob("[0-9]*"):  # nothing where there is no /proc
            try:
                parent = entry.joinpath("stat").read_text().rpartition(")")[2].split()[1]
                command = entry.joinpath("cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if int(parent) == os.getpid() and "spawn_main" in command:
                found.append(command)
        if not found or time.monotonic() > until:
            return found
        time.sleep(0.05)


def seeds(results: Sequence[Mapping[str, Any]]) -> list[int]:
    return sorted(result["seed"] for result in results)


def test_both_engines_give_the_same_results() -> None:
    cases, begun = specs(6), []
    here = list(in_process(cases, run=note))
    pooled = list(local_pool(cases, 2, run=note, failed=failed_case, started=begun.append))
    assert [result["seed"] for result in here] == list(range(6))
    assert {result["pid"] for result in here} == {os.getpid()}
    assert os.getpid() not in {result["pid"] for result in pooled}
    assert Counter(result["id"] for result in pooled) == Counter(result["id"] for result in here)
    assert begun == cases
    assert workers_left() == []


@pytest.mark.parametrize(("workers", "killers"), [(1, [0]), (2, [0, 4])])
def test_a_case_that_kills_its_worker_is_reported_and_no_other_suffers(
    workers: int, killers: list[int]
) -> None:
    cases = specs(3 * workers, killers=killers)
    results = list(local_pool(cases, workers, run=kill_some))
    assert seeds(results) == list(range(3 * workers))
    failed = [result for result in results if result["status"] != "ok"]
    assert seeds(failed) == killers
    for result in failed:
        assert result["status"] == "failed"
        assert "worker process died, twice" in result["error"]
        assert result["id"] == Case(**cases[result["seed"]]).id
        assert result["trajectory"] == "nowhere"
        assert result["metrics"] == {}
    assert workers_left() == []


def test_a_worker_that_dies_once_costs_nothing(tmp_path: Path) -> None:
    cases = specs(3, mark=str(tmp_path / "died"))
    results = list(local_pool(cases, 1, run=kill_once, failed=failed_case))
    assert seeds(results) == [0, 1, 2]
    assert {result["status"] for result in results} == {"ok"}
    assert (tmp_path / "died").exists()


def test_what_a_run_raises_comes_through_and_ends_the_pool() -> None:
    began = time.monotonic()
    with pytest.raises(ArithmeticError, match="no such luck"):
        list(local_pool(specs(6), 2, run=raise_one, failed=failed_case))
    assert workers_left() == []
    assert time.monotonic() - began < 60


def test_cases_are_driven_unless_another_function_is_given() -> None:
    (here,), (pooled,) = list(in_process(specs(1))), list(local_pool(specs(1), 1))
    for result in (here, pooled):
        assert result["status"] == "failed"
        assert "unknown trajectory 'nowhere'" in result["error"]


def test_in_process_passes_on_what_a_run_raises() -> None:
    with pytest.raises(ArithmeticError, match="no such luck"):
        list(in_process(specs(1), run=raise_one))


def test_stopping_early_ends_the_workers() -> None:
    began = time.monotonic()
    run = local_pool(specs(6), 2, run=linger, failed=failed_case)
    assert next(run)["seed"] == 0
    run.close()  # type: ignore[attr-defined]
    assert workers_left() == []
    assert time.monotonic() - began < 60


def test_more_workers_than_cases() -> None:
    assert seeds(list(local_pool(specs(2), 5, run=note, failed=failed_case))) == [0, 1]
    assert list(local_pool([], 5, run=note, failed=failed_case)) == []
    assert workers_left() == []


@pytest.mark.parametrize("workers", [0, -1])
def test_no_workers_are_refused(workers: int) -> None:
    with pytest.raises(ValueError, match=f"workers must be at least 1, not {workers}"):
        next(local_pool(specs(1), workers, run=note, failed=failed_case))


@pytest.mark.parametrize("delay", [0.05, 0.5])
def test_ctrl_c_while_workers_start_gives_one_traceback(delay: float) -> None:
    process = other_process("linger", "none")
    time.sleep(delay)
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert error.count("KeyboardInterrupt") == 1


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc to look into")
def test_workers_in_native_code_end_with_a_killed_parent(tmp_path: Path) -> None:
    mark = tmp_path / "pid"
    process = other_process("stick", str(mark))
    until = time.monotonic() + 60.0
    while not (mark.exists() and mark.read_text()) and time.monotonic() < until:
        time.sleep(0.05)
    worker = int(mark.read_text())
    assert runs(worker)
    process.kill()
    process.communicate()
    until = time.monotonic() + 10.0
    while runs(worker) and time.monotonic() < until:
        time.sleep(0.05)
    assert not runs(worker)


@pytest.mark.skipif(not Path("/dev/shm").exists(), reason="there is no /dev/shm")  # noqa: S108
def test_nothing_is_left_of_a_pool_that_is_killed_as_a_group(tmp_path: Path) -> None:
    mark = tmp_path / "pid"
    process = other_process("stick", str(mark))
    until = time.monotonic() + 60.0
    while not mark.exists() and time.monotonic() < until:
        time.sleep(0.05)
    # Semaphores would be there while the pool runs, and stay when all of it is killed at once.
    held = [
        line
        for entry in Path("/proc").glob("[0-9]*")
        if entry.joinpath("stat").exists() and session(entry) == process.pid
        for line in entry.joinpath("maps").read_text().splitlines()
        if "/dev/shm" in line  # noqa: S108
    ]
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert held == []


def test_a_run_over_its_limit_is_ended_and_no_other_suffers(tmp_path: Path) -> None:
    mark = tmp_path / "pid"
    began = time.monotonic()
    cases = [*specs(1, mark=str(mark)), *specs(4)[1:]]
    results = list(local_pool(cases, 2, run=stick_first, limit=2.0))
    assert seeds(results) == [0, 1, 2, 3]
    failed = {result["seed"]: result.get("error") for result in results}
    assert failed == {0: "took longer than 2 s", 1: None, 2: None, 3: None}
    assert not runs(int(mark.read_text()))
    assert workers_left() == []
    assert time.monotonic() - began < 60.0
