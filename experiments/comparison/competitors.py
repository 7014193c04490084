"""Competitors: an agent's drives in a folder of results, and which of them meet.

Of every result only what a comparison needs is kept, so that many fit into memory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from experiments.comparison.measures import Measure
from experiments.run.regimes import passed
from experiments.run.result_schema import read_case
from experiments.run.settings import Setting, setting_of
from experiments.run.store import ResultStore
from experiments.run.tables import drive_of, label_of, labels, path_name, training_of
from trajectories.arguments import shortened
from trajectories.naming import choose

Result = Mapping[str, Any]

USUAL_BASELINE = "lpv-nmpc"


class Drive(NamedTuple):
    """Setting, path and seed of a drive."""

    setting: str
    path: str
    seed: int

    def __str__(self) -> str:
        return f"{path_name(self.path)} seed {self.seed} ({self.setting})"


class Run(NamedTuple):
    """Outcome of a drive: loss by measure, and the median time of `predict`, s."""

    losses: tuple[float, ...]
    passed: bool
    seconds: float | None


@dataclass(frozen=True)
class Competitor:
    """Runs of one agent in one folder, by drive (see `tables.drive_of`) and training."""

    folder: Path
    label: str
    runs: dict[str, dict[int | None, Run]] = field(repr=False)

    @property
    def trainings(self) -> list[int | None]:
        """Training seeds; [None] for an agent that has none."""
        found = {training for runs in self.runs.values() for training in runs}
        return sorted(found, key=lambda seed: -1 if seed is None else seed)


@dataclass(frozen=True)
class Folder:
    """Competitors of a folder, in the order of the registry, and the drives of all."""

    path: Path
    competitors: dict[str, Competitor]
    drives: dict[str, Drive]
    metrics: frozenset[str]
    """Names of the metrics that any of the drives has."""


def read_folder(path: Path, measures: Sequence[Measure], skipped: list[str]) -> Folder:
    """Read the competitors of a folder; of results that repeat one, the last counts.

    `skipped` receives a message for each line that cannot be read.

    Raises
    ------
    ValueError
        If the folder does not exist or holds no results.
    """
    runs: dict[str, dict[str, dict[int | None, Run]]] = {}
    one_each: dict[str, Result] = {}
    drives: dict[str, Drive] = {}
    titles: dict[Setting, str] = {}
    metrics: set[str] = set()
    for case in ResultStore(path).stream(skipped, _read) if path.is_dir() else ():
        metrics.update(case["metrics"])
        key = drive_of(case)
        if key not in drives:
            if (setting := setting_of(case)) not in titles:
                titles[setting] = str(setting)
            place = str(case.get("trajectory") or case.get("scene"))
            drives[key] = Drive(titles[setting], place, case.get("seed", 0))
        done = passed(case)
        run = Run(
            tuple(one.loss(case, passed=done) for one in measures), done,
            case["solver"].get("median"),
        )  # fmt: skip
        label = label_of(case)
        one_each.setdefault(label, case)
        runs.setdefault(label, {}).setdefault(key, {})[training_of(case)] = run
    if not runs:
        raise ValueError(f"no results in {path}")
    found = {label: Competitor(path, label, runs[label]) for label in labels(one_each.values())}
    return Folder(path, found, drives, frozenset(metrics))


def _read(line: bytes, name: str) -> dict[str, Any]:
    """Read a result of any kind of case; a drive that does not say how it ended has failed."""
    return {"metrics": {}, "solver": {}, "end": None, **read_case(line, name)}


Pair = tuple[Competitor, Competitor]
"""A baseline and a competitor that is compared with it."""


def pairs_within(folder: Folder, agents: Sequence[str], baseline: str | None) -> list[Pair]:
    """Pair the agents of one folder with its baseline.

    The baseline is by default the first of `agents`, else `lpv-nmpc`, else the first there is.

    Raises
    ------
    ValueError
        For an unknown agent, or fewer than two.
    """
    known = list(folder.competitors)
    chosen = [label_among(name, known) for name in agents]
    usual = USUAL_BASELINE if USUAL_BASELINE in known else known[0]
    first = label_among(baseline, known) if baseline else (chosen or [usual])[0]
    others = [name for name in dict.fromkeys(chosen or known) if name != first]
    if not others:
        raise ValueError(
            f"{folder.path} holds no agent to compare with {shortened(first, 80)}: give a second "
            "folder, or --agents"
        )
    return [(folder.competitors[first], folder.competitors[name]) for name in others]


def pairs_between(
    folders: Sequence[Folder], agents: Sequence[str], baseline: str | None
) -> list[Pair]:
    """Pair agents of further folders with the first folder's.

    With `baseline` they all meet that agent of the first folder. Without it, agents meet their
    namesake there; if there is none, all meet the first folder's only agent.

    Raises
    ------
    ValueError
        For an unknown agent, or if it is open which of the first folder's agents is meant.
    """
    first, *others = folders
    chosen = _chosen(folders, agents)
    rest = [
        one for folder in others for one in folder.competitors.values()
        if chosen is None or one.label in chosen
    ]  # fmt: skip
    own = [one for name, one in first.competitors.items() if chosen is None or name in chosen]
    if baseline:
        base = first.competitors[label_among(baseline, tuple(first.competitors))]
        found = [(base, one) for one in rest]
    elif namesakes := [one for one in rest if one.label in {other.label for other in own}]:
        found = [(first.competitors[one.label], one) for one in namesakes]
    elif len(own) == 1:
        found = [(own[0], one) for one in rest]
    else:
        raise ValueError(
            f"no agent is in {first.path} and in another folder: say with --baseline which of "
            f"{shortened(', '.join(first.competitors))} the others are compared with"
        )
    if not found:
        raise ValueError(f"none of the agents {', '.join(agents)} is in a folder after the first")
    return found


def _chosen(folders: Sequence[Folder], agents: Sequence[str]) -> set[str] | None:
    """Return the labels of the agents in any of the folders; None for all."""
    if not agents:
        return None
    known = tuple(dict.fromkeys(name for folder in folders for name in folder.competitors))
    return {label_among(name, known) for name in agents}


def label_among(name: str, known: Sequence[str]) -> str:
    """Return the label that a user means by itself, or by its agent's name if that is one's alone.

    Raises
    ------
    ValueError
        Listing the labels, if it is none of them.
    """
    begun = [label for label in known if label.split(" (")[0] == name]
    if name not in known and len(begun) == 1:
        return begun[0]
    return choose("agent", name, tuple(known))
