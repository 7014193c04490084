"""Kill benchmarks, trainings and tunings at random moments, and go on with them.

A job is killed several times, each time going on from where it stopped, and then finishes. It must
end like one that was never killed: the same files, cases and bits. After every kill the folder must
be readable and hold all that was printed, and no process or shared memory may be left.

Processes are forked from a server that has loaded the project's modules, since loading them takes
longer than the jobs.
"""

import json
import multiprocessing
import os
import random
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from experiments.jobs import checkpoint
from experiments.jobs.job import read_lines
from experiments.run.result_schema import plain
from experiments.run.store import ResultStore
from tests.campaigns import Counts, Say

PRELOADED = (
    "experiments.cli", "experiments.commands.benchmark", "experiments.run.benchmark",
    "experiments.report.build", "experiments.run.console_tables", "experiments.commands.train",
    "experiments.training.loop", "experiments.commands.tune", "experiments.tuning.search",
    "matplotlib.figure", "agents.classical.geometric", "agents.classical.pid",
    "torch.utils.tensorboard",
)  # fmt: skip
KILLS = 4
"""Kills of one job before it finishes."""
HANGS = 240.0
"""Time after which a process hangs, s."""
GONE = 15.0
"""Time that workers have to end after the process that started them, s."""
TIMES = {"seconds", "learning_seconds"}
Facts = Mapping[str, Any]


class Job(NamedTuple):
    """A command, what it has printed as done, and what its folder holds."""

    words: list[str]
    printed: str
    """Pattern of the lines that say how much is done and stored, with that number."""
    held: Callable[[Path], int]
    """How much a folder holds; raises if it cannot be read."""
    result: Callable[[Path], Facts]
    """All that must not depend on kills."""
    workers: bool = False


def cases_held(folder: Path) -> int:
    """Return the number of cases in a folder; raises if it cannot be read."""
    store = ResultStore(folder)
    return len(store.cases())


def benchmark_facts(folder: Path) -> Facts:
    """Return all results of a folder but times, and the number of its lines."""
    store = ResultStore(folder)
    facts: dict[str, Any] = {"lines": store.cases_file.read_bytes().count(b"\n")}
    for stored in store.cases():
        case = plain(stored, "case")
        for name in ("median", "p99", "max"):
            case["solver"].pop(name)
        trace = store.trace(case["id"])
        assert trace is not None
        del trace["solve_time"], case["seconds"]
        facts[case["id"]] = case, {name: array.tobytes() for name, array in trace.items()}
    return facts


def _steps_trained(folder: Path) -> int:
    stored = checkpoint.read(folder)
    if stored is None:
        return 0
    steps = int(stored["lines"][-1]["steps"])
    assert steps in [line["steps"] for line in read_lines(folder)]
    return steps


def _solves_tuned(folder: Path) -> int:
    file = folder / "search.json"
    if not file.exists():
        return 0
    solves = int(json.loads(file.read_text())["solves"])
    assert solves in [line["solves"] for line in read_lines(folder)]
    return solves


def _lines(folder: Path) -> list[Any]:
    return [{k: v for k, v in line.items() if k not in TIMES} for line in read_lines(folder)]


def _training(folder: Path) -> Facts:
    weights = {file.name: file.read_bytes() for file in folder.glob("*.safetensors")}
    return {"lines": _lines(folder), "weights": weights}


def _tuning(folder: Path) -> Facts:
    weights = json.loads((folder / "weights.json").read_text())
    return {"lines": _lines(folder), "weights": {**weights, "provenance": None}}


JOBS = {
    "benchmark": Job(
        ["benchmark", "--agents", "stanley", "pid", "--trajectories", "u-turn", "straight",
         "--seeds", "3", "--workers", "2"],
        r"^\[(\d+)/", cases_held, benchmark_facts, workers=True,
    ),
    "train": Job(
        ["train", "ppo", "--steps", "2048", "--segment", "256", "--envs", "8", "--conditions",
         "simulation", "--trajectories", "u-turn", "--set", "rollout=32", "batch=64", "epochs=1",
         "hidden=[8,8]"],
        r"^ *([\d,]+) steps", _steps_trained, _training,
    ),
    "tune": Job(
        ["tune", "--method", "gradient", "--conditions", "simulation", "--time-limit", "0.5",
         "--solves", "2400", "--trajectories", "circle", "--drives", "2", "--set", "pairs=2"],
        r"^ *([\d,]+) solves", _solves_tuned, _tuning,
    ),
}  # fmt: skip


