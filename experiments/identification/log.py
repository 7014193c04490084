"""Logs of drives for identification: commands, and what was measured, each with its own times."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trajectories.arguments import shortened, shown
from trajectories.text_table import TextTable, read_table

Array = NDArray[np.float64]

CHANNELS = ("vx", "vy", "heading", "yaw_rate", "x", "y")
"""Quantities that may be measured, in the order of the model's state: m/s, m/s, rad, rad/s, m, m;
body frame, left positive."""
COMMANDS = ("acceleration", "steering")
"""Commands to the actuators, m/s^2 and rad, each in force from its time on."""
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "time": ("time", "t", "time_s", "t_s", "timestamp"),
    "vx": ("vx", "vx_mps", "longitudinal_speed", "speed", "v"),
    "vy": ("vy", "vy_mps", "lateral_speed"),
    "heading": ("heading", "heading_rad", "psi", "psi_rad", "yaw"),
    "yaw_rate": ("yaw_rate", "yaw_rate_radps", "r"),
    "x": ("x", "x_m"),
    "y": ("y", "y_m"),
    "acceleration": ("acceleration_command", "acceleration", "a"),
    "steering": ("steering_command", "steering_angle", "steering", "delta"),
}
"""Names that a column may have in the header of a CSV file, in lower case."""

SHORTEST = 30.0
"""Shortest log, s."""
BIN = 0.01
"""Time over which denser readings are averaged, s."""
LONGEST = 3600.0
"""Longest log, s."""


@dataclass(frozen=True)
class Log:
    """A drive: commands and readings.

    Parameters
    ----------
    name
        The file's name, for messages.
    commands
        Times (n,), s, and commands (n, 2) in the order of `COMMANDS`.
    readings
        Times (m,), s, and values (m,) by `CHANNELS`.

    Raises
    ------
    ValueError
        In one line, for a log that is too short or lacks what identification needs.
    """

    name: str
    commands: tuple[Array, Array]
    readings: Mapping[str, tuple[Array, Array]]

    def __post_init__(self) -> None:
        series = {"commands": self.commands[0], **{k: v[0] for k, v in self.readings.items()}}
        for name, times in series.items():
            if len(times) < 3 or (np.diff(times) <= 0.0).any():
                self._fail(f"{name}: at least 3 times are needed, and they must increase")
        if not {"vx", "x"} & set(self.readings):
            self._fail("has neither a speed (vx) nor positions (x, y)")
        if not {"yaw_rate", "heading", "x"} & set(self.readings):
            self._fail("has neither a yaw rate, nor a heading, nor positions")
        first, last = self.span
        if last - first < SHORTEST:
            self._fail(f"{max(last - first, 0.0):.1f} s of drive; at least {SHORTEST:g} are needed")
        if last - first > LONGEST:
            self._fail(f"{last - first:.0f} s of drive; cut it to at most {LONGEST:g}")

    def _fail(self, message: str) -> None:
        raise ValueError(f"{self.name}: {message}")

    @property
    def span(self) -> tuple[float, float]:
        """First and last time, s, between which all quantities are known."""
        times = [self.commands[0][:1], *(times for times, _ in self.readings.values())]
        ends = [self.commands[0], *(times for times, _ in self.readings.values())]
        return max(float(t[0]) for t in times), min(float(t[-1]) for t in ends)


def averaged(times: Array, values: Array) -> tuple[Array, Array]:
    """Return means over `BIN` of readings that are denser than that; others as they are."""
    if len(times) < 2 or float(np.median(np.diff(times))) >= 0.99 * BIN:
        return times, values
    index = np.floor((times - times[0]) / BIN + 1e-6).astype(np.int64)
    _, place = np.unique(index, return_inverse=True)
    count = np.bincount(place)
    return np.bincount(place, times) / count, np.bincount(place, values) / count


def read(file: Path, topics: Mapping[str, str] | None = None) -> Log:
    """Read a log: a CSV file with a header of `COLUMNS`, or a bag.

    `topics` names a bag's topics by kind, as `lpv-track bag replay` does.

    Raises
    ------
    ValueError
        In one line that begins with the file's name.
    ModuleNotFoundError
        For a bag without `rosbags`.
    """
    if file.suffix.lower() in {".csv", ".txt", ".tsv"}:
        return _of_table(read_table(file, _quantity))
    return _of_bag(file, topics or {})


def _quantity(name: str) -> str | None:
    """Return the quantity that a column's name stands for."""
    return next((quantity for quantity, names in COLUMNS.items() if name in names), None)


