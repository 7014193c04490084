"""The reference path: geometry and speed over arc length, sampled, projected on and previewed."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories import projection, table
from trajectories.arguments import Number, Whole, array, flag, instance_of, shown

SPACING = 0.25
"""Usual distance between nodes, m, up to fitting a path's length exactly; imported tracks with
tight bends have less."""
MINIMUM_POINTS = 4
MINIMUM_SPEED = 0.05
"""m/s; a slower reference would take too long to arrive."""
COUNTS = Whole(0, 100_000)
"""Rule of the number of entries of a preview."""
ARC_LENGTHS = Number(unit="m")
"""Rule of an arc length."""
SEAM_GAP = 2e-3
"""Largest gap between the ends of a closed path, in m and, for the heading, in turns."""

Array = NDArray[np.float64]


class PathSample(NamedTuple):
    """A path's quantities at given arc lengths, each shaped like the arc length; SI units."""

    x: Array
    y: Array
    heading: Array
    curvature: Array
    speed: Array
    acceleration: Array
    time: Array


class Projection(NamedTuple):
    """Foot point of a position on a path."""

    arc_length: float
    lateral_error: float
    heading: float
    curvature: float


class Preview(NamedTuple):
    """The reference over the next periods of its own time; see `ReferencePath.preview`."""

    curvature: Array
    speed: Array


def _finite(what: str, values: ArrayLike) -> Array:
    """Return values of any shape as an array; raise a ValueError unless all are finite."""
    given = array(what, values)
    if not np.isfinite(given).all():
        raise ValueError(f"{what} must be finite, not {shown(values)}")
    return given


