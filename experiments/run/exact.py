"""Compare results value by value to the last digit.

Cases are paired by what they drive, not by their ids, which change with the project's sources.
Computing times differ from run to run; they are summed up apart and count as no difference.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.run.store import ResultStore

Result = Mapping[str, Any]

OUTCOMES = (
    "id", "status", "error", "end", "others", "metrics", "solver", "warnings", "seconds",
    "latency", "tried", "training", "trace", "manifest",
)  # fmt: skip
"""Entries of a result that say how its case went; all others say what was driven."""
COMPARED = (
    "status", "end", "error", "others", "metrics", "solver", "warnings", "latency", "tried",
)  # fmt: skip
MEDIANS = ("solver.median", "metrics.predict_median")
TIMES = (*MEDIANS, "solver.p99", "solver.max")
"""Computing times of this project's own `predict`, which differ from run to run."""
MOST = 40
"""Most differences that are listed."""


def values_of(result: Result) -> Iterator[tuple[str, Any]]:
    """Yield dotted name and value of every entry that says how a case went, without times.

    Values are numbers, texts and truth values; entries without a value are left out.
    """
    for key in COMPARED:
        yield from _leaves(key, result.get(key))


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if name in TIMES or value is None:
        return
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(f"{name}.{key}", inner)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for k, inner in enumerate(value):
            yield from _leaves(f"{name}[{k}]", inner)
    else:
        yield name, value


@dataclass
class Comparison:
    """Outcome of `compare`."""

    paired: int = 0
    values: int = 0
    differences: list[str] = field(default_factory=list)
    """A line for each value that differs, and for each case that only one folder has."""
    times: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """By agent the median times of `predict` in both folders, s, a pair for each case."""


def compare(first: Path, second: Path) -> Comparison:
    """Compare the cases of two folders; of cases that were run twice, the later one counts.

    Raises
    ------
    ValueError
        If a folder holds no results, or a line of it is damaged.
    """
    before, after = _by_spec(first), _by_spec(second)
    found = Comparison()
    for spec in [*before, *(spec for spec in after if spec not in before)]:
        if spec not in after or spec not in before:
            only = first if spec in before else second
            found.differences.append(f"{_words(spec)}: only in {only}")
            continue
        found.paired += 1
        old, new = dict(values_of(before[spec])), dict(values_of(after[spec]))
        for name in [*old, *(name for name in new if name not in old)]:
            found.values += 1
            if name not in old or name not in new or old[name] != new[name]:
                change = f"{old.get(name, 'missing')} -> {new.get(name, 'missing')}"
                found.differences.append(f"{_words(spec)}: {name} {change}")
        for kind, name in (times.split(".") for times in MEDIANS):
            first_time, second_time = (
                (case.get(kind) or {}).get(name) for case in (before[spec], after[spec])
            )
            if first_time is not None and second_time is not None:
                pairs = found.times.setdefault(str(before[spec]["agent"]), [])
                pairs.append((first_time, second_time))
    return found


def report_lines(found: Comparison) -> Iterator[str]:
    """Yield the lines that tell a comparison: at most `MOST` differences, times, and the sum."""
    yield from found.differences[:MOST]
    if len(found.differences) > MOST:
        yield f"... and {len(found.differences) - MOST} more"
    for agent, pairs in found.times.items():
        old, new = (1e3 * np.median(times) for times in zip(*pairs, strict=True))
        yield f"time of predict, median over cases: {agent} {old:.3f} -> {new:.3f} ms"
    yield (
        f"{found.paired} cases in both, {found.values} values, "
        f"{len(found.differences) or 'no'} difference{'' if len(found.differences) == 1 else 's'}"
    )


def _by_spec(folder: Path) -> dict[str, Result]:
    """Results by what was driven, as JSON text; an empty entry is the same as none."""
    cases = ResultStore(folder).cases() if folder.is_dir() else []
    if not cases:
        raise ValueError(f"no results in {folder}")
    return {
        json.dumps(
            {key: case[key] for key in sorted(case) if key not in OUTCOMES and case[key]}
        ): case
        for case in cases
    }


def _words(spec: str) -> str:
    return ", ".join(f"{key} {value}" for key, value in json.loads(spec).items() if value)
