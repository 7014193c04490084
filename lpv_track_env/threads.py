"""Threads of compiled code: how many may be had, and calls with so many."""

import operator
import os
from collections.abc import Iterator
from contextlib import contextmanager

import numba


def checked_threads(value: int) -> int:
    """`value` if so many threads can be had.

    Raises
    ------
    ValueError
        If not.
    """
    threads = operator.index(value)
    most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    if not 1 <= threads <= most:
        raise ValueError(
            f"threads must be from 1 to {most} (the processors numba sees; NUMBA_NUM_THREADS sets "
            f"it), not {value}"
        )
    if threads > 1:
        # Else threads that wait spin, and on a busy machine a step takes 700 times as long.
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    return threads


SHARES = 8
"""Shares of the work to a thread: a share may be harder than another, or a processor be taken."""


def shares(threads: int) -> int:
    """Into how many shares threads divide their work, if there is enough of it."""
    return SHARES * threads if threads > 1 else 1


@contextmanager
def using_threads(threads: int) -> Iterator[None]:
    """Have numba's parallel loops use so many threads, each taking the next share when it can."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        with numba.parallel_chunksize(1):
            yield
    finally:
        numba.set_num_threads(before)
