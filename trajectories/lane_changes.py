"""Lane changes between cones after ISO 3888-1 and ISO 3888-2, and a line through the lanes.

Lengths of the sections and widths of the lanes are those of the standards' tables, for a vehicle of
width w (m). The lateral offset is measured between lines of cones:

- ISO 3888-1 (double lane change): sections of 15, 30, 25, 25, 15, 15 m; lanes of 1.1 w + 0.25,
  1.2 w + 0.25 and 1.3 w + 0.25, the last over two sections. The right line of the second lane is
  3.5 m to the left of that of the first; the third lane begins at the first one's right line.
- ISO 3888-2 (obstacle avoidance): sections of 12, 13.5, 11, 12.5, 12 m; lanes of 1.1 w + 0.25,
  w + 1, and 1.3 w + 0.25 but at least 3. The right line of the second lane is 1 m to the left of
  the left line of the first; the third lane ends at the first one's left line.

The standards are not free; these figures agree with public implementations of them, which differ
in one point: on which line of the first lane the wider third one lies.

A vehicle passes if no part of its outline leaves a lane over its length. The line is the smoothest
that keeps `MARGIN` for a body of `BODY` metres that points along it: the largest curvature, and
`RAMP` times its largest slope, are as small as they can be, by linear programmes.
"""

import math
import re
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories import shapes
from trajectories.arguments import Number, shown
from trajectories.path import SPACING, ReferencePath
from trajectories.speed import SpeedLimits

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

Array = NDArray[np.float64]
Lane = tuple[float, float, float, float]
"""x_begin, x_end, y_right, y_left, m."""

NAMES = ("iso-3888-1", "iso-3888-2")
"""Kinds of lane changes, named KIND-WIDTH."""
WIDTH = Number(0.1, 10.0, "m")
"""Rule of the width of a vehicle."""
GATE = 3.0
"""x of the first cones, m: the centre of gravity starts at 0, vehicles of up to 6 m before them."""
AFTER = 30.0
"""m of straight after the last cones: a second at the highest speeds."""
BODY = 4.5
"""Length of the body that the line keeps between the cones, m."""
MARGIN = 0.1
"""Distance of that body from all lines of cones, m: half of what is left beside it at least."""
RAMP = 2.0
"""m over which curvature may change: price of its slope beside its size."""
LIMITS = SpeedLimits(
    max_speed=10.0, max_lateral_acceleration=6.0, max_acceleration=1.5, end_speed=10.0
)
"""Limits of the speed that a path has unless it is driven at a fixed one."""

_NAME = re.compile(r"iso-3888-(?P<part>[12])-(?P<width>\d{1,4}(\.\d{1,8})?)")
_DEGREE, _KNOTS, _POINTS, _ROUNDS = 5, 1.0, 13, 3


def lanes(part: int, width: float) -> list[Lane]:
    """Return the lanes of ISO 3888-`part` for a vehicle of a width, m.

    The first begins at x = `GATE`; its middle is y = 0.
    """
    half = 0.5 * (1.1 * width + 0.25)
    if part == 1:
        second, third = 3.5 - half, -half
        measured = [
            (0.0, 15.0, -half, half),
            (45.0, 70.0, second, second + 1.2 * width + 0.25),
            (95.0, 125.0, third, third + 1.3 * width + 0.25),
        ]
    else:
        second, third = half + 1.0, half - max(1.3 * width + 0.25, 3.0)
        measured = [
            (0.0, 12.0, -half, half),
            (25.5, 36.5, second, second + width + 1.0),
            (49.0, 61.0, third, half),
        ]
    return [(GATE + begin, GATE + end, right, left) for begin, end, right, left in measured]


def outline(length: float, width: float, middle: float) -> Array:
    """Return the corners of a body about its centre of gravity, (4, 2) m, in order.

    `middle` is the distance of the body's middle before the centre of gravity.
    """
    front, rear, side = middle + 0.5 * length, middle - 0.5 * length, 0.5 * width
    return np.array([(front, side), (rear, side), (rear, -side), (front, -side)])


