"""A latest-value mailbox between processes: one writer, and readers that never block it.

The values lie in shared memory: a sequence number, and a few slots used in turn::

    0    uint64   sequence number of the newest complete value, 0 before the first
    64   slots    each [uint64 sequence, int64 stamp, uint64 checksum, value], in lines of 64 bytes

Value n goes to slot n modulo the number of slots. The sequence number at the front is written last;
then a byte into a pipe wakes the one reader that waits. There is no lock that a killed writer could
hold: whenever it is killed, the front still names the last complete value, in another slot than the
torn one.

Readers do not rely on the order in which their processor sees these writes (x86 keeps it, ARM does
not, and Python has no memory fence). A copied slot is valid only if it has the expected sequence
number and the CRC-32 over sequence, stamp and value matches. Otherwise the writer has reused the
slot, or not all of its bytes are visible yet, and the reader tries again.

The memory never has a name: a process gets it as an open descriptor, as it gets the pipe. So the
system frees it with the last process, however that ends, even if all are killed at once.
"""

import mmap
import os
import select
import struct
import tempfile
import time
import zlib
from multiprocessing import reduction
from multiprocessing.connection import Connection, Pipe
from typing import Any, NamedTuple, Self

import numpy as np

FRONT = 64
LINE = 64
CHECKED = struct.Struct("=Qq")
CHECKSUM = struct.Struct("=Q")
HEAD = struct.Struct("=QqQ")
"""Sequence number and stamp, which are checked with the value, and their checksum."""
ATTEMPTS = 10_000
"""Attempts of a reader to copy a value that is being overwritten."""


class Message(NamedTuple):
    """A complete value."""

    sequence: int
    """1 for the first value, then one more for each."""
    stamp: int
    """`time.monotonic_ns()` at the time of writing; all processes share this clock."""
    value: Any
    """A numpy record (np.void) of the mailbox's dtype, read-only."""


class MailboxError(RuntimeError):
    """The memory of a mailbox does not hold the value that its sequence number names."""


class Mailbox:
    """Memory and pipe of a mailbox, in the process that creates them and hands out the ends.

    The ends are passed to processes as arguments of `multiprocessing.Process` (spawn). A process
    opens the end that it uses (`open` or `with`) and closes the other.

    Parameters
    ----------
    dtype
        Type of a value: a numpy structured type without objects.
    slots
        Number of values kept. More than 2 make retries of a reader rarer, and `Reader.wait_all`
        returns those in between.

    Raises
    ------
    ValueError
        For a dtype with objects, or fewer than 2 slots.
    """

    def __init__(self, dtype: np.dtype[Any], *, slots: int = 4) -> None:
        if dtype.hasobject:
            raise ValueError(f"a mailbox cannot hold Python objects: {dtype}")
        if slots < 2:
            raise ValueError(f"a mailbox needs at least 2 slots, not {slots}")
        self.dtype, self.slots = dtype, slots
        self._descriptor = nameless(FRONT + slots * _stride(dtype))
        waiting, waking = Pipe(duplex=False)
        for connection in (waiting, waking):
            os.set_blocking(connection.fileno(), False)
        self.writer = Writer(self._descriptor, dtype, slots, waking)
        self.reader = Reader(self._descriptor, dtype, slots, waiting)
        """The only reader that can wait."""

    def passive_reader(self) -> "Reader":
        """Return a further reader, which can read but not wait."""
        return Reader(self._descriptor, self.dtype, self.slots, None)

    def close(self) -> None:
        """Close both ends in this process."""
        self.writer.close()
        self.reader.close()
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def nameless(size: int) -> int:
    """Return the descriptor of new shared memory, `size` bytes of zeros, that has no name."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("mailbox")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor


class _End:
    """Common part of writer and reader: the views of the memory that `open` creates."""

    def __init__(
        self, descriptor: int, dtype: np.dtype[Any], slots: int, connection: Connection | None
    ) -> None:
        self._dtype, self._slots = dtype, slots
        self._connection = connection
        self._stride = _stride(dtype)
        self._descriptor = os.dup(descriptor)
        self._memory: mmap.mmap | None = None
        self._buffer: Any = None
        self._front: Any = None

    def __getstate__(self) -> dict[str, Any]:
        # Valid for a process that is being started, as of the connection.
        return {**self.__dict__, "_descriptor": reduction.DupFd(self._descriptor)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _descriptor=state["_descriptor"].detach())

    def open(self) -> Self:
        """Attach to the memory, in the process that uses this end.

        Raises
        ------
        OSError
            If this end has been closed.
        """
        if self._memory is None:
            self._memory = mmap.mmap(self._descriptor, FRONT + self._slots * self._stride)
            self._buffer = memoryview(self._memory)
            self._front = self._buffer[:8].cast("Q")
        return self

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Detach, and close this process's end of the pipe."""
        if self._memory is not None:
            self._front.release()
            self._buffer.release()
            self._memory.close()
            self._memory = self._buffer = self._front = None
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
        if self._connection is not None:
            self._connection.close()
            self._connection = None


