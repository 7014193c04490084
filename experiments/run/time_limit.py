"""Time limit of code that runs in this process."""

import math
import signal
import threading
from types import FrameType
from typing import Any, ClassVar


class OutOfTime(BaseException):
    """Ends a run past its limit; `except Exception` does not catch it."""


class TimeLimit:
    """Context that raises OutOfTime in its own code after some seconds, then again every second.

    It ends Python code. A call of native code, such as a solver or a compiled loop, is left to
    return first; code that never does can only be ended from another process. Code that catches
    every exception is ended by the next call of `check_time`. The limit needs the main thread and a
    system with SIGALRM, and is ignored elsewhere.

    Parameters
    ----------
    seconds
        Time limit, s; `math.inf` sets none.
    """

    entered: ClassVar[list["TimeLimit"]] = []
    """Limits of the contexts that the main thread is in."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.over = False
        """True once the time has passed."""
        self._before: Any = None

    def __enter__(self) -> "TimeLimit":
        possible = hasattr(signal, "setitimer") and math.isfinite(self.seconds)
        if possible and threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGALRM, self._end)
            # Not before the context is entered.
            signal.setitimer(signal.ITIMER_REAL, max(self.seconds, 0.001), 1.0)
            self.entered.append(self)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        if self._before is not None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._before)
            self.entered.remove(self)
        return kind is not None and issubclass(kind, OutOfTime)

    def _end(self, _number: int, _frame: FrameType | None) -> None:
        self.over = True
        raise OutOfTime


def check_time() -> None:
    """Raise OutOfTime if a time limit is over, for code whose callee may have caught it."""
    if any(limit.over for limit in TimeLimit.entered):
        raise OutOfTime
