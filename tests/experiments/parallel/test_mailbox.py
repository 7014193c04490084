"""The mailbox between processes: newest value, never a torn one, no endless wait."""

import multiprocessing
import os
import signal
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from experiments.parallel import mailbox_bench
from experiments.parallel.mailbox import FRONT, Mailbox, MailboxError, Reader, Writer

RECORD = np.dtype([("number", np.int64), ("values", np.int64, (50,)), ("sum", np.int64)])
SPAWN = multiprocessing.get_context("spawn")

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pipes that select can wait for")


def record(number: int) -> np.ndarray:
    """Return a record whose fields reveal a mixture of two values."""
    made = np.zeros((), RECORD)
    made["number"] = number
    made["values"] = number * np.arange(50)
    made["sum"] = made["values"].sum()
    return made


def is_whole(value: np.void) -> bool:
    return bool(value == record(int(value["number"])))


@pytest.fixture
def mailbox():
    made = Mailbox(RECORD)
    made.writer.open()
    made.reader.open()
    yield made
    made.close()


def test_nothing_was_written(mailbox: Mailbox) -> None:
    assert mailbox.reader.latest() is None
    assert mailbox.reader.wait(0.01) is None
    assert mailbox.reader.wait_all(0.01) == []


def test_newest_value_with_number_and_stamp(mailbox: Mailbox) -> None:
    before = time.monotonic_ns()
    assert [mailbox.writer.put(record(n)) for n in (10, 11, 12)] == [1, 2, 3]
    message = mailbox.reader.latest()
    assert message is not None
    assert message.sequence == 3
    assert before <= message.stamp <= time.monotonic_ns()
    assert message.value["number"] == 12
    assert is_whole(message.value)


def test_a_value_is_its_own(mailbox: Mailbox) -> None:
    mailbox.writer.put(record(1))
    kept = mailbox.reader.latest()
    for n in range(2, 12):
        mailbox.writer.put(record(n))
    assert kept is not None
    assert kept.value["number"] == 1
    with pytest.raises(ValueError, match="read-only"):
        kept.value["number"] = 5


def test_a_wait_gives_a_value_out_once(mailbox: Mailbox) -> None:
    mailbox.writer.put(record(1))
    mailbox.writer.put(record(2))
    message = mailbox.reader.wait(0.0)
    assert message is not None
    assert message.value["number"] == 2
    began = time.monotonic()
    assert mailbox.reader.wait(0.05) is None
    assert time.monotonic() - began >= 0.05
    latest = mailbox.reader.latest()
    assert latest is not None
    assert latest.value["number"] == 2


def test_wait_all_has_those_in_between_and_numbers_tell_what_is_lost(mailbox: Mailbox) -> None:
    for n in range(1, 4):
        mailbox.writer.put(record(n))
    assert [m.sequence for m in mailbox.reader.wait_all(0.0)] == [1, 2, 3]
    for n in range(4, 14):
        mailbox.writer.put(record(n))
    found = mailbox.reader.wait_all(0.0)
    assert [m.sequence for m in found] == [10, 11, 12, 13]
    assert [int(m.value["number"]) for m in found] == [10, 11, 12, 13]
    assert mailbox.reader.wait_all(0.0) == []


def test_a_passive_reader_waits_without_a_pipe(mailbox: Mailbox) -> None:
    watcher = mailbox.passive_reader().open()
    assert watcher.wait(0.01) is None
    mailbox.writer.put(record(7))
    message = watcher.wait(0.0)
    assert message is not None
    assert message.value["number"] == 7
    watcher.close()


def test_a_writer_never_waits_for_its_reader(mailbox: Mailbox) -> None:
    for n in range(70_000):  # More wakes than the pipe holds.
        mailbox.writer.put(record(n)) if n % 10_000 == 0 else mailbox.writer._wake()
    message = mailbox.reader.wait(0.0)
    assert message is not None
    assert message.value["number"] == 60_000
    mailbox.reader.close()
    mailbox.writer.put(record(1))
    assert mailbox.writer.put(record(2)) == message.sequence + 2


@pytest.mark.parametrize("slots", [2, 4])
def test_a_write_cut_off_anywhere_leaves_the_value_before(slots: int) -> None:
    mailbox = Mailbox(RECORD, slots=slots)
    writer, reader = mailbox.writer.open(), mailbox.reader.open()
    for n in range(1, 6):
        writer.put(record(n))
    # All bytes of the sixth write, which is then undone and cut off after each of them.
    offset = FRONT + 6 % slots * writer._stride
    size = 24 + RECORD.itemsize
    old = bytes(writer._buffer[offset : offset + size])
    writer.put(record(6))
    new = bytes(writer._buffer[offset : offset + size])
    for cut in range(size + 1):
        writer._buffer[offset : offset + size] = new[:cut] + old[cut:]
        writer._front[0] = 5
        message = reader.latest()
        assert message is not None
        assert message.sequence == 5
        assert is_whole(message.value)
        # A processor that does not keep the order of writes may see this.
        writer._front[0] = 6
        copy = reader._copy(6)
        assert (copy is not None) == (new[:cut] + old[cut:] == new)
    mailbox.close()


