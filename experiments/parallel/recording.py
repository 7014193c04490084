"""What a run leaves behind: a row for every control period, and one for every command applied."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.parallel.vehicle import StaleBraking, Vehicle

Array = NDArray[np.float64]

APPLIED = ("period", "latency", "estimated", "commanded", "solve_time", "reason", "failures")
"""Columns of an applied command: number of its period; times from when its sample was due until it
was applied, its estimate was written and it was written, s; the rest as in COMMAND."""


@dataclass
class Recording:
    """Filled in while driving; times in s."""

    rows: list[tuple[Any, ...]] = field(default_factory=list)
    """Of control periods, at their beginnings, see `Driven`."""
    commands: list[tuple[float, ...]] = field(default_factory=list)
    """Of applied commands, see APPLIED."""
    estimates: dict[int, Any] = field(default_factory=dict)
    """ESTIMATE records by number of the period."""
    lateness: list[float] = field(default_factory=list)
    """By how much the vehicle itself was late at each of its ticks."""
    ages: list[float] = field(default_factory=list)
    """Age of the estimate behind the command in force, at each tick."""

    def note(self, vehicle: Vehicle) -> None:
        """Add the vehicle as it is at the beginning of a control period."""
        info = vehicle.info
        self.rows.append(
            (
                vehicle.time, info["state"], info["arc_length"], info["lateral_error"],
                info["heading_error"], info["speed_error"], *vehicle.in_force,
                vehicle.braking is not None,
            )
        )  # fmt: skip

    def applied(self) -> dict[str, Array]:
        """Columns of the applied commands by name, each (n,)."""
        table = np.array(self.commands, dtype=float).reshape(-1, len(APPLIED)).T
        return dict(zip(APPLIED, table, strict=True))

    def driven(self) -> "Driven":
        """What was driven, from the rows."""
        columns = [np.array(column) for column in zip(*self.rows, strict=True)]
        return Driven(*columns)


class Driven(NamedTuple):
    """The true vehicle at the beginnings of n + 1 control periods: arrays (n + 1,), SI units."""

    time: Array
    state: Array
    """[vx, vy, psi, r, X, Y], (n + 1, 6)."""
    arc_length: Array
    lateral_error: Array
    heading_error: Array
    speed_error: Array
    acceleration: Array
    """What the actuators report."""
    steering_angle: Array
    braking: Array
    """Whether it brakes for lack of a fresh command."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended, and all that it recorded."""

    end: str
    """seconds, finished, left_corridor, wrong_heading, non_finite, fault, SIGINT or SIGTERM."""
    fault: str
    """Which process failed and how; "" for none."""
    signal: int
    """Number of the signal that ended it, 0 for none."""
    recording: Recording
    stale_brakings: list[StaleBraking]
    stop: tuple[float, float]
    """Time (s) and distance (m) of the stop at the end."""
    final_speed: float
    """m/s, after it."""
    commands_refused: int
