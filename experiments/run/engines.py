"""Engines that run specs: in this process, or over a pool of local worker processes.

A worker that dies takes its pool with it. The pool is rebuilt and the specs that were in flight are
run alone, one by one; one that kills its worker again is marked failed and the sweep goes on.
Nothing here loads a numerical library, so `one_thread` can be called before they load.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait as wait_for
from types import FrameType
from typing import Any

Result = dict[str, Any]
Spec = Mapping[str, Any]
Run = Callable[[Spec], Result]

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


def in_process(
    specs: Sequence[Spec], run: Run | None = None, started: Callable[[Spec], None] | None = None
) -> Iterator[Result]:
    """Run specs one after another in this process; `run` is by default that of `Case`."""
    run = run or _run_case()
    for spec in specs:
        if started is not None:
            started(spec)
        yield run(spec)


def local_pool(
    specs: Sequence[Spec],
    workers: int,
    run: Run | None = None,
    started: Callable[[Spec], None] | None = None,
    died: Run | None = None,
) -> Iterator[Result]:
    """Run specs over `workers` processes and yield results as they end.

    `run` makes the result of a spec and must be picklable; `died` makes that of a spec that killed
    its worker twice; both are those of `Case` by default. `started` is called with each spec as it
    starts.

    Raises
    ------
    ValueError
        If there is not at least one worker.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, not {workers}")
    one_thread()
    run, died = run or _run_case(), died or _worker_death()
    waiting = list(specs)
    suspects: list[Spec] = []
    while waiting or suspects:
        alone = not waiting
        batch, waiting = (suspects[:1], []) if alone else (waiting, [])
        suspects = suspects[1:] if alone else suspects
        unfinished = yield from _pool(batch, 1 if alone else workers, run, started)
        if unfinished is None:
            continue
        running, waiting = unfinished
        if alone and running:
            yield died(running[0])
        else:
            suspects += running


def _run_case() -> Run:
    # Imported late: cases load numerical libraries.
    from experiments.run.case import run_case

    return run_case


def _worker_death() -> Run:
    from experiments.run.case import worker_death

    return worker_death


def _begin_worker() -> None:
    """Ignore Ctrl-C, which the parent handles, and end when the parent ends or is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        wait_for([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _pool(
    specs: Sequence[Spec], workers: int, run: Run, started: Callable[[Spec], None] | None
) -> Generator[Result, None, tuple[list[Spec], list[Spec]] | None]:
    """Run specs in one pool; if it breaks, return those in flight and those not started."""
    context = multiprocessing.get_context("spawn")
    queue = list(specs)
    running: dict[Future[Result], Spec] = {}
    unfinished = None
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker)
    try:
        while queue or running:
            while queue and len(running) < workers:
                try:
                    future = pool.submit(run, queue[0])
                except BrokenProcessPool:
                    break
                running[future] = spec = queue.pop(0)
                if started is not None:
                    started(spec)
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            # Results from before the pool broke are still valid.
            ended = [future for future in done if not _broken(future)]
            for future in ended:
                running.pop(future)
                yield future.result()
            if not ended:
                unfinished = list(running.values()), queue
                break
    except BaseException:
        # Interrupted, or the consumer stopped: do not wait for results that nobody reads.
        for process in list((getattr(pool, "_processes", None) or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return unfinished


def _broken(future: Future[Result]) -> bool:
    return isinstance(future.exception(), BrokenProcessPool)
