"""Replay of a recorded drive: its sensor readings through the estimator and an agent.

Readings enter the filter in the order of their stamps, with the recorded commands as inputs. In
every control period the agent observes the path from the estimated state, and its action is
compared with the recorded command. The agent's actions do not move the vehicle.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from experiments.ros.read import BagError, info, read
from experiments.ros.reference import datum_of
from experiments.ros.topics import (
    SECOND,
    Commands,
    Datum,
    Fixes,
    GeoPoint,
    Imu,
    Odometry,
    Stamps,
    Topic,
    WheelSpeed,
)
from lpv_track_env.conditions.layout import MAX_STEERING_OFFSET
from lpv_track_env.estimation.estimator import Estimator
from lpv_track_env.estimation.observer import PathObserver
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Array = NDArray[np.float64]
T = TypeVar("T", bound=Topic)

FARTHEST_START = 20.0
"""Distance from the path beyond which a drive cannot belong to it, m."""
COURSE_SPEED = 2.0
"""Speed above which an IMU's heading is compared with the course of the fixes, m/s."""
COURSE_BASE = 2.0
"""Distance between the fixes that a course is computed from, m."""
WORST_HEADING = 0.15
"""Median difference from the course beyond which an IMU's heading is left out, rad (9 degrees)."""


@dataclass(frozen=True)
class Recording:
    """Sensor readings and commands of a drive; optional topics are None if the bag has none."""

    file: Path
    fixes: Fixes
    positions: Array
    """(m, 2) m, of the fixes in the path's frame."""
    commands: Commands
    imu: Imu | None
    wheel: WheelSpeed | None
    odometry: Odometry | None
    datum: GeoPoint
    odometry_is_aligned: bool
    """True if odometry was rotated and moved onto the fixes."""
    remarks: list[str] = field(default_factory=list)


def record(
    file: Path, *, topics: dict[str, str] | None = None, datum: GeoPoint | None = None
) -> Recording:
    """Read the sensor readings and commands of a bag.

    `topics` gives names by kind ("odometry", "imu", "wheel-speed", "fix", "command"), required for
    kinds of which the bag has several. `datum` is the path's origin, by default the bag's own, else
    the first fix.

    Raises
    ------
    BagError
        If there are no fixes, no commands, or several topics of a kind without a name.
    """
    named = topics or {}
    bag = info(file)

    def optional(kind: type[T]) -> T | None:
        if kind.KIND not in named and not bag.of_kind(kind):
            return None
        return read(file, kind, named.get(kind.KIND)).data

    fixes = read(file, Fixes, named.get(Fixes.KIND)).data
    commands = read(file, Commands, named.get(Commands.KIND)).data
    imu, wheel, odometry = optional(Imu), optional(WheelSpeed), optional(Odometry)
    own_datum = optional(Datum)
    origin = datum or datum_of(file, fixes)
    positions = fixes.positions(origin)
    remarks = []
    if imu is not None:
        imu, remark = _trusted(imu, fixes, positions)
        remarks += remark
    if wheel is None and odometry is not None:
        wheel = WheelSpeed(odometry.stamp, odometry.longitudinal_speed)
        remarks.append("no wheel speed: odometry's is taken in its place")
    apart = odometry is not None and (own_datum is None or own_datum.frame != odometry.frame)
    if odometry is not None and apart:
        odometry = _aligned(file, odometry, fixes, positions)
        remarks.append(
            f"no datum of the frame {odometry.frame}: odometry is turned and moved onto the fixes"
        )
    return Recording(file, fixes, positions, commands, imu, wheel, odometry, origin, apart, remarks)


def _trusted(imu: Imu, fixes: Fixes, positions: Array) -> tuple[Imu, list[str]]:
    """Return the IMU without its heading if that is far off the fixes' course, and a remark."""
    known = ~np.isnan(imu.heading)
    kept = [0]
    for k in range(1, len(positions)):
        if math.dist(positions[k], positions[kept[-1]]) >= COURSE_BASE:
            kept.append(k)
    if len(kept) < 3 or not known.any():
        return imu, []
    steps = np.diff(positions[kept], axis=0)
    taken = np.diff(fixes.stamp[kept]) / SECOND
    at = 0.5 * (fixes.stamp[kept][1:] + fixes.stamp[kept][:-1])
    heading = np.interp(at, imu.stamp[known], imu.heading[known])
    off = np.angle(np.exp(1j * (heading - np.arctan2(steps[:, 1], steps[:, 0]))))
    off = off[np.hypot(*steps.T) > COURSE_SPEED * taken]
    if len(off) < 3 or abs(float(np.median(off))) <= WORST_HEADING:
        return imu, []
    remark = (
        f"the IMU's heading is off the fixes' course by {float(np.median(off)):.2f} rad: left out"
    )
    columns = {name: getattr(imu, name) for name in imu.columns() if name != "heading"}
    return Imu(imu.stamp, heading=np.full(len(imu), np.nan), **columns), [remark]


