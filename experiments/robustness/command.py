"""`lpv-track switching`: whether switching weights loses vehicles."""

import argparse
import dataclasses
import hashlib
import json
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from agents.weight_tuning.policy import load
from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule
from experiments.robustness.summary import summary, table, widest_kept
from experiments.robustness.switching import BATCH, WHOLE, WINDOW, Setup, arms_of, drive_arm
from experiments.run.benchmark import progress_bar
from experiments.run.case import project_digest
from experiments.run.provenance import hardware, revision, versions
from lpv_track_env import conditions
from lpv_track_env.validation import checked_threads
from trajectories.fileio import write_atomically

MOST_SPAN = 1e4


def spans_of(given: list[str]) -> tuple[float, ...]:
    """Spans as numbers; "whole" are the whole bounds of weights.

    Raises
    ------
    ValueError
        For anything else than a number above 1 and at most 10000.
    """
    spans = []
    for text in given:
        try:
            span = WHOLE if text == "whole" else float(text)
        except ValueError:
            span = 0.0
        if span != WHOLE and not 1.0 < span <= MOST_SPAN:
            raise ValueError(
                f"--spans are numbers above 1 and at most {MOST_SPAN:g}, or whole; not {text}"
            )
        spans.append(span)
    return tuple(dict.fromkeys(spans))


def base_of(file: Path | None) -> TrackingWeights:
    """The one set of a schedule's file; the default one where there is none.

    Raises
    ------
    ValueError
        If it cannot be read, or holds a policy or several sets.
    """
    if file is None:
        return TrackingWeights()
    result = load(file)
    if not isinstance(result, WeightSchedule) or len(set(result.weights)) != 1:
        raise ValueError(f"{file} holds no single set of weights to switch around")
    return result.weights[0]


def run_switching(options: argparse.Namespace, console: Console) -> int:
    """Drive every arm, print the table, write `switching.json`; arms that are there are kept.

    Raises
    ------
    ValueError
        For settings that are out of range or unknown.
    """
    setup = Setup(
        episodes=options.episodes, conditions=options.conditions, vehicle=options.vehicle,
        candidates=options.candidates, seed=options.seed, weights=base_of(options.weights),
        threads=checked_threads(options.threads),
    )  # fmt: skip
    conditions.load(setup.conditions)
    arms = arms_of(spans_of(options.spans))
    options.out.mkdir(parents=True, exist_ok=True)
    file: Path = options.out / "switching.json"
    # As JSON gives it back: what is kept is compared with it.
    plain = json.loads(json.dumps(dataclasses.asdict(setup)))
    del plain["threads"]
    result: dict[str, Any] = {
        "experiment": "switching",
        "setup": plain,
        "window": WINDOW,
        "bounds": [LOWEST, HIGHEST],
        "trajectories": setup.trajectories,
        "sources": _sources(),
        "revision": revision(),
        "versions": versions(),
        "hardware": hardware(),
    }
    kept = _kept(file, result)
    done: dict[str, Any] = {}
    result["arms"] = done
    batches = -(-setup.episodes // BATCH)
    progress = progress_bar(console)
    with progress:
        for number, arm in enumerate(arms, start=1):
            if arm.label not in kept:
                bar = progress.add_task(arm.label, total=batches * setup.windows)
                outcome = drive_arm(setup, arm, partial(progress.advance, bar))
                kept[arm.label] = summary(outcome)
            done[arm.label] = {**arm.as_dict(), **kept[arm.label]}
            write_atomically(file, json.dumps(result, indent=1, allow_nan=False).encode())
            if not console.is_terminal:
                console.print(
                    f"[{number}/{len(arms)}] {arm.label}: {done[arm.label]['lost']} lost",
                    markup=False, highlight=False,
                )  # fmt: skip
    console.print(table(result))
    console.print(widest_kept(result))
    console.print(f"written: {file}", markup=False, highlight=False, soft_wrap=True)
    return 0


def _sources() -> str:
    """Digest of what a result depends on."""
    here = Path(__file__).parent
    own = "".join((here / f"{name}.py").read_text() for name in ("switching", "summary"))
    return hashlib.sha256((project_digest() + own).encode()).hexdigest()[:16]


def _kept(file: Path, result: dict[str, Any]) -> dict[str, Any]:
    """Arms of a file that the same sources and settings wrote; none where there is no such."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if all(content.get(key) == result[key] for key in ("experiment", "setup", "sources")):
            return dict(content["arms"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass
    return {}