@dataclass(frozen=True, eq=False)
class ReferencePath:
    """A planar reference path with a speed profile, on a uniform grid of arc length.

    Parameters
    ----------
    arc_length
        (n,) m, from 0, uniform.
    x, y
        (n,) m.
    heading
        (n,) rad, counter-clockwise from x; jumps by whole turns, as of arctan2, are unwrapped.
    curvature
        (n,) 1/m, signed, positive to the left.
    speed
        (n,) m/s along the tangent.
    name
        Name for reports.
    closed
        Whether the end joins the start: the last node repeats the first, its heading up to whole
        turns.
    metadata
        Plain JSON values: source, published and achieved statistics, speed limits, warnings.
    widths
        (n, 2) m from the path to the right and the left edge of the road, if known.

    Raises
    ------
    ValueError
        If there are fewer than 4 points, lengths differ, a value is not finite (its column and
        index are named), arc length does not start at 0 or is not uniform, the heading points
        backwards, the ends of a closed path do not join, a speed is below 0.05 m/s, or a width is
        negative.
    """

    arc_length: Array
    x: Array
    y: Array
    heading: Array
    curvature: Array
    speed: Array
    name: str = "path"
    closed: bool = False
    metadata: Mapping[str, Any] = field(default_factory=dict)
    widths: Array | None = None

    def __post_init__(self) -> None:
        instance_of("name", self.name, str, "text")
        instance_of("metadata", self.metadata, Mapping, "a mapping")
        object.__setattr__(self, "closed", flag("closed", self.closed))
        n = np.size(self.arc_length)
        shape: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("arc_length", "x", "y", "heading", "curvature", "speed"), (n,)
        )
        if self.widths is not None:
            shape["widths"] = (n, 2)
        if n < MINIMUM_POINTS:
            raise ValueError(
                f"path {shown(self.name)}: {n} points, at least {MINIMUM_POINTS} are needed"
            )
        for column, wanted in shape.items():
            values = array(column, getattr(self, column)).copy()
            if values.shape != wanted:
                raise ValueError(
                    f"path {shown(self.name)}: {column} has shape {values.shape}, not {wanted}"
                )
            if not np.isfinite(values).all():
                index = int(np.argwhere(~np.isfinite(values))[0][0])
                raise ValueError(f"path {shown(self.name)}: {column}[{index}] is {values[index]}")
            values.flags.writeable = False
            object.__setattr__(self, column, values)
        steps = np.diff(self.arc_length)
        if (steps <= 0).any():
            index = int(np.flatnonzero(steps <= 0)[0]) + 1
            raise ValueError(
                f"path {shown(self.name)}: arc_length does not increase at index {index}"
            )
        uneven = np.abs(steps - self.spacing) > 1e-6 * self.spacing + 1e-9 * self.arc_length[-1]
        if abs(self.arc_length[0]) > 1e-9 or uneven.any():
            raise ValueError(
                f"path {shown(self.name)}: arc_length must start at 0 and be uniform "
                f"(index {int(np.argmax(uneven)) + 1} is not)"
            )
        self._check_heading()
        self._check_seam()
        if (self.speed < MINIMUM_SPEED).any():
            index = int(np.argmin(self.speed))
            raise ValueError(
                f"path {shown(self.name)}: speed[{index}] is {self.speed[index]} m/s, "
                f"at least {MINIMUM_SPEED} is needed"
            )
        if self.widths is not None and (self.widths < 0.0).any():
            index = int(np.argwhere(self.widths < 0.0)[0][0])
            raise ValueError(f"path {shown(self.name)}: widths[{index}] is negative")

    def _check_heading(self) -> None:
        """Unwrap the heading; reject one that points backwards, such as one in degrees."""
        if (np.abs(np.diff(self.heading)) > np.pi).any():
            unwrapped = np.unwrap(self.heading)
            unwrapped.flags.writeable = False
            object.__setattr__(self, "heading", unwrapped)
        x, y = np.diff(self.x), np.diff(self.y)
        middle = 0.5 * (self.heading[1:] + self.heading[:-1])
        backwards = x * np.cos(middle) + y * np.sin(middle) < 0.0
        if backwards.any():
            index = int(np.argmax(backwards))
            raise ValueError(
                f"path {shown(self.name)}: heading[{index}] is {self.heading[index]:.4g} rad, but "
                f"the path goes on in direction {np.arctan2(y[index], x[index]):.4g} rad: headings "
                "must be in radians, counter-clockwise from x"
            )

    def _check_seam(self) -> None:
        """Reject a closed path whose ends do not join."""
        if not self.closed:
            return
        gap = float(np.hypot(self.x[-1] - self.x[0], self.y[-1] - self.y[0]))
        if gap > SEAM_GAP:
            raise ValueError(f"path {shown(self.name)}: closed, but its ends are {gap:.3g} m apart")
        turns = (self.heading[-1] - self.heading[0]) / (2.0 * np.pi)
        if abs(turns - round(turns)) > SEAM_GAP:
            raise ValueError(
                f"path {shown(self.name)}: closed, but it turns by {turns:.4f} turns, "
                "not whole ones"
            )

    @classmethod
    def from_waypoints(
        cls,
        points: ArrayLike,
        *,
        closed: bool | None = None,
        speed: ArrayLike | None = None,
        widths: ArrayLike | None = None,
        **options: Any,
    ) -> "ReferencePath":
        """Make a path of waypoints in the order of driving, as from a file of them.

        Parameters
        ----------
        points
            (n, 2) x, y in m.
        closed
            Whether the end goes on to the start; None decides by whether the ends meet.
        speed
            (n,) m/s, which the path keeps up to the limits in the options; planned if None.
        widths
            (n, 2) m from the points to the right and the left edge of the road.
        options
            Further fields of `trajectories.import_options.ImportOptions`, such as `vehicle`,
            `smoothing`, `max_speed` or `name`.

        Raises
        ------
        ValueError
            If an array has another shape, a value is not finite, an option is none, or the points
            are no drivable path; the message names the point.
        """
        from trajectories.importers import path_of_arrays

        return path_of_arrays(points, speed, widths, {"closed": closed, **options})

    @property
    def length(self) -> float:
        """Length, m."""
        return float(self.arc_length[-1])

    @property
    def spacing(self) -> float:
        """Arc length between two nodes, m."""
        return self.length / (len(self.arc_length) - 1)

    @cached_property
    def time(self) -> Array:
        """(n,) time of the reference at each node, s; its acceleration is constant in a cell."""
        steps = 2.0 * self.spacing / (self.speed[1:] + self.speed[:-1])
        return np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def acceleration(self) -> Array:
        """(n,) tangential acceleration in the cell after each node, m/s^2."""
        cells = np.diff(self.speed**2) / (2.0 * self.spacing)
        return np.append(cells, cells[0] if self.closed else cells[-1])

    @property
    def duration(self) -> float:
        """Time of the reference from start to end, s."""
        return float(self.time[-1])

    @cached_property
    def table(self) -> Array:
        """(n, 8) nodes for compiled code, with the columns of `trajectories.table`."""
        columns = (
            self.x, self.y, np.cos(self.heading), np.sin(self.heading), self.heading,
            self.curvature, self.speed, self.time,
        )  # fmt: skip
        return np.ascontiguousarray(np.column_stack(columns))

    def sample(self, s: ArrayLike) -> PathSample:
        """Interpolate at arc lengths s (m, any shape): wrapped if closed, clamped if open."""
        s = _finite("arc length", s)
        rows = np.empty((s.size, 7))
        table.sample(self.table, self.length, self.closed, s.flatten(), self.acceleration, rows)
        return PathSample(*(column.reshape(s.shape) for column in rows.T))

    def project(self, x: float, y: float, near: float | None = None) -> Projection:
        """Foot point of the position (x, y), m.

        With `near` (an arc length, m), search only the path within 3 m of it: the foot point stays
        on the local branch of a path that crosses or approaches itself. Without, search all of it.
        The lateral error is positive to the left of the path.
        """
        _finite("position", (x, y) if near is None else (x, y, near))
        start, window = 0.5 * self.length, (0.5 if self.closed else 1.0) * self.length
        if near is not None:
            start, window = near, projection.SEARCH_WINDOW
        s, lateral_error, heading, curvature = projection.project(
            self.table, self.length, self.closed, float(x), float(y), float(start), window
        )
        return Projection(s, lateral_error, heading, curvature)

    def arc_length_at(self, time: ArrayLike) -> Array:
        """Arc length of the reference at times (s, any shape) after its start, m."""
        times = _finite("time", time)
        values = [
            table.arc_length_at(self.table, self.length, self.closed, float(t), 0)[0]
            for t in times.ravel()
        ]
        return np.array(values).reshape(times.shape)

    def preview(self, s: float, period: float, count: int) -> Preview:
        """Curvature and speed of the reference over the next `count` periods from arc length s.

        `curvature` (count,): mean signed curvature between successive nodes of the reference's own
        time grid, 1/m; `speed` (count,): speed at each interval's end, m/s.
        """
        _finite("arc length and period", (s, period))
        count = COUNTS.of("count", count)
        values = np.empty(2 * count)
        table.preview(self.table, self.length, self.closed, float(s), float(period), values)
        return Preview(values[:count], values[count:])

    def with_speed(self, speed: ArrayLike, **metadata: Any) -> "ReferencePath":
        """Return the same geometry with another speed profile, a scalar or (n,), m/s."""
        given = _finite("speed", speed)
        if given.shape not in {(), self.arc_length.shape}:
            raise ValueError(f"speed has shape {given.shape}, not () or {self.arc_length.shape}")
        values = np.broadcast_to(given, self.arc_length.shape)
        return replace(self, speed=values, metadata={**self.metadata, **metadata})

    def mirrored(self) -> "ReferencePath":
        """Return the path reflected at the x axis: left and right exchanged."""
        return replace(
            self, y=-self.y, heading=-self.heading, curvature=-self.curvature,
            name=f"{self.name}-mirrored",
            widths=None if self.widths is None else self.widths[:, ::-1],
        )  # fmt: skip

    def section(self, start: float, end: float) -> "ReferencePath":
        """Return the open path from arc length `start` to `end`, m, at the nearest nodes.

        Raises
        ------
        ValueError
            If it is not within the path, does not end after its start, or has fewer than 4 nodes.
        """
        start, end = (ARC_LENGTHS.of("section", value) for value in (start, end))
        if not 0.0 <= start < end <= self.length + 0.5 * self.spacing:
            raise ValueError(
                f"path {shown(self.name)}: section {start:g} to {end:g} m does not go forward "
                f"within its {self.length:.6g} m"
            )
        nodes = slice(round(start / self.spacing), round(end / self.spacing) + 1)
        return ReferencePath(
            self.arc_length[nodes] - self.arc_length[nodes.start],
            self.x[nodes], self.y[nodes], self.heading[nodes], self.curvature[nodes],
            self.speed[nodes], f"{self.name}-{start:g}-{end:g}",
            metadata={**self.metadata, "section": [start, end]},
            widths=None if self.widths is None else self.widths[nodes],
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        cached = {"table", "time", "acceleration"}
        return {key: value for key, value in self.__dict__.items() if key not in cached}
