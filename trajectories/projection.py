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
NEWTON_STEPS = 8
"""At most; two or three are the rule."""
NEWTON_TOLERANCE = 1e-6
"""Of a cell: Newton's method stops after a step below it."""
FAR = 1.0e300

Table = NDArray[np.float64]
# Floats inside compiled code; numba ignores annotations, mypy sees what a caller passes.
Float = Any


@compiled
def saturate(value: Float, bound: Float) -> Float:
    """`value` within +-bound; NaN becomes 0, so what is written is always finite."""
    if value != value:  # noqa: PLR0124  NaN
        return 0.0
    return min(max(value, -bound), bound)


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
def cubic(a: Float, ma: Float, b: Float, mb: Float) -> tuple[Float, Float, Float, Float]:
    """Coefficients in u (lowest first) of the Hermite cubic with ends a, b and slopes ma, mb."""
    d = b - a
    return a, ma, 3.0 * d - 2.0 * ma - mb, ma + mb - 2.0 * d


@compiled
def heading_in(table: Table, h: Float, index: int, u: Float) -> Float:
    """Heading at u in [0, 1] of a cell h long, rad, of the first lap."""
    a, b = index, index + 1
    c0, c1, c2, c3 = cubic(
        table[a, HEADING], h * table[a, CURVATURE], table[b, HEADING], h * table[b, CURVATURE]
    )
    return c0 + u * (c1 + u * (c2 + u * c3))


@compiled
def speed_in(table: Table, index: int, u: Float) -> Float:
    """Speed of the reference at u in [0, 1] of a cell, m/s."""
    v0, v1 = table[index, SPEED], table[index + 1, SPEED]
    return math.sqrt((1.0 - u) * v0 * v0 + u * v1 * v1)


@compiled
def squared_distance(table: Table, closed: bool, x: Float, y: Float, node: int) -> Float:
    """Squared distance of a point from a node, m^2; on a closed path nodes go on over laps."""
    if closed:
        node %= table.shape[0] - 1
    dx, dy = x - table[node, X], y - table[node, Y]
    return dx * dx + dy * dy


@compiled
def nearest_node(table: Table, closed: bool, x: Float, y: Float, first: int, last: int) -> int:
    """Index of the node nearest to a point, of those from `first` to `last`; of equals the first.

    On a closed path the indices go on over laps.
    """
    best, best_distance = first, FAR
    for k in range(first, last + 1):
        distance = squared_distance(table, closed, x, y, k)
        if distance < best_distance:
            best, best_distance = k, distance
    return best


@compiled
def nearest_node_downhill(
    table: Table, closed: bool, x: Float, y: Float, first: int, last: int, guess: int,
    spacing: Float, tightest: Float,
) -> int:  # fmt: skip
    """Index of the nearest node as `nearest_node` gives it, in a few steps from a good `guess`.

    The squared distance falls monotonically to one minimum among these nodes if the path curves
    gently enough. With K = `tightest` the largest curvature (see `tightest_turn`), d the distance
    at a local minimum and W the arc length from there to the far end of the searched nodes: along
    the path, the point's longitudinal and lateral offsets f, e in the path's frame follow
    f' = -1 + kappa e, e' = -kappa f, and half the squared distance has the second derivative
    1 - kappa e. While K |e| < 1, |f'| < 2, so |e| <= d + K W^2: K (d + K W^2) < 1 makes the
    distance convex on all of it. Where that fails, all nodes are searched.
    """
    node = min(max(guess, first), last)
    distance = squared_distance(table, closed, x, y, node)
    while node < last:
        ahead = squared_distance(table, closed, x, y, node + 1)
        if not ahead < distance:
            break
        node, distance = node + 1, ahead
    while node > first:
        behind = squared_distance(table, closed, x, y, node - 1)
        # Of equals the first, as in `nearest_node`.
        if not behind <= distance:
            break
        node, distance = node - 1, behind
    if first < node < last:
        # One more spacing, for f is not quite 0 at a node.
        turn = tightest * (max(node - first, last - node) + 1) * spacing
        margin = 1.0 - turn * turn
        if margin > 0.0 and tightest * tightest * distance < margin * margin:
            return node
    return nearest_node(table, closed, x, y, first, last)


