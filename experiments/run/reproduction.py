"""Run cases of a results folder again, from its files alone, and compare every value.

Where versions, sources and processor are those that made a result, every bit must be the same;
elsewhere numbers are compared with a tolerance.
"""

import json
import os
import random
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from agents.registry import agent_class
from experiments.run.case import BaseCase, Case, failed_case, run_case
from experiments.run.engines import Engine
from experiments.run.exact import OUTCOMES, values_of
from experiments.run.foreign import opened_by
from experiments.run.metrics import BANDS
from experiments.run.provenance import changes_since, manifest_key
from experiments.run.result_schema import read_case
from experiments.run.settings import conditions_words
from experiments.run.store import BLOCK
from experiments.run.tables import path_name
from experiments.run.traffic import TrafficCase
from experiments.run.worker_process import DIED, LATE
from trajectories.arguments import shortened, shown
from trajectories.fileio import opened, parse_json

Result = Mapping[str, Any]
Spec = Mapping[str, Any]

RELATIVE, ABSOLUTE = 1e-3, 1e-5
"""Tolerances of numbers that were computed with other versions or on another processor.

Between NumPy 2.2, SciPy 1.15, Numba 0.61, CasADi 3.7.0 and the newest versions, the largest
relative difference of a metric by more than the absolute tolerance (SI units) was 1e-6 in 1,999 of
2,000 drives, of the suites `quick` (20), `realtime` (240 of four agents) and `limits` (1,740 of
three), and 7e-4 in one, of the NMPC at the limit of friction.
"""
WORD = re.compile(r"[\w-]+")
ALTERED = "its fields or files were changed after it was driven"
MEASURED = "delays are measured on the machine and differ from run to run"
SAME: Mapping[str, Sequence[str]] = {"versions": (), "sources": (), "processor": ()}
"""Changes of a manifest whose key is that of this machine: none."""


class NotRunError(ValueError):
    """A sound row is not run again, for the reason that it names."""


@dataclass(frozen=True)
class Row:
    """A stored result, what it drove, and how this machine differs from the one that made it.

    `changes` are in words, by kind, see `experiments.run.provenance.changes_since`. Of a row that
    is not `whole`, such as one from a table, only the values that it has are compared.
    """

    result: Result
    case: BaseCase
    changes: Mapping[str, Sequence[str]]
    whole: bool = True

    @cached_property
    def altered(self) -> str:
        """Return how its id contradicts its fields, files, versions and sources; "" if not."""
        stored = self.result.get("id")
        if stored in (None, self.case.id) or self.changes["versions"] or self.changes["sources"]:
            return ""
        return f"{ALTERED}: the id is {stored}, that of what it says is {self.case.id}"

    @cached_property
    def same_code(self) -> bool:
        """True if versions and sources are those that made it, which the id proves if it fits."""
        known = not self.changes["versions"] and not self.changes["sources"]
        return known or self.result.get("id") == self.case.id

    @property
    def same_bits(self) -> bool:
        """True if every bit must be the same here."""
        return self.same_code and not self.changes["processor"]

    @property
    def words(self) -> str:
        """Say which case it is."""
        spec = self.case.as_dict()
        parts = [spec["agent"], path_name(self.case.place)]
        parts += [str(spec[key]) for key in ("vehicle", "speed_mode") if key in spec]
        parts += [f"{spec[key]:g}" for key in ("fixed_speed", "grip") if spec.get(key) is not None]
        if (conditions := spec["conditions"]) != "simulation":
            parts.append(conditions_words(conditions))
        parts.append(f"seed {spec['seed']}")
        if "id" in self.result:
            parts.append(f"({self.result['id']})")
        return shortened(" ".join(parts))


@dataclass(frozen=True)
class Verdict:
    """A row that was run again.

    `values` were compared, of which `equal` have the same bits; `largest` is the largest relative
    difference of a number that differs by more than `ABSOLUTE`; each line of `differences` names a
    value, there and here. A `note` says why a row that could not be compared is no difference.
    """

    row: Row
    exact: bool
    values: int = 0
    equal: int = 0
    largest: float = 0.0
    differences: Sequence[str] = ()
    note: str = ""


@dataclass
class Rows:
    """Rows to run again, and how many are not, by the reason: of sound ones and of damaged ones."""

    chosen: list[Row] = field(default_factory=list)
    not_run: Counter[str] = field(default_factory=Counter)
    damaged: Counter[str] = field(default_factory=Counter)


def kind_of(spec: Spec) -> type[BaseCase]:
    """Return the class of a spec's or result's case."""
    return TrafficCase if "scene" in spec else Case


