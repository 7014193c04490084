"""Speed profiles of paths: planned up to limits, or given and kept up to limits."""

from dataclasses import asdict, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from trajectories import plan_cache, speed_limits, speed_program
from trajectories.arguments import Number, array, instance_of
from trajectories.path import MINIMUM_POINTS, MINIMUM_SPEED, ReferencePath
from trajectories.speed_limits import SpeedLimits
from trajectories.speed_program import plan, smoothed_at, smoothing_rows, without_jerk

__all__ = [
    "GRAVITY", "SpeedLimits", "constant_speed", "keep_speed", "plan_speed", "replanned",
    "speed_caps",
]  # fmt: skip

Array = NDArray[np.float64]

GRAVITY = 9.81
"""m/s^2."""
GRID, COARSEST_GRID, FINE_CELLS = 1.0, 2.0, 3000
"""Usual spacing of the linear programmes' grid, m, its largest spacing, and the number of cells
that longer paths keep between these two."""
CELL_TURN = 0.25
"""rad: largest turn in a cell of the grid, which small cars' bends need, up to `FINE_CELLS`."""
ROUNDS, KEPT = 12, 1.005
"""Largest number of plans for a path, and the excess over a limit that is not worth another."""
STEERING_MARGIN = 0.96
"""Share of the steering rate that is used."""
SPACINGS = Number(1e-3, 1e9, "m")
LONGEST = 40_000.0
"""m: longest path that is planned; it takes some ten seconds."""
PLANS = 64
"""Number of profiles that are kept, so that none is planned twice in a row."""


def speed_caps(
    curvature: Array,
    spacing: float,
    limits: SpeedLimits,
    share: Array | float = 1.0,
    *,
    closed: bool = False,
) -> Array:
    """Pointwise bound on speed (n,), m/s, by top speed, lateral acceleration and steering rate.

    `share`, (n,) or a scalar, scales the lateral acceleration that may be used at a point.
    """
    bent = np.maximum(np.abs(curvature), 1e-9)
    lateral = np.sqrt(share * limits.max_lateral_acceleration / bent)
    steering = np.arctan(limits.wheelbase * curvature)
    slope = np.gradient(steering, spacing)
    if closed:
        slope[[0, -1]] = (steering[1] - steering[-2]) / (2.0 * spacing)
    slope = np.maximum(np.abs(slope), 1e-12)
    caps = np.minimum(lateral, STEERING_MARGIN * limits.max_steering_rate / slope)
    bounded: Array = np.minimum(limits.max_speed, np.maximum(caps, limits.min_speed))
    return bounded


def plan_speed(
    curvature: Array,
    spacing: float,
    limits: SpeedLimits,
    *,
    closed: bool = False,
    share: Array | float = 1.0,
) -> Array:
    """Plan the fastest jerk-limited speed profile (n,), m/s, for a `curvature` (n,), 1/m.

    An open path starts and ends at `limits.end_speed`, or as fast as its bends allow if that is too
    fast for them; the profile of a closed one is periodic, its last node the first again. Limits
    are kept to about 1 % at the nodes; lateral acceleration and steering rate are exceeded where
    they would need less than `limits.min_speed`.

    Raises
    ------
    RuntimeError
        If the linear programme finds no profile; the message contains the solver's.
    ValueError
        If the path is longer than `LONGEST`, or an argument is of another kind.
    """
    instance_of("limits", limits, SpeedLimits, "SpeedLimits")
    spacing, curvature = SPACINGS.of("spacing", spacing), array("curvature", curvature)
    if curvature.ndim != 1 or len(curvature) < MINIMUM_POINTS or not np.isfinite(curvature).all():
        raise ValueError(
            f"curvature must be at least {MINIMUM_POINTS} finite numbers in a row, not of shape "
            f"{curvature.shape}"
        )
    share = array("share", share)
    if share.shape not in {(), curvature.shape} or not (share > 0.0).all() or share.max() > 1e3:
        raise ValueError("share must be positive numbers, one or as many as there are curvatures")
    length = spacing * (len(curvature) - 1)
    if not length <= LONGEST:
        raise ValueError(
            f"a speed profile over {length:.4g} m is too long: at most {LONGEST:g} m are planned"
        )
    return _planned(curvature.tobytes(), spacing, limits, bool(closed), share.tobytes()).copy()


