"""Jerk-limited speed profile along a path of given curvature, by sequential linear programming.

With b = v^2 over arc length, acceleration is a = b'/2 and jerk is v a'. Maximising speed under caps
from lateral acceleration, steering rate and top speed is then linear in b, except for the jerk
bound |a'| <= j b^(-1/2). Its right side is convex in b, so linearising it about the last profile
tightens it, and every iterate is feasible (Lipp and Boyd, Minimum-time speed optimisation over a
fixed path, 2014, for the variable b; the linearisation of the jerk bound is this project's).
A closed path is a periodic problem: its differences go on over the seam.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog

from trajectories.speed_limits import SpeedLimits

Array = NDArray[np.float64]

ITERATIONS = 6
"""Largest number of linear programmes."""
SETTLED = 1e-4
"""Relative gain of a lap's time that is worth a further programme for a closed path."""
JERK_MARGIN = 0.92
"""Share of the jerk that is used: at low speed the grid overshoots by up to 8 %."""
FACETS = 4
"""Facets of a quarter of the polygon within the circle of `max_total_acceleration`; at worst the
polygon is 2 % smaller, at zero longitudinal or lateral acceleration it touches the circle."""
CHATTER_WEIGHT = 2e-3
"""Weight of the L1 penalty on changes of acceleration; without it profiles chatter at the caps."""


def smoothed_at(values: Array, at: Array, *, closed: bool) -> Array:
    """Evaluate the uniform quadratic B-spline with control points `values` (m,) at indices (n,).

    Its slope, the acceleration, is continuous and linear between the midpoints of cells, whereas
    the linear programme's is a staircase; it stays within the control points' convex hull.
    """
    before, after = 2 * values[0] - values[1], 2 * values[-1] - values[-2]
    if closed:
        before, after = values[-1], values[0]
        values = np.append(values, after)
        after = values[1]
    padded = np.concatenate([[before], values, [after]])
    node, (before, here, after) = _spline(at, len(values))
    smoothed: Array = before * padded[node] + here * padded[node + 1] + after * padded[node + 2]
    return smoothed


def _spline(at: Array, count: int) -> tuple[NDArray[np.intp], tuple[Array, Array, Array]]:
    """Return the nearest of `count` nodes and the weights of it and its neighbours, each (n,)."""
    node = np.rint(at).astype(int).clip(0, count - 1)
    u = at - node
    return node, (0.5 * (0.5 - u) ** 2, 0.75 - u * u, 0.5 * (0.5 + u) ** 2)


def smoothing_rows(at: Array, count: int, *, closed: bool) -> sparse.csr_matrix:
    """Return the matrix (n, count) of `smoothed_at` at indices (n,)."""
    node, weights = _spline(at, count + closed)
    rows = sparse.csr_matrix((len(at), count))
    for shift, weight in zip((-1, 0, 1), weights, strict=True):
        column = (node + shift) % count if closed else (node + shift).clip(0, count - 1)
        outside = (node + shift != column) & (not closed)
        inner = np.where(column == 0, 1, count - 2)
        for entries, columns in (
            (np.where(outside, 2.0, 1.0) * weight, column),
            (np.where(outside, -weight, 0.0), inner),
        ):
            places = (np.arange(len(at)), columns)
            rows += sparse.csr_matrix((entries, places), shape=rows.shape)
    return rows


class _Facet(NamedTuple):
    """A bound on the accelerations a and a_y: `along` a + `across` a_y <= `bound`."""

    along: float
    across: float
    bound: float
    idle: float
    """Lateral acceleration up to which the other limits keep this one, m/s^2."""


def _facets(limits: SpeedLimits) -> list[_Facet]:
    """Return the facets of the region of `limits` that its other bounds do not keep."""
    facets = []
    most = {1.0: limits.max_acceleration, -1.0: limits.deceleration}
    if (radius := limits.max_total_acceleration) is not None:
        half = 0.25 * np.pi / FACETS
        for sign, largest in most.items():
            idle = np.sqrt(max(radius**2 - largest**2, 0.0)) * np.cos(half)
            for facet in range(FACETS):
                if radius * np.cos(2.0 * half * (facet + 1)) < largest:
                    angle = half * (2 * facet + 1)
                    normal = sign * np.cos(angle), np.sin(angle)
                    facets.append(_Facet(*normal, radius * np.cos(half), idle))
    for (x, y), (next_x, next_y) in pairwise(limits.corners or ()):
        along, across = y - next_y, next_x - x
        bound = along * x + across * y
        idle = (bound - abs(along) * most[1.0 if along > 0.0 else -1.0]) / across
        facets.append(_Facet(along, across, bound, idle))
    return facets


def _within_region(
    bent: Array, caps: Array, difference: sparse.csr_matrix, limits: SpeedLimits
) -> tuple[sparse.csr_matrix, Array]:
    """Bound both accelerations in the cells by `_facets`: matrix on squared speeds, upper bounds.

    Longitudinal acceleration is `difference` b, in the cells; the lateral one at either end of a
    cell is `bent` b, (m,) 1/m. Where a speed may not fall to what the lateral acceleration allows,
    nothing is left for braking.
    """
    bent = np.minimum(bent, limits.max_lateral_acceleration / caps)
    lateral = sparse.diags(bent).tocsr()
    most_lateral = bent * caps
    first = np.arange(difference.shape[0])
    last = (first + 1) % len(bent)
    larger = np.maximum(most_lateral[first], most_lateral[last])
    rows, bounds = [sparse.csr_matrix((0, len(bent)))], [np.empty(0)]
    for facet in _facets(limits):
        cells = np.flatnonzero(larger > facet.idle)
        longitudinal = facet.along * difference[cells]
        rows += [longitudinal + facet.across * lateral[ends[cells]] for ends in (first, last)]
        bounds.append(np.full(2 * len(cells), facet.bound))
    return sparse.vstack(rows, format="csr"), np.concatenate(bounds)


