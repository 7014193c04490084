"""Recorded sensors through the estimator and an agent: what it would have seen and done.

Readings go into the filter in the order of their stamps, with the recorded commands as the inputs
in force. At every control period the agent is shown the path from where the estimate is, and what
it proposes is set beside what was recorded. Nothing that it proposes moves anything: the drive is
the recorded one.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.ros.read import BagError
from experiments.ros.recording import COURSE_BASE, Recording
from experiments.ros.topics import SECOND, Commands, Odometry, Stamps
from lpv_track_env.conditions.layout import WORST_OFFSET
from lpv_track_env.estimation.estimator import Estimator, EstimatorSettings
from lpv_track_env.estimation.observer import PathObserver
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Array = NDArray[np.float64]

FARTHEST_START = 20.0
"""m from the path at which a drive belongs to another path, or another datum."""


@dataclass(frozen=True)
class Replay:
    """What a replay gives, at the ends of control periods, (n,), and at fixes, (m,)."""

    recording: Recording
    path: ReferencePath
    time: Array
    """s since the first fix."""
    estimate: Array
    """(n, 6) vx, vy, psi, r, X, Y."""
    deviation: Array
    """(n,) m, of the position in its worst direction, as the filter believes."""
    lateral_error: Array
    """(n,) m, of the estimate, left of the path."""
    odometry: Array | None
    """(n, 6) recorded, as `estimate`; NaN outside its span."""
    proposed: Array
    """(n, 2) acceleration, steering angle; NaN beyond the path's end."""
    recorded: Array
    """(n, 2) commands in force from then on."""
    fix_time: Array
    fix_nis: Array
    fix_used: NDArray[np.bool_]
    """(m,) of the fixes that were used, or gated."""
    reading_nis: float
    readings: int
    """Sum of the NIS of all IMU and wheel readings that were used, and their number."""
    counts: dict[str, int]
    """Fixes and readings, used and refused, by what came of them."""


class Inputs:
    """Recorded commands as the piecewise constant inputs they are.

    Parameters
    ----------
    commands
        In force from their stamps on; before the first, that is.
    """

    def __init__(self, commands: Commands) -> None:
        self.stamp = commands.stamp
        self.values = np.column_stack([commands.acceleration, commands.steering_angle])
        held = np.diff(self.stamp)[:, None] / SECOND * self.values[:-1]
        self.integral = np.vstack([np.zeros(2), np.cumsum(held, axis=0)])

    def before(self, stamp: int) -> Array:
        """Inputs (2,) that were in force until a stamp."""
        return self._at(int(np.searchsorted(self.stamp, stamp, "left")) - 1)

    def after(self, stamp: int) -> Array:
        """Inputs (2,) that are in force from a stamp on."""
        return self._at(int(np.searchsorted(self.stamp, stamp, "right")) - 1)

    def mean(self, first: int, last: int) -> Array:
        """Mean inputs (2,) between two stamps; at one stamp, those in force until then."""
        if last <= first:
            return self.before(last)
        whole: Array = (self._sum(last) - self._sum(first)) / ((last - first) / SECOND)
        return whole

    def _at(self, index: int) -> Array:
        found: Array = self.values[max(index, 0)]
        return found

    def _sum(self, stamp: int) -> Array:
        index = max(int(np.searchsorted(self.stamp, stamp, "right")) - 1, 0)
        since = (stamp - int(self.stamp[index])) / SECOND
        total: Array = self.integral[index] + since * self.values[index]
        return total


def replay(
    recording: Recording,
    path: ReferencePath,
    vehicle: VehicleParameters,
    agent: Any,
    observer: PathObserver,
    *,
    control_period: float = 0.05,
    settings: EstimatorSettings | None = None,
) -> Replay:
    """Replay a recording.

    Parameters
    ----------
    recording
        Of `record`, in the frame of the path.
    path
        The reference that the agent is shown.
    vehicle
        The vehicle of the estimator's model.
    agent
        Whatever has `predict`, for observations of `observer`'s layout.
    observer
        Of the path.
    control_period
        s between proposals.
    settings
        What the estimator believes.

    Raises
    ------
    BagError
        If the sensors do not say where the drive begins, it begins far from the path, or fixes and
        commands were not recorded at the same time.
    """
    start = _start(recording)
    stamp, x, y, heading, speed = start
    foot = path.project(x, y)
    if abs(foot.lateral_error) > FARTHEST_START:
        raise BagError(
            f"{recording.file}: the drive begins {abs(foot.lateral_error):.0f} m from the path: "
            "give its own path, or the path's datum with --datum"
        )
    run = _Run(recording, stamp, Estimator(vehicle, settings, period=min(control_period, 0.02)))
    run.estimator.begin(0.0, x, y, heading, speed)
    observer.begin(run.estimator.state)
    period = round(control_period * SECOND)
    last = min(int(recording.fixes.stamp[-1]), int(recording.commands.stamp[-1]))
    stamps = np.arange(stamp, last + 1, period)
    if len(stamps) < 2:
        raise BagError(f"{recording.file}: fixes and commands do not overlap in time")
    rows: list[list[float]] = []
    memory: Any = None
    for k, now in enumerate(stamps.tolist()):
        run.feed(now)
        state = run.estimator.state
        offset = float(np.clip(run.estimator.biases[2], -WORST_OFFSET, WORST_OFFSET))
        acceleration, steering_angle = run.inputs.before(now)
        observation = observer.observe(state, acceleration, steering_angle + offset)
        proposed = [math.nan, math.nan]
        if path.closed or observer.arc_length < path.length - 1e-6:
            action, memory = agent.predict(observation, memory, episode_start=np.array([k == 0]))
            # The estimator knows that the wheels stand otherwise than they report.
            proposed = [float(action[0]), float(action[1]) - offset]
        rows.append([*state, run.estimator.position_deviation, observer.lateral_error, *proposed])
    table = np.array(rows)
    return Replay(
        recording, path,
        time=(stamps - stamp) / SECOND,
        estimate=table[:, :6], deviation=table[:, 6], lateral_error=table[:, 7],
        odometry=None if recording.odometry is None else _at(recording.odometry, stamps),
        proposed=table[:, 8:],
        recorded=np.array([run.inputs.after(now) for now in stamps.tolist()]),
        fix_time=np.array(run.fix_time), fix_nis=np.array(run.fix_nis),
        fix_used=np.array(run.fix_used, dtype=np.bool_),
        reading_nis=run.reading_nis, readings=run.readings, counts=run.estimator.counts,
    )  # fmt: skip


