"""What a replay needs of a bag: sensors and commands, in the frame of a path."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from experiments.ros.read import BagError, info, read
from experiments.ros.reference import datum_of
from experiments.ros.topics import SECOND, Commands, Datum, Fixes, Imu, Odometry, Topic, WheelSpeed

Array = NDArray[np.float64]
T = TypeVar("T", bound=Topic)

COURSE_SPEED, COURSE_BASE, WORST_HEADING = 2.0, 2.0, 0.15
"""m/s, m, rad: an IMU's heading is compared with the fixes' course over this base where the vehicle
is faster than this; beyond the last (9 degrees) it does not point north at all, and is left out."""


@dataclass(frozen=True)
class Recording:
    """A drive's sensors as a bag has them; None where it has none."""

    file: Path
    fixes: Fixes
    positions: Array
    """(m, 2) m, of the fixes, in the path's frame."""
    commands: Commands
    imu: Imu | None
    wheel: WheelSpeed | None
    odometry: Odometry | None
    datum: tuple[float, float, float]
    odometry_is_aligned: bool
    """Whether odometry's frame had to be turned and moved onto the fixes'."""
    remarks: list[str] = field(default_factory=list)


def record(
    file: Path,
    *,
    topics: dict[str, str] | None = None,
    datum: tuple[float, float, float] | None = None,
) -> Recording:
    """Read what a replay needs of a bag.

    Parameters
    ----------
    file
        The bag.
    topics
        Names by kind ("odometry", "imu", "wheel-speed", "fix", "command") where there are several.
    datum
        Latitude, longitude (deg) and height (m) of x = y = 0 of the path; the bag's own if None,
        else the first fix.

    Raises
    ------
    BagError
        If there are no fixes, no commands, or several topics to choose from.
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
    told = optional(Datum)
    origin = datum or datum_of(file, fixes)
    positions = fixes.positions(origin)
    remarks = []
    if imu is not None:
        imu, remark = _trusted(imu, fixes, positions)
        remarks += remark
    if wheel is None and odometry is not None:
        wheel = WheelSpeed(odometry.stamp, odometry.longitudinal_speed)
        remarks.append("no wheel speed: odometry's is taken in its place")
    apart = odometry is not None and (told is None or told.frame != odometry.frame)
    if odometry is not None and apart:
        odometry = _aligned(file, odometry, fixes, positions)
        remarks.append(
            f"no datum of the frame {odometry.frame}: odometry is turned and moved onto the fixes"
        )
    return Recording(file, fixes, positions, commands, imu, wheel, odometry, origin, apart, remarks)


def _trusted(imu: Imu, fixes: Fixes, positions: Array) -> tuple[Imu, list[str]]:
    """An IMU without a heading that is far off the fixes' course: its zero is not east."""
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
    """Odometry turned and moved so that it lies on the fixes, least squares (Umeyama, 1991)."""
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
