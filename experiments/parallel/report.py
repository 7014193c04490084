"""What a run came to: numbers for JSON and a table for the console."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table
from rich.text import Text

from experiments.parallel.messages import DRIVING, REASONS, STALE_PERIODS
from experiments.parallel.recording import Driven, Outcome, Recording
from experiments.parallel.setup import Setup
from experiments.run.metrics import rms
from lpv_track_env.bicycle import PSI, VX, X, Y

Array = NDArray[np.float64]
Summary = dict[str, Any]

HELD = 0.99
"""Share of the control periods that must be answered in time for the rate to count as held."""
COMPLETE = ("seconds", "finished")
"""Ends of a run that went as it should."""


def spread(values: Array) -> Summary | None:
    """Median, 99th percentile and greatest of some times (s); None of none."""
    if values.size == 0:
        return None
    return {
        "median": float(np.median(values)),
        "p99": float(np.percentile(values, 99)),
        "max": float(values.max()),
    }


def summarise(setup: Setup, outcome: Outcome) -> Summary:
    """Everything that is reported of a run, plain values; times in s, lengths in m."""
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
    """Rate, deadlines and latencies."""
    applied = recording.applied()
    # While no estimate comes, the last one is answered again and again.
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
    """What went wrong, and who braked for it."""
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
    }


def tracking(driven: Driven) -> Summary:
    """Errors of the true vehicle, as `experiments.run.metrics` defines them."""
    return {
        "mle": float(np.abs(driven.lateral_error).max()),
        "ale": rms(driven.time, driven.lateral_error),
        "moe": float(np.abs(driven.heading_error).max()),
        "aoe": rms(driven.time, driven.heading_error),
        "rms_speed_error": rms(driven.time, driven.speed_error),
    }


def estimation(recording: Recording) -> Summary:
    """Errors of the estimates against the truth of their periods, and what came of the readings."""
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


def table(setup: Setup, summary: Summary) -> Table:
    """The report for a console."""
    rows = Table(box=box.SIMPLE_HEAD)
    for heading in ("", "median", "99 %", "max"):
        rows.add_column(heading, justify="left" if not heading else "right")
    stages = summary["stages"]
    for name, times in (
        ("wake-to-action: sample due to command applied, ms", summary["wake_to_action"]),
        ("    sample due to estimate written", stages["sample_to_estimate"]),
        ("    to command written", stages["estimate_to_command"]),
        ("    to command applied", stages["command_to_action"]),
        ("solve (predict), ms", summary["solve_time"]),
        ("age of the estimate driven on, ms", summary["estimate_age"]),
        ("lateness of the vehicle's own ticks, ms", summary["vehicle_lateness"]),
    ):
        if times is not None:
            cells = [f"{1e3 * times[key]:.3f}" for key in ("median", "p99", "max")]
            rows.add_row(Text(name), *cells)
    rows.title = (
        f"{setup.agent} on {setup.trajectory}, {setup.estimator}, {setup.conditions_name}: "
        f"{summary['rate']:.2f} of {setup.rate} Hz"
    )
    return rows


def sentences(summary: Summary) -> list[str]:
    """What the table does not hold, a line each."""
    share, misses = 100.0 * summary["answered_share"], summary["deadline_misses"]
    lines = [
        f"{summary['periods']} periods, {share:.2f} % answered in time, {misses} deadline misses"
    ]
    if "tracking" in summary:
        told = summary["tracking"]
        lines.append(f"tracking (truth): MLE {told['mle']:.3f} m, ALE {told['ale']:.3f} m")
    if summary.get("estimation"):
        told = summary["estimation"]
        lines.append(
            f"estimate: position error rms {told['position_rms']:.3f} m, "
            f"max {told['position_max']:.3f} m; {told['fixes_used']} fixes used, "
            f"{told['fixes_refused']} refused; {told['readings_refused']} readings refused; "
            f"{told['samples_lost']} samples lost"
        )
    found = summary["faults"]
    if found["stale_brakings"]:
        first = found["stale_brakings"][0]
        lines.append(
            f"the vehicle braked {len(found['stale_brakings'])} times for lack of a fresh command, "
            f"first at {first['began']:.3f} s, {first['age_periods']:.2f} periods "
            f"(of {STALE_PERIODS}) after the last good sample"
        )
    asked = {name: count for name, count in found["commands_to_brake"].items() if count}
    if asked:
        told = ", ".join(f"{count} for {name}" for name, count in asked.items())
        lines.append(f"commands to brake: {told}")
    stop = summary["stop"]
    lines.append(
        f"end: {summary['end']}; then stopped in {stop['distance']:.1f} m and "
        f"{stop['seconds']:.1f} s (simulated), at {stop['final_speed']:.2f} m/s"
    )
    return lines