@lru_cache(maxsize=PLANS)
def _planned(
    curvature: bytes, spacing: float, limits: SpeedLimits, closed: bool, share: bytes
) -> Array:
    """Compute the result of `plan_speed`, whose arrays are given as bytes."""
    if (total := limits.max_total_acceleration) is not None:
        limits = replace(
            limits,
            max_lateral_acceleration=min(limits.max_lateral_acceleration, total),
            max_acceleration=min(limits.max_acceleration, total),
            max_deceleration=min(limits.deceleration, total),
        )
    kappa, shares = np.frombuffer(curvature), np.frombuffer(share)
    content = (curvature, share, repr((spacing, limits, closed)).encode())
    sources = (__file__, speed_limits.__file__, speed_program.__file__)
    return plan_cache.computed(
        sources, content, lambda: _plan(kappa, spacing, limits, closed, shares)
    )


def _plan(
    curvature: Array, spacing: float, limits: SpeedLimits, closed: bool, share: Array
) -> Array:
    """Plan on a grid, and anew with tighter bounds where limits are exceeded between its nodes."""
    caps = speed_caps(curvature, spacing, limits, share, closed=closed)
    length, sharpest = spacing * (len(curvature) - 1), float(np.abs(curvature).max())
    grid = min(max(length / FINE_CELLS, GRID), COARSEST_GRID)
    grid = min(grid, max(CELL_TURN / max(sharpest, 1e-9), length / FINE_CELLS, spacing))
    cells = max(int(np.ceil(length / grid)), 8)
    coarse = np.linspace(0.0, length, cells + 1)
    fine = np.linspace(0.0, length, len(curvature))
    # The nodes of a lap: its last one is the first.
    lap = slice(-1 if closed else None)
    # A coarse node takes the lowest cap around it, so that no cap is lost between nodes.
    reach = int(np.ceil(0.5 * length / cells / spacing))
    nodes = np.rint(coarse[lap] / spacing).astype(int) % len(caps[lap])
    lowest, bent = (
        np.lib.stride_tricks.sliding_window_view(
            np.pad(values[lap], reach, mode="wrap" if closed else "edge"), 2 * reach + 1
        )[nodes]
        for values in (caps, np.abs(curvature))
    )
    upper, bent, eased = lowest.min(axis=1) ** 2, bent.max(axis=1), np.ones(len(nodes))
    at = fine * (cells / length)
    nearest = np.rint(at).astype(int) % len(nodes)
    rows, bounds = sparse.csr_matrix((0, len(nodes))), np.empty(0)
    best, least = np.empty(0), np.inf
    for _ in range(ROUNDS):
        try:
            squared = plan(
                upper, bent, eased, length / cells, limits, (rows, bounds), closed=closed
            )
        except RuntimeError:
            if best.size:
                break
            raise
        planned = np.sqrt(np.minimum(smoothed_at(squared, at, closed=closed), limits.max_speed**2))
        if closed:
            planned[-1] = planned[0]
        over, jerked = _excess(planned, curvature, spacing, limits, share, closed=closed)
        worst = max(over.max(), jerked.max())
        if worst < least:
            best, least = planned, worst
        if worst <= KEPT:
            break
        beyond = np.flatnonzero(over > 1.0)
        added = smoothing_rows(at[beyond], len(nodes), closed=closed)
        rows = sparse.vstack([rows, added], format="csr")
        bounds = np.append(bounds, planned[beyond] ** 2 / over[beyond])
        harder = np.ones(len(nodes))
        np.maximum.at(harder, nearest, jerked)
        eased = eased / harder**1.5
    return best