def plan(
    caps: Array,
    bent: Array,
    eased: Array,
    h: float,
    limits: SpeedLimits,
    between_nodes: tuple[sparse.csr_matrix, Array],
    *,
    closed: bool,
) -> Array:
    """Plan the squared speed (m,) on a grid of spacing h under squared caps (m,).

    `bent` is |curvature| (m,), 1/m, and `eased` the share of the jerk to use (m,). Further bounds
    on sums of squared speeds are `between_nodes`: rows (k, m) and bounds (k,). After the last node
    of a closed path comes the first again.
    """
    m = len(caps)
    end = float(caps.min()) if closed else min(limits.end_speed**2, float(caps[0]), float(caps[-1]))
    upper = caps.copy()
    lowest = min(end, limits.min_speed**2)
    lower = np.full(m, lowest)
    # a = D b, in the cells; change of a = E b, at the nodes between two cells
    if closed:
        following = sparse.identity(m, format="csr")[np.r_[1:m, 0]]
        difference = (0.5 / h * (following - sparse.identity(m))).tocsr()
        change = (difference - following.T @ difference).tocsr()
        between = slice(None)
    else:
        upper[[0, -1]] = lower[[0, -1]] = end
        difference = sparse.diags([-0.5 / h, 0.5 / h], [0, 1], shape=(m - 1, m)).tocsr()
        change = (difference[1:] - difference[:-1]).tocsr()
        between = slice(1, -1)
    cells, inner = difference.shape[0], change.shape[0]
    squared = without_jerk(upper, h, limits, closed=closed)
    identity = sparse.identity(inner, format="csr")
    nothing = sparse.csr_matrix((cells, inner))
    region, most = _within_region(bent, caps, difference, limits)
    region, most = sparse.vstack([region, between_nodes[0]]), np.append(most, between_nodes[1])
    fastest = np.inf
    for _ in range(ITERATIONS):
        last = np.maximum(squared, lower)[between]
        # j h b^(-1/2) linearised at b0: j h (1.5 b0^(-1/2) - 0.5 b0^(-3/2) b)
        allowed = JERK_MARGIN * limits.max_jerk * h * eased[between]
        constant = 1.5 * allowed * last**-0.5
        slope = sparse.diags(
            [0.5 * allowed * last**-1.5], [0 if closed else 1], shape=(inner, m)
        ).tocsr()
        constraints = sparse.vstack(
            [
                sparse.hstack([difference, nothing]),
                sparse.hstack([-difference, nothing]),
                sparse.hstack([change + slope, 0 * identity]),
                sparse.hstack([slope - change, 0 * identity]),
                sparse.hstack([change, -identity]),
                sparse.hstack([-change, -identity]),
                sparse.hstack([region, sparse.csr_matrix((len(most), inner))]),
            ],
            format="csr",
        )
        faster = np.full(cells, limits.max_acceleration)
        slower = np.full(cells, limits.deceleration)
        if not closed:
            # Acceleration is zero at both ends, so jerk limits it in the first and the last cell.
            standing = JERK_MARGIN * limits.max_jerk * h * end**-0.5
            faster[0] = min(faster[0], standing)
            slower[-1] = min(slower[-1], standing)
        bounds = np.concatenate([faster, slower, constant, constant, np.zeros(2 * inner), most])
        weight = np.maximum(squared, end) ** -1.5
        cost = np.concatenate([-weight, np.full(inner, CHATTER_WEIGHT)])
        result = linprog(
            cost,
            A_ub=constraints,
            b_ub=bounds,
            bounds=np.column_stack(
                [np.append(lower, np.zeros(inner)), np.append(upper, np.full(inner, np.inf))]
            ),
            method="highs",
        )
        if result.x is None and lower[0] > lowest:
            lower[[0, -1]] = lowest
            continue
        if result.x is None:
            raise RuntimeError(f"no speed profile found: {result.message}")
        planned = result.x[:m]
        time = float((planned**-0.5).sum())
        if closed and time > (1.0 - SETTLED) * fastest:
            return planned if time < fastest else squared
        moved = float(np.abs(np.sqrt(planned) - np.sqrt(squared)).max())
        squared, fastest = planned, time
        if moved < 1e-3:
            break
    return squared


def without_jerk(caps: Array, h: float, limits: SpeedLimits, *, closed: bool) -> Array:
    """Compute the first iterate: a forward and a backward pass under acceleration bounds alone."""
    if closed:
        # The neighbours of the lowest cap do not lower it: a lap from there to there is open.
        lowest = int(np.argmin(caps))
        around = np.roll(caps, -lowest)
        lap = without_jerk(np.append(around, around[0]), h, limits, closed=False)
        return np.roll(lap[:-1], lowest)
    squared = caps.copy()
    for k in range(1, len(squared)):
        squared[k] = min(squared[k], squared[k - 1] + 2 * limits.max_acceleration * h)
    for k in range(len(squared) - 2, -1, -1):
        squared[k] = min(squared[k], squared[k + 1] + 2 * limits.deceleration * h)
    return squared