def test_memory_that_was_written_over_is_an_error_and_no_endless_loop(mailbox: Mailbox) -> None:
    mailbox.writer.put(record(1))
    mailbox.writer._front[0] = 99
    with pytest.raises(MailboxError, match="not whole"):
        mailbox.reader.latest()


def hammer(writer: Writer, said: Connection) -> None:
    """Write as fast as possible until killed."""
    writer.open()
    records = [record(n) for n in range(64)]
    said.send("writing")
    while True:
        for one in records:
            writer.put(one)


def start_hammering(mailbox: Mailbox) -> multiprocessing.process.BaseProcess:
    heard, said = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(target=hammer, args=(mailbox.writer, said), daemon=True)
    process.start()
    mailbox.writer.close()
    said.close()
    assert heard.poll(30.0)
    return process


def test_no_torn_value_under_a_hammering_writer_and_none_after_its_death() -> None:
    mailbox = Mailbox(RECORD, slots=2)  # Most reads have to be repeated.
    reader = mailbox.reader.open()
    process = start_hammering(mailbox)
    last, read = 0, 0
    until = time.monotonic() + 0.5
    while time.monotonic() < until:
        message = reader.latest() if read % 2 else reader.wait(1.0)
        assert message is not None
        assert message.sequence >= last
        assert is_whole(message.value)
        assert message.value["number"] == (message.sequence - 1) % 64
        last = message.sequence
        read += 1
    assert read > 10
    # The kill most likely hits it within a write.
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    message = reader.latest()
    assert message is not None
    assert is_whole(message.value)
    reader.wait(0.0)
    began = time.monotonic()
    assert reader.wait(0.05) is None
    assert reader.writer_gone
    assert time.monotonic() - began >= 0.05
    mailbox.close()


def read_on(reader: Reader, said: Connection) -> None:
    reader.open()
    said.send("open")
    message = reader.wait(30.0)
    said.send(None if message is None else int(message.value["number"]))
    reader.close()


def named(process: int | None) -> list[str]:
    """Return the shared memory of a process that has a name, which would outlive the process."""
    maps = Path(f"/proc/{process}/maps")
    mapped = [line for line in maps.read_text().splitlines() if "/dev/shm/" in line]  # noqa: S108
    return [line for line in mapped if not line.endswith(" (deleted)")]


def test_the_memory_has_no_name_that_could_be_left() -> None:
    mailbox = Mailbox(RECORD)
    writer = mailbox.writer.open()
    heard, said = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(target=read_on, args=(mailbox.reader, said), daemon=True)
    process.start()
    assert heard.poll(30.0)
    assert heard.recv() == "open"
    if sys.platform == "linux":
        assert named(os.getpid()) == named(process.pid) == []
    writer.put(record(5))
    assert heard.poll(30.0)
    assert heard.recv() == 5
    process.join(30.0)
    assert process.exitcode == 0
    mailbox.close()
    mailbox.close()  # Closing twice has no effect.
    with pytest.raises(OSError, match="Bad file descriptor"):
        mailbox.passive_reader()


def test_mailboxes_leave_no_descriptor_open() -> None:
    opened = Path("/proc/self/fd")
    if not opened.is_dir():
        pytest.skip("this system does not list open files")
    before = len(list(opened.iterdir()))
    for _ in range(3):
        mailbox = Mailbox(RECORD)
        mailbox.writer.open()
        mailbox.passive_reader().close()
        mailbox.close()
    assert len(list(opened.iterdir())) == before


def test_without_memory_files_it_is_a_file_without_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delattr(os, "memfd_create", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    mailbox = Mailbox(RECORD)
    mailbox.writer.open().put(record(3))
    message = mailbox.reader.open().latest()
    assert message is not None
    assert is_whole(message.value)
    assert list(tmp_path.iterdir()) == []
    mailbox.close()


def test_the_bench_measures_every_value_that_was_taken() -> None:
    latencies = mailbox_bench.measure("mailbox (pipe)", 30)
    # Values that the reader of a busy machine missed are left out.
    assert 1 <= len(latencies) <= 30
    assert (latencies > 0.0).all()


def test_what_cannot_be_a_mailbox_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2 slots"):
        Mailbox(RECORD, slots=1)
    with pytest.raises(ValueError, match="Python objects"):
        Mailbox(np.dtype([("any", object)]))