def _excess(
    speed: Array,
    curvature: Array,
    spacing: float,
    limits: SpeedLimits,
    share: Array,
    *,
    closed: bool,
) -> tuple[Array, Array]:
    """Measure which shares of the limits a profile uses at the path's own nodes, two of (n,).

    The first is the largest share of all that grows with the squared speed: lateral acceleration,
    the square of the steering rate, and both accelerations together. It is at most that by which
    the squared speed exceeds that of `min_speed`, to which alone it may be lowered. The second is
    the share of the jerk.
    """
    ends = slice(-2, -1) if closed else slice(1), slice(1, 2) if closed else slice(-1, None)
    v, kappa = (np.concatenate([u[ends[0]], u, u[ends[1]]]) for u in (speed, curvature))
    along, steering = np.diff(v**2) / (2.0 * spacing), np.arctan(limits.wheelbase * kappa)
    in_cells = 0.5 * (v[1:] + v[:-1]) * np.abs(np.diff(steering)) / spacing
    at_nodes = 0.5 * speed * np.abs(steering[2:] - steering[:-2]) / spacing
    steered = np.maximum(at_nodes, _larger(in_cells)) / limits.max_steering_rate
    lateral = speed**2 * np.abs(curvature)
    over = np.maximum(lateral / (share * limits.max_lateral_acceleration), steered**2)
    if (total := limits.max_total_acceleration) is not None:
        over = np.maximum(over, np.hypot(_larger(np.abs(along)), lateral) / total)
    for (x, y), (next_x, next_y) in pairwise(limits.corners or ()):
        facing, across = y - next_y, next_x - x
        used = _larger(facing * along) + across * lateral
        over = np.maximum(over, used / (facing * x + across * y))
    jerked = speed * np.abs(np.diff(along)) / (spacing * limits.max_jerk)
    if not closed:
        jerked[[0, -1]] = 0.0
    return np.minimum(over, (speed / limits.min_speed) ** 2), jerked


def _larger(cells: Array) -> Array:
    """Return the larger value of the two cells beside each node."""
    return np.maximum(cells[1:], cells[:-1])


def keep_speed(
    speed: Array, curvature: Array, spacing: float, limits: SpeedLimits, *, closed: bool = False
) -> Array:
    """Lower speeds (n,), m/s, to the highest ones that keep to limits, but for that of the jerk.

    Given speeds are kept wherever top speed, lateral acceleration, steering rate and both
    longitudinal accelerations allow them. The result is never below `MINIMUM_SPEED`, to which
    stops are raised.

    Parameters
    ----------
    speed, curvature
        (n,) m/s and 1/m at nodes `spacing` (m) apart.
    limits
        Limits; total acceleration and corners are not used.
    closed
        Whether the last node is the first again.
    """
    slow = replace(limits, min_speed=MINIMUM_SPEED)
    caps = np.minimum(speed_caps(curvature, spacing, slow, closed=closed), speed)
    caps = np.maximum(caps, MINIMUM_SPEED)
    if closed:
        caps = np.append(min(caps[0], caps[-1]), caps[1:-1])
    squared = caps**2
    passed = without_jerk(squared, spacing, limits, closed=closed)
    kept: Array = np.where(passed < squared, np.sqrt(passed), caps)
    return np.append(kept, kept[0]) if closed else kept


def replanned(path: ReferencePath, limits: SpeedLimits, **metadata: Any) -> ReferencePath:
    """Return the same geometry with the profile that `limits` allow, which its metadata name.

    Raises
    ------
    RuntimeError, ValueError
        As `plan_speed`.
    """
    speed = plan_speed(path.curvature, path.spacing, limits, closed=path.closed)
    return path.with_speed(speed, limits=asdict(limits), **metadata)


def constant_speed(path: ReferencePath) -> float:
    """Highest constant speed (m/s) that a path's own limits allow all along it.

    Never below the limits' end speed, so that kinked waypoints are driven at walking pace. A path
    without limits in its metadata is driven at its lowest speed.
    """
    if "limits" not in path.metadata:
        return float(path.speed.min())
    limits = SpeedLimits(**path.metadata["limits"])
    caps = speed_caps(path.curvature, path.spacing, limits, closed=path.closed)
    return max(float(caps.min()), limits.end_speed)
