"""Ctrl-C that is not lost."""

import signal
import threading
from types import FrameType
from typing import Any


class Interrupts:
    """Ctrl-C, remembered: raised as ever, but also where what runs takes it for something else.

    CasADi takes one that comes during a solve for a failed solve, and Python drops one that comes
    while a destructor runs. `check` raises it again.
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
        """Raise KeyboardInterrupt if it has come."""
        if self._came:
            raise KeyboardInterrupt
