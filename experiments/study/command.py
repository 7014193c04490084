"""`lpv-track tuning-study`: trainings, judging, oracles, report; goes on where it stopped."""

import argparse
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from agents.weight_tuning.policy import load
from agents.weights import WeightSchedule
from experiments.run.benchmark import progress_bar
from experiments.study import oracle
from experiments.study.evaluation import EvaluationSet, usual_sets
from experiments.study.ladder import EVERY
from experiments.study.oracle import Headroom
from experiments.study.report import write_report
from experiments.study.study import Study, checked_labels, run_judging, run_trainings
from experiments.tuning.loop import WEIGHTS
from trajectories.fileio import write_atomically
from trajectories.importers import read_racetrack

ORACLE, REPORT = "oracle.json", "report.html"
POOL, BRANCHES = 64, 12
"""Sets drawn for the oracles' pool, and tried by the greedy one in every window."""


def study_of(options: argparse.Namespace) -> Study:
    """The study that the options ask for.

    Raises
    ------
    ValueError
        For an unknown rung, an impossible number, or a folder without tracks.
    """
    solves = options.solves
    if not (math.isfinite(solves) and solves >= 1 and solves == int(solves)):
        raise ValueError(f"--solves must be a whole number of at least 1, not {solves:g}")
    if options.seeds < 1 or options.drives < 2:
        raise ValueError("--seeds must be at least 1, --drives at least 2")
    labels = checked_labels(options.rungs or [one.label for one in EVERY])
    quick = options.quick
    sets = usual_sets(2 if quick else options.drives)
    if options.tracks is not None:
        sets.append(track_set(options.tracks, options.drives))
    return Study(
        options.out, labels, tuple(range(2 if quick else options.seeds)),
        60_000 if quick else int(solves), tuple(sets),
    )  # fmt: skip


def track_set(folder: Path, seeds: int) -> EvaluationSet:
    """Real circuits in their own size: the usual vehicle can steer their sharpest bends.

    Raises
    ------
    ValueError
        If the folder holds no centre line.
    """
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise ValueError(f"{folder} holds no .csv of a centre line")
    paths = tuple(read_racetrack(file) for file in files)
    return EvaluationSet("real circuits, randomised", paths, "randomised", max(seeds // 4, 2))


def run_study(options: argparse.Namespace, console: Console) -> int:
    """Make the study; the exit code."""
    study = study_of(options)
    study.claim()
    try:
        with progress_bar(console) as progress:

            def follow(words: str, steps: Iterator[tuple[int, int]]) -> None:
                bar = progress.add_task(words, total=None)
                for done, count in steps:
                    progress.update(bar, completed=done, total=count or 1)
                progress.update(bar, completed=1, total=1)

            follow("trainings", run_trainings(study, options.workers))
            follow("judging", run_judging(study, options.workers))
            headroom, greedy = _oracles(study, quick=options.quick, follow=follow)
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command goes on from {study.folder}")
        return 130
    summary = write_report(study, headroom, greedy, study.folder / REPORT)
    for line in summary["ladder"]:
        console.print("  ".join(line[:1] + line[2:10]), markup=False, highlight=False)
    console.print(f"report: {study.folder / REPORT}", markup=False, soft_wrap=True)
    return 0


Follow = Callable[[str, Iterator[tuple[int, int]]], None]


def _oracles(study: Study, *, quick: bool, follow: Follow) -> tuple[list[Headroom], float | None]:
    """Headroom of the first set, and the greedy oracle's score; kept in the study's folder."""
    file = study.folder / ORACLE
    if file.exists():
        kept = json.loads(file.read_text())
        return [Headroom(**row) for row in kept["headroom"]], kept["greedy"]
    given = study.sets[0]
    found = [
        result.weights[0]
        for one, seed in study.trainings()
        if one.method == "search"
        and isinstance(result := load(study.training(one.label, seed) / WEIGHTS), WeightSchedule)
    ]
    pool = oracle.pool_of(4 if quick else POOL, found)
    scores: list[Any] = []
    known: list[Any] = []

    def pooled() -> Iterator[tuple[int, int]]:
        for path_scores, path_known in oracle.scores_of_pool(given, pool):
            scores.append(path_scores)
            known.append(path_known)
            yield len(scores), len(given.trajectories)

    follow("oracle: every set on every drive", pooled())
    table = np.stack(scores)
    headroom = oracle.headroom(table, np.stack(known))
    greedy: list[Any] = []
    # A few drives a path: each tries many sets in every window.
    few = replace(given, seeds=min(given.seeds, 2))
    some = pool[oracle.varied(table, 3 if quick else BRANCHES)]

    def greedily() -> Iterator[tuple[int, int]]:
        for path_scores in oracle.greedy(few, some):
            greedy.append(path_scores)
            yield len(greedy), len(given.trajectories)

    follow("oracle: greedy, every window", greedily())
    best = table.mean(axis=(0, 2)).argmin()
    # On its own drives against the best fixed set on these, as a share of that on all.
    share = np.mean(greedy) / table[:, best, : few.seeds].mean()
    value = float(headroom[0].hindsight * share)
    content = {"headroom": [vars(row) for row in headroom], "greedy": value}
    write_atomically(file, json.dumps(content, indent=2).encode())
    return headroom, value
