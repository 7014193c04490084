"""Lines are decoded fast where that is safe, results are compact, and stored whole."""

import json
import signal
import subprocess
import sys
import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.run import result_schema, store
from experiments.run.compact import Packed, Sharing
from experiments.run.result_schema import plain, read_case
from experiments.run.store import ResultStore
from tests.helpers import made_results as made


def line_of(result: dict[str, Any]) -> bytes:
    return json.dumps(result, sort_keys=True).encode()


LINES = [
    line_of(made.case(1)),
    line_of(made.case(2, conditions={"name": "ideal", "friction": [0.5, 1.0]}, seed=-3)),
    line_of(made.case(3, warnings=["T2: a: text, of colons", "and “quotes”"], status="failed")),
    line_of(made.case(4, agent_settings={"weights": {"a:b": 1e-7}, "horizon": 20})),
]


def outcome(line: bytes) -> Any:
    try:
        return repr(read_case(line, "line"))
    except ValueError as error:
        return str(error)


def test_the_fast_way_to_read_a_line_agrees_with_the_careful_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    extra = [*b'{}[]":,\\0123456789-+.eE\x00\x1f\x7f \t\xc2\x80ntu', *b'":"']
    pieces = [
        b'"id": "1", ', b'"agent": ', b"1e999", b"123456789012345678901234567890", b"[" * 40,
        b"9223372036854775808", b"-9223372036854775807", b'"a": 1, ', b"\\u003a", b"\\ud800",
        b'"a":"b":', b"0.00012345678901234567", b"true", b"null", b"{}", b"1.0", b"-0", b"NaN",
        b"\xff",
    ]  # fmt: skip
    lines = list(LINES)
    for _ in range(4000):
        line = bytearray(LINES[rng.integers(len(LINES))])
        for _ in range(rng.integers(1, 4)):
            place = int(rng.integers(len(line)))
            if rng.random() < 0.5:
                line[place : place + int(rng.integers(3))] = bytes([int(rng.choice(extra))])
            else:
                line[place:place] = pieces[rng.integers(len(pieces))]
        lines.append(bytes(line))
    fast = [outcome(line) for line in lines]
    decoded = sum(result_schema._harmless(line) is not None for line in lines)
    monkeypatch.setattr(result_schema, "_harmless", lambda _: None)
    assert fast == [outcome(line) for line in lines]
    assert 100 < decoded < len(lines)
    assert sum(text.startswith("{") for text in fast) > 100


def test_lines_of_results_take_the_fast_way() -> None:
    assert all(result_schema._harmless(line) == json.loads(line) for line in LINES[:2])
    assert result_schema._harmless(LINES[3]) == json.loads(LINES[3])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (b'"seed": 0, "seed": 0', "key 'seed' twice"),
        (b'"seed": 9223372036854775808', "beyond 64 bits"),
        (b'"seed": 0, "more": 1e999', "beyond double precision"),
        (b'"seed": 0, "more": ' + b"[" * 40 + b"]" * 40, "nested too deeply"),
        (b'"seed": 0, "more": "\\u009b"', "characters that cannot be printed"),
        (b'"seed": 0, "more": "\x7f"', "characters that cannot be printed"),
    ],
)
def test_what_the_fast_way_would_miss_is_refused(damage: bytes, words: str) -> None:
    assert b'"seed": 0' in LINES[0]
    with pytest.raises(ValueError, match=words):
        read_case(LINES[0].replace(b'"seed": 0', damage), "line 7")


def test_a_line_that_is_too_long_is_named_and_the_next_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(result_schema, "LONGEST_LINE", 3000)
    monkeypatch.setattr(store, "LONGEST_LINE", 3000)
    monkeypatch.setattr(store, "BLOCK", 100)
    long = made.case(1, error="x" * 4000)
    lines = [line_of(made.case(0)), line_of(long), line_of(made.case(2)), line_of(long)]
    (tmp_path / "cases.jsonl").write_bytes(b"\n".join(lines))
    skipped: list[str] = []
    held = ResultStore(tmp_path)
    assert held.ids(skipped) == {made.case(k)["id"]: "ok" for k in (0, 2)}
    (message,) = skipped
    assert message.endswith("cases.jsonl, line 2: is longer than 3000 bytes")
    with pytest.raises(ValueError, match="longer than 3000 bytes"):
        result_schema.as_stored(long)
    held.append(made.case(5))
    assert list(held.ids([])) == [made.case(k)["id"] for k in (0, 2, 5)]


def test_a_file_that_holds_no_results_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "MOST_UNREADABLE", 3)
    (tmp_path / "cases.jsonl").write_bytes(b"x\n" * 10)
    with pytest.raises(ValueError, match=r"cases\.jsonl: more than 3 lines cannot be read"):
        ResultStore(tmp_path).cases([])