@compiled
def foot_point(
    table: Table, h: Float, closed: bool, x: Float, y: Float, node: int
) -> tuple[int, Float, Float]:
    """Foot point of (x, y) beside a node: cell (counted over laps), u in [0, 1], lateral error.

    The squared distance from the cell's Hermite cubic is brought to its minimum by Newton's method
    in the cell towards which it falls at the node. The lateral error is positive to the left.
    """
    n = table.shape[0]
    base = node % (n - 1) if closed else node
    along = (x - table[base, X]) * table[base, COS] + (y - table[base, Y]) * table[base, SIN]
    u = along / h
    if (along < 0.0 and (closed or node > 0)) or (not closed and node == n - 1):
        node -= 1
        base = base - 1 if base > 0 else n - 2
        u += 1.0
    u = min(max(u, 0.0), 1.0)
    a, b = base, base + 1
    x0, x1, x2, x3 = cubic(table[a, X], h * table[a, COS], table[b, X], h * table[b, COS])
    y0, y1, y2, y3 = cubic(table[a, Y], h * table[a, SIN], table[b, Y], h * table[b, SIN])
    x0, y0 = x - x0, y - y0
    low = 0.3 * h * h
    for _ in range(NEWTON_STEPS):
        dx, dy = x0 - u * (x1 + u * (x2 + u * x3)), y0 - u * (y1 + u * (y2 + u * y3))
        tx, ty = x1 + u * (2.0 * x2 + 3.0 * u * x3), y1 + u * (2.0 * y2 + 3.0 * u * y3)
        bend = dx * (2.0 * x2 + 6.0 * u * x3) + dy * (2.0 * y2 + 6.0 * u * y3)
        step = (dx * tx + dy * ty) / max(tx * tx + ty * ty - bend, low)
        before = u
        u = min(max(u + step, 0.0), 1.0)
        # Newton's error squares from step to step: the next would be far below rounding.
        if not abs(u - before) > NEWTON_TOLERANCE:
            break
    dx, dy = x0 - u * (x1 + u * (x2 + u * x3)), y0 - u * (y1 + u * (y2 + u * y3))
    tx, ty = x1 + u * (2.0 * x2 + 3.0 * u * x3), y1 + u * (2.0 * y2 + 3.0 * u * y3)
    return node, u, (dy * tx - dx * ty) / math.sqrt(tx * tx + ty * ty)


@compiled
def searched_nodes(
    n: int, spacing: Float, closed: bool, near: Float, window: Float
) -> tuple[int, int]:
    """First and last node that a projection near an arc length searches."""
    middle = math.floor(near / spacing + 0.5)
    reach = math.ceil(window / spacing)
    if closed:
        return middle - reach, middle + reach
    middle = min(max(middle, 0), n - 1)
    return max(middle - reach, 0), min(middle + reach, n - 1)


@compiled
def arc_length_in(length: Float, closed: bool, n: int, index: int, u: Float) -> Float:
    """Arc length at u of a cell (counted over laps), m; exactly `length` at an open path's end."""
    if not closed and index == n - 2 and u >= 1.0:
        return length
    return (index + u) * (length / (n - 1))


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
    h = length / (n - 1)
    first, last = searched_nodes(n, h, closed, near, window)
    node = nearest_node(table, closed, x, y, first, last)
    index, u, lateral_error = foot_point(table, h, closed, x, y, node)
    s = arc_length_in(length, closed, n, index, u)
    heading = heading_at(table, length, closed, s)
    return s, lateral_error, heading, curvature_at(table, length, closed, s)


