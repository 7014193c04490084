"""Marks of rows: a sample of each row's cases is run again here and compared with what it says.

Besides, the id of every case must fit its fields, as far as this computer can tell.
"""

import hashlib
import random
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rich.console import Console

from experiments.leaderboard.rows import Row
from experiments.run import reproduction
from experiments.run.benchmark import CASE_LIMIT, label, progress_bar
from experiments.run.engines import Engine, Interrupts
from experiments.run.reproduction import Verdict, origin_words, prepared, reproduce
from experiments.run.tables import Result


class Mark(NamedTuple):
    """Verdict of the reruns on a row."""

    words: str = "not rerun"
    remark: str = ""
    refuted: bool = False
    """True if a case does not reproduce: the row is not ranked."""
    differs: str = ""
    """Versions, sources and processor of the row where they are not those of this computer."""


def sample(row: Row, number: int, seed: int) -> list[Result]:
    """Draw cases of a row, by its folder and agent, so that other rows do not change the draw."""
    cases = sorted(row.cases, key=lambda case: str(case["id"]))
    digest = hashlib.sha256(f"{seed}\n{row.key}".encode(errors="backslashreplace")).digest()
    return random.Random(digest).sample(cases, min(number, len(cases)))  # noqa: S311


def marks_of(
    rows: Sequence[Row],
    samples: Mapping[str, Sequence[Result]],
    *,
    engine: Engine,
    open_named_files: bool,
    console: Console,
    limit: float = CASE_LIMIT,
) -> dict[str, Mark]:
    """Run the samples again and return the mark of each row by its key.

    Parameters
    ----------
    rows
        Rows, whose ids fit.
    samples
        Cases of each row, by its key.
    engine
        Where the cases run.
    open_named_files
        True runs the agents and opens the files that cases name: for results that are trusted.
    console
        Receives the progress.
    limit
        Time limit of a case, s.
    """
    wanted = {
        row.key: prepared(
            samples[row.key], row.store.manifest_of, open_named_files=open_named_files
        )
        for row in rows
    }
    chosen = [one for prepared_rows in wanted.values() for one in prepared_rows.chosen]
    verdicts: dict[int, Verdict] = {}
    with progress_bar(console) as progress, Interrupts() as interrupts:
        bar = progress.add_task("cases", total=len(chosen))
        for verdict in reproduce(
            chosen, engine, limit=limit,
            started=lambda spec: progress.update(bar, description=label(spec)),
        ):  # fmt: skip
            interrupts.check()
            verdicts[id(verdict.row)] = verdict
            progress.advance(bar)
    return {
        key: _mark(
            [verdicts[id(one)] for one in prepared_rows.chosen],
            [*prepared_rows.not_run.elements(), *prepared_rows.damaged.elements()],
        )
        for key, prepared_rows in wanted.items()
    }


def altered(row: Row) -> Mark | None:
    """Return the mark of a row that has a case whose id does not fit its fields, else None.

    Only cases of these sources and versions can be checked, and those that name no files.
    """
    found = [one for one in prepared(row.cases, row.store.manifest_of).chosen if one.altered]
    if not found:
        return None
    words = f"✗ does not reproduce: {len(found)} of {len(row.cases)} ids do not fit"
    return Mark(words, f"{found[0].words}: {found[0].altered}", refuted=True)


def _mark(verdicts: Sequence[Verdict], not_run: Sequence[str]) -> Mark:
    """Summarise the reruns of a row's sample."""
    left = f"{len(not_run)} not rerun: {not_run[0]}" if not_run else ""
    compared = [one for one in verdicts if not one.note]
    differ = [one for one in compared if one.differences]
    if differ:
        first = f"{differ[0].row.words}: {differ[0].differences[0]}"
        words = f"✗ does not reproduce ({len(differ)} of {len(compared)})"
        return Mark(words, first, refuted=True)
    notes = [one.note for one in verdicts if one.note]
    if not compared:
        return (
            Mark("– not rerun", next(iter([*notes, *not_run]), "")) if notes or not_run else Mark()
        )
    count = f"({len(compared)} of {len(verdicts) + len(not_run)})"
    differs = next((origin_words(one.row) for one in compared if not one.exact), "")
    inexact = any(not one.exact and one.equal < one.values for one in compared)
    way = f"within {reproduction.RELATIVE:g}" if inexact else "bit for bit"
    return Mark(f"✓ {way} {count}", "; ".join(filter(None, [left, *notes[:1]])), differs=differs)