def test_compact_results_are_equal_and_share_what_they_have_in_common() -> None:
    sharing = Sharing()
    results = [json.loads(line) for line in LINES]
    compact = [sharing.compact(result) for result in results]
    assert compact == results
    assert [dict(one) for one in compact] == results
    assert [plain(one, "case") for one in compact] == results
    assert json.dumps(plain(compact[1], "case")) == json.dumps(results[1])
    first, second = compact[0], compact[1]
    assert first["agent_settings"] is second["agent_settings"]
    assert first["trajectory"] is second["trajectory"]
    assert first.get("nothing", 3) == 3
    assert "nothing" not in first
    assert {**first, "seed": 9} == {**results[0], "seed": 9}
    with pytest.raises(KeyError, match="nothing"):
        first["nothing"]
    with pytest.raises(TypeError):
        first["seed"] = 1  # type: ignore[index]


def test_compact_values_keep_their_types() -> None:
    results = [
        {"id": str(k), "metrics": {"a": value}, "start": {"x": value}}
        for k, value in enumerate((1, 1.0, True, -0.0, 0.0))
    ]
    sharing = Sharing()
    for result in results:
        assert repr(sharing.compact(result)) == repr(result)


def test_a_result_takes_less_than_two_kilobytes() -> None:
    def size(value: Any) -> int:
        """Return the bytes of what is not shared: containers, numbers and the id."""
        if isinstance(value, Packed):
            return sys.getsizeof(value) + size(value._values)
        own = sys.getsizeof(value) + 16  # of the garbage collector
        if isinstance(value, tuple):
            return own + sum(map(size, value))
        return own if isinstance(value, array | float) or value == result["id"] else 0

    result = made.case(1)
    result["metrics"] = {f"metric_{k}": 0.1 * k for k in range(60)}
    assert size(Sharing().compact(result)) < 2000


SWEEP = """
import os, sys
from pathlib import Path
from experiments.run.store import ResultStore
with ResultStore(Path(sys.argv[1])) as store:
    for number in range(10**6):
        trace = {"time": [0.0, 1.0]} if number % 50 == 0 else {}
        store.append({"id": f"{number:016x}", "agent": "a", "status": "ok", "trace": trace})
        print(number, flush=True)
"""


def test_a_kill_loses_no_result_that_was_appended(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    appended = -1
    for moment in range(3):
        folder = tmp_path / str(moment)
        process = subprocess.Popen(
            [sys.executable, "-c", SWEEP, str(folder)], stdout=subprocess.PIPE
        )
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        time.sleep(rng.uniform(0.0, 0.3))
        process.send_signal(signal.SIGKILL)
        lines += process.stdout.readlines()
        process.wait()
        process.stdout.close()
        appended = int(lines[-1] if lines[-1].endswith(b"\n") else lines[-2])
        held = ResultStore(folder)
        numbers = [int(name, 16) for name in held.ids()]
        # One more may have been written before it was printed.
        assert numbers in (list(range(appended + 1)), list(range(appended + 2)))
        assert all(held.trace(f"{k:016x}") is not None for k in numbers[::50])
        held.append(made.case(10**8))
        assert len(held.ids()) == len(numbers) + 1
    assert appended > 0


def test_results_of_a_sweep_are_on_disk_within_a_second_and_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[float] = []
    fsync = store.os.fsync

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        synced.append(time.monotonic())

    monkeypatch.setattr(store.os, "fsync", noted)
    monkeypatch.setattr(store, "TOGETHER", 0.2)
    with ResultStore(tmp_path) as held:
        for number in range(100):
            held.append(made.case(number))
        written = time.monotonic()
        before = len(synced)
        assert before < 20
        while len(synced) == before and time.monotonic() < written + 10.0:
            time.sleep(0.01)
        # Nobody appends any more, and yet the last results reach the disk.
        assert len(synced) > before
        held.append(made.case(100))
        before = len(synced)
    assert len(synced) > before
    held.append(made.case(101))
    assert len(synced) > before + 1
    assert len(held.ids()) == 102


def test_a_full_disk_leaves_whole_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ResultStore(tmp_path) as held:
        held.append(made.case(1))
        assert held._lines is not None
        handle = held._lines._handle

        class Full:
            def __getattr__(self, name: str) -> Any:
                return getattr(handle, name)

            def write(self, content: bytes) -> int:
                if len(content) < 200:
                    raise OSError(28, "No space left on device")
                return handle.write(content[:150])

        monkeypatch.setattr(held._lines, "_handle", Full())
        with pytest.raises(OSError, match="No space left"):
            held.append(made.case(2))
        monkeypatch.setattr(held._lines, "_handle", handle)
        held.append(made.case(3))
    assert list(held.ids()) == [made.case(1)["id"], made.case(3)["id"]]


def test_a_disk_that_fails_ends_the_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(store.os, "fsync", fails)
    with pytest.raises(OSError, match="Input/output error"):
        ResultStore(tmp_path).append(made.case(1))
