"""Kill nodes of a Ray cluster and drivers of sweeps on it at random moments.

A cluster of two nodes with one CPU each runs a benchmark. A node is killed with -9, and the sweep
must end by itself; or the driver is killed with -9 or interrupted, and `--resume` on Ray or on the
local pool must end it. Every folder must hold what one of the local pool holds, to the bit, nothing
lost and nothing twice; and nothing may be left at work on the cluster.

`python -m tests.campaigns.kill_ray` compares the cases per second of both engines.
"""

import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from tests.campaigns import Counts, Say
from tests.campaigns.kill_jobs import (
    GONE,
    PRELOADED,
    Facts,
    Job,
    Running,
    benchmark_facts,
    cases_held,
)
from tests.helpers.ray_runs import children_at_work, cluster, kill_node, node

WAYS = ("node", "driver", "node", "driver", "interrupt")
EARLY = 0.25
"""Share of the moments that lie before the first case."""
WORDS = ["benchmark", "--agents", "stanley", "pid", "--trajectories", "u-turn", "T5"]
PRINTED = r"^\[(\d+)/"
LONG = ["benchmark", "--agents", "lpv-nmpc", "--trajectories", "T5", "T6"]
"""Cases of a second and more: drives of four minutes."""
PATIENCE = 300.0
"""Longest wait for the first case of a sweep, s."""


def job(*words: str) -> Job:
    """Return a benchmark with further options."""
    return Job([*words], PRINTED, cases_held, benchmark_facts, workers=True)


class Campaign:
    """A cluster, the same sweep again and again, and what broke."""

    def __init__(self, scratch: Path, made: Any, seeds: int, say: Say) -> None:
        self.scratch, self.cluster, self.say = scratch, made, say
        words = [*WORDS, "--seeds", str(seeds)]
        self.local = job(*words, "--workers", "2")
        self.ray = job(*words, "--engine", "ray", "--address", made.address)
        self.faults: list[str] = []
        self.seen: Counter[str] = Counter()
        self.added = made.add_node(**node(1))
        self.lasted, self.facts = self._whole()

    def _wait_for_a_case(self, running: Running) -> None:
        """Wait until the sweep has stored a case."""
        file = running.folder / "cases.jsonl"
        until = time.monotonic() + PATIENCE
        while running.process.is_alive() and not (file.exists() and file.stat().st_size):
            if time.monotonic() > until:
                raise RuntimeError(f"no case after {PATIENCE:g} s: {running.folder}")
            time.sleep(0.005)

    def _whole(self) -> tuple[tuple[float, float], Facts]:
        """Run the sweep undisturbed on both engines; return its results.

        Before them, the times on Ray to its first case and from there to its end, s.
        """
        facts: dict[str, Facts] = {}
        for name, one in (("local", self.local), ("ray", self.ray)):
            running = Running(one, self.scratch / f"whole-{name}")
            running.wait_for_a_file()
            began = time.monotonic()
            self._wait_for_a_case(running)
            first = time.monotonic()
            if (code := running.end()) != 0:
                raise RuntimeError(f"{name} ended with {code}: {running.output.read_text()[-500:]}")
            lasted = first - began, time.monotonic() - first
            facts[name] = benchmark_facts(running.folder)
            self.say(f"{name}: first case after {lasted[0]:.1f} s, the others {lasted[1]:.1f} s")
        if facts["local"] != facts["ray"]:
            self.faults.append("whole sweeps differ")
        return lasted, facts["local"]

    def strike(self, number: int, way: str, share: float, early: bool, resumed: Job) -> bool:
        """Disturb a sweep after a share of the time to its first case, or from there to its end.

        Return whether it was still running.
        """
        folder = self.scratch / f"{way}-{number}"
        running = Running(self.ray, folder)
        running.wait_for_a_file()
        if not early:
            self._wait_for_a_case(running)
        wait = share * (self.lasted[0] if early else self.lasted[1])
        label = f"{folder.name}, {wait:.2f} s after its {'start' if early else 'first case'}"
        running.process.join(wait)
        if not running.process.is_alive():
            # The whole sweep was slower, for example because the machine was busy.
            self.lasted = self.lasted[0], min(self.lasted[1], wait)
            self.seen["ended before"] += 1
            shutil.rmtree(folder)
            return False
        held = cases_held(folder)
        code = 0
        if way == "node":
            kill_node(self.added)
            ended = running.end()
            self.added = self._another_node()
        else:
            sent, code = (
                (signal.SIGKILL, -signal.SIGKILL) if way == "driver" else (signal.SIGINT, 130)
            )
            os.kill(running.process.pid, sent)
            ended = running.end()
            self._check_stored(label, running, folder)
            self._check_gone(label)
        text = running.output.read_text()
        if ended != code:
            self.faults.append(f"{label}: ended with {ended}: {' '.join(text[-300:].split())}")
        if "Traceback" in text or "raylet" in text.lower():
            self.faults.append(f"{label}: printed {' '.join(text[:300].split())}")
        if code != 0:
            again = Running(resumed, folder, "--resume")
            if (ended := again.end()) != 0:
                self.faults.append(f"{label}: resumed, ended with {ended}")
        if (facts := benchmark_facts(folder)) != self.facts:
            differ = [
                key for key in {**facts, **self.facts} if facts.get(key) != self.facts.get(key)
            ]
            self.faults.append(f"{label}: differs from the local pool in {', '.join(differ)}")
        self.seen[way] += 1
        self.seen["cases held"] += held
        shutil.rmtree(folder)
        return True

    def _another_node(self) -> Any:
        self.cluster.worker_nodes.discard(self.added)
        return self.cluster.add_node(**node(1))

    def _check_stored(self, label: str, running: Running, folder: Path) -> None:
        if (now := cases_held(folder)) < running.done():
            self.faults.append(f"{label}: {running.done()} were stored, {now} are there")

    def _check_gone(self, label: str) -> None:
        """Check that the actors of a driver that is gone, and their processes, go too."""
        raylets = [
            process.process.pid
            for one in (self.cluster.head_node, self.added)
            for process in one.all_processes["raylet"]
        ]
        until = time.monotonic() + GONE
        while any(children_at_work(pid) for pid in raylets):
            if time.monotonic() > until:
                self.faults.append(f"{label}: processes are left on the cluster")
                return
            time.sleep(0.05)


