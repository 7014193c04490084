"""Compiled access to a path's table: interpolation between its nodes, and the preview.

One copy of this arithmetic serves `ReferencePath` and the environments' kernels. A table has shape
(n, 8), C-contiguous (a node is one cache line), with nodes on a uniform grid of arc length; a cell
is the interval between two nodes, and u in [0, 1] the place in it. Between nodes, positions and
headings are cubic Hermite interpolants (the tangent and the curvature at the nodes are their
derivatives), and the acceleration is constant.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajectories.compilation import compiled, compiled_inline, compiled_internal

# Columns of a table: m, m, cosine and sine of the heading, rad, 1/m, m/s, s.
X, Y, COS, SIN, HEADING, CURVATURE, SPEED, TIME = range(8)

Table = NDArray[np.float64]
# Floats inside compiled code: numba ignores annotations, and mypy accepts every caller's type.
Float = Any


@compiled_internal
def saturate(value: Float, bound: Float) -> Float:
    """Clip `value` to +-bound; NaN becomes 0, so the result is always finite."""
    if value != value:  # noqa: PLR0124  NaN
        return 0.0
    return min(max(value, -bound), bound)


@compiled_internal
def cell(s: Float, length: Float, closed: bool, n: int) -> tuple[int, Float]:
    """Cell of arc length s and the offset (m) in it; s is wrapped if closed, clamped if open."""
    spacing = length / (n - 1)
    if closed:
        s -= math.floor(s / length) * length
    s = min(max(s, 0.0), length)
    index = max(min(int(s / spacing), n - 2), 0)  # never outside, even for NaN
    return index, s - index * spacing


@compiled_internal
def cubic(a: Float, ma: Float, b: Float, mb: Float) -> tuple[Float, Float, Float, Float]:
    """Coefficients in u (lowest first) of the Hermite cubic with ends a, b and slopes ma, mb."""
    d = b - a
    return a, ma, 3.0 * d - 2.0 * ma - mb, ma + mb - 2.0 * d


@compiled_internal
def heading_in(table: Table, h: Float, index: int, u: Float) -> Float:
    """Heading at u in a cell of length h, rad, on the first lap."""
    a, b = index, index + 1
    c0, c1, c2, c3 = cubic(
        table[a, HEADING], h * table[a, CURVATURE], table[b, HEADING], h * table[b, CURVATURE]
    )
    return c0 + u * (c1 + u * (c2 + u * c3))


@compiled_internal
def speed_in(table: Table, index: int, u: Float) -> Float:
    """Speed of the reference at u in a cell, m/s: its square is linear in u."""
    v0, v1 = table[index, SPEED], table[index + 1, SPEED]
    return math.sqrt((1.0 - u) * v0 * v0 + u * v1 * v1)


@compiled
def heading_at(table: Table, length: Float, closed: bool, s: Float) -> Float:
    """Unwrapped heading, rad; straight on beyond an open end, counting whole turns over laps."""
    n = table.shape[0]
    index, offset = cell(s, length, closed, n)
    h = length / (n - 1)
    heading = heading_in(table, h, index, offset / h)
    if closed:
        laps = math.floor(s / length)
        heading += laps * (table[n - 1, HEADING] - table[0, HEADING])
    return heading


@compiled
def curvature_at(table: Table, length: Float, closed: bool, s: Float) -> Float:
    """Signed curvature, 1/m, linear between nodes."""
    n = table.shape[0]
    index, offset = cell(s, length, closed, n)
    u = offset * (n - 1) / length
    return (1.0 - u) * table[index, CURVATURE] + u * table[index + 1, CURVATURE]


@compiled
def position_at(table: Table, length: Float, closed: bool, s: Float) -> tuple[Float, Float]:
    """Position, m."""
    n = table.shape[0]
    index, offset = cell(s, length, closed, n)
    h = length / (n - 1)
    u = offset / h
    h00 = 1.0 + u * u * (2.0 * u - 3.0)
    h10 = h * u * (1.0 + u * (u - 2.0))
    h01 = u * u * (3.0 - 2.0 * u)
    h11 = h * u * u * (u - 1.0)
    a, b = table[index], table[index + 1]
    return (
        h00 * a[X] + h10 * a[COS] + h01 * b[X] + h11 * b[COS],
        h00 * a[Y] + h10 * a[SIN] + h01 * b[Y] + h11 * b[SIN],
    )


@compiled
def speed_at(table: Table, length: Float, closed: bool, s: Float) -> Float:
    """Speed of the reference, m/s."""
    n = table.shape[0]
    index, offset = cell(s, length, closed, n)
    return speed_in(table, index, offset * (n - 1) / length)


@compiled
def time_at(table: Table, length: Float, closed: bool, s: Float) -> Float:
    """Time at which the reference passes s, s; beyond an open end it keeps its last speed."""
    n = table.shape[0]
    index, offset = cell(s, length, closed, n)
    speed = speed_in(table, index, offset * (n - 1) / length)
    time = table[index, TIME] + 2.0 * offset / (table[index, SPEED] + speed)
    if closed:
        return time + math.floor(s / length) * table[n - 1, TIME]
    return time + max(s - length, 0.0) / table[n - 1, SPEED]


@compiled
def arc_length_at(table: Table, length: Float, closed: bool, time: Float, index: int) -> Any:
    """Arc length of the reference at a time, m, and its cell: the inverse of `time_at`.

    The search starts at the cell `index`, which must not lie behind the answer (0 if unknown). On a
    closed path `time` may cover several laps; the arc length then grows from lap to lap.
    """
    n = table.shape[0]
    spacing = length / (n - 1)
    laps = 0.0
    duration = table[n - 1, TIME]
    if closed:
        laps = math.floor(time / duration)
        time -= laps * duration
        if time < table[index, TIME]:
            index = 0
    elif time >= duration:
        return length + (time - duration) * table[n - 1, SPEED], n - 2
    while index < n - 2 and table[index + 1, TIME] <= time:
        index += 1
    v0, v1 = table[index, SPEED], table[index + 1, SPEED]
    tau = max(time - table[index, TIME], 0.0)
    acceleration = (v1 * v1 - v0 * v0) / (2.0 * spacing)
    offset = min(tau * (v0 + 0.5 * acceleration * tau), spacing)
    return laps * length + index * spacing + offset, index


@compiled
def sample(
    table: Table, length: Float, closed: bool, s: NDArray[Any], acceleration: NDArray[Any],
    out: NDArray[Any],
) -> None:  # fmt: skip
    """Write x, y, heading, curvature, speed, acceleration and time at s (m,) into `out` (m, 7).

    `acceleration` (n - 1,) or longer holds the reference's acceleration in each cell, m/s^2.
    """
    for k in range(s.shape[0]):
        index, _ = cell(s[k], length, closed, table.shape[0])
        out[k, 0], out[k, 1] = position_at(table, length, closed, s[k])
        out[k, 2] = heading_at(table, length, closed, s[k])
        out[k, 3] = curvature_at(table, length, closed, s[k])
        out[k, 4] = speed_at(table, length, closed, s[k])
        out[k, 5] = acceleration[index]
        out[k, 6] = time_at(table, length, closed, s[k])


@compiled_inline
def fill_preview(
    table: Table, length: Float, closed: bool, s: Float, index: int, u: Float, period: Float,
    out: NDArray[Any], first: int, count: int, curvature_bound: Float, speed_bound: Float,
) -> None:  # fmt: skip
    """Write the preview at s (see `preview`), whose place is u in the cell `index` (first lap).

    `out[first : first + count]` receives the curvatures and the `count` entries after it the
    speeds, both clipped to their bounds.
    """
    n = table.shape[0]
    # Never negative, but this tells the compiler, which then omits a check at every access.
    index = max(index, 0)
    h = length / (n - 1)
    inverse, quarter = 1.0 / h, 0.25 * (n - 1) / length
    # One type for all: comparisons between types cost conversions.
    curvature_bound, speed_bound = np.float64(curvature_bound), np.float64(speed_bound)
    duration, last_speed = table[n - 1, TIME], table[n - 1, SPEED]
    now = table[index, TIME] + 2.0 * u * h / (table[index, SPEED] + speed_in(table, index, u))
    heading = heading_in(table, h, index, u)
    # Offsets of the current lap in arc length, heading and time.
    base, turned, passed = s - (index + u) * h, 0.0, 0.0
    if not closed:
        base = 0.0
        now += max(s - length, 0.0) / last_speed
    start = s
    for k in range(count):
        time = now + (k + 1) * period - passed
        if time >= duration:
            if closed:
                laps = math.floor(time / duration)
                passed += laps * duration
                time = max(time - laps * duration, 0.0)
                base += laps * length
                turned += laps * (table[n - 1, HEADING] - table[0, HEADING])
                index = 0
            else:
                end = length + (time - duration) * last_speed
                next_heading = table[n - 1, HEADING]
                mean = (next_heading - heading) / max(end - start, 1e-9)
                out[first + k] = min(max(mean, -curvature_bound), curvature_bound)
                out[first + count + k] = min(last_speed, speed_bound)
                start, heading = end, next_heading
                continue
        # This stops before the end, because the last node's time is beyond `time`.
        while table[index + 1, TIME] <= time:
            index += 1
        v0, v1 = table[index, SPEED], table[index + 1, SPEED]
        tau = time - table[index, TIME]
        half = quarter * (v1 * v1 - v0 * v0) * tau
        offset = tau * (v0 + half)
        end = base + (index * h + offset)
        next_heading = turned + heading_in(table, h, index, offset * inverse)
        mean = (next_heading - heading) / max(end - start, 1e-9)
        out[first + k] = min(max(mean, -curvature_bound), curvature_bound)
        out[first + count + k] = min(v0 + 2.0 * half, speed_bound)
        start, heading = end, next_heading


@compiled
def preview(
    table: Table,
    length: Float,
    closed: bool,
    s: Float,
    period: Float,
    values: NDArray[Any],
) -> None:
    """Fill the preview at s: the reference over the next `count` periods of its own time.

    `values` has shape (2 count,): first the mean signed curvature between the arc lengths that the
    reference reaches k and k + 1 periods from now, so that the headings at these nodes follow
    exactly; then its speed at node k + 1. An open path goes on straight at its last speed.
    """
    count = values.shape[0] // 2
    index, offset = cell(s, length, closed, table.shape[0])
    u = offset * (table.shape[0] - 1) / length
    fill_preview(table, length, closed, s, index, u, period, values, 0, count, math.inf, math.inf)