class Writer(_End):
    """The writing end; there is one."""

    def put(self, record: np.ndarray[Any, Any]) -> int:
        """Write a value, an array () of the mailbox's dtype; return its sequence number."""
        value = record.tobytes()
        sequence = self._front[0] + 1
        checked = CHECKED.pack(sequence, time.monotonic_ns())
        content = checked + CHECKSUM.pack(zlib.crc32(value, zlib.crc32(checked))) + value
        offset = FRONT + sequence % self._slots * self._stride
        self._buffer[offset : offset + len(content)] = content
        self._front[0] = sequence
        self._wake()
        return int(sequence)

    def _wake(self) -> None:
        if self._connection is None:
            return
        try:
            os.write(self._connection.fileno(), b"\0")
        except BlockingIOError:
            pass  # The pipe is full of wakes that the reader has not read.
        except BrokenPipeError:  # The reader is gone.
            self._connection.close()
            self._connection = None


class Reader(_End):
    """An end that reads; values are given out once by `wait` and `wait_all`."""

    def __init__(
        self, descriptor: int, dtype: np.dtype[Any], slots: int, connection: Connection | None
    ) -> None:
        super().__init__(descriptor, dtype, slots, connection)
        self.last_read = 0
        """Sequence number of the newest value that was returned."""
        self.writer_gone = False
        """True once a wait has found that no process has the writing end open."""

    def latest(self) -> Message | None:
        """Return the newest complete value, read before or not; None before the first.

        Raises
        ------
        MailboxError
            If no copy was valid in thousands of attempts.
        """
        for _ in range(ATTEMPTS):
            sequence = self._front[0]
            if sequence == 0:
                return None
            message = self._copy(sequence)
            if message is not None:
                return message
        raise MailboxError("a mailbox's newest value is not whole: its memory was written over")

    def wait(self, timeout: float) -> Message | None:
        """Return the newest unread value; None if none arrives within `timeout` s."""
        if not self._wait(timeout):
            return None
        message = self.latest()
        assert message is not None
        self.last_read = message.sequence
        return message

    def wait_all(self, timeout: float) -> list[Message]:
        """Return all unread values that are still there, oldest first; [] after `timeout` s.

        Gaps in the sequence numbers show values that were lost.
        """
        if not self._wait(timeout):
            return []
        newest = int(self._front[0])
        first = max(self.last_read + 1, newest - self._slots + 1)
        copies = [self._copy(sequence) for sequence in range(first, newest + 1)]
        messages = [message for message in copies if message is not None]
        if not messages:  # All were overwritten while they were copied.
            message = self.latest()
            assert message is not None
            messages = [message]
        self.last_read = messages[-1].sequence
        return messages

    def _wait(self, timeout: float) -> bool:
        """Wait up to `timeout` s for an unread value; return whether there is one."""
        deadline = time.monotonic() + timeout
        while self._front[0] <= self.last_read:
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            if self._connection is None or self.writer_gone:
                time.sleep(left)
                continue
            # Unlike poll and epoll, select has a timeout finer than milliseconds.
            ready, _, _ = select.select([self._connection], [], [], left)
            if ready and not os.read(self._connection.fileno(), 4096):
                self.writer_gone = True
        return True

    def _copy(self, sequence: int) -> Message | None:
        """Return the value of a sequence number if it is complete and still there."""
        offset = FRONT + sequence % self._slots * self._stride
        size = HEAD.size + self._dtype.itemsize
        content = bytes(self._buffer[offset : offset + size])
        found, stamp, checksum = HEAD.unpack_from(content)
        value = content[HEAD.size :]
        if found != sequence or checksum != zlib.crc32(value, zlib.crc32(content[: CHECKED.size])):
            return None
        return Message(found, stamp, np.frombuffer(value, self._dtype)[0])


def _stride(dtype: np.dtype[Any]) -> int:
    """Return the bytes from slot to slot: whole cache lines, so that slots share none."""
    return -(-(HEAD.size + dtype.itemsize) // LINE) * LINE