def _aligned(file: Path, odometry: Odometry, fixes: Fixes, positions: Array) -> Odometry:
    """Rotate and move odometry onto the fixes by least squares (Umeyama, 1991)."""
    inside = (fixes.stamp >= odometry.stamp[0]) & (fixes.stamp <= odometry.stamp[-1])
    if inside.sum() < 3:
        raise BagError(f"{file}: odometry and fixes do not overlap in time")
    own = np.interp(fixes.stamp[inside], odometry.stamp, odometry.x) + 1j * np.interp(
        fixes.stamp[inside], odometry.stamp, odometry.y
    )
    theirs = positions[inside, 0] + 1j * positions[inside, 1]
    turn = float(np.angle(np.sum(np.conj(own - own.mean()) * (theirs - theirs.mean()))))
    moved = theirs.mean() + np.exp(1j * turn) * (odometry.x + 1j * odometry.y - own.mean())
    return Odometry(
        odometry.stamp, moved.real, moved.imag, odometry.heading + turn,
        odometry.longitudinal_speed, odometry.lateral_speed, odometry.yaw_rate,
        frame=odometry.frame,
    )  # fmt: skip


@dataclass(frozen=True)
class Replay:
    """Result of a replay, at the ends of n control periods and at m fixes."""

    recording: Recording
    path: ReferencePath
    time: Array
    """(n,) s since the first fix."""
    estimate: Array
    """(n, 6) vx, vy, psi, r, X, Y."""
    deviation: Array
    """(n,) m, the filter's standard deviation of the position in its worst direction."""
    lateral_error: Array
    """(n,) m, of the estimate, left of the path."""
    odometry: Array | None
    """(n, 6) recorded, as `estimate`; NaN outside its time span."""
    proposed: Array
    """(n, 2) acceleration, steering angle; NaN beyond the path's end."""
    recorded: Array
    """(n, 2) commands in force from then on."""
    fix_time: Array
    """(m,) s since the first fix."""
    fix_nis: Array
    """(m,) normalised innovations squared of the fixes."""
    fix_used: NDArray[np.bool_]
    """(m,) False where the filter's gate rejected the fix."""
    reading_nis: float
    """Sum of the normalised innovations squared of all IMU and wheel readings used."""
    readings: int
    """Number of those readings."""
    counts: dict[str, int]
    """Fixes and readings, used and refused, by outcome."""


class Inputs:
    """Recorded commands as piecewise constant inputs; the first also holds before its stamp."""

    def __init__(self, commands: Commands) -> None:
        self.stamp = commands.stamp
        self.values = np.column_stack([commands.acceleration, commands.steering_angle])
        held = np.diff(self.stamp)[:, None] / SECOND * self.values[:-1]
        self.integral = np.vstack([np.zeros(2), np.cumsum(held, axis=0)])

    def before(self, stamp: int) -> Array:
        """Return the inputs (2,) in force until a stamp."""
        return self._at(int(np.searchsorted(self.stamp, stamp, "left")) - 1)

    def after(self, stamp: int) -> Array:
        """Return the inputs (2,) in force from a stamp on."""
        return self._at(int(np.searchsorted(self.stamp, stamp, "right")) - 1)

    def mean(self, first: int, last: int) -> Array:
        """Return the mean inputs (2,) between two stamps; if equal, the inputs until then."""
        if last <= first:
            return self.before(last)
        whole: Array = (self._sum(last) - self._sum(first)) / ((last - first) / SECOND)
        return whole

    def _at(self, index: int) -> Array:
        found: Array = self.values[max(index, 0)]
        return found

    def _sum(self, stamp: int) -> Array:
        """Return the integral (2,) of the inputs from the first stamp on."""
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
) -> Replay:
    """Replay a recording in the frame of the path.

    The estimator has the `vehicle`'s model. The `agent` is called every `control_period` (s) with
    observations by `observer`, which observes the same path.

    Raises
    ------
    BagError
        If the readings do not determine the start, it is far from the path, or fixes and commands
        do not overlap in time.
    """
    stamp, x, y, heading, speed = _start(recording)
    distance = abs(path.project(x, y).lateral_error)
    if distance > FARTHEST_START:
        raise BagError(
            f"{recording.file}: the drive begins {distance:.0f} m from the path: "
            "give its own path, or the path's datum with --datum"
        )
    estimator = Estimator(vehicle, period=min(control_period, 0.02))
    feeder = _Feeder(recording, stamp, estimator)
    inputs = feeder.inputs
    estimator.begin(0.0, x, y, heading, speed)
    observer.begin(estimator.state)
    period = round(control_period * SECOND)
    last = min(int(recording.fixes.stamp[-1]), int(recording.commands.stamp[-1]))
    stamps = np.arange(stamp, last + 1, period)
    if len(stamps) < 2:
        raise BagError(f"{recording.file}: fixes and commands do not overlap in time")
    rows: list[list[float]] = []
    memory: Any = None
    for k, now in enumerate(stamps.tolist()):
        feeder.feed(now)
        state = estimator.state
        offset = float(np.clip(estimator.biases[2], -MAX_STEERING_OFFSET, MAX_STEERING_OFFSET))
        acceleration, steering_angle = inputs.before(now)
        observation = observer.observe(state, acceleration, steering_angle + offset)
        proposed = [math.nan, math.nan]
        if path.closed or observer.arc_length < path.length - 1e-6:
            action, memory = agent.predict(observation, memory, episode_start=np.array([k == 0]))
            # A command lacks the offset between the wheels' angle and the reported one.
            proposed = [float(action[0]), float(action[1]) - offset]
        rows.append([*state, estimator.position_deviation, observer.lateral_error, *proposed])
    table = np.array(rows)
    return Replay(
        recording, path,
        time=(stamps - stamp) / SECOND,
        estimate=table[:, :6], deviation=table[:, 6], lateral_error=table[:, 7],
        odometry=None if recording.odometry is None else _at(recording.odometry, stamps),
        proposed=table[:, 8:],
        recorded=np.array([inputs.after(now) for now in stamps.tolist()]),
        fix_time=np.array(feeder.fix_time), fix_nis=np.array(feeder.fix_nis),
        fix_used=np.array(feeder.fix_used, dtype=np.bool_),
        reading_nis=feeder.reading_nis, readings=feeder.readings, counts=estimator.counts,
    )  # fmt: skip


