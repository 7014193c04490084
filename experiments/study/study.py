"""The tuning study: every rung trained for several seeds and evaluated on the same drives.

A rung is a way to tune weights: a method, its budget, its view and its conditions. The folder of a
study holds `trainings/LABEL-SEED/` as `lpv-track tune` leaves them, and `judged/SET/LABEL-SEED.npz`
with the evaluation of each. Only what is missing is made, so a study resumes where it stopped.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.policy import load
from experiments.jobs.job import PROGRESS, Line, Listener, read_lines
from experiments.run.engines import Engine
from experiments.run.folder_lock import locked
from experiments.run.store import read_arrays, write_arrays
from experiments.study.evaluation import FIGURES, EvaluationSet, Evaluator
from experiments.tuning.loop import WEIGHTS, tune
from experiments.tuning.settings import TuningSettings, usual
from trajectories.arguments import shortened
from trajectories.fileio import checked, file_name, read_json, write_atomically
from trajectories.naming import choose

Array = NDArray[Any]
Figures = dict[str, Array]

SETTINGS = "study.json"
BLOCK = 12
"""Trainings that a worker evaluates in one go: making the environments takes as long as several."""

# Rungs --------------------------------------------------------------------------------------------

BASELINE = "search x10"
"""Label of the best fixed set at ten times the others' budget, which gains are relative to."""
OURS = "paired"
"""Label of the project's own method."""
PPO = "rl"
"""Label of PPO from a library."""


@dataclass(frozen=True)
class Rung:
    """A way to tune weights; its budget is `factor` times that of the study."""

    label: str
    method: str
    words: str
    factor: int = 1
    view: str = "all"
    conditions: str = "randomised"

    @property
    def by_path(self) -> bool:
        """True if a set is chosen once for a path."""
        return self.method == "paper"

    @property
    def baseline(self) -> str:
        """Label of the rung to compare with: the best fixed set under the same conditions."""
        return f"{BASELINE}, simulation" if self.conditions == "simulation" else BASELINE

    def settings(self, seed: int, solves: int) -> TuningSettings:
        """Return the settings of a training."""
        return usual(
            self.method, seed=seed, solves=self.factor * solves, view=self.view,
            conditions=self.conditions,
        )  # fmt: skip

    def command(self, seed: int, solves: int) -> str:
        """Return the command that makes the same weights."""
        words = ["lpv-track", "tune", "--method", self.method]
        words += ["--solves", str(self.factor * solves), "--seed", str(seed)]
        return " ".join([*words, "--view", self.view, "--conditions", self.conditions])


RUNGS: tuple[Rung, ...] = (
    Rung("default", "fixed", "default weights"),
    Rung("paper", "paper", "a set by the path's sharpest curvature, searched"),
    Rung("search", "search", "best fixed set, CMA-ES"),
    Rung(BASELINE, "search", "the same at ten times the budget", factor=10),
    Rung("bands", "bands", "a set a band, CMA-ES"),
    Rung("gradient", "gradient", "a set a band, gradients of the closed loop"),
    Rung("catalogue", "catalogue", "PPO chooses of 25 sets"),
    Rung(PPO, "rl", "PPO multiplies weights"),
    Rung(OURS, "paired", "a linear policy multiplies weights, learned from pairs of drives"),
    Rung("paired, path", "paired", "the same, shown curvature alone", view="path"),
    Rung("paired, drive", "paired", "the same, shown the drive's history alone", view="drive"),
    # Without disturbances, drives differ in the curvature of the path alone.
    Rung(f"{BASELINE}, simulation", "search", "best fixed set without disturbances", 10,
         conditions="simulation"),
    Rung("bands, simulation", "bands", "a set a band without disturbances",
         conditions="simulation"),
    Rung("rl, simulation", "rl", "PPO shown curvature alone, without disturbances", view="path",
         conditions="simulation"),
    Rung("paired, simulation", "paired", "a linear policy shown curvature alone, without them",
         view="path", conditions="simulation"),
)  # fmt: skip


def rung_of(label: str) -> Rung:
    """Return the rung with a label."""
    return next(rung for rung in RUNGS if rung.label == label)


def checked_labels(labels: Sequence[str]) -> tuple[str, ...]:
    """Return labels of rungs, all of them known.

    Raises
    ------
    ValueError
        Naming the one that is not.
    """
    return tuple(choose("rung", label, tuple(rung.label for rung in RUNGS)) for label in labels)


# The study's folder -------------------------------------------------------------------------------


class StoredStudy(TypedDict):
    """Content of `study.json`."""

    solves: int
    sets: dict[str, Any]


