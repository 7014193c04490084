"""Drives that a report draws: cases with their traces, grouped by setting and by conditions."""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

import trajectories
from experiments.report.page import first_open, joined, paragraph
from experiments.run import tables
from experiments.run.excerpts import MOST_SETTINGS, first_and_worst
from experiments.run.foreign import is_path_file
from experiments.run.settings import Setting, conditions_words, setting_of
from experiments.run.store import ResultStore
from experiments.run.tables import Result
from lpv_track_env import vehicle
from lpv_track_env.bicycle import PSI, STATE_SIZE, X, Y
from lpv_track_env.vehicle import VEHICLES, VehicleParameters
from trajectories import ReferencePath

Array = NDArray[np.float64]
Key = TypeVar("Key", bound=Hashable)

TRACE = (
    "time", "state", "arc_length", "lateral_error", "heading_error", "reference_speed",
    "acceleration", "steering_angle", "solve_time",
)  # fmt: skip
"""Arrays that a trace must hold to be drawn."""
MOST_DRIVES = 3000
"""Most drives whose traces are read."""
LEAD = "lpv-nmpc"
"""Agent whose figures come first, if it has driven."""


@dataclass(frozen=True)
class NamedFiles:
    """Files of paths and vehicles that cases name, as far as a report may open them.

    A results folder may come from somebody else, so that a report opens no file by itself.

    Parameters
    ----------
    opened
        Names of files that may be opened; None for all.
    """

    opened: frozenset[str] | None = frozenset()

    def path(self, trajectory: str, car: VehicleParameters | None) -> ReferencePath | None:
        """Return the path of a name or file for a vehicle; None if it is not to be had.

        It cannot be loaded, or may not be opened.
        """
        return None if self.closed_path(trajectory) else reference_path(trajectory, car)

    def car(self, case: Result) -> VehicleParameters | None:
        """Return the vehicle of a case; None if it cannot be loaded or may not be opened."""
        return None if self.closed_vehicle(str(case.get("vehicle"))) else plant(case)

    def closed_path(self, trajectory: str) -> bool:
        """Return whether a trajectory is a file that may not be opened."""
        return is_path_file(trajectory) and not self._may_open(trajectory)

    def closed_vehicle(self, vehicle: str) -> bool:
        """Return whether a vehicle is a file that may not be opened."""
        return vehicle not in VEHICLES and not self._may_open(vehicle)

    def _may_open(self, name: str) -> bool:
        return self.opened is None or name in self.opened


NO_FILES = NamedFiles()
"""Nothing may be opened."""


@dataclass(frozen=True)
class Drive:
    """A case with its trace and its agent's label in the tables."""

    label: str
    trajectory: str
    case: Result
    trace: Mapping[str, Array]
    files: NamedFiles = NO_FILES

    @property
    def path(self) -> ReferencePath | None:
        """Its path, or None if it cannot be loaded or may not be opened."""
        return self.files.path(self.trajectory, self.car)

    @property
    def car(self) -> VehicleParameters | None:
        """Its vehicle, or None if it cannot be loaded or may not be opened."""
        return self.files.car(self.case)

    @property
    def finished(self) -> bool:
        """True if the drive reached the end of the path."""
        return bool(self.case.get("end") == "finished")

    @property
    def conditions(self) -> str:
        """Its conditions in words."""
        return conditions_words(self.case.get("conditions", "simulation"))


@dataclass(frozen=True)
class Family:
    """Drives whose settings differ in nothing but the conditions."""

    name: str
    drives: Sequence[Drive]

    @property
    def conditions(self) -> list[str]:
        """Conditions of its drives, in order."""
        return list(dict.fromkeys(drive.conditions for drive in self.drives))

    @property
    def labels(self) -> list[str]:
        """Labels of its agents, the leading one first."""
        found = dict.fromkeys(drive.label for drive in self.drives)
        return sorted(found, key=lambda label: label != LEAD)

    def under(self, conditions: str) -> list[Drive]:
        """Return its drives under the given conditions."""
        return [drive for drive in self.drives if drive.conditions == conditions]

    def of(self, label: str) -> list[Drive]:
        """Return the drives of one agent."""
        return [drive for drive in self.drives if drive.label == label]


def usable(trace: Mapping[str, Array] | None) -> bool:
    """Return whether a trace holds all arrays of `TRACE`, finite, of one length, in time's order.

    `state` is (n, 6), the others are (n,), n > 1.
    """
    if not trace or any(name not in trace for name in TRACE):
        return False
    n = trace["time"].size
    return (
        n > 1
        and all(
            trace[name].shape == ((n, STATE_SIZE) if name == "state" else (n,))
            and bool(np.isfinite(trace[name]).all())
            for name in TRACE
        )
        and bool((np.diff(trace["time"]) > 0.0).all())
    )


