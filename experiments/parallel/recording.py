"""What a run leaves behind: a row for every control period, and one for every command applied."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.parallel.vehicle import StaleBraking, Vehicle
from experiments.rollout import Trace

Array = NDArray[np.float64]

APPLIED = ("period", "latency", "estimated", "commanded", "solve_time", "reason", "failures")
"""Columns of an applied command: number of its period; times from when its sample was due until it
was applied, its estimate was written and it was written, s; the rest as in COMMAND."""


@dataclass
class Recording:
    """Filled in while driving; times in s."""

    rows: list[tuple[Any, ...]] = field(default_factory=list)
    """Of control periods, at their beginnings: time, state, info and inputs in force."""
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
        speed = float(info["state"][0])
        self.rows.append(
            (
                vehicle.time, info["state"], info["arc_length"], info["lateral_error"],
                info["heading_error"], speed - info["speed_error"], *vehicle.in_force,
                vehicle.braking is not None,
            )
        )  # fmt: skip

    def applied(self) -> dict[str, Array]:
        """Columns of the applied commands by name, each (n,)."""
        table = np.array(self.commands, dtype=float).reshape(-1, len(APPLIED)).T
        return dict(zip(APPLIED, table, strict=True))

    def trace(self) -> Trace:
        """What was driven, as `experiments.metrics` takes it; n + 1 rows for n control periods."""
        columns = list(zip(*self.rows, strict=True))
        zeros = np.zeros(len(self.rows))
        solve_time = zeros.copy()
        for row in self.commands:
            period = int(row[0])
            if period + 1 < len(solve_time):
                solve_time[period + 1] = row[APPLIED.index("solve_time")]
        return Trace(
            time=np.array(columns[0]),
            state=np.array(columns[1]),
            arc_length=np.array(columns[2]),
            lateral_error=np.array(columns[3]),
            heading_error=np.array(columns[4]),
            reference_speed=np.array(columns[5]),
            acceleration=np.array(columns[6]),
            steering_angle=np.array(columns[7]),
            solve_time=solve_time,
            reward=zeros,
            clipped=zeros,
        )


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