@dataclass(frozen=True)
class Study:
    """A study: trainings of `labels` for `seeds`, each of `solves` times the rung's factor."""

    folder: Path
    labels: tuple[str, ...]
    seeds: tuple[int, ...]
    solves: int
    sets: tuple[EvaluationSet, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return all that determines the trainings and evaluations, in plain JSON."""
        return {
            "solves": self.solves,
            "sets": {
                one.name: {"paths": list(one.labels), "seeds": one.seeds, "vehicle": one.vehicle}
                for one in self.sets
            },
        }  # fmt: skip

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Make the folder this study's, and lock it meanwhile.

        Raises
        ------
        ValueError
            If it holds a study with another budget or other drives, or another process uses it.
        """
        with locked(self.folder):
            self._claim()
            yield

    def _claim(self) -> None:
        file, own = self.folder / SETTINGS, self.as_dict()
        if file.exists():
            kept = checked(read_json(file), StoredStudy, file)
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
        """Return the folder of a training."""
        return self.folder / "trainings" / f"{file_name(label)}-{seed}"

    def evaluations(self, name: str) -> Path:
        """Return the folder of the evaluations on a set."""
        return self.folder / "judged" / file_name(name)

    def evaluation(self, name: str, label: str, seed: int) -> Path:
        """Return the file of a training's evaluation on a set."""
        return self.evaluations(name) / f"{file_name(label)}-{seed}.npz"

    def trainings(self) -> list[tuple[Rung, int]]:
        """Return all trainings, the longest first so that a pool ends evenly."""
        rungs = sorted((rung_of(label) for label in self.labels), key=lambda rung: -rung.factor)
        return [(rung, seed) for rung in rungs for seed in self._seeds_of(rung)]

    def _seeds_of(self, rung: Rung) -> tuple[int, ...]:
        """Return the seeds of a rung: the default weights are the same for every seed."""
        return self.seeds[:1] if rung.method == "fixed" else self.seeds

    def read(self, name: str, label: str) -> dict[str, Array]:
        """Read the figures of a rung on a set, (trainings, paths, drives) each."""
        every = [
            read_figures(self.evaluation(name, label, seed))
            for seed in self._seeds_of(rung_of(label))
        ]
        return {key: np.stack([one[key] for one in every]) for key in FIGURES}

    def progress(self, label: str, seed: int) -> list[Line]:
        """Read the lines of a training's progress; none for the default weights."""
        folder = self.training(label, seed)
        return read_lines(folder) if (folder / PROGRESS).exists() else []


def read_figures(file: Path) -> Figures:
    """Read the figures of a file, (paths, drives) each.

    Raises
    ------
    ValueError
        In one line, if the file cannot be used.
    """
    try:
        content = read_arrays(file)
        return {name: content[name] for name in FIGURES}
    except (ValueError, KeyError) as error:
        raise ValueError(
            f"{file} cannot be used ({shortened(error)}): remove it, and it is made anew"
        ) from None


# Trainings and evaluations ------------------------------------------------------------------------


def train_one(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Train one rung for one seed, or resume it; for a pool of processes."""
    settings = rung_of(spec["label"]).settings(spec["seed"], spec["solves"])
    tune(settings, Path(spec["folder"]), Listener(), command=spec["command"])
    return {"label": spec["label"], "seed": spec["seed"]}


def evaluate_one(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Evaluate a block of trainings on a set; for a pool of processes."""
    given: EvaluationSet = spec["set"]
    evaluator = Evaluator(given)
    for label, weights, file in spec["todo"]:
        figures = evaluator.evaluate(load(Path(weights)), by_path=rung_of(label).by_path)
        write_arrays(Path(file), figures)
    return {"set": given.name}


def run_trainings(study: Study, engine: Engine) -> Iterator[tuple[int, int]]:
    """Run the missing trainings; yields (done, all) after each."""
    specs = [
        {
            "folder": str(folder), "label": rung.label, "seed": seed, "solves": study.solves,
            "command": rung.command(seed, study.solves),
        }
        for rung, seed in study.trainings()
        if not ((folder := study.training(rung.label, seed)) / WEIGHTS).exists()
    ]  # fmt: skip
    yield 0, len(specs)
    ended = engine.run(specs, train_one, failed=_died, folder=_folder)
    for k, _ in enumerate(ended):
        yield k + 1, len(specs)


def run_evaluations(study: Study, engine: Engine) -> Iterator[tuple[int, int]]:
    """Run the missing evaluations; yields (done, all) after each block."""
    specs = []
    for given in study.sets:
        todo = [
            (rung.label, str(study.training(rung.label, seed) / WEIGHTS), str(file))
            for rung, seed in study.trainings()
            if not (file := study.evaluation(given.name, rung.label, seed)).exists()
        ]
        folder = str(study.evaluations(given.name))
        specs += [
            {"set": given, "folder": folder, "todo": todo[k : k + BLOCK]}
            for k in range(0, len(todo), BLOCK)
        ]
    yield 0, len(specs)
    ended = engine.run(specs, evaluate_one, failed=_died, files=_weights, folder=_folder)
    for k, _ in enumerate(ended):
        yield k + 1, len(specs)


def _folder(spec: Mapping[str, Any]) -> Path:
    return Path(spec["folder"])


def _weights(spec: Mapping[str, Any]) -> list[Path]:
    return [Path(weights) for _, weights, _ in spec["todo"]]


def _died(spec: Mapping[str, Any], error: str) -> dict[str, Any]:
    raise RuntimeError(f"{spec.get('label') or spec['set'].name}: {error}")
