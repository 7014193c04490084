"""A tuning from its beginning, or from where it was interrupted, to the end of its budget."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.weight_tuning.policy import write as write_policy
from agents.weights import TrackingWeights, WeightSchedule
from experiments.run.process import Interrupts
from experiments.run.provenance import hardware, revision, versions
from experiments.training.lock import alone_in
from experiments.tuning.drives import load_paths, path_names
from experiments.tuning.settings import PPO_METHODS, TuningSettings
from experiments.tuning.tuner import Result, Tuner
from lpv_track_env import vehicle
from trajectories import CurvatureBands, ReferencePath
from trajectories.fileio import write_atomically

WEIGHTS, PROGRESS, SETTINGS = "weights.json", "progress.jsonl", "settings.json"


@dataclass(frozen=True)
class Listener:
    """What the loop tells while it runs."""

    loading: Callable[[int, int], None]
    """Paths loaded, and of how many."""
    step: Callable[[dict[str, Any]], None]
    """A line of `progress.jsonl`."""


def make_tuner(settings: TuningSettings, paths: list[ReferencePath]) -> Tuner:
    """The tuner of a method, on its paths."""
    if settings.method in PPO_METHODS:
        from experiments.tuning.learning import PolicyLearning

        return PolicyLearning(settings, paths)
    rows = len(CurvatureBands()) if settings.method in {"bands", "gradient"} else 1
    if settings.method == "gradient":
        from experiments.tuning.gradient import GradientSearch

        return GradientSearch(settings, paths, rows)
    if settings.method == "paired":
        from experiments.tuning.paired import PairedLearning

        return PairedLearning(settings, paths)
    if settings.method == "paper":
        from experiments.tuning.by_path import PathClassSearch

        return PathClassSearch(settings, paths)
    from experiments.tuning.search import CmaSearch

    return CmaSearch(settings, paths, rows)


def tune(
    settings: TuningSettings, folder: Path, listener: Listener, *, command: str
) -> list[dict[str, Any]]:
    """Tune, or go on with what the folder holds; the lines of `progress.jsonl`.

    The folder gets `settings.json`, `weights.json` (a schedule, or a policy with its network beside
    it), `progress.jsonl` and what a tuning is resumed from.

    Raises
    ------
    ValueError
        If the folder holds a tuning with other settings, a file in it cannot be used, or the budget
        does not allow one step.
    KeyboardInterrupt
        On Ctrl-C; the folder has all steps but the one that it interrupted.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        return _tune(settings, folder, listener, command)


def _tune(
    settings: TuningSettings, folder: Path, listener: Listener, command: str
) -> list[dict[str, Any]]:
    stored = stored_settings(folder)
    if stored is not None:
        for key, value in settings.as_dict().items():
            if stored.get(key) != value:
                raise ValueError(
                    f"{folder} holds a tuning with other settings: {key} is {value!r}, there "
                    f"{stored.get(key)!r}"
                )
    if settings.method == "fixed":
        return _default(settings, folder, command)
    tuner = make_tuner(settings, load_paths(settings, listener.loading))
    lines: list[dict[str, Any]] = []
    if stored is not None and tuner.restore(folder):
        lines = progress_until(tuner.solves, folder / PROGRESS)
    elif tuner.done:
        raise ValueError(
            f"one step of {settings.method} takes {tuner.cost:,} solves: give more than "
            f"--solves {settings.solves:,}, or fewer --drives or a shorter --time-limit"
        )
    _write_json(folder / SETTINGS, settings.as_dict())
    before, began = lines[-1]["seconds"] if lines else 0.0, time.perf_counter()
    with Interrupts() as interrupts:
        while not tuner.done:
            figures = tuner.step()
            interrupts.check()
            lines.append(
                {
                    "step": len(lines), "solves": tuner.solves,
                    "seconds": before + time.perf_counter() - began, **figures,
                }
            )  # fmt: skip
            text = "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)
            write_atomically(folder / PROGRESS, text.encode())
            tuner.save(folder)
            listener.step(lines[-1])
    last = lines[-1]
    write_result(
        tuner.result(provenance(settings, command, last["solves"], last["seconds"])),
        folder / WEIGHTS,
    )
    return lines


def _default(settings: TuningSettings, folder: Path, command: str) -> list[dict[str, Any]]:
    """Write the default weights: nothing is tuned, nothing spent."""
    bands = CurvatureBands()
    schedule = WeightSchedule(
        bands, (TrackingWeights(),) * len(bands),
        provenance=provenance(settings, command, 0, 0.0),
    )  # fmt: skip
    _write_json(folder / SETTINGS, settings.as_dict())
    write_result(schedule, folder / WEIGHTS)
    return []


def provenance(
    settings: TuningSettings, command: str, solves: int, seconds: float
) -> dict[str, Any]:
    """Where weights come from, in plain JSON."""
    names = path_names(settings)
    return {
        "command": command,
        "settings": settings.as_dict(),
        "vehicle": vehicle.load(settings.vehicle).name,
        "paths": [names[0], names[-1]],
        "solves": solves,
        "seconds": round(seconds, 1),
        "versions": versions(),
        "revision": revision(),
        "hardware": hardware(),
    }


def write_result(result: Result, file: Path) -> None:
    """Write a schedule or a policy, in its own format."""
    if isinstance(result, WeightSchedule):
        result.write(file)
    else:
        write_policy(result, file)


def progress_until(solves: int, file: Path) -> list[dict[str, Any]]:
    """Lines of a `progress.jsonl` up to a state: a line is written before its state.

    Raises
    ------
    ValueError
        In one line, if they cannot be read, or are not those of the state.
    """
    try:
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        kept = [line for line in lines if line["solves"] <= solves]
        if not kept or kept[-1]["solves"] != solves:
            raise ValueError(f"it does not tell of the step that ended at {solves:,} solves")
    except (OSError, KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"{file} cannot be used ({reason}): give another --out, and the tuning begins anew"
        ) from None
    return kept


def stored_settings(folder: Path) -> Mapping[str, Any] | None:
    """Settings of the tuning in a folder; None where there is none.

    Raises
    ------
    ValueError
        If they cannot be read.
    """
    file = folder / SETTINGS
    if not file.exists():
        return None
    try:
        content: dict[str, Any] = json.loads(file.read_text())
        if not isinstance(content, dict):
            raise TypeError(f"{SETTINGS} holds no settings")
    except (OSError, TypeError, ValueError) as error:
        raise ValueError(f"{folder} holds no tuning to go on with: {error}") from None
    return content


def _write_json(file: Path, content: Any) -> None:
    write_atomically(file, json.dumps(content, indent=2).encode())