def clearance(
    cones: ArrayLike, x: ArrayLike, y: ArrayLike, heading: ArrayLike, corners: ArrayLike
) -> float:
    """Return the least distance of an outline from the lines of cones, m; negative beyond one.

    Distances are across the lanes, and count over the length of each lane for all that is between
    its ends, corners or sides. Without any part in a lane the result is inf.

    Parameters
    ----------
    cones
        Lanes, (m, 4): x_begin, x_end, y_right, y_left, m.
    x, y, heading
        Poses of the centre of gravity, (n,) m, m, rad.
    corners
        Corners of the outline, (k, 2) m, in order, from the centre of gravity, x forwards.
    """
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    ahead, aside = np.asarray(corners, dtype=np.float64).T
    along = np.asarray(x)[:, None] + c * ahead - s * aside
    across = np.asarray(y)[:, None] + s * ahead + c * aside
    step, rise = np.roll(along, -1, 1) - along, np.roll(across, -1, 1) - across
    flat = np.where(np.abs(step) > 1e-12, step, 1e-12)
    least = math.inf
    for begin, end, right, left in np.asarray(cones, dtype=np.float64):
        # Of each side, the part between the ends of the lane: from share `first` to `last`.
        bounds = np.sort(np.stack([(begin - along) / flat, (end - along) / flat]), axis=0)
        first, last = bounds[0].clip(0.0, 1.0), bounds[1].clip(0.0, 1.0)
        inside = (bounds[0] <= 1.0) & (bounds[1] >= 0.0)
        for share in (first, last):
            at = (across + share * rise)[inside]
            if at.size:
                least = min(least, float(left - at.max()), float(at.min() - right))
    return least


def load(name: str) -> ReferencePath | None:
    """Return the path of a name KIND-WIDTH, such as "iso-3888-1-1.61"; None for other names.

    Raises
    ------
    ValueError
        If the width is not one of `WIDTH`.
    """
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    width = WIDTH.of(f"trajectory {shown(name)}: the width", float(match["width"]))
    return lane_change(int(match["part"]), width)


def lane_change(part: int, width: float) -> ReferencePath:
    """Make the path through the lanes of ISO 3888-`part` for a vehicle of a width, m.

    It starts `GATE` before the first cones, in the middle of the first lane and straight. The lanes
    are in `metadata["cones"]`.
    """
    cones = lanes(part, width)
    spline = _line(cones, width)
    first, second = spline.derivative(), spline.derivative(2)

    def curve(t: Array) -> shapes.Derivatives:
        return t, spline(t), np.ones_like(t), first(t), np.zeros_like(t), second(t)

    geometry = shapes.parametric(curve, cones[-1][1] + AFTER, pieces=2000)
    return shapes.from_geometry(
        geometry, LIMITS, f"iso-3888-{part}-{width:.10g}",
        source=f"lanes of ISO 3888-{part} for a vehicle of {width:g} m; line by lpv-track-env",
        cones=[list(lane) for lane in cones],
    )  # fmt: skip


def _line(cones: list[Lane], width: float) -> "BSpline":
    """Return y over x of the smoothest line on which the body keeps `MARGIN` from the cones.

    Unknowns are the control points of a quintic spline, the largest curvature, and its largest
    slope. Headings, and the factor between curvature and second derivative, are those of the last
    programme; from the second on they hardly change.
    """
    from scipy.interpolate import BSpline
    from scipy.optimize import linprog

    end = cones[-1][1] + AFTER
    cells = math.ceil(end / _KNOTS)
    knots = end / cells * np.arange(-_DEGREE, cells + _DEGREE + 1)
    basis = BSpline(knots, np.eye(cells + _DEGREE), _DEGREE)
    x = shapes.grid(end)
    value, slope, bend, jerk = (basis(x, nu=order) for order in range(4))
    straight = x >= cones[-1][1] + 0.5 * BODY
    fixed = np.vstack([value[:1], slope[:1], bend[:1], slope[straight]])
    side = 0.5 * width
    points = [(d, e) for e in (side, -side) for d in np.linspace(-0.5 * BODY, 0.5 * BODY, _POINTS)]
    steepness = np.zeros_like(x)
    for _ in range(_ROUNDS):
        heading, stretch = np.arctan(steepness), 1.0 + steepness**2
        c, s = np.cos(heading), np.sin(heading)
        rows, most = [], []
        for matrix, factor, column in ((bend, stretch**1.5, 0), (jerk, np.ones_like(x), 1)):
            excess = np.zeros((len(x), 2))
            excess[:, column] = -factor
            rows += [np.hstack([sign * matrix, excess]) for sign in (1.0, -1.0)]
            most += [np.zeros(len(x))] * 2
        for d, e in points:
            at, lever = x + d * c - e * s, (d * c - e * s) / stretch
            for begin, last, right, left in cones:
                here = (at >= begin - SPACING) & (at <= last + SPACING)
                matrix = value[here] + lever[here, None] * slope[here]
                rest = (d * s + e * c - lever * steepness)[here]
                rows += [np.hstack([sign * matrix, np.zeros((len(rest), 2))]) for sign in (1, -1)]
                most += [left - MARGIN - rest, rest - right - MARGIN]
        found = linprog(
            np.concatenate([np.zeros(value.shape[1]), [1.0, RAMP]]),
            A_ub=np.vstack(rows), b_ub=np.concatenate(most),
            A_eq=np.hstack([fixed, np.zeros((len(fixed), 2))]), b_eq=np.zeros(len(fixed)),
            bounds=(None, None), method="highs",
        )  # fmt: skip
        control = found.x[:-2]
        steepness = slope @ control
    return BSpline(knots, control, _DEGREE)