def run(count: int, seed: int, say: Say) -> Counts:
    """Disturb `count` sweeps."""
    rng = random.Random(seed)  # noqa: S311
    multiprocessing.set_forkserver_preload(list(PRELOADED))
    seeds = 10 if count > len(WAYS) else 4
    with tempfile.TemporaryDirectory() as scratch, cluster(1) as made:
        campaign = Campaign(Path(scratch), made, seeds, say)
        done = number = 0
        while done < count:
            way, number = WAYS[done % len(WAYS)], number + 1
            resumed = campaign.ray if rng.random() < 0.5 else campaign.local
            early = rng.random() < EARLY
            done += campaign.strike(number, way, rng.random(), early, resumed)
            say(f"{done} of {count}, {way}, {len(campaign.faults)} broke")
    return Counts(count, campaign.faults, dict(campaign.seen))


def cases_per_second(words: list[str], folder: Path) -> float:
    """Run a benchmark and return the cases per second between its first and last lines."""
    running = Running(job(*words), folder)
    if (code := running.end()) != 0:
        raise RuntimeError(f"ended with {code}: {running.output.read_text()[-500:]}")
    times = sorted(file.stat().st_mtime for file in (folder / "traces").glob("*.npz"))
    # The first cases of both workers compile.
    return (len(times) - 5) / (times[-1] - times[4])


def throughput(seeds: int = 30) -> int:
    """Print the cases per second of the local pool and of two nodes, twice each."""
    rates: dict[str, list[float]] = {"local": [], "ray": []}
    with tempfile.TemporaryDirectory() as scratch, cluster(2) as made:
        words = [*LONG, "--conditions", "realtime", "--seeds", str(seeds)]
        for number in range(2):
            more = {
                "local": ["--workers", "2"],
                "ray": ["--engine", "ray", "--address", made.address],
            }
            for name, options in more.items():
                rate = cases_per_second([*words, *options], Path(scratch) / f"{name}-{number}")
                rates[name].append(rate)
                print(f"{name}: {rate:.3f} cases/s, {2 / rate:.2f} s a case and worker", flush=True)
    ratio = max(rates["ray"]) / max(rates["local"])
    print(f"Ray's best over the local pool's best: {ratio:.3f}")
    return 0 if ratio >= 0.9 else 1


if __name__ == "__main__":
    sys.exit(throughput())
