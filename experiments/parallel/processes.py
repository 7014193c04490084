"""Child processes that end with their parent, and that tell why they ended.

Each child has a link to the supervisor, a pipe: through it the child says that it has attached to
its mailboxes, that it is ready, or what it failed of; the supervisor's closing it means stop, and
so does the supervisor's death.
"""

import ctypes
import gc
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

ATTACHED, READY, FAILED = "attached", "ready", "failed"
DEATH_SIGNAL, TIMER_SLACK = 1, 29
"""prctl's PR_SET_PDEATHSIG and PR_SET_TIMERSLACK."""
GRACE = 0.5
"""s that a child has to end by itself, and then to die of SIGTERM, before it is killed."""


class Link:
    """The child's end of its link."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def say(self, word: str, detail: str = "") -> None:
        """Tell the supervisor; without effect where it is gone."""
        with suppress(OSError):
            self._connection.send((word, detail))

    def stopped(self) -> bool:
        """Whether the supervisor wants the child to end, or is gone itself."""
        ready, _, _ = select.select([self._connection], [], [], 0.0)
        return bool(ready)


Role = Callable[..., None]


def child_main(role: Role, connection: Connection, parent: int, arguments: tuple[Any, ...]) -> None:
    """Run a role in a child: `role(link, *arguments)`; what it raises goes to the supervisor."""
    end_with(parent)
    # Ctrl-C reaches the whole group: the supervisor, which brakes first, decides when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    link = Link(connection)
    try:
        role(link, *arguments)
    except Exception as error:  # noqa: BLE001  told to the supervisor, which ends the run
        link.say(FAILED, f"{type(error).__name__}: {' '.join(str(error).split())}")
        sys.exit(1)


def end_with(parent: int) -> None:
    """Have the system kill this process when its parent dies, where the system can (Linux).

    Elsewhere a child ends when it next looks at its link, so one that hangs outlives a parent that
    is killed.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # It died before that.
        sys.exit(1)


def quiet() -> None:
    """Before a loop that must not be late: no garbage collector, timers to the microsecond."""
    gc.collect()
    gc.freeze()
    gc.disable()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(TIMER_SLACK, 1, 0, 0, 0)


def no_longer_quiet() -> None:
    """Undo `quiet`, after the loop."""
    gc.enable()
    gc.unfreeze()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(TIMER_SLACK, 0, 0, 0, 0)  # 0: back to the default


class Child:
    """The supervisor's view of a child process.

    Parameters
    ----------
    name
        Of the role, for messages.
    context
        multiprocessing's, spawn.
    role, arguments
        What it runs: `role(link, *arguments)`, a function of a module.
    """

    def __init__(
        self, name: str, context: SpawnContext, role: Role, arguments: tuple[Any, ...]
    ) -> None:
        self.name = name
        self._connection, theirs = context.Pipe()
        self.process: SpawnProcess = context.Process(
            target=child_main, args=(role, theirs, os.getpid(), arguments), name=name, daemon=True
        )
        self._heard: dict[str, str] = {}
        self.process.start()
        theirs.close()

    def heard(self, word: str) -> bool:
        """Whether the child has said a word."""
        self._listen()
        return word in self._heard

    def _listen(self) -> None:
        with suppress(EOFError, OSError):
            while self._connection.poll():
                word, detail = self._connection.recv()
                self._heard[word] = detail

    @property
    def dead(self) -> bool:
        """Whether the process has ended."""
        return self.process.exitcode is not None

    def cause_of_death(self) -> str:
        """How a dead child ended, in words."""
        code = self.process.exitcode
        if self.heard(FAILED):
            return f"failed: {self._heard[FAILED]}"
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def ask_to_stop(self) -> None:
        """Tell the child to end."""
        self._listen()
        self._connection.close()

    def end(self) -> None:
        """Wait for the child, which was asked to stop; make it end if it does not."""
        if not self._connection.closed:
            self.ask_to_stop()
        for make_end in (self.process.terminate, self.process.kill):
            self.process.join(GRACE)
            if self.dead:
                break
            make_end()
        self.process.join()
        self.process.close()


class Stop:
    """SIGINT and SIGTERM, remembered until the loop looks.

    Raises
    ------
    ValueError
        On entering outside of the main thread, where Python takes no signals.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.number = 0
        """Of the first signal that came; 0 for none."""
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
    """Wait for a condition, a few ms at a time; False after `timeout` s or when a signal came."""
    deadline = time.monotonic() + timeout
    while not condition():
        if stop.number or time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True
