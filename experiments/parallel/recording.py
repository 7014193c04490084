"""Recording of a run, and the numbers that are reported of it."""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.parallel.setup import DRIVING, REASONS, Setup
from experiments.parallel.simulated_vehicle import StaleBraking, Vehicle
from experiments.run.metrics import rms
from lpv_track_env.bicycle import PSI, VX, X, Y

Array = NDArray[np.float64]
Summary = dict[str, Any]

HELD = 0.99
"""Share of control periods answered in time from which the rate counts as held."""
COMPLETE = ("seconds", "finished")
"""Ends of a complete run."""
APPLIED = ("period", "latency", "estimated", "commanded", "solve_time", "reason", "failures")
"""Columns of an applied command: number of its period; times (s) from when its sample was due until
it was applied, its estimate was written and it was written; the rest as in COMMAND."""


@dataclass
class Recording:
    """Record of a run, filled in while driving; times in s."""

    rows: list[tuple[Any, ...]] = field(default_factory=list)
    """Rows of the control periods, at their beginnings, see `Driven`."""
    commands: list[tuple[float, ...]] = field(default_factory=list)
    """Rows of the applied commands, see `APPLIED`."""
    estimates: dict[int, Any] = field(default_factory=dict)
    """ESTIMATE records by number of the period."""
    lateness: list[float] = field(default_factory=list)
    """Lateness of the vehicle itself at each of its ticks."""
    ages: list[float] = field(default_factory=list)
    """Age of the estimate behind the command in force, at each tick."""

    def note(self, vehicle: Vehicle) -> None:
        """Add a row for the vehicle at the beginning of a control period."""
        info = vehicle.info
        self.rows.append(
            (
                vehicle.time, info["state"], info["arc_length"], info["lateral_error"],
                info["heading_error"], info["speed_error"], *vehicle.in_force,
                vehicle.braking is not None,
            )
        )  # fmt: skip

    def applied(self) -> dict[str, Array]:
        """Return the columns of the applied commands by name, each (n,)."""
        table = np.array(self.commands, dtype=float).reshape(-1, len(APPLIED)).T
        return dict(zip(APPLIED, table, strict=True))

    def driven(self) -> "Driven":
        """Return the rows as arrays."""
        columns = [np.array(column) for column in zip(*self.rows, strict=True)]
        return Driven(*columns)


class Driven(NamedTuple):
    """True vehicle at the beginnings of n + 1 control periods: arrays (n + 1,), SI units."""

    time: Array
    state: Array
    """[vx, vy, psi, r, X, Y], (n + 1, 6)."""
    arc_length: Array
    lateral_error: Array
    heading_error: Array
    speed_error: Array
    acceleration: Array
    """As reported by the actuators."""
    steering_angle: Array
    braking: Array
    """True where the vehicle brakes for lack of a fresh command."""


@dataclass(frozen=True)
class Outcome:
    """End of a run, and everything it recorded."""

    end: str
    """seconds, finished, left_corridor, wrong_heading, non_finite, fault, SIGINT or SIGTERM."""
    fault: str
    """Process that failed and its failure; "" for none."""
    signal: int
    """Number of the signal that ended it, 0 for none."""
    recording: Recording
    stale_brakings: list[StaleBraking]
    stop: tuple[float, float]
    """Time (s) and distance (m) of the stop at the end."""
    final_speed: float
    """Speed after the stop, m/s."""
    commands_refused: int
    compiled: dict[str, str] = field(default_factory=dict)
    """Place, by process, at which code had to be compiled or loaded while driving."""


def spread(values: Array) -> Summary | None:
    """Return median, 99th percentile and maximum of times (s); None without any."""
    if values.size == 0:
        return None
    return {
        "median": float(np.median(values)),
        "p99": float(np.percentile(values, 99)),
        "max": float(values.max()),
    }


