"""Compare two folders of results, value by value to the last digit.

Cases are paired by what they drive, not by their ids, which change with the project's sources.
Computing times differ from run to run; they are summed up apart and count as no difference.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.run.store import ResultStore

Result = Mapping[str, Any]

EXAMPLE = "python -m experiments.run.compare results/before results/after"
OUTCOMES = (
    "id", "status", "error", "end", "others", "metrics", "solver", "warnings", "seconds",
    "latency", "training", "trace", "manifest",
)  # fmt: skip
"""Entries of a result that say how its case went; all others say what was driven."""
COMPARED = ("status", "end", "others", "metrics", "solver", "warnings")
MEDIANS = ("solver.median", "metrics.predict_median")
TIMES = (*MEDIANS, "solver.p99", "solver.max")
MOST = 40
"""Most differences that are printed."""


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
        old, new = dict(_values(before[spec])), dict(_values(after[spec]))
        for name in [*old, *(name for name in new if name not in old)]:
            if name in TIMES:
                continue
            found.values += 1
            if name not in old or name not in new or old[name] != new[name]:
                change = f"{old.get(name, 'missing')} -> {new.get(name, 'missing')}"
                found.differences.append(f"{_words(spec)}: {name} {change}")
        for name in MEDIANS:
            if name in old and name in new:
                pair = old[name], new[name]
                found.times.setdefault(str(before[spec]["agent"]), []).append(pair)
    return found


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


def _values(case: Result) -> Iterator[tuple[str, Any]]:
    """Compared entries of a result by their dotted names."""
    for key in COMPARED:
        value = case.get(key)
        if isinstance(value, Mapping):
            yield from ((f"{key}.{name}", inner) for name, inner in value.items())
        elif value is not None:
            yield key, value


def _words(spec: str) -> str:
    return ", ".join(f"{key} {value}" for key, value in json.loads(spec).items() if value)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the differences; return 0 if there are none, 1 if there are, 2 without results."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.run.compare", description=__doc__,
        epilog=f"example: {EXAMPLE}", formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("first", type=Path, metavar="A", help="folder of results")
    parser.add_argument("second", type=Path, metavar="B", help="folder to compare with it")
    options = parser.parse_args(arguments)
    try:
        found = compare(options.first, options.second)
    except (ValueError, OSError) as error:
        print(f"compare: {error}")
        return 2
    for line in found.differences[:MOST]:
        print(line)
    if len(found.differences) > MOST:
        print(f"... and {len(found.differences) - MOST} more")
    for agent, pairs in found.times.items():
        old, new = (1e3 * np.median(times) for times in zip(*pairs, strict=True))
        print(f"time of predict, median over cases: {agent} {old:.3f} -> {new:.3f} ms")
    print(
        f"{found.paired} cases in both, {found.values} values, "
        f"{len(found.differences) or 'no'} difference{'' if len(found.differences) == 1 else 's'}"
    )
    return 1 if found.differences else 0


if __name__ == "__main__":
    raise SystemExit(main())
