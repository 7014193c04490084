"""The compiled preview: what a reference does over the next periods of its own time."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajectories.compilation import compiled, compiled_inline
from trajectories.interpolation import (
    HEADING,
    SPEED,
    TIME,
    Float,
    Table,
    cell,
    heading_in,
    speed_in,
)


@compiled_inline
def fill_preview(
    table: Table, length: Float, closed: bool, s: Float, index: int, u: Float, period: Float,
    out: NDArray[Any], first: int, count: int, curvature_bound: Float, speed_bound: Float,
) -> None:  # fmt: skip
    """Write the preview at s (see `preview`), which is at u of the cell `index` (first lap).

    `out[first : first + count]` is filled with the curvatures, what follows with the speeds, both
    within their bounds.
    """
    n = table.shape[0]
    # It never is negative, but only so compiled code knows and does not look at every access.
    index = max(index, 0)
    h = length / (n - 1)
    inverse, quarter = 1.0 / h, 0.25 * (n - 1) / length
    # In one type: comparisons of mixed ones cost conversions.
    curvature_bound, speed_bound = np.float64(curvature_bound), np.float64(speed_bound)
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
                out[first + k] = min(max(mean, -curvature_bound), curvature_bound)
                out[first + count + k] = min(last_speed, speed_bound)
                start, heading = end, next_heading
                continue
        # No need to look for the end: the last node's time is beyond `time`.
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
    """Fill the preview at s: what the reference does over the next `count` periods of its own time.

    `values`, (2 count,): first the mean signed curvature between the arc lengths that the reference
    reaches k and k + 1 periods from now, so that headings at these nodes follow exactly; then its
    speed at node k + 1. An open path goes on straight at its last speed.
    """
    count = values.shape[0] // 2
    index, offset = cell(s, length, closed, table.shape[0])
    u = offset * (table.shape[0] - 1) / length
    fill_preview(table, length, closed, s, index, u, period, values, 0, count, math.inf, math.inf)
