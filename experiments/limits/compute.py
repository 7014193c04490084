"""Computes a limit and shows that it is one: a replay, and motions that are 2 % better."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import trajectories
from experiments.limits import lane_changes, laps
from experiments.limits.optimal_control import Motion, Outcome
from experiments.run.physical_limits import BEYOND, Limit, LimitCase, digest
from lpv_track_env import vehicle
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath
from trajectories.arguments import shown

Progress = Callable[[str], None]


class Found(NamedTuple):
    """A limit, and the motion that reaches it."""

    limit: Limit
    motion: Motion


def compute(case: LimitCase, progress: Progress = lambda _: None) -> Found:
    """Compute the limit of a case; `progress` is called with what is done next.

    Raises
    ------
    ValueError
        If the path has neither cones nor is closed, or a name is unknown.
    RuntimeError
        If IPOPT finds no motion.
    """
    path, car = trajectories.load(case.path), vehicle.load(case.vehicle)
    if "cones" in path.metadata:
        return _entry_speed(case, path, car, progress)
    if path.closed:
        return _lap_time(case, path, car, progress)
    raise ValueError(f"path {shown(path.name)} has no cones and is not closed: it has no limit")


def _entry_speed(
    case: LimitCase, path: ReferencePath, car: VehicleParameters, progress: Progress
) -> Found:
    progress("highest entry speed")
    for start in (16.0, 12.0, 22.0, 8.0):
        guess = lane_changes.along_the_line(path, car, start)
        outcome = lane_changes.highest_entry_speed(path, car, case.friction, case.kept, guess)
        if outcome.solved:
            break
    motion = _motion(case, outcome)
    speed = -outcome.value
    better = (1.0 + BEYOND) * speed

    def beyond() -> Iterator[float]:
        shares = (0.6, 0.8, 1.0)
        starts = [lane_changes.along_the_line(path, car, share * better) for share in shares]
        for number, start in enumerate(starts, start=1):
            progress(f"{better:.2f} m/s, start {number} of {len(starts)}")
            found = lane_changes.widest(path, car, case.friction, case.kept, better, start)
            if found.solved:
                yield lane_changes.PLAY - found.value

    distances = list(beyond())
    replayed = lane_changes.replayed_clearance(path, car, case.friction, motion)
    return _found(case, path, "entry speed", speed, replayed, max, distances, outcome)


def _lap_time(
    case: LimitCase, path: ReferencePath, car: VehicleParameters, progress: Progress
) -> Found:
    progress("least lap time")
    guess = laps.quasi_static(path, car, case.friction)
    outcome = laps.least_lap_time(path, car, case.friction, case.corridor, guess)
    motion = _motion(case, outcome)
    better = (1.0 - BEYOND) * outcome.value

    def beyond() -> Iterator[float]:
        for number, start in enumerate((motion, guess), start=1):
            progress(f"{better:.2f} s, start {number} of 2")
            found = laps.narrowest(path, car, case.friction, better, start)
            if found.solved:
                yield found.value

    widths = list(beyond())
    replayed = laps.replayed_error(path, car, case.friction, motion)
    return _found(case, path, "lap time", outcome.value, replayed, min, widths, outcome)


def _motion(case: LimitCase, outcome: Outcome) -> Motion:
    if not outcome.solved:
        raise RuntimeError(
            f"{case.path}, {case.vehicle}, friction {case.friction:g}: IPOPT found no motion "
            f"({outcome.status} after {outcome.iterations} iterations)"
        )
    return outcome.motion


def _found(
    case: LimitCase, path: ReferencePath, kind: str, value: float, replayed: float,
    best: Callable[..., float], beyond: list[float], outcome: Outcome,
) -> Found:  # fmt: skip
    limit = Limit(
        case=case, kind=kind, value=value, replayed=replayed,
        beyond=best(beyond) if beyond else 0.0, starts=len(beyond),
        nodes=len(outcome.motion.steps) + 1, iterations=outcome.iterations,
        seconds=outcome.seconds, path_digest=digest(path),
    )  # fmt: skip
    return Found(limit, outcome.motion)
