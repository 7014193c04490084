"""Compiled access to a path's table: interpolation between its nodes.

One copy of this arithmetic serves `ReferencePath` and the environments' kernels. A path is a table
of shape (n, 8), C-contiguous (a node is one cache line), on a uniform grid of arc length.
Between nodes, positions and headings are cubic Hermite interpolants (tangents and curvature at the
nodes are their derivatives); speed has constant acceleration within a cell.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajectories.compilation import compiled, compiled_internal

X, Y, COS, SIN, HEADING, CURVATURE, SPEED, TIME = range(8)
TABLE_COLUMNS = 8

Table = NDArray[np.float64]
# Floats inside compiled code; numba ignores annotations, mypy sees what a caller passes.
Float = Any


@compiled_internal
def saturate(value: Float, bound: Float) -> Float:
    """`value` within +-bound; NaN becomes 0, so what is written is always finite."""
    if value != value:  # noqa: PLR0124  NaN
        return 0.0
    return min(max(value, -bound), bound)


@compiled_internal
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


@compiled_internal
def cubic(a: Float, ma: Float, b: Float, mb: Float) -> tuple[Float, Float, Float, Float]:
    """Coefficients in u (lowest first) of the Hermite cubic with ends a, b and slopes ma, mb."""
    d = b - a
    return a, ma, 3.0 * d - 2.0 * ma - mb, ma + mb - 2.0 * d


@compiled_internal
def heading_in(table: Table, h: Float, index: int, u: Float) -> Float:
    """Heading at u in [0, 1] of a cell h long, rad, of the first lap."""
    a, b = index, index + 1
    c0, c1, c2, c3 = cubic(
        table[a, HEADING], h * table[a, CURVATURE], table[b, HEADING], h * table[b, CURVATURE]
    )
    return c0 + u * (c1 + u * (c2 + u * c3))


@compiled_internal
def speed_in(table: Table, index: int, u: Float) -> Float:
    """Speed of the reference at u in [0, 1] of a cell, m/s."""
    v0, v1 = table[index, SPEED], table[index + 1, SPEED]
    return math.sqrt((1.0 - u) * v0 * v0 + u * v1 * v1)