def _start(recording: Recording) -> tuple[int, float, float, float, float]:
    """Return stamp, x, y, heading and speed at the first fix, where the estimator begins."""
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
    """Return odometry as states (n, 6), interpolated to stamps; NaN outside its time span."""
    columns = ("longitudinal_speed", "lateral_speed", "heading", "yaw_rate", "x", "y")
    values = (getattr(odometry, name) for name in columns)
    outside = {"left": math.nan, "right": math.nan}
    return np.column_stack([np.interp(stamps, odometry.stamp, one, **outside) for one in values])


class _Feeder:
    """Feeds a recording's readings to an estimator, up to one stamp after the other."""

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
        """Take all readings with stamps up to `until` (ns), and predict to that time."""
        while self._next < len(self._events) and self._events[self._next].stamp <= until:
            self._take(self._events[self._next])
            self._next += 1
        if self._last < until:
            self._advance(until)

    def _advance(self, stamp: int, **readings: float) -> None:
        """Predict to a stamp and correct by the readings there."""
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
        """Predict to an event and correct by its readings and its fix."""
        if event.readings or event.stamp > self._last:
            self._advance(event.stamp, **event.readings)
        if event.fix is None:
            return
        time = (event.stamp - self.start) / SECOND
        outcome = self.estimator.take_fix(time, *event.fix)
        if outcome in {"used", "gated"}:
            self.fix_time.append(time)
            self.fix_nis.append(self.estimator.fix_nis)
            self.fix_used.append(outcome == "used")


@dataclass
class _Event:
    """Readings at one stamp."""

    stamp: int
    readings: dict[str, float]
    fix: tuple[float, float] | None = None


def _events(recording: Recording, start: int) -> list[_Event]:
    """Return the readings after the first fix by stamp, with equal stamps merged."""
    found: dict[int, _Event] = {}

    def event(stamp: int) -> _Event:
        return found.setdefault(stamp, _Event(stamp, {}))

    def add(name: str, stamps: Stamps, values: Array) -> None:
        for stamp, value in zip(stamps.tolist(), values.tolist(), strict=True):
            if not math.isnan(value):
                event(stamp).readings[name] = value

    if recording.imu is not None:
        add("heading", recording.imu.stamp, recording.imu.heading)
        add("yaw_rate", recording.imu.stamp, recording.imu.yaw_rate)
    if recording.wheel is not None:
        add("speed", recording.wheel.stamp, recording.wheel.speed)
    for stamp, (x, y) in zip(
        recording.fixes.stamp.tolist(), recording.positions.tolist(), strict=True
    ):
        event(stamp).fix = (x, y)
    return [found[stamp] for stamp in sorted(found) if stamp > start]
