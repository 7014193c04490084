"""Metrics of an episode: the paper's, by its formulas, and further ones.

e_d is the lateral error (left positive), e_th the heading error in (-pi, pi]; T the episode's
duration (kumar2025lpv, section V)::

    MLE = max |e_d|                 ALE = sqrt(1/T int e_d^2 dt)
    MOE = max |e_th|                AOE = sqrt(1/T int e_th^2 dt)
    CTE = (x_v - x_r) sin(th_r) - (y_v - y_r) cos(th_r)

ALE and AOE are root mean squares, whatever their name says. With the reference point (x_r, y_r) at
the foot of the perpendicular, |CTE| is |e_d|, so Max CTE equals MLE and Mean CTE never exceeds ALE.
The published tables have Mean CTE above ALE; their reference point must be another one, for example
the reference's position at the same time. That distance is given separately.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from experiments.run.rollout import Trace
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y, derivative
from lpv_track_env.reference import ORDINARY_FRICTION
from lpv_track_env.vehicle import VehicleParameters
from trajectories import CurvatureBands, ReferencePath
from trajectories.lane_changes import clearance, outline
from trajectories.speed import GRAVITY

Array = NDArray[np.float64]

BANDS = CurvatureBands()
"""Straight, gentle, moderate, sharp."""
RECOVERED, NEAR, AHEAD = 0.1, 0.05, 1e-3
"""Lateral errors (m) of a vehicle that has come back to the path and of a start on it, and heading
error (rad) of a start along it."""
BETWEEN_STATES = 10
"""Poses per control period at which the distance from cones is measured."""
KEPT = 1e-3
"""Largest excess, in a constraint's unit, that does not count as a violation."""


def rms(time: Array, values: Array) -> float:
    """Compute sqrt(1/T int values^2 dt) by the trapezoidal rule; 0 for an empty episode."""
    duration = time[-1] - time[0]
    if duration <= 0:
        return 0.0
    return float(np.sqrt(np.trapezoid(values**2, time) / duration))


def cross_track_error(trace: Trace, path: ReferencePath) -> Array:
    """Compute the CTE by the paper's formula with the foot point as reference point, (n + 1,) m."""
    foot = path.sample(trace.arc_length)
    dx, dy = trace.state[:, X] - foot.x, trace.state[:, Y] - foot.y
    return dx * np.sin(foot.heading) - dy * np.cos(foot.heading)


def time_indexed_distance(trace: Trace, path: ReferencePath) -> Array:
    """Compute the distance to the reference's position at the same time, (n + 1,) m."""
    start = path.sample(trace.arc_length[0]).time
    clock = path.arc_length_at(trace.time + float(start))
    there = path.sample(np.minimum(clock, path.length) if not path.closed else clock)
    return np.hypot(trace.state[:, X] - there.x, trace.state[:, Y] - there.y)


