"""The door that every file comes through: regular files of bounded size, JSON with bounds."""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pytest

from trajectories.fileio import (
    DEEPEST,
    LARGEST_INTEGER,
    checked,
    parse_json,
    read_bytes,
    read_json,
    shortened,
    shown,
)


def refusal(call: Any, *arguments: Any) -> str:
    with pytest.raises(ValueError, match=r".") as caught:
        call(*arguments)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) <= 320
    return message


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"12345")
    assert read_bytes(file, 5) == b"12345"
    assert refusal(read_bytes, file, 4) == f"{file}: 5 bytes are too many: at most 4 are read"
    os.truncate(file, 2**40)  # sparse
    assert "1099511627776 bytes are too many" in refusal(read_bytes, file, 4)


@pytest.mark.parametrize("reader", [read_bytes, read_json])
def test_what_is_no_regular_file_is_not_waited_for(reader: Any, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("pipe", "link"):
        assert "no regular file" in refusal(reader, tmp_path / name)
    assert "no regular file" in refusal(reader, Path("/dev/zero"))
    assert "Is a directory" in refusal(reader, tmp_path)
    assert "levels of symbolic links" in refusal(reader, tmp_path / "loop")
    assert "No such file" in refusal(reader, tmp_path / "none")
    assert "null byte" in refusal(reader, "a\0b")
    assert "File name too long" in refusal(reader, "x" * 100_000)


@pytest.mark.parametrize(
    "value", [{"a": [1, -2.5, None, True, "é\n"]}, [], 0, "\ud800", LARGEST_INTEGER, 5e-324]
)
def test_json_is_read(value: Any, tmp_path: Path) -> None:
    file = tmp_path / "value.json"
    for content in (json.dumps(value).encode(), b"\xef\xbb\xbf" + json.dumps(value).encode()):
        file.write_bytes(content)
        assert read_json(file) == value


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "is not JSON: Expecting value"),
        ('{"a": 1', "is not JSON"),
        ("1 2", "is not JSON: Extra data"),
        ("[" * 100_000, "nested too deeply"),
        ("[" * (DEEPEST + 1) + "0" + "]" * (DEEPEST + 1), "nested too deeply"),
        ('{"a":' * 50 + "0" + "}" * 50, "nested too deeply"),
        ("[1e400]", "'1e400' is beyond double precision"),
        ("-" + "9" * 400 + ".0", "is beyond double precision"),
        ("NaN", "NaN is no number"),
        ("-Infinity", "-Infinity is no number"),
        (str(LARGEST_INTEGER + 1), "is beyond 64 bits"),
        ("1" * 500_000, "is beyond 64 bits"),
        ('{"a": 1, "a": 1}', "key 'a' twice"),
        (f'{{"{"k" * 500_000}": 1, "{"k" * 500_000}": 1}}', "twice"),
        ('"\0"', "is not JSON"),
        (b"\xff\xfe1\0", "is not a text file in UTF-8 (byte 0)"),
        ('{"a": 1}'.encode("utf-16"), "is not a text file in UTF-8"),
    ],
)  # fmt: skip
def test_what_is_not_json_of_ours_is_refused(content: str | bytes, reason: str) -> None:
    said = refusal(parse_json, content, "here, line 3")
    assert said.startswith("here, line 3: ")
    assert reason in said


def test_the_deepest_json_is_read() -> None:
    text = "[" * DEEPEST + "0" + "]" * DEEPEST
    assert json.dumps(parse_json(text, "here")) == text


def test_words_for_infinity_are_read_where_python_has_written_them() -> None:
    found = parse_json("[Infinity, -Infinity, NaN]", "here", infinite=True)
    assert found[:2] == [math.inf, -math.inf]
    assert math.isnan(found[2])
    assert "beyond double" in refusal(lambda: parse_json("1e400", "here", infinite=True))


@dataclass(frozen=True)
class Part:
    size: float
    ends: tuple[float, float]

    def __post_init__(self) -> None:
        if self.size < 0.0:
            raise ValueError("size must not be negative")


class Whole(msgspec.Struct, forbid_unknown_fields=True):
    parts: list[Part]
    note: str = ""


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ([], "Expected `object`, got `array`"),
        ({}, "missing required field `parts`"),
        ({"parts": [{"size": 1, "ends": [0, 1]}, {"size": "1", "ends": [0, 1]}]},
         "Expected `float`, got `str` - at `$.parts[1].size`"),
        ({"parts": [{"size": True, "ends": [0, 1]}]}, "got `bool`"),
        ({"parts": [{"size": 1, "ends": [0]}]}, "length 2, got 1 - at `$.parts[0].ends`"),
        ({"parts": [{"size": -1, "ends": [0, 1]}]}, "size must not be negative"),
        ({"parts": [], "n" * 500_000: 1}, "unknown field `nnn"),
    ],
)  # fmt: skip
def test_a_schema_names_the_place(value: Any, reason: str) -> None:
    said = refusal(checked, value, Whole, "here")
    assert said.startswith("here: ")
    assert reason in said


def test_a_schema_gives_its_type() -> None:
    found = checked({"parts": [{"size": 1, "ends": [0, 2]}]}, Whole, "here")
    assert found == Whole([Part(1.0, (0.0, 2.0))])


@pytest.mark.parametrize(
    "value", ["x" * 500_000, 10**5000, [["y" * 9000] * 50] * 50, {"a\nb\0": "\x1b[2J"}, "\ud800"],
    ids=("long", "huge", "nested", "unprintable", "surrogate"),
)  # fmt: skip
def test_values_are_shown_on_one_line(value: object) -> None:
    for text in (shown(value), shortened(shown(value))):
        assert len(text) < 130
        assert text.isprintable()


def test_texts_are_shortened_in_their_middle() -> None:
    assert shortened("a b") == "a b"
    assert shortened("a\n  b") == "a b"
    assert shortened("\x1b[2J") == r"\x1b[2J"
    long = shortened("b" * 1000 + "e" * 1000)
    assert long.startswith("bbb")
    assert long.endswith("eee")
    assert len(long) < 200
