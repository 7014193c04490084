"""Functions that run in a forked child, where they may crash, hang, or eat memory."""

import contextlib
import os
import resource
import signal
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

MEMORY = 4 * 1024**3
"""Address space that a child may take beyond its parent's, bytes."""
POLL = 0.002


class Ended(NamedTuple):
    """End of a child: exit code (None: hung, and killed), and what it wrote."""

    code: int | None
    out: str
    err: str
    seconds: float


def forked(function: Callable[[], int], seconds: float) -> Ended:
    """Run a function in a child that has a time and a memory limit; its result is the exit code.

    An exception is a traceback in `err` and exit code 70; `SystemExit` is its own code.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        began = time.perf_counter()
        child = os.fork()
        if child == 0:
            _become(function, out.fileno(), err.fileno())
        code = _wait(child, began + seconds)
        taken = time.perf_counter() - began
        written = []
        for stream in (out, err):
            stream.seek(0)
            written.append(stream.read(2_000_000).decode(errors="replace"))
        return Ended(code, *written, taken)


def _become(function: Callable[[], int], out: int, err: int) -> None:
    """Be the child: run the function and leave without the parent's clean-up."""
    code = 70
    try:
        os.setsid()
        os.dup2(out, 1)
        os.dup2(err, 2)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        code = function()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # noqa: BLE001  whatever it is, the parent reports it
        with contextlib.suppress(BaseException):
            os.write(2, traceback.format_exc().encode(errors="replace"))
    finally:
        os._exit(code & 0xFF)


def _wait(child: int, until: float) -> int | None:
    """Wait for a child and return its exit code; kill its group at the time limit."""
    while time.perf_counter() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)  # what it may have left
            return os.waitstatus_to_exitcode(status)
        time.sleep(POLL)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None
