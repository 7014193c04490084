"""Rows of the leaderboard: the results of an agent in a folder, on the drives of a suite.

Rows are compared on the same drives only. Those of a suite are the ones that it gives to every
agent; agents to which it gives less than half of the most, such as IPOPT's in `paper`, do not
count. A folder that was made without a suite is compared with folders of exactly the same drives.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.run import regimes, suites
from experiments.run.case import Case
from experiments.run.resampling import Plan, plan_of
from experiments.run.result_schema import read_driven
from experiments.run.settings import setting_of
from experiments.run.store import ResultStore
from experiments.run.tables import (
    Result,
    by_label,
    current,
    drive_of,
    path_names,
    training_of,
    trainings,
)
from trajectories.arguments import shortened

Array = NDArray[np.float64]

CUSTOM = "custom"
MOST_SEEDS = 100
"""Most seeds for which the drives of a suite are found."""
LONGEST = 120
"""Most characters of a text from a folder that a cell shows."""


@dataclass(frozen=True)
class Row:
    """Results of an agent in one folder, on the drives of a section.

    Parameters
    ----------
    store
        The folder, named as it was given.
    name
        Short name of the folder, which no other of the board has.
    label
        Label of the agent, see `experiments.run.tables.label_of`.
    cases
        Its results on the section's drives; of several trainings each has them.
    further
        Number of its results on other drives.
    drives
        Number of the section's drives.
    """

    store: ResultStore
    name: str
    label: str
    cases: Sequence[Result]
    further: int
    drives: int

    @property
    def key(self) -> str:
        """Text that no other row of the board has."""
        return f"{self.name}\n{self.label}"

    @cached_property
    def manifests(self) -> list[dict[str, Any]]:
        """Manifests of the runs that its cases come from."""
        keys = dict.fromkeys(str(case.get("manifest", "before")) for case in self.cases)
        return [self.store.manifest_of(key) for key in keys]

    @cached_property
    def seeds(self) -> list[int]:
        """Training seeds; empty for an agent that is no folder of several trainings."""
        found = {seed for case in self.cases if (seed := training_of(case)) is not None}
        return sorted(found)

    @cached_property
    def by_training(self) -> dict[int | None, dict[str, Result]]:
        """Results by training seed and drive; one training, None, for all other agents."""
        found: dict[int | None, dict[str, Result]] = {}
        for case in self.cases:
            found.setdefault(training_of(case), {})[drive_of(case)] = case
        return found

    @cached_property
    def shared(self) -> list[str]:
        """Drives that it has; of several trainings, those that all of them have."""
        if not self.cases:
            return []
        first, *others = self.by_training.values()
        return [drive for drive in first if all(drive in other for other in others)]

    @property
    def complete(self) -> bool:
        """True if it has all drives of its section."""
        return bool(self.cases) and len(self.shared) == self.drives

    def losses(self, metric: str) -> Array:
        """Return a metric of each training and shared drive, (trainings, drives).

        A drive that failed counts as infinite.
        """
        of_training = [
            [_loss(found[drive], metric) for drive in self.shared]
            for found in self.by_training.values()
        ]
        return np.array(of_training, dtype=np.float64).reshape(len(self.by_training), -1)

    @cached_property
    def plan(self) -> Plan:
        """Plan of a bootstrap of the shared drives."""
        if not self.cases:
            return plan_of([])
        first = next(iter(self.by_training.values()))
        cases = [first[drive] for drive in self.shared]
        return plan_of(
            [(setting_of(case), str(case["trajectory"]), case.get("seed", 0)) for case in cases]
        )

    @property
    def trained(self) -> list[dict[str, Any]]:
        """Cost of each training, as far as it was recorded."""
        return [training for _, training in trainings(self.cases)]


def _loss(case: Result, metric: str) -> float:
    return float(case["metrics"][metric]) if regimes.passed(case) else float("inf")


@dataclass(frozen=True)
class Section:
    """Rows that have a suite in common.

    Parameters
    ----------
    suite
        Name of the suite; "custom" for folders that were made without one.
    seeds
        Number of seeds for which the suite gives the drives; 1: the fewest seeds of each part.
    drives
        The drives on which its rows are compared.
    rows
        The rows, in no order.
    """

    suite: str
    seeds: int
    drives: frozenset[str]
    rows: list[Row]


def sections_of(folders: Sequence[Path], skipped: list[str]) -> list[Section]:
    """Read folders of results; no file is opened but theirs, and nothing is run.

    Parameters
    ----------
    folders
        The folders.
    skipped
        Receives a message for each line and each folder that cannot be read.

    Raises
    ------
    ValueError
        For a folder without results, and for one that is given twice.
    """
    resolved = [folder.resolve() for folder in folders]
    for place, folder in enumerate(folders):
        if not (folder / "cases.jsonl").is_file():
            raise ValueError(f"no results in {shortened(folder)}: it holds no cases.jsonl")
        if resolved.index(resolved[place]) < place:
            raise ValueError(f"{shortened(folder)} is given twice")
    names = _names([str(folder) for folder in folders])
    found: dict[tuple[str, str], Section] = {}
    for folder, name in zip(folders, names, strict=True):
        store = ResultStore(folder)
        before = len(skipped)
        cases = current(store.cases(skipped, read_driven))
        if not cases:
            skipped.insert(before, f"{folder}: no line of cases.jsonl can be read")
            continue
        suite, seeds = _suite(store.manifest())
        own = suite == CUSTOM
        drives = frozenset(map(drive_of, cases)) if own else drives_of_suite(suite, seeds)
        section = found.setdefault((suite, _digest(drives)), Section(suite, seeds, drives, []))
        for label, group in by_label(cases).items():
            counted = [case for case in group if drive_of(case) in drives]
            further = len(group) - len(counted)
            section.rows.append(Row(store, name, label, counted, further, len(drives)))
    known = [*suites.SUITES, CUSTOM]
    return sorted(found.values(), key=lambda section: (known.index(section.suite), section.seeds))


def _suite(manifest: Mapping[str, Any]) -> tuple[str, int]:
    """Return the suite of a manifest, and the number of seeds with which its drives are found.

    More seeds usually add drives to those of one. Where they are others, as in `limits`, they make
    a section of their own.
    """
    settings = manifest.get("settings")
    given = settings if isinstance(settings, Mapping) else {}
    suite, seeds = given.get("suite"), given.get("seeds")
    if not isinstance(suite, str) or suite not in suites.SUITES:
        return CUSTOM, 1
    count = len(seeds) if isinstance(seeds, list) and 1 <= len(seeds) <= MOST_SEEDS else 1
    if drives_of_suite(suite, 1) <= drives_of_suite(suite, count):
        return suite, 1
    return suite, count


def _names(folders: Sequence[str]) -> list[str]:
    """Return short names of folders: the last part, the last two, or all, so that they differ."""
    short = path_names(folders)
    found = list(short.values())
    return [folder if found.count(short[folder]) > 1 else short[folder] for folder in folders]


def _digest(drives: frozenset[str]) -> str:
    return hashlib.sha256("\n".join(sorted(drives)).encode()).hexdigest()


@cache
def drives_of_suite(suite: str, seeds: int) -> frozenset[str]:
    """Return the drives of a suite that it gives to every agent, with the seeds 0 to `seeds` - 1.

    Some parts of a suite have more seeds than are asked for.
    """
    given: dict[str, set[str]] = {}
    for agent in suites.default_agents():
        for spec in suites.SUITES[suite]((agent,), range(seeds)):
            given.setdefault(spec["agent"], set()).add(drive_of(Case(**spec).as_dict()))
    most = max(len(own) for own in given.values())
    return frozenset.intersection(
        *(frozenset(own) for own in given.values() if 2 * len(own) >= most)
    )


def groups_of(rows: Sequence[Row]) -> list[dict[str, list[Result]]]:
    """Return the groups of drives that count alike in a ranking: cases of each row by its key.

    They are regimes where cases have one, else settings.
    """
    found: dict[str, dict[str, list[Result]]] = {}
    for row in rows:
        for case in row.cases:
            group = str(case.get("regime") or setting_of(case))
            found.setdefault(group, {}).setdefault(row.key, []).append(case)
    return list(found.values())
