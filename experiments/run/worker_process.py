"""A child process that runs one spec after another.

It talks over a pipe: however it and this process end, nothing is left of it. Nothing here loads a
numerical library, so `one_thread` can be called before they load.
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
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Any

Result = dict[str, Any]
Spec = Mapping[str, Any]
Run = Callable[[Spec], Result]
Failed = Callable[[Spec, str], Result]
Files = Callable[[Spec], Sequence[Path]]
Folder = Callable[[Spec], Path]
Identity = Callable[[Spec], str]
Machine = Callable[[Mapping[str, Any]], None]

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
LATE = "took longer than"
DIED = "the worker process died, twice"
PATIENCE = 5.0
"""Time that an idle worker has to end by itself, s."""


def one_thread() -> None:
    """Give numerical libraries one thread, here and in child processes; call before they load."""
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")


def late(limit: float) -> str:
    """Return the error of a run that took longer than the limit, s."""
    return f"{LATE} {limit:g} s"


def ready(busy: Sequence["Worker"], limit: float) -> list["Worker"]:
    """Wait until some busy workers have sent something, died, or exceeded the limit, s."""
    while True:
        left = min(limit - worker.lasted for worker in busy)
        # A dead worker's pipe stays open while its own children hold it: look every second.
        heard = wait_for([worker.pipe for worker in busy], min(max(left, 0.0), 1.0))
        found = [
            worker
            for worker in busy
            if worker.pipe in heard or worker.lasted > limit or not worker.process.is_alive()
        ]
        if found:
            return found


class Worker:
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
            The exception that the run raised.
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
            answer = pickled_exception(error)
        pipe.send_bytes(answer)


def pickled_exception(error: BaseException) -> bytes:
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
        if wait_for([sentinel], 0):  # closed before the system was asked to tell
            os._exit(1)
