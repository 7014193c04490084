"""What a report draws: cases with their traces, grouped by setting and by conditions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trajectories
from experiments.run import tables
from experiments.run.store import ResultStore
from lpv_track_env import vehicle
from lpv_track_env.bicycle import X, Y
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Array = NDArray[np.float64]
Result = Mapping[str, Any]

TRACE = (
    "time", "state", "arc_length", "lateral_error", "heading_error", "reference_speed",
    "acceleration", "steering_angle", "solve_time",
)  # fmt: skip
"""Arrays that a trace must hold to be drawn."""
LEAD = "lpv-nmpc"
"""Whose figures stand first where it has driven."""


@dataclass(frozen=True)
class Drive:
    """One case with its trace, under the label that it has in the tables."""

    label: str
    trajectory: str
    case: Result
    trace: Mapping[str, Array]

    @property
    def finished(self) -> bool:
        """Whether it drove the whole path."""
        return bool(self.case.get("end") == "finished")

    @property
    def conditions(self) -> str:
        """Its conditions in words."""
        return tables.conditions_words(self.case.get("conditions", "simulation"))


@dataclass(frozen=True)
class Family:
    """Drives whose settings differ in nothing but the conditions."""

    name: str
    drives: Sequence[Drive]

    @property
    def conditions(self) -> list[str]:
        """The conditions that it has drives under, those of the first drive first."""
        return list(dict.fromkeys(drive.conditions for drive in self.drives))

    @property
    def labels(self) -> list[str]:
        """Its agents, the leading one first."""
        found = dict.fromkeys(drive.label for drive in self.drives)
        return sorted(found, key=lambda label: label != LEAD)

    def under(self, conditions: str) -> list[Drive]:
        """Its drives under one kind of conditions."""
        return [drive for drive in self.drives if drive.conditions == conditions]

    def of(self, label: str) -> list[Drive]:
        """Its drives by one agent."""
        return [drive for drive in self.drives if drive.label == label]


def usable(trace: Mapping[str, Array] | None) -> bool:
    """Whether a trace holds what the figures need, finite and of one length."""
    if not trace or any(name not in trace for name in TRACE):
        return False
    n = len(trace["time"])
    return n > 1 and all(
        len(trace[name]) == n and bool(np.isfinite(trace[name]).all()) for name in TRACE
    )


def drives_of(cases: Iterable[Result], store: ResultStore) -> tuple[list[Drive], list[Result]]:
    """What can be drawn: of each agent, setting and trajectory the first seed; and what lacks."""
    drives: dict[tuple[str, str, str], Drive] = {}
    missing: list[Result] = []
    for case in cases:
        label, path = tables.label_of(case), str(case.get("trajectory"))
        key = tables.setting_of(case), path, label
        if case.get("status") != "ok" or key in drives:
            continue
        trace = store.trace(str(case["id"]))
        if trace is None or not usable(trace):
            missing.append(case)
            continue
        drives[key] = Drive(label, path, case, trace)
    return list(drives.values()), missing


def family_of(case: Result) -> str:
    """Words for all that cases of one family share: their setting but for the conditions."""
    return tables.setting_of({**case, "conditions": "simulation"})


def in_families(cases: Sequence[Result]) -> list[Result]:
    """Cases in the same order, but those of a family together: conditions beside each other."""
    places = {name: place for place, name in enumerate(dict.fromkeys(map(family_of, cases)))}
    return sorted(cases, key=lambda case: places[family_of(case)])


def main_family(cases: Iterable[Result]) -> str:
    """The first family: whose figures and tables stand open."""
    return family_of(next(iter(cases)))


def families(drives: Iterable[Drive]) -> list[Family]:
    """Drives by family, in order."""
    groups: dict[str, list[Drive]] = {}
    for drive in drives:
        groups.setdefault(family_of(drive.case), []).append(drive)
    return [Family(name, group) for name, group in groups.items()]


def by_setting(drives: Iterable[Drive]) -> dict[str, list[Drive]]:
    """Drives by setting, in order."""
    groups: dict[str, list[Drive]] = {}
    for drive in drives:
        groups.setdefault(tables.setting_of(drive.case), []).append(drive)
    return groups


def by_trajectory(drives: Iterable[Drive]) -> dict[str, list[Drive]]:
    """Drives by trajectory, in order."""
    groups: dict[str, list[Drive]] = {}
    for drive in drives:
        groups.setdefault(drive.trajectory, []).append(drive)
    return groups


@cache
def reference_path(trajectory: str) -> ReferencePath | None:
    """Geometry of a case's trajectory by its name or file, or None where that is not to be had."""
    try:
        return trajectories.load(trajectory)
    except (ValueError, OSError):
        return None


def foot_points(trace: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    """X, Y (m) and heading (rad, unwrapped) of the path at a trace's foot points, each (n,).

    The foot point lies a lateral error to the right of the vehicle, seen along the path.
    """
    heading = np.unwrap(trace["state"][:, 2] - trace["heading_error"])
    x = trace["state"][:, X] + trace["lateral_error"] * np.sin(heading)
    y = trace["state"][:, Y] - trace["lateral_error"] * np.cos(heading)
    return x, y, heading


def reference_line(drives: Sequence[Drive]) -> tuple[Array, Array]:
    """X and Y (m) of a trajectory; where it is not to be had, of what was driven of it."""
    path = reference_path(drives[0].trajectory)
    if path is not None:
        return path.x, path.y
    longest = max((drive.trace for drive in drives), key=lambda trace: trace["arc_length"][-1])
    x, y, _ = foot_points(longest)
    return x, y


def plant(case: Result) -> VehicleParameters | None:
    """The vehicle of a case with its changes, or None where it no longer loads."""
    changes = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in (case.get("vehicle_changes") or {}).items()
    }
    try:
        return vehicle.load(str(case.get("vehicle"))).replace(**changes)
    except (ValueError, TypeError):
        return None