def case_of(result: Result) -> BaseCase:
    """Return the case of a stored result; fields that it lacks have their defaults.

    Raises
    ------
    ValueError
        For an entry that no case of this version has, or without an agent and a place.
    """
    kind = kind_of(result)
    known = _fields(kind)
    spec = {}
    for key, value in result.items():
        if key not in (*known, *OUTCOMES):
            raise ValueError(f"this version knows no entry {shown(key)} of a result")
        if key in known and value is not None:
            spec[key] = value
    for key in ("agent", "trajectory"):
        if key in known and key not in spec:
            raise ValueError(f"the result names no {key}")
    return kind(**spec)


def prepared(
    results: Iterable[Result],
    manifest_of: Callable[[str], Mapping[str, Any]] | None = None,
    *,
    open_named_files: bool = False,
    whole: bool = True,
) -> Rows:
    """Prepare stored results to be run again.

    Parameters
    ----------
    results
        Results of `ResultStore.cases` or `pasted`.
    manifest_of
        Returns the manifest of a key, such as `ResultStore.manifest_of`; None knows none.
    open_named_files
        True runs the agents and opens the files that results name: for results that are trusted.
    whole
        True counts a value that a result lacks as a difference.
    """
    rows, here = Rows(), manifest_key()

    @cache
    def changes(key: str, packages: Sequence[str]) -> Mapping[str, Sequence[str]]:
        manifest = {} if manifest_of is None else manifest_of(key)
        return SAME if key == here else changes_since(manifest, packages)

    for result in results:
        try:
            case = _case_to_run(result, open_named_files)
        except NotRunError as error:
            rows.not_run[str(error)] += 1
        except (ValueError, OSError) as error:
            rows.damaged[str(error)] += 1
        else:
            key = str(result.get("manifest", "before"))
            rows.chosen.append(Row(result, case, changes(key, case.packages()), whole))
    return rows


def _case_to_run(result: Result, open_named_files: bool) -> BaseCase:
    named = opened_by(result)
    if named[:1] == [result.get("agent")] and WORD.fullmatch(named[0]):
        agent_class(named[0])  # no file or module, but a name that is not known
    if named and not open_named_files:
        raise NotRunError(
            f"to run it again would open or execute {shown(named[0])}: --open-named-files does, "
            "for results you trust"
        )
    for file in named:
        stem = file.rpartition(":")[0] if ".py:" in file else file
        if not (os.path.exists(stem) or ":" in stem):  # noqa: PTH110
            raise NotRunError(f"{shown(file)} is not here; run this where the results were made")
    case = case_of(result)
    if (result.get("computing") or {}).get("control") == "measured":
        raise NotRunError(MEASURED)
    if next(values_of(result), None) is None:
        raise ValueError("the result holds no value to compare")
    if named:
        case.id  # noqa: B018  raises for a file that cannot be read
    return case


def pasted(text: str) -> list[dict[str, Any]]:
    """Read results as JSON objects one after another, each on one line or wrapped over several.

    Raises
    ------
    ValueError
        In one line, if there is none, or for anything else.
    """
    try:
        rows = list(_objects(text))
    except ValueError:
        # A page breaks lines anywhere, within numbers and texts.
        joined = "".join(text.splitlines())
        if joined == text:
            raise
        rows = list(_objects(joined))
    if not rows:
        raise ValueError("standard input: holds no result; give JSON objects, one or several")
    for number, row in enumerate(rows, start=1):
        filled = {"id": "none", "status": "ok", "agent": "none", **row}
        read_case(json.dumps(filled).encode(), f"standard input, result {number}")
    return rows


def _objects(text: str) -> Iterator[dict[str, Any]]:
    decoder, place, number = json.JSONDecoder(), 0, 0
    while rest := text[place:].lstrip():
        place, number = len(text) - len(rest), number + 1
        try:
            _, end = decoder.raw_decode(text, place)
        except (ValueError, RecursionError):
            end = len(text)
        row = parse_json(text[place:end], f"standard input, result {number}")
        if not isinstance(row, dict):
            raise ValueError(f"standard input, result {number}: must be a JSON object")  # noqa: TRY004
        yield row
        place = end


