"""Compiled access to a path's table: interpolation, projection, preview.

One copy of this arithmetic serves `ReferencePath` and the environments' kernels. A path is a table
of shape (n, 8), C-contiguous (a node is one cache line), on a uniform grid of arc length.
Between nodes, positions and headings are cubic Hermite interpolants (tangents and curvature at the
nodes are their derivatives); speed has constant acceleration within a cell.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajectories.compilation import compiled

X, Y, COS, SIN, HEADING, CURVATURE, SPEED, TIME = range(8)
TABLE_COLUMNS = 8
SEARCH_WINDOW = 3.0
"""m: projection looks this far around the last arc length, so it stays on the local branch."""
NEWTON_STEPS = 3
FAR = 1.0e300

Table = NDArray[np.float64]
# Floats inside compiled code; numba ignores annotations, mypy sees what a caller passes.
Float = Any


@compiled
def cell(s: Float, length: Float, closed: bool, n: int) -> tuple[int, Float]:
    """Cell index and offset (m) in it; s is wrapped on a closed path, clamped on an open one."""
    spacing = length / (n - 1)
    if closed:
        s -= math.floor(s / length) * length
    s = min(max(s, 0.0), length)
    index = max(min(int(s / spacing), n - 2), 0)  # never outside, even for NaN
    return index, s - index * spacing


@compiled
def heading_at(table: Table, length: Float, closed: bool, s: Float) -> Float:
    """Unwrapped heading, rad; continued straight beyond an open end, turning on over laps."""
    n = table.shape[0]
    index, offset = cell(s, length, closed, n)
    h = length / (n - 1)
    u = offset / h
    p0, p1 = table[index, HEADING], table[index + 1, HEADING]
    m0, m1 = table[index, CURVATURE] * h, table[index + 1, CURVATURE] * h
    d = p1 - p0
    heading = p0 + u * (m0 + u * ((3.0 * d - 2.0 * m0 - m1) + u * (m0 + m1 - 2.0 * d)))
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
    """Speed of the reference, m/s: its square is linear within a cell."""
    n = table.shape[0]
    index, offset = cell(s, length, closed, n)
    u = offset * (n - 1) / length
    v0, v1 = table[index, SPEED], table[index + 1, SPEED]
    return math.sqrt((1.0 - u) * v0 * v0 + u * v1 * v1)


@compiled
def time_at(table: Table, length: Float, closed: bool, s: Float) -> Float:
    """Time at which the reference passes s, s; the end speed is held beyond an open end."""
    n = table.shape[0]
    index, offset = cell(s, length, closed, n)
    u = offset * (n - 1) / length
    v0, v1 = table[index, SPEED], table[index + 1, SPEED]
    speed = math.sqrt((1.0 - u) * v0 * v0 + u * v1 * v1)
    time = table[index, TIME] + 2.0 * offset / (v0 + speed)
    if closed:
        return time + math.floor(s / length) * table[n - 1, TIME]
    return time + max(s - length, 0.0) / table[n - 1, SPEED]


@compiled
def arc_length_at(table: Table, length: Float, closed: bool, time: Float, index: int) -> Any:
    """Arc length at which the reference is at a time, and its cell: the inverse of `time_at`.

    `index` is a cell at or before the answer (0 when unknown); on a closed path `time` may run
    over several laps, and the arc length then runs on.
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
def nearest_node(table: Table, closed: bool, x: Float, y: Float, first: int, count: int) -> int:
    """Index of the node nearest to a point among `count` nodes from `first` on."""
    n = table.shape[0]
    best, best_distance = 0, FAR
    for k in range(first, first + count):
        node = k
        if closed:
            node = k % (n - 1)
        elif k < 0 or k >= n:
            continue
        dx, dy = x - table[node, X], y - table[node, Y]
        distance = dx * dx + dy * dy
        if distance < best_distance:
            best, best_distance = k, distance
    return best


@compiled
def project(
    table: Table, length: Float, closed: bool, x: Float, y: Float, near: Float, window: Float
) -> tuple[Float, Float, Float, Float]:
    """Foot point of (x, y): arc length, lateral error, heading and curvature there.

    Nodes within `window` of the arc length `near` are searched, then the foot point is refined by
    Newton's method. The lateral error is positive to the left of the path. On a closed path the
    arc length runs on over laps with `near`. On an open path it lies within [0, length].
    """
    n = table.shape[0]
    spacing = length / (n - 1)
    middle = math.floor(near / spacing + 0.5)
    reach = math.ceil(window / spacing)
    if not closed:
        middle = min(max(middle, 0), n - 1)
    node = nearest_node(table, closed, x, y, middle - reach, 2 * reach + 1)
    s = node * spacing
    low, high = s - spacing, s + spacing
    if not closed:
        low, high = max(low, 0.0), min(high, length)
    for _ in range(NEWTON_STEPS):
        px, py = position_at(table, length, closed, s)
        heading = heading_at(table, length, closed, s)
        c, d = math.cos(heading), math.sin(heading)
        dx, dy = x - px, y - py
        curvature = curvature_at(table, length, closed, s)
        stretch = max(1.0 - curvature * (dy * c - dx * d), 0.3)
        s = min(max(s + (dx * c + dy * d) / stretch, low), high)
    px, py = position_at(table, length, closed, s)
    heading = heading_at(table, length, closed, s)
    lateral_error = (y - py) * math.cos(heading) - (x - px) * math.sin(heading)
    return s, lateral_error, heading, curvature_at(table, length, closed, s)


@compiled
def preview(
    table: Table,
    length: Float,
    closed: bool,
    s: Float,
    period: Float,
    curvature: NDArray[Any],
    speed: NDArray[Any],
) -> None:
    """Fill the preview at s: what the reference does over the next `count` periods of its own time.

    `curvature[k]`, shape (count,): mean signed curvature between the arc lengths that the reference
    reaches k and k + 1 periods from now, so that headings at these nodes follow exactly;
    `speed[k]`, shape (count,): its speed at node k + 1. An open path goes on straight at its last
    speed.
    """
    n = table.shape[0]
    now = time_at(table, length, closed, s)
    index, _ = cell(s, length, closed, n)
    start = s
    heading = heading_at(table, length, closed, s)
    for k in range(curvature.shape[0]):
        end, index = arc_length_at(table, length, closed, now + (k + 1) * period, index)
        next_heading = heading_at(table, length, closed, end)
        curvature[k] = (next_heading - heading) / max(end - start, 1e-9)
        speed[k] = speed_at(table, length, closed, end)
        start, heading = end, next_heading