def _command(words: list[str], output: str) -> None:
    """Run a command in a session of its own; for a process of the server."""
    os.setsid()
    # The default, as in a process that was not forked from the server.
    multiprocessing.set_start_method(multiprocessing.get_all_start_methods()[0], force=True)
    descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    sys.argv = ["lpv-track", *words]
    from experiments.cli import main

    sys.exit(main(words))


class Running:
    """A command of a job that runs in a folder."""

    def __init__(self, job: Job, folder: Path, *more: str) -> None:
        self.job, self.folder = job, folder
        self.output = folder.with_suffix(".txt")
        context = multiprocessing.get_context("forkserver")
        words = [*job.words, "--out", str(folder), *more]
        self.process: Any = context.Process(target=_command, args=(words, str(self.output)))
        self.process.start()

    def wait_for_a_file(self) -> None:
        """Wait until the command has begun to write."""
        until = time.monotonic() + HANGS
        while time.monotonic() < until and self.process.is_alive():
            if self.folder.exists() and any(self.folder.iterdir()):
                return
            time.sleep(0.002)

    def end(self) -> int | None:
        """Wait for the end; return the exit code, None if it hangs."""
        self.process.join(HANGS)
        code: int | None = self.process.exitcode
        if code is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.join()
        return code

    def left(self) -> list[int]:
        """Return the processes of the command that are still there after a while."""
        until = time.monotonic() + GONE
        while (found := processes_of(self.process.pid)) and time.monotonic() < until:
            time.sleep(0.02)
        return found

    def done(self) -> int:
        """Return how much is done by what was printed."""
        found = re.findall(self.job.printed, self.output.read_text(), re.MULTILINE)
        return max((int(number.replace(",", "")) for number in found), default=0)


def processes_of(leader: int) -> list[int]:
    """Return the living processes of a session."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] != "Z":
            found.append(int(entry.parent.name))
    return found


def _shared_memory() -> set[str]:
    """Return the names of shared memory and semaphores that no living process has mapped."""
    names = {file.name for file in Path("/dev/shm").glob("*")}  # noqa: S108
    for entry in Path("/proc").glob("[0-9]*/maps"):
        try:
            text = entry.read_text()
        except OSError:
            continue
        names = {name for name in names if f"/dev/shm/{name}" not in text}  # noqa: S108
    return names


def _names(folder: Path) -> list[str]:
    """Return the names of a finished folder's files; those of TensorBoard hold times."""
    files = [str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()]
    return sorted(name for name in files if not name.startswith("tensorboard"))


