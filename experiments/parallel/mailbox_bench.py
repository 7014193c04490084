"""Latency of a value from one process to another, for several ways of waiting for it."""

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from experiments.parallel.child_processes import READY, Child, Link
from experiments.parallel.mailbox import Mailbox, Message, Reader
from experiments.parallel.recording import spread
from experiments.parallel.setup import ESTIMATE

VALUES = 1000
"""Values written for each way of waiting, without the warm-up."""
WARM_UP = 20
PAUSE = 0.005
"""Time between values, s: long enough for the reader to fall asleep."""
NAP = 1e-4
"""Sleep of the polling reader between checks, s."""
TIMEOUT = 1.0

Wait = Callable[[Reader], Message | None]


def by_pipe(reader: Reader) -> Message | None:
    """Wait for the mailbox's pipe, as the run does."""
    return reader.wait(TIMEOUT)


def by_polling(reader: Reader) -> Message | None:
    """Check, sleep a little, check again."""
    while (message := reader.wait(0.0)) is None:
        time.sleep(NAP)
    return message


def by_spinning(reader: Reader) -> Message | None:
    """Check all the time: the smallest possible latency, at the price of a core."""
    while (message := reader.wait(0.0)) is None:
        pass
    return message


WAYS: dict[str, Wait] = {
    "mailbox (pipe)": by_pipe,
    f"polling every {1e3 * NAP:g} ms": by_polling,
    "spinning": by_spinning,
}


def read(link: Link, reader: Reader, way: str, values: int, sent: Connection) -> None:
    """Take the values and send back their latencies, s."""
    wait = WAYS[way]
    latencies: list[float] = []
    reader.open()
    link.report(READY)
    with link.quiet():
        while reader.last_read < values + WARM_UP:  # A value that was overwritten is skipped.
            message = wait(reader)
            now = time.monotonic_ns()
            if message is None:
                raise TimeoutError(f"no value for {TIMEOUT:g} s")
            if message.sequence > WARM_UP:
                latencies.append(1e-9 * (now - message.stamp))
    reader.close()
    sent.send_bytes(np.array(latencies).tobytes())


def measure(way: str, values: int) -> NDArray[np.float64]:
    """Return latencies of one way, s, from the writer's stamp to the reader holding the value.

    Values that were overwritten before they were read are left out.
    """
    context = multiprocessing.get_context("spawn")
    mailbox = Mailbox(ESTIMATE)
    received, sent = context.Pipe(duplex=False)
    writer = mailbox.writer.open()
    child = Child("reader", context, read, (mailbox.reader, way, values, sent))
    sent.close()
    try:
        while not child.reported(READY):
            if child.dead:
                raise RuntimeError(f"the reader {child.how_it_ended()}")
            time.sleep(PAUSE)
        record = np.zeros((), ESTIMATE)
        for _ in range(values + WARM_UP):
            time.sleep(PAUSE)
            writer.put(record)
        return np.frombuffer(received.recv_bytes())
    except EOFError:
        child.process.join()
        raise RuntimeError(f"the reader {child.how_it_ended()}") from None
    finally:
        child.end()
        mailbox.close()


def costs() -> dict[str, float]:
    """Return the median times of a write and of a read within one process, s."""
    mailbox = Mailbox(ESTIMATE)
    writer, reader = mailbox.writer.open(), mailbox.reader.open()
    record = np.zeros((), ESTIMATE)
    found: dict[str, list[float]] = {"put": [], "latest": []}
    for _ in range(5 * VALUES):
        began = time.perf_counter()
        writer.put(record)
        between = time.perf_counter()
        reader.latest()
        found["put"].append(between - began)
        found["latest"].append(time.perf_counter() - between)
    mailbox.close()
    return {name: float(np.median(times)) for name, times in found.items()}


def bench_mailbox(console: Console) -> dict[str, Any]:
    """Measure all ways in turn, print a table, return the figures, s."""
    rows = Table(box=box.SIMPLE_HEAD, title=f"wake latency, us, {VALUES} values {PAUSE:g} s apart")
    for heading in ("", "median", "99 %", "max"):
        rows.add_column(heading, justify="left" if not heading else "right")
    found: dict[str, Any] = {}
    for way in WAYS:
        figures = spread(measure(way, VALUES)) or {}
        found[way] = figures
        rows.add_row(way, *(f"{1e6 * value:.1f}" for value in figures.values()))
    console.print(rows)
    found["cost"] = costs()
    words = ", ".join(f"{name} {1e6 * value:.1f} us" for name, value in found["cost"].items())
    console.print(f"median cost in one process: {words}", highlight=False)
    return found