def reproduce(
    rows: Sequence[Row],
    engine: Engine,
    *,
    limit: float,
    exact: bool = False,
    started: Callable[[Spec], None] | None = None,
) -> Iterator[Verdict]:
    """Run the cases of rows again and yield what became of each, as they end.

    Parameters
    ----------
    rows
        Rows of `prepared`.
    engine
        Where the cases run.
    limit
        Time limit of a case, s.
    exact
        True compares bits even where versions, sources or processor differ.
    started
        Called with the fields of each case as it starts.
    """
    wanted: dict[str, list[Row]] = {}
    for row in rows:
        wanted.setdefault(_what_is_driven(row.case.as_dict()), []).append(row)
    specs = [group[0].case.as_dict() for group in wanted.values()]
    for result in engine.run(
        specs, _run, started=started, failed=_failed, limit=limit, files=_files, identity=_identity
    ):
        for row in wanted[_what_is_driven(result)]:
            # A cluster may have run it on a computer of another kind.
            same = row.same_bits and result["manifest"] == manifest_key()
            yield judged(row, result, exact=exact or same)


def _fields(kind: type[BaseCase]) -> tuple[str, ...]:
    return tuple(one.name for one in fields(kind))  # type: ignore[arg-type]


def _what_is_driven(result: Result) -> str:
    return json.dumps({name: result[name] for name in _fields(kind_of(result))})


def _run(spec: Spec) -> dict[str, Any]:
    return run_case(spec, kind_of(spec))


def _failed(spec: Spec, error: str) -> dict[str, Any]:
    return failed_case(spec, error, kind_of(spec))


def _identity(spec: Spec) -> str:
    return kind_of(spec)(**spec).id


def _files(spec: Spec) -> list[Path]:
    return kind_of(spec)(**spec).present_files()


def judged(row: Row, result: Result, *, exact: bool) -> Verdict:
    """Compare a row with the result of its case here, bit for bit if `exact`.

    Within the tolerance, metrics of curvature bands are left out: they jump at the bands' edges.
    """
    there, here = dict(values_of(row.result)), dict(values_of(result))
    error = str(row.result.get("error") or "")
    if error.startswith((LATE, DIED)) and here.get("error") != error:
        now = here.get("end") or here.get("error")
        return Verdict(row, exact, note=f"failed there: {error}; here: {now}")
    names = [*there, *(name for name in here if name not in there and row.whole and row.same_code)]
    if there.get("status", "ok") != here["status"]:
        # A failed case lacks most values: only the failure itself is told.
        names = [name for name in ("status", "end", "error") if name in there or name in here]
    if not exact:
        # The last digit decides to which band a place at its edge belongs.
        names = [name for name in names if name.rpartition("_")[2] not in BANDS.names]
    pairs = [(name, there.get(name), here.get(name)) for name in names]
    lines = [
        f"{name} {_shown(old)} there, {_shown(new)} here"
        for name, old, new in pairs
        if old != new and (exact or not _close(old, new))
    ]
    if row.altered:
        lines.insert(0, row.altered)
    equal = sum(old == new for _, old, new in pairs)
    largest = max((_relative(old, new) for _, old, new in pairs), default=0.0)
    return Verdict(row, exact, len(pairs), equal, largest, lines)


def _shown(value: object) -> str:
    return "missing" if value is None else shortened(value)


def _close(old: object, new: object) -> bool:
    numbers = isinstance(old, int | float) and isinstance(new, int | float)
    return numbers and _relative(old, new) <= RELATIVE


def _relative(old: object, new: object) -> float:
    """Return the relative difference of numbers; 0 if it is small, or for anything else."""
    if not (isinstance(old, int | float) and isinstance(new, int | float)):
        return 0.0
    change = abs(old - new)
    return change / max(abs(old), abs(new)) if change > ABSOLUTE else 0.0


def sampled(rows: Sequence[Row], number: int, seed: int) -> list[Row]:
    """Return a random sample of rows, or all if there are no more, in their order."""
    places = random.Random(seed).sample(range(len(rows)), min(number, len(rows)))  # noqa: S311
    return [rows[place] for place in sorted(places)]


def origin_words(row: Row) -> str:
    """Say what differs between the machine that made a row and this one."""
    kinds = ("processor",) if row.same_code else ("versions", "sources", "processor")
    changes = [line for kind in kinds for line in row.changes[kind]]
    return "; ".join(changes) or "the same versions, sources and processor as here"


def torn_line(file: Path) -> list[str]:
    """Return a line that names the incomplete last line of `cases.jsonl`, if there is one."""
    last, number = b"\n", 0
    with opened(file) as handle:
        while part := handle.readline(BLOCK):
            number += last.endswith(b"\n")
            last = part
    if last.endswith(b"\n"):
        return []
    return [f"{file}, line {number}: is torn, as a run that was killed leaves it"]