class Campaign:
    """Kills of jobs, with what broke."""

    def __init__(self, scratch: Path, rng: random.Random, say: Say) -> None:
        self.scratch, self.rng, self.say = scratch, rng, say
        self.faults: list[str] = []
        self.seen: Counter[str] = Counter()
        self.wholes: dict[str, tuple[float, Facts, list[str]]] = {}
        """By job: time from its first file to its end (s), result, and names of its files."""

    def whole(self, name: str) -> tuple[float, Facts, list[str]]:
        """Run a job that is not killed, once; again for its time if it compiled."""
        for attempt in range(2):
            if name in self.wholes:
                break
            running = Running(JOBS[name], self.scratch / f"{name}-whole-{attempt}")
            running.wait_for_a_file()
            began = time.monotonic()
            if (code := running.end()) != 0:
                raise RuntimeError(f"{name} ended with {code}: {running.output.read_text()[-500:]}")
            lasted, folder = time.monotonic() - began, running.folder
            if attempt or "compiling" not in running.output.read_text():
                self.wholes[name] = lasted, JOBS[name].result(folder), _names(folder)
                self.say(f"{name}: {lasted:.1f} s from its first file to its end")
        return self.wholes[name]

    def kill(self, name: str, folder: Path, what: str) -> bool:
        """Go on with a job and kill it, or one of its workers; return whether it was alive."""
        job = JOBS[name]
        held = job.held(folder) if folder.exists() else 0
        running = Running(job, folder, "--resume")
        running.wait_for_a_file()
        lasted, *rest = self.whole(name)
        wait, began = self.rng.uniform(0.0, lasted), time.monotonic()
        running.process.join(wait)
        label = f"{folder.name}, {what} after {wait:.3f} s"
        if (code := self.strike(running, what)) is None:
            # The whole run was slower, for example because the machine was busy.
            self.wholes[name] = min(lasted, time.monotonic() - began), rest[0], rest[1]
            self.seen["ended before"] += 1
            return False
        if what == "worker" and code != 0:
            self.faults.append(f"{label}: ended with {code}")
        running.process.join()
        self.seen[f"{name} {what}"] += 1
        if running.left():
            self.faults.append(f"{label}: processes are left")
        try:
            # What was printed is of this run for cases, of the whole job otherwise.
            least = held + running.done() if job.workers else max(held, running.done())
            if (now := job.held(folder)) < least:
                self.faults.append(f"{label}: {least} were stored, {now} are there")
        except Exception as error:  # noqa: BLE001  a folder that cannot be read is a fault
            self.faults.append(f"{label}: {type(error).__name__}: {error}")
        return True

    def strike(self, running: Running, what: str) -> int | None:
        """Kill a job, or one or two of its workers; return how it ended, None if it had before."""
        pid = running.process.pid
        assert pid is not None
        try:
            if not running.process.is_alive():
                return None
            if what == "worker":
                workers = [one for one in processes_of(pid) if one != pid]
                for worker in workers[: 1 + self.rng.randrange(2)]:
                    os.kill(worker, signal.SIGKILL)
                return running.end()
            (os.killpg if what == "group" else os.kill)(pid, signal.SIGKILL)
        except ProcessLookupError:  # It ended between the look and the kill.
            running.process.join()
            return None
        return -signal.SIGKILL

    def finish(self, name: str, folder: Path) -> None:
        """Let a job finish, and compare it with one that was never killed."""
        for file in folder.rglob(".*.tmp"):
            os.utime(file, (0.0, 0.0))  # as if more than a minute had passed
        running = Running(JOBS[name], folder, "--resume")
        if (code := running.end()) != 0:
            text = " ".join(running.output.read_text()[-300:].split())
            self.faults.append(f"{folder.name}: ended with {code}: {text}")
            return
        _, facts, names = self.whole(name)
        try:
            mine = JOBS[name].result(folder)
        except Exception as error:  # noqa: BLE001
            self.faults.append(f"{folder.name}: {type(error).__name__}: {error}")
            return
        for key in {**facts, **mine}:
            if facts.get(key) != mine.get(key):
                self.faults.append(f"{folder.name}: {key} differs from that of a whole run")
        if (found := _names(folder)) != names:
            differing = sorted(set(found) ^ set(names))
            self.faults.append(f"{folder.name}: files differ: {', '.join(differing)}")


def run(count: int, seed: int, say: Say) -> Counts:
    """Kill jobs `count` times in all."""
    rng = random.Random(seed)  # noqa: S311
    multiprocessing.set_forkserver_preload(list(PRELOADED))
    before = _shared_memory()
    with tempfile.TemporaryDirectory() as scratch:
        campaign = Campaign(Path(scratch), rng, say)
        killed = number = 0
        while killed < count:
            name = list(JOBS)[number % len(JOBS)]
            folder = Path(scratch) / f"{name}-{number}"
            campaign.whole(name)
            for _ in range(min(KILLS, max(1, (count - killed) // len(JOBS)))):
                ways = ["group", "group", "main", *(["worker"] if JOBS[name].workers else [])]
                if killed == count or not campaign.kill(name, folder, rng.choice(ways)):
                    break
                killed += 1
            campaign.finish(name, folder)
            number += 1
            say(f"{killed} of {count} kills, {number} jobs, {len(campaign.faults)} broke")
        left = _shared_memory() - before
    if left:
        campaign.faults.append(f"left in shared memory: {', '.join(sorted(left))}")
    return Counts(killed, campaign.faults, {"jobs": number, **campaign.seen})
