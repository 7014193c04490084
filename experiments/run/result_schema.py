"""Schema of a stored case, and the way of a result into it and back.

The same check holds for what a case leaves and for what anybody may have written into
`cases.jsonl`: no result is stored that cannot be read. Most lines are recognised as harmless JSON
at first sight, and decoded fast; all others go through `parse_json`, which names what is wrong.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, Required, TypedDict

import msgspec
import numpy as np
from msgspec import Meta

from trajectories.fileio import DEEPEST, LARGEST_INTEGER, checked, parse_json

Case = dict[str, Any]

Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
Time = Annotated[float, Meta(ge=0.0, le=1e12)]
Count = Annotated[int, Meta(ge=0)]
Text = Annotated[str, Meta(max_length=100_000)]
Name = Annotated[str, Meta(max_length=1000)]
Id = Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_-]{1,64}\Z")]
"""An id is part of a file's name."""
Settings = dict[str, Any] | None
CONTROL = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Characters that a terminal takes for commands, that HTML forbids, or that turn the direction of
the text around them, and halves of characters.
"""
LONGEST_LINE = 2**22
"""Longest line of `cases.jsonl` that is written and read, bytes."""


class Solver(TypedDict, total=False):
    """Times of `predict` (s) and solves."""

    median: Time
    p99: Time
    max: Time
    failures: Count | None
    solves: Count | None
    statuses: dict[str, Count]
    fallbacks: dict[str, Count]
    mean_iterations: Number | None
    slack: Annotated[list[Number], Meta(min_length=3, max_length=3)] | None


class Training(TypedDict, total=False):
    """Cost of making a learned policy."""

    algorithm: Name
    steps: Count
    seconds: Time
    solves: Count
    command: str


class Computing(TypedDict, total=False):
    """Arguments of `experiments.run.computing.ComputingTimes`."""

    arrangement: Name
    load: Number


class Searched(TypedDict, total=False):
    """Arguments of `experiments.run.search.Search`."""

    setting: Literal["fixed_speed", "grip"]


class Stored(TypedDict, total=False):
    """A line of `cases.jsonl`; old results lack some entries, and there may be further ones."""

    id: Required[Id]
    status: Required[Literal["ok", "failed"]]
    agent: Required[Name]
    trajectory: Name
    scene: Name
    vehicle: Name
    conditions: Name | dict[str, Any]
    seed: int
    speed_mode: Name
    fixed_speed: Number | None
    grip: Number | None
    control_period: Annotated[float, Meta(gt=0.0, le=3600.0)]
    vehicle_changes: Settings
    agent_settings: Settings
    env_settings: Settings
    computing: Computing | None
    regime: Name
    start: Settings
    search: Searched | None
    end: Name | None
    error: Text | None
    seconds: Time
    warnings: list[Text]
    metrics: dict[str, Number]
    solver: Solver
    training: Training
    others: Count | None
    manifest: Name


class Errors(TypedDict, total=False):
    """Metrics that the tables cannot do without."""

    mle: Required[Number]
    ale: Required[Number]
    aoe: Required[Number]
    duration: Required[Time]


class Times(TypedDict, total=False):
    """Times that the tables cannot do without."""

    median: Required[Time]
    p99: Required[Time]


class Driven(TypedDict, total=False):
    """Entries of a case that drove a path, beside those of `Stored`."""

    trajectory: Required[Name]
    metrics: Required[Errors]
    solver: Required[Times]


def read_case(line: bytes, name: str) -> Case:
    """Read a line of `cases.jsonl`.

    Raises
    ------
    ValueError
        In one line that begins with `name`, if it is too long, is not JSON, does not fit the
        schema, or holds characters that cannot be printed.
    """
    if len(line) > LONGEST_LINE:
        raise ValueError(f"{name}: is longer than {LONGEST_LINE} bytes")
    case = _harmless(line)
    if case is None:
        case = checked(parse_json(line, name), Case, name)
        if any(CONTROL.search(text) for text in _texts(case)):
            raise ValueError(f"{name}: holds characters that cannot be printed")
    checked(case, Stored, name)
    return case


def _harmless(line: bytes) -> Case | None:
    """Decode a line that surely passes `parse_json` and holds no `CONTROL`; None for any other.

    Without escapes, ASCII that is JSON holds no such characters. Brackets bound the depth. As many
    colons as keys and texts have mean that no key stands twice.
    """
    printable = line.isascii() and b"\\" not in line and b"\x7f" not in line
    if not printable or line.count(b"{") + line.count(b"[") > DEEPEST:
        return None
    try:
        found: Case = msgspec.json.decode(line, type=dict)
    except msgspec.MsgspecError:
        return None
    keys = 0
    outer: list[Any] = [found]
    for value in outer:
        is_object = isinstance(value, dict)
        keys += len(value) if is_object else 0
        for inner in value.values() if is_object else value:
            kind = type(inner)
            if kind is dict or kind is list:
                outer.append(inner)
            elif kind is int and abs(inner) > LARGEST_INTEGER:
                return None
    colons = line.count(b":") - keys
    if colons and colons != sum(text.count(":") for text in _texts(found)):
        return None
    return found


def read_driven(line: bytes, name: str) -> Case:
    """Read a line of `cases.jsonl` whose case drove a path, with all that tables and reports need.

    Raises
    ------
    ValueError
        As `read_case`, or for a case of another kind.
    """
    case = read_case(line, name)
    if case["status"] == "ok":
        checked(case, Driven, name)
    for key, empty in (("metrics", {}), ("solver", {}), ("warnings", [])):
        case.setdefault(key, empty)
    return case


def _texts(value: Any) -> Iterator[str]:
    """Yield every text in plain JSON, keys included."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield key
            yield from _texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner)


def as_stored(result: Mapping[str, Any]) -> Case:
    """Return a result as a folder gives it back: plain JSON, and a trace of numbers.

    Raises
    ------
    ValueError, TypeError
        In one line that names the entry, if it holds anything else.
    """
    line = {key: plain(value, key) for key, value in result.items() if key != "trace"}
    line = read_case(json.dumps(line).encode(), "the result")
    if "trace" not in result:
        return line
    trace = {name: np.asarray(values, float) for name, values in result["trace"].items()}
    return {**line, "trace": trace}


def plain(value: Any, name: str) -> Any:
    """Convert NumPy's values, tuples and mappings to plain JSON; numbers must be finite.

    Raises
    ------
    ValueError, TypeError
        In one line that names the entry.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(inner, f"{name}.{key}") for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner, f"{name}[{k}]") for k, inner in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} is {value}, not a finite number")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{name} is of type {type(value).__name__}, which a result cannot hold")
