"""Child processes that end with their parent and report why they ended.

Each child has a pipe to the supervisor, its link. Through it the child reports that it is ready,
its failure, and code that had to be compiled in its real-time loop. The child stops when the
supervisor closes the link or dies.
"""

import ctypes
import gc
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from itertools import takewhile
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from numba.core import event

from experiments.run.case import in_words

READY, FAILED, COMPILED = "ready", "failed", "compiled"
DEATH_SIGNAL, TIMER_SLACK = 1, 29
"""prctl's PR_SET_PDEATHSIG and PR_SET_TIMERSLACK."""
GRACE = 0.5
"""Time that a child has to end by itself, and again after SIGTERM, before it is killed, s."""


class Link:
    """The child's end of its link."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def report(self, word: str, detail: str = "") -> None:
        """Send a word to the supervisor; no effect if it is gone."""
        with suppress(OSError):
            self._connection.send((word, detail))

    def quiet(self) -> AbstractContextManager[None]:
        """Run the child's real-time loop, see `quiet`; what is compiled in it is reported."""
        return quiet(partial(self.report, COMPILED))

    def stopped(self) -> bool:
        """Return whether the supervisor has closed the link or is gone."""
        ready, _, _ = select.select([self._connection], [], [], 0.0)
        return bool(ready)


Role = Callable[..., None]


def child_main(role: Role, connection: Connection, parent: int, arguments: tuple[Any, ...]) -> None:
    """Run `role(link, *arguments)` in a child; report its exception to the supervisor."""
    end_with(parent)
    # Ctrl-C reaches the whole process group, but the supervisor must brake first.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    link = Link(connection)
    try:
        role(link, *arguments)
    except BaseException as error:  # noqa: BLE001  reported to the supervisor, which ends the run
        link.report(FAILED, in_words(error))
        sys.exit(1)


def end_with(parent: int) -> None:
    """Let the system kill this process when its parent dies (Linux only).

    Elsewhere a child ends when it next checks its link, so a hung child outlives a killed parent.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # The parent died before the call.
        sys.exit(1)


@contextmanager
def quiet(tell: Callable[[str], None]) -> Iterator[None]:
    """Run a real-time loop: no garbage collection, timers accurate to the microsecond.

    Everything that the loop calls should be compiled before. `tell` is called, once, with the place
    at which machine code has to be compiled or loaded nevertheless, which takes from 1 ms to
    seconds.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    _set_timer_slack(1)
    watch = _Watch(tell)
    event.register("numba:compiler_lock", watch)  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        event.unregister("numba:compiler_lock", watch)  # type: ignore[no-untyped-call]
        _set_timer_slack(0)  # back to the default
        gc.enable()
        gc.unfreeze()


def _set_timer_slack(nanoseconds: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(TIMER_SLACK, nanoseconds, 0, 0, 0)


class _Watch(event.Listener):
    """Tells the place in our code, or in an agent's, at which numba is first asked to compile."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell: Callable[[str], None] | None = tell

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002  part of the protocol
        if self._tell is None:
            return
        tell, self._tell = self._tell, None
        *_, place = takewhile(
            lambda frame: f"{os.sep}numba{os.sep}" not in frame.filename, traceback.extract_stack()
        )
        tell(f"{place.name} ({place.filename}:{place.lineno})")

    def on_end(self, event: event.Event) -> None:
        pass


class Child:
    """A child process, as the supervisor handles it.

    Parameters
    ----------
    name
        Name of the role, for messages.
    context
        Context of multiprocessing, spawn.
    role, arguments
        Function of a module and its arguments: the child runs `role(link, *arguments)`.
    """

    def __init__(
        self, name: str, context: SpawnContext, role: Role, arguments: tuple[Any, ...]
    ) -> None:
        self.name = name
        self._connection, theirs = context.Pipe()
        self.process: SpawnProcess = context.Process(
            target=child_main, args=(role, theirs, os.getpid(), arguments), name=name, daemon=True
        )
        self._reports: dict[str, str] = {}
        self.process.start()
        theirs.close()

    @property
    def compiled(self) -> str:
        """Place at which the child had to compile in its loop; "" for none."""
        self._listen()
        return self._reports.get(COMPILED, "")

    def reported(self, word: str) -> bool:
        """Return whether the child has sent a word."""
        self._listen()
        return word in self._reports

    def _listen(self) -> None:
        with suppress(EOFError, OSError):
            while self._connection.poll():
                word, detail = self._connection.recv()
                self._reports[word] = detail

    @property
    def dead(self) -> bool:
        """True once the process has ended."""
        return self.process.exitcode is not None

    def how_it_ended(self) -> str:
        """Return how a dead child ended, in words."""
        code = self.process.exitcode
        if self.reported(FAILED):
            return f"failed: {self._reports[FAILED]}"
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def request_stop(self) -> None:
        """Tell the child to end."""
        self._listen()
        self._connection.close()

    def end(self) -> None:
        """Ask the child to stop and wait for it; terminate or kill it if it does not."""
        if not self._connection.closed:
            self.request_stop()
        for make_end in (self.process.terminate, self.process.kill):
            self.process.join(GRACE)
            if self.dead:
                break
            make_end()
        self.process.join()
        self.process.close()


class Stop:
    """SIGINT and SIGTERM, remembered for the loop to check.

    Raises
    ------
    ValueError
        On entering outside of the main thread, where Python handles no signals.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.number = 0
        """Number of the first signal; 0 for none."""
        self._before: list[Any] = []

    def __enter__(self) -> "Stop":
        self._before = [signal.signal(number, self._remember) for number in self.SIGNALS]
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in zip(self.SIGNALS, self._before, strict=True):
            signal.signal(number, handler)

    def _remember(self, number: int, _frame: object) -> None:
        self.number = self.number or number


def wait_until(condition: Callable[[], bool], timeout: float, stop: Stop) -> bool:
    """Wait for a condition; return False after `timeout` s or on a signal."""
    deadline = time.monotonic() + timeout
    while not condition():
        if stop.number or time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True
