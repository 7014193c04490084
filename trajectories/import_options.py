"""Options of reading a foreign path, and the limits of its speed that follow from them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from trajectories.arguments import Number, flag, instance_of, numbers, shown
from trajectories.naming import choose
from trajectories.path import MINIMUM_SPEED
from trajectories.speed_limits import CREEPING_SPEED, UNLIMITED, PlannedVehicle, SpeedLimits

IMPORT_LIMITS = SpeedLimits(
    max_speed=10.0, max_lateral_acceleration=2.0, max_acceleration=1.5, min_speed=CREEPING_SPEED
)
"""Speed limits of an imported path without a vehicle: as for analytic shapes, but it starts at 1.5
m/s and slows down to `CREEPING_SPEED` at kinks."""
NO_LIMITS = SpeedLimits(
    max_speed=UNLIMITED, max_lateral_acceleration=UNLIMITED, max_acceleration=UNLIMITED,
    max_jerk=UNLIMITED, max_steering_rate=UNLIMITED, wheelbase=1e-3, min_speed=MINIMUM_SPEED,
)  # fmt: skip
"""Limits that leave all speeds of a file as they are."""
SPEED_UNITS = {
    "m/s": 1.0, "mps": 1.0, "ms": 1.0, "m_s": 1.0, "km/h": 1.0 / 3.6, "kmh": 1.0 / 3.6,
    "kph": 1.0 / 3.6, "km_h": 1.0 / 3.6, "kmph": 1.0 / 3.6, "mph": 0.44704, "kn": 1852.0 / 3600.0,
    "knots": 1852.0 / 3600.0,
}  # fmt: skip
"""Factors from a unit to m/s."""
SPEEDS = ("file", "planned")
SCALES = Number(0.0, 1e9, above=True)
DISTANCES = Number(0.0, 1e9, "m")
ORIGIN = Number(-1e6, 1e6)
"""Rules of arguments."""


def _text(name: str, value: Any) -> str:
    text: str = instance_of(name, value, str, "text")
    return text


def _names(name: str, value: Any) -> tuple[str, ...]:
    given = instance_of(name, value, list | tuple, "a list of names")
    return tuple(_text(f"{name}[{k}]", one) for k, one in enumerate(given))


@dataclass(frozen=True)
class ImportOptions:
    """Options of reading a path from a foreign file or of an array.

    Parameters
    ----------
    vehicle
        Vehicle that is to drive: the limits of a planned speed are `SpeedLimits.of` it, those of a
        file's speeds `SpeedLimits.hardest`.
    closed
        Whether the end goes on to the start; None decides by whether the ends meet: they are within
        1.5 times the spacing (median, first or last), and the direction continues.
    scale
        Factor on all coordinates and widths.
    smoothing
        Largest rms deviation of the path from the (scaled) points, m, and a third of the largest
        one at any point; 0 interpolates. By default 0.05, and 0.2 for latitudes and longitudes,
        times `scale` if that is below 1.
    minimum_distance
        m: points nearer than this to the last kept one are left out. By default points at the same
        place (1 mm) are merged, and latitudes and longitudes take the smallest of 1, 2 and 4 m that
        takes out the wandering of a receiver that stands.
    speeds
        "file": those of the file, up to what the limits allow. "planned": the fastest profile
        within the limits. None: those of the file if it has any and `scale` is 1.
    speed_unit
        Unit of the file's speeds, one of `SPEED_UNITS`; by default that in the column's name, or
        else m/s.
    columns
        Names of the columns of a table, in place of its header; "-" leaves a column out.
    part
        Name or number of one of several tracks, roads or lanelets in a file; by default the
        longest.
    origin
        Latitude and longitude (deg) and height (m) of x = y = 0, where x points east and y north;
        by default the first point.
    max_speed, max_lateral_acceleration, max_acceleration
        m/s and m/s^2, in place of those in the limits; braking follows `max_acceleration`.
    limits
        All limits of the speed, in place of the vehicle's. Without either, speeds are planned by
        10 m/s, 2 m/s^2 laterally and 1.5 m/s^2 longitudinally, and a file's are kept as they are.
    name
        Name of the path, by default the file's stem.

    Raises
    ------
    ValueError
        Naming the first option that is not as described.
    """

    vehicle: PlannedVehicle | None = None
    closed: bool | None = None
    scale: float = 1.0
    smoothing: float | None = None
    minimum_distance: float | None = None
    speeds: str | None = None
    speed_unit: str | None = None
    columns: Sequence[str] | None = None
    part: str | None = None
    origin: Sequence[float] | None = None
    max_speed: float | None = None
    max_lateral_acceleration: float | None = None
    max_acceleration: float | None = None
    limits: SpeedLimits | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        if self.vehicle is not None and not isinstance(self.vehicle, PlannedVehicle):
            raise ValueError(
                "vehicle must be one of lpv_track_env.vehicle, such as load('m2-minibus'), not "
                f"{shown(self.vehicle)}"
            )
        rules: dict[str, Callable[[str, Any], Any]] = {
            "closed": flag,
            "scale": SCALES.of,
            "smoothing": DISTANCES.of,
            "minimum_distance": DISTANCES.of,
            "speeds": lambda name, value: choose(name, value, SPEEDS),
            "speed_unit": lambda name, value: choose(name, value, tuple(SPEED_UNITS)),
            "columns": _names,
            "part": lambda name, value: _text(name, str(value) if type(value) is int else value),
            "origin": lambda name, value: numbers(name, value, ORIGIN, 3),
            "limits": lambda name, value: instance_of(name, value, SpeedLimits, "SpeedLimits"),
            "name": _text,
        }
        for name, rule in rules.items():
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, rule(name, value))
        self.planning()

    def given(self) -> list[str]:
        """Return the names of the options that differ from their defaults, but for the vehicle."""
        own = [field for field in fields(self) if field.name != "vehicle"]
        return [field.name for field in own if getattr(self, field.name) != field.default]

    def planning(self) -> SpeedLimits:
        """Return the limits of a planned profile."""
        return self._changed(
            IMPORT_LIMITS if self.vehicle is None else SpeedLimits.of(self.vehicle)
        )

    def keeping(self) -> SpeedLimits:
        """Return the limits up to which the speeds of a file are kept."""
        return self._changed(
            NO_LIMITS if self.vehicle is None else SpeedLimits.hardest(self.vehicle)
        )

    def _changed(self, usual: SpeedLimits) -> SpeedLimits:
        names = ("max_speed", "max_lateral_acceleration", "max_acceleration")
        own = {name: value for name in names if (value := getattr(self, name)) is not None}
        if "max_acceleration" in own:
            own["max_deceleration"] = None
        return replace(self.limits or usual, **own)


USUAL = ImportOptions()
"""The defaults."""
