"""Compiled projection: the foot point of a position on a path's table.

The search stays within a window around the last arc length, and so on the local branch of a path
that crosses or approaches itself.
"""

import math

import numpy as np

from trajectories.compilation import compiled, compiled_inline, compiled_internal
from trajectories.table import (
    COS,
    CURVATURE,
    HEADING,
    SIN,
    Float,
    Table,
    X,
    Y,
    cubic,
    curvature_at,
    heading_at,
    heading_in,
)

SEARCH_WINDOW = 3.0
"""m to each side of the last arc length."""
NEWTON_STEPS = 8
"""Largest number of steps; two or three are usual."""
NEWTON_TOLERANCE = 1e-6
"""Share of a cell: Newton's method stops after a smaller step, for the next would be its square."""
FAR = 1.0e300
"""m^2, larger than any squared distance."""


@compiled_internal
def squared_distance(table: Table, closed: bool, x: Float, y: Float, node: int) -> Float:
    """Squared distance of a point from a node, m^2; on a closed path nodes count on over laps."""
    if closed:
        node %= table.shape[0] - 1
    dx, dy = x - table[node, X], y - table[node, Y]
    return dx * dx + dy * dy


@compiled_internal
def nearest_node(table: Table, closed: bool, x: Float, y: Float, first: int, last: int) -> int:
    """Index of the node nearest to a point from `first` to `last`; the first of equally near ones.

    On a closed path the indices count on over laps.
    """
    best, best_distance = first, FAR
    for k in range(first, last + 1):
        distance = squared_distance(table, closed, x, y, k)
        if distance < best_distance:
            best, best_distance = k, distance
    return best


@compiled_inline
def nearest_node_downhill(
    table: Table, closed: bool, x: Float, y: Float, first: int, last: int, guess: int,
    spacing: Float, tightest: Float,
) -> int:  # fmt: skip
    """Index of the nearest node, as `nearest_node` finds it, in a few steps from a good `guess`.

    The squared distance falls monotonically to one minimum among these nodes if the path curves
    gently enough. Let K = `tightest` be the largest curvature (see `tightest_turn`), d the distance
    at a local minimum and W the arc length from there to the far end of the searched nodes. Along
    the path, the point's longitudinal and lateral offsets f, e in the path's frame follow
    f' = -1 + kappa e, e' = -kappa f, and half the squared distance has the second derivative
    1 - kappa e. While K |e| < 1, |f'| < 2, so |e| <= d + K W^2: K (d + K W^2) < 1 makes the
    distance convex over all searched nodes. Where that fails, every node is compared.
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
        # The first of equally near nodes, as in `nearest_node`.
        if not behind <= distance:
            break
        node, distance = node - 1, behind
    if first < node < last:
        # One more spacing, because f is not exactly 0 at a node.
        turn = tightest * (max(node - first, last - node) + 1) * spacing
        margin = 1.0 - turn * turn
        if margin > 0.0 and tightest * tightest * distance < margin * margin:
            return node
    return nearest_node(table, closed, x, y, first, last)


@compiled_inline
def foot_point(
    table: Table, h: Float, closed: bool, x: Float, y: Float, node: int
) -> tuple[int, Float, Float]:
    """Foot point of (x, y) near a node: cell (counted over laps), u in [0, 1], lateral error.

    Of the two cells at the node, take the one towards which the squared distance falls, and
    minimise the squared distance from its Hermite cubic by Newton's method. The lateral error is
    positive to the left.
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
        # The error squares from step to step: the next step would be far below rounding.
        if not abs(u - before) > NEWTON_TOLERANCE:
            break
    dx, dy = x0 - u * (x1 + u * (x2 + u * x3)), y0 - u * (y1 + u * (y2 + u * y3))
    tx, ty = x1 + u * (2.0 * x2 + 3.0 * u * x3), y1 + u * (2.0 * y2 + 3.0 * u * y3)
    return node, u, (dy * tx - dx * ty) / math.sqrt(tx * tx + ty * ty)


@compiled_internal
def searched_nodes(
    n: int, spacing: Float, closed: bool, near: Float, window: Float
) -> tuple[int, int]:
    """First and last node within `window` (m) of the arc length `near`."""
    middle = math.floor(near / spacing + 0.5)
    reach = math.ceil(window / spacing)
    if closed:
        return middle - reach, middle + reach
    middle = min(max(middle, 0), n - 1)
    return max(middle - reach, 0), min(middle + reach, n - 1)


@compiled_internal
def arc_length_in(length: Float, closed: bool, n: int, index: int, u: Float) -> Float:
    """Arc length at u in a cell (counted over laps), m; exactly `length` at an open path's end."""
    if not closed and index == n - 2 and u >= 1.0:
        return length
    return (index + u) * (length / (n - 1))


@compiled
def project(
    table: Table, length: Float, closed: bool, x: Float, y: Float, near: Float, window: Float
) -> tuple[Float, Float, Float, Float]:
    """Foot point of (x, y): arc length, lateral error, heading and curvature there.

    The nearest node within `window` of the arc length `near` is found first, then the foot point by
    Newton's method. The lateral error is positive to the left of the path. The arc length counts on
    over laps with `near` on a closed path, and lies within [0, length] on an open one.
    """
    n = table.shape[0]
    h = length / (n - 1)
    first, last = searched_nodes(n, h, closed, near, window)
    node = nearest_node(table, closed, x, y, first, last)
    index, u, lateral_error = foot_point(table, h, closed, x, y, node)
    s = arc_length_in(length, closed, n, index, u)
    heading = heading_at(table, length, closed, s)
    return s, lateral_error, heading, curvature_at(table, length, closed, s)


@compiled_inline
def follow(
    table: Table, length: Float, closed: bool, x: Float, y: Float,
    near: Float, ahead: Float, window: Float, tightest: Float,
) -> tuple[Float, Float, Float, int, Float, int]:  # fmt: skip
    """Foot point of (x, y), expected about `ahead` m further on than the last one at `near`.

    The foot point equals that of `project` but is found faster; `tightest` is the result of
    `tightest_turn`. Returns arc length, lateral error, heading (counting on over laps), cell (on
    the first lap), u in it, and the number of laps before it.
    """
    n = table.shape[0]
    h = length / (n - 1)
    first, last = searched_nodes(n, h, closed, near, window)
    # Clip the guess to the window before it becomes an integer, however absurd it is.
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


def tightest_turn(table: Table, closed: bool) -> float:
    """Largest curvature of a path's table, 1/m, by its column, its headings or its polyline.

    The largest of the three bounds the path's bends even where the columns of a file disagree.
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