def summarise(setup: Setup, outcome: Outcome) -> Summary:
    """Return everything that is reported of a run, plain values; times in s, lengths in m."""
    recording = outcome.recording
    summary: Summary = {
        "end": outcome.end,
        "fault": outcome.fault,
        "stop": {
            "seconds": outcome.stop[0], "distance": outcome.stop[1],
            "final_speed": outcome.final_speed,
        },
        **timing(setup, recording),
        "faults": faults(setup, outcome),
    }  # fmt: skip
    if len(recording.rows) > 1:
        summary["tracking"] = tracking(recording.driven())
        summary["estimation"] = estimation(recording)
    summary["complete"] = outcome.end in COMPLETE
    summary["held"] = summary["periods"] > 0 and summary["answered_share"] >= HELD
    return summary


def timing(setup: Setup, recording: Recording) -> Summary:
    """Return rate, deadline misses and latencies."""
    applied = recording.applied()
    # While no estimate arrives, the last one is answered repeatedly.
    _, first = np.unique(applied["period"], return_index=True)
    applied = {name: column[first] for name, column in applied.items()}
    periods = max(len(recording.rows) - 1, 0)
    in_time = applied["latency"] <= setup.period
    answered = int(np.sum(in_time & (applied["period"] < periods)))
    solves = applied["solve_time"][applied["solve_time"] > 0.0]
    share = answered / periods if periods else 0.0
    return {
        "periods": periods,
        "answered_in_time": answered,
        "answered_share": share,
        "deadline_misses": periods - answered,
        "rate": setup.rate * share,
        "wake_to_action": spread(applied["latency"]),
        "stages": {
            "sample_to_estimate": spread(applied["estimated"]),
            "estimate_to_command": spread(applied["commanded"] - applied["estimated"]),
            "command_to_action": spread(applied["latency"] - applied["commanded"]),
        },
        "solve_time": spread(solves),
        "estimate_age": spread(np.array(recording.ages)),
        "vehicle_lateness": spread(np.array(recording.lateness)),
    }


def faults(setup: Setup, outcome: Outcome) -> Summary:
    """Return faults, and the braking that they caused."""
    applied = outcome.recording.applied()
    reasons = applied["reason"].astype(int)
    return {
        "stale_brakings": [
            {
                "began": one.began,
                "age_periods": one.age / setup.period,
                "seconds": None if one.ended is None else one.ended - one.began,
            }
            for one in outcome.stale_brakings
        ],
        "commands_to_brake": {
            name: int(np.sum(reasons == code))
            for code, name in enumerate(REASONS)
            if code != DRIVING
        },
        "failed_solves": int(applied["failures"].max(initial=0)),
        "commands_refused": outcome.commands_refused,
        "compiled_while_driving": outcome.compiled,
    }


def tracking(driven: Driven) -> Summary:
    """Return errors of the true vehicle, as `experiments.run.metrics` defines them."""
    return {
        "mle": float(np.abs(driven.lateral_error).max()),
        "ale": rms(driven.time, driven.lateral_error),
        "moe": float(np.abs(driven.heading_error).max()),
        "aoe": rms(driven.time, driven.heading_error),
        "rms_speed_error": rms(driven.time, driven.speed_error),
    }


def estimation(recording: Recording) -> Summary:
    """Return errors of the estimates against the truth, and counts of used and refused readings."""
    errors = []
    last = None
    for period, estimate in sorted(recording.estimates.items()):
        if period < len(recording.rows):
            truth = recording.rows[period][1]
            last = estimate
            errors.append(np.asarray(estimate["state"]) - truth)
    if last is None:
        return {}
    table = np.array(errors)
    position = np.hypot(table[:, X], table[:, Y])
    heading = (table[:, PSI] + math.pi) % (2.0 * math.pi) - math.pi
    return {
        "position_rms": float(np.sqrt(np.mean(position**2))),
        "position_max": float(position.max()),
        "heading_rms": float(np.sqrt(np.mean(heading**2))),
        "speed_rms": float(np.sqrt(np.mean(table[:, VX] ** 2))),
        **{
            name: int(last[name])
            for name in ("fixes_used", "fixes_refused", "readings_refused", "samples_lost")
        },
    }
