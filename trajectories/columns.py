"""Columns of a table of points: quantity and unit by name, and the points that they make.

A name may end in its unit: `v_kmh`, `Velocity (km/h)`, `x [mm]`. Without one it is in SI units, and
angles are in degrees.
"""

import math
import re
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trajectories.arguments import shortened, shown
from trajectories.import_options import SPEED_UNITS, ImportOptions
from trajectories.raw_path import RawPath
from trajectories.text_table import TextTable, is_number, read_table

Array = NDArray[np.float64]

LENGTHS = {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3}
ANGLES = {"deg": 1.0, "degrees": 1.0, "°": 1.0, "rad": math.degrees(1.0)}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
NUMBERS = {"1": 1.0}
"""Factors from a unit to m, deg, s and 1."""
NAMES: dict[str, tuple[dict[str, float], str]] = {
    "x": (LENGTHS, "x east easting utm_e utm_east utm_easting utm_x pos_x position_x x_ref"),
    "y": (LENGTHS, "y north northing utm_n utm_north utm_northing utm_y pos_y position_y y_ref"),
    "latitude": (ANGLES, "lat latitude gps_lat gps_latitude"),
    "longitude": (ANGLES, "lon lng long longitude gps_lon gps_long gps_longitude"),
    "height": (LENGTHS, "h height alt altitude ele elevation"),
    "time": (TIMES, "t time timestamp"),
    "speed": (
        SPEED_UNITS,
        (
            "v vx velocity speed vel vx_racetraj longitudinal_velocity target_speed gps_speed "
            "linear_x linear_velocity desired_velocity desired_speed reference_speed ref_speed "
            "v_ref spd"
        ),
    ),
    "sideways": (SPEED_UNITS, "vy"),
    "width_right": (LENGTHS, "w_tr_right width_right w_right"),
    "width_left": (LENGTHS, "w_tr_left width_left w_left"),
    "normal_x": (NUMBERS, "x_normvec x_normvec_m"),
    "normal_y": (NUMBERS, "y_normvec y_normvec_m"),
    "offset": (LENGTHS, "alpha"),
}
"""Units of each quantity, and its names in lower case, the likelier ones first."""
KNOWN = {
    f"{name}{unit and joint}{unit}": (quantity, rank, factor)
    for quantity, (units, names) in NAMES.items()
    for rank, name in enumerate(names.split())
    for unit, factor in {"": 1.0, **units}.items()
    for joint in ("_", "")
    if joint or len(unit) > 2  # as in speedKmh
}
"""Quantity, rank and factor by name."""
KNOWN_NAMES = "known are x, y, v, lat, lon, h, t, w_right, w_left and others, with units as v_kmh"
"""End of messages on names."""
_NAME = re.compile(r"(.*?)\s*(?:[(\[]([^)\]]*)[)\]])?", re.DOTALL)
"""Name and unit of a column."""
_MESSAGE = re.compile(r"^.*_(?=position_[xy]$|linear_x$)")
"""Names of ROS messages before a field, as in `field.pose.pose.position.x`."""
UNNEEDED = ("height", "time", "sideways")
"""Quantities that no path needs: a column with the name of one but an unknown unit, such as the
temperature `T [C]`, is left out."""
IGNORED = "-"
"""Name of a column that is not read."""


class Column(NamedTuple):
    """Quantity of a column, rank of its name, and factor to the usual unit (NaN: unknown unit)."""

    quantity: str
    rank: int
    factor: float


def known(name: str) -> Column | None:
    """Return the column that a name stands for; None for an unknown name."""
    words, unit = _NAME.fullmatch(name.lower()).groups()  # type: ignore[union-attr]
    plain = re.sub(r"[\s./-]+", "_", words.strip())
    found = KNOWN.get(_MESSAGE.sub("", plain))
    if found is None or unit is None:
        return None if found is None else Column(*found)
    return Column(*found[:2], NAMES[found[0]][0].get(unit.strip(), math.nan))


def read_points(
    file: str | Path, options: ImportOptions, usual: tuple[str, ...] = ("x_m", "y_m")
) -> RawPath:
    """Read the points of a table: x,y in metres or a GPS log, with speeds and widths if there.

    `usual` are the names of the columns of a table without a header that has as many.

    Raises
    ------
    ValueError
        If the file is no table, or its columns are not known; the message names line and column.
    """
    table = read_table(file, known)
    width, header = len(table.rows[0]), table.header
    if not header and width == len(usual):
        header = usual
    if options.columns is not None:
        header = tuple(options.columns)
        if len(header) != width:
            table.fail(
                f"has {width} columns, but {len(header)} are named: name each, and those "
                f"that are not needed {IGNORED!r}"
            )
        for name in header:
            if name != IGNORED and known(name) is None:
                table.fail(f"column name {shown(name)} is not known: {KNOWN_NAMES}")
    return _Points(replace(table, header=header), options).raw_path()


