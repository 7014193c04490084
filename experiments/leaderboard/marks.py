"""Marks of rows: a sample of each row's cases is run again here and compared with what it says."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from rich.console import Console

import agents
from experiments.leaderboard.rows import Row
from experiments.run.benchmark import progress_bar
from experiments.run.engines import Engine
from experiments.run.exact import values_of
from experiments.run.tables import USUAL, Result

Kind = Literal["equal", "close", "differs", "closed"]

NOT_RERUN = "not rerun"
CLOSED = "own agent file; give --open-named-files"


class Rerun(NamedTuple):
    """A case that was run again: equal bit by bit, within the tolerance, different, or not run.

    `words` says what differs, or why it was not run.
    """

    id: str
    kind: Kind
    words: str = ""


class Mark(NamedTuple):
    """What reruns say of a row."""

    words: str = NOT_RERUN
    remark: str = ""
    refuted: bool = False
    """True if a case does not reproduce: the row is not ranked."""


def sample(row: Row, number: int, seed: int) -> list[Result]:
    """Draw cases of a row, by its folder and agent, so that other rows do not change the draw."""
    cases = sorted(row.cases, key=lambda case: str(case["id"]))
    digest = hashlib.sha256(f"{seed}\n{row.key}".encode()).digest()
    random = np.random.default_rng(int.from_bytes(digest[:8]))
    count = min(number, len(cases))
    return [cases[k] for k in sorted(random.choice(len(cases), count, replace=False))]


def mark_of(reruns: Sequence[Rerun]) -> Mark:
    """Summarise the reruns of a row's sample."""
    by_kind: dict[Kind, list[Rerun]] = {}
    for one in reruns:
        by_kind.setdefault(one.kind, []).append(one)
    differs, closed = by_kind.get("differs", []), by_kind.get("closed", [])
    close, run = by_kind.get("close", []), len(reruns) - len(closed)
    left = f"{len(closed)} not rerun: {closed[0].words}" if closed else ""
    if differs:
        first = f"{differs[0].id}: {differs[0].words}"
        return Mark(f"✗ does not reproduce ({len(differs)} of {run})", first, refuted=True)
    if not run:
        return Mark(f"– {NOT_RERUN}", closed[0].words if closed else "")
    if close:
        remark = "; ".join(filter(None, [close[0].words, left]))
        return Mark(f"✓ within 1e-6 on other versions ({run} of {run})", remark)
    return Mark(f"✓ bit for bit ({run} of {run})", left)


def marks_of(
    rows: Sequence[Row],
    samples: Mapping[str, Sequence[Result]],
    *,
    engine: Engine,
    open_files: bool,
    console: Console,
) -> dict[str, Mark]:
    """Run the samples again and return the mark of each row by its key."""
    reruns: dict[str, list[Rerun]] = {row.key: [] for row in rows if samples[row.key]}
    wanted: dict[str, list[tuple[str, Result]]] = {}
    for key, own in reruns.items():
        for case in samples[key]:
            if open_files or str(case["agent"]) in agents.names():
                wanted.setdefault(str(case["id"]), []).append((key, case))
            else:
                own.append(Rerun(str(case["id"]), "closed", CLOSED))
    firsts = [found[0][1] for found in wanted.values()]
    specs = [{name: case[name] for name in USUAL if name in case} for case in firsts]
    with progress_bar(console) as progress:
        bar = progress.add_task("cases again", total=len(specs))
        for result in engine.run(specs):
            for key, case in wanted.get(result["id"], []):
                reruns[key].append(_compared(case, result))
            progress.advance(bar)
    return {row.key: mark_of(reruns[row.key]) if row.key in reruns else Mark() for row in rows}


def _compared(theirs: Result, ours: Result) -> Rerun:
    old, new = dict(values_of(theirs)), dict(values_of(ours))
    for name in {**old, **new}:
        if old.get(name) != new.get(name):
            words = f"{name}, theirs {old.get(name)}, ours {new.get(name)}"
            return Rerun(str(theirs["id"]), "differs", words)
    return Rerun(str(theirs["id"]), "equal")