def _start(recording: Recording) -> tuple[int, float, float, float, float]:
    """Stamp, x, y, heading and speed from which the estimator begins: at the first fix."""
    fixes, positions = recording.fixes, recording.positions
    imu, wheel = recording.imu, recording.wheel
    stamp = int(fixes.stamp[0])
    away = np.hypot(*(positions - positions[0]).T)
    moved = np.flatnonzero(away >= COURSE_BASE)
    if not moved.size:
        raise BagError(f"{recording.file}: the fixes do not move by {COURSE_BASE:g} m")
    first = int(moved[0])
    if imu is not None and not np.isnan(imu.heading).all():
        known = ~np.isnan(imu.heading)
        heading = float(np.interp(stamp, imu.stamp[known], imu.heading[known]))
    else:
        heading = math.atan2(*(positions[first] - positions[0])[::-1])
    if wheel is not None:
        speed = float(np.interp(stamp, wheel.stamp, wheel.speed))
    else:
        speed = float(away[first]) / (float(fixes.time[first]) or 1.0)
    return stamp, float(positions[0, 0]), float(positions[0, 1]), heading, speed


def _at(odometry: Odometry, stamps: Stamps) -> Array:
    """Odometry (n, 6) as states at some stamps, interpolated; NaN outside its span."""
    columns = (
        odometry.longitudinal_speed, odometry.lateral_speed, odometry.heading,
        odometry.yaw_rate, odometry.x, odometry.y,
    )  # fmt: skip
    return np.column_stack(
        [
            np.interp(stamps, odometry.stamp, values, left=math.nan, right=math.nan)
            for values in columns
        ]
    )


class _Run:
    """Feeds an estimator with a recording's readings, up to one stamp after the other."""

    def __init__(self, recording: Recording, start: int, estimator: Estimator) -> None:
        self.estimator, self.inputs, self.start = estimator, Inputs(recording.commands), start
        self.fix_time: list[float] = []
        self.fix_nis: list[float] = []
        self.fix_used: list[bool] = []
        self.reading_nis, self.readings = 0.0, 0
        self._last = start
        self._events = _events(recording, start)
        self._next = 0

    def feed(self, until: int) -> None:
        """Take in all readings with stamps up to `until` (ns), and predict to it."""
        while self._next < len(self._events) and self._events[self._next].stamp <= until:
            self._take(self._events[self._next])
            self._next += 1
        if self._last < until:
            self._advance(until)

    def _advance(self, stamp: int, **readings: float) -> None:
        acceleration, steering_angle = self.inputs.mean(self._last, stamp)
        self.estimator.advance(
            (stamp - self.start) / SECOND, acceleration, steering_angle, **readings
        )
        self._last = stamp
        if readings:
            nis, count = self.estimator.reading_nis
            self.reading_nis += nis
            self.readings += count

    def _take(self, event: "_Event") -> None:
        if event.readings or event.stamp > self._last:
            self._advance(event.stamp, **event.readings)
        if event.fix is None:
            return
        came = self.estimator.take_fix((event.stamp - self.start) / SECOND, *event.fix)
        if came in {"used", "gated"}:
            self.fix_time.append((event.stamp - self.start) / SECOND)
            self.fix_nis.append(self.estimator.fix_nis)
            self.fix_used.append(came == "used")


@dataclass
class _Event:
    """What was read at one stamp."""

    stamp: int
    readings: dict[str, float]
    fix: tuple[float, float] | None = None


def _events(recording: Recording, start: int) -> list[_Event]:
    """Readings from the first fix on, which begins the estimate, by stamp; equal stamps as one."""
    found: dict[int, _Event] = {}

    def event(stamp: int) -> _Event:
        return found.setdefault(stamp, _Event(stamp, {}))

    if recording.imu is not None:
        for name in ("heading", "yaw_rate"):
            values = getattr(recording.imu, name)
            for stamp, value in zip(recording.imu.stamp.tolist(), values.tolist(), strict=True):
                if not math.isnan(value):
                    event(stamp).readings[name] = value
    if recording.wheel is not None:
        wheel = recording.wheel
        for stamp, value in zip(wheel.stamp.tolist(), wheel.speed.tolist(), strict=True):
            event(stamp).readings["speed"] = value
    for stamp, position in zip(
        recording.fixes.stamp.tolist(), recording.positions.tolist(), strict=True
    ):
        event(stamp).fix = (position[0], position[1])
    return [found[stamp] for stamp in sorted(found) if stamp > start]
