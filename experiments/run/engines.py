"""Engines that run specs: in this process, or over a pool of local worker processes.

A spec that takes longer than the limit, or that kills its worker twice, gets the result of a
failure, and the sweep goes on.
"""

import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any

from experiments.run.time_limit import TimeLimit
from experiments.run.worker_process import (
    DIED,
    PATIENCE,
    Failed,
    Files,
    Folder,
    Identity,
    Machine,
    Result,
    Run,
    Spec,
    Worker,
    late,
    one_thread,
    ready,
)

ENGINES = ("local", "ray")


class Interrupts:
    """Context that remembers Ctrl-C, for code that may swallow the KeyboardInterrupt.

    CasADi takes a Ctrl-C during a solve for a failed solve, and Python drops one that comes while
    a destructor runs. KeyboardInterrupt is raised as usual, and `check` raises it again.
    """

    def __init__(self) -> None:
        self._came = False
        self._before: Any = None

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _remember(self, _number: int, _frame: FrameType | None) -> None:
        self._came = True
        raise KeyboardInterrupt

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was pressed inside the context."""
        if self._came:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class Engine:
    """Place where specs run: this process, local worker processes, or a Ray cluster.

    Parameters
    ----------
    workers
        Number of processes; local 1: this process. None: all cores, or all CPUs of the cluster.
    name
        One of `ENGINES`.
    address
        Address of the Ray cluster; None: one on this computer, made for the run.
    """

    workers: int | None = None
    name: str = "local"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be at least 1, not {self.workers}")
        if self.name not in ENGINES:
            raise ValueError(f"engine must be one of {', '.join(ENGINES)}, not {self.name!r}")
        if self.address is not None and self.name != "ray":
            raise ValueError("--address is that of a Ray cluster: it needs --engine ray")

    def run(
        self,
        specs: Sequence[Spec],
        run: Run | None = None,
        *,
        started: Callable[[Spec], None] | None = None,
        failed: Failed | None = None,
        limit: float = math.inf,
        files: Files | None = None,
        folder: Folder | None = None,
        identity: Identity | None = None,
        machine: Machine | None = None,
    ) -> Iterator[Result]:
        """Run specs and yield results as they end; see `local_pool`.

        Parameters
        ----------
        files
            Names the files that a spec's run reads, beside the project's sources; the Ray engine
            brings them to the computer that runs it.
        folder
            Names the folder that a spec's run reads and writes; the Ray engine brings its content
            there and back.
        identity
            Gives what must be the same on the computer that runs a spec, such as a case's id;
            without it, the versions of all packages must be the same.
        machine
            Called with `key` and `experiments.run.provenance.provenance()` of each kind of computer
            other than this one, before its first result.
        """
        if self.name == "ray":
            from experiments.run.ray_engine import run_on_ray

            return run_on_ray(
                specs, self.workers, self.address, run or _run_case(), failed or _failed_case(),
                started=started, limit=limit, files=files, folder=folder, identity=identity,
                machine=machine,
            )  # fmt: skip
        workers = self.workers or os.cpu_count() or 1
        if workers == 1:
            return in_process(specs, run, started, failed, limit)
        return local_pool(specs, workers, run, started, failed, limit)


def in_process(
    specs: Sequence[Spec],
    run: Run | None = None,
    started: Callable[[Spec], None] | None = None,
    failed: Failed | None = None,
    limit: float = math.inf,
) -> Iterator[Result]:
    """Run specs one after another in this process.

    The arguments are those of `local_pool`; the limit holds as far as `TimeLimit` can.
    """
    run, failed = run or _run_case(), failed or _failed_case()
    for spec in specs:
        if started is not None:
            started(spec)
        with TimeLimit(limit) as clock:
            result = run(spec)
        yield failed(spec, late(limit)) if clock.over else result


def local_pool(
    specs: Sequence[Spec],
    workers: int,
    run: Run | None = None,
    started: Callable[[Spec], None] | None = None,
    failed: Failed | None = None,
    limit: float = math.inf,
) -> Iterator[Result]:
    """Run specs over `workers` processes and yield results as they end.

    A worker that dies, for example for want of memory, is replaced; its spec is run again at the
    end, alone. A worker that exceeds the limit is killed.

    Parameters
    ----------
    specs
        Specs to run.
    workers
        Number of processes.
    run
        Makes the result of a spec; must be picklable. By default that of `Case`.
    started
        Called with each spec as it starts.
    failed
        Makes the result of a spec and an error, for one that killed its worker twice or took too
        long. By default that of `Case`.
    limit
        Time limit of a spec, s; the start of a worker does not count.

    Raises
    ------
    ValueError
        If there is not at least one worker.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, not {workers}")
    one_thread()
    pool = _Pool(specs, workers, run or _run_case(), failed or _failed_case(), limit)
    try:
        while pool.unfinished:
            for spec in pool.assign():
                if started is not None:
                    started(spec)
            yield from pool.collect()
        pool.dismiss()
    finally:
        # Interrupted, or the consumer stopped: do not wait for results that nobody reads.
        pool.kill()


def _run_case() -> Run:
    # Imported late: cases load numerical libraries.
    from experiments.run.case import run_case

    return run_case


def _failed_case() -> Failed:
    from experiments.run.case import failed_case

    return failed_case


class _Pool:
    """Workers, and the specs that wait for one."""

    def __init__(
        self, specs: Sequence[Spec], workers: int, run: Run, failed: Failed, limit: float
    ) -> None:
        self._most, self._run, self._failed, self._limit = workers, run, failed, limit
        self._fresh = list(reversed(specs))
        self._suspects: list[Spec] = []
        self._workers: list[Worker] = []

    @property
    def _busy(self) -> list["Worker"]:
        return [worker for worker in self._workers if worker.spec is not None]

    @property
    def unfinished(self) -> bool:
        """True while a spec waits or runs."""
        return bool(self._fresh or self._suspects or self._busy)

    def assign(self) -> list[Spec]:
        """Give specs to idle workers; return those that start for the first time."""
        begun = []
        while self._fresh and len(self._busy) < self._most:
            begun.append(self._fresh.pop())
            self._idle_worker().give(begun[-1], again=False)
        if self._suspects and not self._busy:
            self._idle_worker().give(self._suspects.pop(), again=True)
        return begun

    def _idle_worker(self) -> "Worker":
        for worker in self._workers:
            if worker.spec is None:
                return worker
        self._workers.append(Worker(self._run))
        return self._workers[-1]

    def collect(self) -> list[Result]:
        """Wait for messages, deaths and ends of time; return the results that there are."""
        results = []
        for worker in ready(self._busy, self._limit):
            message = worker.message()
            if message is None:
                results += self._replace(worker)
            else:
                results += message
        return results

    def _replace(self, worker: "Worker") -> list[Result]:
        """End a worker that has died or exceeded its time; return what became of its spec."""
        worker.kill()
        self._workers.remove(worker)
        assert worker.spec is not None
        if worker.lasted > self._limit:
            return [self._failed(worker.spec, late(self._limit))]
        if worker.again:
            return [self._failed(worker.spec, DIED)]
        self._suspects.append(worker.spec)
        return []

    def dismiss(self) -> None:
        """Let all workers end by themselves."""
        for worker in self._workers:
            worker.pipe.close()
        for worker in self._workers:
            worker.process.join(PATIENCE)

    def kill(self) -> None:
        """End all workers at once."""
        for worker in self._workers:
            worker.kill()