def drives_of(
    cases: Iterable[Result], store: ResultStore, files: NamedFiles = NO_FILES
) -> tuple[list[Drive], list[Result]]:
    """Return the first seed's drive of every agent, setting and path, and cases without a trace.

    Of many paths those of `drawn_paths` count, of many drives the first `MOST_DRIVES`. `files` says
    which files of paths and vehicles may be opened.
    """
    cases = list(cases)
    drawn = drawn_paths(cases)
    drives: dict[tuple[Setting, str, str], Drive] = {}
    missing: list[Result] = []
    for case in cases:
        if case.get("status") != "ok" or len(drives) == MOST_DRIVES:
            continue
        label, path = tables.label_of(case), str(case.get("trajectory"))
        setting = setting_of(case)
        key = setting, path, label
        if key in drives or path not in drawn[setting.family]:
            continue
        trace = store.trace(str(case["id"]))
        if trace is None or not usable(trace):
            missing.append(case)
            continue
        drives[key] = Drive(label, path, case, trace, files)
    return list(drives.values()), missing


def drawn_paths(cases: Iterable[Result]) -> dict[Setting, set[str]]:
    """Return the paths of each family that are drawn, see `excerpts.first_and_worst`."""
    errors: dict[Setting, dict[str, float]] = {}
    for case in cases:
        found = errors.setdefault(family_of(case), {})
        path = str(case.get("trajectory"))
        error = case["metrics"].get("mle", np.inf) if case.get("end") == "finished" else np.inf
        found[path] = max(error, found.get(path, 0.0))
    return {family: set(first_and_worst(found)) for family, found in errors.items()}


def family_of(case: Result) -> Setting:
    """Return the family of a case's setting, which is all of it but the conditions."""
    return setting_of(case).family


def in_families(cases: Sequence[Result]) -> list[Result]:
    """Return the cases with those of each family together, otherwise in the same order."""
    places = {name: place for place, name in enumerate(dict.fromkeys(map(family_of, cases)))}
    return sorted(cases, key=lambda case: places[family_of(case)])


def main_family(cases: Iterable[Result]) -> Setting:
    """Return the first family, whose figures and tables are not folded away."""
    return family_of(next(iter(cases)))


def per_setting(
    cases: Sequence[Result], content: Callable[[Setting, Sequence[Result]], str]
) -> str:
    """Join content(setting, its cases): the main family's shown, other settings folded away."""
    family = main_family(cases)
    groups = list(tables.cases_by_setting(cases).items())
    parts = [
        (setting.family == family, content(setting, group))
        for setting, group in groups[:MOST_SETTINGS]
    ]
    note = ""
    if len(groups) > MOST_SETTINGS:
        note = paragraph(f"{MOST_SETTINGS} of {len(groups)} settings are shown.", "soft")
    return joined([first_open([part for part in parts if part[1]], "Other settings"), note])


def families(drives: Iterable[Drive]) -> list[Family]:
    """Group drives by family, in order."""
    groups = _grouped(drives, lambda drive: family_of(drive.case))
    return [Family(str(family), group) for family, group in groups.items()]


def by_setting(drives: Iterable[Drive]) -> dict[Setting, list[Drive]]:
    """Group drives by setting, in order."""
    return _grouped(drives, lambda drive: setting_of(drive.case))


def by_trajectory(drives: Iterable[Drive]) -> dict[str, list[Drive]]:
    """Group drives by trajectory, in order."""
    return _grouped(drives, lambda drive: drive.trajectory)


def _grouped(drives: Iterable[Drive], key: Callable[[Drive], Key]) -> dict[Key, list[Drive]]:
    groups: dict[Key, list[Drive]] = {}
    for drive in drives:
        groups.setdefault(key(drive), []).append(drive)
    return groups


@cache
def reference_path(trajectory: str, car: VehicleParameters | None) -> ReferencePath | None:
    """Return the path of a name or file for a vehicle, or None if it cannot be loaded."""
    try:
        return trajectories.load(trajectory, vehicle=car)
    except (ValueError, OSError):
        return None


def foot_points(trace: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    """Return X, Y (m) and heading (rad, unwrapped) of the path at a trace's foot points, each (n,).

    The foot point lies a lateral error to the right of the vehicle, seen along the path.
    """
    heading = np.unwrap(trace["state"][:, PSI] - trace["heading_error"])
    x = trace["state"][:, X] + trace["lateral_error"] * np.sin(heading)
    y = trace["state"][:, Y] - trace["lateral_error"] * np.cos(heading)
    return x, y, heading


def longest_trace(drives: Sequence[Drive]) -> Mapping[str, Array]:
    """Return the trace that reaches furthest along the path."""
    return max((drive.trace for drive in drives), key=lambda trace: trace["arc_length"][-1])


def reference_line(drives: Sequence[Drive]) -> tuple[Array, Array]:
    """Return X and Y (m) of a trajectory, or of the driven part of it if it cannot be loaded."""
    path = drives[0].path
    if path is not None:
        return path.x, path.y
    x, y, _ = foot_points(longest_trace(drives))
    return x, y


def plant(case: Result) -> VehicleParameters | None:
    """Return the vehicle of a case with its changes, or None if it cannot be loaded."""
    changes = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in (case.get("vehicle_changes") or {}).items()
    }
    try:
        return vehicle.load(str(case.get("vehicle"))).replace(**changes)
    except (ValueError, TypeError):
        return None