def tracking(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute the paper's six metrics, errors of speed, and distances at the same time."""
    del vehicle
    cte = np.abs(cross_track_error(trace, path))
    clock = time_indexed_distance(trace, path)
    speed_error = trace.state[:, VX] - trace.reference_speed
    return {
        "max_cte": float(cte.max()),
        "mean_cte": float(cte.mean()),
        "mle": float(np.abs(trace.lateral_error).max()),
        "ale": rms(trace.time, trace.lateral_error),
        "moe": float(np.abs(trace.heading_error).max()),
        "aoe": rms(trace.time, trace.heading_error),
        "mean_abs_lateral_error": float(np.abs(trace.lateral_error).mean()),
        "max_time_indexed_distance": float(clock.max()),
        "mean_time_indexed_distance": float(clock.mean()),
        "max_speed_error": float(np.abs(speed_error).max()),
        "rms_speed_error": rms(trace.time, speed_error),
    }


def by_band(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute errors and share of time in each band of |curvature| at the foot point.

    For a band NAME, e the lateral and th the heading error, w the trapezoidal rule's weights::

        share_NAME = sum w / T          mle_NAME = max |e|
        ale_NAME = sqrt(sum w e^2 / sum w)          aoe_NAME = sqrt(sum w th^2 / sum w)

    over the samples of the band; m, rad and a share of 1. A sample's weight, half of the step
    before and half of the step after, counts for its band, so a step between two bands is divided
    at its middle. Shares sum to 1, share * ale^2 to ALE^2 of the episode, share * aoe^2 to its
    AOE^2, and the largest mle is its MLE. A band that the episode never visits has no entries. An
    episode of no duration has, as in `rms`, ale and aoe 0, and share 1.
    """
    del vehicle
    band = BANDS.classify(path.sample(trace.arc_length).curvature)
    weight = trapezoidal_weights(trace.time)
    total = float(weight.sum())
    values: dict[str, float] = {}
    for index, name in enumerate(BANDS.names):
        here = band == index
        if not here.any():
            continue
        lateral = trace.lateral_error[here]
        values |= {
            f"ale_{name}": weighted_rms(weight[here], lateral),
            f"mle_{name}": float(np.abs(lateral).max()),
            f"aoe_{name}": weighted_rms(weight[here], trace.heading_error[here]),
            f"share_{name}": float(weight[here].sum()) / total if total > 0.0 else 1.0,
        }
    return values


def trapezoidal_weights(time: Array) -> Array:
    """Return the trapezoidal rule's weights w (n,), s: int f dt = sum w f at times (n,), s."""
    return 0.5 * (np.diff(time, append=time[-1]) + np.diff(time, prepend=time[0]))


def weighted_rms(weight: Array, values: Array) -> float:
    """Compute sqrt(sum w values^2 / sum w), both (n,); 0 if all weights are 0."""
    total = float(weight.sum())
    return float(np.sqrt((weight @ values**2) / total)) if total > 0.0 else 0.0


def activity(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute the actuators' activity: total variation, and the rms of their rates."""
    del path, vehicle
    dt = np.diff(trace.time)
    steering = np.diff(trace.steering_angle)
    acceleration = np.diff(trace.acceleration)
    # The first entry is the value before the first command.
    return {
        "steering_variation": float(np.abs(steering).sum()),
        "acceleration_variation": float(np.abs(acceleration).sum()),
        "steering_rate_rms": float(np.sqrt(np.mean((steering / dt) ** 2))) if dt.size else 0.0,
        "jerk_rms": float(np.sqrt(np.mean((acceleration / dt) ** 2))) if dt.size else 0.0,
        "clipped_share": float(np.mean(trace.clipped[1:] != 0)) if dt.size else 0.0,
    }


def violations(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute the violation of the paper's constraints: largest excess, share of periods.

    Each constraint gives `excess_NAME` (its own unit, 0 if kept) and `violated_NAME`, the share of
    control periods in which it was violated by more than 1e-3 of its unit. Accelerations dvx/dt are
    those of the vector field at the start of a period, under the input held over it.
    """
    del path
    vx, vy = trace.state[:, VX], trace.state[:, VY]
    low, high = vehicle.speed_range
    dv_low, dv_high = vehicle.longitudinal_acceleration_range
    dt = np.diff(trace.time)
    inputs = np.vstack([trace.acceleration[1:], trace.steering_angle[1:]])
    rate = derivative(trace.state[:-1].T, inputs, vehicle)[VX]
    excesses = {
        "speed": np.maximum(low - vx, vx - high),
        "lateral_velocity": np.abs(vy) - vehicle.max_lateral_velocity_ratio * vx,
        "longitudinal_acceleration": np.maximum(dv_low - rate, rate - dv_high),
        "steering_angle": np.abs(trace.steering_angle) - vehicle.max_steering_angle,
        "steering_rate": np.abs(np.diff(trace.steering_angle)) / dt - vehicle.max_steering_rate,
        "jerk": np.abs(np.diff(trace.acceleration)) / dt - vehicle.max_jerk,
    }
    result = {}
    for name, excess in excesses.items():
        result[f"excess_{name}"] = float(max(excess.max(initial=0.0), 0.0))
        result[f"violated_{name}"] = float(np.mean(excess > KEPT)) if excess.size else 0.0
    return result


def knowledge(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute errors of the estimate, the share of periods braked by itself, deadline misses.

    All are zero under ideal conditions. The lateral error of the estimate is across the path.
    """
    del vehicle
    foot = path.sample(trace.arc_length)
    dx, dy = (trace.estimate[:, k] - trace.state[:, k] for k in (X, Y))
    distance = np.hypot(dx, dy)
    across = dy * np.cos(foot.heading) - dx * np.sin(foot.heading)
    return {
        "rms_estimate_error": rms(trace.time, distance),
        "max_estimate_error": float(distance.max()),
        "rms_lateral_estimate_error": rms(trace.time, across),
        "stopping_share": float(np.mean(trace.stopping[1:])) if trace.time.size > 1 else 0.0,
        "deadline_misses": float(trace.deadline_misses[-1]),
    }


def recovery(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute how the vehicle comes to the path from where it starts.

    `overshoot` is the largest lateral error (m) on the other side of the path than the start: 0 if
    there is none. The side is that of the lateral error, within `NEAR` of the path that to which
    the heading error leads; a start without either counts both sides. `recovery_time` is the time
    (s) from which on the lateral error stays below `RECOVERED`; there is none if it never does.
    """
    del path, vehicle
    error = trace.lateral_error
    away = error[0] if abs(error[0]) > NEAR else trace.heading_error[0]
    other = np.abs(error) if abs(away) <= AHEAD else -np.sign(away) * error
    result = {"overshoot": float(max(other.max(), 0.0))}
    beyond = np.flatnonzero(np.abs(error) >= RECOVERED)
    if beyond.size == 0:
        result["recovery_time"] = 0.0
    elif beyond[-1] + 1 < error.size:
        result["recovery_time"] = float(trace.time[beyond[-1] + 1])
    return result


def cones(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute `cone_clearance`, the least distance (m) of the body from the lines of cones.

    It is negative if the body left a lane of `path.metadata["cones"]`, see
    `trajectories.lane_changes.clearance`; paths without cones have none. Between the trace's states
    poses are interpolated by cubic Hermite polynomials, whose slopes are the states' velocities.
    """
    if "cones" not in path.metadata:
        return {}
    middle = 0.5 * (vehicle.front_axle_distance - vehicle.rear_axle_distance)
    corners = outline(vehicle.length, vehicle.width, middle)
    x, y, heading = poses(trace.time, trace.state)
    least = clearance(path.metadata["cones"], x, y, heading, corners)
    return {"cone_clearance": least} if np.isfinite(least) else {}


def poses(time: Array, state: Array) -> Array:
    """Return x, y (m) and heading (rad) at and between states, (3, m), from states (n + 1, 6)."""
    vx, vy, psi = state[:, VX], state[:, VY], state[:, PSI]
    values = state[:, [X, Y, PSI]]
    slopes = np.column_stack(
        [
            vx * np.cos(psi) - vy * np.sin(psi), vx * np.sin(psi) + vy * np.cos(psi),
            state[:, YAW_RATE],
        ]
    )  # fmt: skip
    u = np.linspace(0.0, 1.0, BETWEEN_STATES, endpoint=False)[:, None, None]
    step = np.diff(time)[:, None]
    between = (
        (1.0 + 2.0 * u) * (1.0 - u) ** 2 * values[:-1] + u * u * (3.0 - 2.0 * u) * values[1:]
        + step * (u * (1.0 - u) ** 2 * slopes[:-1] - u * u * (1.0 - u) * slopes[1:])
    )  # fmt: skip
    return np.vstack([between.swapaxes(0, 1).reshape(-1, 3), values[-1:]]).T


def grip(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute the share of grip that the vehicle uses: its acceleration over mu g.

    The acceleration is the vector in the plane of the road, its mean over a control period: the
    change of the velocity in the world over the period's length. mu is the friction where the
    period begins, `ORDINARY_FRICTION` where tyres are linear. `grip_used_max` and `grip_used_rms`
    are the largest share and the root mean square over time.
    """
    del path, vehicle
    if trace.time.size < 2:
        return {"grip_used_max": 0.0, "grip_used_rms": 0.0}
    vx, vy, psi = trace.state[:, VX], trace.state[:, VY], trace.state[:, PSI]
    velocity = (vx + 1j * vy) * np.exp(1j * psi)
    step = np.diff(trace.time)
    friction = np.where(trace.friction > 0.0, trace.friction, ORDINARY_FRICTION)[:-1]
    used = np.abs(np.diff(velocity)) / (step * friction * GRAVITY)
    return {"grip_used_max": float(used.max()), "grip_used_rms": weighted_rms(step, used)}


def lap(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute `lap_time`, s, until a closed path was driven once; there is none if it was not.

    The start counts as it is: at the reference's speed unless the case says otherwise.
    """
    del vehicle
    driven = trace.arc_length - trace.arc_length[0]
    if not path.closed or driven[-1] < path.length:
        return {}
    last = int(np.argmax(driven >= path.length))
    ends = slice(max(last - 1, 0), last + 1)
    return {"lap_time": float(np.interp(path.length, driven[ends], trace.time[ends]))}


METRICS: tuple[Callable[[Trace, ReferencePath, VehicleParameters], dict[str, float]], ...] = (
    tracking,
    by_band,
    activity,
    violations,
    knowledge,
    recovery,
    cones,
    grip,
    lap,
)
"""Functions whose entries form a case's `metrics`; add your own here."""


def evaluate(trace: Trace, path: ReferencePath, vehicle: VehicleParameters) -> dict[str, float]:
    """Compute all metrics of an episode."""
    values: dict[str, float] = {}
    for metric in METRICS:
        values |= metric(trace, path, vehicle)
    covered = trace.arc_length[-1] - trace.arc_length[0]
    # A closed path is driven for one lap from the start of the episode.
    distance = path.length if path.closed else path.length - trace.arc_length[0]
    return {
        **values,
        "reward": float(trace.reward.sum()),
        "duration": float(trace.time[-1]),
        "completed": float(np.clip(covered / max(distance, 1e-9), 0, 1)),
    }


# Published results of kumar2025lpv, in metres and radians -----------------------------------------

PAPER_COLUMNS = {
    "max_cte": ("Max CTE", "m"),
    "mean_cte": ("Mean CTE", "m"),
    "mle": ("MLE", "m"),
    "ale": ("ALE", "m"),
    "moe": ("MOE", "rad"),
    "aoe": ("AOE", "rad"),
}
"""Heading and unit of each metric, in the paper's order."""

PAPER_SIMULATION: dict[str, tuple[float, ...]] = {
    "T1": (1.36, 0.25, 1.35, 0.19, 0.45, 0.08),
    "T2": (0.76, 0.17, 0.73, 0.14, 0.63, 0.04),
    "T3": (0.99, 0.19, 0.97, 0.15, 0.57, 0.05),
    "T4": (1.73, 0.30, 1.61, 0.20, 0.54, 0.18),
    "T5": (0.82, 0.19, 0.82, 0.13, 0.37, 0.03),
    "T6": (0.77, 0.16, 0.72, 0.11, 0.29, 0.02),
}
"""Simulation rows by trajectory, in the order of `PAPER_COLUMNS`."""

PAPER_REALTIME: dict[str, tuple[float, ...]] = {
    "T1": (2.86, 0.26, 2.71, 0.20, 0.57, 0.08),
    "T2": (1.97, 0.19, 1.67, 0.16, 0.77, 0.03),
    "T3": (2.23, 0.21, 2.13, 0.17, 0.65, 0.05),
    "T4": (2.09, 0.23, 1.92, 0.17, 0.63, 0.13),
    "T5": (2.66, 0.18, 2.58, 0.12, 0.42, 0.03),
    "T6": (0.90, 0.19, 0.79, 0.13, 0.18, 0.01),
}
"""Rows of the runs with the vehicle, in the same order."""


def published_row(trajectory: str, conditions: object = "simulation") -> dict[str, float] | None:
    """Return the published row of a trajectory or its raw form by column; None for others.

    Conditions "simulation" have the row of the paper's simulation, all others that of its runs with
    the vehicle.
    """
    rows = PAPER_SIMULATION if conditions == "simulation" else PAPER_REALTIME
    values = rows.get(trajectory.removesuffix("-raw"))
    return None if values is None else dict(zip(PAPER_COLUMNS, values, strict=True))
