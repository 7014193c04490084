"""Settings of the process itself: one thread for numerical libraries, no lost Ctrl-C."""

import os
import signal
import threading
from types import FrameType
from typing import Any

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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
