"""A tuning as a resumable job, from its folder to the weights it writes."""

from pathlib import Path
from typing import Any

from agents.weight_tuning.policy import write as write_policy
from agents.weights import TrackingWeights, WeightSchedule
from experiments.jobs.job import (
    Line,
    Listener,
    claimed,
    load_paths,
    run_job,
    training_names,
    write_settings,
)
from experiments.run.provenance import provenance
from experiments.tuning.settings import PPO_METHODS, TuningSettings
from experiments.tuning.tuner import Result, Tuner
from lpv_track_env import vehicle
from trajectories import CurvatureBands, ReferencePath

WEIGHTS = "weights.json"


def make_tuner(settings: TuningSettings, paths: list[ReferencePath]) -> Tuner:
    """Make the tuner of a method, with its paths."""
    if settings.method in PPO_METHODS:
        from experiments.tuning.ppo import PolicyLearning

        return PolicyLearning(settings, paths)
    if settings.method == "paired":
        from experiments.tuning.paired import PairedLearning

        return PairedLearning(settings, paths)
    from experiments.tuning import search

    if settings.method == "paper":
        return search.PathClassSearch(settings, paths)
    rows = len(CurvatureBands()) if settings.method in {"bands", "gradient"} else 1
    if settings.method == "gradient":
        return search.GradientSearch(settings, paths, rows)
    return search.CmaSearch(settings, paths, rows)


def path_names(settings: TuningSettings) -> list[str]:
    """Return the names of the paths of a tuning."""
    return training_names(settings.trajectories, settings.seed, settings.paths)


def tune(settings: TuningSettings, folder: Path, listener: Listener, *, command: str) -> list[Line]:
    """Tune, or resume what the folder holds; return the lines of `progress.jsonl`.

    The folder gets `settings.json`, `weights.json` (a schedule, or a policy with its network beside
    it), `progress.jsonl` and the state that a tuning is resumed from.

    Raises
    ------
    ValueError
        If the folder holds a tuning with other settings, a file in it cannot be used, or the budget
        does not allow one step.
    KeyboardInterrupt
        On Ctrl-C; the folder keeps every step but the interrupted one.
    """
    packages = ("torch", "stable-baselines3") if settings.method in PPO_METHODS else ("cma",)
    with claimed(folder, settings, "tuning", packages) as resumed:
        if settings.method == "fixed":
            bands = CurvatureBands()
            default = WeightSchedule(
                bands, (TrackingWeights(),) * len(bands),
                provenance=origin(settings, command, 0, 0.0),
            )  # fmt: skip
            write_settings(folder, settings)
            write_result(default, folder / WEIGHTS)
            return []
        car = vehicle.load(settings.vehicle)
        tuner = make_tuner(settings, load_paths(path_names(settings), listener.loading, car))
        if not (resumed and tuner.restore(folder)) and tuner.done:
            raise ValueError(
                f"one step of {settings.method} takes {tuner.cost:,} solves: give more than "
                f"--solves {settings.solves:,}, or fewer --drives or a shorter --time-limit"
            )
        lines = run_job(tuner, folder, listener)
        last = lines[-1]
        result = tuner.result(origin(settings, command, last["solves"], last["seconds"]))
        write_result(result, folder / WEIGHTS)
        return lines


def origin(settings: TuningSettings, command: str, solves: int, seconds: float) -> dict[str, Any]:
    """Return where weights come from and what they cost, in plain JSON."""
    names = path_names(settings)
    return {
        "command": command,
        "settings": settings.as_dict(),
        "vehicle": vehicle.load(settings.vehicle).name,
        "paths": [names[0], names[-1]],
        "solves": solves,
        "seconds": round(seconds, 1),
        **provenance(),
    }


def write_result(result: Result, file: Path) -> None:
    """Write a schedule or a policy, each in its own format."""
    if isinstance(result, WeightSchedule):
        result.write(file)
    else:
        write_policy(result, file)