@compiled
def follow(
    table: Table, length: Float, closed: bool, x: Float, y: Float,
    near: Float, ahead: Float, window: Float, tightest: Float,
) -> tuple[Float, Float, Float, int, Float, int]:  # fmt: skip
    """Foot point of (x, y) that came from `near` and should be about `ahead` m further on.

    The same foot point as of `project`, found faster; `tightest` as `tightest_turn` gives it.
    Returns arc length, lateral error, heading (running on over laps), and, for `fill_preview` and
    the rest, cell, u in it and laps before it.
    """
    n = table.shape[0]
    h = length / (n - 1)
    first, last = searched_nodes(n, h, closed, near, window)
    # A guess however absurd is clipped to the window before it becomes an integer.
    guess = math.floor((near + min(max(ahead, -window), window)) / h + 0.5)
    node = nearest_node_downhill(table, closed, x, y, first, last, guess, h, tightest)
    index, u, lateral_error = foot_point(table, h, closed, x, y, node)
    s = arc_length_in(length, closed, n, index, u)
    laps = 0
    if closed:
        laps = index // (n - 1)
        index -= laps * (n - 1)
    heading = heading_in(table, h, index, u)
    if closed:
        heading += laps * (table[n - 1, HEADING] - table[0, HEADING])
    return s, lateral_error, heading, index, u, laps


@compiled
def fill_preview(
    table: Table, length: Float, closed: bool, s: Float, index: int, u: Float, period: Float,
    out: NDArray[Any], first: int, count: int, curvature_bound: Float, speed_bound: Float,
) -> None:  # fmt: skip
    """Write the preview at s (see `preview`), which is at u of the cell `index` (first lap).

    `out[first : first + count]` is filled with the curvatures, what follows with the speeds, both
    within their bounds.
    """
    n = table.shape[0]
    h = length / (n - 1)
    inverse = 1.0 / h
    duration, last_speed = table[n - 1, TIME], table[n - 1, SPEED]
    now = table[index, TIME] + 2.0 * u * h / (table[index, SPEED] + speed_in(table, index, u))
    heading = heading_in(table, h, index, u)
    # Where this lap's grid stands, in arc length, heading and time.
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
                out[first + k] = saturate(mean, curvature_bound)
                out[first + count + k] = saturate(last_speed, speed_bound)
                start, heading = end, next_heading
                continue
        # No need to look for the end: the last node's time is beyond `time`.
        while table[index + 1, TIME] <= time:
            index += 1
        v0, v1 = table[index, SPEED], table[index + 1, SPEED]
        tau = max(time - table[index, TIME], 0.0)
        half = 0.25 * (v1 * v1 - v0 * v0) * inverse * tau
        offset = min(tau * (v0 + half), h)
        end = base + (index * h + offset)
        next_heading = turned + heading_in(table, h, index, offset * inverse)
        out[first + k] = saturate(
            (next_heading - heading) / max(end - start, 1e-9), curvature_bound
        )
        out[first + count + k] = saturate(v0 + 2.0 * half, speed_bound)
        start, heading = end, next_heading


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
    count = curvature.shape[0]
    index, offset = cell(s, length, closed, table.shape[0])
    u = offset * (table.shape[0] - 1) / length
    values = np.empty(2 * count)
    fill_preview(table, length, closed, s, index, u, period, values, 0, count, math.inf, math.inf)
    curvature[:] = values[:count]
    speed[:] = values[count:]


def tightest_turn(table: Table, closed: bool) -> float:
    """Largest curvature of a path's table, 1/m: of its column, its headings and its polyline.

    The largest of the three, so that it bounds the path's bends even where the columns of a given
    file do not agree.
    """
    steps = np.diff(table[:, [X, Y]], axis=0)
    if closed:
        steps = np.concatenate([steps, steps[:1]])
    chords = np.hypot(steps[:, 0], steps[:, 1])
    cross = steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0]
    turns = np.arctan2(np.abs(cross), (steps[:-1] * steps[1:]).sum(axis=1))
    headings = np.diff(table[:, HEADING])
    shortest = float(chords.min())
    if shortest <= 0.0:
        return math.inf
    sharpest = max(float(turns.max()), float(np.abs(headings).max())) / shortest
    return max(sharpest, float(np.abs(table[:, CURVATURE]).max()))