class _Points:
    """The quantities that are found in a table."""

    def __init__(self, table: TextTable, options: ImportOptions) -> None:
        self.table, self.options = table, options
        self.found: dict[str, tuple[int, int, float]] = {}
        self.twins: dict[int, int] = {}
        for index, column in enumerate(map(known, table.header)):
            if column is None or (column.quantity in UNNEEDED and math.isnan(column.factor)):
                continue
            better = (column.rank, index, column.factor)
            held = self.found.setdefault(column.quantity, better)
            if held[1] < index and held[::2] == better[::2]:
                self.twins[held[1]] = index
            self.found[column.quantity] = min(better, held)

    def __contains__(self, quantities: str) -> bool:
        return set(quantities.split()) <= self.found.keys()

    def read(self, quantity: str) -> Array:
        """Return a quantity (n,) in its usual unit."""
        _, index, factor = self.found[quantity]
        if index in self.twins:
            one, other = (shown(self.table.header[k]) for k in (index, self.twins[index]))
            self.table.fail(
                f"columns {one} and {other} may both be the {quantity}: name the columns, those "
                f"that are not needed {IGNORED!r}"
            )
        if math.isnan(factor):
            name = shown(self.table.header[index])
            units = ", ".join(NAMES[quantity][0])
            self.table.fail(f"the unit in the column's name {name} is none of {units}")
        return self.table.column(index) * factor

    def raw_path(self) -> RawPath:
        """Return the points, as metres or as angles."""
        columns: dict[str, Array] = {}
        metadata: dict[str, str] = {}
        if "latitude longitude" in self:
            kind = "GPS log"
            metadata |= self._drop_rows_without_fix()
            columns = {q: self.read(q) for q in ("latitude", "longitude")}
            if "height" in self:
                columns["height"] = self.read("height")
            if "time" in self:
                columns["time"] = self._times(self.found["time"][1])
        elif "x y" in self:
            kind = "x,y waypoints"
            columns = {q: self.read(q) for q in ("x", "y")}
            if "time speed" in self:
                columns["time"] = self._times(self.found["time"][1])
        else:
            self._fail()
        if "width_right width_left" in self:
            kind = "racetrack-database centre line" if kind == "x,y waypoints" else kind
            columns |= {q: self.read(q) for q in ("width_right", "width_left")}
        if "x normal_x normal_y offset" in self:
            kind = "racing line"
            self._shift(columns)
        if "speed" in self and self.options.speeds != "planned":
            columns["speed"] = self._speeds()
            index = self.found["speed"][1]
            metadata["speed_column"] = shortened(self.table.header[index], 40)
        elif "speed" not in self and (others := self._others()):
            metadata["others"] = f"no speed among its other columns {others}"
        places = [f"line {line}" for line in self.table.lines]
        file = self.table.file
        return RawPath(kind, str(file), file.stem, columns, places, metadata=metadata)

    def _others(self) -> str:
        """Return the names of the columns that stand for nothing known."""
        header = self.table.header
        names = [name for name in header if name not in {"", IGNORED} and known(name) is None]
        return shortened(", ".join(names), 80)

    def _drop_rows_without_fix(self) -> dict[str, str]:
        """Leave out rows without latitude and longitude, and return words that say so."""
        table, places = self.table, [self.found[q][1] for q in ("latitude", "longitude")]
        fixed = [k for k, row in enumerate(table.rows) if any(row[place] for place in places)]
        if (count := len(table.rows) - len(fixed)) == 0:
            return {}
        self.table = replace(
            table, rows=[table.rows[k] for k in fixed], lines=[table.lines[k] for k in fixed]
        )
        self.table.check_size()
        return {"missing": f"{count} rows without a position left out"}

    def _fail(self) -> None:
        """Raise a ValueError that says which columns are missing."""
        header, width = self.table.header, len(self.table.rows[0])
        if not header:
            rest = "v" if width == 3 else " ".join([IGNORED] * min(width - 2, 10))
            self.table.fail(
                f"{width} columns without a header: give it one, such as x_m,y_m,v_mps, or name "
                f"them, in load(..., columns=[...]) or by lpv-track trajectories FILE --columns "
                f"x y {rest} --write DIR"
            )
        if "latitude" in self or "longitude" in self:
            self.table.fail("a GPS log needs latitudes and longitudes: one of them is missing")
        self.table.fail(
            f"no columns x and y in its header {shortened(','.join(header), 80)!r}; {KNOWN_NAMES}"
        )

    def _times(self, index: int) -> Array:
        """Read times (n,), s, from a column of numbers, of ISO 8601 stamps, or of times of day."""
        table = self.table
        if is_number(table.rows[0][index], table.separator):
            return self.read("time")
        stamps = np.empty(len(table.rows))
        for k, row in enumerate(table.rows):
            try:
                day = "" if "-" in row[index] else "1970-01-02T"
                stamps[k] = datetime.fromisoformat(day + row[index]).timestamp()
            except (ValueError, OverflowError, OSError):
                table.fail(f"line {table.lines[k]}: {shown(row[index])} is not a time")
        return stamps

    def _speeds(self) -> Array:
        """Return the speeds (n,), m/s; two columns vx and vy are the components of a velocity."""
        if self.options.speed_unit is not None:
            unit = SPEED_UNITS[self.options.speed_unit]
            for quantity in {"speed", "sideways"} & self.found.keys():
                self.found[quantity] = (*self.found[quantity][:2], unit)
        speeds = self.read("speed")
        rank = self.found["speed"][0]
        if "sideways" in self and NAMES["speed"][1].split()[rank] == "vx":
            return np.hypot(speeds, self.read("sideways"))
        return speeds

    def _shift(self, columns: dict[str, Array]) -> None:
        """Move the points and widths from a reference line to the racing line beside it.

        It is `alpha` along the normal vector, which points to the right (TUMFTM,
        global_racetrajectory_optimization, conventions of its readme).
        """
        offset = self.read("offset")
        for axis in ("x", "y"):
            columns[axis] = columns[axis] + offset * self.read(f"normal_{axis}")
        if "width_right" in columns:
            columns["width_right"] = columns["width_right"] - offset
            columns["width_left"] = columns["width_left"] + offset
