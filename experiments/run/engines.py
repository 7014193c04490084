"""Engines that run specs: in this process, or over a pool of local worker processes.

A spec that takes longer than the limit, or that kills its worker twice, gets the result of a
failure, and the sweep goes on. Workers talk over pipes: however they and this process end, nothing
is left of them. Nothing here loads a numerical library, so `one_thread` can be called before they
load.
"""

import contextlib
import math
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from types import FrameType
from typing import Any

from experiments.run.time_limit import TimeLimit

Result = dict[str, Any]
Spec = Mapping[str, Any]
Run = Callable[[Spec], Result]
Failed = Callable[[Spec, str], Result]
Files = Callable[[Spec], Sequence[Path]]
Folder = Callable[[Spec], Path]

ENGINES = ("local", "ray")

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DIED = "the worker process died, twice"
PATIENCE = 5.0
"""Time that an idle worker has to end by itself, s."""


def one_thread() -> None:
    """Give numerical libraries one thread, here and in child processes; call before they load."""
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")


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
        """
        del files, folder
        if self.name == "ray":
            raise ValueError("--engine ray is not there yet")
        workers = self.workers or os.cpu_count() or 1
        if workers == 1:
            return in_process(specs, run, started, failed, limit)
        return local_pool(specs, workers, run, started, failed, limit)


def late(limit: float) -> str:
    """Return the error of a run that took longer than the limit, s."""
    return f"took longer than {limit:g} s"


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
        What to run.
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
        self._workers: list[_Worker] = []

    @property
    def _busy(self) -> list["_Worker"]:
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

    def _idle_worker(self) -> "_Worker":
        for worker in self._workers:
            if worker.spec is None:
                return worker
        self._workers.append(_Worker(self._run))
        return self._workers[-1]

    def collect(self) -> list[Result]:
        """Wait for messages, deaths and ends of time; return the results that there are."""
        results = []
        for worker in self._ready():
            message = worker.message()
            if message is None:
                results += self._replace(worker)
            else:
                results += message
        return results

    def _ready(self) -> list["_Worker"]:
        busy, limit = self._busy, self._limit
        while True:
            left = min(limit - worker.lasted for worker in busy)
            # A dead worker's pipe stays open while its own children hold it: look every second.
            ready = wait_for([worker.pipe for worker in busy], min(max(left, 0.0), 1.0))
            found = [
                worker
                for worker in busy
                if worker.pipe in ready or worker.lasted > limit or not worker.process.is_alive()
            ]
            if found:
                return found

    def _replace(self, worker: "_Worker") -> list[Result]:
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


class _Worker:
    """A process that runs one spec after another."""

    def __init__(self, run: Run) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, run))
        with _interrupts_held():
            self.process.start()
        theirs.close()
        self.spec: Spec | None = None
        self.again = False
        self._began = math.inf

    @property
    def lasted(self) -> float:
        """Time since it began its spec, s; negative before."""
        return time.monotonic() - self._began

    def give(self, spec: Spec, *, again: bool) -> None:
        """Give it a spec to run, for the second time if `again`."""
        self.spec, self.again, self._began = spec, again, math.inf
        # A worker that has died is noticed when its message is read.
        with contextlib.suppress(OSError):
            self.pipe.send(spec)

    def message(self) -> list[Result] | None:
        """Read what it sent: a result, or none yet; None if it has died or exceeded its time.

        Raises
        ------
        BaseException
            What the run raised.
        """
        try:
            if not self.pipe.poll():
                return None
            kind, content = self.pipe.recv()
        except Exception:  # noqa: BLE001  a torn message is anything
            return None
        if kind == "raised":
            raise content
        if kind == "begun":
            self._began = time.monotonic()
            return []
        self.spec = None
        return [content]

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back, also in a process that is started here, until it ignores Ctrl-C itself."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Its start would let Ctrl-C through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: Connection, run: Run) -> None:
    """Run the specs that come through a pipe, until it is closed."""
    _begin_worker()
    while True:
        try:
            spec = pipe.recv()
        except EOFError:
            return
        pipe.send(("begun", None))
        try:
            answer = pickle.dumps(("done", run(spec)))
        except BaseException as error:  # noqa: BLE001  raised again in the parent
            answer = _exception(error)
        pipe.send_bytes(answer)


def _exception(error: BaseException) -> bytes:
    """Pickle an exception, or where that cannot be done its text."""
    try:
        answer = pickle.dumps(("raised", error))
        pickle.loads(answer)  # noqa: S301  of our own making
    except Exception:  # noqa: BLE001  anything can happen in an exception's own methods
        return pickle.dumps(("raised", RuntimeError(f"a run raised {type(error).__name__}")))
    return answer


def _begin_worker() -> None:
    """Ignore Ctrl-C, which the parent handles, and end when the parent ends or is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        wait_for([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
    with contextlib.suppress(ImportError, AttributeError, OSError):
        # The thread cannot run while native code holds the interpreter: there, the system ends the
        # process, when the sentinel's other end is closed.
        import fcntl

        sentinel = int(parent.sentinel)
        fcntl.fcntl(sentinel, fcntl.F_SETOWN, os.getpid())
        flags = fcntl.fcntl(sentinel, fcntl.F_GETFL)
        fcntl.fcntl(sentinel, fcntl.F_SETFL, flags | os.O_ASYNC)
