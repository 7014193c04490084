"""The tuning study: every rung of the ladder, trained for several seeds, judged on the same drives.

A folder holds all of it: `trainings/LABEL-SEED/` as `lpv-track tune` leaves them, and
`judged/SET/LABEL-SEED.npz`; what is there is not made again, so a study goes on where it stopped.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.policy import load
from experiments.run.engines import local_pool
from experiments.study.evaluation import FIGURES, EvaluationSet, Judge
from experiments.study.ladder import EVERY, Rung, rung
from experiments.tuning.loop import PROGRESS, WEIGHTS, Listener, tune
from trajectories.fileio import write_atomically
from trajectories.naming import choose

Array = NDArray[Any]
Figures = dict[str, Array]

SETTINGS = "study.json"


@dataclass(frozen=True)
class Study:
    """What a study makes: trainings of `labels` for `seeds`, each of `solves` times its factor."""

    folder: Path
    labels: tuple[str, ...]
    seeds: tuple[int, ...]
    solves: int
    sets: tuple[EvaluationSet, ...]

    def as_dict(self) -> dict[str, Any]:
        """What decides what the trainings and their judgements are, in plain JSON."""
        return {
            "solves": self.solves,
            "sets": {
                one.name: {"paths": list(one.labels), "seeds": one.seeds, "vehicle": one.vehicle}
                for one in self.sets
            },
        }  # fmt: skip

    def claim(self) -> None:
        """Make the folder this study's.

        Raises
        ------
        ValueError
            If it holds one of another budget, or other drives to judge on.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        file, own = self.folder / SETTINGS, self.as_dict()
        if file.exists():
            kept = json.loads(file.read_text())
            same = kept["solves"] == own["solves"] and all(
                kept["sets"].get(name, given) == given for name, given in own["sets"].items()
            )
            if not same:
                raise ValueError(
                    f"{self.folder} holds a study of another budget or other drives: give another "
                    "--out"
                )
            own["sets"] = {**kept["sets"], **own["sets"]}
        write_atomically(file, json.dumps(own, indent=2).encode())

    def training(self, label: str, seed: int) -> Path:
        """Folder of a training."""
        return self.folder / "trainings" / f"{plain(label)}-{seed}"

    def judged(self, name: str, label: str, seed: int) -> Path:
        """File of what a training was judged on a set."""
        return self.folder / "judged" / plain(name) / f"{plain(label)}-{seed}.npz"

    def trainings(self) -> list[tuple[Rung, int]]:
        """All of them, the longest first so that a pool ends evenly."""
        rungs = sorted((rung(label) for label in self.labels), key=lambda one: -one.factor)
        # The default weights are the same for every seed.
        return [
            (one, seed)
            for one in rungs
            for seed in (self.seeds[:1] if one.method == "fixed" else self.seeds)
        ]

    def read(self, name: str, label: str) -> dict[str, Array]:
        """Figures of a rung on a set, (trainings, paths, drives) each."""
        seeds = self.seeds[:1] if rung(label).method == "fixed" else self.seeds
        every = [read_figures(self.judged(name, label, seed)) for seed in seeds]
        return {key: np.stack([one[key] for one in every]) for key in FIGURES}

    def progress(self, label: str, seed: int) -> list[dict[str, Any]]:
        """Lines of a training's `progress.jsonl`; none for the default weights."""
        file = self.training(label, seed) / PROGRESS
        if not file.exists():
            return []
        return [json.loads(line) for line in file.read_text().splitlines()]


def plain(name: str) -> str:
    """A name as a file's."""
    return name.replace(", ", "-").replace(" ", "-")


def read_figures(file: Path) -> Figures:
    """Figures of a file, (paths, drives) each.

    Raises
    ------
    ValueError
        In one line, if it cannot be used.
    """
    try:
        with np.load(file, allow_pickle=False) as content:
            return {name: content[name] for name in FIGURES}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"{file} cannot be used ({reason}): remove it, and it is made anew"
        ) from None


def write_figures(file: Path, figures: Figures) -> None:
    """Write figures, atomically."""
    buffer = io.BytesIO()
    named: Any = {name: figures[name] for name in FIGURES}
    np.savez_compressed(buffer, **named)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, buffer.getvalue())


def train_one(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Train one rung for one seed, or go on with it; for a pool of processes."""
    folder = Path(spec["folder"])
    settings = rung(spec["label"]).settings(spec["seed"], spec["solves"])
    listener = Listener(lambda *_: None, lambda _: None)
    tune(settings, folder, listener, command=spec["command"])
    return {"label": spec["label"], "seed": spec["seed"]}


def judge_one(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Judge all trainings of a set that are not yet judged; for a pool of processes."""
    given: EvaluationSet = spec["set"]
    judge = Judge(given)
    for label, weights, file in spec["todo"]:
        figures = judge.judge(load(Path(weights)), by_path=rung(label).by_path)
        write_figures(Path(file), figures)
    return {"set": given.name}


def run_trainings(study: Study, workers: int) -> Iterator[tuple[int, int]]:
    """Make what trainings are missing; (done, all) after each."""
    wanted = [
        (one, seed)
        for one, seed in study.trainings()
        if not (study.training(one.label, seed) / WEIGHTS).exists()
    ]
    specs = [
        {
            "folder": str(study.training(one.label, seed)), "label": one.label, "seed": seed,
            "solves": study.solves, "command": one.command(seed, study.solves),
        }
        for one, seed in wanted
    ]  # fmt: skip
    yield 0, len(specs)
    for k, _ in enumerate(local_pool(specs, workers, run=train_one, died=_died)):
        yield k + 1, len(specs)


def run_judging(study: Study, workers: int) -> Iterator[tuple[int, int]]:
    """Judge what is not yet judged; (done, all) after each block."""
    specs = []
    for given in study.sets:
        todo = [
            (one.label, str(study.training(one.label, seed) / WEIGHTS), str(file))
            for one, seed in study.trainings()
            if not (file := study.judged(given.name, one.label, seed)).exists()
        ]
        # A block takes as long as making its environments, several times over.
        specs += [{"set": given, "todo": todo[k : k + BLOCK]} for k in range(0, len(todo), BLOCK)]
    yield 0, len(specs)
    for k, _ in enumerate(local_pool(specs, workers, run=judge_one, died=_died)):
        yield k + 1, len(specs)


BLOCK = 12
"""Trainings judged in one go."""


def _died(spec: Mapping[str, Any]) -> dict[str, Any]:
    raise RuntimeError(f"a worker died, twice, over {spec.get('label') or spec['set'].name}")


def checked_labels(labels: Sequence[str]) -> tuple[str, ...]:
    """Labels of rungs, all known.

    Raises
    ------
    ValueError
        Naming the one that is not.
    """
    return tuple(choose("rung", label, tuple(one.label for one in EVERY)) for label in labels)