def _of_table(table: TextTable) -> Log:
    found = {
        quantity: next((table.header.index(name) for name in names if name in table.header), None)
        for quantity, names in COLUMNS.items()
    }
    for needed in ("time", *COMMANDS):
        if found[needed] is None:
            names = " or ".join(COLUMNS[needed])
            table.fail(f"no column {names} in its header {shown(','.join(table.header))}")
    columns = {
        quantity: table.column(index, gaps=True)
        for quantity, index in found.items()
        if index is not None
    }
    time = columns.pop("time")
    if np.isnan(time).any():
        table.fail(f"line {table.lines[int(np.isnan(time).argmax())]}: has no time")
    back = np.flatnonzero(np.diff(time) <= 0.0)
    if back.size:
        k = int(back[0]) + 1
        table.fail(f"line {table.lines[k]}: time {time[k]:g} is not after {time[k - 1]:g}")
    time = time - time[0]
    given = ~np.isnan(columns["acceleration"]) & ~np.isnan(columns["steering"])
    commands = np.column_stack([columns.pop(name)[given] for name in COMMANDS])
    readings = {}
    for name, values in columns.items():
        known = ~np.isnan(values)
        if known.any():
            readings[name] = (time[known], values[known])
    if ("x" in readings) != ("y" in readings):
        table.fail("has x or y alone: both or neither")
    return _tidied(shortened(table.file), (time[given], commands), readings)


def _of_bag(file: Path, topics: Mapping[str, str]) -> Log:
    """Read commands, and odometry, or in its place IMU, wheel speed and fixes."""
    from experiments.ros.read import info
    from experiments.ros.read import read as read_topic
    from experiments.ros.topics import SECOND, Commands, Fixes, Imu, Odometry, Topic, WheelSpeed

    bag = info(file)
    start = bag.start

    def series(topic: Topic, name: str) -> tuple[Array, Array]:
        values: Array = getattr(topic, name)
        known = ~np.isnan(values)
        return (topic.stamp[known] - start) / SECOND, values[known]

    def has(kind: type[Topic]) -> bool:
        return kind.KIND in topics or bool(bag.of_kind(kind))

    sent = read_topic(file, Commands, topics.get(Commands.KIND)).data
    commands = np.column_stack([sent.acceleration, sent.steering_angle])
    readings: dict[str, tuple[Array, Array]] = {}
    if has(Odometry):
        odometry = read_topic(file, Odometry, topics.get(Odometry.KIND)).data
        names = ("longitudinal_speed", "lateral_speed", "heading", "yaw_rate", "x", "y")
        readings = {
            channel: series(odometry, name) for channel, name in zip(CHANNELS, names, strict=True)
        }
    else:
        if has(WheelSpeed):
            wheel = read_topic(file, WheelSpeed, topics.get(WheelSpeed.KIND)).data
            readings["vx"] = series(wheel, "speed")
        if has(Imu):
            imu = read_topic(file, Imu, topics.get(Imu.KIND)).data
            readings["yaw_rate"] = series(imu, "yaw_rate")
            readings["heading"] = series(imu, "heading")
        if has(Fixes):
            fixes = read_topic(file, Fixes, topics.get(Fixes.KIND)).data
            first = float(fixes.latitude[0]), float(fixes.longitude[0]), 0.0
            at = (fixes.stamp - start) / SECOND
            for column, name in enumerate(("x", "y")):
                readings[name] = at, fixes.positions(first)[:, column]
    readings = {name: (times, values) for name, (times, values) in readings.items() if len(times)}
    return _tidied(shortened(file), ((sent.stamp - start) / SECOND, commands), readings)


def _tidied(
    name: str, commands: tuple[Array, Array], readings: dict[str, tuple[Array, Array]]
) -> Log:
    """Unwrap headings, average dense readings, and keep what lies within the common span."""
    if "heading" in readings:
        times, heading = readings["heading"]
        readings["heading"] = times, np.unwrap(heading)
    readings = {name: averaged(*series) for name, series in readings.items()}
    whole = Log(name, commands, readings)
    first, last = whole.span
    kept = {}
    for channel, (times, values) in readings.items():
        inside = (times >= first - 1e-9) & (times <= last + 1e-9)
        kept[channel] = (times[inside], values[inside])
    return Log(name, commands, kept)
